"""Bending and twist of rods: two neighbouring segments keep the rotation from the frame of one to that of the other.

A segment's frame D = (d1, d2, t) has its tangent t and, across it, the direction d1 to a ghost point that marks its twist: so twist is a
matter of positions like all else (compare Umetani, Schmidt, Stam 2014). With the rest rotation R from frame a to frame b, the energy

    1 / l (tr C - tr(D_b^T D_a M)),   M = (R C + C R) / 2,   C = diag(GJ / 2, GJ / 2, EI - GJ / 2),

is 2 / l (EI (v1^2 + v2^2) + GJ v3^2), v the vector part of the unit quaternion that is left to rotate: that of a Kirchhoff rod of the
rigidities EI and GJ, with twice the sine of half an angle in place of the angle, as in `rod_bending`. It is never negative, and bounded: twist
between two segments is known up to whole turns only.

**Derivatives.** With e the segment, w from its middle to the ghost point, w_t = w . t and rho = w . d1, the frame turns by

    omega = t x de / |e| + t (d2 . dw - w_t d2 . de / |e|) / rho.

N = D_a M D_b^T; its axial vector n is the torque on a, -n on b, and the second derivative is
|omega_a|^2 tr N - omega_a . N omega_a + (the same of b) + 2 (omega_b . N omega_a - omega_a . omega_b tr N) + torques times what omega changes by.
Projected, the antisymmetric part of N and the last terms are left out, and the rest, (tr N - sym N) of omega_a - omega_b, is made positive.
All in double precision.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import eigen, tets
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import func, kernel, struct
from pdipc.device.launch import Device
from pdipc.device.precision import Real

NAME = "rod_frames"
CORNERS = 5
PROJECTIVE = False
BLOCKS = CORNERS * (CORNERS + 1) // 2


def frames(start: np.ndarray, end: np.ndarray, ghost: np.ndarray) -> np.ndarray:
    """(s, 3, 3): the frames of segments, d1, d2 and t in columns, from their ends and ghost points (s, 3)."""
    t = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    w = ghost - 0.5 * (start + end)
    d1 = w - np.einsum("ij,ij->i", w, t)[:, None] * t
    d1 /= np.linalg.norm(d1, axis=1, keepdims=True)
    return np.stack([d1, np.cross(t, d1), t], axis=2)


def rest(rest_positions: np.ndarray, vertices: np.ndarray, bending_stiffness: float, twist_stiffness: float) -> ConstraintSet:
    """Joints of two segments. vertices: (e, 5): the first vertex, the one that both share, the last, and the ghost points of both.

    bending_stiffness: EI, N m^2. twist_stiffness: GJ, N m^2.
    """
    x = rest_positions[vertices]
    a, b = frames(x[:, 0], x[:, 1], x[:, 3]), frames(x[:, 1], x[:, 2], x[:, 4])
    rotation = np.swapaxes(a, 1, 2) @ b
    stiffness = np.tile([0.5 * twist_stiffness, 0.5 * twist_stiffness, bending_stiffness - 0.5 * twist_stiffness], (len(x), 1))
    length = 0.5 * np.linalg.norm(np.diff(x[:, :3], axis=1), axis=2).sum(axis=1)
    none = np.zeros((len(vertices), 1, CORNERS))  # no row is constant
    with np.errstate(divide="ignore"):
        return make_set(NAME, vertices, none, 1.0 / length, rotation=rotation, stiffness=stiffness)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights: R (e, 3, 3) and the diagonal of C (e, 3), N m^2."""
    rotation = wp.array(s.data["rotation"], dtype=wp.mat33d, device=device.warp)
    return [rotation, wp.array(s.data["stiffness"], dtype=wp.vec3d, device=device.warp)]


wide, wide3, wide4, wide33 = wp.float64, wp.vec3d, wp.vec4d, wp.mat33d
zero, half, one, two = (wp.constant(wide(value)) for value in (0.0, 0.5, 1.0, 2.0))


@struct
class Segment:
    e: wp.vec3d
    w: wp.vec3d
    d: wp.mat33d  # d1, d2 and t in columns
    length: wp.float64  # |e|
    along: wp.float64  # w . t
    across: wp.float64  # w . d1


@func
def column(m: wide33, k: int) -> wide3:
    return wide3(m[0, k], m[1, k], m[2, k])


