"""Attachment of a vertex to a point that is fixed or follows a motion: the projection of x is the point.

The points are `Projector.anchors`, in the order of the elements; who moves them uploads them before a step.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real

NAME = "point_attachment"
CORNERS = 1
PROJECTIVE = True


def rest(points: np.ndarray, vertices: np.ndarray, stiffness) -> ConstraintSet:
    """Attaches `vertices` (k,) to `points` (k, 3) m with springs of `stiffness` N/m, one or one each."""
    vertices = np.asarray(vertices).reshape(-1, 1)
    return make_set(NAME, vertices, np.ones((len(vertices), 1, 1)), stiffness, point=np.asarray(points, dtype=np.float64))


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights: the points."""
    return [wp.array(s.data["point"], dtype=real.vec3, device=device.warp)]


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)
    element = wp.types.vector(1, wp.int32)

    @kernel(module)
    def force(
        first: int,
        vertices: wp.array(dtype=element),
        point: wp.array(dtype=vec3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w (p - x)."""
        e = first + wp.tid()
        corners_out[offset + e] = weight[e] * ((point[e] - base[vertices[e][0]]) - u[vertices[e][0]])

    @kernel(module)
    def energy(
        first: int,
        vertices: wp.array(dtype=element),
        point: wp.array(dtype=vec3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wp.float64),
    ):
        e = first + wp.tid()
        v = vertices[e][0]
        d = wp.vec3d()
        for k in range(3):
            d[k] = wp.float64(point[e][k]) - wp.float64(base[v][k]) - wp.float64(u[v][k])
        energy_out[offset + e] = wp.float64(0.5) * wp.float64(weight[e]) * wp.length_sq(d)

    return SimpleNamespace(force=force, energy=energy)
