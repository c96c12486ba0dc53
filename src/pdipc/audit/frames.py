"""States and forces of a run's frames, made again from what the run has kept."""

from collections.abc import Iterable, Iterator

import numpy as np

from pdipc.audit.energies import barrier_forces
from pdipc.model import Model, State, build
from pdipc.output.results import Run
from pdipc.scene.schema import Scene
from pdipc.work import Work


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
