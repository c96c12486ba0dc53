"""Preservation of area: the projection of the 3x2 F is the nearest P whose columns span an area of one.

The same iteration as `tet_volume`, with cof P = [p2 x n, n x p1]; the plane of F, and so n, stays.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import triangle_strain, triangles
from pdipc.constraints.base import ConstraintSet
from pdipc.constraints.tet_volume import ITERATIONS, LEAST, away_from_zero, settled
from pdipc.device.language import func
from pdipc.device.precision import Real, Scalar, Vec3

NAME = "triangle_area"
CORNERS = triangles.CORNERS
PROJECTIVE = True
arguments = triangles.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_area) -> ConstraintSet:
    """Area of `vertices` (m, 3). weight_per_area: N/m, see `material.cloth`. Raises ValueError for triangles without area."""
    return triangles.make(NAME, rest_positions, vertices, weight_per_area)


@func
def project(f1: Vec3, f2: Vec3):
    """The columns of the nearest P of area one, as rows; where the iteration finds none, of the nearest isometry."""
    n = triangles.normal(f1, f2)
    p1 = f1
    p2 = f2
    found = int(0)
    for _ in range(ITERATIONS):
        c1 = wp.cross(p2, n)
        c2 = wp.cross(n, p1)
        size = wp.length_sq(c1) + wp.length_sq(c2)
        if size > type(size)(1.0e-12):
            area = wp.dot(n, wp.cross(p1, p2))
            step = (wp.dot(c1, p1 - f1) + wp.dot(c2, p2 - f2) - (area - type(size)(1.0))) / size
            q1 = f1 + step * c1
            q2 = f2 + step * c2
            moved = wp.length_sq(q1 - p1) + wp.length_sq(q2 - p2)
            p1 = q1
            p2 = q2
            if moved <= settled(size) * settled(size) * (wp.length_sq(p1) + wp.length_sq(p2)):
                found = 1
                break
        else:
            break
    if found == 0 and not (wp.abs(wp.dot(n, wp.cross(p1, p2)) - type(f1[0])(1.0)) < type(f1[0])(1.0e-3)):
        return triangle_strain.project(f1, f2)
    return wp.matrix_from_rows(p1, p2)


@func
def principal(s1: Scalar, s2: Scalar):
    """Of half the squared distance. As for `tet_volume`: s_i = p_i + m / p_i with p1 p2 = 1."""
    zero, one, least = type(s1)(0.0), type(s1)(1.0), type(s1)(LEAST)
    near = project(wp.vector(s1, zero, zero), wp.vector(zero, s2, zero))
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
    stretch = wp.vector(one - one / a1 + b1 * b1 / total, b1 * b2 / total, one - one / a2 + b2 * b2 / total)
    # (W1 + W2) / (s1 + s2) = m / (1 + m) and (W1 - W2) / (s1 - s2) = -m / (1 - m), since p1 p2 = 1
    pair = wp.vector(m / away_from_zero(one + m), -m / away_from_zero(one - m))
    tilt = wp.vector(m * c1 / wp.max(s1, least), m * c2 / wp.max(s2, least))
    return stretch, pair, tilt


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return triangles.kernels(real, real.module(__name__), project, principal)
