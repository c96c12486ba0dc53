"""Constraints on the deformation gradient of a tetrahedron: F = [x1 - x0, x2 - x0, x3 - x0] Dm^-1."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.launch import Device
from pdipc.device.precision import Real

CORNERS = 4


def rest_shape(rest_positions: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dm^-1 (t, 3, 3) in 1/m and volumes (t,) in m^3 of the rest shape. Raises ValueError for a tet that is not positive."""
    x = rest_positions[tets]
    edges = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    volume = np.linalg.det(edges) / 6.0
    bad = np.flatnonzero(~(volume > 0.0))
    if len(bad):
        raise ValueError(
            f"tet {bad[0]} (vertices {tets[bad[0]].tolist()}) has the volume {volume[bad[0]]:g} m^3; it must be positive"
        )
    return np.linalg.inv(edges), volume


def make(kind: str, rest_positions: np.ndarray, tets: np.ndarray, weight_per_volume) -> ConstraintSet:
    """Elements whose weight is `weight_per_volume` (Pa, one or one a tet) times their volume."""
    inverse, volume = rest_shape(rest_positions, tets)
    gradient = np.zeros((len(tets), 3, 4))
    gradient[:, :, 1:] = np.swapaxes(inverse, 1, 2)
    gradient[:, :, 0] = -gradient[:, :, 1:].sum(axis=2)
    return make_set(kind, tets, gradient, np.asarray(weight_per_volume) * volume, inverse=inverse)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights."""
    return [wp.array(s.data["inverse"], dtype=real.mat33, device=device.warp)]


def kernels(real: Real, module: wp.Module, project: Callable) -> SimpleNamespace:
    """Force and energy of tets whose deformation gradient is projected by `project(F) -> P`."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33

    @wp.func
    def deformation(x: wp.array(dtype=vec3), q: wp.vec4i, inverse: mat33) -> mat33:
        x0 = x[q[0]]
        return wp.matrix_from_cols(x[q[1]] - x0, x[q[2]] - x0, x[q[3]] - x0) * inverse

    @wp.kernel(module=module)
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec4i),
        inverse: wp.array(dtype=mat33),
        weight: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w G^T (p - G x) at the four corners."""
        e = first + wp.tid()
        b = inverse[e]
        f = deformation(x, vertices[e], b)
        h = (weight[e] * (project(f) - f)) * wp.transpose(b)
        f1 = vec3(h[0, 0], h[1, 0], h[2, 0])
        f2 = vec3(h[0, 1], h[1, 1], h[2, 1])
        f3 = vec3(h[0, 2], h[1, 2], h[2, 2])
        corner = offset + 4 * e
        corners_out[corner] = -(f1 + f2 + f3)
        corners_out[corner + 1] = f1
        corners_out[corner + 2] = f2
        corners_out[corner + 3] = f3

    @wp.kernel(module=module)
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec4i),
        inverse: wp.array(dtype=mat33),
        weight: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=scalar),
    ):
        e = first + wp.tid()
        f = deformation(x, vertices[e], inverse[e])
        d = f - project(f)
        energy_out[offset + e] = scalar(0.5) * weight[e] * wp.ddot(d, d)

    return SimpleNamespace(force=force, energy=energy)
