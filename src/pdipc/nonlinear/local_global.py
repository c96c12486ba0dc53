"""The local-global iterations of projective dynamics inside Algorithm 1 (lines 6 to 12), accelerated."""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.barrier.pairs import ActivePairs, Exerted
from pdipc.barrier.restitution import Restitution
from pdipc.device.language import kernel
from pdipc.device.launch import Reducer
from pdipc.device.precision import Real
from pdipc.integration import inertia as implicit
from pdipc.integration import status
from pdipc.integration.script import led
from pdipc.linear import Translations
from pdipc.nonlinear.anderson import Anderson
from pdipc.nonlinear.descent import Descent

INNER_FRACTION = 0.1  # the inner loop ends early once it moves by less than this fraction of the tolerance
REBOUND_ITERATIONS, REBOUND_TOLERANCE = 200, 1e-5  # of the iterations for restitution: most, and relative motion
INNER_TOLERANCE = 0.2  # or by less than this part of its first iteration


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Inertial, Led = real.scalar, real.vec3, implicit.inertial(real), led(real)
    module = real.module(__name__)

    @kernel(module)
    def inertia(
        first: int,
        u_tilde: wp.array(dtype=vec3),
        o: Inertial,
        force_out: wp.array(dtype=vec3),
        increment_out: wp.array(dtype=vec3),
    ):
        """-dE/dx at x~ (line 8), with mass-proportional damping; and a zero start for the increment."""
        i = first + wp.tid()
        scale = o.free[i] * o.mass[i] / o.h
        force_out[i] = scale / o.h * (o.z[i] - u_tilde[i]) - scale * o.damping * (u_tilde[i] - o.rest[i])
        increment_out[i] = vec3()

    @kernel(module)
    def measure(
        first: int,
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        x_tilde_out: wp.array(dtype=vec3),
        moved_out: wp.array(dtype=scalar),
    ):
        """How far each free vertex wants to go; where that is no number, infinitely far, and it stays."""
        i = first + wp.tid()
        moved = wp.length(u_tilde[i] - u[i])
        if not (moved < scalar(1.0e30)):
            moved = scalar(wp.inf)
            u_tilde[i] = u[i]
        x_tilde_out[i] = base[i] + u_tilde[i]
        if free[i] == scalar(0.0) and moved < scalar(wp.inf):
            moved = scalar(0.0)
        moved_out[i] = moved

    @kernel(module)
    def direct(first: int, u: wp.array(dtype=vec3), u_tilde: wp.array(dtype=vec3), p_out: wp.array(dtype=vec3)):
        i = first + wp.tid()
        p_out[i] = u_tilde[i] - u[i]

    @kernel(module)
    def commit(
        first: int,
        overflow: wp.array(dtype=wp.int32),
        numbers: wp.array(dtype=scalar),
        u_end: wp.array(dtype=vec3),
        x_end: wp.array(dtype=vec3),
        u_out: wp.array(dtype=vec3),
        x_out: wp.array(dtype=vec3),
    ):
        """The truncated motion is made."""
        i = first + wp.tid()
        if overflow[0] == 0 and numbers[status.MOVED] < scalar(wp.inf):
            x_out[i] = x_end[i]
            u_out[i] = u_end[i]

    @kernel(module)
    def stay(first: int, o: Led, u_tilde_out: wp.array(dtype=vec3)):
        """What is scripted and does not set out stays."""
        i = first + wp.tid()
        if o.free[i] == scalar(0.0) and o.mover[i] >= 0 and o.drive[wp.max(o.mover[i], 0)] == 0:
            u_tilde_out[i] = o.u[i]

    @kernel(module)
    def lead(
        first: int,
        o: Led,
        goal: wp.array(dtype=vec3),
        u_tilde_out: wp.array(dtype=vec3),
        lag_out: wp.array(dtype=scalar),
    ):
        """Where the next outer iteration starts from; what is scripted goes on to its waypoint. lag: m, how far it is from its goal."""
        i = first + wp.tid()
        lag_out[i] = scalar(0.0)
        u_tilde_out[i] = o.u[i]
        if o.free[i] == scalar(0.0):
            lag_out[i] = wp.length((goal[i] - o.base[i]) - o.u[i])
            if o.drive[wp.max(o.mover[i], 0)] != 0:
                u_tilde_out[i] = o.target[i] - o.base[i]

    return SimpleNamespace(inertia=inertia, measure=measure, direct=direct, commit=commit, stay=stay, lead=lead)


