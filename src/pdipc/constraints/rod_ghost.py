"""What keeps the ghost point of a rod's segment at its distance from the middle of the segment, and across from it.

With e the segment and w from its middle to the ghost point: k / 2 ((|w| - rho)^2 + (w . e / l)^2), l the segment's length at rest. It feels
neither stretch nor twist, so it adds nothing to the rod's stiffness. No local projection belongs to it.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import tets
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import func, kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real

NAME = "rod_ghost"
CORNERS = 3
PROJECTIVE = False


def rest(rest_positions: np.ndarray, vertices: np.ndarray, stiffness) -> ConstraintSet:
    """Segments and their ghost points, `vertices` (s, 3). stiffness: k, N/m, one or one a segment."""
    x = rest_positions[vertices]
    span = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
    length = np.linalg.norm(x[:, 2] - 0.5 * (x[:, 0] + x[:, 1]), axis=1)
    return make_set(NAME, vertices, np.zeros((len(vertices), 1, CORNERS)), stiffness, length=length, span=span)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights: rho (s,) and l (s,), m."""
    return [wp.array(s.data[name], dtype=real.scalar, device=device.warp) for name in ("length", "span")]


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    wide = wp.float64
    module = real.module(__name__)
    edges = tets.functions(real)
    half, one = wp.constant(scalar(0.5)), wp.constant(scalar(1.0))

    @func
    def parts(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), v: wp.vec3i):
        e = edges.edge(base, u, v[0], v[1])
        return e, edges.edge(base, u, v[0], v[2]) - half * e

    @kernel(module)
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        length: wp.array(dtype=scalar),
        span: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        e, w = parts(base, u, vertices[i])
        lean = wp.dot(w, e) / (span[i] * span[i])
        size = wp.max(wp.length(w), scalar(1.0e-30))
        on_w = -weight[i] * ((one - length[i] / size) * w + lean * e)
        on_e = -weight[i] * lean * w
        corners_out[offset + 3 * i] = -on_e - half * on_w
        corners_out[offset + 3 * i + 1] = on_e - half * on_w
        corners_out[offset + 3 * i + 2] = on_w

    @kernel(module)
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        length: wp.array(dtype=scalar),
        span: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wide),
    ):
        i = first + wp.tid()
        v = vertices[i]
        e = edges.wide_edge(base, u, v[0], v[1])
        w = edges.wide_edge(base, u, v[0], v[2]) - wide(0.5) * e
        longer = wp.length(w) - wide(length[i])
        lean = wp.dot(w, e) / wide(span[i])
        energy_out[offset + i] = wide(0.5) * wide(weight[i]) * (longer * longer + lean * lean)

    @kernel(module)
    def hessian(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        length: wp.array(dtype=scalar),
        span: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        i = first + wp.tid()
        e, w = parts(base, u, vertices[i])
        k = weight[i]
        c = k / (span[i] * span[i])
        size = wp.max(wp.length(w), scalar(1.0e-30))
        across = one - length[i] / size
        lean = wp.dot(w, e)
        if project[0] != 0:
            across = wp.max(across, scalar(0.0))
            lean = scalar(0.0)
        identity = mat33(wp.identity(n=3, dtype=scalar))
        ww = k * (across * identity + (one - across) / (size * size) * wp.outer(w, w)) + c * wp.outer(e, e)
        we = c * (wp.outer(e, w) + lean * identity)
        ew = wp.transpose(we)
        ee = c * wp.outer(w, w)
        # e = x1 - x0 and w = g - (x0 + x1) / 2
        blocks_out[offset + 6 * i] = ee + half * (ew + we) + half * half * ww
        blocks_out[offset + 6 * i + 1] = -ee + half * ew - half * we + half * half * ww
        blocks_out[offset + 6 * i + 2] = -ew - half * ww
        blocks_out[offset + 6 * i + 3] = ee - half * (ew + we) + half * half * ww
        blocks_out[offset + 6 * i + 4] = ew - half * ww
        blocks_out[offset + 6 * i + 5] = ww

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)
