"""What the figures share: optional data, runs that go on where they were stopped, pictures, the last sentence."""

import csv
import datetime
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.device.launch import Device
from pdipc.judge.witness import find_intersections
from pdipc.output.results import Run, RunWriter, open_run
from pdipc.pictures.render import drawing, settings_of
from pdipc.scene.assembly import assemble
from pdipc.scene.schema import Scene
from pdipc.simulation import StepInfo, run_scene

CHECKOUT = Path(__file__).parents[3]
EVERY = 60.0  # s, between the lines that a log is told
Arrays = dict[str, np.ndarray]


def data(name: str) -> Path | None:
    """The file `name` of the optional data: in the folder PDIPC_DATA, else in `shared/data` beside a checkout. None: not there."""
    path = Path(os.environ.get("PDIPC_DATA", CHECKOUT.parent / "shared" / "data")) / name
    return path if path.exists() else None


# --- runs ---


def simulated(
    scene: Scene,
    folder: Path,
    label: str,
    device: str | None = None,
    steps: int | None = None,
    after: Callable[[], Any] = lambda: None,
) -> Run:
    """The run of `scene` in `folder`. One of the same scene that was stopped goes on; one that is complete is only read.

    steps: in place of the scene's. after: called after each step that is made.
    """
    resume = _begun(scene, folder)
    with progress(label, scene.simulation.steps if steps is None else steps) as advance:

        def made(info: StepInfo) -> None:
            after()
            advance(info.step, f"outer {info.result.outer:<3d} contacts {info.result.barriers}")

        run_scene(
            scene,
            folder,
            steps=steps,
            device=device,
            resume=resume,
            overwrite=not resume,
            progress=made,
        )
    return open_run(folder)


def stepped(
    scene: Scene,
    folder: Path,
    label: str,
    step: Callable[[int, Arrays], tuple[Arrays, dict]],
    first: Arrays | None = None,
) -> Run:
    """As `simulated`, but by another method: step(k, arrays) makes step k; it returns the new arrays and its statistics.

    first: the arrays that it starts from; absent, the scene's positions and velocities, (n, 3).
    """
    if _begun(scene, folder):
        writer = RunWriter.resume(folder)
        done, arrays = writer.latest_checkpoint() or (0, {})
    else:
        assembly = assemble(scene)
        topology = {"triangles": assembly.triangles, **assembly.topology()}
        writer = RunWriter.create(folder, scene.model_dump_json(), topology, {"device": "cpu"}, overwrite=True)
        done, arrays = 0, first or {"positions": assembly.positions, "velocities": assembly.velocities}
        writer.append(0, 0.0, assembly.positions, {})
        writer.checkpoint(0, arrays)
    with writer, progress(label, scene.simulation.steps) as advance:
        for k in range(done, scene.simulation.steps):
            arrays, stats = step(k, arrays)
            writer.append(k + 1, (k + 1) * scene.simulation.time_step, arrays["positions"], stats)
            writer.checkpoint(k + 1, arrays)
            advance(k + 1, "")
    return open_run(folder)


def _begun(scene: Scene, folder: Path) -> bool:
    """Whether `folder` holds a run of this very scene."""
    return (folder / "run.json").is_file() and open_run(folder).scene == json.loads(scene.model_dump_json())


def intersections(run: Run) -> list[int]:
    """Pairs of triangles that the independent witness finds in each frame."""
    found = []
    with progress(f"{run.folder.name}: witness", run.frame_count) as advance:
        for frame in range(run.frame_count):
            found.append(len(find_intersections(run.positions(frame), run.triangles, run.obstacle)))
            advance(frame + 1, "")
    return found


@contextmanager
def progress(label: str, total: int) -> Iterator[Callable[[int, str], None]]:
    """A bar on stderr, or where that is no terminal a line now and then; yields a function that takes how much is done, and what to
    say of it.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lines_of_progress(label, total, lambda line: print(line, file=sys.stderr, flush=True))
        return
    columns = [TextColumn(label), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.fields[told]}")]
    with Progress(*columns, TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task(label, total=total, told="")
        yield lambda done, told: bar.update(task, completed=done, told=told)


def lines_of_progress(
    label: str, total: int, write: Callable[[str], None], clock: Callable[[], float] = time.monotonic
) -> Callable[[int, str], None]:
    """What a log is told: a line each minute, with the time that is left at the rate so far, and one at the end."""
    begun, last, first = clock(), clock(), None

    def advance(done: int, told: str) -> None:
        nonlocal last, first
        now = clock()
        if first is None:
            first = done  # a run that goes on has done the steps before
        if done == total or now - last >= EVERY:
            last = now
            rate = (done - first + 1) / max(now - begun, 1e-9)
            left = datetime.timedelta(seconds=round((total - done) / rate))
            write(f"{label}: {done}/{total} {told}, {left} left".replace(" ,", ","))

    return advance


# --- what is written ---


def machine(device: Device) -> str:
    """The machine, for captions."""
    if device.is_cuda:
        return device.warp.name
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor() or platform.machine()}, {device.threads} threads"


def pictures(
    run: Run,
    frames: Iterable[int],
    size: tuple[int, int],
    view: tuple[float, float, float] | None = None,
    framed: Iterable[int] | None = None,
    beside: Run | None = None,
) -> list[np.ndarray]:
    """The given frames, (height, width, 3) uint8 each, under one camera that holds all of `framed` (else of `frames`).

    view: absent, that of the scene. beside: a run under whose camera, which holds all of `framed` of that run, this one is drawn.
    """
    frames = list(frames)
    framed = list(frames if framed is None else framed)
    settings = settings_of(run).model_copy(update={"size": size} | ({"view": view} if view else {}))
    if beside is not None:
        with drawing(beside, framed, settings) as drawn:
            camera = drawn.plotter.camera
            place = {"position": tuple(camera.position), "target": tuple(camera.focal_point)}
        settings, framed = settings.model_copy(update=place), frames
    with drawing(run, framed, settings) as drawn:
        return [drawn.image(frame) for frame in frames]


def write_table(path: Path, header: Iterable[str], rows: Iterable[Iterable]) -> None:
    """A CSV file."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def conclude(picture: Path, sentence: str) -> Path:
    """Prints what the paper shows and what was seen, and keeps it beside the picture, which is returned."""
    picture.with_suffix(".txt").write_text(sentence + "\n")
    print(sentence)
    return picture


