"""The nearest rotation of a matrix: the hot spot of the local step.

The rotation R that minimises |F - R|_F belongs to the signed singular values s1 >= s2 >= |s3| of F (s3 < 0 where F is
inverted). With i1 = s1 + s2 + s3, i2 = s1 s2 + s2 s3 + s3 s1, i3 = det F, the Cayley-Hamilton theorem for the stretch S = R^T F
gives R without any eigenvector:

    R = (i1 cof F + (i1^2 - i2) F - F F^T F) / (i1 i2 - i3),     i2 = (i1^2 - |F|^2) / 2,

and i1 is the largest root of the quartic (i1^2 - |F|^2)^2 = 4 |cof F|^2 + 8 i1 det F, which Newton's method finds from above,
from sqrt(3) |F|, without a safeguard. The divisor is (s1 + s2) (s2 + s3) (s3 + s1): where it is nearly zero, the nearest
rotation itself is ill-determined, and an SVD takes over. One Newton-Schulz step makes R orthogonal to rounding.
"""

import warp as wp

from pdipc.device.language import func
from pdipc.device.precision import Mat33, unit_roundoff

REFINEMENTS = 2  # of the SVD's rotation
NEWTON_STEPS = 16  # at most; three or four are usual


@func
def degenerate(like: wp.float64):
    """Part of |F|^3 below which the divisor is too small; in the type of `like`."""
    return wp.float64(1.0e-4)


@func
def degenerate(like: wp.float32):  # noqa: F811
    return wp.float32(2.0e-2)


@func
def cofactor(f: Mat33):
    """cof F = det(F) F^-T: its columns are the cross products of the columns of F."""
    t = wp.transpose(f)
    return wp.matrix_from_cols(wp.cross(t[1], t[2]), wp.cross(t[2], t[0]), wp.cross(t[0], t[1]))


@func
def orthonormalized(r: Mat33):
    """R (3 I - R^T R) / 2: squares the deviation from orthogonality."""
    g = wp.transpose(r) * r
    return type(r[0][0])(1.5) * r - type(r[0][0])(0.5) * (r * g)


@func
def rotation_by_svd(f: Mat33):
    """The nearest rotation by a singular value decomposition: robust, and several times slower."""
    u, s, v = wp.svd3(f)
    r = u * wp.transpose(v)
    if wp.determinant(r) < type(s[0])(0.0):
        # turn the direction of the smallest singular value around
        small = int(2)
        if s[0] <= s[1] and s[0] <= s[2]:
            small = 0
        elif s[1] <= s[2]:
            small = 1
        for i in range(3):
            u[i, small] = -u[i, small]
        r = u * wp.transpose(v)
    return orthonormalized(orthonormalized(r))


@func
def refined(f: Mat33, rotation: Mat33):
    """Newton's method for R^T F symmetric, from a rotation near that: Warp's SVD in float32 is good to 1e-3 only."""
    r = rotation
    for _ in range(REFINEMENTS):
        s = wp.transpose(r) * f
        asymmetry = type(f[0])(s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1])
        h = type(f[0][0])(-0.5) * (s + wp.transpose(s))
        trace = wp.trace(s)
        for i in range(3):
            h[i, i] += trace
        turn = cofactor(h) * asymmetry / wp.determinant(h)
        if wp.length(turn) < type(f[0][0])(0.3):  # not where the nearest rotation is all but undetermined
            r = orthonormalized(orthonormalized(r + r * wp.skew(turn)))
    return r


@func
def nearest_rotation(f: Mat33):
    """argmin over rotations R of |F - R|_F; the identity for F = 0."""
    size_sq = wp.ddot(f, f)
    zero, one, two, four = type(size_sq)(0.0), type(size_sq)(1.0), type(size_sq)(2.0), type(size_sq)(4.0)
    if not (size_sq > zero):
        largest = wp.max(wp.max(wp.abs(f[0, 0]), wp.abs(f[1, 1])), wp.abs(f[2, 2]))
        if not (largest > zero):
            return type(f)(
                one, zero, zero,
                zero, one, zero,
                zero, zero, one,
            )  # fmt: skip
    g = f / wp.sqrt(size_sq)  # |g| = 1
    c = cofactor(g)
    d = g[0, 0] * c[0, 0] + g[1, 0] * c[1, 0] + g[2, 0] * c[2, 0]
    m = wp.ddot(c, c)
    i1 = type(size_sq)(1.7320508075688772)
    # p(i1) = (i1^2 - 1)^2 - 4 m - 8 d i1 is convex and increasing from its largest root on
    settled_at = int(0)
    for k in range(NEWTON_STEPS):
        q = i1 * i1 - one
        slope = four * (i1 * q - two * d)
        step = (q * q - four * m - type(size_sq)(8.0) * d * i1) / wp.max(slope, type(size_sq)(1.0e-30))
        i1 -= step
        if wp.abs(step) <= type(size_sq)(8.0) * unit_roundoff(size_sq):
            settled_at = k + 1
            break
    i2 = type(size_sq)(0.5) * (i1 * i1 - one)
    divisor = i1 * i2 - d
    if settled_at == 0 or not (divisor > degenerate(size_sq)):
        return refined(g, rotation_by_svd(g))
    r = (i1 * c + (i1 * i1 - i2) * g - g * (wp.transpose(g) * g)) / divisor
    return orthonormalized(r)
