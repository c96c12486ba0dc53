"""Stitches: a thread from a vertex to a point of a triangle of another panel, which holds no more than it pulls.

G x = sum_k w_k x_k - x, with the weights w of the point in its triangle (a vertex or a point on an edge have zeros). The projection is the
nearest vector that is no longer than the thread, and the energy w/2 (|G x| - L)^2 where it is taut. It is convex.

The lengths are `Projector.threads`, in the order of the elements; who sews uploads them before a step.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rows
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.precision import Real

NAME = "stitch"
CORNERS = 4
PROJECTIVE = True
arguments = rows.arguments


def rest(elements: np.ndarray, weights: np.ndarray, stiffness, length) -> ConstraintSet:
    """Threads from elements[:, 0] to the points of the triangles elements[:, 1:] with weights (k, 3). stiffness: N/m, one or one a
    thread. length: (k,) m.
    """
    gradient = np.concatenate([np.full((len(elements), 1), -1.0), weights], axis=1)[:, None, :]
    return make_set(
        NAME, elements, gradient, stiffness, length=np.broadcast_to(np.asarray(length, dtype=np.float64), len(elements))
    )


def functions(real: Real) -> SimpleNamespace:
    """project(v, length)."""
    return SimpleNamespace(project=rows.limit_length(real))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, rows.limit_length, pulls=True)
