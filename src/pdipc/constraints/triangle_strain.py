"""Strain of a triangle: as isometric as possible. The projection of the 3x2 F is its nearest isometry.

In closed form: with the unit normal n, cof F = [f2 x n, n x f1] turns with F, and P = (F + cof F) / (s1 + s2), where the sum of
the singular values is sqrt(|F|^2 + 2 |f1 x f2|).
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import triangles
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func
from pdipc.device.precision import Real, Scalar, Vec3

NAME = "triangle_strain"
CORNERS = triangles.CORNERS
PROJECTIVE = True
arguments = triangles.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_area) -> ConstraintSet:
    """Strain of `vertices` (m, 3). weight_per_area: N/m, see `material.cloth`. Raises ValueError for triangles without area."""
    return triangles.make(NAME, rest_positions, vertices, weight_per_area)


@func
def project(f1: Vec3, f2: Vec3):
    """The columns of the nearest isometry as rows."""
    zero, one = type(f1[0])(0.0), type(f1[0])(1.0)
    n = triangles.normal(f1, f2)
    p1 = f1 + wp.cross(f2, n)
    p2 = f2 + wp.cross(n, f1)
    size = wp.sqrt(type(f1[0])(0.5) * (wp.length_sq(p1) + wp.length_sq(p2)))
    if size > zero:
        p1 = p1 / size
        p2 = p2 / size
    else:
        p1 = type(f1)(one, zero, zero)
        p2 = type(f1)(zero, one, zero)
    return wp.matrix_from_rows(p1, p2)


@func
def principal(s1: Scalar, s2: Scalar):
    """Of W = ((s1 - 1)^2 + (s2 - 1)^2) / 2."""
    zero, one, least = type(s1)(0.0), type(s1)(1.0), type(s1)(1.0e-6)
    twist = one - type(s1)(2.0) / wp.max(s1 + s2, least)
    tilt = wp.vector(one - one / wp.max(s1, least), one - one / wp.max(s2, least))
    return wp.vector(one, zero, one), wp.vector(twist, one), tilt


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return triangles.kernels(real, real.module(__name__), project, principal)
