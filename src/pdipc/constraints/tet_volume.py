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
from pdipc.device.precision import Real

NAME = "tet_volume"
CORNERS = tets.CORNERS
arguments = tets.arguments
ITERATIONS = 30
SETTLED = {"float32": 1.0e-5, "float64": 1.0e-12}


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Volume of `vertices` (t, 4). weight_per_volume: Pa, see `material.solid`. Raises ValueError for inverted tets."""
    return tets.make(NAME, rest_positions, vertices, weight_per_volume)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """project(F): the nearest matrix of determinant one."""
    scalar, mat33 = real.scalar, real.mat33
    rot = rotation.functions(real)
    settled = wp.constant(scalar(SETTLED[real.name]))

    @wp.func
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

    return SimpleNamespace(project=project)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.kernels(real, real.module(__name__), functions(real).project)
