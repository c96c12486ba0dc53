"""A limit of the stretch of cloth: a barrier on each singular value s of F, which no load of a sensible size passes by more than 1 % of it.

With y = (s - 1) / limit, the part of the limit that is used, and t = (y - BEGIN) / (END - BEGIN),

    W = STIFF w limit^2 (END - BEGIN)^2 (psi(t1) + psi(t2)),     psi(t) = -t^2 ln(1 - t) for t > 0,

which begins smoothly at BEGIN and pulls without bound towards END (as the strain limit of Codim-IPC, Li et al. 2021, does). STIFF is a
compromise: where the barrier is weak, loads go to where it is steep, and there Newton and conjugate gradients take many iterations. Measured on a
sheet of 50 N/m held at two corners, on which a ball falls: with STIFF = 1, 10 and 100, 46, 16 and 0 % of the steps do not converge, after 63, 59
and 18 outer iterations a step.
From FIRM short of END on it goes on as a parabola: a script that pulls cloth farther than its limit must find a finite energy.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import triangles
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func, kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real, Scalar

NAME = "strain_limit"
CORNERS = triangles.CORNERS
PROJECTIVE = False
BEGIN, END = 0.9, 1.009  # of the limit: where the barrier begins, and what it does not let pass
STIFF = 100.0  # of w
CLOSE = {"float32": 1e-3, "float64": 1e-6}  # of the limit: stretches that differ by less are taken for one
FIRM = 1e-4  # of what lies between them: how close to END the parabola takes over


def rest(rest_positions: np.ndarray, vertices: np.ndarray, weight_per_area, limit) -> ConstraintSet:
    """Triangles `vertices` (m, 3) that stretch by no more than `limit`, a part of the rest length. weight_per_area: w, N/m."""
    weight = STIFF * np.asarray(weight_per_area)
    return triangles.make(NAME, rest_positions, vertices, weight, limit=np.full(len(vertices), float(limit)))


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights."""
    limit = wp.array(s.data["limit"], dtype=real.scalar, device=device.warp)
    return [*triangles.arguments(device, real, s), limit]


@func
def barrier(s: Scalar, limit: Scalar):
    """W, W' and W'' of one singular value, over w."""
    zero, one, two = type(s)(0.0), type(s)(1.0), type(s)(2.0)
    width = type(s)(wp.static(END - BEGIN))
    t = ((s - one) / limit - type(s)(BEGIN)) / width  # from 0 to 1
    if t <= zero:
        return wp.vector(zero, zero, zero)
    a = wp.min(t, one - type(s)(FIRM))
    log = wp.log(one - a)
    rest = one - a
    value = -a * a * log
    slope = a * (a / rest - two * log)
    bend = -two * log + two * two * a / rest + a * a / (rest * rest)
    more = t - a
    value += more * (slope + more * bend / two)
    slope += more * bend
    return wp.vector(width * width * limit * limit * value, width * limit * slope, bend)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec2, vec3, mat22, mat33 = real.scalar, real.vec2, real.vec3, real.mat22, real.mat33
    module = real.module(__name__)
    f_of, write = triangles.functions(real), triangles.writer(real)
    wide, tiny, close = wp.float64, wp.constant(scalar(1.0e-3)), wp.constant(scalar(CLOSE[real.name]))

    @kernel(module, "force")
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        limit: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """-w dW/dF G at the three corners, dW/dF = sum W_i u_i v_i^T; in double precision, as steep as it is."""
        e = first + wp.tid()
        b = inverse[e]
        f = f_of.wide_deformation(base, u, vertices[e], b)
        angle, s1, s2, u1, u2, _n = triangles.axes(wp.vec3d(f[0, 0], f[0, 1], f[0, 2]), wp.vec3d(f[1, 0], f[1, 1], f[1, 2]))
        t1 = wide(weight[e]) * barrier(s1, wide(limit[e]))[1] * u1
        t2 = wide(weight[e]) * barrier(s2, wide(limit[e]))[1] * u2
        c = wp.cos(angle)
        s = wp.sin(angle)
        d1 = -(c * t1 - s * t2)
        d2 = -(s * t1 + c * t2)
        g1 = wide(b[0, 0]) * d1 + wide(b[0, 1]) * d2
        g2 = wide(b[1, 0]) * d1 + wide(b[1, 1]) * d2
        one = vec3(scalar(g1[0]), scalar(g1[1]), scalar(g1[2]))
        other = vec3(scalar(g2[0]), scalar(g2[1]), scalar(g2[2]))
        corner = offset + 3 * e
        corners_out[corner] = -(one + other)
        corners_out[corner + 1] = one
        corners_out[corner + 2] = other

    @kernel(module, "energy")
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        limit: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wide),
    ):
        e = first + wp.tid()
        f = f_of.wide_deformation(base, u, vertices[e], inverse[e])
        _angle, s1, s2, _u1, _u2, _n = triangles.axes(wp.vec3d(f[0, 0], f[0, 1], f[0, 2]), wp.vec3d(f[1, 0], f[1, 1], f[1, 2]))
        total = barrier(s1, wide(limit[e]))[0] + barrier(s2, wide(limit[e]))[0]
        energy_out[offset + e] = wide(weight[e]) * total

    @kernel(module, "hessian")
    def hessian(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        inverse: wp.array(dtype=mat22),
        limit: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """The six blocks of corners a <= b. W is convex: there is nothing to project."""
        e = first + wp.tid()
        f = f_of.deformation(base, u, vertices[e], inverse[e])
        angle, s1, s2, u1, u2, n = triangles.axes(vec3(f[0, 0], f[0, 1], f[0, 2]), vec3(f[1, 0], f[1, 1], f[1, 2]))
        w1 = barrier(s1, limit[e])
        w2 = barrier(s2, limit[e])
        # (W1 - W2) / (s1 - s2), from the middle where they are close
        flip = barrier(scalar(0.5) * (s1 + s2), limit[e])[2]
        if wp.abs(s1 - s2) > close * limit[e]:
            flip = (w1[1] - w2[1]) / (s1 - s2)
        pair = vec2((w1[1] + w2[1]) / wp.max(s1 + s2, tiny), flip)
        tilt = vec2(w1[1] / wp.max(s1, tiny), w2[1] / wp.max(s2, tiny))
        stretch = vec3(w1[2], scalar(0.0), w2[2])
        write(stretch, pair, tilt, weight[e], angle, u1, u2, n, inverse[e], project[0], offset + 6 * e, blocks_out)

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)
