"""One time step: Algorithm 1 of the paper, corrected (docs/paper_map.md)."""

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import warp as wp

from pdipc.barrier.pairs import ActivePairs
from pdipc.barrier.restitution import ELASTIC_END, ELASTIC_START, Restitution
from pdipc.collision.candidates import Candidates
from pdipc.collision.truncation import Truncation
from pdipc.device import system
from pdipc.device.launch import Graph, Reducer, one_at_a_time
from pdipc.device.precision import Real
from pdipc.integration.loads import Loads
from pdipc.judge.witness import find_intersections
from pdipc.linear import Translations
from pdipc.model import Model, State
from pdipc.nonlinear.anderson import Anderson
from pdipc.paper_mode.energy_rate import EnergyRate
from pdipc.paper_mode.targets import OUTER_SQUARED, PaperPairs

RESTRUCTURE_EVERY = 32  # steps between rebuilds of the culling's trees
REBOUND_ITERATIONS, REBOUND_TOLERANCE = 200, 1e-5  # of the local-global iterations for restitution: most, and relative motion
INNER_FRACTION = 0.1  # the inner loop ends early once it moves by less than this fraction of the outer tolerance

STAGES = ("solver", "ccd", "barrier", "misc")
STARTED, LAST = wp.constant(len(STAGES)), wp.constant(len(STAGES) + 1)  # places of the clock, in milliseconds
RUNNING, CONVERGED, CAPPED, OUT_OF_TIME, OVERFLOW, NOT_FINITE = (wp.constant(code) for code in range(6))
STATUS, OUTER, TRUNCATIONS, BARRIERS, BEHIND = (wp.constant(place) for place in range(5))
COUNTS = 5
# What a step reports after its counts, in one array that the host reads once: iterations, residual, gap, then the stages' times.
LOCAL_GLOBAL, LINEAR, RESIDUAL, GAP, FOREIGN, TIMES = (wp.constant(place) for place in range(COUNTS, COUNTS + 6))


