"""Linear motions of two primitives, judged in whole numbers, where nothing rounds. Slow, and the last word.

The search is for a direction n on which the two primitives stay apart at both ends of an interval of time. Vertices move
linearly, so then they stay apart in between. Where a pair turns, another proof holds for longer: the volume of the four vertices
over the area that two of their differences span is the distance of two planes, or lines, that hold the primitives. Both are
polynomials of time, which their Bernstein coefficients bound. An interval for which neither is found is halved. No code is
shared with what is judged.
"""

from fractions import Fraction

import numpy as np

AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1))
HALVINGS = 60  # of [0, 1], after which the question stays open


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


class Motion:
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


def _separates(n, q, bound_num, bound_den) -> bool:
    least = min(_dot(n, r) for r in q)
    return least > 0 and least * least * bound_den > bound_num * _dot(n, n)


def _planes_apart(begin, end, kind, bound_num, bound_den) -> bool:
    """Whether the planes, or lines, of the two primitives stay farther apart than sqrt(bound_num / bound_den) from begin to end."""

    def spans(q):
        a, b, c = q[:3]
        return (_minus(b, a), _minus(c, a), a) if kind == "vertex_triangle" else (_minus(a, c), _minus(b, a), a)

    (u0, v0, w0), (u1, v1, w1) = spans(begin), spans(end)
    first, last = _cross(u0, v0), _cross(u1, v1)
    middle = tuple(x + y for x, y in zip(_cross(u0, v1), _cross(u1, v0), strict=True))
    # six times the Bernstein coefficients of the volume, and of the area
    volume = (
        6 * _dot(first, w0),
        2 * (_dot(middle, w0) + _dot(first, w1)),
        2 * (_dot(last, w0) + _dot(middle, w1)),
        6 * _dot(last, w1),
    )
    if not (min(volume) > 0 or max(volume) < 0):
        return False
    area = max(36 * _dot(first, first), 9 * _dot(middle, middle), 36 * _dot(last, last))
    return min(map(abs, volume)) ** 2 * bound_den > bound_num * area


def stays_apart_exactly(points: np.ndarray, kind: str, time: float, separation: float = 0.0) -> bool | None:
    """Whether the distance of one query stays above `separation` in [0, time]; None where this is not decided."""
    motion, last = Motion(points, kind), Fraction(float(time))
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
        if _planes_apart(begin, end, kind, bound_num, bound_den):
            continue
        if k - last.denominator.bit_length() > HALVINGS:
            return None
        work += [(low + high, 2 * high, k + 1), (2 * low, low + high, k + 1)]
    return True
