"""Constraints on the deformation gradient of a tetrahedron: F = [x1 - x0, x2 - x0, x3 - x0] Dm^-1.

Forces and energies are computed in double precision whatever the scene's: what rounding to float32 takes off a strain is a force, 6e-8 of the
stiffness, that a stiff small body does not come to rest under. Hessians need no such care.

A kind brings two functions. `stress(F, mu, lame)` is its first Piola-Kirchhoff stress over the weight. `principal(s, mu, lame)` is its
energy's second derivative in terms of the signed singular values s of F = U diag(s) V^T (Smith, de Goes, Kim 2019, Analytic
Eigensystems for Isotropic Distortion Energies): the 3x3 matrix W_ij over the stretches, and for each pair of axes, named by the
third, what twisting them costs, (W_i + W_j) / (s_i + s_j), and flipping them, (W_i - W_j) / (s_i - s_j). These are the eigenvalues:
projection sets the negative ones to zero.

A kind whose energy is a function of |F|^2 and J = det F alone may bring `invariants(F, mu, lame)`, too: the factors a, b, c, d of

    d^2 W = a |dF|^2 + b (F : dF)^2 + c (dJ)^2 + d d^2 J,

from which the Hessian follows without singular values where it is not projected.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import eigen, rotation
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import func, kernel
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


def make(kind: str, rest_positions: np.ndarray, tets: np.ndarray, weight_per_volume, mu=1.0, lame=0.0) -> ConstraintSet:
    """Elements whose weight is `weight_per_volume` (Pa, one or one a tet) times their volume; mu and lame: of that, without unit."""
    inverse, volume = rest_shape(rest_positions, tets)
    gradient = np.zeros((len(tets), 3, 4))
    gradient[:, :, 1:] = np.swapaxes(inverse, 1, 2)
    gradient[:, :, 0] = -gradient[:, :, 1:].sum(axis=2)
    modulus = np.stack([np.broadcast_to(mu, len(tets)), np.broadcast_to(lame, len(tets))], axis=1)
    return make_set(kind, tets, gradient, np.asarray(weight_per_volume) * volume, inverse=inverse, modulus=modulus)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights."""
    inverse = wp.array(s.data["inverse"], dtype=real.mat33, device=device.warp)
    return [inverse, wp.array(s.data["modulus"], dtype=real.vec2, device=device.warp)]


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """Deformation gradients, and blocks of the Hessian."""
    scalar, vec3, vec4, mat33 = real.scalar, real.vec3, real.vec4, real.mat33
    wide, wide3, wide33 = wp.float64, wp.vec3d, wp.mat33d
    zero = wp.constant(scalar(0.0))

    @func
    def edge(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), a: int, b: int) -> vec3:
        """(base + u)_b - (base + u)_a: differences first, so that small displacements of far positions are not lost."""
        return (base[b] - base[a]) + (u[b] - u[a])

    @func
    def wide_edge(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), a: int, b: int) -> wide3:
        """The same in double precision."""
        e = wide3(wide(base[b][0]) - wide(base[a][0]), wide(base[b][1]) - wide(base[a][1]), wide(base[b][2]) - wide(base[a][2]))
        return e + wide3(wide(u[b][0]) - wide(u[a][0]), wide(u[b][1]) - wide(u[a][1]), wide(u[b][2]) - wide(u[a][2]))

    @func
    def deformation(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), q: wp.vec4i, inverse: mat33) -> mat33:
        return wp.matrix_from_cols(edge(base, u, q[0], q[1]), edge(base, u, q[0], q[2]), edge(base, u, q[0], q[3])) * inverse

    @func
    def widened(a: mat33) -> wide33:
        return wide33(
            wide(a[0, 0]), wide(a[0, 1]), wide(a[0, 2]),
            wide(a[1, 0]), wide(a[1, 1]), wide(a[1, 2]),
            wide(a[2, 0]), wide(a[2, 1]), wide(a[2, 2]),
        )  # fmt: skip

    @func
    def narrowed(a: wide33) -> mat33:
        return mat33(
            scalar(a[0, 0]), scalar(a[0, 1]), scalar(a[0, 2]),
            scalar(a[1, 0]), scalar(a[1, 1]), scalar(a[1, 2]),
            scalar(a[2, 0]), scalar(a[2, 1]), scalar(a[2, 2]),
        )  # fmt: skip

    @func
    def wide_deformation(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), q: wp.vec4i, inverse: mat33) -> wide33:
        e = wp.matrix_from_cols(wide_edge(base, u, q[0], q[1]), wide_edge(base, u, q[0], q[2]), wide_edge(base, u, q[0], q[3]))
        return e * widened(inverse)

    @func
    def singular_values(f: mat33):
        """Signed s, U and V with F = U diag(s) V^T, both rotations: from the polar decomposition."""
        r = rotation.nearest_rotation(f)
        s, v = eigen.symmetric(wp.transpose(r) * f)
        return s, r * v, v

    @func
    def block(stretch: mat33, p: vec3, q: vec3, a: vec3, b: vec3) -> mat33:
        """The Hessian between two corners whose gradients are a and b, all in the axes of the singular values."""
        return mat33(
            stretch[0, 0] * a[0] * b[0] + p[2] * a[1] * b[1] + p[1] * a[2] * b[2],
            stretch[0, 1] * a[0] * b[1] + q[2] * a[1] * b[0],
            stretch[0, 2] * a[0] * b[2] + q[1] * a[2] * b[0],
            stretch[1, 0] * a[1] * b[0] + q[2] * a[0] * b[1],
            stretch[1, 1] * a[1] * b[1] + p[2] * a[0] * b[0] + p[0] * a[2] * b[2],
            stretch[1, 2] * a[1] * b[2] + q[0] * a[2] * b[1],
            stretch[2, 0] * a[2] * b[0] + q[1] * a[0] * b[2],
            stretch[2, 1] * a[2] * b[1] + q[0] * a[1] * b[2],
            stretch[2, 2] * a[2] * b[2] + p[1] * a[0] * b[0] + p[0] * a[1] * b[1],
        )  # fmt: skip

    @func
    def skew(a: vec3) -> mat33:
        return mat33(zero, -a[2], a[1], a[2], zero, -a[0], -a[1], a[0], zero)

    @func
    def plain_block(i: vec4, f: mat33, cofactors: mat33, a: vec3, b: vec3) -> mat33:
        """The same from the factors `i` of the invariants, in the scene's axes: d^2 J = det(dx_a, dx_b, F (a x b))."""
        outer = i[1] * wp.outer(f * a, f * b) + i[2] * wp.outer(cofactors * a, cofactors * b)
        return i[0] * wp.dot(a, b) * wp.identity(n=3, dtype=scalar) + outer - i[3] * skew(f * wp.cross(a, b))

    return SimpleNamespace(
        plain_block=plain_block,
        edge=edge,
        wide_edge=wide_edge,
        deformation=deformation,
        wide_deformation=wide_deformation,
        widened=widened,
        narrowed=narrowed,
        singular_values=singular_values,
        block=block,
    )


