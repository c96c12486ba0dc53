"""What culling and CCD say "cannot meet" about, pair by pair, so that an exact judge can ask whether it is so.

Each of `REJECTIONS` is f(points (n, 8, 3), kind, precision, reach (n,)) -> (n,) bool: whether the pairs are left out, which promises that
they stay farther apart than twice `reach`, all the way from the rows 0 to 3 to the rows 4 to 7. Points and reach are numbers of
that precision.
"""

import functools
from fractions import Fraction

import numpy as np
import warp as wp

from collision import exact
from pdipc.collision import broad_phase, candidates, ccd, moving_boxes, sieve, surface
from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.judge import witness

KINDS = ("vertex_triangle", "edge_edge")
PRECISIONS = ("float64", "float32")
BACKOFF = 0.2  # of CCD; with a reach of nothing it has no say in what is rejected


@functools.cache
def kernels(precision: str, kind: str):
    """(sieve, boxes, ccd): kernels that ask about a list of pairs whose vertices are in a row."""
    number = real(precision)
    module = number.module(f"{__name__}.{kind}")
    passes, Sieve = sieve.functions(number), sieve.functions(number).Sieve
    edges = kind == "edge_edge"
    time_of = getattr(ccd.functions(number), kind)
    later_of = getattr(ccd.variant(number, rejects=False), kind)
    scalar, vec3 = number.scalar, number.vec3

    @kernel(module, f"ask_sieve_{kind}")
    def ask_sieve(near: Sieve, out: wp.array(dtype=wp.int32)):
        i = wp.tid()
        k = 4 * i
        met = bool(True)
        if wp.static(edges):
            met = passes.edge_edge(near, wp.vec2i(k, k + 1), wp.vec2i(k + 2, k + 3))
        else:
            met = passes.vertex_triangle(near, k, wp.vec3i(k + 1, k + 2, k + 3))
        out[i] = wp.where(met, 0, 1)

    @kernel(module, f"ask_boxes_{kind}")
    def ask_boxes(boxes: moving_boxes.Boxes, out: wp.array(dtype=wp.int32)):
        i = wp.tid()
        k = 4 * i
        a = moving_boxes.load(boxes, k)
        b = moving_boxes.join(moving_boxes.load(boxes, k + 2), moving_boxes.load(boxes, k + 3))
        other = moving_boxes.load(boxes, k + 1)
        if wp.static(edges):
            a = moving_boxes.join(a, other)
        else:
            b = moving_boxes.join(b, other)
        out[i] = wp.where(moving_boxes.meet(a, b), 0, 1)

    def ask_ccd(name, of):
        @kernel(module, f"{name}_{kind}")
        def ask(
            begin: wp.array(dtype=vec3),
            end: wp.array(dtype=vec3),
            xi: wp.array(dtype=scalar),
            backoff: scalar,
            out: wp.array(dtype=wp.int32),
        ):
            i = wp.tid()
            k = 4 * i
            t = of(
                begin[k], begin[k + 1], begin[k + 2], begin[k + 3], end[k], end[k + 1], end[k + 2], end[k + 3],
                xi[i], backoff, scalar(0.0),
            )  # fmt: skip
            out[i] = wp.where(t > scalar(1.0), 1, 0)

        return ask

    return ask_sieve, ask_boxes, ask_ccd("ask_ccd", time_of), ask_ccd("ask_later", later_of)


def _arrays(points, precision, reach):
    number = real(precision)
    begin, end = (
        wp.array(np.ascontiguousarray(points[:, part]).reshape(-1, 3), dtype=number.vec3, device="cpu")
        for part in (slice(0, 4), slice(4, 8))
    )
    return begin, end, wp.array(np.repeat(reach, 4), dtype=number.scalar, device="cpu")


def by_sieve(points, kind, precision, reach):
    near = sieve.functions(real(precision)).Sieve()
    near.begin, near.end, near.reach = _arrays(points, precision, reach)
    return _ask(0, kind, precision, len(points), [near])


def by_boxes(points, kind, precision, reach):
    begin, end, reaches = _arrays(points, precision, reach)
    boxes = moving_boxes.boxes(len(begin), Device("cpu", 1))
    Device("cpu", 1).launch(moving_boxes.kernels(real(precision)).vertex_boxes, len(begin), [begin, end, reaches, boxes])
    return _ask(1, kind, precision, len(points), [boxes])


def by_ccd(points, kind, precision, reach, which=2):
    begin, end, _ = _arrays(points, precision, reach)
    number = real(precision)
    with np.errstate(over="ignore"):
        xi = wp.array((2 * np.asarray(reach, number.numpy)).astype(number.numpy), dtype=number.scalar, device="cpu")
    return _ask(which, kind, precision, len(points), [begin, end, xi, number.scalar(BACKOFF)])


