"""Constraints on the 3x2 deformation gradient of a triangle: F = [x1 - x0, x2 - x0] Dm^-1, Dm in the triangle's own plane."""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import tets
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import Function, func, kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real, Scalar, Vec2, Vec3

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


def make(kind: str, rest_positions: np.ndarray, triangles: np.ndarray, weight_per_area, axis=None, **data) -> ConstraintSet:
    """Elements whose weight is `weight_per_area` (N/m, one or one a triangle) times their area.

    axis: (3,) a direction at rest, which becomes the first of each triangle's two axes; None for its first side. data: further rest data.
    """
    inverse, area = rest_shape(rest_positions, triangles)
    if axis is not None:
        inverse = inverse @ _turned(rest_positions, triangles, np.asarray(axis, dtype=np.float64))
    gradient = np.zeros((len(triangles), 2, 3))
    gradient[:, :, 1:] = np.swapaxes(inverse, 1, 2)
    gradient[:, :, 0] = -gradient[:, :, 1:].sum(axis=2)
    return make_set(kind, triangles, gradient, np.asarray(weight_per_area) * area, inverse=inverse, **data)


def _turned(rest_positions: np.ndarray, triangles: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(m, 2, 2) from the axes (`axis` in the triangle's plane, and across it) to those of `rest_shape`."""
    x = rest_positions[triangles]
    first = x[:, 1] - x[:, 0]
    first /= np.linalg.norm(first, axis=1)[:, None]
    normal = np.cross(first, x[:, 2] - x[:, 0])
    second = np.cross(normal / np.linalg.norm(normal, axis=1)[:, None], first)
    along = np.stack([first @ axis, second @ axis], axis=1)
    length = np.linalg.norm(along, axis=1)
    bad = np.flatnonzero(length < 1e-3 * np.linalg.norm(axis))
    if len(bad):
        raise ValueError(f"triangle {bad[0]} (vertices {triangles[bad[0]].tolist()}) lies across the axis {axis.tolist()}")
    along /= length[:, None]
    return np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=2)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights."""
    return [wp.array(s.data["inverse"], dtype=real.mat22, device=device.warp)]


@func
def normal(f1: Vec3, f2: Vec3):
    """The unit normal of a deformed triangle; where it has no area, a fixed choice across its longer side."""
    zero, one = type(f1[0])(0.0), type(f1[0])(1.0)
    c = wp.cross(f1, f2)
    size = wp.length(c)
    if size > type(f1[0])(1.0e-12) * (wp.length_sq(f1) + wp.length_sq(f2)):
        return c / size
    u = f1
    if wp.length_sq(f2) > wp.length_sq(f1):
        u = f2
    axis = type(f1)(zero, one, zero)
    if wp.abs(u[1]) > type(f1[0])(0.9) * wp.length(u):
        axis = type(f1)(one, zero, zero)
    c = wp.cross(axis, u)
    if wp.length_sq(c) > zero:
        return wp.normalize(c)
    return type(f1)(zero, zero, one)


@func
def axes(f1: Vec3, f2: Vec3):
    """An angle, singular values and vectors of F, and the normal.

    F^T F = V diag(s^2) V^T, V the rotation by `angle`; s1 and s2 follow from their sum and difference of squares without cancellation.
    """
    n = normal(f1, f2)
    c11 = wp.dot(f1, f1)
    c12 = wp.dot(f1, f2)
    c22 = wp.dot(f2, f2)
    angle = type(c12)(0.5) * wp.atan2(type(c12)(2.0) * c12, c11 - c22)
    c = wp.cos(angle)
    s = wp.sin(angle)
    h1 = c * f1 + s * f2
    h2 = c * f2 - s * f1
    s1 = wp.length(h1)
    s2 = wp.length(h2)
    u1 = wp.normalize(h1)
    u2 = wp.cross(n, u1)
    if s1 < s2:
        u2 = wp.normalize(h2)
        u1 = wp.cross(u2, n)
    return angle, s1, s2, u1, u2, n


@func
def block(k: Vec3, p: Scalar, q: Scalar, tilt: Vec2, u1: Vec3, u2: Vec3, n: Vec3, a: Vec2, b: Vec2):
    """The Hessian between two corners of gradients a and b in the axes of the singular values."""
    h11 = k[0] * a[0] * b[0] + p * a[1] * b[1]
    h12 = k[1] * a[0] * b[1] + q * a[1] * b[0]
    h21 = k[1] * a[1] * b[0] + q * a[0] * b[1]
    h22 = k[2] * a[1] * b[1] + p * a[0] * b[0]
    hn = tilt[0] * a[0] * b[0] + tilt[1] * a[1] * b[1]
    return wp.outer(u1, h11 * u1 + h12 * u2) + wp.outer(u2, h21 * u1 + h22 * u2) + wp.outer(n, hn * n)


@func
def positive_stretch(k: Vec3):
    """What is positive of the symmetric 2x2 matrix of entries 11, 12 and 22."""
    zero, one, half = type(k[0])(0.0), type(k[0])(1.0), type(k[0])(0.5)
    mean = half * (k[0] + k[2])
    spread = wp.sqrt(half * half * (k[0] - k[2]) * (k[0] - k[2]) + k[1] * k[1])
    if not (mean - spread < zero):
        return k
    high = wp.max(mean + spread, zero)
    # high times the projector on its eigenvector
    cosine = zero
    sine = zero
    if spread > zero:
        cosine = half * (k[0] - k[2]) / spread
        sine = k[1] / spread
    return half * high * type(k)(one + cosine, sine, one - cosine)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """Deformation gradients of triangles, their columns f1 and f2, in the scene's precision and in double; and forces on them."""
    scalar, vec3, mat22 = real.scalar, real.vec3, real.mat22
    edges = tets.functions(real)
    mat23 = wp.types.matrix((2, 3), scalar)
    wide = wp.float64
    wide23 = wp.types.matrix((2, 3), wide)

    @func
    def deformation(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), t: wp.vec3i, b: mat22) -> mat23:
        """The columns of F as rows."""
        e1 = edges.edge(base, u, t[0], t[1])
        e2 = edges.edge(base, u, t[0], t[2])
        f1 = b[0, 0] * e1 + b[1, 0] * e2
        f2 = b[0, 1] * e1 + b[1, 1] * e2
        return mat23(f1[0], f1[1], f1[2], f2[0], f2[1], f2[2])

    @func
    def wide_deformation(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), t: wp.vec3i, b: mat22) -> wide23:
        e1 = edges.wide_edge(base, u, t[0], t[1])
        e2 = edges.wide_edge(base, u, t[0], t[2])
        f1 = wide(b[0, 0]) * e1 + wide(b[1, 0]) * e2
        f2 = wide(b[0, 1]) * e1 + wide(b[1, 1]) * e2
        return wide23(f1[0], f1[1], f1[2], f2[0], f2[1], f2[2])

    @func
    def hand_out(b: mat22, d1: vec3, d2: vec3, corner: int, corners_out: wp.array(dtype=vec3)):
        """Forces at three corners from those on the columns of F."""
        g1 = b[0, 0] * d1 + b[0, 1] * d2
        g2 = b[1, 0] * d1 + b[1, 1] * d2
        corners_out[corner] = -(g1 + g2)
        corners_out[corner + 1] = g1
        corners_out[corner + 2] = g2

    return SimpleNamespace(deformation=deformation, wide_deformation=wide_deformation, hand_out=hand_out)


