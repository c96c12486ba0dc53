"""Eigenvalues and eigenvectors of symmetric 3x3 matrices by Jacobi's method, and what is positive of such a matrix."""

import warp as wp

from pdipc.device.language import func
from pdipc.device.precision import Mat33, Scalar, Vec3, unit_roundoff

SWEEPS = 5  # of the three rotations; four already reach rounding


@func
def turn(app: Scalar, aqq: Scalar, apq: Scalar):
    """Cosine and sine of the rotation that annihilates apq (Golub and Van Loan, 8.5.2)."""
    zero, one = type(apq)(0.0), type(apq)(1.0)
    c = one
    s = zero
    if apq != zero:
        tau = (aqq - app) / (type(apq)(2.0) * apq)
        t = wp.sign(tau) / (wp.abs(tau) + wp.sqrt(one + tau * tau))
        c = one / wp.sqrt(one + t * t)
        s = t * c
    return c, s


@func
def rotated(app: Scalar, aqq: Scalar, apq: Scalar, apr: Scalar, aqr: Scalar, vp: Vec3, vq: Vec3):
    """The entries and the columns p and q of the vectors after the rotation that annihilates apq; r is the third axis."""
    c, s = turn(app, aqq, apq)
    two = type(apq)(2.0)
    tpp = c * c * app - two * s * c * apq + s * s * aqq
    tqq = s * s * app + two * s * c * apq + c * c * aqq
    return tpp, tqq, c * apr - s * aqr, s * apr + c * aqr, c * vp - s * vq, s * vp + c * vq


@func
def symmetric(a: Mat33):
    """Eigenvalues (vec3) and the matrix whose columns are the eigenvectors, of the symmetric part of a."""
    zero, one, half = type(a[0][0])(0.0), type(a[0][0])(1.0), type(a[0][0])(0.5)
    a00 = a[0, 0]
    a11 = a[1, 1]
    a22 = a[2, 2]
    a01 = half * (a[0, 1] + a[1, 0])
    a02 = half * (a[0, 2] + a[2, 0])
    a12 = half * (a[1, 2] + a[2, 1])
    v0 = type(a[0])(one, zero, zero)
    v1 = type(a[0])(zero, one, zero)
    v2 = type(a[0])(zero, zero, one)
    size = wp.abs(a00) + wp.abs(a11) + wp.abs(a22)
    for _ in range(SWEEPS):
        if wp.abs(a01) + wp.abs(a02) + wp.abs(a12) <= unit_roundoff(size) * size:
            break
        a00, a11, a02, a12, v0, v1 = rotated(a00, a11, a01, a02, a12, v0, v1)
        a01 = zero
        a00, a22, a01, a12, v0, v2 = rotated(a00, a22, a02, a01, a12, v0, v2)
        a02 = zero
        a11, a22, a01, a02, v1, v2 = rotated(a11, a22, a12, a01, a02, v1, v2)
        a12 = zero
    return type(a[0])(a00, a11, a22), wp.matrix_from_cols(v0, v1, v2)


@func
def positive_part(a: Mat33):
    """The nearest symmetric positive semidefinite matrix: negative eigenvalues become zero."""
    # a diagonally dominant matrix is positive already
    if (
        a[0, 0] >= wp.abs(a[0, 1]) + wp.abs(a[0, 2])
        and a[1, 1] >= wp.abs(a[0, 1]) + wp.abs(a[1, 2])
        and a[2, 2] >= wp.abs(a[0, 2]) + wp.abs(a[1, 2])
    ):
        return a
    # and so is one whose leading minors are positive beyond doubt (Sylvester)
    size = wp.max(wp.max(wp.abs(a[0, 0]), wp.abs(a[1, 1])), wp.abs(a[2, 2]))
    doubt = type(size)(32.0) * unit_roundoff(size) * size
    minor = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    third = a[2, 2] * minor - (
        a[1, 1] * a[0, 2] * a[0, 2] + a[0, 0] * a[1, 2] * a[1, 2] - type(size)(2.0) * a[0, 1] * a[0, 2] * a[1, 2]
    )
    if a[0, 0] > doubt and minor > doubt * size and third > doubt * size * size:
        return a
    zero = type(size)(0.0)
    s, v = symmetric(a)
    if s[0] >= zero and s[1] >= zero and s[2] >= zero:
        return a
    t = wp.transpose(v)
    return wp.matrix_from_cols(wp.max(s[0], zero) * t[0], wp.max(s[1], zero) * t[1], wp.max(s[2], zero) * t[2]) * t
