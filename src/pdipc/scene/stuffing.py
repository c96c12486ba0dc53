"""Tets that fill a level set: isosurface stuffing (Labelle and Shewchuk 2007, "Isosurface stuffing: fast tetrahedral meshes with good
dihedral angles").

A body-centred cubic lattice covers the set; its points near the surface move onto it; the tets that the surface still crosses are cut
there. Faces with four corners are cut from their vertex of smallest number, as `cells` does, not by the paper's parity rule.
"""

from collections.abc import Callable

import numpy as np

from pdipc.scene.cells import tetrahedra
from pdipc.scene.meshes import Mesh, boundary, tet_volumes

LONG, SHORT = 0.24999, 0.41189  # the paper's: how near to a crossing, in parts of an edge, a lattice point moves onto it
HALVINGS = 12  # of the interval in which an edge crosses the surface
LevelSet = Callable[[np.ndarray], np.ndarray]


def stuffed(level: LevelSet, low: np.ndarray, high: np.ndarray, cell: float) -> Mesh:
    """Tets, and their surface, of where `level` is negative within the box from `low` to `high`; the largest piece of it.

    level: (n, 3) m -> (n,), continuous. cell: side of the lattice's cubes, m; what is thinner than that may be lost. Raises ValueError
    where nothing is inside.
    """
    counts = np.ceil((np.asarray(high) - low) / cell).astype(int) + 2  # a layer more than the box needs, on each side
    points = 0.5 * (np.asarray(low) + high) + cell * (_lattice(counts) - 0.5 * counts)
    value = level(points)
    tets = _lattice_tets(counts, value < 0)
    edges = np.unique(np.sort(tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1), axis=0)
    edges = edges[value[edges[:, 0]] * value[edges[:, 1]] < 0]
    at = _crossings(level, points, value, edges)  # part of the way from the edge's first to its second point
    points, value, kept = _snapped(points, value, edges, at, cell)
    edges, at = edges[kept], at[kept]
    cuts = points[edges[:, 0]] + at[:, None] * (points[edges[:, 1]] - points[edges[:, 0]])
    whole = np.concatenate([points, cuts])
    tets = _cut(whole, np.sign(value), tets, edges)
    if not len(tets):
        raise ValueError("nothing is inside the surface, or all of it is thinner than a cell")
    while len(pinched := _pinched(tets)):
        tets = tets[~pinched]
    return Mesh.of_tets(whole, _largest_piece(tets))


def _lattice(counts: np.ndarray) -> np.ndarray:
    """(n, 3): the corners of (counts) unit cubes, then their centres."""
    corners, cubes = (np.indices(tuple(each)).reshape(3, -1).T for each in (counts + 1, counts))
    return np.concatenate([corners, cubes + 0.5])


