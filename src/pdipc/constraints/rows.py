"""Constraints with a single row: G x = sum_c g_c x_c is one 3-vector, and its projection has a given length (or is zero)."""

from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from pdipc.constraints.base import ConstraintSet
from pdipc.device.launch import Device
from pdipc.device.precision import Real


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights: g (e, c) and the rest length (e,) of G x."""
    corners = s.vertices.shape[1]
    g = wp.array(s.gradient[:, 0, :], dtype=wp.types.vector(corners, real.scalar), device=device.warp)
    return [g, wp.array(s.data["length"], dtype=real.scalar, device=device.warp)]


def keep_length(real: Real) -> Callable:
    """project(v, length): the nearest vector of that length; a fixed direction where v = 0."""
    scalar, vec3 = real.scalar, real.vec3

    @wp.func
    def project(v: vec3, length: scalar) -> vec3:
        size = wp.length(v)
        if size > scalar(0.0):
            return v * (length / size)
        return vec3(length, scalar(0.0), scalar(0.0))

    return project


def kernels(real: Real, module: wp.Module, corners: int, project: Callable) -> SimpleNamespace:
    """Force and energy; `project(G x, length)` is the local projection."""
    scalar, vec3 = real.scalar, real.vec3
    row = wp.types.vector(corners, scalar)
    element = wp.types.vector(corners, wp.int32)
    count = wp.constant(corners)

    @wp.func
    def combined(x: wp.array(dtype=vec3), v: element, g: row) -> vec3:
        total = vec3()
        for c in range(count):
            total += g[c] * x[v[c]]
        return total

    @wp.kernel(module=module)
    def force(
        first: int,
        vertices: wp.array(dtype=element),
        g: wp.array(dtype=row),
        length: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w G^T (p - G x) at the corners."""
        e = first + wp.tid()
        q = combined(x, vertices[e], g[e])
        d = weight[e] * (project(q, length[e]) - q)
        for c in range(count):
            corners_out[offset + count * e + c] = g[e][c] * d

    @wp.kernel(module=module)
    def energy(
        first: int,
        vertices: wp.array(dtype=element),
        g: wp.array(dtype=row),
        length: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=scalar),
    ):
        e = first + wp.tid()
        q = combined(x, vertices[e], g[e])
        energy_out[offset + e] = scalar(0.5) * weight[e] * wp.length_sq(q - project(q, length[e]))

    return SimpleNamespace(force=force, energy=energy)
