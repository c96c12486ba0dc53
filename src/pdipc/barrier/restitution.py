"""Restitution: the speed at which a pair parts after an impact (the eps of Eq. 6, for forces instead of position targets).

A position target cannot promise a rebound: the end velocity then depends on where in the step the impact falls. Here positions are
those of the barrier, and the velocities at the end of the step are corrected, as in the contact law of Newton and Moreau. With u the
speed along the normal at which the two sides of an active pair part, before the step (u-) and after it (u),

    u = -eps u-      where they approached, u- < 0,
    u <= u-          where they parted already: a barrier that is still compressed moves them, but gives them no speed.

The correction dv is the least one in the metric of the implicit step, which spreads an impulse over a stiff body:

    min  |h dv|^2_M / (2 h^2) + Psi(x + h dv) - grad Psi(x) . h dv  +  sum_k w/2 (h n . sum_i a_i dv_i - ...)^2

with weights w that are large against the bodies' masses. Local-global iterations solve it, or one step of Newton's method. Pairs push as a whole, so momentum is
conserved. Should the kinetic energy afterwards exceed what the step had to give, dv is shortened.

A body that sound does not cross within a step is not stopped at once, but springs back by itself. There the law would only make its
surface rattle, and implicit Euler takes that energy away: the rebound would fall with eps. So the law holds for the part r of a pair,
and for the rest the pair is left as it is for eps = 1 and comes to rest for eps = 0; r = q^2 / (1 + q^2), with q the time step over
the time that sound needs to cross the softer body.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.barrier.exact import BarrierTerm
from pdipc.barrier.pairs import ActivePairs, frozen
from pdipc.device.language import filled, func, kernel, struct_of
from pdipc.device.launch import Device, Reducer, Span
from pdipc.device.precision import Real, Scalar

SQUARE, CROSS, EXCESS, ELASTIC_START, ELASTIC_END = (wp.constant(place) for place in range(5))  # places of `sums`, J
WEIGHT = 100.0  # of a pair's constraint, in units of the lighter body's mass / h^2


@func
def parting(before: Scalar, now: Scalar, rigidity: Scalar, restitution: Scalar):
    """The motion along the normal that a pair should have made in a step, m, and whether it is to be held to that.

    before: the motion that its velocity at the start would have made; now: the one that it made.
    """
    one = type(now)(1.0)
    if before < type(now)(0.0):
        return restitution * ((one - rigidity) * now - rigidity * before), bool(True)
    return rigidity * before + (one - rigidity) * (restitution * now + (one - restitution) * before), now > before


@func
def lighter(a: Scalar, b: Scalar):
    """The lesser of two masses; what is kinematic, and has 0, does not count."""
    least = wp.min(a, b)
    if least == type(a)(0.0):
        return wp.max(a, b)
    return least


@functools.cache
def law(real: Real) -> Any:
    """A struct: what the law of impact knows of bodies; see `Restitution`."""
    return struct_of(
        "Law",
        __name__,
        mass=wp.array(dtype=real.scalar),  # kg
        free=wp.array(dtype=real.scalar),
        body_mass=wp.array(dtype=real.scalar),
        rigidity=wp.array(dtype=real.scalar),
        restitution=real.scalar,
        h=real.scalar,  # s
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Frozen, Law = real.scalar, real.vec3, frozen(real), law(real)
    mat43 = wp.types.matrix((4, 3), scalar)
    module = real.module(__name__)

    @kernel(module)
    def clear(first: int, needed_out: wp.array(dtype=wp.int32)):
        needed_out[0] = 0

    @kernel(module)
    def forget(first: int, rebound_out: wp.array(dtype=scalar)):
        rebound_out[first + wp.tid()] = scalar(0.0)

    @kernel(module)
    def aim(
        span: Span,
        pairs: Frozen,
        x_start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v_start: wp.array(dtype=vec3),
        law: Law,
        target_out: wp.array(dtype=scalar),
        pull_out: wp.array(dtype=scalar),
        needed_out: wp.array(dtype=wp.int32),
    ):
        """Of each pair: the motion along the normal that it should have made by the end of the step, m, and its weight, N/m."""
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                q = pairs.quads[k]
                before = scalar(0.0)
                now = scalar(0.0)
                for s in range(4):
                    i = q[s]
                    moved = x[i] - x_start[i]
                    now += pairs.weights[k][s] * wp.dot(pairs.normals[k], moved)
                    if law.free[i] > scalar(0.0):
                        moved = law.h * v_start[i]
                    before += pairs.weights[k][s] * wp.dot(pairs.normals[k], moved)
                rigidity = wp.min(law.rigidity[q[0]], law.rigidity[q[3]])
                target, engaged = parting(before, now, rigidity, law.restitution)
                target_out[k] = target
                pull = scalar(0.0)
                if engaged:
                    pull = scalar(WEIGHT) * lighter(law.body_mass[q[0]], law.body_mass[q[3]]) / (law.h * law.h)
                if pull > scalar(0.0):
                    needed_out[0] = 1  # whoever writes, writes the same
                pull_out[k] = pull

    @kernel(module)
    def inertia(
        first: int,
        x_now: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        law: Law,
        elastic: wp.array(dtype=vec3),
        force_out: wp.array(dtype=vec3),
        increment_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        force_out[i] = -law.free[i] * law.mass[i] / (law.h * law.h) * (x_now[i] - x[i]) - elastic[i]
        increment_out[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    @func
    def parted(pairs: Frozen, k: int, x_start: wp.array(dtype=vec3), x_now: wp.array(dtype=vec3)) -> scalar:
        """How far the sides of pair k have moved apart along its normal, m."""
        moved = vec3()
        for s in range(4):
            moved += pairs.weights[k][s] * (x_now[pairs.quads[k][s]] - x_start[pairs.quads[k][s]])
        return wp.dot(pairs.normals[k], moved)

    @kernel(module)
    def linearize(
        span: Span,
        pairs: Frozen,
        x_start: wp.array(dtype=vec3),
        x_now: wp.array(dtype=vec3),
        target: wp.array(dtype=scalar),
        pull: wp.array(dtype=scalar),
        friction_out: wp.array(dtype=scalar),
        hessian_out: wp.array(dtype=scalar),
        force_out: wp.array(dtype=vec3),
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                friction_out[k] = scalar(0.0)
                hessian_out[k] = pull[k]
                force_out[k] = pull[k] * (target[k] - parted(pairs, k, x_start, x_now)) * pairs.normals[k]

    @kernel(module)
    def linearize_exact(
        span: Span,
        pairs: Frozen,
        x_start: wp.array(dtype=vec3),
        x_now: wp.array(dtype=vec3),
        target: wp.array(dtype=scalar),
        pull: wp.array(dtype=scalar),
        energy_out: wp.array(dtype=wp.float64),
        slope_out: wp.array(dtype=mat43),
        lever_out: wp.array(dtype=mat43),
        hessian_out: wp.array(dtype=scalar),
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                slope = pull[k] * (parted(pairs, k, x_start, x_now) - target[k])
                lever = mat43()
                for s in range(4):
                    for axis in range(3):
                        lever[s, axis] = pairs.weights[k][s] * pairs.normals[k][axis]
                energy_out[k] = wp.float64(0.0)
                slope_out[k] = slope * lever
                lever_out[k] = lever
                hessian_out[k] = pull[k]

    @kernel(module)
    def move(
        first: int,
        x: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        p: wp.array(dtype=vec3),
        x_now_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        x_now_out[i] = x[i] + free[i] * p[i]

    @kernel(module)
    def kinetic(
        first: int,
        x_start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        x_now: wp.array(dtype=vec3),
        v_start: wp.array(dtype=vec3),
        acceleration: wp.array(dtype=vec3),
        law: Law,
        square_out: wp.array(dtype=scalar),
        cross_out: wp.array(dtype=scalar),
        excess_out: wp.array(dtype=scalar),
    ):
        """Kinetic energy of v + s dv: s^2 square + s cross + ..., and how far it is at s = 0 above energy at the start plus work."""
        i = first + wp.tid()
        v = (x[i] - x_start[i]) / law.h
        dv = (x_now[i] - x[i]) / law.h
        square_out[i] = scalar(0.5) * law.mass[i] * wp.dot(dv, dv)
        cross_out[i] = law.mass[i] * wp.dot(v, dv)
        given = scalar(0.5) * wp.dot(v_start[i], v_start[i]) + law.h * wp.dot(acceleration[i], v)
        excess_out[i] = law.mass[i] * (scalar(0.5) * wp.dot(v, v) - given)

    @kernel(module)
    def limit(first: int, sums: wp.array(dtype=scalar), part_out: wp.array(dtype=scalar)):
        """The largest s <= 1 with s^2 square + s cross + excess <= 0."""
        square = sums[SQUARE]
        cross = sums[CROSS]
        excess = sums[EXCESS] + sums[ELASTIC_END] - sums[ELASTIC_START]
        part = scalar(1.0)
        if square + cross + excess > scalar(0.0):
            part = scalar(0.0)
            root = cross * cross - scalar(4.0) * square * excess
            if root > scalar(0.0) and square > scalar(0.0):
                part = wp.clamp((wp.sqrt(root) - cross) / (scalar(2.0) * square), scalar(0.0), scalar(1.0))
        part_out[0] = part

    @kernel(module)
    def keep(
        span: Span,
        pairs: Frozen,
        x_start: wp.array(dtype=vec3),
        x_now: wp.array(dtype=vec3),
        target: wp.array(dtype=scalar),
        pull: wp.array(dtype=scalar),
        part: wp.array(dtype=scalar),
        rebound_out: wp.array(dtype=scalar),
    ):
        """Of each pair: the force along the normal, N, that over the step makes the correction."""
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                rebound_out[k] = part[0] * pull[k] * (target[k] - parted(pairs, k, x_start, x_now))

    @kernel(module)
    def shorten(first: int, x: wp.array(dtype=vec3), part: wp.array(dtype=scalar), x_now: wp.array(dtype=vec3)):
        i = first + wp.tid()
        x_now[i] = x[i] + part[0] * (x_now[i] - x[i])

    return SimpleNamespace(
        clear=clear,
        forget=forget,
        aim=aim,
        inertia=inertia,
        linearize=linearize,
        linearize_exact=linearize_exact,
        move=move,
        kinetic=kinetic,
        limit=limit,
        keep=keep,
        shorten=shorten,
    )


class Restitution:
    """Corrects the velocities at the end of a step. Everything is recordable.

    body_mass: (n,) kg, the mass of each vertex's body, 0 where kinematic. rigidity: (n,) r of each vertex's body, 1 where
    kinematic. restitution: eps in [0, 1]. h: s.
    needed: (1,) int32 on the device, whether `aim` found a pair to correct. u_now: (n,) m, u + h dv, a displacement since the start of the step.
    """

    def __init__(
        self,
        device: Device,
        real: Real,
        pairs: ActivePairs,
        mass: wp.array,
        free: wp.array,
        body_mass: wp.array,
        rigidity: wp.array,
        restitution: float,
        h: float,
    ):
        n = len(mass)
        self.device, self.pairs, self.kernels = device, pairs, kernels(real)
        self.mass, self.free, self.body_mass, self.rigidity = mass, free, body_mass, rigidity
        self.restitution, self.h = restitution, h
        self.law = filled(law(real), self)
        self.u_now, self.elastic, self.zero = (wp.zeros(n, dtype=real.vec3, device=device.warp) for _ in range(3))
        self.needed = wp.zeros(1, dtype=wp.int32, device=device.warp)
        self.energies = [wp.zeros(n, dtype=real.scalar, device=device.warp) for _ in range(3)]
        self.sums, self.part = (wp.zeros(size, dtype=real.scalar, device=device.warp) for size in (5, 1))
        self.reducer = Reducer(device, real, n)

    def aim(self, x_start: wp.array, x: wp.array, v_start: wp.array) -> None:
        """Launches the targets of the active pairs; u_now starts at x. Here and below x_start and x may be displacements as well."""
        k, device, p = self.kernels, self.device, self.pairs
        device.copy(self.u_now, x)
        device.launch_serial(k.clear, [self.needed])
        device.launch(k.forget, p.capacity, [p.rebound])
        motion = [x_start, x, v_start, self.law]
        # `gaps` and `stiffness` of the pairs are of no further use in this step
        device.launch_list(k.aim, p.capacity, [p.frozen, *motion, p.gaps, p.stiffness, self.needed])

    def inertia(self, x: wp.array, force_out: wp.array, increment_out: wp.array) -> None:
        """Launches the force of M and of the elastic forces at x; and a zero start for the increment."""
        inputs = [self.u_now, x, self.law, self.elastic, force_out, increment_out]
        self.device.launch(self.kernels.inertia, len(x), inputs)

    def linearize(self, x_start: wp.array, rhs: wp.array) -> None:
        """Adds the pairs' forces to rhs, and makes their Hessian and block diagonal."""
        p = self.pairs
        inputs = [p.frozen, x_start, self.u_now, p.gaps, p.stiffness, p.friction, p.hessian, p.force]
        self.device.launch_list(self.kernels.linearize, p.capacity, inputs)
        p.gather(rhs)

    def linearize_exact(self, x_start: wp.array) -> None:
        """The pairs' forces and Hessian in the form of `BarrierTerm`, in place of the barrier's."""
        p, k = self.pairs, self.kernels
        assert isinstance(p, BarrierTerm)
        result = [p.energy_of_pair, p.slope, p.lever, p.hessian]
        self.device.launch_list(k.linearize_exact, p.capacity, [p.frozen, x_start, self.u_now, p.gaps, p.stiffness, *result])
        p.gather_pairs()

    def limit(self, x_start: wp.array, x: wp.array, v_start: wp.array, acceleration: wp.array) -> None:
        """Shortens the correction so that energy does not rise; elastic energies are in `sums` already."""
        k, device, n = self.kernels, self.device, len(x)
        inputs = [x_start, x, self.u_now, v_start, acceleration, self.law]
        device.launch(k.kinetic, n, [*inputs, *self.energies])
        for values, place in zip(self.energies, (SQUARE, CROSS, EXCESS), strict=True):
            self.reducer.sum(values, self.sums, place)
        device.launch_serial(k.limit, [self.sums, self.part])
        p = self.pairs
        inputs = [p.frozen, x_start, self.u_now, p.gaps, p.stiffness, self.part, p.rebound]
        device.launch_list(k.keep, p.capacity, inputs)
        device.launch(k.shorten, n, [x, self.part, self.u_now])
