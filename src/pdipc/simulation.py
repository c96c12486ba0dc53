"""Running a scene: in memory (`Simulation`, `simulate`) or into a folder that survives a kill (`run_scene`)."""

import dataclasses
import json
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from pdipc.audit.contact import collect, mean
from pdipc.control.commands import Controls
from pdipc.control.phases import model_at
from pdipc.device.launch import Graph, one_at_a_time, replayed
from pdipc.drive import StepResult, stepping
from pdipc.model import Model, State, build
from pdipc.scene.schema import Scene
from pdipc.work import Work

if TYPE_CHECKING:
    from pdipc.output.results import Run, RunWriter

CHECKPOINT_SECONDS = 10.0  # a checkpoint is written when the last one is older
STATES = ("positions", "velocities", "accelerations", "remainders")  # arrays of a checkpoint with a row for each vertex


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


class Simulation(Controls):
    """A scene in motion: a model, its state and its buffers; and between steps, what leads obstacles, pins and bodies (`Controls`).

    device: "cpu", "cuda:0", or None for the scene's choice. observe(x, x_end): see `pdipc.drive.step`.
    state: the current one, whose arrays every step overwrites (`state.copy()` keeps it).
    """

    def __init__(self, scene: Scene | Model, device: str | None = None, observe: Callable | None = None):
        self.model = scene if isinstance(scene, Model) else build(scene, device)
        self.state: State = self.model.initial_state()
        self.work = Work(self.model)
        self.observe = observe
        self._writer: RunWriter | None = None

    @property
    @one_at_a_time
    def positions(self) -> np.ndarray:
        """(n, 3) float64, m."""
        return self.state.positions.numpy().astype(np.float64)

    @property
    @one_at_a_time
    def velocities(self) -> np.ndarray:
        """(n, 3) float64, m/s: at the end of the last step."""
        return self.state.velocities.numpy().astype(np.float64)

    @property
    def steps_done(self) -> int:
        """Steps since the start; a step may be several sub-steps."""
        return self.state.step // self.model.substeps

    @property
    def triangles(self) -> np.ndarray:
        """(m, 3) int32: the surface of every body and obstacle."""
        return self.model.triangles

    @one_at_a_time
    def step(self, forces: bool = False) -> StepResult:
        """One step of the scene's time_step, in its sub-steps; the result's counts are summed over them.

        forces: also the forces of contact, `result.forces`, on vertices, bodies and pairs of bodies.
        Raises RunError where the step is to be recorded and does not follow the last one that was, or there is no room.
        """
        if self._writer is None:
            return replayed(self.stepping(forces))
        self._writer.expects(self.steps_done + 1)
        result = replayed(self.stepping(forces=True))
        assert result.forces is not None
        contact = result.forces.arrays(vertices=False)
        self._writer.append(self.steps_done, self.state.time, self.positions, stats_of(result), contact)
        return result

    @contextmanager
    def record(self, folder: str | Path, overwrite: bool = False) -> Iterator[None]:
        """Within it every step is a frame of a new run folder: what commands did can be looked at, checked and exported as any run.

        The folder holds the scene, which knows nothing of commands, and says in run.json that there may have been some. Results of steps have
        `forces`, whether asked for or not.

        Raises RunError unless it begins at the start, before the first step or after `reset`, and where the folder does not take a run.
        """
        from pdipc.output.results import RunError

        if self._writer is not None or self.steps_done > 0:
            now = f"{self.steps_done} steps are done" if self._writer is None else f"{self._writer.folder} is being recorded"
            raise RunError(f"{folder}: a recording begins at the start, and {now}; reset first")
        with writer_of(self, folder, None, overwrite, live="commands between steps") as writer:
            writer.append(0, 0.0, self.positions, _ignoring(self))
            self._writer = writer
            try:
                yield
            finally:
                self._writer = None
                if self.steps_done == writer.frames[-1][0]:
                    writer.checkpoint(self.steps_done, self.state.arrays())

    def stepping(self, forces: bool = False) -> Generator[Graph, None, StepResult]:
        """`step` as a task; see `pdipc.drive.stepping`."""
        self.model.device.refuse_forked()
        results, contact = [], []
        for _ in range(self.model.substeps):
            self._hold()
            results.append((yield from stepping(self.model, self.state, self.work, self.observe, into=self.state)))
            if forces:
                contact.append(collect(self.model, self.positions, self.work.method.exerted()))
        result = _merge(results)
        result.forces = mean(contact) if forces else None
        return result

    def _hold(self) -> None:
        """Changes the model where pins begin or end; commands go on."""
        model = model_at(self.model, self.state)
        if model is not self.model:
            before, self.model = self.work, model
            self.work = Work(model)
            self.work.loads.take_over(before.loads)
            self.work.follow(before.script.leads)
            wp.copy(self.work.x, before.x)  # what was proven: a state from elsewhere is judged, whatever pins do

    @one_at_a_time
    def reset(self) -> None:
        """Back to the start, with no command."""
        self.work.follow({})
        self.work.loads.reset()
        self.state = self.model.initial_state()
        self._hold()
        wp.copy(self.work.x, self.state.positions)  # the start was judged when the model was built
        self.work.candidates.invalidate()


