"""Rods: the order of their segments, and the ghost points that mark how each segment is twisted.

A segment appears among the triangles as (a, b, b), a triangle without area: whatever looks at vertices and triangles, and at edges and edges,
sees rods without knowing of them. Vertices and edges meet the segments of rods as they meet triangles.
"""

import numpy as np

from pdipc.scene.errors import SceneError


def in_order(lines: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Segments (s, 2) int32, each chain of them from end to end, and their joints (j, 2) int32: two segments that follow each other.

    lines: (s, 2), in any order and direction. Chains begin where they are named first; rings are closed by a joint of their own.
    Raises SceneError for a line that is a point, or there twice, and for a vertex of more than two.
    """
    lines = np.asarray(lines, dtype=np.int64)
    points = np.flatnonzero(lines[:, 0] == lines[:, 1])
    if len(points):
        raise SceneError(f"{where}: line {points[0]} leads from vertex {lines[points[0], 0]} to itself; it needs two ends")
    _, first, counts = np.unique(np.sort(lines, axis=1), axis=0, return_index=True, return_counts=True)
    if counts.max(initial=1) > 1:
        twice = lines[first[np.argmax(counts)]].tolist()
        raise SceneError(f"{where}: the line {twice} is there {counts.max()} times; each must be there once")
    around: dict[int, list[int]] = {}
    for number, (a, b) in enumerate(lines.tolist()):
        around.setdefault(a, []).append(number)
        around.setdefault(b, []).append(number)
    for vertex, own in around.items():
        if len(own) > 2:
            found = f"vertex {vertex} joins {len(own)} lines"
            raise SceneError(f"{where}: {found}; a rod does not branch: make rods of its branches and attach them")
    ends = [vertex for vertex, own in around.items() if len(own) == 1]
    segments: list[tuple[int, int]] = []
    joints: list[tuple[int, int]] = []
    done = np.zeros(len(lines), dtype=bool)
    for start in [*ends, *around]:  # chains first: what is left are rings
        vertex, begin = start, len(segments)
        while True:
            ahead = [number for number in around[vertex] if not done[number]]
            if not ahead:
                break
            number = ahead[0]
            done[number] = True
            other = int(lines[number].sum()) - vertex
            if len(segments) > begin:
                joints.append((len(segments) - 1, len(segments)))
            segments.append((vertex, other))
            vertex = other
        if len(segments) > begin and vertex == start:
            joints.append((len(segments) - 1, begin))
    return np.array(segments, dtype=np.int32).reshape(-1, 2), np.array(joints, dtype=np.int32).reshape(-1, 2)


def lengths(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """(s,) m."""
    return np.linalg.norm(points[segments[:, 1]] - points[segments[:, 0]], axis=1)


def ghost_points(rest: np.ndarray, start: np.ndarray, segments: np.ndarray, joints: np.ndarray, radius: float) -> tuple:
    """The ghost points of segments (s, 2) at rest and at the start, (s, 3) each, m.

    rest, start: (n, 3) m. They lie across from the middle of each segment, at the radius, or at half of a mean segment where that is more: so
    that a given precision of places is one of angles. Their sides alternate, which leaves the centre of mass on the rod. What differs between rest and start is
    bending alone, as far as it can be: a ring spreads over all joints what is left.
    """
    away = max(radius, 0.5 * float(lengths(rest, segments).mean()))
    tangents = [_tangents(points, segments) for points in (rest, start)]
    side = 1.0 - 2.0 * (np.arange(len(segments)) % 2)
    at_rest = _carry(tangents[0], joints, None)
    at_start = _carry(tangents[1], joints, (tangents[0], at_rest))
    found = []
    for points, across in ((rest, at_rest), (start, at_start)):
        middle = 0.5 * (points[segments[:, 0]] + points[segments[:, 1]])
        found.append(middle + away * side[:, None] * across)
    return tuple(found)


def _tangents(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    t = points[segments[:, 1]] - points[segments[:, 0]]
    return t / np.linalg.norm(t, axis=1, keepdims=True)


def _carry(tangents: np.ndarray, joints: np.ndarray, like: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    """(s, 3): a direction across each tangent, carried along without twist; with the twist of (tangents, directions) `like`, where given."""
    across = np.zeros_like(tangents)
    follows = {int(b): int(a) for a, b in joints if b > a}
    closing = {int(a): int(b) for a, b in joints if b < a}
    first = 0
    for b, t in enumerate(tangents):
        a = follows.get(b)
        if a is None:
            first = b
            across[b] = _normal(t)
        else:
            across[b] = _next(a, b, tangents, across, like)
        if b in closing and like is not None:
            # the ring closes on its first segment, turned by an angle that all of it shares
            last = _next(b, first, tangents, across, like)
            angle = np.arctan2(np.cross(last, across[first]) @ tangents[first], last @ across[first])
            count = b - first + 1
            for k in range(1, count):
                part, own = angle * k / count, first + k
                across[own] = np.cos(part) * across[own] + np.sin(part) * np.cross(tangents[own], across[own])
    return across


def _next(a: int, b: int, tangents: np.ndarray, across: np.ndarray, like) -> np.ndarray:
    """The direction across b that a's becomes by bending alone, or as `like` does."""
    d, t = across[a], tangents[b]
    if like is not None:
        rest_tangents, rest_across = like
        frames = [_frame(rest_tangents[k], rest_across[k]) for k in (a, b)]
        turned = _frame(tangents[a], d) @ frames[0].T @ frames[1]
        return _bent(turned[:, 2], t, turned[:, 0])
    return _bent(tangents[a], t, d)


def _frame(t: np.ndarray, d: np.ndarray) -> np.ndarray:
    return np.column_stack([d, np.cross(t, d), t])


def _bent(old: np.ndarray, new: np.ndarray, d: np.ndarray) -> np.ndarray:
    """d, which is across `old`, turned by the least rotation that takes `old` to `new`; and across `new` to the last bit."""
    axis, cosine = np.cross(old, new), old @ new
    if cosine > -0.999999:
        d = d + np.cross(axis, d) + np.cross(axis, np.cross(axis, d)) / (1.0 + cosine)
    d = d - (d @ new) * new
    size = np.linalg.norm(d)
    return d / size if size > 1e-6 else _normal(new)


def _normal(t: np.ndarray) -> np.ndarray:
    """A unit vector across t."""
    if not np.isfinite(t).all():
        return np.full(3, np.nan)
    d = np.cross(t, np.eye(3)[np.argmin(np.abs(t))])
    return d / np.linalg.norm(d)
