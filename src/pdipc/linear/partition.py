"""Groups of neighbouring vertices, found from the matrix alone."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

ROUNDS = 4  # of Lloyd's algorithm


def groups(matrix: sp.csr_matrix, free: np.ndarray, size: int) -> np.ndarray:
    """Cuts the free vertices into connected groups of about `size`; returns each vertex's group, -1 where not free.

    Lloyd's algorithm on the graph of the matrix: every vertex joins the nearest seed, then each seed moves to the vertex of
    its group that is farthest from the group's border. A component without a seed becomes a group of its own.
    """
    count = matrix.shape[0]
    label = np.full(count, -1)
    vertices = np.flatnonzero(free)
    if vertices.size == 0:
        return label
    edges = sp.coo_matrix(matrix)
    inside = free[edges.row] & free[edges.col] & (edges.row != edges.col)
    edges = np.stack([edges.row[inside], edges.col[inside]])
    seeds = np.random.default_rng(0).choice(vertices, max(1, vertices.size // size), replace=False)
    for again in range(ROUNDS + 1):
        label = _spread(count, edges, seeds, np.arange(len(seeds)))
        if again < ROUNDS:
            seeds = _centres(count, edges, label, len(seeds))
    lost = np.flatnonzero(free & (label < 0))
    if lost.size:
        graph = sp.csr_matrix((np.ones(edges.shape[1]), tuple(edges)), shape=(count, count))
        component = csgraph.connected_components(graph, directed=False)[1][lost]
        label[lost] = len(seeds) + np.unique(component, return_inverse=True)[1]
    label[vertices] = np.unique(label[vertices], return_inverse=True)[1]
    return label


def _spread(count: int, edges: np.ndarray, starts: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Breadth-first search from all starts at once: the label of the nearest start, -1 where none can be reached."""
    label = np.full(count, -1)
    label[starts] = labels
    while True:
        cross = (label[edges[0]] >= 0) & (label[edges[1]] < 0)
        if not cross.any():
            return label
        label[edges[1][cross]] = label[edges[0][cross]]


def _centres(count: int, edges: np.ndarray, label: np.ndarray, groups: int) -> np.ndarray:
    """The vertex farthest from the border of each group."""
    depth = np.full(count, -1)
    same = label[edges[0]] == label[edges[1]]
    depth[edges[0][~same]] = 0
    inner, level = edges[:, same], 0
    while True:
        cross = (depth[inner[0]] == level) & (depth[inner[1]] < 0)
        if not cross.any():
            break
        level += 1
        depth[inner[1][cross]] = level
    reached = np.flatnonzero(label >= 0)
    order = reached[np.lexsort((depth[reached], label[reached]))]
    last = np.append(np.flatnonzero(np.diff(label[order])), len(order) - 1)
    return order[last]


def neighbourhoods(matrix: sp.csr_matrix, label: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The vertices of each group and of the `depth` rings of neighbours around it.

    Returns starts (groups + 1,), vertices in the order group, ring, index, and the ring of each (0 for the group itself).
    """
    count, total = matrix.shape[0], int(label.max(initial=-1)) + 1
    inside = np.flatnonzero(label >= 0)
    ring = np.sort(label[inside].astype(np.int64) * count + inside)
    keys, rings = [ring], [np.zeros(len(ring), dtype=np.int64)]
    known = ring
    for k in range(1, depth + 1):
        owner, vertex = np.divmod(ring, count)
        lengths = np.diff(matrix.indptr)[vertex]
        first = np.repeat(matrix.indptr[vertex] - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
        reached = matrix.indices[first + np.arange(lengths.sum())]
        ring = np.setdiff1d(np.repeat(owner, lengths) * count + reached, known)
        known = np.union1d(known, ring)
        keys.append(ring)
        rings.append(np.full(len(ring), k))
    key, level = np.concatenate(keys), np.concatenate(rings)
    owner, vertex = np.divmod(key, count)
    order = np.lexsort((vertex, level, owner))
    starts = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=total))])
    return starts, vertex[order], level[order]
