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
from pdipc.device.precision import Real

NAME = "triangle_strain"
CORNERS = triangles.CORNERS
PROJECTIVE = True
arguments = triangles.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_area) -> ConstraintSet:
    """Strain of `vertices` (m, 3). weight_per_area: N/m, see `material.cloth`. Raises ValueError for triangles without area."""
    return triangles.make(NAME, rest_positions, vertices, weight_per_area)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """project(f1, f2): the columns of the nearest isometry as rows. principal(s1, s2): W = ((s1 - 1)^2 + (s2 - 1)^2) / 2."""
    scalar, vec2, vec3 = real.scalar, real.vec2, real.vec3
    one, least = wp.constant(scalar(1.0)), wp.constant(scalar(1.0e-6))
    mat23 = wp.types.matrix((2, 3), scalar)
    normal = triangles.normal_function(real)

    @func
    def project(f1: vec3, f2: vec3) -> mat23:
        n = normal(f1, f2)
        p1 = f1 + wp.cross(f2, n)
        p2 = f2 + wp.cross(n, f1)
        size = wp.sqrt(scalar(0.5) * (wp.length_sq(p1) + wp.length_sq(p2)))
        if size > scalar(0.0):
            p1 = p1 / size
            p2 = p2 / size
        else:
            p1 = vec3(scalar(1.0), scalar(0.0), scalar(0.0))
            p2 = vec3(scalar(0.0), scalar(1.0), scalar(0.0))
        return mat23(p1[0], p1[1], p1[2], p2[0], p2[1], p2[2])

    @func
    def principal(s1: scalar, s2: scalar):
        twist = one - scalar(2.0) / wp.max(s1 + s2, least)
        tilt = vec2(one - one / wp.max(s1, least), one - one / wp.max(s2, least))
        return vec3(one, scalar(0.0), one), vec2(twist, one), tilt

    return SimpleNamespace(project=project, principal=principal)


def project_of(real: Real):
    """project(f1, f2): the nearest isometry."""
    return functions(real).project


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return triangles.kernels(real, real.module(__name__), project_of, functions(real).principal)