@func
def segment(e: wide3, away: wide3):
    """Along e, with its ghost at `away` from where it begins, both m."""
    s = Segment()
    s.e = e
    s.w = away - half * s.e
    s.length = wp.length(s.e)
    t = s.e / s.length
    s.along = wp.dot(s.w, t)
    d1 = s.w - s.along * t
    s.across = wp.max(wp.length(d1), wide(1.0e-30))
    d1 = d1 / s.across
    s.d = wp.matrix_from_cols(d1, wp.cross(t, d1), t)
    return s


@func
def coupling(r: wide33, c: wide3) -> wide33:
    """M."""
    return half * (r * wp.diag(c) + wp.diag(c) * r)


@func
def axial(n: wide33) -> wide3:
    return wide3(n[1, 2] - n[2, 1], n[2, 0] - n[0, 2], n[0, 1] - n[1, 0])


@func
def along_segment(s: Segment, torque: wide3) -> wide3:
    """The transpose of omega(de), applied to a torque."""
    t = column(s.d, 2)
    twist = wp.dot(torque, t) * s.along / (s.length * s.across)
    return wp.cross(torque, t) / s.length - twist * column(s.d, 1)


@func
def across_segment(s: Segment, torque: wide3) -> wide3:
    """The transpose of omega(dw), applied to a torque."""
    return (wp.dot(torque, column(s.d, 2)) / s.across) * column(s.d, 1)


@func
def turning(s: Segment):
    """omega(de) and omega(dw) as matrices."""
    t = column(s.d, 2)
    d2 = column(s.d, 1)
    by_edge = wp.skew(t) / s.length - (s.along / (s.length * s.across)) * wp.outer(t, d2)
    return by_edge, wp.outer(t, d2) / s.across


@func
def both(a: wide3, b: wide3) -> wide33:
    return half * (wp.outer(a, b) + wp.outer(b, a))


@func
def bent(s: Segment, torque: wide3):
    """torque . (what omega changes by): the blocks of de de, de dw and dw dw."""
    d1 = column(s.d, 0)
    d2 = column(s.d, 1)
    t = column(s.d, 2)
    t1 = wp.dot(torque, d1)
    t2 = wp.dot(torque, d2)
    t3 = wp.dot(torque, t)
    c = one / s.length
    k = s.along / s.across
    ee = -two * t2 * both(t, d1) + two * t1 * both(t, d2) - k * (t1 * both(d1, d2) + t2 * both(d2, d2))
    ee += t3 * (two * k * both(d2, t) - (one + two * k * k) * both(d1, d2))
    ew = wp.outer(t1 * d1 + t2 * d2, d2) + t3 * (two * k * (wp.outer(d2, d1) + wp.outer(d1, d2)) - two * wp.outer(d2, t))
    ww = (-two * t3 / (s.across * s.across)) * both(d1, d2)
    return (c * c) * ee, (half * c / s.across) * ew, ww


@func
def mirrored(m: wide33) -> wide33:
    """Symmetric: what is below the diagonal as above it."""
    return wide33(
        m[0, 0], m[0, 1], m[0, 2],
        m[0, 1], m[1, 1], m[1, 2],
        m[0, 2], m[1, 2], m[2, 2],
    )  # fmt: skip


