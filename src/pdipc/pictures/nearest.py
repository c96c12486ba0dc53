"""Questions to a surface: a field at points near it, and what it hides."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.device import system
from pdipc.device.language import kernel


def values(positions: np.ndarray, triangles: np.ndarray, field: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """(k,): the field at the point of the surface that is nearest to each of the points (k, 3), 0 where none is within `reach`.

    positions: (n, 3); triangles: (m, 3); field: (n,), linear in each triangle.
    """
    if not len(triangles):
        return np.zeros(len(points))
    system.start_warp()
    with wp.ScopedDevice("cpu"):
        mesh = wp.Mesh(wp.array(positions, dtype=wp.vec3f), wp.array(triangles.ravel(), dtype=wp.int32))
        out = wp.zeros(len(points), dtype=wp.float32)
        inputs = [mesh.id, wp.array(field, dtype=wp.float32), wp.array(points, dtype=wp.vec3f), float(reach), out]
        wp.launch(kernels().values, len(points), inputs)
        return out.numpy().astype(np.float64)


def hidden(positions: np.ndarray, triangles: np.ndarray, points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(k,) bool: whether the surface is between the eye (3,) and each of the points (k, 3). positions: (n, 3); triangles: (m, 3)."""
    if not len(triangles):
        return np.zeros(len(points), dtype=bool)
    system.start_warp()
    with wp.ScopedDevice("cpu"):
        mesh = wp.Mesh(wp.array(positions, dtype=wp.vec3f), wp.array(triangles.ravel(), dtype=wp.int32))
        out = wp.zeros(len(points), dtype=wp.int32)
        wp.launch(kernels().hidden, len(points), [mesh.id, wp.array(points, dtype=wp.vec3f), wp.vec3f(*eye), out])
        return out.numpy() != 0


@functools.cache
def kernels() -> SimpleNamespace:
    """Those of `values` and `hidden`, a point each."""
    module = wp.get_module(__name__)
    module.options["enable_backward"] = False

    @kernel(module, "nearest_values")
    def nearest_values(
        mesh: wp.uint64,
        field: wp.array(dtype=wp.float32),
        points: wp.array(dtype=wp.vec3f),
        reach: float,
        out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        found = wp.mesh_query_point_no_sign(mesh, points[i], reach)
        if found.result:
            corners = wp.mesh_get(mesh).indices
            a, b, c = corners[3 * found.face], corners[3 * found.face + 1], corners[3 * found.face + 2]
            out[i] = found.u * field[a] + found.v * field[b] + (1.0 - found.u - found.v) * field[c]

    @kernel(module, "hidden")
    def hidden(mesh: wp.uint64, points: wp.array(dtype=wp.vec3f), eye: wp.vec3f, out: wp.array(dtype=wp.int32)):
        i = wp.tid()
        way = points[i] - eye
        if wp.mesh_query_ray(mesh, eye, way, 0.999).result:
            out[i] = 1

    return SimpleNamespace(values=nearest_values, hidden=hidden)