def kernels(
    real: Real, module: wp.Module, stress: Callable, principal: Callable, density: Callable, invariants: Callable | None = None
) -> SimpleNamespace:
    """Force, energy and Hessian of tets. stress, and density(F, mu, lame), the energy over the weight: in double precision."""
    scalar, vec2, vec3, mat33 = real.scalar, real.vec2, real.vec3, real.mat33
    f_of = functions(real)
    half, zero, wide = wp.constant(scalar(0.5)), wp.constant(scalar(0.0)), wp.float64
    plain = invariants

    @kernel(module, "force")
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec4i),
        inverse: wp.array(dtype=mat33),
        modulus: wp.array(dtype=vec2),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """-w G^T P(F) at the four corners."""
        e = first + wp.tid()
        f = f_of.wide_deformation(base, u, vertices[e], inverse[e])
        p = stress(f, wide(modulus[e][0]), wide(modulus[e][1]))
        h = f_of.narrowed((-wide(weight[e]) * p) * wp.transpose(f_of.widened(inverse[e])))
        f1 = vec3(h[0, 0], h[1, 0], h[2, 0])
        f2 = vec3(h[0, 1], h[1, 1], h[2, 1])
        f3 = vec3(h[0, 2], h[1, 2], h[2, 2])
        corner = offset + 4 * e
        corners_out[corner] = -(f1 + f2 + f3)
        corners_out[corner + 1] = f1
        corners_out[corner + 2] = f2
        corners_out[corner + 3] = f3

    @kernel(module, "energy")
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec4i),
        inverse: wp.array(dtype=mat33),
        modulus: wp.array(dtype=vec2),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wp.float64),
    ):
        e = first + wp.tid()
        f = f_of.wide_deformation(base, u, vertices[e], inverse[e])
        energy_out[offset + e] = wp.float64(weight[e]) * density(f, wp.float64(modulus[e][0]), wp.float64(modulus[e][1]))

    @kernel(module, "hessian")
    def hessian(
        first: int,
        vertices: wp.array(dtype=wp.vec4i),
        inverse: wp.array(dtype=mat33),
        modulus: wp.array(dtype=vec2),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """The blocks of corners a < b; where `project` says so, positive semidefinite as a whole."""
        e = first + wp.tid()
        b = inverse[e]
        f = f_of.deformation(base, u, vertices[e], b)
        w = weight[e]
        at = offset + 10 * e
        if wp.static(invariants is not None):  # noqa: SIM102  (Warp compiles neither otherwise)
            if project[0] == 0:
                i = w * plain(f, modulus[e][0], modulus[e][1])
                c = rotation.cofactor(f)
                b1 = vec3(b[0, 0], b[0, 1], b[0, 2])
                b2 = vec3(b[1, 0], b[1, 1], b[1, 2])
                b3 = vec3(b[2, 0], b[2, 1], b[2, 2])
                b0 = -(b1 + b2 + b3)
                blocks_out[at + 1] = f_of.plain_block(i, f, c, b0, b1)
                blocks_out[at + 2] = f_of.plain_block(i, f, c, b0, b2)
                blocks_out[at + 3] = f_of.plain_block(i, f, c, b0, b3)
                blocks_out[at + 5] = f_of.plain_block(i, f, c, b1, b2)
                blocks_out[at + 6] = f_of.plain_block(i, f, c, b1, b3)
                blocks_out[at + 8] = f_of.plain_block(i, f, c, b2, b3)
                return
        s, turn, axes = f_of.singular_values(f)
        stretch, twist, flip = principal(s, modulus[e][0], modulus[e][1])
        if project[0] != 0:
            stretch = eigen.positive_part(stretch)
            for k in range(3):
                twist[k] = wp.max(twist[k], zero)
                flip[k] = wp.max(flip[k], zero)
        stretch = w * stretch
        p = vec3()
        q = vec3()
        for k in range(3):
            p[k] = half * w * (flip[k] + twist[k])
            q[k] = half * w * (flip[k] - twist[k])
        g = b * axes  # row c: the gradient of corner c + 1 in the axes of the singular values
        g1 = vec3(g[0, 0], g[0, 1], g[0, 2])
        g2 = vec3(g[1, 0], g[1, 1], g[1, 2])
        g3 = vec3(g[2, 0], g[2, 1], g[2, 2])
        g0 = -(g1 + g2 + g3)
        back = wp.transpose(turn)
        blocks_out[at + 1] = turn * f_of.block(stretch, p, q, g0, g1) * back
        blocks_out[at + 2] = turn * f_of.block(stretch, p, q, g0, g2) * back
        blocks_out[at + 3] = turn * f_of.block(stretch, p, q, g0, g3) * back
        blocks_out[at + 5] = turn * f_of.block(stretch, p, q, g1, g2) * back
        blocks_out[at + 6] = turn * f_of.block(stretch, p, q, g1, g3) * back
        blocks_out[at + 8] = turn * f_of.block(stretch, p, q, g2, g3) * back

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)


def projective(real: Real, module: wp.Module, project: Callable, principal: Callable) -> SimpleNamespace:
    """Kernels of a kind whose energy is |F - P|^2 / 2, P the projection of F."""

    @func
    def stress(f: wp.mat33d, mu: wp.float64, lame: wp.float64) -> wp.mat33d:
        return f - project(f)

    @func
    def density(f: wp.mat33d, mu: wp.float64, lame: wp.float64) -> wp.float64:
        d = f - project(f)
        return wp.float64(0.5) * wp.ddot(d, d)

    return kernels(real, module, stress, principal, density)
