"""Tetrahedral strain: as rigid as possible. The projection of F is its nearest rotation (Bouaziz et al. 2014, Section 5.1)."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func
from pdipc.device.precision import Real, Scalar, Vec3

NAME = "tet_strain"
CORNERS = tets.CORNERS
PROJECTIVE = True
arguments = tets.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Strain of `vertices` (t, 4). weight_per_volume: Pa, see `material.solid`. Raises ValueError for inverted tets."""
    return tets.make(NAME, rest_positions, vertices, weight_per_volume)


@func
def principal(s: Vec3, mu: Scalar, lame: Scalar):
    """W = sum (s_i - 1)^2 / 2."""
    zero, one, two, least = type(s[0])(0.0), type(s[0])(1.0), type(s[0])(2.0), type(s[0])(1.0e-6)
    twist = type(s)(
        one - two / wp.max(s[1] + s[2], least),
        one - two / wp.max(s[0] + s[2], least),
        one - two / wp.max(s[0] + s[1], least),
    )
    like = wp.outer(s, s)
    identity = type(like)(
        one, zero, zero,
        zero, one, zero,
        zero, zero, one,
    )  # fmt: skip
    return identity, twist, type(s)(one, one, one)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.projective(real, real.module(__name__), rotation.nearest_rotation, principal)