@functools.cache
def writer(real: Real) -> Function:
    """write(...): the blocks of an isotropic energy of the singular values."""
    scalar, vec2, vec3, mat22, mat33 = real.scalar, real.vec2, real.vec3, real.mat22, real.mat33
    zero, half = wp.constant(scalar(0.0)), wp.constant(scalar(0.5))

    # Arguments: an element in its own axes, and where its blocks go.
    @func
    def write(
        stretch: vec3,
        pair: vec2,
        tilted: vec2,
        w: scalar,
        angle: scalar,
        u1: vec3,
        u2: vec3,
        n: vec3,
        b: mat22,
        project: int,
        at: int,
        blocks_out: wp.array(dtype=mat33),
    ):
        """w times the Hessian of an energy of the singular values whose derivatives are stretch, pair and tilted; see `kernels`."""
        k = stretch
        tilt = tilted
        c = wp.cos(angle)
        s = wp.sin(angle)
        # the positive part of the stretch, twist, flip and tilt
        if project != 0:
            k = positive_stretch(k)
        k = w * k
        t = pair[0]
        flip = pair[1]
        if project != 0:
            t = wp.max(t, zero)
            flip = wp.max(flip, zero)
            tilt = vec2(wp.max(tilt[0], zero), wp.max(tilt[1], zero))
        p = half * w * (flip + t)
        q = half * w * (flip - t)
        out = w * tilt
        g1 = vec2(c * b[0, 0] + s * b[0, 1], c * b[0, 1] - s * b[0, 0])
        g2 = vec2(c * b[1, 0] + s * b[1, 1], c * b[1, 1] - s * b[1, 0])
        g0 = -(g1 + g2)
        blocks_out[at + 1] = block(k, p, q, out, u1, u2, n, g0, g1)
        blocks_out[at + 2] = block(k, p, q, out, u1, u2, n, g0, g2)
        blocks_out[at + 4] = block(k, p, q, out, u1, u2, n, g1, g2)

    return write


