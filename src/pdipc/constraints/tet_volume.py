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
from pdipc.device.precision import Real

NAME = "tet_volume"
CORNERS = tets.CORNERS
PROJECTIVE = True
arguments = tets.arguments
ITERATIONS = 30
SETTLED = {"float32": 1.0e-5, "float64": 1.0e-12}


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Volume of `vertices` (t, 4). weight_per_volume: Pa, see `material.solid`. Raises ValueError for inverted tets."""
    return tets.make(NAME, rest_positions, vertices, weight_per_volume)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """project(F): the nearest matrix of determinant one. principal(s, mu, lame): of half the squared distance to it.

    With the singular values p of P, p1 p2 p3 = 1, and a multiplier m: s_i = p_i + m / p_i. So W_i = m / p_i, and with
    a_i = 1 - m / p_i^2 and c_i = 1 / p_i the derivative of p is dp_i/ds_j = delta_ij / a_i - (c_i / a_i) (c_j / a_j) / sum(c^2 / a).
    """
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    zero, one = wp.constant(scalar(0.0)), wp.constant(scalar(1.0))
    least = wp.constant(scalar(1.0e-3))
    rot = rotation.functions(real)
    settled = wp.constant(scalar(SETTLED[real.name]))

    @func
    def project(f: mat33) -> mat33:
        """The nearest P with det P = 1; where the iteration finds none (F of rank one or less), the nearest rotation."""
        p = f
        found = int(0)
        for _ in range(ITERATIONS):
            c = rot.cofactor(p)
            size = wp.ddot(c, c)
            if size > scalar(1.0e-12):
                det = p[0, 0] * c[0, 0] + p[1, 0] * c[1, 0] + p[2, 0] * c[2, 0]
                before = p
                p = f + c * ((wp.ddot(c, p - f) - (det - scalar(1.0))) / size)
                moved = p - before
                if wp.ddot(moved, moved) <= settled * settled * wp.ddot(p, p):
                    found = 1
                    break
            else:
                break
        if found == 0 and not (wp.abs(wp.determinant(p) - scalar(1.0)) < scalar(1.0e-3)):
            return rot.nearest_rotation(f)
        return p

    @func
    def away_from_zero(a: scalar) -> scalar:
        """a, but no nearer to zero than a thousandth: where the nearest matrix jumps, its derivative has no bound."""
        if wp.abs(a) < least:
            return wp.where(a < zero, -least, least)
        return a

    @func
    def principal(s: vec3, mu: scalar, lame: scalar):
        f = mat33(
            s[0], zero, zero,
            zero, s[1], zero,
            zero, zero, s[2],
        )  # fmt: skip
        near = project(f)
        p = vec3(away_from_zero(near[0, 0]), away_from_zero(near[1, 1]), away_from_zero(near[2, 2]))
        c = vec3(one / p[0], one / p[1], one / p[2])
        m = wp.dot(s - p, c) / wp.dot(c, c)
        a = vec3(
            away_from_zero(one - m * c[0] * c[0]),
            away_from_zero(one - m * c[1] * c[1]),
            away_from_zero(one - m * c[2] * c[2]),
        )
        b = vec3(c[0] / a[0], c[1] / a[1], c[2] / a[2])
        total = away_from_zero(wp.dot(b, c))
        stretch = mat33(
            one - one / a[0] + b[0] * b[0] / total, b[0] * b[1] / total, b[0] * b[2] / total,
            b[1] * b[0] / total, one - one / a[1] + b[1] * b[1] / total, b[1] * b[2] / total,
            b[2] * b[0] / total, b[2] * b[1] / total, one - one / a[2] + b[2] * b[2] / total,
        )  # fmt: skip
        twist = vec3()
        flip = vec3()
        for k in range(3):
            twist[k] = m * p[k] / away_from_zero(one + m * p[k])
            flip[k] = -m * p[k] / away_from_zero(one - m * p[k])
        return stretch, twist, flip

    return SimpleNamespace(project=project, principal=principal)


def project_of(real: Real):
    """project(F): the nearest matrix of determinant one."""
    return functions(real).project


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.projective(real, real.module(__name__), project_of, functions(real).principal)
