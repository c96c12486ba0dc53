"""Preservation of area: the projection of the 3x2 F is the nearest P whose columns span an area of one.

The same iteration as `tet_volume`, with cof P = [p2 x n, n x p1]; the plane of F, and so n, stays.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import triangle_strain, triangles
from pdipc.constraints.base import ConstraintSet
from pdipc.constraints.tet_volume import ITERATIONS, SETTLED
from pdipc.device.language import func
from pdipc.device.precision import Real

NAME = "triangle_area"
CORNERS = triangles.CORNERS
PROJECTIVE = True
arguments = triangles.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_area) -> ConstraintSet:
    """Area of `vertices` (m, 3). weight_per_area: N/m, see `material.cloth`. Raises ValueError for triangles without area."""
    return triangles.make(NAME, rest_positions, vertices, weight_per_area)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """project(f1, f2): the columns of the nearest P of area one, as rows. principal(s1, s2): of half the squared distance to it.

    As for `tet_volume`: s_i = p_i + m / p_i with p1 p2 = 1.
    """
    scalar, vec2, vec3 = real.scalar, real.vec2, real.vec3
    one, zero, least = wp.constant(scalar(1.0)), wp.constant(scalar(0.0)), wp.constant(scalar(1.0e-3))
    mat23 = wp.types.matrix((2, 3), scalar)
    normal = triangles.normal_function(real)
    isometry = triangle_strain.functions(real).project
    settled = wp.constant(scalar(SETTLED[real.name]))

    @func
    def project(f1: vec3, f2: vec3) -> mat23:
        n = normal(f1, f2)
        p1 = f1
        p2 = f2
        found = int(0)
        for _ in range(ITERATIONS):
            c1 = wp.cross(p2, n)
            c2 = wp.cross(n, p1)
            size = wp.length_sq(c1) + wp.length_sq(c2)
            if size > scalar(1.0e-12):
                area = wp.dot(n, wp.cross(p1, p2))
                step = (wp.dot(c1, p1 - f1) + wp.dot(c2, p2 - f2) - (area - scalar(1.0))) / size
                q1 = f1 + step * c1
                q2 = f2 + step * c2
                moved = wp.length_sq(q1 - p1) + wp.length_sq(q2 - p2)
                p1 = q1
                p2 = q2
                if moved <= settled * settled * (wp.length_sq(p1) + wp.length_sq(p2)):
                    found = 1
                    break
            else:
                break
        if found == 0 and not (wp.abs(wp.dot(n, wp.cross(p1, p2)) - scalar(1.0)) < scalar(1.0e-3)):
            return isometry(f1, f2)
        return mat23(p1[0], p1[1], p1[2], p2[0], p2[1], p2[2])

    @func
    def away_from_zero(a: scalar) -> scalar:
        """a, but no nearer to zero than a thousandth."""
        if wp.abs(a) < least:
            return wp.where(a < zero, -least, least)
        return a

    @func
    def principal(s1: scalar, s2: scalar):
        near = project(vec3(s1, zero, zero), vec3(zero, s2, zero))
        p1 = away_from_zero(near[0, 0])
        p2 = away_from_zero(near[1, 1])
        c1 = one / p1
        c2 = one / p2
        m = ((s1 - p1) * c1 + (s2 - p2) * c2) / (c1 * c1 + c2 * c2)
        a1 = away_from_zero(one - m * c1 * c1)
        a2 = away_from_zero(one - m * c2 * c2)
        b1 = c1 / a1
        b2 = c2 / a2
        total = away_from_zero(b1 * c1 + b2 * c2)
        stretch = vec3(one - one / a1 + b1 * b1 / total, b1 * b2 / total, one - one / a2 + b2 * b2 / total)
        # (W1 + W2) / (s1 + s2) = m / (1 + m) and (W1 - W2) / (s1 - s2) = -m / (1 - m), since p1 p2 = 1
        pair = vec2(m / away_from_zero(one + m), -m / away_from_zero(one - m))
        tilt = vec2(m * c1 / wp.max(s1, least), m * c2 / wp.max(s2, least))
        return stretch, pair, tilt

    return SimpleNamespace(project=project, principal=principal)


def project_of(real: Real):
    """project(f1, f2): the nearest P of area one."""
    return functions(real).project


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return triangles.kernels(real, real.module(__name__), project_of, functions(real).principal)
