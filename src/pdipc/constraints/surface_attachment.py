"""Springs from a vertex to a point of a triangle of another surface, which feels them too: they keep their length.

G x = sum_k w_k x_k - x, with the weights w of the point in its triangle. The projection is the vector of rest length along it.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rows
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.precision import Real

NAME = "surface_attachment"
CORNERS = 4
PROJECTIVE = True
arguments = rows.arguments


def rest(positions: np.ndarray, elements: np.ndarray, weights: np.ndarray, stiffness) -> ConstraintSet:
    """Springs from elements[:, 0] to the points of the triangles elements[:, 1:] with weights (k, 3), at rest at positions (n, 3) m.
    stiffness: N/m, one or one a spring.
    """
    gradient = np.concatenate([np.full((len(elements), 1), -1.0), weights], axis=1)[:, None, :]
    length = np.linalg.norm(np.einsum("ek,ekd->ed", weights, positions[elements[:, 1:]]) - positions[elements[:, 0]], axis=1)
    return make_set(NAME, elements, gradient, stiffness, length=length)


def functions(real: Real) -> SimpleNamespace:
    """project(v, length)."""
    return SimpleNamespace(project=rows.keep_length(real))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, rows.keep_length)
