"""Eigenvalues and eigenvectors of symmetric 3x3 matrices by Jacobi's method, and what is positive of such a matrix."""

import warp as wp

from pdipc.device.language import func
from pdipc.device.precision import Mat33, Scalar, unit_roundoff

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
def symmetric(a: Mat33):
    """Eigenvalues (vec3) and the matrix whose columns are the eigenvectors, of the symmetric part of a."""
    zero, one, half, two = type(a[0][0])(0.0), type(a[0][0])(1.0), type(a[0][0])(0.5), type(a[0][0])(2.0)
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
        c, s = turn(a00, a11, a01)
        t00 = c * c * a00 - two * s * c * a01 + s * s * a11
        t11 = s * s * a00 + two * s * c * a01 + c * c * a11
        t02 = c * a02 - s * a12
        a12 = s * a02 + c * a12
        a02 = t02
        a00 = t00
        a11 = t11
        a01 = zero
        w = c * v0 - s * v1
        v1 = s * v0 + c * v1
        v0 = w
        c, s = turn(a00, a22, a02)
        t00 = c * c * a00 - two * s * c * a02 + s * s * a22
        t22 = s * s * a00 + two * s * c * a02 + c * c * a22
        t01 = c * a01 - s * a12
        a12 = s * a01 + c * a12
        a01 = t01
        a00 = t00
        a22 = t22
        a02 = zero
        w = c * v0 - s * v2
        v2 = s * v0 + c * v2
        v0 = w
        c, s = turn(a11, a22, a12)
        t11 = c * c * a11 - two * s * c * a12 + s * s * a22
        t22 = s * s * a11 + two * s * c * a12 + c * c * a22
        t01 = c * a01 - s * a02
        a02 = s * a01 + c * a02
        a01 = t01
        a11 = t11
        a22 = t22
        a12 = zero
        w = c * v1 - s * v2
        v2 = s * v1 + c * v2
        v1 = w
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
