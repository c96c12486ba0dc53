"""Preservation of volume. The projection of F is the nearest matrix with det P = 1 (Bouaziz et al. 2014, Section 5.3).

It is found by D <- cof(F + D) (<cof(F + D), D> - (det(F + D) - 1)) / |cof(F + D)|^2, from D = 0: the iteration that Bouaziz
et al. state for singular values, in terms of F itself, so that no SVD is needed.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func
from pdipc.device.precision import Mat33, Real, Scalar, Vec3

NAME = "tet_volume"
CORNERS = tets.CORNERS
PROJECTIVE = True
arguments = tets.arguments
ITERATIONS = 30
SETTLED = {"float32": 1.0e-5, "float64": 1.0e-12}


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Volume of `vertices` (t, 4). weight_per_volume: Pa, see `material.solid`. Raises ValueError for inverted tets."""
    return tets.make(NAME, rest_positions, vertices, weight_per_volume)


LEAST = 1.0e-3  # no nearer to zero


@func
def settled(like: wp.float64):
    """Of |P|: a change below which the iteration ends; in the type of `like`."""
    return wp.float64(wp.static(SETTLED["float64"]))


@func
def settled(like: wp.float32):  # noqa: F811
    return wp.float32(wp.static(SETTLED["float32"]))


@func
def project(f: Mat33):
    """The nearest P with det P = 1; where the iteration finds none (F of rank one or less), the nearest rotation."""
    p = f
    found = int(0)
    for _ in range(ITERATIONS):
        c = rotation.cofactor(p)
        size = wp.ddot(c, c)
        if size > type(size)(1.0e-12):
            det = p[0, 0] * c[0, 0] + p[1, 0] * c[1, 0] + p[2, 0] * c[2, 0]
            before = p
            p = f + c * ((wp.ddot(c, p - f) - (det - type(size)(1.0))) / size)
            moved = p - before
            if wp.ddot(moved, moved) <= settled(size) * settled(size) * wp.ddot(p, p):
                found = 1
                break
        else:
            break
    if found == 0 and not (wp.abs(wp.determinant(p) - type(f[0][0])(1.0)) < type(f[0][0])(1.0e-3)):
        return rotation.nearest_rotation(f)
    return p


@func
def away_from_zero(a: Scalar):
    """a, but no nearer to zero than a thousandth: where the nearest matrix jumps, its derivative has no bound."""
    least = type(a)(LEAST)
    if wp.abs(a) < least:
        return wp.where(a < type(a)(0.0), -least, least)
    return a


@func
def principal(s: Vec3, mu: Scalar, lame: Scalar):
    """Of half the squared distance to the nearest matrix of determinant one.

    With the singular values p of P, p1 p2 p3 = 1, and a multiplier m: s_i = p_i + m / p_i. So W_i = m / p_i, and with
    a_i = 1 - m / p_i^2 and c_i = 1 / p_i the derivative of p is dp_i/ds_j = delta_ij / a_i - (c_i / a_i) (c_j / a_j) / sum(c^2 / a).
    """
    zero, one = type(s[0])(0.0), type(s[0])(1.0)
    like = wp.outer(s, s)
    f = type(like)(
        s[0], zero, zero,
        zero, s[1], zero,
        zero, zero, s[2],
    )  # fmt: skip
    near = project(f)
    p = type(s)(away_from_zero(near[0, 0]), away_from_zero(near[1, 1]), away_from_zero(near[2, 2]))
    c = type(s)(one / p[0], one / p[1], one / p[2])
    m = wp.dot(s - p, c) / wp.dot(c, c)
    a = type(s)(
        away_from_zero(one - m * c[0] * c[0]),
        away_from_zero(one - m * c[1] * c[1]),
        away_from_zero(one - m * c[2] * c[2]),
    )
    b = type(s)(c[0] / a[0], c[1] / a[1], c[2] / a[2])
    total = away_from_zero(wp.dot(b, c))
    stretch = type(like)(
        one - one / a[0] + b[0] * b[0] / total, b[0] * b[1] / total, b[0] * b[2] / total,
        b[1] * b[0] / total, one - one / a[1] + b[1] * b[1] / total, b[1] * b[2] / total,
        b[2] * b[0] / total, b[2] * b[1] / total, one - one / a[2] + b[2] * b[2] / total,
    )  # fmt: skip
    twist = type(s)()
    flip = type(s)()
    for k in range(3):
        twist[k] = m * p[k] / away_from_zero(one + m * p[k])
        flip[k] = -m * p[k] / away_from_zero(one - m * p[k])
    return stretch, twist, flip


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.projective(real, real.module(__name__), project, principal)
