"""Bending of sheets that are flat at rest and stiffer to bend along their warp than along their weft, or the other way.

The basic shell triangle (Onate and Zarate 2000): what the gradient of x changes by across the sides of a triangle is its curvature. With n_i the
normal of side i in the plane of the triangle, warp and weft its axes, and g_i the row of cotangents of the hinge there (`quadratic_bending`),

    K = sum over i of n_i n_i^T (g_i x) / A_i,

A_i the area of both triangles of that hinge: the gradient at a side is taken between those of its two triangles, by their heights. Every
component of K is a 3-vector; its energy per area is that of an orthotropic plate without Poisson's effect,

    W = (k1 |K11|^2 + k2 |K22|^2 + 2 sqrt(k1 k2) |K12|^2) / 2,

quadratic in x, so that the projection is zero. A strip cut at an angle t to the warp and bent without stretch is as stiff as
(sqrt(k1) cos^2 t + sqrt(k2) sin^2 t)^2, Huber's law; with k1 = k2 as stiff in all directions. This is exact where triangles are translated or turned
by half a turn into their neighbours; on irregular meshes it is not, most in a direction that is far softer than the other (docs/materials.md).
Across an open side no moment acts: what K has there is what makes W least.
"""

import functools
from types import SimpleNamespace

import numpy as np

from pdipc.constraints import quadratic_bending, rows, triangles
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.precision import Real

NAME = "woven_bending"
CORNERS = 6  # those of a triangle, and across its sides
PROJECTIVE = True
arguments = rows.arguments


def rest(
    rest_positions: np.ndarray, sheet: np.ndarray, warp_stiffness: float, weft_stiffness: float, warp, corners=None
) -> ConstraintSet:
    """Bending of the sheet `sheet` (m, 3): an element for each part of K that is not left open, at most three a triangle.

    warp_stiffness, weft_stiffness: flexural rigidities k1, k2, N m. warp: (3,) its direction at rest, in any unit. corners: (m, 3, 3) the corners of
    each triangle in a flat shape of its own, from which the sheet is sewn; None for rest_positions. Raises ValueError for triangles without
    area, or that lie across the warp.
    """
    own = rest_positions[sheet] if corners is None else corners
    apart = np.arange(3 * len(sheet)).reshape(-1, 3)
    shape = triangles.make(NAME, own.reshape(-1, 3), apart, 1.0, axis=warp)  # its rows are the gradients of the three corners
    area, inward = shape.weight, np.roll(shape.gradient, 1, axis=2)  # of the corner across side i
    n = np.swapaxes(inward / np.linalg.norm(inward, axis=1, keepdims=True), 1, 2)
    mean = np.sqrt(warp_stiffness * weft_stiffness)
    root = np.array([(warp_stiffness / weft_stiffness) ** 0.25, (weft_stiffness / warp_stiffness) ** 0.25, np.sqrt(2.0)])
    along = root * np.stack([n[:, :, 0] ** 2, n[:, :, 1] ** 2, n[:, :, 0] * n[:, :, 1]], axis=2)  # (m, 3, 3): side, component
    vertices, row = _patches(sheet, own)
    closed = (row != 0.0).any(axis=2)
    found = [], [], []
    for count in range(1, 4):
        which = np.flatnonzero(closed.sum(axis=1) == count)
        # what open sides can change takes no part
        basis = np.linalg.svd(np.swapaxes(along[which] * ~closed[which][:, :, None], 1, 2))[0][:, :, 3 - count :]
        g = np.einsum("tkr,tik,tic->trc", basis, along[which], row[which]) * area[which][:, None, None]
        for part, values in zip(
            found, (np.repeat(vertices[which], count, axis=0), g.reshape(-1, 6), np.repeat(area[which], count)), strict=True
        ):
            part.append(values)
    elements, g, areas = (np.concatenate(part) for part in found)
    return make_set(NAME, elements, g[:, None, :], mean / areas, length=np.zeros(len(elements)))


def _patches(sheet: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m, 6): the corners of each triangle and those across its sides, and (m, 3, 6) g_i / A_i, 1/m^2, of its sides; where there is no
    neighbour the triangle's own first corner, and zeros."""
    side = np.stack([sheet, np.roll(sheet, -1, axis=1)], axis=2).reshape(-1, 2)
    low, high = side.min(axis=1), side.max(axis=1)
    order = np.lexsort((high, low))
    second = np.flatnonzero((low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])) + 1
    a, b = order[second - 1], order[second]  # sides, numbered 3 t + i
    at, other = (np.concatenate(pair) for pair in ((a, b), (b, a)))
    t, i = np.divmod(at, 3)
    s, j = np.divmod(other, 3)
    same = sheet[t, i] == sheet[s, j]  # or turned alike, so that the ends of the side come in the other order
    first, last = np.where(same, j, (j + 1) % 3), np.where(same, (j + 1) % 3, j)
    mine = np.stack([corners[t, i], corners[t, (i + 1) % 3], corners[t, (i + 2) % 3]], axis=1)
    theirs = np.stack([corners[s, first], corners[s, last], corners[s, (j + 2) % 3]], axis=1)
    g, both = quadratic_bending.rows_of_sides(mine, theirs)
    vertices = np.concatenate([sheet, np.repeat(sheet[:, :1], 3, axis=1)], axis=1)
    vertices[t, 3 + i] = sheet[s, (j + 2) % 3]
    row = np.zeros((len(sheet), 3, 6))
    for place, values in zip((i, (i + 1) % 3, (i + 2) % 3, 3 + i), (g / both[:, None]).T, strict=True):
        row[t, i, place] = values
    return vertices, row


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return rows.kernels(real, real.module(__name__), CORNERS, lambda of: quadratic_bending.functions(of).project, bends=False)
