"""Seams of panels that coincide, as programs for garments write them: welded into one surface, or opened by a gap that threads can close."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pdipc.scene import sewing
from pdipc.scene.errors import SceneError

ROUNDS = 40  # of opening


def weld(points: np.ndarray, triangles: np.ndarray, within: float, where: str) -> tuple[np.ndarray, np.ndarray]:
    """For each of the points (n, 3) the number of the one that it becomes, (n,), and the triangles (m, 3) with those.

    Vertices of rims that are no further apart than `within`, m, and share no triangle become one. Numbers stay in order of first vertices.
    Raises SceneError where that would fold a triangle up.
    """
    rim = sewing.rim_vertices(triangles)
    pairs = cKDTree(points[rim]).query_pairs(within, output_type="ndarray")
    pairs = rim[pairs.reshape(-1, 2)]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    size = np.int64(len(points))
    together = np.isin(np.sort(pairs, axis=1) @ [size, 1], sides.astype(np.int64) @ [size, 1])
    pairs = pairs[~together]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    _, group = connected_components(graph, directed=False)
    _, first = np.unique(group, return_index=True)
    order = np.argsort(first)
    number = np.empty(len(first), dtype=np.int64)
    number[order] = np.arange(len(first))
    number = number[group]
    welded = number[triangles].astype(np.int32)
    folded = np.flatnonzero((welded == welded[:, [1, 2, 0]]).any(axis=1))
    if len(folded):
        short = np.linalg.norm(points[sides[:, 0]] - points[sides[:, 1]], axis=1).min()
        raise SceneError(
            f"{where}: {within:g} m would fold {len(folded)} triangles up, first triangles[{folded[0]}]; its shortest edge is {short:.3g} m"
        )
    return number, welded


def opened(points: np.ndarray, triangles: np.ndarray, gap: float) -> np.ndarray:
    """(n, 3) m: the points with rims drawn back into their own panels where others are nearer than `gap`, until these are that far apart.

    A vertex goes towards the middle of the triangles around it, a good half of what is missing in each round, and in all by `gap` or, where that is more, half of its way there. What
    cannot be opened that way, such as a rim in the middle of another panel or rims that lie on each other and go the same way, is left for the check to find.
    """
    rim = sewing.rim_vertices(triangles)
    used, part = sewing.parts(triangles)
    of = np.full(len(points), -1)
    of[used] = part
    corner = triangles.ravel()
    count = np.bincount(corner, minlength=len(points))
    x, most = points.copy(), None
    for _ in range(ROUNDS):
        near = cKDTree(x[rim]).query_pairs(gap, output_type="ndarray").reshape(-1, 2)
        i, j = rim[near[:, 0]], rim[near[:, 1]]
        other = of[i] != of[j]
        i, j = i[other], j[other]
        if not len(i):
            break
        missing = np.zeros(len(points))
        np.maximum.at(missing, np.concatenate([i, j]), np.tile(gap - np.linalg.norm(x[i] - x[j], axis=1), 2))
        middles = np.repeat(x[triangles].mean(axis=1), 3, axis=0)
        inward = np.stack([np.bincount(corner, weights=middles[:, axis], minlength=len(points)) for axis in range(3)], axis=1)
        inward = inward / np.maximum(count, 1)[:, None] - x
        length = np.linalg.norm(inward, axis=1)
        most = np.maximum(gap, 0.5 * length) if most is None else most
        moved = missing > 0.0
        step = np.minimum(0.6 * missing[moved] + 0.05 * gap, 0.3 * length[moved])
        x[moved] += (step / np.maximum(length[moved], 1e-300))[:, None] * inward[moved]
        way = x - points
        x = points + way * np.minimum(1.0, most / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
    return x