@func
def plus(total: wide33, part: wide, to: wide4, a: wide33, b: wide33, c: wide33, d: wide33) -> wide33:
    """total + part (to_0 a + to_1 b + to_2 c + to_3 d), one after the other."""
    total = total + (part * to[0]) * a
    total = total + (part * to[1]) * b
    total = total + (part * to[2]) * c
    return total + (part * to[3]) * d


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    element = wp.types.vector(CORNERS, wp.int32)
    edges = tets.functions(real)
    table = wp.types.matrix((4, CORNERS), wide)

    @func
    def segment_of(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), i: int, j: int, g: int):
        return segment(edges.wide_edge(base, u, i, j), edges.wide_edge(base, u, i, g))

    @func
    def narrow(a: wide3) -> vec3:
        return vec3(scalar(a[0]), scalar(a[1]), scalar(a[2]))

    @kernel(module)
    def force(
        first: int,
        vertices: wp.array(dtype=element),
        rotation: wp.array(dtype=wide33),
        stiffness: wp.array(dtype=wide3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        v = vertices[i]
        a = segment_of(base, u, v[0], v[1], v[3])
        b = segment_of(base, u, v[1], v[2], v[4])
        torque = wide(weight[i]) * axial(a.d * coupling(rotation[i], stiffness[i]) * wp.transpose(b.d))
        ea = along_segment(a, torque)
        wa = across_segment(a, torque)
        eb = along_segment(b, -torque)
        wb = across_segment(b, -torque)
        at = offset + wp.static(CORNERS) * i
        corners_out[at] = narrow(-ea - half * wa)
        corners_out[at + 1] = narrow(ea - half * wa - eb - half * wb)
        corners_out[at + 2] = narrow(eb - half * wb)
        corners_out[at + 3] = narrow(wa)
        corners_out[at + 4] = narrow(wb)

    @kernel(module)
    def energy(
        first: int,
        vertices: wp.array(dtype=element),
        rotation: wp.array(dtype=wide33),
        stiffness: wp.array(dtype=wide3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wide),
    ):
        i = first + wp.tid()
        v = vertices[i]
        a = segment_of(base, u, v[0], v[1], v[3])
        b = segment_of(base, u, v[1], v[2], v[4])
        # tr C - tr N as a sum of squares, which loses nothing near rest
        forward = b.d - a.d * rotation[i]
        backward = a.d - b.d * wp.transpose(rotation[i])
        total = zero
        for k in range(3):
            lengths = wp.length_sq(column(forward, k)) + wp.length_sq(column(backward, k))
            total += half * half * stiffness[i][k] * lengths
        energy_out[offset + i] = wide(weight[i]) * total

    @kernel(module)
    def hessian(
        first: int,
        vertices: wp.array(dtype=element),
        rotation: wp.array(dtype=wide33),
        stiffness: wp.array(dtype=wide3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """The fifteen blocks of corners a <= b; where `project` says so, positive semidefinite as a whole."""
        i = first + wp.tid()
        v = vertices[i]
        a = segment_of(base, u, v[0], v[1], v[3])
        b = segment_of(base, u, v[1], v[2], v[4])
        n = wide(weight[i]) * a.d * coupling(rotation[i], stiffness[i]) * wp.transpose(b.d)
        own = wp.trace(n) * wp.identity(n=3, dtype=wide) - half * (n + wp.transpose(n))
        cross = n - wp.trace(n) * wp.identity(n=3, dtype=wide)  # of omega_b, omega_a
        if project[0] != 0:
            values, axes = eigen.symmetric(own)
            own = wide33()
            for k in range(3):
                own += wp.max(values[k], zero) * wp.outer(column(axes, k), column(axes, k))
            cross = -own
        jea, jwa = turning(a)
        jeb, jwb = turning(b)
        # of e_a, w_a, e_b and w_b
        h00 = wp.transpose(jea) * own * jea
        h01 = wp.transpose(jea) * own * jwa
        h11 = wp.transpose(jwa) * own * jwa
        h22 = wp.transpose(jeb) * own * jeb
        h23 = wp.transpose(jeb) * own * jwb
        h33 = wp.transpose(jwb) * own * jwb
        h02 = wp.transpose(jea) * wp.transpose(cross) * jeb
        h03 = wp.transpose(jea) * wp.transpose(cross) * jwb
        h12 = wp.transpose(jwa) * wp.transpose(cross) * jeb
        h13 = wp.transpose(jwa) * wp.transpose(cross) * jwb
        if project[0] == 0:
            torque = axial(n)
            ee, ew, ww = bent(a, -torque)
            h00 += ee
            h01 += ew
            h11 += ww
            ee, ew, ww = bent(b, torque)
            h22 += ee
            h23 += ew
            h33 += ww
        # e_a, w_a, e_b, w_b of the five corners
        of = table(
            -one, one, zero, zero, zero,
            -half, -half, zero, one, zero,
            zero, -one, one, zero, zero,
            zero, -half, -half, zero, one,
        )  # fmt: skip
        begin = offset + wp.static(BLOCKS) * i
        p, q = int(0), int(0)
        for at in range(begin, begin + wp.static(BLOCKS)):  # not unrolled: fifteen times this takes long to compile
            to = wide4(of[0, q], of[1, q], of[2, q], of[3, q])
            total = plus(wide33(), of[0, p], to, mirrored(h00), h01, h02, h03)
            total = plus(total, of[1, p], to, wp.transpose(h01), mirrored(h11), h12, h13)
            total = plus(total, of[2, p], to, wp.transpose(h02), wp.transpose(h12), mirrored(h22), h23)
            total = plus(total, of[3, p], to, wp.transpose(h03), wp.transpose(h13), wp.transpose(h23), mirrored(h33))
            blocks_out[at] = edges.narrowed(total)
            q += 1
            if q == wp.static(CORNERS):
                p += 1
                q = p

    return SimpleNamespace(force=force, energy=energy, hessian=hessian)
