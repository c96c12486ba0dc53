"""Meshes for drawing: where the surface has an edge, its vertices are doubled, so that what draws smoothly shows the edge."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def split(points: np.ndarray, triangles: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertex (k,) that each vertex drawn is a double of, and triangles (m, 3) of these.

    points: (n, 3); triangles: (m, 3) in one orientation. angle: degrees; sharper edges, and those of other than two triangles, are edges.
    """
    corners = np.arange(triangles.size).reshape(-1, 3)
    ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    at = np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)])  # the corners of these ends
    swapped = ends[:, 0] > ends[:, 1]
    ends[swapped], at[swapped] = ends[swapped][:, ::-1], at[swapped][:, ::-1]
    _, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]])[count == 2]
    a, b = order[first], order[first + 1]
    normals = np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    smooth = np.einsum("ij,ij->i", normals[a % len(triangles)], normals[b % len(triangles)]) > np.cos(np.radians(angle))
    joined = np.concatenate([np.stack([at[a[smooth], k], at[b[smooth], k]], axis=1) for k in range(2)])
    graph = coo_array((np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=(triangles.size, triangles.size))
    _, drawn = connected_components(graph, directed=False)
    _, chosen = np.unique(drawn, return_index=True)
    return triangles.ravel()[chosen], drawn.reshape(-1, 3).astype(np.int32)


def closed(triangles: np.ndarray) -> bool:
    """Whether each edge of the triangles (m, 3) belongs to two of them."""
    edges = np.sort(np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())
