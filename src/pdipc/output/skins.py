"""What is drawn of a body: the surface of solids, cloth and obstacles as it is, and tubes around the segments of rods."""

from dataclasses import dataclass

import numpy as np

SIDES = 10  # of a tube


@dataclass
class Skin:
    """A surface that moves with the vertices of a run. sources: (k,) the vertex that each point belongs to; triangles: (m, 3) of points."""

    sources: np.ndarray
    triangles: np.ndarray

    def points(self, positions: np.ndarray) -> np.ndarray:
        """(k, 3) m, for positions (n, 3) of all vertices."""
        return positions[self.sources]


def skin(triangles: np.ndarray, radius: float = 0.0) -> Skin:
    """The skin of a body with the given triangles (m, 3), those of a rod (a, b, b) with its radius, m."""
    if radius > 0.0 and len(triangles):
        return _tube(triangles[:, :2], radius)
    sources, local = np.unique(triangles, return_inverse=True)
    return Skin(sources, local.reshape(-1, 3).astype(np.int32))


@dataclass
class Tube(Skin):
    """A tube around each chain of segments, closed at its ends. chains: vertices of each, and whether it is a ring; radius: m."""

    chains: list[tuple[np.ndarray, bool]]
    radius: float

    def points(self, positions: np.ndarray) -> np.ndarray:
        """(k, 3) m: circles around the vertices, without twist from one to the next; then the middles of the two ends."""
        found = []
        angle = 2 * np.pi * np.arange(SIDES) / SIDES
        circle = self.radius * np.stack([np.cos(angle), np.sin(angle)])
        for vertices, ring in self.chains:
            x = positions[vertices]
            step = np.diff(np.concatenate([x[-1:], x, x[:1]]) if ring else np.concatenate([x[:1], x, x[-1:]]), axis=0)
            size = np.linalg.norm(step, axis=1, keepdims=True)
            step = step / np.where(size > 0.0, size, 1.0)
            t = step[:-1] + step[1:]
            t /= np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-30)
            d = np.zeros_like(x)
            last = np.eye(3)[np.argmin(np.abs(t[0]))]
            for k in range(len(x)):
                last = last - (last @ t[k]) * t[k]
                d[k] = last = last / max(np.linalg.norm(last), 1e-30)
            found.append((x[:, None] + np.einsum("as,kai->ksi", circle, np.stack([d, np.cross(t, d)], axis=1))).reshape(-1, 3))
            if not ring:
                found.append(x[[0, -1]])
        return np.concatenate(found)


def _tube(segments: np.ndarray, radius: float) -> Tube:
    chains: list[list[int]] = []
    for a, b in segments.tolist():  # in order: see `pdipc.scene.rods`
        if chains and chains[-1][-1] == a and (len(chains[-1]) < 3 or chains[-1][0] != a):
            chains[-1].append(b)
        else:
            chains.append([a, b])
    made: list[tuple[np.ndarray, bool]] = []
    sources, triangles, first = [], [], 0
    side = np.arange(SIDES)
    after = (side + 1) % SIDES
    for chain in chains:
        ring = len(chain) > 3 and chain[0] == chain[-1]
        vertices = np.array(chain[:-1] if ring else chain)
        n = len(vertices)
        made.append((vertices, ring))
        lows = first + SIDES * np.arange(n if ring else n - 1)[:, None]
        highs = first + SIDES * ((np.arange(n if ring else n - 1) + 1) % n)[:, None]
        triangles.append(np.stack([lows + side, lows + after, highs + after], axis=-1).reshape(-1, 3))
        triangles.append(np.stack([lows + side, highs + after, highs + side], axis=-1).reshape(-1, 3))
        sources.append(np.repeat(vertices, SIDES))
        first += SIDES * n
        if not ring:
            end = first - SIDES
            triangles.append(np.column_stack([np.full(SIDES, first), first - SIDES * n + after, first - SIDES * n + side]))
            triangles.append(np.column_stack([np.full(SIDES, first + 1), end + side, end + after]))
            sources.append(vertices[[0, -1]])
            first += 2
    return Tube(np.concatenate(sources), np.concatenate(triangles).astype(np.int32), made, radius)
