"""One time step as its caller sees it: record, run, grow what was full, judge what is foreign, report."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from pdipc import algorithm
from pdipc.bodies import rigid
from pdipc.device.launch import Graph, one_at_a_time, replayed
from pdipc.integration import status
from pdipc.integration.inertia import CHORDS, FIRST_NUMBER, FOREIGN, GAP, LINEAR, LOCAL_GLOBAL, TIMES
from pdipc.judge.witness import find_intersections
from pdipc.model import Model, State
from pdipc.output.forces import ContactForces
from pdipc.work import Work

RESTRUCTURE_EVERY = 32  # steps between rebuilds of the culling's trees


@dataclass
class StepResult:
    """The new state and what it took; the fields after `converged` carry the names of the paper's Table 1.

    residual: m, the largest motion that the last outer iteration wanted to make of a free vertex; for Newton's method the estimate of
    the error of the step; in the paper's mode the norm of the truncated motion of all vertices.
    force_residual: N, the largest force on a free vertex that was left at the start of the last outer iteration, and force_scale, N, the
    largest force of inertia to compare it with; 0 for other methods than Newton's.
    lag: m, how far what is furthest behind its script or command is behind where it should be; message names it. searches: outer iterations that were turned back because
    the potential rose. chords: in how many straight pieces what turns was led, at most. forces: of contact, where `Simulation.step` was asked for them. quarantined: bodies that
    ignored each other in this step. smallest_gap: m beyond the minimum separation, inf without contact. milliseconds: solver, ccd (culling and
    CCD), barrier, misc.
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
    searches: int = 0
    chords: int = 0
    lag: float = 0.0
    force_residual: float = 0.0
    force_scale: float = 0.0
    forces: ContactForces | None = None
    quarantined: tuple[tuple[str, str], ...] = ()

    @property
    def estimated_error(self) -> float:
        """m; see residual."""
        return self.residual


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
    return replayed(stepping(model, state, work or Work(model), observe, into))


def stepping(
    model: Model, state: State, work: Work, observe: Callable | None = None, into: State | None = None
) -> Generator[Graph, None, StepResult]:
    """`step` as a task (`launch.Task`), so that the steps of several simulations go side by side."""
    _belongs(model, state, work)
    report, motions = yield from _solve(model, state, work, observe is not None)
    if report[FOREIGN]:
        _judge(model, state, work)
    if observe is not None:
        for motion in motions:
            observe(*motion)
    return _result(model, state, work, report, into)


def _solve(model: Model, state: State, work: Work, observed: bool) -> Generator[Graph, None, tuple[list[float], list]]:
    """Takes the step, again from its start whenever a list was full; returns the report, and the motions that were committed, where they are observed."""
    work.foreign.zero_()
    model.device.launch(work.kernels.compare, model.vertex_count, [state.positions, work.x, work.foreign])
    work.set_scripted(state)
    work.ignore(state.quarantined)
    if state.step % RESTRUCTURE_EVERY == 0:
        work.candidates.restructure(state.positions)
    while True:
        wp.copy(work.x_start, state.positions)
        wp.copy(work.v_start, state.velocities)
        wp.copy(work.a_start, state.accelerations)
        wp.copy(work.rest, state.remainders)
        motions = []
        if not observed:
            yield from work.run(algorithm.time_step)
        else:
            yield from work.run(algorithm.begin)
            while int(work.going.numpy()[0]) != 0:
                begin = wp.clone(work.x)
                yield from work.run(algorithm.outer_iteration)
                motions.append((begin, wp.clone(work.x)))
            yield from work.run(algorithm.finish)
        report = work.report.numpy().tolist()
        if report[status.STATUS] != status.OVERFLOW:
            return report, motions
        if not work.grow():  # a list was full: with more room, the step is taken again
            raise AssertionError("a list overflowed that had room")


def _result(model: Model, state: State, work: Work, report: list[float], into: State | None) -> StepResult:
    """What the step came to, and its new state."""
    s, code, outer = model.settings, int(report[status.STATUS]), int(report[status.OUTER])
    time, number = state.time + s.time_step, state.step + 1
    reached, lag, behind = work.script.settle(time, state.reached, report[FIRST_NUMBER + status.LAG], work.x)
    message = {
        status.CONVERGED: behind,
        status.LAGGING: behind,
        status.CAPPED: f"the cap of {s.max_outer} outer iterations ended the step",
        status.OUT_OF_TIME: f"the time budget of {s.budget_ms or 0.0:g} ms ended the step after {outer} outer iterations",
        status.STALLING: f"no direction lowered the potential any more after {outer} outer iterations"
        + (", where float32 tells no more" if model.real.name == "float32" else ""),
        status.NOT_FINITE: "the iterate is not finite; the step kept the last feasible state",
    }[code]
    if lag > 0.0 and code not in (status.LAGGING, status.CONVERGED):
        message += f"; {behind}"
    ignoring, left = work.quarantine.names(state.quarantined), state.quarantined
    if ignoring:
        left = work.quarantine.left(work.x.numpy().astype(np.float64), left)
    new = into or State(
        positions=wp.empty_like(work.x),
        velocities=wp.empty_like(work.v),
        accelerations=wp.empty_like(work.a),
        remainders=wp.empty_like(work.rest),
        reached=reached,
    )
    wp.copy(new.positions, work.x)
    wp.copy(new.velocities, work.v)
    wp.copy(new.accelerations, work.a)
    wp.copy(new.remainders, work.rest_end)
    new.reached, new.quarantined, new.time, new.step = reached, left, time, number
    return StepResult(
        state=new,
        converged=code in (status.CONVERGED, status.LAGGING),
        message=message,
        constraints=model.projector.count,
        barriers=int(report[status.BARRIERS]),
        local_global=int(report[LOCAL_GLOBAL]),
        outer=outer,
        linear_iterations=int(report[LINEAR]),
        truncations=int(report[status.TRUNCATIONS]),
        residual=report[FIRST_NUMBER + status.MOVED],
        smallest_gap=report[GAP],
        milliseconds=dict(zip(status.STAGES, report[TIMES:], strict=True)),
        searches=int(report[status.SEARCHES]),
        chords=int(report[CHORDS]),
        lag=lag,
        force_residual=report[FIRST_NUMBER + status.FORCE],
        force_scale=report[FIRST_NUMBER + status.FORCE_SCALE],
        quarantined=ignoring,
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
    if wrong := rigid.torn(assembly, state.positions.numpy().astype(np.float64)):
        work.x.fill_(wp.nan)  # so that it is judged again
        raise ValueError(f"the state at t = {state.time:g} s cannot be: {wrong}")
    pairs = find_intersections(state.positions.numpy(), triangles, assembly.obstacle)
    pairs = pairs[~work.quarantine.excuses(pairs, state.quarantined)]
    if len(pairs):
        work.x.fill_(wp.nan)  # so that it is judged again
        names = [assembly.bodies[body].name for body in assembly.body_of_vertex[triangles[pairs[0]][:, 0]]]
        raise ValueError(
            f"the state at t = {state.time:g} s has {len(pairs)} pairs of triangles that intersect, such as triangle {pairs[0][0]} "
            f'of "{names[0]}" and {pairs[0][1]} of "{names[1]}"; a step starts from a state without intersections'
        )