def _lattice_tets(counts: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(t, 4): the lattice's tets with a corner inside: between each two cubes that share a face, four around the line of their
    centres.
    """
    cubes = np.indices(tuple(counts)).reshape(3, -1).T
    steps = np.array([(counts[1] + 1) * (counts[2] + 1), counts[2] + 1, 1])
    strides = np.array([counts[1] * counts[2], counts[2], 1])
    tets = []
    for axis in range(3):
        first = cubes[cubes[:, axis] < counts[axis] - 1]
        b, c = (axis + 1) % 3, (axis + 2) % 3
        centre = np.prod(counts + 1) + first @ strides
        square = first @ steps + steps[axis]  # the face between the two cubes
        ring = [square, square + steps[b], square + steps[b] + steps[c], square + steps[c]]
        for k in range(4):
            own = np.column_stack([centre, ring[(k + 1) % 4], ring[k], centre + strides[axis]])
            tets.append(own[inside[own].any(axis=1)])
    return np.concatenate(tets)


def _crossings(level: LevelSet, points: np.ndarray, value: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(e,): where along each edge the level set is crossed, by bisection."""
    start, way = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    low, high, inside = np.zeros(len(edges)), np.ones(len(edges)), value[edges[:, 0]] < 0
    for _ in range(HALVINGS if len(edges) else 0):
        middle = 0.5 * (low + high)
        same = (level(start + middle[:, None] * way) < 0) == inside
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def _snapped(
    points: np.ndarray, value: np.ndarray, edges: np.ndarray, at: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The lattice with every point that is too near to a crossing moved onto its nearest one, its value there 0; and the numbers of
    the edges that are still crossed.
    """
    points, value = points.copy(), value.copy()
    length = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    near = np.where(length > 0.95 * cell, LONG, SHORT)
    ends = np.concatenate([edges[:, 0], edges[:, 1]])
    part = np.concatenate([at, 1.0 - at])
    place = np.tile(points[edges[:, 0]] + at[:, None] * (points[edges[:, 1]] - points[edges[:, 0]]), (2, 1))
    close = np.flatnonzero(part < np.tile(near, 2))
    close = close[np.argsort((part * np.tile(length, 2))[close], kind="stable")]
    moved, first = np.unique(ends[close], return_index=True)
    points[moved], value[moved] = place[close[first]], 0.0
    return points, value, np.flatnonzero(~np.isin(edges, moved).any(axis=1))


def _cut(points: np.ndarray, sign: np.ndarray, tets: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(t, 4): the parts of the tets that are inside. The cut of edge k is vertex len(sign) + k.

    A tet's corners are taken in the order inside, on the surface, outside; all parts are turned to positive volume at the end, which a
    tet whose corners moved by less than the limits above keeps.
    """
    key = edges[:, 0] * len(sign) + edges[:, 1]

    def cut(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return len(sign) + np.searchsorted(key, np.minimum(a, b) * len(sign) + np.maximum(a, b))

    order = np.argsort(sign[tets], axis=1, kind="stable")
    corners = np.take_along_axis(tets, order, axis=1)
    inside, outside = ((sign[corners] == s).sum(axis=1) for s in (-1, 1))
    parts = [corners[(inside > 0) & (outside == 0)]]
    for n_in, n_out in ((1, 1), (1, 2), (1, 3), (2, 1), (2, 2), (3, 1)):
        chosen = (inside == n_in) & (outside == n_out)
        a, b, c, d = corners[chosen].T
        match n_in, n_out:
            case 1, 1:
                kind, cells = "tetra", [a, b, c, cut(a, d)]
            case 1, 2:
                kind, cells = "tetra", [a, b, cut(a, c), cut(a, d)]
            case 1, 3:
                kind, cells = "tetra", [a, cut(a, b), cut(a, c), cut(a, d)]
            case 2, 1:
                kind, cells = "pyramid", [a, cut(a, d), cut(b, d), b, c]
            case 2, 2:
                kind, cells = "wedge", [a, cut(a, c), cut(a, d), b, cut(b, c), cut(b, d)]
            case _:
                kind, cells = "wedge", [a, b, c, cut(a, d), cut(b, d), cut(c, d)]
        parts.append(tetrahedra(kind, np.column_stack(cells).reshape(-1, len(cells))))
    whole = np.concatenate(parts)
    turned = tet_volumes(points, whole) < 0
    whole[turned] = whole[turned][:, [0, 2, 1, 3]]
    return whole


def _pinched(tets: np.ndarray) -> np.ndarray:
    """(t,) bool: tets to leave out because the surface touches itself there, in a vertex or an edge; empty where it is a manifold.

    Of the tets around such a vertex all go but those that hang together, by their faces, with the most.
    """
    surface = boundary(tets)
    corner = np.arange(surface.size).reshape(-1, 3)
    sides = np.concatenate([surface[:, [k, (k + 1) % 3]] for k in range(3)])
    ends = np.concatenate([corner[:, [k, (k + 1) % 3]] for k in range(3)])
    turned = sides[:, 0] > sides[:, 1]
    sides, ends = np.where(turned[:, None], sides[:, ::-1], sides), np.where(turned[:, None], ends[:, ::-1], ends)
    order = np.lexsort(sides.T)
    same = np.all(sides[order[1:]] == sides[order[:-1]], axis=1)
    a, b = ends[order[1:][same]], ends[order[:-1][same]]
    fan = _components(surface.size, a.ravel(), b.ravel())  # corners at one vertex that neighbouring triangles share
    fans = np.unique(np.column_stack([surface.ravel(), fan]), axis=0)[:, 0]
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    bad = np.union1d(np.flatnonzero(np.bincount(fans) > 1), edges[uses > 2])
    if not len(bad):
        return np.zeros(0, dtype=bool)
    out = np.zeros(len(tets), dtype=bool)
    for vertex in bad:
        around = np.flatnonzero((tets == vertex).any(axis=1) & ~out)
        if len(around):
            piece = _pieces(tets[around])
            out[around[piece != np.bincount(piece).argmax()]] = True
    return out if out.any() else np.asarray(np.isin(tets, bad).any(axis=1))


def _largest_piece(tets: np.ndarray) -> np.ndarray:
    piece = _pieces(tets)
    return tets[piece == np.bincount(piece).argmax()]


def _pieces(tets: np.ndarray) -> np.ndarray:
    """(t,): the number of the piece that each tet belongs to; pieces hang together by faces."""
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = np.all(faces[order[1:]] == faces[order[:-1]], axis=1)
    return _components(len(tets), order[1:][same] // 4, order[:-1][same] // 4)


def _components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)[1]