# --- bodies where the data is absent ---

# Capsules: two ends, m, and a radius. About 1 m tall, y up, facing -z.
DINOSAUR = [
    ((0, 0.0, -0.02), (0, 0.12, -0.12), 0.16),
    ((0, 0.15, -0.15), (0, 0.36, -0.3), 0.085),
    ((0, 0.4, -0.3), (0, 0.35, -0.47), 0.085),
    ((0, 0.0, 0.05), (0, -0.12, 0.3), 0.1),
    ((0, -0.12, 0.3), (0, -0.2, 0.52), 0.065),
    *(((side * 0.12, -0.02, 0.0), (side * 0.13, -0.28, -0.02), 0.085) for side in (-1, 1)),
    *(((side * 0.13, -0.28, -0.02), (side * 0.13, -0.42, -0.06), 0.075) for side in (-1, 1)),
    *(((side * 0.12, 0.12, -0.18), (side * 0.14, 0.03, -0.32), 0.06) for side in (-1, 1)),
]
BIPED = [
    ((0, 0.02, 0), (0, 0.2, 0), 0.19),
    ((0, 0.38, -0.02), (0, 0.36, -0.1), 0.13),
    ((0, -0.1, 0.1), (0, -0.2, 0.38), 0.06),
    *(((side * 0.15, 0.2, 0), (side * 0.34, 0.3, -0.08), 0.085) for side in (-1, 1)),
    *(((side * 0.34, 0.3, -0.08), (side * 0.42, 0.42, -0.25), 0.075) for side in (-1, 1)),
    *(((side * 0.12, -0.1, 0), (side * 0.22, -0.38, 0), 0.1) for side in (-1, 1)),
    *(((side * 0.22, -0.42, 0), (side * 0.24, -0.42, -0.12), 0.08) for side in (-1, 1)),
]


def creature(capsules: list, cell: float) -> dict:
    """A union of capsules as a mesh table of a scene: cubes of side `cell`, m, six tets each, with their corners drawn towards
    the round surface as far as no tet loses more than two thirds of its volume.
    """
    from pdipc.scene.generators import lattice
    from pdipc.scene.meshes import Mesh, tet_volumes

    first, last, radius = (np.array(column, dtype=float) for column in zip(*capsules, strict=True))

    def outside(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance to the surface, negative inside, (n,), and its gradient, (n, 3)."""
        along = last - first
        t = np.clip(((x[:, None] - first) * along).sum(axis=2) / (along**2).sum(axis=1), 0, 1)
        away = x[:, None] - first - t[:, :, None] * along
        length = np.linalg.norm(away, axis=2)
        near = np.argmin(length - radius, axis=1)
        rows = np.arange(len(x))
        return (length - radius)[rows, near], away[rows, near] / np.maximum(length[rows, near], 1e-9)[:, None]

    low, high = np.min([first, last], axis=(0, 1)) - radius.max(), np.max([first, last], axis=(0, 1)) + radius.max()
    cells = np.ceil((high - low) / cell).astype(int)
    points, tets = lattice(tuple(cells))
    x = 0.5 * (low + high) + 0.5 * cell * cells * points
    cubes = tets.reshape(len(tets) // 6, 24)
    mesh = Mesh.of_tets(x, cubes[outside(x[cubes].mean(axis=1))[0] < 0].reshape(-1, 4))
    x, skin, whole = mesh.vertices, np.unique(mesh.triangles), cell**3 / 6
    for _ in range(8):
        distance, gradient = outside(x[skin])
        trial = x.copy()
        trial[skin] -= 0.4 * np.clip(distance, -cell, cell)[:, None] * gradient
        while len(crushed := mesh.tets[tet_volumes(trial, mesh.tets) < whole / 3]):
            trial[crushed] = x[crushed]
        x = trial
    return {"vertices": x, "tets": mesh.tets}