def _merge(results: list[StepResult]) -> StepResult:
    """Of a step's sub-steps: counts and times add up, lengths are the worst, the rest is that of the last."""
    if len(results) == 1:
        return results[0]
    merged = {
        field.name: _merged(field.name, [getattr(r, field.name) for r in results]) for field in dataclasses.fields(StepResult)
    }
    return StepResult(**merged)


def _merged(name: str, values: list[Any]) -> Any:
    known = [value for value in values if value is not None]
    if not known:
        return None
    last = known[-1]
    if name in ("constraints", "barriers"):
        return max(known)
    if name == "smallest_gap":
        return min(known)
    if isinstance(last, tuple):  # the quarantined of the first: fewer later
        return known[0]
    if isinstance(last, bool):
        return all(known)
    if isinstance(last, int):
        return sum(known)
    if isinstance(last, float):
        return max(known)
    if isinstance(last, str):
        return "; ".join(dict.fromkeys(filter(None, known)))
    if isinstance(last, dict):
        return {key: sum(value[key] for value in known) for key in last}
    return last


def simulate(scene: Scene | Model, steps: int | None = None, device: str | None = None, forces: bool = False) -> "Frames":
    """Gives a `Frame` after each step: `for frame in pdipc.simulate(scene, steps=100): ...`. forces: see `Simulation.step`."""
    return Frames(scene, steps, device, forces)


class Frames(Iterator[Frame]):
    """The frames of a simulation, one after the other; their number is known, as bars of progress ask for."""

    def __init__(self, scene: Scene | Model, steps: int | None, device: str | None, forces: bool):
        described = scene.scene if isinstance(scene, Model) else scene
        self._left = described.simulation.steps if steps is None else steps
        self._make: Callable[[], Simulation] = lambda: Simulation(scene, device)
        self._simulation: Simulation | None = None
        self._forces = forces

    def __len__(self) -> int:
        return self._left

    def __next__(self) -> Frame:
        if self._left <= 0:
            raise StopIteration
        self._simulation = simulation = self._simulation or self._make()
        result = simulation.step(self._forces)
        self._left -= 1
        return Frame(simulation.steps_done, simulation.state.time, simulation.positions, result)


def stats_of(result: StepResult) -> dict[str, Any]:
    """A step's statistics as plain values, named after the columns of the paper's Table 1; None for what is not finite."""
    record = {
        field.name: getattr(result, field.name) for field in dataclasses.fields(result) if field.name not in ("state", "forces")
    }
    return {name: None if isinstance(value, float) and not np.isfinite(value) else value for name, value in record.items()}


def run_scene(
    scene: Scene,
    out_dir: str | Path,
    *,
    steps: int | None = None,
    device: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    certify: bool = False,
    forces: bool = False,
    progress: Callable[[StepInfo], None] | bool | None = None,
) -> None:
    """Simulates `scene` into the folder `out_dir`: frames, statistics, checkpoints. The folder is locked meanwhile.

    A run that was stopped, at any moment and by whatever, goes on with `resume=True` from its last checkpoint, and gives the same bits
    as one that was not. certify: also record every committed motion, for `pdipc certify`. forces: of contact on every vertex, too; those on
    bodies and between them are always recorded. progress: called after each step; True for a bar
    in the terminal or notebook.

    Raises SceneError for a scene that cannot be simulated, before anything is launched; RunError where the folder does not take this
    run, is being written by another process, or has no room.
    """
    from pdipc.output.progress import bar_of_steps

    if progress is True:
        with bar_of_steps(scene.simulation.steps if steps is None else steps) as advance:
            return run_scene(
                scene,
                out_dir,
                steps=steps,
                device=device,
                resume=resume,
                overwrite=overwrite,
                certify=certify,
                forces=forces,
                progress=advance,
            )
    begun = begun_run(scene, out_dir) if resume else None
    if begun is not None:
        device = device or begun.meta.get("device")
    simulation = Simulation(scene, device)
    steps = scene.simulation.steps if steps is None else steps
    with writer_of(simulation, out_dir, begun, overwrite) as writer:
        replayed(running(simulation, writer, steps, certify, forces, progress or None))


def begun_run(scene: Scene, folder: str | Path) -> "Run":
    """The run of a scene that was begun in `folder`. Raises RunError where it is of another scene."""
    from pdipc.output.results import RunError, open_run

    begun = open_run(folder)
    if where := _first_difference(_without_steps(Scene.model_validate(begun.scene)), _without_steps(scene)):
        raise RunError(f"{folder} holds a run of another scene ({where} differs); resume it with its own scene and options")
    return begun


