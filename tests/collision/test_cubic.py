"""Section 6: the cubic's coefficients and its minimum-gradient Newton, against exact arithmetic."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp

from collision import hard_queries
from pdipc.collision import cubic

NEVER = cubic.NEVER


@wp.kernel(enable_backward=False, module="unique")
def find_roots(k: wp.array(dtype=wp.vec4d), margin: wp.float64, tolerance: wp.float64, out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = cubic.first_root(k[i], margin, tolerance)


def first_roots(coefficients, margin=0.0, tolerance=1e-3):
    k = wp.array(np.asarray(coefficients), dtype=wp.vec4d, device="cpu")
    out = wp.zeros(len(k), dtype=wp.float64, device="cpu")
    wp.launch(find_roots, len(k), [k, margin, tolerance, out], device="cpu")
    return out.numpy()


def exceeds(coefficients, margin, time) -> bool:
    """Whether |A t^3 + B t^2 + C t + D| > margin on [0, time], exactly: Bernstein coefficients, halved where undecided."""
    a, b, c, d = (Fraction(float(k)) for k in coefficients)
    if d < 0:
        a, b, c, d = -a, -b, -c, -d
    t = Fraction(float(time))
    d -= Fraction(float(margin))
    a, b, c = a * t**3, b * t**2, c * t
    pieces = [(d, d + c / 3, d + 2 * c / 3 + b / 3, a + b + c + d)]
    for _ in range(4000):
        if not pieces:
            return True
        p = pieces.pop()
        if min(p) > 0:
            continue
        if p[0] <= 0 or p[3] <= 0:
            return False
        q = [(p[i] + p[i + 1]) / 2 for i in range(3)]
        r = [(q[0] + q[1]) / 2, (q[1] + q[2]) / 2]
        s = (r[0] + r[1]) / 2
        pieces += [(s, r[1], q[2], p[3]), (p[0], q[0], r[0], s)]
    return False


def from_roots(*roots, scale=1.0):
    """Coefficients A, B, C, D of scale * prod (t - root), for one to three roots."""
    return [0.0] * (3 - len(roots)) + list(scale * np.poly(roots))


CASES = {
    "A > 0, root in interval II": (from_roots(-1, 0.5, 2), 0.5),
    "A > 0, minimum above zero": ([1, -1, 0, 1], None),
    "A > 0, minimum before the start": ([1, 1, 1, 1], None),
    "A > 0, minimum after the end": (from_roots(0.75, 3, -1), 0.75),
    "A < 0, root in interval I": (from_roots(0.25, 0.5, 2, scale=-1.0), 0.25),
    "A < 0, interval III after I without a root": ([-8, 10, -3.25, 0.4], None),
    "A < 0, interval III": (from_roots(0.875, -1, -2, scale=-1.0), 0.875),
    "A < 0, monotone (B^2 < 3AC)": ([-1, 0, -1, 1], 0.6823278),
    "A > 0, monotone": ([1, 0, 1, 1], None),
    "A = 0, two roots": (from_roots(0.25, 0.75), 0.25),
    "A = 0, touches": (from_roots(0.5, 0.5), 0.5),
    "A = B = 0": ([0, 0, -2, 1], 0.5),
    "A = B = C = 0": ([0, 0, 0, 1], None),
    "d(0) < 0": (from_roots(0.25, 0.5, 2), 0.25),
    "d(0) = 0": ([1, -1, 1, 0], 0.0),
    "root past the end": (from_roots(1.5, 2, 3, scale=-1.0), None),
    "triple root": (from_roots(0.5, 0.5, 0.5, scale=-1.0), 0.5),
}


@pytest.mark.parametrize("case", CASES)
def test_cases(case):
    """The three cases of Section 6, and those it leaves out: the root from below, none where there is none."""
    coefficients, root = CASES[case]
    if case == "A < 0, interval III after I without a root":
        root = max(np.roots(coefficients).real)
        assert np.isreal(np.roots(coefficients)).sum() == 1 and root < 1
    (t,) = first_roots([coefficients], tolerance=1e-6)
    if root is None:
        assert t == NEVER
    else:
        assert exceeds(coefficients, 0, t) or t == 0
        # a fixed slope is slow where the root is multiple
        off = {"A = 0, touches": 0.05, "triple root": 0.15}.get(case, 1e-3)
        assert root - off <= t <= root


def first_real_root(coefficients) -> float:
    roots = np.roots(coefficients)
    real = roots.real[np.abs(roots.imag) < 1e-9]
    return min(real[(real >= 0) & (real <= 1)], default=NEVER)


def test_never_past_the_root():
    """Random and near-degenerate cubics: the answer is proven by exact arithmetic, and most roots are met closely."""
    rng = np.random.default_rng(0)
    n = 400
    roots = rng.uniform(-0.5, 1.5, (n, 3))
    roots[: n // 4, 1] = roots[: n // 4, 0] + 10.0 ** rng.uniform(-12, -2, n // 4)  # nearly double
    cubics = np.array([from_roots(*r) for r in roots]) * rng.choice([-1, 1], (n, 1))
    cubics[n // 2 : 3 * n // 4] = rng.normal(size=(n // 4, 4)) * 10.0 ** rng.uniform(-9, 0, (n // 4, 4))
    for least in (0.0, 1e-4):
        times = first_roots(cubics, margin=least)
        for k, t in zip(cubics, times, strict=True):
            assert t == 0 or exceeds(k, least, min(t, 1.0)), (k, t)
        if least:
            continue
        first = np.array([first_real_root(k.astype(float)) for k in cubics])
        assert (times <= first + 1e-6).all()
        assert np.median((first - times)[(first <= 1) & (times > 0)]) < 0.01


def exact_coefficients(u0, v0, w0, u1, v1, w1):
    def cross(a, b):
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def volume(a, b, c):
        return sum(x * y for x, y in zip(cross(a, b), c, strict=True))

    du, dv, dw = ([y - x for x, y in zip(a, b, strict=True)] for a, b in ((u0, u1), (v0, v1), (w0, w1)))
    return [
        volume(du, dv, dw),
        volume(du, dv, w0) + volume(du, v0, dw) + volume(u0, dv, dw),
        volume(du, v0, w0) + volume(u0, dv, w0) + volume(u0, v0, dw),
        volume(u0, v0, w0),
    ]


@wp.kernel(enable_backward=False, module="unique")
def find_coefficients(
    x: wp.array(dtype=wp.vec3d, ndim=2), k_out: wp.array(dtype=wp.vec4d), error_out: wp.array(dtype=wp.float64)
):
    i = wp.tid()
    a0 = x[i, 1] - x[i, 0]
    b0 = x[i, 2] - x[i, 0]
    c0 = x[i, 3] - x[i, 0]
    a1 = x[i, 5] - x[i, 4]
    b1 = x[i, 6] - x[i, 4]
    c1 = x[i, 7] - x[i, 4]
    size = wp.float64(0.0)
    for j in range(4):
        size = wp.max(size, wp.max(wp.max(wp.abs(x[i, j] - x[i, 0])), wp.max(wp.abs(x[i, 4 + j] - x[i, 4]))))
    k_out[i] = cubic.coefficients(b0 - a0, c0 - a0, a0, b1 - a1, c1 - a1, a1)
    error_out[i] = cubic.coefficient_error(b0 - a0, c0 - a0, a0, b1 - a1, c1 - a1, a1, size)


def test_coefficients_are_within_their_error():
    """Lemma 3, where it is hardest: small primitives far from the origin, slivers, everything in one plane."""
    underflow = Fraction(1e-300)  # such volumes are not used
    worst = 0.0
    for seed, family in enumerate(hard_queries.FAMILIES):
        points = family(np.random.default_rng(seed), 30)
        k = wp.zeros(len(points), dtype=wp.vec4d, device="cpu")
        error = wp.zeros(len(points), dtype=wp.float64, device="cpu")
        x = wp.array(points, dtype=wp.vec3d, ndim=2, device="cpu")
        wp.launch(find_coefficients, len(points), [x, k, error], device="cpu")
        for query, computed, bound in zip(points, k.numpy(), error.numpy(), strict=True):
            y = [[Fraction(float(v)) for v in row] for row in query]
            a0, b0, c0, a1, b1, c1 = ([p - q for p, q in zip(y[i], y[j], strict=True)] for i, j in
                                      ((1, 0), (2, 0), (3, 0), (5, 4), (6, 4), (7, 4)))  # fmt: skip
            minus = lambda p, q: [s - t for s, t in zip(p, q, strict=True)]  # noqa: E731
            true = exact_coefficients(minus(b0, a0), minus(c0, a0), a0, minus(b1, a1), minus(c1, a1), a1)
            off = sum(abs(Fraction(float(c)) - t) for c, t in zip(computed, true, strict=True))
            assert off <= Fraction(float(bound)) + underflow
            worst = max(worst, float(off) / float(bound) if bound else 0.0)
    assert worst > 1e-3, "the bound is so loose that this test says nothing"