@dataclass
class StepResult:
    """The new state and what it took; the fields after `converged` carry the names of the paper's Table 1.

    residual: m, the largest untruncated motion of the last outer iteration; in the paper's mode the norm of the truncated motion of
    all vertices. smallest_gap: m beyond the minimum separation, inf
    without contact. milliseconds: solver, ccd (culling and CCD), barrier, misc.
    """

    state: State
    converged: bool
    message: str
    constraints: int
    barriers: int
    local_global: int
    outer: int
    linear_iterations: int
    truncations: int
    residual: float
    smallest_gap: float
    milliseconds: dict[str, float] = field(default_factory=dict)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)

    @wp.kernel(module=module)
    def compare(
        first: int,
        x_start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        foreign_out: wp.array(dtype=wp.int32),
    ):
        """Whether a step starts anywhere but where the last one ended."""
        i = first + wp.tid()
        for axis in range(3):
            if x_start[i][axis] != x[i][axis]:
                foreign_out[0] = 1

    @wp.kernel(module=module)
    def predict(
        first: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        a: wp.array(dtype=vec3),
        acceleration: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        h: scalar,
        z_out: wp.array(dtype=vec3),
        x_tilde_out: wp.array(dtype=vec3),
    ):
        """Lines 1 and 2: z = x* + h v* + h^2 M^-1 f_ext; x~ = x* + h v* + h^2/4 a*. Kinematic vertices: their target."""
        i = first + wp.tid()
        if free[i] > scalar(0.0):
            inertial = x[i] + h * v[i]
            z_out[i] = inertial + h * h * acceleration[i]
            x_tilde_out[i] = inertial + scalar(0.25) * h * h * a[i]
        else:
            z_out[i] = target[i]
            x_tilde_out[i] = target[i]

    @wp.kernel(module=module)
    def inertia(
        first: int,
        x_tilde: wp.array(dtype=vec3),
        x_start: wp.array(dtype=vec3),
        z: wp.array(dtype=vec3),
        mass: wp.array(dtype=scalar),
        free: wp.array(dtype=scalar),
        h: scalar,
        damping: scalar,
        force_out: wp.array(dtype=vec3),
        increment_out: wp.array(dtype=vec3),
    ):
        """-dE/dx at x~ (line 8), with mass-proportional damping; and a zero start for the increment."""
        i = first + wp.tid()
        scale = free[i] * mass[i] / h
        force_out[i] = scale / h * (z[i] - x_tilde[i]) - scale * damping * (x_tilde[i] - x_start[i])
        increment_out[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    @wp.kernel(module=module)
    def begin(
        first: int,
        count: wp.array(dtype=wp.int32),
        local_global: wp.array(dtype=wp.int32),
        linear: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        for i in range(count.shape[0]):
            count[i] = 0
        local_global[0] = 0
        linear[0] = 0
        going_out[0] = 1

    @wp.kernel(module=module)
    def measure(
        first: int,
        x: wp.array(dtype=vec3),
        x_tilde: wp.array(dtype=vec3),
        moved_out: wp.array(dtype=scalar),
    ):
        """How far each vertex wants to go; where that is no number, infinitely far, and it stays."""
        i = first + wp.tid()
        moved = wp.length(x_tilde[i] - x[i])
        if not (moved < scalar(1.0e30)):
            moved = scalar(wp.inf)
            x_tilde[i] = x[i]
        moved_out[i] = moved

    @wp.kernel(module=module)
    def measure_squared(first: int, x: wp.array(dtype=vec3), x_end: wp.array(dtype=vec3), moved_out: wp.array(dtype=scalar)):
        i = first + wp.tid()
        moved_out[i] = wp.length_sq(x_end[i] - x[i])

    @wp.kernel(module=module)
    def decide(
        first: int,
        pairs: wp.array(dtype=wp.int32),
        passes: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        increment: wp.array(dtype=scalar),
        clock: wp.array(dtype=wp.float64),
        as_printed: int,
        committed: wp.array(dtype=scalar),
        tolerance: scalar,
        max_outer: int,
        budget_ms: wp.float64,
        largest: wp.array(dtype=scalar),
        count: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        """Line 16. As printed it looks at the truncated motion, which becomes small because t_I does, converged or not; else at
        the untruncated one."""
        status = int(RUNNING)
        residual = largest[0]
        free_flight = pairs[0] == 0 and increment[0] <= tolerance
        waits = count[BEHIND] > 0 and count[OUTER] % 2 == 1  # see commit
        count[BEHIND] = 0
        if overflow[0] != 0:
            status = OVERFLOW
        elif residual >= scalar(wp.inf):
            status = NOT_FINITE
            count[OUTER] = count[OUTER] + 1
        else:
            count[OUTER] = count[OUTER] + 1
            count[BARRIERS] = pairs[0]
            if passes[0] > 0:
                count[TRUNCATIONS] = count[TRUNCATIONS] + 1
            settled = passes[0] == 0 and not waits and (residual <= tolerance or free_flight)
            if as_printed != 0:
                largest[0] = wp.sqrt(committed[0])
                settled = largest[0] <= tolerance and not waits
            if settled:
                status = CONVERGED
            elif budget_ms > wp.float64(0.0) and clock[LAST] - clock[STARTED] > budget_ms:
                status = OUT_OF_TIME
            elif count[OUTER] >= max_outer:
                status = CAPPED
        count[STATUS] = status
        going_out[0] = 0
        if status == RUNNING:
            going_out[0] = 1

    @wp.kernel(module=module)
    def commit(
        first: int,
        count: wp.array(dtype=wp.int32),
        x_end: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        x_out: wp.array(dtype=vec3),
        x_tilde_out: wp.array(dtype=vec3),
    ):
        """The truncated motion is made. Scripted vertices that it left behind their target go on to it in every second outer
        iteration: in the one between, the others make way, so that gaps do not shrink from iteration to iteration.
        """
        i = first + wp.tid()
        if count[STATUS] < OVERFLOW:
            x_out[i] = x_end[i]
            x_tilde_out[i] = x_end[i]
            if free[i] == scalar(0.0) and wp.length_sq(target[i] - x_end[i]) > scalar(0.0):
                count[BEHIND] = 1
                if count[OUTER] % 2 == 0:
                    x_tilde_out[i] = target[i]

    @wp.kernel(module=module)
    def finish(
        first: int,
        x_start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        h: scalar,
        v: wp.array(dtype=vec3),
        a: wp.array(dtype=vec3),
        v_out: wp.array(dtype=vec3),
        a_out: wp.array(dtype=vec3),
    ):
        """Line 18: v = (x - x*) / h, a = (v - v*) / h."""
        i = first + wp.tid()
        velocity = (x[i] - x_start[i]) / h
        a_out[i] = (velocity - v[i]) / h
        v_out[i] = velocity

    @wp.kernel(module=module)
    def report(
        first: int,
        count: wp.array(dtype=wp.int32),
        local_global: wp.array(dtype=wp.int32),
        linear: wp.array(dtype=wp.int32),
        residual: wp.array(dtype=scalar),
        closest: wp.array(dtype=scalar),
        foreign: wp.array(dtype=wp.int32),
        clock: wp.array(dtype=wp.float64),
        report_out: wp.array(dtype=wp.float64),
    ):
        for i in range(count.shape[0]):
            report_out[i] = wp.float64(count[i])
        report_out[LOCAL_GLOBAL] = wp.float64(local_global[0])
        report_out[LINEAR] = wp.float64(linear[0])
        report_out[RESIDUAL] = wp.float64(residual[0])
        report_out[FOREIGN] = wp.float64(foreign[0])
        report_out[GAP] = wp.float64(wp.inf)
        if count[BARRIERS] > 0:
            report_out[GAP] = -wp.float64(wp.max(closest[0], closest[1]))
        for stage in range(STARTED):
            report_out[TIMES + stage] = clock[stage]

    milliseconds = system.milliseconds()  # the step is one graph, so its stages are timed where it runs

    @wp.kernel(module=module)
    def start_clock(first: int, call: wp.uint64, argument: wp.int64, clock: wp.array(dtype=wp.float64)):
        for i in range(clock.shape[0]):
            clock[i] = wp.float64(0.0)
        now = milliseconds(call, argument)
        clock[STARTED] = now
        clock[LAST] = now

    @wp.kernel(module=module)
    def mark(first: int, stage: int, call: wp.uint64, argument: wp.int64, clock: wp.array(dtype=wp.float64)):
        """The time since the last mark belongs to `stage`."""
        now = milliseconds(call, argument)
        clock[stage] = clock[stage] + now - clock[LAST]
        clock[LAST] = now

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Kernel)})


