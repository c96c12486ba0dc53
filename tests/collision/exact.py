"""A judge of CCD answers that shares nothing with the code it judges: proofs in float64 with margins, else in whole numbers.

It looks for a direction n on which the two primitives stay apart at both ends of an interval of time. Vertices move
linearly, so then they stay apart in between. An interval for which no n is found is halved. `stays_apart` first lets NumPy
prove what it can, with a margin far above its rounding, then in extended precision, and gives the rest to `pdipc.judge.exact`, where nothing rounds.
"""

import functools
from fractions import Fraction

import numpy as np

from pdipc.judge.exact import Motion, nearest, stays_apart_exactly

__all__ = ["candidates", "differences", "distance_squared", "stays_apart", "stays_apart_exactly"]

LEVELS, MOST = 60, 500  # halvings, and intervals of one query, before whole numbers take over
MARGIN = 32  # roundings (of numbers above one) that a proof leaves room for


def differences(points: np.ndarray, kind: str) -> np.ndarray:
    """(n, 8, 3) -> (n, 2, k, 3): vertices of one primitive less those of the other, at the start and the end."""
    start_end = points.reshape(len(points), 2, 4, 3)
    if kind == "vertex_triangle":
        return start_end[:, :, 1:] - start_end[:, :, :1]
    pairs = start_end[:, :, None, 2:] - start_end[:, :, :2, None]  # (n, 2, a, b, 3)
    return pairs.reshape(len(points), 2, 4, 3)


def stays_apart(points: np.ndarray, kind: str, times: np.ndarray, separation: float | np.ndarray = 0.0) -> np.ndarray:
    """(n,) whether the distance is proven to stay above `separation` for all t in [0, times]."""
    separation = np.broadcast_to(np.asarray(separation, dtype=float), len(points))
    points, times = np.asarray(points, dtype=float), np.asarray(times, dtype=float)
    result = np.zeros(len(points), dtype=bool)
    doubtful = np.arange(len(points))
    for number in (np.float64, np.longdouble):
        result[doubtful] = _proven(points[doubtful], kind, times[doubtful], separation[doubtful], number)
        doubtful = doubtful[~result[doubtful]]
    for i in doubtful:
        result[i] = stays_apart_exactly(points[i], kind, times[i], separation[i]) is True
    return result


def _proven(points, kind, times, separation, number) -> np.ndarray:
    """(n,) what the rounded arithmetic of `number` proves."""
    with np.errstate(all="ignore"):
        q = differences(points.astype(number), kind)
    size, separation = np.abs(q).max(axis=(1, 2, 3)), separation.astype(number)
    open_ = np.zeros(len(q), dtype=bool)
    query, low, high = np.arange(len(q)), np.zeros(len(q), dtype=number), times.astype(number)
    for _ in range(LEVELS):
        if not len(query):
            break
        proven, hopeless = np.zeros(len(query), dtype=bool), np.zeros(len(query), dtype=bool)
        for chunk in np.array_split(np.arange(len(query)), max(1, len(query) // 20_000)):
            ends = q[query[chunk]]
            found = _separated(ends, kind, low[chunk], high[chunk], separation[query[chunk]], size[query[chunk]])
            proven[chunk], hopeless[chunk] = found
        open_[query[hopeless]] = True
        open_ |= np.bincount(query, minlength=len(q)) > MOST
        keep = ~proven & ~open_[query]
        query, low, high = query[keep], low[keep], high[keep]
        middle = (low + high) / 2
        query, low, high = np.tile(query, 2), np.concatenate([low, middle]), np.concatenate([middle, high])
    open_[query] = True
    return ~open_


def estimate(points: np.ndarray, kind: str, t: float) -> np.ndarray:
    """(n,) the distance at time t, about."""
    ends = differences(np.asarray(points, dtype=float), kind)
    q = ends[:, 0] + t * (ends[:, 1] - ends[:, 0])
    best = np.zeros(len(q))
    with np.errstate(all="ignore"):
        for n in candidates(q, kind):
            n = n / np.sqrt(np.einsum("ni,ni->n", n, n))[:, None]
            best = np.fmax(best, np.einsum("ni,nki->nk", n, q).min(axis=1))
    return best


def along_axes(points: np.ndarray, kind: str) -> np.ndarray:
    """(n,) the gap of the boxes of the two primitives along the axis where it is greatest, of the lesser of both ends, about."""
    q = differences(np.asarray(points, dtype=float), kind)
    return np.maximum(q.min(axis=(1, 2)), (-q).min(axis=(1, 2))).max(axis=1)


def _separated(q, kind, low, high, separation, size) -> tuple[np.ndarray, np.ndarray]:
    """Which intervals are proven, and which are hopeless: no direction separates at the middle by more than the margin."""
    margin = MARGIN * np.finfo(q.dtype).eps

    def at(t):
        return q[:, 0] + t[:, None, None] * (q[:, 1] - q[:, 0])

    begin, middle, end = at(low), at((low + high) / 2), at(high)
    proven, hopeless = np.zeros(len(q), dtype=bool), np.ones(len(q), dtype=bool)
    with np.errstate(all="ignore"):
        for n in candidates(middle, kind):
            length = np.sqrt(np.einsum("ni,ni->n", n, n)) * (1 + margin)
            over = separation * length + margin * np.abs(n).sum(axis=1) * size
            least = [_least(np.einsum("ni,nki->nk", n, points)) for points in (begin, middle, end)]
            valid = (length > 1e-140) & np.isfinite(length)
            proven |= valid & (np.minimum(least[0], least[2]) > over)
            hopeless &= ~(valid & (least[1] > over))
    return proven, hopeless


def _least(values: np.ndarray) -> np.ndarray:
    """(n,) of (n, k); a reduction along so short an axis takes NumPy several times as long."""
    return functools.reduce(np.minimum, values.T)


def candidates(q, kind):
    """Directions among which that of the closest points is, for (n, k, 3) differences: faces, edges, vertices."""

    def along(n):
        return n * np.where(np.einsum("ni,ni->n", n, q[:, 0]) < 0, -1.0, 1.0)[:, None]

    def across(a, b):
        e = b - a
        for _ in range(2):
            a = a - (np.einsum("ni,ni->n", a, e) / np.maximum(np.einsum("ni,ni->n", e, e), 1e-300))[:, None] * e
        return a

    if kind == "vertex_triangle":
        a, b, c = q[:, 0], q[:, 1], q[:, 2]
        edges = [(a, b), (b, c), (c, a)]
        yield along(np.cross(b - a, c - a))
    else:
        edges = [(q[:, 0], q[:, 1]), (q[:, 2], q[:, 3]), (q[:, 0], q[:, 2]), (q[:, 1], q[:, 3])]
        yield along(np.cross(q[:, 2] - q[:, 0], q[:, 1] - q[:, 0]))
    for a, b in edges:
        yield across(a, b)
    for k in range(q.shape[1]):
        yield q[:, k]


def distance_squared(points: np.ndarray, kind: str, t: float) -> Fraction:
    """The exact squared distance at time t."""
    motion, time = Motion(points, kind), Fraction(float(t))
    r, m = nearest(motion(time.numerator, time.denominator.bit_length() - 1), kind)
    return Fraction(sum(x * x for x in r), (m * time.denominator * motion.unit) ** 2)
