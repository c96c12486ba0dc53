"""Constraints on the 3x2 deformation gradient of a triangle: F = [x1 - x0, x2 - x0] Dm^-1, Dm in the triangle's own plane."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.launch import Device
from pdipc.device.precision import Real

CORNERS = 3


def rest_shape(rest_positions: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dm^-1 (m, 2, 2) in 1/m and areas (m,) in m^2. Raises ValueError for a triangle without area."""
    x = rest_positions[triangles]
    e1, e2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    length = np.linalg.norm(e1, axis=1)
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    bad = np.flatnonzero(~(area > 0.0))
    if len(bad):
        raise ValueError(
            f"triangle {bad[0]} (vertices {triangles[bad[0]].tolist()}) has the area {area[bad[0]]:g} m^2 at rest; "
            "it must be positive"
        )
    edges = np.zeros((len(triangles), 2, 2))
    edges[:, 0, 0] = length
    edges[:, 0, 1] = np.einsum("ij,ij->i", e1, e2) / length
    edges[:, 1, 1] = 2.0 * area / length
    return np.linalg.inv(edges), area


def make(kind: str, rest_positions: np.ndarray, triangles: np.ndarray, weight_per_area) -> ConstraintSet:
    """Elements whose weight is `weight_per_area` (N/m, one or one a triangle) times their area."""
    inverse, area = rest_shape(rest_positions, triangles)
    gradient = np.zeros((len(triangles), 2, 3))
    gradient[:, :, 1:] = np.swapaxes(inverse, 1, 2)
    gradient[:, :, 0] = -gradient[:, :, 1:].sum(axis=2)
    return make_set(kind, triangles, gradient, np.asarray(weight_per_area) * area, inverse=inverse)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights."""
    return [wp.array(s.data["inverse"], dtype=real.mat22, device=device.warp)]


def kernels(real: Real, module: wp.Module, project: Callable) -> SimpleNamespace:
    """Force and energy of triangles; `project(f1, f2)` gives the two columns of P as rows of a 2x3 matrix."""
    scalar, vec3, mat22 = real.scalar, real.vec3, real.mat22
    mat23 = wp.types.matrix((2, 3), scalar)

    @wp.func
    def difference(x: wp.array(dtype=vec3), t: wp.vec3i, b: mat22) -> mat23:
        """P - F, its columns as rows."""
        e1 = x[t[1]] - x[t[0]]
        e2 = x[t[2]] - x[t[0]]
        f1 = b[0, 0] * e1 + b[1, 0] * e2
        f2 = b[0, 1] * e1 + b[1, 1] * e2
        p = project(f1, f2)
        return mat23(p[0, 0] - f1[0], p[0, 1] - f1[1], p[0, 2] - f1[2], p[1, 0] - f2[0], p[1, 1] - f2[1], p[1, 2] - f2[2])

    @wp.kernel(module=module)
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        weight: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w G^T (p - G x) at the three corners."""
        e = first + wp.tid()
        b = inverse[e]
        d = difference(x, vertices[e], b)
        d1 = weight[e] * vec3(d[0, 0], d[0, 1], d[0, 2])
        d2 = weight[e] * vec3(d[1, 0], d[1, 1], d[1, 2])
        g1 = b[0, 0] * d1 + b[0, 1] * d2
        g2 = b[1, 0] * d1 + b[1, 1] * d2
        corner = offset + 3 * e
        corners_out[corner] = -(g1 + g2)
        corners_out[corner + 1] = g1
        corners_out[corner + 2] = g2

    @wp.kernel(module=module)
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        weight: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=scalar),
    ):
        e = first + wp.tid()
        d = difference(x, vertices[e], inverse[e])
        energy_out[offset + e] = scalar(0.5) * weight[e] * wp.ddot(d, d)

    return SimpleNamespace(force=force, energy=energy)


def normal_function(real: Real):
    """normal(f1, f2): the unit normal of a deformed triangle; where it has no area, a fixed choice across its longer side."""
    scalar, vec3 = real.scalar, real.vec3

    @wp.func
    def normal(f1: vec3, f2: vec3) -> vec3:
        c = wp.cross(f1, f2)
        size = wp.length(c)
        if size > scalar(1.0e-12) * (wp.length_sq(f1) + wp.length_sq(f2)):
            return c / size
        u = f1
        if wp.length_sq(f2) > wp.length_sq(f1):
            u = f2
        axis = vec3(scalar(0.0), scalar(1.0), scalar(0.0))
        if wp.abs(u[1]) > scalar(0.9) * wp.length(u):
            axis = vec3(scalar(1.0), scalar(0.0), scalar(0.0))
        c = wp.cross(axis, u)
        if wp.length_sq(c) > scalar(0.0):
            return wp.normalize(c)
        return vec3(scalar(0.0), scalar(0.0), scalar(1.0))

    return normal