class Work:
    """Buffers of a step, allocated once for a model, and the recorded step.

    recorded: whether steps run as recorded graphs; without, each kernel is launched from Python, with the same bits. So it
    is for a solver that the host drives, and, with a warning, on a CUDA driver that has no loops in graphs.
    """

    @one_at_a_time
    def __init__(self, model: Model, recorded: bool = True):
        device, real, n = model.device, model.real, model.vertex_count
        vec3, scalar = real.vec3, real.scalar
        self.model, self.kernels = model, kernels(real)
        self.recorded = recorded and model.solver.recordable and device.records_loops
        if recorded and not device.records_loops:
            warnings.warn(f"the driver of {device.name} has no loops in graphs: each kernel is launched alone", stacklevel=2)

        def zeros(dtype, count=n):
            return wp.zeros(count, dtype=dtype, device=device.warp)

        self.x_start, self.v_start, self.a_start = zeros(vec3), zeros(vec3), zeros(vec3)
        self.x, self.v, self.a = model.initial_state().positions, zeros(vec3), zeros(vec3)
        self.x_tilde, self.z = zeros(vec3), zeros(vec3)
        self.target, self.loads = zeros(vec3), Loads(device, real, model.external)
        self.acceleration = self.loads.acceleration
        self.force, self.rhs, self.increment = zeros(vec3), zeros(vec3), zeros(vec3)
        self.moved, self.residual, self.committed = zeros(scalar), zeros(scalar, 1), zeros(scalar, 1)
        self.count, self.going, self.foreign = zeros(wp.int32, COUNTS), zeros(wp.int32, 1), zeros(wp.int32, 1)
        self.clock = zeros(wp.float64, len(STAGES) + 2)
        self.report = zeros(wp.float64, TIMES + len(STAGES))
        self.largest = Reducer(device, real, n)
        settings = model.settings
        self.candidates = Candidates(
            device,
            real,
            model.surface,
            model.broad_phase,
            model.assembly.rest_positions,
            model.half_separation,
            settings.activation_distance,
            settings.margin,
        )
        surfaces = (device, real, model.kappa, model.friction, model.free, settings.slip_threshold)
        self.as_printed, self.truncated_tolerance = settings.method == "paper", OUTER_SQUARED**0.5
        if self.as_printed:
            rebound = {"mass": model.mass, "restitution": settings.restitution or 0.0, "h": settings.time_step}
            self.pairs = PaperPairs(*surfaces, **rebound)
            self.inner = EnergyRate(device, real, model.projector, self.pairs, self.x, self.z, model.mass)
        else:
            self.pairs = ActivePairs(*surfaces)
            self.inner = Anderson(device, real, n, INNER_FRACTION * settings.outer_tolerance, settings.inner_tolerance)
        self.restitution = None
        if settings.restitution is not None and not self.as_printed:
            masses = (model.mass, model.free, model.body_mass, model.rigidity)
            self.restitution = Restitution(device, real, self.pairs, *masses, settings.restitution, settings.time_step)
            self.parting = Anderson(device, real, n, 0.0, REBOUND_TOLERANCE)
        # the paper starts its solves from rest
        self.translations = None if self.as_printed or model.solver.moves_bodies else Translations(model.solver.system)
        self.truncation = Truncation(device, real, n, model.rigid, settings.per_vertex_truncation)
        self._graphs: dict[str, Graph] = {}
        self._graphs_of: tuple[int, int] = (-1, -1)
        self._scripted = False

    def set_scripted(self, state: State, time: float) -> None:
        """Where kinematic vertices go by `time`, only uploaded where they move, and the external accelerations."""
        model = self.model
        if not self._scripted or model.moves:
            self.target.assign(model.kinematic_targets(time))
            model.move_anchors(time)
        self.loads.update(state.time, state.positions, state.velocities)
        self._scripted = True

    def run(self, part: Callable[[], None]) -> None:
        """Replays `part` of a step; records it first where it is new or arrays were replaced."""
        if not self.recorded:
            part()
            return
        generation = (self.candidates.generation, self.pairs.generation)
        if self._graphs_of != generation:
            self._graphs, self._graphs_of = {}, generation
        name = part.__name__
        if name not in self._graphs:
            self._graphs[name] = self.model.device.capture(part, self)
        self._graphs[name].launch()

    def grow(self) -> bool:
        """Makes room where a list was full; returns whether one was."""
        grown = [self.candidates.grow(), self.pairs.grow()]
        self.candidates.overflow.zero_()
        return any(grown)

    def list_pairs(self, x: wp.array) -> None:
        """Freezes the pairs that are active at x, outside of a step."""
        while True:
            self.candidates.cover(x, x)
            self.pairs.freeze(self.candidates, x)
            if not self.grow():
                return

    # The step, in launches only: it is recorded, and on CUDA the host hears of it when it is over.

    def whole_step(self) -> None:
        """Algorithm 1."""
        self.start()
        self.model.device.loop(self.going, self.outer_iteration)
        self.finish()

    def start(self) -> None:
        """Lines 1 to 3."""
        model, device, k, n = self.model, self.model.device, self.kernels, self.model.vertex_count
        device.launch_serial(k.start_clock, [*system.clock_call(), self.clock])
        device.launch_serial(k.begin, [self.count, self.inner.done, model.solver.iterations, self.going])
        device.copy(self.x, self.x_start)
        start = [self.x_start, self.v_start, self.a_start, self.acceleration, self.target, model.free]
        device.launch(k.predict, n, [*start, model.real.scalar(model.settings.time_step), self.z, self.x_tilde])
        self.pairs.expect(self.x, self.x_tilde)
        self.candidates.check(self.x, self.x)
        device.when(self.candidates.needed, lambda: self.candidates.cover(self.x, self.x))
        self._mark("ccd")

    def outer_iteration(self) -> None:
        """Lines 5 to 16."""
        device, k, n, s = self.model.device, self.kernels, self.model.vertex_count, self.model.settings
        self.pairs.freeze(self.candidates, self.x)  # line 5
        if self.as_printed:  # the diagonal changes with the barriers only (Section 5)
            self.model.solver.prepare(self.pairs)
        self._mark("barrier")
        self.inner.begin(s.inner_iterations)
        device.loop(self.inner.going, self._local_global)  # lines 7 to 12
        device.launch(k.measure, n, [self.x, self.x_tilde, self.moved])
        self.largest.max(self.moved, self.residual)
        self._mark("solver")
        self.candidates.check(self.x, self.x_tilde)
        device.when(self.candidates.needed, self._cover)  # line 13
        self.truncation.truncate(self.candidates, self.x, self.x_tilde)  # lines 14 and 15
        self._mark("ccd")
        self.pairs.expect(self.x, self.x_tilde, self.truncation.fraction)
        tolerance = s.outer_tolerance
        if self.as_printed:
            device.launch(k.measure_squared, n, [self.x, self.truncation.x_end, self.moved])
            self.largest.sum(self.moved, self.committed)
            tolerance = self.truncated_tolerance
        states = [self.pairs.count, self.truncation.passes, self.candidates.overflow, self.inner.moved, self.clock]
        limits = [int(self.as_printed), self.committed, self.model.real.scalar(tolerance), s.max_outer, s.budget_ms or 0.0]
        device.launch_serial(k.decide, [*states, *limits, self.residual, self.count, self.going])
        inputs = [self.count, self.truncation.x_end, self.target, self.model.free]
        device.launch(k.commit, n, [*inputs, self.x, self.x_tilde])
        self._mark("misc")

    def _local_global(self) -> None:
        """Lines 8 to 11: local projections and the global step, at fixed barriers."""
        model, device, k, s = self.model, self.model.device, self.kernels, self.model.settings
        h, damping = model.real.scalar(s.time_step), model.real.scalar(s.damping)
        inputs = [self.x_tilde, self.x_start, self.z, model.mass, model.free, h, damping, self.force, self.increment]
        device.launch(k.inertia, model.vertex_count, inputs)
        model.projector.add_forces(self.x_tilde, self.rhs, self.force)
        self.pairs.linearize(self.x, self.x_tilde, self.x_start, self.rhs)
        self._solve()
        self.inner.advance(self.x_tilde, self.increment, model.free)

    def _solve(self) -> None:
        """Line 10: K increment = rhs."""
        if self.translations is not None:
            self.translations.start(self.increment, self.rhs, self.pairs)
        self.model.solver.solve(self.increment, self.rhs, self.pairs, prepared=self.as_printed)

    def finish(self) -> None:
        """Line 18; with restitution, velocities are those that bodies part with."""
        model, k = self.model, self.kernels
        h = model.real.scalar(model.settings.time_step)
        moved_to = self.x
        if self.restitution is not None:
            moved_to = self.restitution.x_now
            self.restitution.aim(self.x_start, self.x, self.v_start)
            model.device.when(self.restitution.needed, self._rebound)
            self._mark("solver")
        inputs = [self.x_start, moved_to, h, self.v_start, self.a_start, self.v, self.a]
        model.device.launch(k.finish, model.vertex_count, inputs)
        self._mark("misc")
        numbers = [self.count, self.inner.done, model.solver.iterations, self.residual, self.pairs.closest, self.foreign]
        model.device.launch_serial(k.report, [*numbers, self.clock, self.report])

    def _rebound(self) -> None:
        model, rebound = self.model, self.restitution
        assert rebound is not None  # only then is this part of the step
        model.projector.add_forces(self.x, rebound.elastic, rebound.zero)
        self.parting.begin(REBOUND_ITERATIONS)

        def local_global() -> None:
            rebound.inertia(self.x, self.force, self.increment)
            model.projector.add_forces(rebound.x_now, self.rhs, self.force)
            rebound.linearize(self.x_start, self.rhs)
            self._solve()
            self.parting.advance(rebound.x_now, self.increment, model.free)

        model.device.loop(self.parting.going, local_global)
        for x, place in ((self.x_start, ELASTIC_START), (self.x, ELASTIC_END)):
            model.projector.energy(x, rebound.sums, place)
        rebound.limit(self.x_start, self.x, self.v_start, self.acceleration)

    def _cover(self) -> None:
        self.candidates.cover(self.x, self.x_tilde)

    def _mark(self, stage: str) -> None:
        self.model.device.launch_serial(self.kernels.mark, [STAGES.index(stage), *system.clock_call(), self.clock])