def by_cubic_and_directions(points, kind, precision, reach):
    """CCD without its first reject."""
    return by_ccd(points, kind, precision, reach, 3)


REJECTIONS = {"sieve": by_sieve, "boxes": by_boxes, "ccd": by_ccd, "cubic and directions": by_cubic_and_directions}


def _ask(which, kind, precision, count, inputs):
    out = wp.zeros(count, dtype=wp.int32, device="cpu")
    wp.launch(kernels(precision, kind)[which], count, [*inputs, out], device="cpu")
    return out.numpy().astype(bool)


def pairs(family, kind, precision, n, rng):
    """(points, reach) of a family, in numbers of that precision: reaches of any size, and such as the pairs just keep, or miss.

    Without a pair that is not finite in this precision.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        points = family(rng, n).astype(precision).astype(float)
        points = points[np.isfinite(points).all(axis=(1, 2))]
        n = len(points)
        size = np.abs(points - points[:, :1]).max(axis=(1, 2))
        free = size * 10.0 ** rng.uniform(-18, 0.3, n)
        least = np.minimum.reduce([exact.estimate(points, kind, t) for t in (0.0, 0.5, 1.0)])
        off = rng.choice([-1, 1], n) * 10.0 ** rng.uniform(-17, -1, n)
        least = np.where(rng.random(n) < 0.4, exact.along_axes(points, kind), least)
        close = least * (1 + off) + rng.choice([0, 0, 1e-16, -1e-16, 3e-16], n) * size
        reach = 0.5 * np.where(rng.random(n) < 0.4, free, close)
        reach = np.where(np.isfinite(reach), np.maximum(reach, 0.0), 0.0).astype(precision)
    return points, reach.astype(float)


def wrong(points, kind, reach, rejected):
    """Indices of the rejected pairs that come as near as twice `reach` on their way, by exact arithmetic."""
    asked = np.flatnonzero(rejected)
    if not len(asked):
        return asked
    return asked[~exact.stays_apart(points[asked], kind, np.ones(len(asked)), 2 * reach[asked])]


# --- what counts as near enough to use a list again ---


def strays(precision, n, rng):
    """(x (n, 3), y (n, 3), margin (n,)): two places about as far apart as the margin, of any size."""
    exponent = rng.uniform(*((-120, 120) if precision == "float64" else (-40, 30)), (n, 1))
    y = rng.normal(size=(n, 3)) * 10.0**exponent
    margin = np.abs(y).max(axis=1) * 10.0 ** rng.uniform(-9, 3, n)
    off = rng.normal(size=(n, 3)) * rng.choice([1.0, 1e-3], (n, 3))
    off *= (margin / np.linalg.norm(off, axis=1) * (1 + rng.normal(size=n) * 10.0 ** rng.uniform(-17, -5, n)))[:, None]
    return ((values.astype(precision)).astype(float) for values in (y + off, y, margin))


@functools.cache
def near_kernel(precision: str):
    number = real(precision)
    near = candidates.kernels(number).near
    scalar, vec3 = number.scalar, number.vec3

    @kernel(number.module(f"{__name__}.near"), "ask_near")
    def ask_near(
        x: wp.array(dtype=vec3), y: wp.array(dtype=vec3), margin: wp.array(dtype=scalar), out: wp.array(dtype=wp.int32)
    ):
        i = wp.tid()
        out[i] = wp.where(near(x[i], y[i], margin[i]), 1, 0)

    return ask_near


def is_near(x, y, margin, precision):
    """(n,) bool: whether each x counts as near its y, which promises that it is within (1 + ROUNDING / 10) of the margin."""
    number = real(precision)
    places = [wp.array(v, dtype=number.vec3, device="cpu") for v in (x, y)]
    out = wp.zeros(len(x), dtype=wp.int32, device="cpu")
    wp.launch(near_kernel(precision), len(x), [*places, wp.array(margin, dtype=number.scalar, device="cpu"), out], device="cpu")
    return out.numpy().astype(bool)


def not_near(x, y, margin, near):
    """Indices of those that count as near and are not, exactly."""
    asked = np.flatnonzero(near)
    difference = x[asked].astype(np.longdouble) - y[asked].astype(np.longdouble)
    far = (difference * difference).sum(axis=1)
    limit = (margin[asked].astype(np.longdouble) * (1 + np.longdouble(candidates.ROUNDING) / 10)) ** 2
    size = (np.abs(x[asked]) + np.abs(y[asked])).max(axis=1).astype(np.longdouble)
    doubtful = (
        far + 64 * np.finfo(np.longdouble).eps * (far + limit + size * np.sqrt(far)) >= limit
    )  # with room for all that rounds
    return np.array([i for i in asked[doubtful] if not _near_exactly(x[i], y[i], margin[i])], dtype=int)


def _near_exactly(x, y, margin) -> bool:
    far = sum((Fraction(a) - Fraction(b)) ** 2 for a, b in zip(x, y, strict=True))
    return far <= (Fraction(margin) * (1 + Fraction(candidates.ROUNDING) / 10)) ** 2


# --- whole lists: trees, patches, boxes and the sieve together ---


def soup(family, precision, rng, count=10):
    """(x0, x1, triangles, reach): loose triangles, of which each two hold a query of the family, and one reach, near its gaps."""
    n = 2 * count
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        points = family(rng, n).astype(precision).astype(float)
        points = points[np.isfinite(points).all(axis=(1, 2))][:count]
        n = len(points)
        # three more vertices: a vertex gets a triangle that it is a corner of, or each edge one
        weights = rng.dirichlet(np.ones(4), (n, 3))
        more = np.concatenate([weights @ points[:, :4], weights @ points[:, 4:]], axis=1)
        more = (more * rng.uniform(0.5, 1.5, more.shape)).astype(precision).astype(float)
        more = np.where(np.isfinite(more), more, 0.0)
        x0, x1 = (
            np.concatenate([points[:, part], more[:, own]], axis=1)
            for part, own in ((slice(4), slice(3)), (slice(4, 8), slice(3, 6)))
        )
        edges = np.array([[0, 1, 4], [2, 3, 5]])
        face = np.array([[1, 2, 3], [0, 4, 5]])
        corners = np.where(rng.random((n, 1, 1)) < 0.5, edges, face) + 7 * np.arange(n)[:, None, None]
        kinds = rng.choice(KINDS)
        reach = rng.choice(0.5 * exact.estimate(points, kinds, 0.5)) * rng.choice([1.0, 1.5, 1e-3]) if n else 0.0
        reach = float(np.asarray(reach if np.isfinite(reach) else 0.0).astype(precision))
    return x0.reshape(-1, 3), x1.reshape(-1, 3), corners.reshape(-1, 3).astype(np.int32), reach


def lists(x0, x1, triangles, reach, precision, method):
    """(surface, vertex-triangle pairs (k, 2), edge-edge pairs) that culling lists, in its own numbering of primitives."""
    device, number = Device("cpu", 1), real(precision)
    n = len(x0)
    skin = surface.build(device, triangles, x0, np.zeros(n, int), np.zeros(n, bool))
    search = broad_phase.BroadPhase(device, number, skin, method)
    begin, end = (wp.array(x, dtype=number.vec3, device="cpu") for x in (x0, x1))
    reaches = wp.array(np.full(n, reach), dtype=number.scalar, device="cpu")
    near = sieve.functions(number).Sieve()
    near.begin, near.end, near.reach = begin, end, reaches
    search.restructure(begin, reaches)
    while True:
        search.find(begin, end, reaches, near)
        if not search.grow():
            return skin, *(each.pairs.numpy()[: each.count.numpy()[0]] for each in search.lists)


def unlisted(x0, x1, triangles, reach, precision, method):
    """Of each kind: queries (k, 8, 3) of the pairs that culling does not list, and how many pairs there are."""
    skin, *listed = lists(x0, x1, triangles, reach, precision, method)
    vertices, edges, faces = skin.members
    first = [np.repeat(np.arange(len(vertices)), len(faces)), np.triu_indices(len(edges), 1)[0]]
    second = [np.tile(np.arange(len(faces)), len(vertices)), np.triu_indices(len(edges), 1)[1]]
    number = np.zeros(len(x0), dtype=int)
    number[vertices.ravel()] = np.arange(len(vertices))
    found = []
    for kind, i, j, pairs, (one, other) in zip(KINDS, first, second, listed, ((vertices, faces), (edges, edges)), strict=True):
        pairs = np.column_stack([number[pairs[:, 0]], pairs[:, 1]]) if kind == "vertex_triangle" else pairs
        left = np.ones((len(one), len(other)), dtype=bool)
        left[pairs[:, 0], pairs[:, 1]] = False
        quads = np.concatenate([one[i], other[j]], axis=1)
        split = one.shape[1]
        apart = ~(quads[:, :split, None] == quads[:, None, split:]).any(axis=(1, 2))
        out = quads[apart & left[i, j]]
        found.append((np.concatenate([x0[out], x1[out]], axis=1), int(apart.sum())))
    return found


# --- what the witness decides without whole numbers ---


def segments(family, precision, rng, n):
    """(n, 5, 3): the ends of a segment, and a triangle of the family: the segment crosses it, ends on it but for rounding, within or on its rim,
    or lies in its plane.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        points = family(rng, n)[:, :4]
        n, corners = len(points), points[:, 1:]

        def aim():
            weights = rng.dirichlet(np.ones(3), n)
            weights[rng.random((n, 3)) < 0.25] = 0.0  # the rim, and corners
            weights /= np.maximum(weights.sum(axis=1), 1e-300)[:, None]
            beyond = rng.choice([1.0, 1.0, 2.0, -1.5], n)[:, None]  # in the plane, but outside of it
            return np.einsum("nk,nki->ni", weights, corners - corners[:, :1]) * beyond + corners[:, 0]

        which = rng.random(n)[:, None]
        begin = np.where(which < 0.7, points[:, 0], aim())
        target = aim()
        end = target + np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0.0, 1.5, n))[:, None] * (target - begin)
        result = np.concatenate([begin[:, None], end[:, None], corners], axis=1).astype(precision)
        ulps = rng.choice([0, 0, 0, 1, -1], (n, 2, 3))
        result[:, :2] = np.where(ulps == 0, result[:, :2], np.nextafter(result[:, :2], (np.inf * ulps).astype(precision)))
        result = result.astype(float)
        return result[np.isfinite(result).all(axis=(1, 2)) & (np.abs(result).max(axis=(1, 2)) < 1e300)]


