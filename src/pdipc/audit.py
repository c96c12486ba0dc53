"""Energies and momenta of a state, and the barrier's forces in it: what `pdipc audit` prints, and what tests compare with mechanics."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from pdipc.device.launch import one_at_a_time
from pdipc.model import Model, State, build
from pdipc.output.results import Run
from pdipc.scene.schema import Scene
from pdipc.work import Work


@dataclass
class Audit:
    """Energies in J; linear momentum (3,) in kg m/s and angular momentum about the origin (3,) in kg m^2/s.

    gravity: potential energy with the origin as its zero. Kinematic vertices do not count.
    """

    time: float
    kinetic: float
    elastic: float
    barrier: float
    gravity: float
    linear_momentum: np.ndarray
    angular_momentum: np.ndarray

    @property
    def total(self) -> float:
        """Sum of the four energies."""
        return self.kinetic + self.elastic + self.barrier + self.gravity


@one_at_a_time
def audit(model: Model, state: State, work: Work) -> Audit:
    """The energies and momenta of `state`."""
    work.list_pairs(state.positions)
    if model.projector.cavities is not None:
        model.projector.cavities.reference.zero_()
    numbers = wp.zeros(2, dtype=model.real.scalar, device=model.device.warp)
    model.projector.energy(state.positions, state.remainders, numbers, 0)
    work.pairs.energy(numbers, 1)
    elastic, barrier = (float(value) for value in numbers.numpy())
    mass = model.external.mass[:, None]
    x, v = state.positions.numpy().astype(np.float64), state.velocities.numpy().astype(np.float64)
    gravity = work.loads.external.gravity[0]
    return Audit(
        time=state.time,
        kinetic=0.5 * float((mass * v * v).sum()),
        elastic=elastic,
        barrier=barrier,
        gravity=-float((mass * x * gravity).sum()),
        linear_momentum=(mass * v).sum(axis=0),
        angular_momentum=np.cross(x, mass * v).sum(axis=0),
    )


@one_at_a_time
def barrier_forces(model: Model, state: State, work: Work) -> np.ndarray:
    """(n, 3) N: the barrier's force on every vertex, on obstacles too. Friction and what restitution adds belong to a step and not to a
    state: `Simulation.step(forces=True)` has them.

    Raises ValueError in the paper's mode, whose forces all belong to a step.
    """
    if model.settings.method == "paper":
        raise ValueError(
            "in the paper's mode forces belong to a step, not to a state: run with --forces, or step with forces=True"
        )
    work.list_pairs(state.positions)
    return work.pairs.forces(state.positions).numpy().astype(np.float64)


def replay(run: Run, frames: Iterable[int] | None = None) -> Iterator[tuple[Model, State, Work]]:
    """Frames of a run, all by default, as states that the functions above take; on the CPU, in the precision of the run.

    Velocities follow from the frames, as v = (x - x*) / h does in a step; with sub-steps they are the mean over a step.
    """
    scene = Scene.model_validate(run.scene)
    scene.simulation.precision = run.meta.get("precision", scene.simulation.precision)
    model = build(scene, "cpu")
    work, start = Work(model), model.initial_state().arrays()
    for frame in range(run.frame_count) if frames is None else frames:
        frame = range(run.frame_count)[frame]
        positions, velocities = run.positions(frame), start["velocities"]
        if frame > 0:
            velocities = (positions - run.positions(frame - 1)) / (run.times[frame] - run.times[frame - 1])
        arrays = {"positions": positions, "velocities": velocities, "time": run.times[frame], "step": frame}
        yield model, model.state_from({**start, **arrays}), work


def vertex_forces(run: Run, frames: Iterable[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Normal forces and friction (n, 3), N, on every vertex at each of the frames: as recorded, see `run_scene`; else the barrier's of the
    state, and NaN for friction.

    Raises ValueError for a run in the paper's mode that did not record them.
    """
    paper = run.scene.get("contact", {}).get("method") == "paper"
    asked: list[int] = []
    states = replay(run, iter(asked.pop, None))  # of the frames asked for, one at a time
    for frame in frames:
        forces = run.forces(frame)
        if forces is not None and forces.vertex_normal is not None and forces.vertex_friction is not None:
            yield forces.vertex_normal, forces.vertex_friction
        elif paper and run.records[frame]["step"] == 0:  # nothing has been pushed yet
            nothing = np.zeros((len(run.scripted), 3))
            yield nothing, nothing
        else:
            asked.append(frame)
            normal = barrier_forces(*next(states))
            yield normal, np.full_like(normal, np.nan)
