"""Woven cloth: stiffer along its warp or its weft, and soft or stiff in shear.

With f1 and f2 the columns of F along warp and weft, e_i = |f_i| - 1 and g = f1 . f2,

    W = (C11 e1^2 + 2 C12 e1 e2 + C22 e2^2 + S g^2) / 2,

for small strains the orthotropic law of plane stress (the strains are those of Baraff and Witkin 1998). Hessian: C on the two lengths, which is
positive; the tension s_i / |f_i| across each thread and S g (f1, f2), of which only the positive part is kept where that is asked for.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import triangles
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real

NAME = "woven"
CORNERS = triangles.CORNERS
PROJECTIVE = False


def rest(rest_positions: np.ndarray, vertices: np.ndarray, stiffness, warp) -> ConstraintSet:
    """Triangles `vertices` (m, 3). stiffness: C11, C22, C12, S, N/m; warp: (3,) its direction at rest, in any unit.

    Raises ValueError for triangles without area, or that lie across the warp.
    """
    law = np.tile(np.asarray(stiffness, dtype=np.float64), (len(vertices), 1))
    return triangles.make(NAME, rest_positions, vertices, 1.0, axis=warp, law=law)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights."""
    return [*triangles.arguments(device, real, s), wp.array(s.data["law"], dtype=real.vec4, device=device.warp)]


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec2, vec3, vec4, mat22, mat33 = real.scalar, real.vec2, real.vec3, real.vec4, real.mat22, real.mat33
    module = real.module(__name__)
    f_of = triangles.functions(real)
    wide, one, zero, half = wp.float64, wp.constant(scalar(1.0)), wp.constant(scalar(0.0)), wp.constant(scalar(0.5))
    least = wp.constant(scalar(1.0e-6))

    @kernel(module, "force")
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        law: wp.array(dtype=vec4),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        e = first + wp.tid()
        b = inverse[e]
        c = law[e]
        f = f_of.wide_deformation(base, u, vertices[e], b)
        f1 = wp.vec3d(f[0, 0], f[0, 1], f[0, 2])
        f2 = wp.vec3d(f[1, 0], f[1, 1], f[1, 2])
        l1 = wp.max(wp.length(f1), wide(least))
        l2 = wp.max(wp.length(f2), wide(least))
        e1 = l1 - wide(1.0)
        e2 = l2 - wide(1.0)
        shear = wide(c[3]) * wp.dot(f1, f2)
        p1 = (wide(c[0]) * e1 + wide(c[2]) * e2) / l1 * f1 + shear * f2
        p2 = (wide(c[1]) * e2 + wide(c[2]) * e1) / l2 * f2 + shear * f1
        d1 = -weight[e] * vec3(scalar(p1[0]), scalar(p1[1]), scalar(p1[2]))
        d2 = -weight[e] * vec3(scalar(p2[0]), scalar(p2[1]), scalar(p2[2]))
        f_of.hand_out(b, d1, d2, offset + 3 * e, corners_out)

    @kernel(module, "energy")
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        law: wp.array(dtype=vec4),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wide),
    ):
        e = first + wp.tid()
        c = law[e]
        f = f_of.wide_deformation(base, u, vertices[e], inverse[e])
        f1 = wp.vec3d(f[0, 0], f[0, 1], f[0, 2])
        f2 = wp.vec3d(f[1, 0], f[1, 1], f[1, 2])
        e1 = wp.length(f1) - wide(1.0)
        e2 = wp.length(f2) - wide(1.0)
        g = wp.dot(f1, f2)
        total = wide(c[0]) * e1 * e1 + wide(c[1]) * e2 * e2 + wide(2.0) * wide(c[2]) * e1 * e2 + wide(c[3]) * g * g
        energy_out[offset + e] = wide(0.5) * wide(weight[e]) * total

    @kernel(module, "hessian")
    def hessian(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        law: wp.array(dtype=vec4),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """The six blocks of corners a <= b."""
        e = first + wp.tid()
        b = inverse[e]
        c = law[e]
        f = f_of.deformation(base, u, vertices[e], b)
        f1 = vec3(f[0, 0], f[0, 1], f[0, 2])
        f2 = vec3(f[1, 0], f[1, 1], f[1, 2])
        l1 = wp.max(wp.length(f1), least)
        l2 = wp.max(wp.length(f2), least)
        n1 = f1 / l1
        n2 = f2 / l2
        t1 = (c[0] * (l1 - one) + c[2] * (l2 - one)) / l1
        t2 = (c[1] * (l2 - one) + c[2] * (l1 - one)) / l2
        shear = c[3] * wp.dot(f1, f2)
        twist = zero  # of [[0, I], [I, 0]] the positive part is [[I, I], [I, I]] / 2, of its negative [[I, -I], [-I, I]] / 2
        if project[0] != 0:
            t1 = wp.max(t1, zero)
            t2 = wp.max(t2, zero)
            twist = half * wp.abs(shear)
            shear = half * shear
        unit = mat33(wp.identity(n=3, dtype=scalar))
        h11 = (c[0] - t1) * wp.outer(n1, n1) + (t1 + twist) * unit + c[3] * wp.outer(f2, f2)
        h22 = (c[1] - t2) * wp.outer(n2, n2) + (t2 + twist) * unit + c[3] * wp.outer(f1, f1)
        h12 = c[2] * wp.outer(n1, n2) + shear * unit + c[3] * wp.outer(f2, f1)
        h21 = wp.transpose(h12)
        w = weight[e]
        g1 = vec2(b[0, 0], b[0, 1])
        g2 = vec2(b[1, 0], b[1, 1])
        g0 = -(g1 + g2)
        at = offset + 6 * e
        for i in range(3):
            p = g0
            if i == 1:
                p = g1
            if i == 2:
                p = g2
            for j in range(i, 3):
                q = g0
                if j == 1:
                    q = g1
                if j == 2:
                    q = g2
                blocks_out[at] = w * (p[0] * q[0] * h11 + p[1] * q[1] * h22 + p[0] * q[1] * h12 + p[1] * q[0] * h21)
                at += 1

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)
