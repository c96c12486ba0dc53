"""Springs: an edge keeps its length. The projection of x_b - x_a is the vector of rest length along it.

Also what attaches vertices of two bodies to each other: a spring, of rest length zero where they are to meet.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rows
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.precision import Real

NAME = "edge_length"
CORNERS = 2
PROJECTIVE = True
arguments = rows.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, stiffness, length=None) -> ConstraintSet:
    """Springs along `vertices` (e, 2). stiffness: N/m, one or one a spring. length: (e,) m; None for that of the rest shape."""
    if length is None:
        length = np.linalg.norm(rest_positions[vertices[:, 1]] - rest_positions[vertices[:, 0]], axis=1)
    bad = np.flatnonzero(~(np.asarray(length) >= 0.0))
    if len(bad):
        raise ValueError(f"{NAME} element {bad[0]}: the rest length is {length[bad[0]]}; it must not be negative")
    gradient = np.broadcast_to([[[-1.0, 1.0]]], (len(vertices), 1, 2))
    return make_set(NAME, vertices, gradient, stiffness, length=np.asarray(length, dtype=np.float64))


def functions(real: Real) -> SimpleNamespace:
    """project(v, length)."""
    return SimpleNamespace(project=rows.keep_length(real))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, rows.keep_length)
