"""Nearest points of many triangles and segments, and winding numbers, in NumPy."""

import numpy as np

ALMOST_CLOSED = 0.05  # part of a surface's edges that may be its border, for it to enclose space
PART = 1 << 21  # points times triangles that are looked at together


def closest_on_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(k, 3): barycentric weights of the point of each triangle (k, 3, 3) that is nearest to points (k, 3)."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    w = points - a
    uu, uv, vv, uw, vw = (np.einsum("ij,ij->i", p, q) for p, q in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    square = uu * vv - uv * uv
    safe = np.where(square > 0.0, square, 1.0)
    s, t = (vv * uw - uv * vw) / safe, (uu * vw - uv * uw) / safe
    best = np.column_stack([1.0 - s - t, s, t])
    inside = (square > 1e-24 * uu * vv) & (best >= 0.0).all(axis=1)
    options, lengths = [], []
    for k in range(3):
        begin, way = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        length = np.einsum("ij,ij->i", way, way)
        part = np.clip(np.einsum("ij,ij->i", points - begin, way) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
        option = np.zeros_like(best)
        option[:, k], option[:, (k + 1) % 3] = 1.0 - part, part
        options.append(option)
        lengths.append(np.linalg.norm(points - begin - part[:, None] * way, axis=1))
    on_edge = np.array(options)[np.argmin(lengths, axis=0), np.arange(len(points))] if len(points) else best
    return np.where(inside[:, None], best, on_edge)


def closest_on_segments(e: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k,), (k,): how far along segments e and f, both (k, 2, 3), their nearest points are."""
    u, v, w = e[:, 1] - e[:, 0], f[:, 1] - f[:, 0], e[:, 0] - f[:, 0]
    uu, uv, vv, uw, vw = (np.einsum("ij,ij->i", p, q) for p, q in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    square = uu * vv - uv * uv
    skew = square > 1e-24 * uu * vv
    s = np.where(skew, np.clip((uv * vw - vv * uw) / np.where(skew, square, 1.0), 0.0, 1.0), 0.0)
    t = np.clip((uv * s + vw) / np.where(vv > 0.0, vv, 1.0), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.where(uu > 0.0, uu, 1.0), 0.0, 1.0)
    return s, t


def winding_numbers(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(k,): how often the surface of triangles (m, 3, 3) goes around each of points (k, 3); see `check.winding_number`."""
    found = []
    for part in np.array_split(points, max(1, -(-len(points) * len(corners) // PART))):
        a, b, c = np.moveaxis(corners[None] - part[:, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        ab, bc, ca = (np.einsum("kmi,kmi->km", p, q) for p, q in ((a, b), (b, c), (c, a)))
        volume = np.einsum("kmi,kmi->km", a, np.cross(b, c))
        found.append(np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2.0 * np.pi))
    return np.concatenate(found)


def encloses(positions: np.ndarray, triangles: np.ndarray) -> bool:
    """Whether a surface of triangles (m, 3) encloses space: it faces outward and hardly has a border. Segments (a, b, b) do not."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(sides, axis=0, return_counts=True)
    corners = positions[triangles]
    corners = corners - corners.mean(axis=(0, 1))
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return bool(np.count_nonzero(counts == 1) <= ALMOST_CLOSED * len(counts) and volume > 0.0)
