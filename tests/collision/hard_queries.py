"""Families of CCD queries that are random or hard: each is f(rng, n) -> points (n, 8, 3), for both kinds of pairs."""

import numpy as np


def _motion(rng, start, size):
    """Moves every vertex by up to `size` (scalar or (n,))."""
    size = np.broadcast_to(size, len(start))[:, None, None]
    return np.concatenate([start, start + size * rng.uniform(-1, 1, start.shape)], axis=1)


def _powers(rng, n, low, high):
    return 10.0 ** rng.uniform(low, high, n)


def random(rng, n):
    return rng.uniform(-1, 1, (n, 8, 3))


def small_motions(rng, n):
    """What a time step asks: neighbours, motions of 1e-6 to 1 of their size."""
    return _motion(rng, rng.uniform(-1, 1, (n, 4, 3)) * [1, 1, 0.1], _powers(rng, n, -6, 0))


def tiny_motions(rng, n):
    """Nearly touching, and moving by about as little."""
    points = hits(rng, n)
    before = _powers(rng, n, -13, -3)[:, None, None]
    return np.concatenate([_before(points, before), _before(points, -before)], axis=1)


def flat_sheets(rng, n):
    """Everything in one plane at the start; in half of the queries at the end too."""
    points = _motion(rng, rng.uniform(-1, 1, (n, 4, 3)) * [1, 1, 0], _powers(rng, n, -4, 0))
    points[: n // 2, 4:, 2] = 0
    return points


def stacked_sheets(rng, n):
    """Two parallel planes that come together: a vertex over a triangle, edges that cross in the view from above."""
    points = rng.uniform(-1, 1, (n, 4, 3)) * [1, 1, 0]
    points = np.concatenate([points, points], axis=1)
    points[:, :4, 2] = np.where(rng.random((n, 1)) < 0.5, [1, 0, 0, 0], [1, 1, 0, 0]) * _powers(rng, n, -12, -1)[:, None]
    points[:, 4:, 2] = rng.uniform(-1, 1, (n, 4)) * points[:, :1, 2]
    return points


def parallel_edges(rng, n):
    """Edges (and triangle sides) parallel to 0 .. 1e-2, sliding along one another."""
    along, across = rng.normal(size=(n, 1, 3)), rng.normal(size=(n, 1, 3))
    where = rng.uniform(-1, 1, (n, 4, 1))
    tilt = rng.choice([0, 1e-16, 1e-12, 1e-8, 1e-5, 1e-2], (n, 1, 1))
    start = where * along + [[0], [0], [1], [1]] * across * _powers(rng, n, -8, 0)[:, None, None]
    start = start + tilt * rng.normal(size=start.shape)
    slide = np.concatenate([start, start + rng.uniform(-1, 1, (n, 4, 1)) * along], axis=1)
    slide[:, 6:] -= across * rng.uniform(0, 1, (n, 1, 1))
    return slide


def slivers(rng, n):
    """A triangle with a height of 1e-12 to 1e-2, or an edge of that length."""
    points = rng.uniform(-1, 1, (n, 8, 3))
    thin = _powers(rng, n, -12, -2)[:, None]
    points[:, 3] = points[:, 2] + thin * (points[:, 3] - points[:, 2])
    points[:, 7] = points[:, 6] + thin * (points[:, 7] - points[:, 6])
    gap = _before(points, 0.0)[:, 2] - _before(points, 0.0)[:, 0]
    points[:, [0, 4]] += gap[:, None] + thin[:, None] * rng.normal(size=(n, 1, 3)) * rng.integers(0, 2, (n, 1, 1))
    return points


def far_away(rng, n):
    """1e2 to 1e7 sizes from the origin, where coordinates are coarse."""
    return hits(rng, n) + rng.normal(size=(n, 1, 3)) * _powers(rng, n, 2, 7)[:, None, None]


def hits(rng, n):
    """At t = 1/2 two points of the primitives are in the same place: for half of them as one kind, for half as the other."""
    return _meeting(rng, n, boundary=False)


def grazing(rng, n):
    """As `hits`, but the common point is on the boundary, to within an ulp or so."""
    return _meeting(rng, n, boundary=True)


def _before(points, time):
    """Positions `time` before t = 1/2."""
    return 0.5 * (points[:, :4] + points[:, 4:]) + time * (points[:, :4] - points[:, 4:])


def _meeting(rng, n, boundary):
    points = rng.uniform(-1, 1, (n, 8, 3))
    t = 0.5
    vertex_triangle = rng.random(n) < 0.5
    w = rng.dirichlet([1, 1, 1], n)
    s = rng.random((n, 2))
    if boundary:
        w[:, rng.integers(3)] = 0
        w /= w.sum(axis=1, keepdims=True)
        s[:, rng.integers(2)] = rng.integers(0, 2, n)
    one = np.ones((n, 1))
    face = np.concatenate([one, -w], axis=1)
    edge = np.concatenate([1 - s[:, :1], s[:, :1], s[:, 1:] - 1, -s[:, 1:]], axis=1)
    weights = np.where(vertex_triangle[:, None], face, edge)[:, :, None]
    at = (1 - t) * points[:, :4] + t * points[:, 4:]
    # move the first primitive (its vertices have positive weights) so that the gap at t closes
    first = weights > 0
    gap = (weights * at).sum(axis=1, keepdims=True)
    return points - np.tile(first, (1, 2, 1)) * gap


def touching(rng, n):
    """Apart by a few units in the last place at the start, or touching."""
    grid = np.round(_before(hits(rng, n), 0.0) * 64) / 64
    grid[:, 1:, 2] = grid[:, :1, 2]
    ulps = rng.integers(0, 4, n)
    grid[:, 0, 2] += ulps * np.spacing(np.abs(grid[:, 0, 2]))
    return _motion(rng, grid, _powers(rng, n, -15, 0))


def lattice(rng, n):
    """Whole numbers from -2 to 2: everything coplanar, parallel, degenerate, touching, at rest, often several at once."""
    return rng.integers(-2, 3, (n, 8, 3)).astype(float)


def at_rest(rng, n):
    """One primitive does not move; in a third of the queries neither does, in a third all move together."""
    points = hits(rng, n)
    points[:, 5:] = points[:, 1:4]
    third = n // 3
    points[:third, 4:] = points[:third, :4]
    points[third : 2 * third, 4:] = points[third : 2 * third, :4] + rng.normal(size=(third, 1, 3))
    return points


def degenerate(rng, n):
    """Triangles and edges without area or length, and vertices in the same place."""
    points = hits(rng, n)
    same, other = rng.integers(0, 4, n), rng.integers(0, 4, n)
    rows = np.arange(n)
    points[rows, same] = points[rows, other]
    points[rows, same + 4] = points[rows, other + 4]
    middle = rng.random(n) < 0.5
    points[middle, 3] = 0.5 * (points[middle, 1] + points[middle, 2])
    return points


def specks(rng, n):
    """One primitive, or one of its sides, is so small that products of its sides underflow."""
    points = rng.uniform(-1, 1, (n, 8, 3))
    small = _powers(rng, n, -170, -15)[:, None, None]
    first = np.where(rng.random((n, 1)) < 0.5, [1, 1, 0, 0], [0, 1, 1, 1])[:, :, None]
    return points * np.where(np.tile(first, (1, 2, 1)), small, 1)


def rotating(rng, n):
    """Half turns, where the volume has all three of its roots."""
    start = rng.uniform(-1, 1, (n, 4, 3))
    end = start * rng.choice([-1, 1], (n, 1, 3)) + 0.1 * rng.normal(size=(n, 4, 3))
    return np.concatenate([start, end], axis=1)


FAMILIES = (
    random,
    small_motions,
    tiny_motions,
    flat_sheets,
    stacked_sheets,
    parallel_edges,
    slivers,
    far_away,
    hits,
    grazing,
    touching,
    lattice,
    at_rest,
    degenerate,
    specks,
    rotating,
)


# --- pairs that culling is asked about, and wants to leave out: as above, but near the edge of what it may leave out ---


def ridges(rng, n):
    """Long edges that cross at 1e-9 to 1e-3 rad, a gap of 1e-13 to 1e-3 of their length apart, and what lies beside them."""
    x = np.stack([-1 + rng.uniform(-0.3, 0.3, n), 1 + rng.uniform(-0.3, 0.3, n)], axis=1)
    angle, gap = _powers(rng, n, -9, -3), _powers(rng, n, -13, -3)
    cross = rng.uniform(-1, 1, n) * (rng.random(n) < 0.5)
    start = np.zeros((n, 4, 3))
    start[:, :2, 0] = x
    start[:, 2:, 0] = x[:, ::-1] * rng.choice([-1, 1], (n, 1)) + rng.uniform(-0.3, 0.3, (n, 2))
    start[:, 2:, 2] = (start[:, 2:, 0] - cross[:, None]) * angle[:, None]
    start[:, 2:, 1] = gap[:, None]
    # for a vertex and a triangle: a vertex over a needle
    middle = 0.5 * (start[:, :1] + start[:, 1:2])
    needle = rng.random(n) < 0.5
    start[needle, 0] = (middle + rng.uniform(-0.2, 0.2, (n, 1, 1)) * (start[:, 1:2] - middle))[needle, 0]
    start = _turned(rng, start)
    move = np.where(rng.random(n) < 0.5, 0.0, gap * _powers(rng, n, -2, 1))
    return _motion(rng, start, move)


def needles(rng, n):
    """Triangles of a width of 1e-12 to 1e-3 of their length, with a vertex or an edge over them at about that height."""
    thin = _powers(rng, n, -12, -3)[:, None]
    start = rng.uniform(-1, 1, (n, 4, 3))
    start[:, 3] = start[:, 2] + thin * rng.normal(size=(n, 3))
    along = rng.uniform(0, 1, (n, 1))
    over = (1 - along) * start[:, 1] + along * start[:, 2]
    start[:, 0] = over + thin * 10.0 ** rng.uniform(-3, 3, (n, 1)) * rng.normal(size=(n, 3))
    return _motion(rng, start, np.where(rng.random(n) < 0.5, 0.0, thin[:, 0] * _powers(rng, n, -2, 1)))


def very_far(rng, n):
    """1e5 to 1e9 m from the origin, of 1e-3 to 1e3 m, near each other and moving together, apart or not at all."""
    size = _powers(rng, n, -3, 3)[:, None, None]
    points = size * hits(rng, n)
    away = rng.normal(size=(n, 1, 3)) * _powers(rng, n, 5, 9)[:, None, None]
    journey = np.zeros((n, 8, 3))
    journey[:, 4:] = away * rng.uniform(-1, 1, (n, 1, 1)) * (rng.random((n, 1, 1)) < 0.5)
    return points + away + journey


def tiny_beside_huge(rng, n):
    """One primitive of 1e-6 to 1e-2 near another of 1 to 1e4, its vertices led away by 0 to 1e5."""
    points = hits(rng, n)
    center = _before(points, 0.0)[:, :1]
    first = np.where(rng.random((n, 1)) < 0.5, [1, 1, 0, 0], [1, 0, 0, 0])
    first = np.tile(first, (1, 2))[:, :, None]
    tiny, huge = _powers(rng, n, -6, -2)[:, None, None], _powers(rng, n, 0, 4)[:, None, None]
    points = (points - center) * np.where(first > 0, tiny, huge)
    led = rng.integers(0, 8, n)
    points[np.arange(n), led] += rng.normal(size=(n, 3)) * np.where(rng.random(n) < 0.5, 0.0, _powers(rng, n, 0, 5))[:, None]
    return points


def extreme(rng, n):
    """As large, or as small, as numbers get: 1e-320 to 1e300 (1e-44 to 1e36 once rounded to float32), all vertices or some."""
    points = np.where(rng.random((n, 1, 1)) < 0.5, hits(rng, n), ridges(rng, n))
    single = rng.random(n) < 0.5
    exponent = np.where(single, rng.uniform(-44, 36, n), rng.uniform(-320, 300, n))
    other = np.where(rng.random(n) < 0.5, exponent, rng.uniform(-44, 36, n))
    vertex = np.tile(rng.random((n, 4)) < 0.5, (1, 2))
    with np.errstate(under="ignore"):
        return points * 10.0 ** np.where(vertex, exponent[:, None], other[:, None])[:, :, None]


def _turned(rng, points):
    """Each turned its own way."""
    q, _ = np.linalg.qr(rng.normal(size=(len(points), 3, 3)))
    return points @ q.transpose(0, 2, 1)


CULLING = (ridges, needles, very_far, tiny_beside_huge, extreme)
