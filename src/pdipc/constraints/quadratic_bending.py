"""Quadratic bending of sheets that are flat at rest (Wardetzky et al. 2007; Bergou et al. 2006).

For the hinge of two triangles at an edge (x0, x1) with opposite vertices x2, x3, the row g of cotangents gives the mean
curvature vector: g x = 0 when flat. The energy k / (2 A) |g x|^2, with A the area of both triangles, is quadratic: the
projection is zero. With k the flexural rigidity in N m, a sheet of equilateral triangles rolled to a radius r has the energy
k / (2 r^2) per area in every direction; a grid of right-angled triangles has 0.98 of that along the grid, and more across.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import rows
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import func
from pdipc.device.precision import Real

NAME = "quadratic_bending"
CORNERS = 4
PROJECTIVE = True
arguments = rows.arguments


def hinges(triangles: np.ndarray) -> np.ndarray:
    """(h, 4) int32: for every edge with two triangles its ends and the two vertices across."""
    corner = np.arange(3)
    edges = triangles[:, np.stack([corner, (corner + 1) % 3], axis=1)].reshape(-1, 2)
    across = triangles[:, (corner + 2) % 3].reshape(-1)
    low, high = edges.min(axis=1), edges.max(axis=1)
    order = np.lexsort((high, low))
    low, high, across = low[order], high[order], across[order]
    second = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1])) + 1
    return np.stack([low[second], high[second], across[second - 1], across[second]], axis=1).astype(np.int32)


def curvature_rows(rest_positions: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """g (h, 4) and the areas (h,) of both triangles of each hinge, m^2."""
    corners = rest_positions[vertices]
    return rows_of_sides(corners[:, :3], corners[:, [0, 1, 3]])


def rows_of_sides(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same, from (h, 3, 3) each: the ends of the hinge and the vertex across, as either triangle has them at rest."""

    def cotangents(side: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """At both ends of the hinge, and the area."""
        e, a, b = side[:, 1] - side[:, 0], side[:, 2] - side[:, 0], side[:, 2] - side[:, 1]
        double = np.linalg.norm(np.cross(e, a), axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.einsum("ij,ij->i", e, a) / double, np.einsum("ij,ij->i", -e, b) / double, 0.5 * double

    (c01, c03, area), (c02, c04, other) = cotangents(first), cotangents(second)
    return np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], axis=1), area + other


def rest(rest_positions: np.ndarray, triangles: np.ndarray, bending_stiffness: float, corners=None) -> ConstraintSet:
    """Bending of the sheet `triangles` (m, 3). bending_stiffness: flexural rigidity k, N m. Raises ValueError for slivers.

    corners: (m, 3, 3) the corners of each triangle in a flat shape of its own, from which the sheet is sewn; None for rest_positions.
    """
    vertices = hinges(triangles)
    if corners is None:
        g, area = curvature_rows(rest_positions, vertices)
    else:
        g, area = rows_of_sides(*(_side(triangles, corners, vertices[:, [0, 1, across]]) for across in (2, 3)))
    return make_set(NAME, vertices, g[:, None, :], bending_stiffness / area, length=np.zeros(len(vertices)))


def _side(triangles: np.ndarray, corners: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(h, 3, 3): where `vertices` (h, 3), the corners of a triangle in any order, are in `corners`."""
    keys = np.sort(triangles, axis=1)
    order = np.lexsort(keys.T[::-1])
    wanted = np.sort(vertices, axis=1)
    size = np.int64(triangles.max()) + 1

    def code(rows: np.ndarray) -> np.ndarray:
        return (rows[:, 0].astype(np.int64) * size + rows[:, 1]) * size + rows[:, 2]

    which = order[np.searchsorted(code(keys)[order], code(wanted))]
    place = np.argmax(triangles[which][:, None, :] == vertices[:, :, None], axis=2)
    return corners[which[:, None], place]


def functions(real: Real) -> SimpleNamespace:
    """project(v, length) = 0."""
    scalar, vec3 = real.scalar, real.vec3

    @func
    def project(v: vec3, length: scalar) -> vec3:
        return vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    return SimpleNamespace(project=project)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, lambda of: functions(of).project, bends=False)