def _ignoring(simulation: Simulation) -> dict[str, Any]:
    """The record of a start: which bodies ignore each other there."""
    ignoring = simulation.work.quarantine.names(simulation.state.quarantined)
    return {"quarantined": ignoring} if ignoring else {}


def writer_of(
    simulation: Simulation, folder: str | Path, begun: "Run | None", overwrite: bool = False, live: str | None = None
) -> "RunWriter":
    """What writes a simulation's run into `folder`, or goes on with the one that was begun there. live: what may have led it that is not
    in its scene. Raises RunError.
    """
    from pdipc.output.results import RunError, RunWriter

    model = simulation.model
    made_by = {"device": model.device.name, "precision": model.real.name}
    if begun is not None:
        for name, now in made_by.items():
            if begun.meta.get(name, now) != now:
                raise RunError(
                    f"{folder} was run on {begun.meta[name]}; going on with {name} {now} would not give the same results"
                )
        return RunWriter.resume(folder)
    topology = {"triangles": model.triangles, **model.assembly.topology()}
    dropped = 0.0 if model.solver is None else model.solver.dropped
    meta = {**made_by, "threads": model.device.threads, "solver_dropped": dropped}
    if model.assembly.separated:
        meta["moved_at_the_start"] = model.assembly.separated
    if live is not None:
        meta["live"] = live
    return RunWriter.create(folder, model.scene.model_dump_json(), topology, meta, overwrite=overwrite)


def _without_steps(scene: Scene) -> dict[str, Any]:
    data = json.loads(scene.model_dump_json())
    del data["simulation"]["steps"]
    return data


def _first_difference(a: Any, b: Any, path: str = "") -> str | None:
    """The key of the first value that differs, such as "bodies[0].material.density"; None where all are the same."""
    if isinstance(a, dict) and isinstance(b, dict):
        inner = ((f"{path}.{name}" if path else str(name), a.get(name), b.get(name)) for name in sorted({*a, *b}))
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        inner = ((f"{path}[{i}]", mine, other) for i, (mine, other) in enumerate(zip(a, b, strict=True)))
    else:
        return None if a == b else path
    return next(filter(None, (_first_difference(mine, other, where) for where, mine, other in inner)), None)


def _go_on_from(checkpoint: tuple[int, dict[str, np.ndarray]], simulation: Simulation, writer: "RunWriter") -> None:
    """Puts the simulation into the state of a checkpoint. Raises RunError where its arrays are whole, and no state of this scene."""
    from pdipc.output.results import RunError

    try:
        state, right = simulation.model.state_from(checkpoint[1]), simulation.state.positions.shape
        if wrong := [name for name in STATES if getattr(state, name).shape != right]:
            raise ValueError(f"its {wrong[0]} have the shape {getattr(state, wrong[0]).shape}; those of the scene {right}")
    except (LookupError, TypeError, ValueError, RuntimeError) as error:
        path = writer.folder / "checkpoints" / f"{checkpoint[0]:06d}.npz"
        said = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise RunError(f"{path} holds no state of this scene: {said}; delete it, or start again with --overwrite") from error
    simulation.state = state


def running(
    simulation: Simulation,
    writer: "RunWriter",
    steps: int,
    certify: bool = False,
    forces: bool = False,
    progress: Callable[[StepInfo], None] | None = None,
) -> Generator[Graph, None, None]:
    """A run from its last checkpoint, or the start where there is none, to the end, as a task (`launch.Task`)."""
    checkpoint = writer.latest_checkpoint()
    if checkpoint is not None:
        _go_on_from(checkpoint, simulation, writer)
    else:
        writer.append(0, 0.0, simulation.positions, _ignoring(simulation))
        writer.checkpoint(0, simulation.state.arrays())
    motions = 0

    def record(x: wp.array, x_end: wp.array) -> None:
        nonlocal motions
        writer.append_segments(simulation.steps_done + 1, motions, x.numpy(), x_end.numpy())
        motions += 1

    if certify:
        simulation.observe = record
    last_checkpoint = time.monotonic()
    done = simulation.steps_done
    whole = False  # whether the state is that of the last frame: an interrupt may come in the middle of a step
    try:
        while done < steps:
            whole, motions = False, 0
            result = yield from simulation.stepping(forces=True)
            assert result.forces is not None
            contact = result.forces.arrays(vertices=forces)
            writer.append(simulation.steps_done, simulation.state.time, simulation.positions, stats_of(result), contact)
            done, whole = simulation.steps_done, True
            if time.monotonic() - last_checkpoint > CHECKPOINT_SECONDS or done == steps:
                writer.checkpoint(done, simulation.state.arrays())
                last_checkpoint = time.monotonic()
            if progress is not None:
                progress(StepInfo(done, steps, result))
    except KeyboardInterrupt:
        if whole:
            writer.checkpoint(done, simulation.state.arrays())
        raise
