"""Bending of sheets that are curved at rest: each hinge keeps the length of its mean curvature vector g x.

The row g is that of `quadratic_bending`; the projection is the vector of rest length along the present one. For a flat hinge it
is the same constraint. The length has no sign: a hinge may snap through to its mirror image, which is at rest as well.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rows
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.constraints.quadratic_bending import curvature_rows, hinges
from pdipc.device.precision import Real

NAME = "curved_bending"
CORNERS = 4
PROJECTIVE = True
arguments = rows.arguments


def rest(rest_positions: np.ndarray, triangles: np.ndarray, bending_stiffness: float) -> ConstraintSet:
    """Bending of the sheet `triangles` (m, 3). bending_stiffness: flexural rigidity k, N m. Raises ValueError for slivers."""
    vertices = hinges(triangles)
    g, area = curvature_rows(rest_positions, vertices)
    length = np.linalg.norm(np.einsum("hc,hcd->hd", g, rest_positions[vertices]), axis=1)
    return make_set(NAME, vertices, g[:, None, :], bending_stiffness / area, length=length)


def functions(real: Real) -> SimpleNamespace:
    """project(v, length)."""
    return SimpleNamespace(project=rows.keep_length(real))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, rows.keep_length)
