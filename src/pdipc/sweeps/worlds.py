"""Small scenes side by side: many copies or variants of one, in one process, that do not see each other.

Each world is a simulation with arrays, lists, solver and decisions of its own: it ends up with the same bits as alone, and a world that has
converged, or takes its step again with more room, moves no other. Shared are the process, the compiled kernels, the device, and the cores: on
the CPU one thread replays the recorded step of one world, so that nobody waits for others within a step. That is where small
scenes gain: their kernels are too short to be split over threads.

What this is not: one system of all worlds. On CUDA the steps of worlds follow each other on the device; only the host's part of one goes on
beside the device's part of another.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, overload

import numpy as np

from pdipc.device.launch import Device, Task, one_at_a_time, side_by_side
from pdipc.drive import StepResult
from pdipc.model import Model, build, reassembled
from pdipc.scene.errors import SceneError
from pdipc.scene.schema import Scene
from pdipc.scene.worlds import scenes_of
from pdipc.simulation import Simulation, StepInfo, begun_run, running, writer_of
from pdipc.sweeps.cases import Case
from pdipc.sweeps.run import prepare
from pdipc.sweeps.table import write_table


class Worlds(Sequence[Simulation]):
    """Simulations that step at the same time: `worlds[2]` is one, with all that a `Simulation` has.

    scenes: one, with its `worlds`; or one for each world. worlds: in place of the scene's own, a number of copies, or for each world what is
    other in it, by dotted keys: [{"contact.friction": 0.1}, {"contact.friction": 0.3}]. device: "cpu", "cuda:0", or None for the scenes'
    choice.

    Raises SceneError where any of them cannot be simulated.
    """

    @one_at_a_time
    def __init__(
        self, scenes: Scene | Sequence[Scene], worlds: int | Sequence[dict[str, Any]] | None = None, device: str | None = None
    ):
        if isinstance(scenes, Scene):
            scenes = scenes_of(scenes, worlds)
        elif worlds is not None:
            raise ValueError("worlds are of one scene; a list of scenes has one for each world")
        wanted = {device or scene.simulation.device for scene in scenes}
        if len(wanted) != 1:
            raise SceneError(
                f"worlds share a device; these want {sorted(map(str, wanted))}" if wanted else "there are no worlds"
            )
        place = Device(wanted.pop(), threads=1)
        models: dict[int, Model] = {}
        self._simulations = []
        for number, scene in enumerate(scenes):
            try:
                known = models.get(id(scene))
                model = build(scene, place) if known is None else reassembled(known, known.assembly)
            except SceneError as error:
                raise SceneError(f"world {number}: {error}") from None
            models.setdefault(id(scene), model)
            self._simulations.append(Simulation(model))

    @overload
    def __getitem__(self, number: int) -> Simulation: ...
    @overload
    def __getitem__(self, number: slice) -> list[Simulation]: ...
    def __getitem__(self, number):
        return self._simulations[number]

    def __len__(self) -> int:
        return len(self._simulations)

    @one_at_a_time
    def step(self, forces: bool = False) -> list[StepResult]:
        """One step of each world, see `Simulation.step`. Where one raises, the others have made theirs."""
        return side_by_side([world.stepping(forces) for world in self])

    @property
    def positions(self) -> np.ndarray:
        """(worlds, n, 3) float64, m. Raises ValueError where worlds have different numbers of vertices."""
        counts = sorted({world.model.vertex_count for world in self})
        if len(counts) > 1:
            raise ValueError(f"worlds have {counts[0]} to {counts[-1]} vertices; take the positions of each")
        return np.stack([world.positions for world in self])

    def reset(self) -> None:
        """All worlds back to their start, with no command."""
        for world in self:
            world.reset()

    def checkpoint(self) -> list[dict[str, Any]]:
        """State and commands of each world; see `Simulation.checkpoint`."""
        return [world.checkpoint() for world in self]

    def restore(self, arrays: Sequence[dict[str, Any]]) -> None:
        """Goes on from what `checkpoint` gave."""
        for world, own in zip(self, arrays, strict=True):
            world.restore(own)


def run_worlds(
    scene: Scene,
    out_dir: str | Path,
    *,
    steps: int | None = None,
    device: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    certify: bool = False,
    forces: bool = False,
    progress: Callable[[StepInfo], None] | None = None,
) -> None:
    """Simulates the worlds of a scene, each into a run folder of its own below `out_dir`, 0000, 0001, ..., and makes the table that
    `pdipc.sweeps` describes. The options are those of `run_scene`; progress counts the steps of all worlds.

    Raises SceneError where a world cannot be simulated; RunError where the folder does not take these runs.
    """
    scenes, folder = scenes_of(scene), Path(out_dir)
    changes = scene.worlds if isinstance(scene.worlds, list) else [{}] * len(scenes)
    cases = [Case(k, own, each.model_dump_json()) for k, (own, each) in enumerate(zip(changes, scenes, strict=True))]
    folders = [folder / case.folder for case in cases]
    begun = [
        begun_run(each, own) if resume and (own / "run.json").is_file() else None
        for each, own in zip(scenes, folders, strict=True)
    ]
    device = device or next((run.meta.get("device") for run in begun if run is not None), None)
    worlds = Worlds(scenes, device=device)
    prepare(folder, cases, {"worlds": [case.values for case in cases]}, resume, overwrite)
    goals = [each.simulation.steps if steps is None else steps for each in scenes]
    done = [world.steps_done for world in worlds]
    interrupted: KeyboardInterrupt | None = None

    def tell(number: int, info: StepInfo) -> None:
        nonlocal interrupted
        done[number] = info.step
        if progress is not None and interrupted is None:
            try:
                progress(StepInfo(sum(done), sum(goals), info.result))
            except KeyboardInterrupt as heard:
                interrupted = heard
        if interrupted is not None:  # each world ends its step, and is saved
            raise interrupted

    def run(number: int, writer: Any) -> Task:
        try:
            yield from running(worlds[number], writer, goals[number], certify, forces, lambda info: tell(number, info))
        except KeyboardInterrupt as heard:
            if heard is not interrupted:
                raise

    with ExitStack() as writers:
        tasks = []
        for number, (own, before) in enumerate(zip(folders, begun, strict=True)):
            writer = writers.enter_context(writer_of(worlds[number], own, before, overwrite))
            done[number] = 0 if before is None else before.records[-1]["step"] if before.records else 0
            tasks.append(run(number, writer))
        side_by_side(tasks)
        if interrupted is not None:
            raise interrupted
    write_table(folder, cases, {})
