"""Section 6: the cubic of coplanarity and its minimum-gradient Newton, completed and with its rounding bounded.

The four vertices of a pair are coplanar where the volume d(t) = (u(t) x v(t)) . w(t) = A t^3 + B t^2 + C t + D (Eq. 15) is
zero; u and v span the triangle, or are the two edges, and w goes from one primitive to the other. Before the first root,
less a margin, nothing has met.

This differs from Section 6 in:
1. The sign is turned so that d(0) > 0, and where |d(0)| is within the margin the answer is 0: with "inside tests" at
   computed roots, as printed, every pair that starts coplanar (all pairs of a flat cloth) is lost.
2. The extrema are clipped to [0, 1], and every piece in between is looked at in order: interval III follows when I has no
   root, B^2 <= 3AC has no extrema, and A = 0 needs no special case.
3. No inside test: what is returned is a lower bound of the time of impact, not the time itself.
4. The margin may hold a separation g: while |d| > g |u x v|, the two planes (lines) are farther apart than g.

**Lemma 1 (from below).** On a piece [l, r] with m = min d' < 0, d(tau) >= d(t) + m (tau - t) for t <= tau in it. So t - d(t)/m
is not past the first root, wherever in the piece t is. d' is a parabola, so m is its value at l, at r, or, where that is
inside and A > 0, at the inflection -B / (3A), where it is C - B^2 / (3A).

**Lemma 2 (pieces).** The computed extrema are the exact ones of a cubic with A, B, C off by 8u relative: the quadratic formula
that avoids cancellation is backward stable, for both roots together. On [0, 1] that cubic differs from d by 8u (|A| + |B| +
|C|), and between its extrema it is monotone: positive at both ends is positive in between. With S = |A| + |B| + |C| + |D|,
evaluating d adds 6u S and rounding of t less than 4u S. EVALUATION = 32u S is taken off.

**Lemma 3 (coefficients).** Let the components of all vertex differences be at most Q and off by 2u Q, and U, V, W the lengths
of u, v, w at the start plus those of their changes, plus 128u Q so that they hold for the exact vectors too. Differences of
differences are off by at most 32u Q a component for u(t) and v(t), 10u Q for w(t): d moves by 56u Q (U + V) W + 18u Q U V;
products and sums add 8u U V W <= 42u Q U V, and an area in the margin 20u Q (U + V) W. COEFFICIENTS = 128u Q (U V + (U + V) W)
is taken off. Underflow is far below the rounding of the smallest d(0) that is used.
"""

import warp as wp

from pdipc.device.language import func

wide = wp.float64

EVALUATION = 32.0 * 2.0**-53
COEFFICIENTS = 128.0 * 2.0**-53
SMALLEST = 1.0e-280  # below, products lose digits
MAX_ITERATIONS = 16
NEVER = 2.0


@func
def coefficients(u0: wp.vec3d, v0: wp.vec3d, w0: wp.vec3d, u1: wp.vec3d, v1: wp.vec3d, w1: wp.vec3d):
    """(A, B, C, D) of the volume (u x v) . w as u, v, w move linearly from 0 to 1."""
    du = u1 - u0
    dv = v1 - v0
    dw = w1 - w0
    start = wp.cross(u0, v0)
    middle = wp.cross(du, v0) + wp.cross(u0, dv)
    end = wp.cross(du, dv)
    return wp.vec4d(
        wp.dot(end, dw),
        wp.dot(end, w0) + wp.dot(middle, dw),
        wp.dot(middle, w0) + wp.dot(start, dw),
        wp.dot(start, w0),
    )


@func
def coefficient_error(u0: wp.vec3d, v0: wp.vec3d, w0: wp.vec3d, u1: wp.vec3d, v1: wp.vec3d, w1: wp.vec3d, size: wide):
    """How far d(t) with the computed coefficients may be from the true one on [0, 1]; size: the Q of the lemma."""
    off = wide(COEFFICIENTS) * size
    big_u = wp.length(u0) + wp.length(u1 - u0) + off
    big_v = wp.length(v0) + wp.length(v1 - v0) + off
    big_w = wp.length(w0) + wp.length(w1 - w0) + off
    return off * (big_u * big_v + (big_u + big_v) * big_w)


@func
def largest_area(u0: wp.vec3d, v0: wp.vec3d, u1: wp.vec3d, v1: wp.vec3d):
    """A bound of |u(t) x v(t)| on [0, 1]: the largest control point of this quadratic curve."""
    middle = wide(0.5) * (wp.cross(u0, v1) + wp.cross(u1, v0))
    return wp.max(wp.max(wp.length(wp.cross(u0, v0)), wp.length(wp.cross(u1, v1))), wp.length(middle))


@func
def value(k: wp.vec4d, t: wide):
    return ((k[0] * t + k[1]) * t + k[2]) * t + k[3]


@func
def slope(k: wp.vec4d, t: wide):
    return (wide(3.0) * k[0] * t + wide(2.0) * k[1]) * t + k[2]


@func
def first_root(k: wp.vec4d, margin: wide, tolerance: wide):
    """Time up to which |A t^3 + B t^2 + C t + D| stays above `margin`, from below, or 2 where it does on all of [0, 1].

    Ends where the value has come down to `tolerance` times the value at the start.
    """
    zero, one, three = wide(0.0), wide(1.0), wide(3.0)
    k = wp.where(k[3] < zero, -k, k)
    rounding = wide(EVALUATION) * (wp.abs(k[0]) + wp.abs(k[1]) + wp.abs(k[2]) + wp.abs(k[3]))
    k[3] = k[3] - margin - rounding
    if not k[3] > wide(SMALLEST):
        return zero
    enough = tolerance * k[3]
    # the extrema, where there are any inside
    low = one
    high = one
    discriminant = k[1] * k[1] - three * k[0] * k[2]
    if discriminant > zero:
        root = wp.sqrt(discriminant)
        q = -(k[1] + wp.where(k[1] < zero, -root, root))
        r1 = wp.clamp(q / (three * k[0]), zero, one)
        r2 = wp.clamp(k[2] / q, zero, one)
        low = wp.min(r1, r2)
        high = wp.max(r1, r2)
    begin = zero
    for piece in range(3):
        end = one
        if piece == 0:
            end = low
        if piece == 1:
            end = high
        if end > begin and not value(k, end) > zero:
            steepest = wp.min(slope(k, begin), slope(k, end))
            if k[0] > zero:
                inflection = -k[1] / (three * k[0])
                if inflection > begin and inflection < end:
                    steepest = wp.min(steepest, k[2] + k[1] * inflection)
            steepest = steepest - rounding
            t = begin
            for _iteration in range(wp.static(MAX_ITERATIONS)):
                d = value(k, t)
                if d <= enough:
                    return t
                t = wp.min(t - d / steepest, end)
            return t
        begin = wp.max(begin, end)
    return wide(NEVER)
