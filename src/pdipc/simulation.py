"""Running a scene: in memory (`Simulation`, `simulate`) or into a folder that survives a kill (`run_scene`)."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from pdipc.device.launch import one_at_a_time
from pdipc.drive import StepResult, Work, step
from pdipc.model import Model, State, build
from pdipc.scene.schema import Scene

CHECKPOINT_SECONDS = 10.0  # a checkpoint is written when the last one is older


@dataclass
class Frame:
    """One simulated step. positions: (n, 3), m; time: s; result: status and statistics."""

    step: int
    time: float
    positions: np.ndarray
    result: StepResult


@dataclass
class StepInfo:
    """Progress of a run: step of steps done, and the result of the last one."""

    step: int
    steps: int
    result: StepResult


class Simulation:
    """A scene in motion: a model, its state and its buffers.

    device: "cpu", "cuda:0", or None for the scene's choice. observe(x, x_end): see `pdipc.drive.step`.
    state: the current one, whose arrays every step overwrites (`state.copy()` keeps it).
    """

    def __init__(self, scene: Scene | Model, device: str | None = None, observe: Callable | None = None):
        self.model = scene if isinstance(scene, Model) else build(scene, device)
        self.state: State = self.model.initial_state()
        self.work = Work(self.model)
        self.observe = observe

    @property
    def positions(self) -> np.ndarray:
        """(n, 3) float64, m."""
        return self.state.positions.numpy().astype(np.float64)

    @property
    def steps_done(self) -> int:
        """Steps since the start; a step may be several sub-steps."""
        return self.state.step // self.model.substeps

    @property
    def triangles(self) -> np.ndarray:
        """(m, 3) int32: the surface of every body and obstacle."""
        return self.model.triangles

    def set_vertex_force(self, vertices: np.ndarray, forces: np.ndarray) -> None:
        """Pulls the given vertices (k,) with forces (k, 3) in newtons from the next step on, in place of earlier ones.

        Raises ValueError for vertices that are not simulated, forces that are no finite numbers, or lengths that differ.
        """
        vertices, forces = np.asarray(vertices), np.asarray(forces, dtype=np.float64)
        if vertices.size and vertices.dtype.kind not in "iu":
            raise ValueError(f"vertices are {vertices.dtype}; they must be whole numbers")
        vertices = vertices.astype(np.int64)
        if vertices.ndim != 1 or forces.shape != (len(vertices), 3):
            raise ValueError(f"{vertices.shape} vertices and {forces.shape} forces; they must be (k,) and (k, 3)")
        scripted = self.model.assembly.scripted
        if len(unknown := vertices[(vertices < 0) | (vertices >= len(scripted))]):
            raise ValueError(f"there is no vertex {unknown[0]}; vertices are 0 to {len(scripted) - 1}")
        if len(held := vertices[scripted[vertices]]):
            raise ValueError(f"vertex {held[0]} follows a script and cannot be pulled")
        if len(wrong := np.flatnonzero(~np.isfinite(forces).all(axis=1))):
            raise ValueError(f"the force on vertex {vertices[wrong[0]]} is {forces[wrong[0]].tolist()}; it must be finite")
        self.model.external.pulled = (vertices, forces)

    def step(self) -> StepResult:
        """One step of the scene's time_step, in its sub-steps; the result's counts are summed over them."""
        results = []
        for _ in range(self.model.substeps):
            result = step(self.model, self.state, self.work, self.observe, into=self.state)
            results.append(result)
        return _merge(results)

    @one_at_a_time
    def reset(self) -> None:
        """Back to the start, with no vertex pulled."""
        self.set_vertex_force(np.zeros(0), np.zeros((0, 3)))
        self.state = self.model.initial_state()
        wp.copy(self.work.x, self.state.positions)  # the start was judged when the model was built
        self.work.candidates.invalidate()


def _merge(results: list[StepResult]) -> StepResult:
    if len(results) == 1:
        return results[0]
    last = results[-1]
    total = StepResult(**{**last.__dict__})
    for name in ("local_global", "outer", "linear_iterations", "truncations"):
        setattr(total, name, sum(getattr(result, name) for result in results))
    total.barriers = max(result.barriers for result in results)
    total.converged = all(result.converged for result in results)
    total.residual = max(result.residual for result in results)
    total.smallest_gap = min(result.smallest_gap for result in results)
    total.message = "; ".join(dict.fromkeys(result.message for result in results if result.message))
    total.milliseconds = {key: sum(result.milliseconds[key] for result in results) for key in last.milliseconds}
    return total


def simulate(scene: Scene | Model, steps: int | None = None, device: str | None = None) -> Iterator[Frame]:
    """Yields a `Frame` after each step: `for frame in pdipc.simulate(scene, steps=100): ...`."""
    simulation = Simulation(scene, device)
    for _ in range(simulation.model.scene.simulation.steps if steps is None else steps):
        result = simulation.step()
        yield Frame(simulation.steps_done, simulation.state.time, simulation.positions, result)


def stats_of(result: StepResult) -> dict[str, Any]:
    """A step's statistics as plain values, named after the columns of the paper's Table 1."""
    record = {name: value for name, value in result.__dict__.items() if name != "state"}
    if not np.isfinite(record["smallest_gap"]):
        record["smallest_gap"] = None
    return record


def run_scene(
    scene: Scene,
    out_dir: str | Path,
    *,
    steps: int | None = None,
    device: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    certify: bool = False,
    progress: Callable[[StepInfo], None] | None = None,
) -> None:
    """Simulates `scene` into the folder `out_dir`: frames, statistics, checkpoints.

    A run that was stopped goes on with `resume=True`, from its last checkpoint, and gives the same bits as one that was not.
    certify: also record every committed motion, for `pdipc certify`. progress: called after each step.
    Raises SceneError for a scene that cannot be simulated, before anything is launched.
    """
    from pdipc.output.results import RunWriter

    simulation = Simulation(scene, device)
    model = simulation.model
    steps = model.scene.simulation.steps if steps is None else steps
    if resume:
        writer = RunWriter.resume(out_dir)
        checkpoint = writer.latest_checkpoint()
        if checkpoint is not None:
            simulation.state = model.state_from(checkpoint[1])
    else:
        topology = {"triangles": model.triangles, **model.assembly.topology()}
        meta = {"device": model.device.name, "precision": model.real.name, "threads": model.device.threads}
        meta |= {"solver_dropped": model.solver.dropped}
        writer = RunWriter.create(out_dir, model.scene.model_dump_json(), topology, meta, overwrite=overwrite)
        writer.append(0, 0.0, simulation.positions, {})
        writer.checkpoint(0, simulation.state.arrays())
    outer = [0]

    def record(x, x_end) -> None:
        writer.append_segments(simulation.steps_done + 1, outer[0], x.numpy(), x_end.numpy())
        outer[0] += 1

    if certify:
        simulation.observe = record
    last_checkpoint = time.monotonic()
    done = simulation.steps_done
    try:
        while done < steps:
            outer[0] = 0
            result = simulation.step()
            done = simulation.steps_done
            writer.append(done, simulation.state.time, simulation.positions, stats_of(result))
            if time.monotonic() - last_checkpoint > CHECKPOINT_SECONDS or done == steps:
                writer.checkpoint(done, simulation.state.arrays())
                last_checkpoint = time.monotonic()
            if progress is not None:
                progress(StepInfo(done, steps, result))
    except KeyboardInterrupt:
        writer.checkpoint(done, simulation.state.arrays())
        raise
