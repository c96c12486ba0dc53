"""Bending of rods that twist freely: at each inner vertex the difference of the two tangents keeps its length.

The row g of (1 / l_a, -1 / l_a - 1 / l_b, 1 / l_b) gives g x = t_b - t_a, which is as long as twice the sine of half the angle between them.
Its energy EI / (2 l) |g x - p|^2, l half the length of both segments, is that of a beam of rigidity EI. The length has no
direction: a rod that is curved at rest may be curved about any axis, as one that twists freely may.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rows
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.precision import Real

NAME = "rod_bending"
CORNERS = 3
PROJECTIVE = True
arguments = rows.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, bending_stiffness: float) -> ConstraintSet:
    """Bending at the middle one of `vertices` (e, 3), each with a neighbour on either side. bending_stiffness: EI, N m^2."""
    x = rest_positions[vertices]
    lengths = np.linalg.norm(np.diff(x, axis=1), axis=2)
    with np.errstate(divide="ignore"):
        a, b = (1.0 / lengths).T
    g = np.stack([a, -a - b, b], axis=1)
    tangents = np.diff(x, axis=1) / lengths[:, :, None]
    length = np.linalg.norm(tangents[:, 1] - tangents[:, 0], axis=1)
    return make_set(NAME, vertices, g[:, None, :], bending_stiffness / (0.5 * lengths.sum(axis=1)), length=length)


def functions(real: Real) -> SimpleNamespace:
    """project(v, length)."""
    return SimpleNamespace(project=rows.keep_length(real))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, rows.keep_length)