def crossing(points):
    """(n,) bool: what the witness says of segments and triangles (n, 5, 3)."""
    n = len(points)
    vertices, own = np.arange(5 * n).reshape(n, 5), np.column_stack([np.arange(n)] * 2)
    found = witness.edge_triangle_crossings(points.reshape(-1, 3), vertices[:, :2], vertices[:, 2:], [own])
    result = np.zeros(n, dtype=bool)
    result[found[:, 0]] = True
    return result


def wrongly_crossing(points, said):
    """Indices of the segments and triangles (n, 5, 3) of which it is not true that they meet, or do not, as `said` has it.

    Extended precision proves what it can, with a margin far above its rounding; whole numbers decide the rest.
    """
    proven = np.zeros(len(points), dtype=int)
    if np.finfo(np.longdouble).maxexp >= 1 << 14:  # where it has no more range than float64, products would overflow
        for part in np.array_split(np.arange(len(points)), max(1, len(points) // 20_000)):
            proven[part] = _meet(points[part].astype(np.longdouble))
    wrong = np.where(said, proven < 0, proven > 0)
    for i in np.flatnonzero(proven == 0):
        wrong[i] = witness.segment_meets_triangle(*points[i]) != said[i]
    return np.flatnonzero(wrong)


def _meet(points):
    """(n,) 1: the segment surely meets the triangle, -1: surely does not; 0: in doubt."""
    p, q, *corners = points.transpose(1, 0, 2)
    margin = exact.MARGIN * np.finfo(points.dtype).eps

    def side(a, b, c, d):
        u, v, w = b - a, c - a, d - a
        volume = np.einsum("ni,ni->n", w, np.cross(u, v))
        u, v, w = np.abs(u), np.abs(v), np.abs(w)
        room = margin * np.einsum("ni,ni->n", w, np.roll(u, -1, 1) * np.roll(v, 1, 1) + np.roll(u, 1, 1) * np.roll(v, -1, 1))
        return np.where(np.abs(volume) > room, np.sign(volume), 0).astype(int)

    above = [side(*corners, end) for end in (p, q)]
    around = np.array([side(p, q, corners[k], corners[k - 2]) for k in range(3)])
    through = above[0] * above[1] < 0
    meet = through & (np.abs(around.sum(axis=0)) == 3)
    apart = (above[0] * above[1] > 0) | ((around.min(axis=0) < 0) & (around.max(axis=0) > 0))
    # a direction across an edge and an axis on which all of the one is before all of the other, for what lies in a plane
    edges = [q - p, *(corners[k] - corners[k - 1] for k in range(3))]
    differences = (points[:, 2:, None] - points[:, None, :2]).reshape(-1, 6, 3)
    size = margin * np.abs(differences).max(axis=(1, 2))
    for edge in edges:
        for axis in np.eye(3, dtype=points.dtype):
            n = np.cross(edge, axis)
            along = np.einsum("ni,nki->kn", n, differences)
            room = size * np.einsum("ni->n", np.abs(n))
            apart |= (functools.reduce(np.minimum, along) > room) | (functools.reduce(np.maximum, along) < -room)
    return meet.astype(int) - apart
