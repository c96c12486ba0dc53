"""Flat faces: triangles of a body that keeps its shape which lie in one plane and are a convex polygon together.

A floor of many triangles is one polygon. Were each of them to push by itself, as the barrier of pairs has it, a vertex above would be pushed off the
edges between them, which are not there: a ball would roll over bumps. So a face counts once: a vertex has the barrier of the nearest
triangle of a face alone, and edges and vertices *inside* of a face have none.

**Nothing is lost.** Where something comes near an inner edge or vertex, a pair that counts is as near. What comes is a segment, a triangle or a flat face. Over
its part above the face, a convex polygon, the height above the plane is linear, so it is least at a corner: a vertex above the face
(vertex-triangle), an edge above an edge of the face's border (edge-edge), or a point above a corner of the face (vertex-triangle), all of which
count. So the potential still grows without bound before anything touches. CCD knows nothing of faces, and proves every pair.

**Smooth.** The distance to a convex set has a continuous gradient, that to others has none where two places are nearest. So a plane region that is not
convex is cut into faces that are.
"""

from collections.abc import Iterator

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

FLAT = 1e-3  # of the activation distance: how far off its plane, and off convex, a face may be
MOST_CUT = 5000  # triangles of a region that is cut; where a larger one is not convex, each of its triangles counts by itself


def flat_faces(x: np.ndarray, triangles: np.ndarray, keeps_shape: np.ndarray, tolerance: float) -> np.ndarray:
    """(m,) int32: the face of each triangle (m, 3), -1 for none. x: (n, 3) m; keeps_shape: (n,) bool; tolerance: m."""
    face = np.full(len(triangles), -1, dtype=np.int32)
    neighbours = _flat_neighbours(x, triangles, keeps_shape, tolerance)
    if not len(neighbours):
        return face
    graph = scipy.sparse.coo_matrix((np.ones(len(neighbours)), neighbours.T), shape=(len(triangles), len(triangles)))
    region = connected_components(graph, directed=False)[1]
    order, pairs = np.argsort(region, kind="stable"), neighbours[np.argsort(region[neighbours[:, 0]], kind="stable")]
    ends, pair_ends = (np.searchsorted(of, np.unique(region), "right") for of in (region[order], region[pairs[:, 0]]))
    count = 0
    for members, adjacent in zip(np.split(order, ends[:-1]), np.split(pairs, pair_ends[:-1]), strict=True):
        for part in _convex_parts(x, triangles, members, adjacent, tolerance) if len(members) > 1 else ():
            face[part] = count
            count += 1
    return face


def inside(triangles: np.ndarray, face: np.ndarray, edges: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Which edges (k, 2), ends in ascending order, and which of n vertices lie inside of a face: (k,) and (n,) bool."""
    keys, owner = _sides(triangles, n)
    known, place, count = np.unique(keys, return_inverse=True, return_counts=True)
    one, other = np.full(len(known), -1), np.full(len(known), -2)
    one[place], other[place[::-1]] = face[owner], face[owner[::-1]]  # of two sides the last, and the first
    within = (one == other) & (one >= 0) & (count == 2)
    at = within[np.searchsorted(known, edges[:, 0].astype(np.int64) * n + edges[:, 1])]
    vertices = np.zeros(n, dtype=bool)
    vertices[edges[at]] = True
    vertices[edges[~at]] = False
    return at, vertices


def _sides(triangles: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(3 m,) each edge of every triangle as one number, and the triangle; without those of a rod's segments (a, b, b) that are none."""
    ends = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1).astype(np.int64)
    real = ends[:, 0] < ends[:, 1]
    return (ends[:, 0] * n + ends[:, 1])[real], np.repeat(np.arange(len(triangles)), 3)[real]


def _flat_neighbours(x: np.ndarray, triangles: np.ndarray, keeps_shape: np.ndarray, tolerance: float) -> np.ndarray:
    """(p, 2): triangles on both sides of an edge that lie in one plane, side by side."""
    own = np.flatnonzero(keeps_shape[triangles].all(axis=1) & (triangles[:, 1] != triangles[:, 2]))
    keys, owner = _sides(triangles[own], len(x))
    order = np.argsort(keys, kind="stable")
    _, first, count = np.unique(keys[order], return_index=True, return_counts=True)
    sides = order[
        first[count == 2][:, None] + [0, 1]
    ]  # places in `keys`: three times the triangle, and the corner that is opposite
    pairs = own[owner[sides]]
    corners = triangles[pairs]
    apex = x[np.take_along_axis(corners, (sides % 3)[:, :, None], axis=2)[:, :, 0]]
    a, b = (x[np.take_along_axis(corners[:, 0], (sides[:, :1] + k) % 3, axis=1)[:, 0]] for k in (1, 2))
    edge = b - a
    normals = np.cross(edge[:, None], apex - a[:, None])
    sizes = np.linalg.norm(normals, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.abs(np.einsum("pki,pki->pk", normals / sizes[:, :, None], (apex - a[:, None])[:, ::-1])).max(axis=1)
    apart = np.einsum("pi,pi->p", normals[:, 0], normals[:, 1]) < 0.0
    return pairs[(off <= tolerance) & apart & (sizes > 0.0).all(axis=1)]


def _convex_parts(
    x: np.ndarray, triangles: np.ndarray, members: np.ndarray, neighbours: np.ndarray, tolerance: float
) -> Iterator[np.ndarray]:
    """Triangles of a flat region (members) that are a convex polygon: all of them, or some at a time."""
    corners = x[triangles[members]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    points = corners.reshape(-1, 3) - corners.mean(axis=(0, 1))
    normal = normals[np.argmax(areas)] / np.linalg.norm(normals[np.argmax(areas)])
    if np.ptp(points @ normal) > 2.0 * tolerance:
        return  # each is nearly flat with the next, all of them are not
    along = np.linalg.svd(normal[None])[2][1:]
    flat = (points @ along.T).reshape(-1, 3, 2)

    def hull(points: np.ndarray, area: float) -> np.ndarray | None:
        """The corners of a convex polygon of this area; None where the points have another."""
        found = ConvexHull(points)
        return points[found.vertices] if abs(found.volume - area) <= tolerance * found.area else None

    if hull(flat.reshape(-1, 2), areas.sum()) is not None:
        yield members
        return
    if len(members) > MOST_CUT:
        return
    place = np.zeros(len(triangles), dtype=np.int64)
    place[members] = np.arange(len(members))
    label, outline, area = np.arange(len(members)), dict(enumerate(flat)), dict(enumerate(areas))
    joined = True
    while joined:
        joined = False
        for one, other in place[neighbours].tolist():
            a, b = int(label[one]), int(label[other])
            if a != b and (found := hull(np.concatenate([outline[a], outline[b]]), area[a] + area[b])) is not None:
                label[label == b] = a
                outline[a], area[a] = found, area[a] + area[b]
                joined = True
    yield from (members[label == part] for part in np.unique(label) if np.count_nonzero(label == part) > 1)
