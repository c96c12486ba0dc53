"""What a closed sheet holds: a constant pressure, a gas of a given amount, or a liquid that resists a change of volume.

Each closed part of a surface is a cavity of volume V, and what it holds pushes outward with the pressure

    q(V) = a + b (V0 / V)^g + k (1 - V / V0),      W(V) = - integral of q from V0 to V,

a: constant, Pa; b and g: a gas and its exponent (g = 1: p V is constant); k: bulk modulus of a liquid, Pa. The force on a vertex is q dV/dx,
a sixth of the cross products of the triangles around it, so that on a closed surface forces and torques add up to zero.

Hessian: W'' (dV/dx)(dV/dx)^T - q d^2V/dx^2. The first couples all vertices of a cavity. It is one direction, never negative, and is no part
of the assembled matrix: `Cavities` multiplies with it. The second is a 3x3 block an edge, [x_k]_x / 6, without a sign: it is left out where
the Hessian is to be positive semidefinite. What is left then, mass and membranes and W'' >= 0, is positive, so that its step descends.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pdipc.constraints import tets
from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import filled, func, kernel, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.device.sums import BodySums

NAME = "enclosed_volume"
CORNERS = 3
PROJECTIVE = False
LAW = 5  # a, b, g, k, V0
LEAST = 1.0e-6  # of V0: no pressure is computed for less


def cavities(triangles: np.ndarray) -> np.ndarray:
    """(m,) the connected part of each of triangles (m, 3), named by its first vertex."""
    used, local = np.unique(triangles, return_inverse=True)
    local = local.reshape(-1, 3)
    sides = local[:, [[0, 1], [1, 2]]].reshape(-1, 2).T
    _, part = connected_components(coo_matrix((np.ones(sides.shape[1]), sides), shape=(len(used), len(used))), directed=False)
    _, first = np.unique(part, return_index=True)
    return used[first[part[local[:, 0]]]].astype(np.int32)


def volumes(positions: np.ndarray, triangles: np.ndarray, cavity: np.ndarray) -> np.ndarray:
    """(m,) m^3: for each of triangles (m, 3) the volume of the cavity that it is part of; negative where it faces inward."""
    names, number = np.unique(cavity, return_inverse=True)
    corners = positions[triangles] - positions[cavity][:, None]
    parts = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    return np.bincount(number.ravel(), weights=parts, minlength=len(names))[number.ravel()]


def rest(triangles: np.ndarray, cavity: np.ndarray, law: np.ndarray) -> ConstraintSet:
    """Cavities bounded by triangles (m, 3), which face outward. cavity: (m,) see `cavities`; law: (m, 5) a, b, g, k, V0 of its cavity."""
    law = np.asarray(law, dtype=np.float64).reshape(-1, LAW)
    return make_set(NAME, triangles, np.zeros((len(triangles), 1, 3)), 1.0, cavity=np.asarray(cavity), law=law)


wide = wp.float64
Law = wp.types.vector(LAW, wide)
one, least = wp.constant(wide(1.0)), wp.constant(wide(LEAST))


@func
def overpressure(volume: wide, law: Law) -> wide:
    part = wp.max(volume / law[4], least)
    return law[0] + law[1] * wp.pow(part, -law[2]) + law[3] * (one - part)


@func
def stiffness(volume: wide, law: Law) -> wide:
    part = wp.max(volume / law[4], least)
    return (law[1] * law[2] * wp.pow(part, -law[2] - one) + law[3]) / law[4]


@func
def log1p(x: wide) -> wide:
    """ln(1 + x) as exact as x (Kahan)."""
    y = one + x
    if y == one:
        return x
    return wp.log(y) * x / (y - one)


@func
def expm1(x: wide) -> wide:
    y = wp.exp(x)
    if y == one or y - one == -one:
        return wp.where(y == one, x, -one)
    return (y - one) * x / wp.log(y)


@func
def pressure_energy(volume: wide, reference: wide, law: Law) -> wide:
    """W(volume) - W(reference), as exact as the change of volume: gas and what it works against all but cancel."""
    r = reference / law[4]
    change = wp.max(volume / reference, least) - one
    grown = log1p(change)
    gas = grown
    if law[2] != one:
        gas = expm1((one - law[2]) * grown) / (one - law[2])
    gas = law[1] * wp.pow(r, -law[2]) * gas
    liquid = wide(0.5) * law[3] * change * (r * change + wide(2.0) * (r - one))
    return reference * (liquid - law[0] * change - gas)


@functools.cache
def held(real: Real) -> Any:
    """A struct: the cavities of the triangles, and what they hold."""
    return struct_of(
        "Held",
        __name__,
        number=wp.array(dtype=wp.int32),  # of each triangle, its cavity
        leader=wp.array(dtype=wp.int32),  # of each triangle, the cavity that it stands for, -1 for none
        first=wp.array(dtype=wp.int32),  # of each cavity, its first vertex
        pressure=wp.array(dtype=real.scalar),  # Pa
        energy=wp.array(dtype=wide),  # J
    )


class Cavities:
    """Volumes and pressures of all cavities of a set, and their part of the Newton matrix that no block holds.

    reference: (c,) m^3, the volumes at which energies are zero; 0 for V0. Newton's method counts from the last iterate, see `_keep_energies` there.
    names: (c,) first vertices. laws: (c,) see the module; assign to it to change them. volume: (c,) float64, m^3; pressure: (c,), Pa.
    held: what kernels take. diagonal: None, it adds nothing to the preconditioner: one direction more costs conjugate gradients an iteration or two.
    """

    diagonal = rows = None
    capacity = 0

    def __init__(self, device: Device, real: Real, n: int, s: ConstraintSet):
        self.device, self.real, self._kernels = device, real, kernels(real)
        self.names, first, number = np.unique(s.data["cavity"], return_index=True, return_inverse=True)
        number, count = number.ravel(), len(self.names)

        def upload(values: np.ndarray, dtype) -> wp.array:
            return wp.array(values, dtype=dtype, device=device.warp)

        def zeros(dtype, size=count) -> wp.array:
            return wp.zeros(size, dtype=dtype, device=device.warp)

        leader = np.full(len(s), -1)
        leader[first] = np.arange(count)
        self.vertices = upload(s.vertices, wp.vec3i)
        self.number, self.leader = upload(number.astype(np.int32), wp.int32), upload(leader.astype(np.int32), wp.int32)
        self.first = upload(self.names.astype(np.int32), wp.int32)
        self.laws = upload(s.data["law"][first], Law)
        self.volume, self.pressure, self.energy = zeros(wp.float64), zeros(real.scalar), zeros(wp.float64)
        self.reference = zeros(wp.float64)
        self.held = filled(held(real), self)
        self.stiffness, self._stiffness, self._dots = zeros(real.scalar), zeros(real.scalar), zeros(wp.float64)
        self._parts = zeros(wp.float64, len(s))
        self._volumes = BodySums(device, [number], count)
        # the vertices of cavities, and the triangles around each
        corner = s.vertices.ravel()
        order = np.argsort(corner, kind="stable")
        members, starts = np.unique(corner[order], return_index=True)
        of = np.empty(n, dtype=np.int32)
        of[corner] = np.repeat(number, 3)
        self._count = len(members)
        self._members, self._of = upload(members.astype(np.int32), wp.int32), upload(of[members], wp.int32)
        self._starts = upload(np.append(starts, len(corner)).astype(np.int32), wp.int32)
        self._around = upload((order // 3).astype(np.int32), wp.int32)
        self._gradient, self._products = zeros(real.vec3, self._count), zeros(wp.float64, self._count)
        self._sums = BodySums(device, [of[members]], count)

    def measure(self, base: wp.array, u: wp.array) -> None:
        """Launches volumes, pressures and energies at x = base + u."""
        k, device = self._kernels, self.device
        inputs = [self.vertices, self.held, base, u, self._parts]
        device.launch(k.part, len(self.vertices), inputs, grain=16)
        self._volumes.add([self._parts], self.volume)
        found = [self.pressure, self._stiffness, self.energy]
        device.launch_serial(k.judge, [len(self.names), self.volume, self.laws, self.reference, *found])

    def refer(self, base: wp.array, u: wp.array) -> None:
        """Launches the reference of energies: the volumes at x = base + u."""
        self.measure(base, u)
        self.device.copy(self.reference, self.volume)

    def differentiate(self, base: wp.array, u: wp.array) -> None:
        """Launches W'' and dV/dx at x = base + u, what `apply` multiplies with."""
        self.measure(base, u)
        self.device.copy(self.stiffness, self._stiffness)
        inputs = [self._starts, self._around, self.vertices, base, u, self._gradient]
        self.device.launch(self._kernels.gather_gradient, self._count, inputs, grain=32)

    def apply(self, p: wp.array, y: wp.array) -> None:
        """y += W'' dV/dx (dV/dx . p). Recordable."""
        k, device = self._kernels, self.device
        device.launch(k.multiply, self._count, [self._members, self._gradient, p, self._products], grain=4)
        self._sums.add([self._products], self._dots)
        inputs = [self._members, self._of, self._gradient, self.stiffness, self._dots, y]
        device.launch(k.spread, self._count, inputs, grain=4)

    def couple(self, modes) -> None:
        """Nothing: see `diagonal`."""

    def operand(self) -> None:
        """None: there is `apply`."""


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """None: the kernels take the arrays of `Cavities`, which the projector makes."""
    return []


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33, Held = real.scalar, real.vec3, real.mat33, held(real)
    module = real.module(__name__)
    edges = tets.functions(real)
    sixth = wp.constant(scalar(1.0 / 6.0))

    @func
    def area_normal(base: wp.array(dtype=vec3), u: wp.array(dtype=vec3), t: wp.vec3i) -> vec3:
        """Twice the area, along the normal."""
        return wp.cross(edges.edge(base, u, t[0], t[1]), edges.edge(base, u, t[0], t[2]))

    @func
    def skew(a: vec3) -> mat33:
        zero = scalar(0.0)
        return mat33(zero, -a[2], a[1], a[2], zero, -a[0], -a[1], a[0], zero)

    @kernel(module)
    def part(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        o: Held,
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        volume_out: wp.array(dtype=wide),
    ):
        """Volume between a triangle and the first vertex of its cavity."""
        e = first + wp.tid()
        t = vertices[e]
        origin = o.first[o.number[e]]
        a = edges.wide_edge(base, u, origin, t[0])
        b = edges.wide_edge(base, u, origin, t[1])
        c = edges.wide_edge(base, u, origin, t[2])
        volume_out[e] = wp.dot(a, wp.cross(b, c)) / wide(6.0)

    @kernel(module)
    def judge(
        first: int,
        count: int,
        volume: wp.array(dtype=wide),
        laws: wp.array(dtype=Law),
        reference: wp.array(dtype=wide),
        pressure_out: wp.array(dtype=scalar),
        stiffness_out: wp.array(dtype=scalar),
        energy_out: wp.array(dtype=wide),
    ):
        for c in range(count):
            pressure_out[c] = scalar(overpressure(volume[c], laws[c]))
            stiffness_out[c] = scalar(stiffness(volume[c], laws[c]))
            energy_out[c] = pressure_energy(volume[c], wp.where(reference[c] > wide(0.0), reference[c], laws[c][4]), laws[c])

    @kernel(module)
    def force(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        o: Held,
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """q n / 3 at the three corners, n the area along the normal."""
        e = first + wp.tid()
        f = sixth * o.pressure[o.number[e]] * area_normal(base, u, vertices[e])
        for c in range(3):
            corners_out[offset + 3 * e + c] = f

    @kernel(module)
    def energy(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        o: Held,
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wide),
    ):
        """W of a cavity, on its first triangle."""
        e = first + wp.tid()
        energy_out[offset + e] = wide(0.0)
        if o.leader[e] >= 0:
            energy_out[offset + e] = o.energy[o.leader[e]]

    @kernel(module)
    def hessian(
        first: int,
        vertices: wp.array(dtype=wp.vec3i),
        o: Held,
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        project: wp.array(dtype=wp.int32),
        blocks_out: wp.array(dtype=mat33),
    ):
        """-q d^2V/dx^2 of the volume above the cavity's first vertex, which drops out of the sum over a closed surface."""
        e = first + wp.tid()
        at = offset + 6 * e
        for k in range(6):
            blocks_out[at + k] = mat33()
        if project[0] == 0:
            t = vertices[e]
            first_of_cavity = o.first[o.number[e]]
            q = sixth * o.pressure[o.number[e]]
            blocks_out[at + 1] = q * skew(edges.edge(base, u, first_of_cavity, t[2]))
            blocks_out[at + 2] = -q * skew(edges.edge(base, u, first_of_cavity, t[1]))
            blocks_out[at + 4] = q * skew(edges.edge(base, u, first_of_cavity, t[0]))

    @kernel(module)
    def gather_gradient(
        first: int,
        starts: wp.array(dtype=wp.int32),
        around: wp.array(dtype=wp.int32),
        vertices: wp.array(dtype=wp.vec3i),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        gradient_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        total = vec3()
        for k in range(starts[i], starts[i + 1]):
            total += area_normal(base, u, vertices[around[k]])
        gradient_out[i] = sixth * total

    @kernel(module)
    def multiply(
        first: int,
        members: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        product_out: wp.array(dtype=wide),
    ):
        i = first + wp.tid()
        product_out[i] = wide(wp.dot(gradient[i], p[members[i]]))

    @kernel(module)
    def spread(
        first: int,
        members: wp.array(dtype=wp.int32),
        cavity: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=vec3),
        stiffness: wp.array(dtype=scalar),
        dots: wp.array(dtype=wide),
        y: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        c = cavity[i]
        y[members[i]] = y[members[i]] + scalar(wide(stiffness[c]) * dots[c]) * gradient[i]

    return SimpleNamespace(
        part=part,
        judge=judge,
        force=force,
        energy=energy,
        hessian=hessian,
        gather_gradient=gather_gradient,
        multiply=multiply,
        spread=spread,
    )
