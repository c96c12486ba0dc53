"""Tetrahedral strain: as rigid as possible. The projection of F is its nearest rotation (Bouaziz et al. 2014, Section 5.1)."""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.precision import Real

NAME = "tet_strain"
CORNERS = tets.CORNERS
arguments = tets.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Strain of `vertices` (t, 4). weight_per_volume: Pa, see `material.solid`. Raises ValueError for inverted tets."""
    return tets.make(NAME, rest_positions, vertices, weight_per_volume)


def functions(real: Real) -> SimpleNamespace:
    """project(F): the nearest rotation."""
    return SimpleNamespace(project=rotation.functions(real).nearest_rotation)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.kernels(real, real.module(__name__), functions(real).project)
