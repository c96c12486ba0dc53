"""Tetrahedral strain: as rigid as possible. The projection of F is its nearest rotation (Bouaziz et al. 2014, Section 5.1)."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func
from pdipc.device.precision import Real

NAME = "tet_strain"
CORNERS = tets.CORNERS
PROJECTIVE = True
arguments = tets.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Strain of `vertices` (t, 4). weight_per_volume: Pa, see `material.solid`. Raises ValueError for inverted tets."""
    return tets.make(NAME, rest_positions, vertices, weight_per_volume)


def project_of(real: Real):
    """project(F): the nearest rotation."""
    return rotation.functions(real).nearest_rotation


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """project(F); principal(s, mu, lame): W = sum (s_i - 1)^2 / 2."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    one = wp.constant(scalar(1.0))
    two = wp.constant(scalar(2.0))
    least = wp.constant(scalar(1.0e-6))

    @func
    def principal(s: vec3, mu: scalar, lame: scalar):
        twist = vec3(
            one - two / wp.max(s[1] + s[2], least),
            one - two / wp.max(s[0] + s[2], least),
            one - two / wp.max(s[0] + s[1], least),
        )
        identity = wp.identity(n=3, dtype=scalar)
        return mat33(identity), twist, vec3(one, one, one)

    return SimpleNamespace(project=project_of(real), principal=principal)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.projective(real, real.module(__name__), project_of, functions(real).principal)
