"""Judges of CCD answers that share nothing with the code they judge: proofs in float64 with margins, else in fractions.

Both look for a direction n on which the two primitives stay apart at both ends of an interval of time. Vertices move
linearly, so then they stay apart in between. An interval for which no n is found is halved. `stays_apart` first lets NumPy
prove what it can, with a margin far above its rounding, and gives the rest to whole numbers, where nothing rounds.
"""

from fractions import Fraction

import numpy as np

LEVELS = 25  # halvings before fractions take over
AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1))
MARGIN = 64 * 2.0**-53
HALVINGS = 60  # of [0, 1], after which fractions give up


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
    q = differences(points, kind)
    size = np.abs(q).max(axis=(1, 2, 3))
    open_ = np.zeros(len(q), dtype=bool)
    query, low, high = np.arange(len(q)), np.zeros(len(q)), times.copy()
    for _ in range(LEVELS):
        proven, hopeless = np.zeros(len(query), dtype=bool), np.zeros(len(query), dtype=bool)
        for chunk in np.array_split(np.arange(len(query)), max(1, len(query) // 50_000)):
            ends = q[query[chunk]]
            found = _separated(ends, kind, low[chunk], high[chunk], separation[query[chunk]], size[query[chunk]])
            proven[chunk], hopeless[chunk] = found
        open_[query[hopeless]] = True
        keep = ~proven & ~open_[query]
        query, low, high = query[keep], low[keep], high[keep]
        middle = 0.5 * (low + high)
        query, low, high = np.tile(query, 2), np.concatenate([low, middle]), np.concatenate([middle, high])
    open_[query] = True
    result = ~open_
    for i in np.flatnonzero(open_):
        result[i] = stays_apart_exactly(points[i], kind, times[i], separation[i]) is True
    return result


def _separated(q, kind, low, high, separation, size) -> tuple[np.ndarray, np.ndarray]:
    """Which intervals are proven, and which are hopeless: no direction separates at the middle by more than the margin."""

    def at(t):
        return q[:, 0] + t[:, None, None] * (q[:, 1] - q[:, 0])

    begin, middle, end = at(low), at(0.5 * (low + high)), at(high)
    proven, hopeless = np.zeros(len(q), dtype=bool), np.ones(len(q), dtype=bool)
    with np.errstate(all="ignore"):
        for n in candidates(middle, kind):
            length = np.sqrt(np.einsum("ni,ni->n", n, n)) * (1 + MARGIN)
            over = separation * length + MARGIN * np.abs(n).sum(axis=1) * size
            least = [np.einsum("ni,nki->nk", n, points).min(axis=1) for points in (begin, middle, end)]
            valid = (length > 1e-140) & np.isfinite(length)
            proven |= valid & (np.minimum(least[0], least[2]) > over)
            hopeless &= ~(valid & (least[1] > over))
    return proven, hopeless


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


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _minus(a, b):
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _nearest_on_segment(a, b):
    e = _minus(b, a)
    along, length = -_dot(a, e), _dot(e, e)
    if along <= 0:
        return a, 1
    if along >= length:
        return b, 1
    return tuple(length * x + along * y for x, y in zip(a, e, strict=True)), length


def nearest(q, kind):
    """(r, m): r / m is the shortest vector between two primitives; all are exact integers."""
    if kind == "vertex_triangle":
        a, b, c = q
        n = _cross(_minus(b, a), _minus(c, a))
        edges = ((a, b), (b, c), (c, a))
        inside = any(n) and all(_dot(n, _cross(*edge)) > 0 for edge in edges)
    else:
        a, q01, q10, q11 = q
        e1, e2 = _minus(a, q10), _minus(q01, a)
        aa, ab, bb, c, f = _dot(e1, e1), _dot(e1, e2), _dot(e2, e2), -_dot(e1, a), -_dot(e2, a)
        sine = aa * bb - ab * ab
        n = _cross(e1, e2)
        edges = ((a, q01), (q10, q11), (a, q10), (q01, q11))
        inside = 0 < ab * f - c * bb < sine and 0 < aa * f - ab * c < sine
    if inside:
        return tuple(_dot(n, a) * x for x in n), _dot(n, n)
    found = [_nearest_on_segment(*edge) for edge in edges]
    return min(found, key=lambda r: Fraction(_dot(r[0], r[0]), r[1] ** 2))


class ExactMotion:
    """The differences of one query (8, 3) as integers, at any time a / 2^k."""

    def __init__(self, points: np.ndarray, kind: str):
        x = [[Fraction(float(v)) for v in row] for row in points]
        self.unit = max(v.denominator for row in x for v in row)  # a power of two
        whole = [tuple(int(v * self.unit) for v in row) for row in x]
        picks = [(1, 0), (2, 0), (3, 0)] if kind == "vertex_triangle" else [(2, 0), (3, 0), (2, 1), (3, 1)]
        self.start, self.end = ([_minus(whole[j + shift], whole[i + shift]) for j, i in picks] for shift in (0, 4))

    def __call__(self, a: int, k: int):
        """Differences in units of 2^-k / unit."""
        b = (1 << k) - a
        return [tuple(b * x + a * y for x, y in zip(p, r, strict=True)) for p, r in zip(self.start, self.end, strict=True)]


def distance_squared(points: np.ndarray, kind: str, t: float) -> Fraction:
    """The exact squared distance at time t."""
    motion, time = ExactMotion(points, kind), Fraction(float(t))
    r, m = nearest(motion(time.numerator, time.denominator.bit_length() - 1), kind)
    return Fraction(_dot(r, r), (m * time.denominator * motion.unit) ** 2)


def _separates(n, q, bound_num, bound_den) -> bool:
    least = min(_dot(n, r) for r in q)
    return least > 0 and least * least * bound_den > bound_num * _dot(n, n)


def stays_apart_exactly(points: np.ndarray, kind: str, time: float, separation: float = 0.0) -> bool | None:
    """Whether the distance of one query stays above `separation` in [0, time]; None where this is not decided."""
    motion, last = ExactMotion(points, kind), Fraction(float(time))
    limit = Fraction(float(separation)) ** 2
    work = [(0, last.numerator, last.denominator.bit_length() - 1)]
    while work:
        low, high, k = work.pop()
        # twice the denominator, so that the middle is there too
        begin, middle, end = motion(2 * low, k + 1), motion(low + high, k + 1), motion(2 * high, k + 1)
        unit_squared = (motion.unit << (k + 1)) ** 2
        bound_num, bound_den = limit.numerator * unit_squared, limit.denominator
        found = [nearest(q, kind) for q in (middle, begin, end)]
        if any(_dot(n, n) * bound_den <= bound_num * m * m for n, m in found):
            return False
        if any(_separates(n, (*begin, *end), bound_num, bound_den) for n in (*(n for n, _ in found), *AXES)):
            continue
        if k - last.denominator.bit_length() > HALVINGS:
            return None
        work += [(low + high, 2 * high, k + 1), (2 * low, low + high, k + 1)]
    return True
