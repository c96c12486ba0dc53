"""One time step: Algorithm 1 of the paper, corrected (docs/paper_map.md)."""

import functools
import time
from dataclasses import dataclass, field
from types import SimpleNamespace

import warp as wp

from pdipc.anderson import Anderson
from pdipc.contact.candidates import Candidates
from pdipc.contact.pairs import ActivePairs
from pdipc.contact.truncation import Truncation
from pdipc.model import Model, State
from pdipc.parallel import Graph, Reducer
from pdipc.precision import Real

INNER_FRACTION = 0.1  # the inner loop ends early once it moves by less than this fraction of the outer tolerance


@dataclass
class StepResult:
    """The new state and what it took; the fields after `converged` carry the names of the paper's Table 1.

    residual: m, the largest untruncated motion of the last outer iteration. smallest_gap: m beyond the minimum separation, inf
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
    def distance(first: int, a: wp.array(dtype=vec3), b: wp.array(dtype=vec3), distance_out: wp.array(dtype=scalar)):
        i = first + wp.tid()
        distance_out[i] = wp.length(a[i] - b[i])

    @wp.kernel(module=module)
    def finish(
        first: int,
        x_start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        h: scalar,
        v: wp.array(dtype=vec3),
        a: wp.array(dtype=vec3),
    ):
        """Line 18: v = (x - x*) / h, a = (v - v*) / h."""
        i = first + wp.tid()
        velocity = (x[i] - x_start[i]) / h
        a[i] = (velocity - v[i]) / h
        v[i] = velocity

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Kernel)})


class Work:
    """Buffers of a step, allocated once for a model, and the recorded inner loop."""

    def __init__(self, model: Model):
        device, real, n = model.device, model.real, model.vertex_count
        vec3, scalar = real.vec3, real.scalar
        self.kernels = kernels(real)

        def zeros(dtype, count=n):
            return wp.zeros(count, dtype=dtype, device=device.warp)

        self.x_start, self.x, self.x_tilde, self.z = zeros(vec3), zeros(vec3), zeros(vec3), zeros(vec3)
        self.target, self.acceleration = zeros(vec3), zeros(vec3)
        self.force, self.rhs, self.increment = zeros(vec3), zeros(vec3), zeros(vec3)
        self.moved, self.numbers = zeros(scalar), zeros(scalar, 1)
        self.anderson = Anderson(device, real, n)
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
        )
        self.pairs = ActivePairs(device, real, model.kappa, model.friction, model.free, settings.slip_threshold)
        self.truncation = Truncation(device, real, n, model.rigid, settings.per_vertex_truncation)
        self._graph: Graph | None = None
        self._graph_of = -1

        self._scripted = False

    def set_scripted(self, model: Model, state: State, time: float) -> None:
        """Where kinematic vertices go by `time`, and the external accelerations; only uploaded where they change."""
        if not self._scripted or model.moves:
            self.target.assign(model.kinematic_targets(time))
            model.move_anchors(time)
        if not self._scripted or not model.external.constant:
            positions, velocities = state.positions.numpy(), state.velocities.numpy()
            self.acceleration.assign(model.external.accelerations(state.time, positions, velocities))
        self._scripted = True

    def inner_loop(self, model: Model) -> None:
        """Replays the recorded inner loop; records it first where it is new or its arrays were replaced."""
        if self._graph is None or self._graph_of != self.pairs.generation:
            self._graph = model.device.capture(lambda: self._launch_inner(model), self)
            self._graph_of = self.pairs.generation
        self._graph.launch()

    def _launch_inner(self, model: Model) -> None:
        """Lines 7 to 12: local-global iterations at fixed barriers."""
        device, k, s, n = model.device, self.kernels, model.settings, model.vertex_count
        h, damping = model.real.scalar(s.time_step), model.real.scalar(s.damping)

        def local_global() -> None:
            inputs = [self.x_tilde, self.x_start, self.z, model.mass, model.free, h, damping, self.force, self.increment]
            device.launch(k.inertia, n, inputs)
            model.projector.add_forces(self.x_tilde, self.rhs, self.force)  # local projections
            self.pairs.linearize(self.x, self.x_tilde, self.x_start, self.rhs)
            model.solver.solve(self.increment, self.rhs, self.pairs)  # global step
            limits = (INNER_FRACTION * s.outer_tolerance, s.inner_tolerance)
            self.anderson.advance(self.x_tilde, self.increment, model.free, *limits)

        self.anderson.begin(s.inner_iterations)
        device.loop(self.anderson.going, local_global)


class Stopwatch:
    """Adds up the milliseconds between marks by name."""

    def __init__(self, device):
        self.device, self.milliseconds = device, {"solver": 0.0, "ccd": 0.0, "barrier": 0.0, "misc": 0.0}
        self.started = self.last = time.perf_counter()

    def mark(self, name: str) -> None:
        now = time.perf_counter()
        self.milliseconds[name] += 1e3 * (now - self.last)
        self.last = now

    @property
    def elapsed(self) -> float:
        """Milliseconds since the start."""
        return 1e3 * (time.perf_counter() - self.started)


def step(model: Model, state: State, work: Work | None = None, observe=None) -> StepResult:
    """One time step of h from `state`, which is left as it is: Algorithm 1.

    work: buffers from an earlier step of this model; made where None. observe(x, x_end): called with the start and the end of
    every outer iteration's committed motion, (n,) vec3 on the device, for witnesses and certificates.
    """
    work = work or Work(model)
    device, real, s, k, n = model.device, model.real, model.settings, work.kernels, model.vertex_count
    clock = Stopwatch(device)
    h = real.scalar(s.time_step)
    new = state.copy()
    new.time, new.step = state.time + s.time_step, state.step + 1
    work.set_scripted(model, state, new.time)
    wp.copy(work.x_start, state.positions)
    wp.copy(work.x, state.positions)
    v, a = state.velocities, state.accelerations
    device.launch(k.predict, n, [work.x_start, v, a, work.acceleration, work.target, model.free, h, work.z, work.x_tilde])
    for counter in (work.anderson.done, model.solver.iterations):
        counter.zero_()
    candidates, pairs, truncation = work.candidates, work.pairs, work.truncation
    margin = s.margin
    clock.mark("misc")

    converged, truncations, message, residual, smallest = False, 0, "", 0.0, float("inf")
    outer = 0
    while not converged and outer < s.max_outer:
        outer += 1
        if not (candidates.covers(work.x) and candidates.covers(work.x_tilde)):
            candidates.cover(work.x, work.x_tilde, margin)
            clock.mark("ccd")
        smallest = pairs.freeze(candidates, work.x)  # line 5
        clock.mark("barrier")
        work.inner_loop(model)  # lines 7 to 12
        clock.mark("solver")
        if not candidates.covers(work.x_tilde):  # line 13
            candidates.cover(work.x, work.x_tilde, margin)
        passes = truncation.truncate(candidates, work.x, work.x_tilde)  # lines 14 and 15
        clock.mark("ccd")
        truncations += passes > 0
        device.launch(k.distance, n, [work.x, work.x_tilde, work.moved])
        work.largest.max(work.moved, work.numbers)
        residual = float(work.numbers.numpy()[0])
        last_increment = float(work.anderson.moved.numpy()[0])
        if not residual < float("inf"):
            message = "the iterate is not finite; the step kept the last feasible state"
            break
        free_flight = pairs.number == 0 and last_increment <= s.outer_tolerance
        converged = passes == 0 and (residual <= s.outer_tolerance or free_flight)
        if observe is not None:
            observe(work.x, truncation.x_end)
        wp.copy(work.x, truncation.x_end)
        wp.copy(work.x_tilde, truncation.x_end)
        clock.mark("misc")
        if s.budget_ms is not None and clock.elapsed > s.budget_ms and not converged:
            message = f"the time budget of {s.budget_ms:g} ms ended the step after {outer} outer iterations"
            break
    if not converged and not message:
        message = f"the cap of {s.max_outer} outer iterations ended the step"

    wp.copy(new.positions, work.x)
    device.launch(k.finish, n, [work.x_start, work.x, h, new.velocities, new.accelerations])  # line 18
    return_value = StepResult(
        state=new,
        converged=converged,
        message=message,
        constraints=model.projector.count,
        barriers=pairs.number,
        local_global=int(work.anderson.done.numpy()[0]),
        outer=outer,
        linear_iterations=int(model.solver.iterations.numpy()[0]),
        truncations=truncations,
        residual=residual,
        smallest_gap=smallest,
    )
    clock.mark("misc")
    return_value.milliseconds = clock.milliseconds
    return return_value