def kernels(real: Real, module: wp.Module, project_of: Callable, principal: Callable) -> SimpleNamespace:
    """Force, energy and Hessian of triangles of the energy |F - P|^2 / 2.

    project_of(f1, f2): the two columns of P as rows of a 2x3 matrix. principal(s1, s2): see `tets`; the stretch
    W_11, W_12, W_22, then what it costs to twist, to flip, and per axis to tilt out of the plane, W_i / s_i.
    """
    scalar, vec3, mat22, mat33 = real.scalar, real.vec3, real.mat22, real.mat33
    f_of, write = functions(real), writer(real)

    @kernel(module, "force")
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w G^T (p - G x) at the three corners."""
        e = first + wp.tid()
        b = inverse[e]
        f = f_of.wide_deformation(base, u, vertices[e], b)
        d = project_of(wp.vec3d(f[0, 0], f[0, 1], f[0, 2]), wp.vec3d(f[1, 0], f[1, 1], f[1, 2])) - f
        d1 = weight[e] * vec3(scalar(d[0, 0]), scalar(d[0, 1]), scalar(d[0, 2]))
        d2 = weight[e] * vec3(scalar(d[1, 0]), scalar(d[1, 1]), scalar(d[1, 2]))
        f_of.hand_out(b, d1, d2, offset + 3 * e, corners_out)

    @kernel(module, "energy")
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wp.float64),
    ):
        e = first + wp.tid()
        f = f_of.wide_deformation(base, u, vertices[e], inverse[e])
        d = project_of(wp.vec3d(f[0, 0], f[0, 1], f[0, 2]), wp.vec3d(f[1, 0], f[1, 1], f[1, 2])) - f
        energy_out[offset + e] = wp.float64(0.5) * wp.float64(weight[e]) * wp.ddot(d, d)

    @kernel(module, "hessian")
    def hessian(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """The blocks of corners a < b; where `project` says so, positive semidefinite as a whole."""
        e = first + wp.tid()
        f = f_of.deformation(base, u, vertices[e], inverse[e])
        angle, s1, s2, u1, u2, n = axes(vec3(f[0, 0], f[0, 1], f[0, 2]), vec3(f[1, 0], f[1, 1], f[1, 2]))
        k, pair, tilt = principal(s1, s2)
        write(k, pair, tilt, weight[e], angle, u1, u2, n, inverse[e], project[0], offset + 6 * e, blocks_out)

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)
