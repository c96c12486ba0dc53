"""Where threads go: points of a panel by name, or the nearest ones."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pdipc.scene.errors import SceneError

if TYPE_CHECKING:
    from pdipc.scene.assembly import AssembledBody


def rim_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, 2) the edges of triangles (m, 3) that have a triangle on one side only, and the third corner (k,) of that."""
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    across = triangles[:, [2, 0, 1]].reshape(-1)
    _, first, counts = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    return sides[first[counts == 1]], across[first[counts == 1]]


def rim_vertices(triangles: np.ndarray) -> np.ndarray:
    """(k,) ascending: the vertices of `rim_edges`."""
    return np.unique(rim_edges(triangles)[0]).astype(np.int32)


def parts(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of triangles (m, 3), ascending, and which connected part each belongs to."""
    used, local = np.unique(triangles, return_inverse=True)
    sides = local.reshape(-1, 3)[:, [[0, 1], [1, 2]]].reshape(-1, 2).T
    graph = coo_matrix((np.ones(sides.shape[1]), sides), shape=(len(used), len(used)))
    return used, connected_components(graph, directed=False)[1]


def named(body: "AssembledBody", points: list, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Elements (k, 4) and weights (k, 3) of points (vertex, corners, weights) of `body`. Raises SceneError for what is no point of it."""
    around: dict[int, list[np.ndarray]] = {}
    for triangle in body.triangles:
        for corner in triangle.tolist():
            around.setdefault(corner, []).append(triangle)
    elements, weights = [], []
    for vertex, corners, part in points:
        asked = [corner - body.first for corner in corners]
        if not 1 <= len(corners) <= 3 or len(part) != len(corners):
            raise SceneError(f"{where}: the point {asked}, {part} must have one to three corners and as many weights")
        if abs(sum(part) - 1.0) > 1e-6:
            raise SceneError(f"{where}: the weights {part} add up to {sum(part):g}; they must add up to 1")
        found = [t for t in around.get(corners[0], []) if set(corners) <= set(t.tolist()) and vertex not in t]
        if not found:
            raise SceneError(
                f'{where}: the vertices {asked} of "{body.name}" are no corners of one of its triangles that the sewn vertex is not '
                "a corner of itself"
            )
        by_corner = dict(zip(corners, part, strict=True))
        elements.append([vertex, *found[0]])
        weights.append([by_corner.get(corner, 0.0) for corner in found[0].tolist()])
    return np.array(elements, dtype=np.int32).reshape(-1, 4), np.array(weights, dtype=np.float64).reshape(-1, 3)


def nearest(
    positions: np.ndarray, a: "AssembledBody", b: "AssembledBody", vertices: np.ndarray, within: float, surface: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Elements (k, 4) and weights (k, 3) from each of `vertices` of a to the nearest point of b's rim, or of its surface, within m.

    Within one body a vertex is sewn to other parts of it only.
    """
    if surface:
        targets = b.triangles
    else:
        edges, across = rim_edges(b.triangles)
        targets = np.column_stack([edges, across])
    kept = targets if surface else targets[:, :2]
    if not len(targets) or not len(vertices):
        return np.zeros((0, 4), dtype=np.int32), np.zeros((0, 3))
    middles = positions[kept].mean(axis=1)
    reach = np.linalg.norm(positions[kept] - middles[:, None], axis=2).max()
    near = cKDTree(middles).query_ball_point(positions[vertices], within + reach)
    row = np.repeat(np.arange(len(vertices)), [len(each) for each in near])
    which = np.concatenate([np.asarray(each, dtype=np.int64) for each in near])
    if a.name == b.name and len(which):
        used, part = parts(a.triangles)
        of = dict(zip(used.tolist(), part.tolist(), strict=True))
        other = np.array([of[v] for v in vertices[row].tolist()]) != np.array([of[t] for t in targets[which, 0].tolist()])
        row, which = row[other], which[other]
    if not len(which):
        return np.zeros((0, 4), dtype=np.int32), np.zeros((0, 3))
    points, corners = positions[vertices[row]], positions[targets[which]]
    if surface:
        from trimesh.triangles import closest_point, points_to_barycentric

        weights = np.clip(points_to_barycentric(corners, closest_point(corners, points)), 0.0, None)
        weights /= weights.sum(axis=1, keepdims=True)
    else:
        along = corners[:, 1] - corners[:, 0]
        part = np.einsum("ij,ij->i", points - corners[:, 0], along) / np.einsum("ij,ij->i", along, along)
        part = np.clip(part, 0.0, 1.0)
        weights = np.column_stack([1.0 - part, part, np.zeros(len(part))])
    distance = np.linalg.norm(np.einsum("ek,ekd->ed", weights, corners) - points, axis=1)
    order = np.lexsort((which, distance, row))
    order = order[distance[order] <= within]
    first = order[np.unique(row[order], return_index=True)[1]]
    return np.column_stack([vertices[row[first]], targets[which[first]]]).astype(np.int32), weights[first]
