"""Pairs of bodies that ignore each other until they have parted: for starts that intersect and cannot be separated."""

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from pdipc.judge import boxes
from pdipc.judge.witness import find_intersections
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.distances import closest_on_segments, closest_on_triangles, encloses, winding_numbers

PARTED = 1.2  # of their minimum separation: bodies that keep more have parted


class Quarantine:
    """The pairs of `assembly.quarantine`, and the test whether they have parted."""

    def __init__(self, assembly: Assembly):
        self.assembly, self.pairs = assembly, assembly.quarantine
        bodies = {body for pair in self.pairs for body in pair}
        self._parts = {k: _components(assembly.bodies[k]) for k in bodies}
        self._encloses = {k: encloses(assembly.positions, assembly.bodies[k].triangles) for k in bodies}

    def left(self, x: np.ndarray, quarantined: tuple[bool, ...]) -> tuple[bool, ...]:
        """Which of the pairs that were quarantined still are, at positions x (n, 3), m."""
        return tuple(was and not self.parted(x, *pair) for was, pair in zip(quarantined, self.pairs, strict=True))

    def names(self, quarantined: tuple[bool, ...]) -> tuple[tuple[str, str], ...]:
        """Of the pairs that are."""
        bodies = self.assembly.bodies
        return tuple((bodies[a].name, bodies[b].name) for is_one, (a, b) in zip(quarantined, self.pairs, strict=True) if is_one)

    def excuses(self, pairs: np.ndarray, quarantined: tuple[bool, ...]) -> np.ndarray:
        """(k,) bool: which pairs (k, 2) of triangles belong to bodies that ignore each other."""
        owner = np.sort(self.assembly.body_of_vertex[self.assembly.triangles[pairs][:, :, 0]], axis=1)
        ignoring = [pair for is_one, pair in zip(quarantined, self.pairs, strict=True) if is_one]
        return (
            np.any([np.all(owner == pair, axis=1) for pair in ignoring], axis=0)
            if ignoring
            else np.zeros(len(pairs), dtype=bool)
        )

    def parted(self, x: np.ndarray, a: int, b: int) -> bool:
        """Whether bodies a and b neither intersect, nor are too near each other, nor one in the other."""
        one, other = self.assembly.bodies[a], self.assembly.bodies[b]
        margin = PARTED * (one.half_separation + other.half_separation)
        corners = [x[body.triangles] for body in (one, other)]
        (low_a, high_a), (low_b, high_b) = ((points.min(axis=1), points.max(axis=1)) for points in corners)
        near = boxes.overlapping(low_a - margin, high_a + margin, low_b, high_b)
        if len(near):
            triangles = np.concatenate([one.triangles[np.unique(near[:, 0])], other.triangles[np.unique(near[:, 1])]])
            owner = self.assembly.body_of_vertex[triangles[find_intersections(x, triangles)][:, :, 0]]
            if (
                np.any(owner[:, 0] != owner[:, 1])
                or _nearest(x, one.triangles[near[:, 0]], other.triangles[near[:, 1]]) <= margin
            ):
                return False
        for inner, outer in ((a, b), (b, a)):
            if self._encloses[outer]:
                inside = winding_numbers(x[self._parts[inner]], x[self.assembly.bodies[outer].triangles])
                if np.any(inside > 0.5):
                    return False
        return True


def _nearest(x: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """m: the least distance of a corner and a triangle, or of two sides, of pairs of triangles (k, 3)."""
    least = np.inf
    for points, triangles in ((first, second), (second, first)):
        for corner in points.T:
            weights = closest_on_triangles(x[corner], x[triangles])
            least = min(least, np.linalg.norm(np.einsum("kc,kci->ki", weights, x[triangles]) - x[corner], axis=1).min())
    for k in range(3):
        for m in range(3):
            e, f = x[first[:, [k, k - 1]]], x[second[:, [m, m - 1]]]
            s, t = (part[:, None] for part in closest_on_segments(e, f))
            apart = (1.0 - s) * e[:, 0] + s * e[:, 1] - (1.0 - t) * f[:, 0] - t * f[:, 1]
            least = min(least, np.linalg.norm(apart, axis=1).min())
    return float(least)


def _components(body: AssembledBody) -> np.ndarray:
    """A vertex of each connected part of the surface."""
    count = body.last - body.first
    edges = (body.triangles[:, [[0, 1], [1, 2]]].reshape(-1, 2) - body.first).T
    graph = scipy.sparse.coo_matrix((np.ones(edges.shape[1]), edges), shape=(count, count))
    used = np.unique(body.triangles) - body.first
    _, label = connected_components(graph, directed=False)
    return used[np.unique(label[used], return_index=True)[1]] + body.first
