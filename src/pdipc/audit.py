"""Energies, momenta and contact forces of a state: what `pdipc audit` prints, and what tests compare with mechanics."""

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
    gravity = np.asarray(model.scene.simulation.gravity)
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
def contact_forces(model: Model, state: State, work: Work) -> np.ndarray:
    """(n, 3) N: the barrier's force on every vertex, on obstacles too; the resultant on a body is the sum over its vertices.

    Without friction, which depends on a step and not on a state alone. So do the targets of the paper's contact: there all is NaN.
    """
    if model.settings.method == "paper":
        return np.full((model.vertex_count, 3), np.nan)
    work.list_pairs(state.positions)
    return work.pairs.forces(state.positions).numpy().astype(np.float64)


def body_forces(model: Model, state: State, work: Work) -> dict[str, np.ndarray]:
    """(3,) N by the name of a body or obstacle: the resultant of the contact forces on it."""
    force = contact_forces(model, state, work)
    return {body.name: force[body.first : body.last].sum(axis=0) for body in model.assembly.bodies}


def vertex_areas(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) m^2: a third of the triangles around each surface vertex, 0 inside."""
    corners = positions[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = np.zeros(len(positions))
    for corner in range(3):
        np.add.at(total, triangles[:, corner], area / 3.0)
    return total


def contact_pressures(model: Model, state: State, work: Work) -> np.ndarray:
    """(n,) Pa: magnitude of the contact force over the area around each surface vertex."""
    force = np.linalg.norm(contact_forces(model, state, work), axis=1)
    area = vertex_areas(state.positions.numpy().astype(np.float64), model.triangles)
    return np.where(area > 0.0, force / np.maximum(area, 1e-300), 0.0)


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
