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
from pdipc.device.precision import Real

NAME = "triangle_area"
CORNERS = triangles.CORNERS
arguments = triangles.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_area) -> ConstraintSet:
    """Area of `vertices` (m, 3). weight_per_area: N/m, see `material.cloth`. Raises ValueError for triangles without area."""
    return triangles.make(NAME, rest_positions, vertices, weight_per_area)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """project(f1, f2): the columns of the nearest P of area one, as rows."""
    scalar, vec3 = real.scalar, real.vec3
    mat23 = wp.types.matrix((2, 3), scalar)
    normal = triangles.normal_function(real)
    isometry = triangle_strain.functions(real).project
    settled = wp.constant(scalar(SETTLED[real.name]))

    @wp.func
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

    return SimpleNamespace(project=project)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return triangles.kernels(real, real.module(__name__), functions(real).project)
