"""Constraints with a single row: G x = sum_c g_c x_c is one 3-vector, and its projection has a given length (or is zero)."""

from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from pdipc.constraints import tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func, kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.device.precision import real as real_of


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights: g (e, c) and the rest length (e,) of G x."""
    corners = s.vertices.shape[1]
    g = wp.array(s.gradient[:, 0, :], dtype=wp.types.vector(corners, real.scalar), device=device.warp)
    return [g, wp.array(s.data["length"], dtype=real.scalar, device=device.warp)]


def keep_length(real: Real) -> Callable:
    """project(v, length): the nearest vector of that length; a fixed direction where v = 0."""
    scalar, vec3 = real.scalar, real.vec3

    @func
    def project(v: vec3, length: scalar) -> vec3:
        size = wp.length(v)
        if size > scalar(0.0):
            return v * (length / size)
        return vec3(length, scalar(0.0), scalar(0.0))

    return project


def limit_length(real: Real) -> Callable:
    """project(v, length): the nearest vector that is no longer."""
    scalar, vec3 = real.scalar, real.vec3

    @func
    def project(v: vec3, length: scalar) -> vec3:
        size = wp.length(v)
        if size > length:
            return v * (length / size)
        return v

    return project


def kernels(
    real: Real,
    module: wp.Module,
    corners: int,
    project_of: Callable[[Real], Callable],
    bends: bool = True,
    pulls: bool = False,
) -> SimpleNamespace:
    """Force and energy; project_of(real) makes project(G x, length), the local projection.

    bends: whether the projection depends on G x; without, the Hessian is w G^T G, which does not change, and no kernel is made.
    pulls: whether what is shorter than its length is slack, as with `limit_length`.
    """
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    row = wp.types.vector(corners, scalar)
    element = wp.types.vector(corners, wp.int32)
    count = wp.constant(corners)
    blocks = wp.constant(corners * (corners + 1) // 2)
    project = project_of(real_of("float64"))
    edges = tets.functions(real)
    wide = wp.float64
    slackens = wp.constant(1 if pulls else 0)

    @func
    def combined(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), v: element, g: row) -> vec3:
        """G x; the g_c add up to zero, so it is a sum over differences."""
        total = vec3()
        for c in range(1, count):
            total += g[c] * edges.edge(base, u, v[0], v[c])
        return total

    @func
    def wide_combined(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), v: element, g: row) -> wp.vec3d:
        total = wp.vec3d()
        for c in range(1, count):
            total += wide(g[c]) * edges.wide_edge(base, u, v[0], v[c])
        return total

    @kernel(module, "force")
    def force(
        first: int,
        vertices: wp.array(dtype=element),
        g: wp.array(dtype=row),
        length: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w G^T (p - G x) at the corners."""
        e = first + wp.tid()
        q = wide_combined(base, u, vertices[e], g[e])
        d = project(q, wide(length[e])) - q
        pull = weight[e] * vec3(scalar(d[0]), scalar(d[1]), scalar(d[2]))
        for c in range(count):
            corners_out[offset + count * e + c] = g[e][c] * pull

    @kernel(module, "energy")
    def energy(
        first: int,
        vertices: wp.array(dtype=element),
        g: wp.array(dtype=row),
        length: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wp.float64),
    ):
        e = first + wp.tid()
        q = wide_combined(base, u, vertices[e], g[e])
        energy_out[offset + e] = wide(0.5) * wide(weight[e]) * wp.length_sq(q - project(q, wide(length[e])))

    if not bends:
        return SimpleNamespace(force=force, energy=energy)

    @kernel(module, "hessian")
    def hessian(
        first: int,
        vertices: wp.array(dtype=element),
        g: wp.array(dtype=row),
        length: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """w g_a g_b (d d^T + (1 - L / |q|) (I - d d^T)), q = G x and d = q / |q|: one along it, and
        across what tension gives, or compression takes, which projection drops."""
        e = first + wp.tid()
        q = combined(base, u, vertices[e], g[e])
        size = wp.length(q)
        h = mat33(wp.identity(n=3, dtype=scalar))
        if size > scalar(0.0):
            d = q / size
            across = scalar(1.0) - length[e] / size
            if project[0] != 0:
                across = wp.max(scalar(0.0), across)
            h = across * h + (scalar(1.0) - across) * wp.outer(d, d)
        elif length[e] > scalar(0.0):
            h = mat33()
        if slackens == 1 and size < length[e]:
            h = mat33()
        at = offset + blocks * e
        for a in range(count):
            for b in range(a, count):
                blocks_out[at] = (weight[e] * g[e][a] * g[e][b]) * h
                at += 1

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)