class Iterations:
    """What local-global methods share; see `nonlinear.Method`."""

    def __init__(self, work):
        model = work.model
        device, real, n = model.device, model.real, model.vertex_count
        self.work, self.model, self.device, self.kernels = work, model, device, kernels(real)

        def zeros(dtype, count=n):
            return wp.zeros(count, dtype=dtype, device=device.warp)

        self.force, self.rhs, self.increment = zeros(real.vec3), zeros(real.vec3), zeros(real.vec3)
        self.moved, self.lags = zeros(real.scalar), zeros(real.scalar)
        self.numbers = zeros(real.scalar, status.NUMBERS)
        self.largest = Reducer(device, real, n)
        self.iterations = model.solver.iterations
        self._make()
        self.inner = self.loop.done

    def _make(self) -> None:
        """The pairs, the inner loop, and where solves start."""
        model, settings = self.model, self.model.settings
        surfaces = (model.device, model.real, model.kappa, model.friction, model.free, settings.slip_threshold)
        self.pairs = ActivePairs(*surfaces)
        ends = INNER_FRACTION * settings.tolerance, INNER_TOLERANCE
        self.loop = Anderson(model.device, model.real, model.vertex_count, *ends)
        self.parting = Anderson(model.device, model.real, model.vertex_count, 0.0, REBOUND_TOLERANCE)
        self.translations = None if model.solver.moves_bodies else Translations(model.solver.system)

    @property
    def generation(self) -> int:
        """Grows whenever arrays were replaced."""
        return self.pairs.generation

    def grow(self) -> bool:
        """Makes room where a list was full."""
        return self.pairs.grow()

    def exerted(self) -> tuple[Exerted, Exerted]:
        """See `nonlinear.Method`: the pairs of where the step ended."""
        w = self.work
        self.pairs.freeze(w.candidates, w.x)
        return self.pairs.exerted(w.u, w.rest)

    def start(self) -> None:
        """Nothing is known of the motion yet but the predictor."""
        self.pairs.expect(self.work.u, self.work.u_tilde)

    def freeze(self) -> None:
        """Line 5."""
        self.pairs.freeze(self.work.candidates, self.work.x)

    def solve(self) -> None:
        """Lines 6 to 12."""
        w, k, n = self.work, self.kernels, self.model.vertex_count
        self.loop.begin(self.model.settings.inner_iterations)
        self.device.loop(self.loop.going, self._local_global)
        self.device.launch(k.measure, n, [w.x_start, w.u, w.u_tilde, self.model.free, w.x_tilde, self.moved])
        self.largest.max(self.moved, self.numbers, status.MOVED)

    def _local_global(self) -> None:
        """Lines 8 to 11: local projections and the global step, at fixed barriers."""
        w, model = self.work, self.model
        inputs = [w.u_tilde, w.inertial(), self.force, self.increment]
        self.device.launch(self.kernels.inertia, model.vertex_count, inputs)
        model.projector.add_forces(w.x_start, w.u_tilde, self.rhs, self.force)
        self.pairs.linearize(w.u, w.u_tilde, w.rest, self.rhs)
        self.solve_linear(self.increment, self.rhs)
        self.loop.advance(w.u_tilde, self.increment, model.free)

    def solve_linear(self, increment: wp.array, rhs: wp.array) -> None:
        """Line 10: K increment = rhs."""
        if self.translations is not None:
            self.translations.start(increment, rhs, self.pairs)
        self.model.solver.solve(increment, rhs, self.pairs)

    def correct(self, r: Restitution) -> None:
        """The velocities of restitution: `r.u_now`."""
        w, model = self.work, self.model
        model.projector.add_forces(w.x_start, w.u, r.elastic, r.zero)
        parting = self.parting
        parting.begin(REBOUND_ITERATIONS)

        def local_global() -> None:
            r.inertia(w.u, self.force, self.increment)
            model.projector.add_forces(w.x_start, r.u_now, self.rhs, self.force)
            r.linearize(w.rest, self.rhs)
            self.solve_linear(self.increment, self.rhs)
            parting.advance(r.u_now, self.increment, model.free)

        self.device.loop(parting.going, local_global)

    def _lead(self) -> None:
        w, n = self.work, self.model.vertex_count
        self.device.launch(self.kernels.lead, n, [w.led(), w.script.goal, w.u_tilde, self.lags])


class LocalGlobal(Iterations):
    """The default mode's: as much of their motion is made as lowers the true potential, island by island, as with Newton's method.

    Not with friction, which here follows the iterate and so has no potential: then all of the truncated motion is made.
    """

    def _make(self) -> None:
        super()._make()
        self.descent = Descent(self.work, False, descends=not self.model.has_friction, weighs=not self.model.has_friction)
        matrix = self.model.solver.system.matrix
        self.work.truncation.neighbours = [
            wp.array(part, dtype=wp.int32, device=self.device.warp) for part in (matrix.indptr, matrix.indices)
        ]
        self.numbers = self.descent.numbers

    @property
    def generation(self) -> int:
        """Grows whenever arrays were replaced."""
        return self.pairs.generation + self.descent.generation

    def grow(self) -> bool:
        """Makes room where a list was full."""
        return any([self.pairs.grow(), self.descent.grow()])

    def start(self) -> None:
        """The predictor, and the potential where the step starts."""
        super().start()
        self.descent.start()
        w = self.work
        if w.script.moves:
            self.device.launch(self.kernels.stay, self.model.vertex_count, [w.led(), w.u_tilde])

    def solve(self) -> None:
        """Lines 6 to 12."""
        super().solve()
        w = self.work
        self.device.launch(self.kernels.direct, self.model.vertex_count, [w.u, w.u_tilde, self.descent.p])

    def accept(self) -> None:
        """Line 16."""
        w = self.work
        self.pairs.expect(w.u, w.u_tilde, w.truncation.fraction)
        self.descent.accept()
        self._lead()
