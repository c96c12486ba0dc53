"""A scene by this package and by IPC, from one model: the same masses, energies, barrier and friction, timed alike."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.drive import step
from pdipc.model import Model, build
from pdipc.output.results import Run
from pdipc.reproduce import _common
from pdipc.scene.schema import Scene
from pdipc.work import Work

TIME = "seconds"  # of the processor, of all threads together; on a GPU of the clock


def with_arap(scene: Scene) -> Scene:
    """The scene with the energy that IPC has here as well: as rigid as possible (Section 7.3)."""
    data = scene.model_dump()
    for body in data["bodies"]:
        if body["kind"] == "solid":
            body["material"]["model"] = "arap"
    return Scene.model_validate(data)


def ours(scene: Scene, folder: Path, device: str | None = None) -> Run:
    """The run of this package. Its steps' statistics: outer, barriers, converged, seconds."""
    model = build(scene, device)
    first = model.initial_state().arrays()
    made = Ours(model)
    return _common.stepped(scene, folder, "this package", lambda _, arrays: made.step(arrays), first)


def theirs(scene: Scene, folder: Path) -> Run:
    """The run of IPC. Its steps' statistics: outer (Newton iterations), converged, seconds."""
    made = Theirs(build(scene, "cpu"))
    return _common.stepped(scene, folder, "IPC", made.step)


class Ours:
    """Steps of this package, of any state."""

    def __init__(self, model: Model):
        self.model, self.work = model, Work(model)
        self.clock: Callable[[], float] = time.perf_counter if model.device.is_cuda else time.process_time
        step(model, model.initial_state(), self.work)  # compiles

    def step(self, arrays: dict[str, Any]) -> tuple[dict[str, Any], dict]:
        """The state after the one of `arrays`, and what it took."""
        state, begun = self.model.state_from(arrays), self.clock()
        result = step(self.model, state, self.work)
        told = {"outer": result.outer, "barriers": result.barriers, "converged": result.converged}
        return result.state.arrays(), told | {TIME: self.clock() - begun}


class Theirs:
    """Steps of IPC, to the tolerance of the model."""

    def __init__(self, model: Model):
        from pdipc.baselines.reference import Reference

        self.model, self.reference = model, Reference(model)

    def step(self, k: int, arrays: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict]:
        """The state after step k, which starts from positions and velocities (n, 3), and what it took."""
        from pdipc.baselines import ipc

        settings = self.model.settings
        self.reference.state = ipc.State(arrays["positions"].astype(float), arrays["velocities"].astype(float))
        self.reference.time = k * settings.time_step
        begun = time.process_time()
        info = self.reference.step(tolerance=settings.tolerance)
        state = self.reference.state
        told = {"outer": info.iterations, "converged": info.converged, TIME: time.process_time() - begun}
        return {"positions": state.positions, "velocities": state.velocities}, told


def single_steps(scene: Scene, made: Run, steps: Sequence[int], folder: Path) -> Run:
    """IPC makes some steps of a run of this package, each from the state that the run's step starts from. The frames of what is
    returned are the ends of these steps.
    """
    shorter = scene.model_copy(deep=True)
    shorter.simulation.steps = len(steps)
    ipc, h = Theirs(build(scene, "cpu")), scene.simulation.time_step

    def step(k: int, _: _common.Arrays) -> tuple[_common.Arrays, dict]:
        start = steps[k] - 1
        x = made.positions(start)
        before = made.positions(start - 1) if start else x - h * ipc.model.assembly.velocities
        return ipc.step(start, {"positions": x, "velocities": (x - before) / h})

    return _common.stepped(shorter, folder, "IPC", step)