@one_at_a_time
def step(
    model: Model, state: State, work: Work | None = None, observe: Callable | None = None, into: State | None = None
) -> StepResult:
    """One time step of h from `state`: Algorithm 1. The host waits for the device once, to read the report at the end.

    work: buffers from an earlier step of this model; made where None. observe(x, x_end): called with the start and the end of
    every outer iteration's committed motion, (n,) vec3 on the device, for witnesses and certificates.
    into: whose arrays receive the new state, so that nothing is allocated; it may be `state`. Where None the new state gets
    arrays of its own, and `state` stays as it is.

    Raises ValueError for a state of another model, and for one that intersects: positions that the last step with `work` did not
    end at are judged by the witness.
    """
    work = work or Work(model)
    _belongs(model, state, work)
    work.foreign.zero_()
    model.device.launch(work.kernels.compare, model.vertex_count, [state.positions, work.x, work.foreign])
    work.set_scripted(state, state.time + model.settings.time_step)
    if state.step % RESTRUCTURE_EVERY == 0:
        work.candidates.restructure(state.positions)
    while True:
        wp.copy(work.x_start, state.positions)
        wp.copy(work.v_start, state.velocities)
        wp.copy(work.a_start, state.accelerations)
        motions = []
        if observe is None:
            work.run(work.whole_step)
        else:
            work.run(work.start)
            while int(work.going.numpy()[0]) != 0:
                begin = wp.clone(work.x)
                work.run(work.outer_iteration)
                motions.append((begin, wp.clone(work.x)))
            work.run(work.finish)
        report = work.report.numpy().tolist()
        if report[STATUS] != OVERFLOW:
            break
        if not work.grow():  # a list was full: with more room, the step is taken again
            raise AssertionError("a list overflowed that had room")
    if report[FOREIGN]:
        _judge(model, state, work)
    if observe is not None:
        for motion in motions:
            observe(*motion)
    s, status, outer = model.settings, int(report[STATUS]), int(report[OUTER])
    message = {
        CONVERGED: "",
        CAPPED: f"the cap of {s.max_outer} outer iterations ended the step",
        OUT_OF_TIME: f"the time budget of {s.budget_ms or 0.0:g} ms ended the step after {outer} outer iterations",
        NOT_FINITE: "the iterate is not finite; the step kept the last feasible state",
    }[status]
    time, number = state.time + s.time_step, state.step + 1
    new = into or State(*(wp.empty_like(each) for each in (work.x, work.v, work.a)))
    wp.copy(new.positions, work.x)
    wp.copy(new.velocities, work.v)
    wp.copy(new.accelerations, work.a)
    new.time, new.step = time, number
    return StepResult(
        state=new,
        converged=status == CONVERGED,
        message=message,
        constraints=model.projector.count,
        barriers=int(report[BARRIERS]),
        local_global=int(report[LOCAL_GLOBAL]),
        outer=outer,
        linear_iterations=int(report[LINEAR]),
        truncations=int(report[TRUNCATIONS]),
        residual=report[RESIDUAL],
        smallest_gap=report[GAP],
        milliseconds=dict(zip(STAGES, report[TIMES:], strict=True)),
    )


def _belongs(model: Model, state: State, work: Work) -> None:
    if work.model is not model:
        raise ValueError("work was made for another model; make one with Work(model)")
    for name in ("positions", "velocities", "accelerations"):
        array: wp.array = getattr(state, name)
        if array.shape != work.x.shape or not wp.types.types_equal(array.dtype, work.x.dtype):
            raise ValueError(
                f"the state's {name} are {array.shape} of {array.numpy().dtype}; those of the model are {work.x.shape} of "
                f"{model.real.name}"
            )


def _judge(model: Model, state: State, work: Work) -> None:
    assembly, triangles = model.assembly, model.triangles
    pairs = find_intersections(state.positions.numpy(), triangles, assembly.obstacle)
    if len(pairs):
        work.x.fill_(wp.nan)  # so that it is judged again
        names = [assembly.bodies[body].name for body in assembly.body_of_vertex[triangles[pairs[0]][:, 0]]]
        raise ValueError(
            f"the state at t = {state.time:g} s has {len(pairs)} pairs of triangles that intersect, such as triangle {pairs[0][0]} "
            f'of "{names[0]}" and {pairs[0][1]} of "{names[1]}"; a step starts from a state without intersections'
        )
