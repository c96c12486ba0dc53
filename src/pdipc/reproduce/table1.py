"""Table 1: the paper's eight scenes one after another, what each step takes, and the paper's numbers beside them."""

import hashlib
import itertools
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pdipc.collision.surface import unique_edges
from pdipc.device.launch import Device
from pdipc.output.results import Run, open_run
from pdipc.pictures.render import render_animation, settings_of
from pdipc.reproduce import _common, _scenes
from pdipc.scene.assembly import Assembly, assemble
from pdipc.scene.load import load_scene
from pdipc.scene.memory import used_memory
from pdipc.scene.schema import Cloth, Scene

COLUMNS = ("bodies", "DOF", "elements", "triangles / edges", "constraints", "barriers", "order", "L-G", "outer", "linear")
COLUMNS += ("solver ms", "CCD ms", "barrier ms", "misc ms", "FPS")
JUDGED = (
    "steps",
    "unconverged",
    "intersections",
    "median ms",
    "p95 ms",
    "processor ms",
    "memory, MiB",
    "energy gained, J",
    "away from default, mm",
)
MODES = ("default", "paper")
Mode = Literal["default", "paper", "both"]
SHOTS = (0.0, 0.3, 0.6, 1.0)  # of a run, in its picture
FILM = (640, 480)  # pixels
FRAMES = 50  # of a film, about


@dataclass(frozen=True)
class Row:
    """A row of Table 1. paper: its cells, in the order of COLUMNS; bundled: the small scene; full: makes the one of the paper's size;
    order: of A-Jacobi.
    """

    title: str
    paper: tuple[str, ...]
    bundled: str
    full: Callable[[], Scene]
    order: int


def _cells(line: str) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in line.split("|"))


ROWS = {
    "dinosaur": Row(
        "Falling dinosaur",
        _cells("4 | 69K | 103K | 23K / 35K | 106K | 6K | 3 | 40 | 8 | 122 | 21.4 | 11.4 | 5.1 | 1.1 | 21.1 to 115.5"),
        "falling_dinosaur",
        _scenes.falling_dinosaur,
        3,
    ),
    "dragon": Row(
        "Dragon",
        _cells("1 | 80K | 100K | 39K / 58K | 100K | 8K | 3 | 44 | 14 | 134 | 35.1 | 15.7 | 4.5 | 1.3 | 14.6 to 119.3"),
        "dragon",
        _scenes.dragon,
        3,
    ),
    "armadillo": Row(
        "Armadillo",
        _cells("3 | 78K | 77K | 45K / 68K | 99K | 11K | 3 | 32 | 10 | 96 | 29.9 | 8.9 | 2.8 | 1.5 | 19.4 to 112.0"),
        "armadillo",
        _scenes.armadillo,
        3,
    ),
    "skirt": Row(
        "Tiered skirt",
        _cells("1 | 91K | 59K | 84K / 127K | 120K | 42K | 3 | 46 | 11 | 228 | 41.4 | 19.3 | 7.7 | 1.3 | 12.2 to 29.1"),
        "tiered_skirt",
        _scenes.tiered_skirt,
        3,
    ),
    "helicopters": Row(
        "Rubber helicopters",
        _cells("3 | 150K | 224K | 46K / 69K | 224K | 14K | 3 | 45 | 11 | 176 | 38.7 | 19.2 | 7.6 | 1.8 | 11.2 to 87.1"),
        "rubber_helicopters",
        _scenes.rubber_helicopters,
        3,
    ),
    "bone_dragon": Row(
        "Bone dragon",
        _cells("4 | 109K | 89K | 69K / 103K | 92K | 8K | 3 | 63 | 12 | 340 | 48.5 | 15.2 | 4.5 | 1.8 | 12.4 to 48.4"),
        "bone_dragon",
        _scenes.bone_dragon,
        3,
    ),
    "animals": Row(
        '"Animal crossing"',
        _cells("21 | 218K | 293K | 86K / 128K | 293K | 16K | 2 | 50 | 8 | 257 | 39.5 | 19.1 | 3.8 | 1.8 | 13.4 to 46.3"),
        "animal_crossing",
        _scenes.animal_crossing,
        2,
    ),
    "halloween": Row(
        "Halloween party",
        _cells("13 | 249K | 265K | 159K / 239K | 287K | 9K | 2 | 93 | 17 | 263 | 85.3 | 32.4 | 9.8 | 2.2 | 7.7 to 26.8"),
        "halloween_party",
        _scenes.halloween_party,
        2,
    ),
}


def run(
    out_dir: str | Path,
    small: bool = False,
    device: str | None = None,
    rows: Sequence[str] = (),
    mode: Mode = "default",
    steps: int | None = None,
) -> Path:
    """Writes table1.csv, table1.json, table1.md, table1.txt, table1.png, scenes.png, and a folder, a picture and a film a row, to `out_dir`; returns the
    PNG. small: the bundled scenes. rows: names in ROWS, all where empty. mode: the default one, the paper's, or both. steps: in place
    of each scene's. Rows that `out_dir` holds are kept and, where more steps are asked for, go on.

    Raises ValueError for a row that there is not, FileNotFoundError where the data for a full size is missing.
    """
    if unknown := [name for name in rows if name not in ROWS]:
        raise ValueError(f'rows: there is no "{unknown[0]}"; there are: {", ".join(ROWS)}')
    chosen = [name for name in ROWS if not rows or name in rows]
    modes = MODES if mode == "both" else (mode,)
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    machine = _common.machine(Device(device))
    found: list[dict[str, Any]] = []
    for number, name in enumerate(chosen):
        print(f"[{number + 1}/{len(chosen)}] {ROWS[name].title}", flush=True)
        scene = load_scene(ROWS[name].bundled) if small else ROWS[name].full()
        known = [_known(out, name, each) for each in modes]
        judged = [_row(out, name, each, scene, steps, device) for each in modes]
        found += judged
        if known != judged:
            (out / f"{name}.png").unlink(missing_ok=True)
        _write(out, found, machine, small)
    for name in chosen:  # after all runs, whose memory is told
        if not (out / f"{name}.png").is_file():
            _films(out, name, modes)
            _picture(out, name, modes)
    _gallery(out, chosen)
    return _conclude(out, found, machine, small)


# --- one row ---


def paper_mode(scene: Scene, order: int) -> Scene:
    """The scene as the paper's printed method takes it: Eq. (6), A-Jacobi of that order, no friction, the constraints of projective
    dynamics, and nothing inside closed cloth, which needs Newton's method.
    """
    data = scene.model_dump()
    data["contact"] |= {"method": "paper", "friction": 0.0}
    data["simulation"] |= {"nonlinear_solver": "auto", "linear_solver": "a-jacobi", "solver_order": order}
    for placed in (*data["bodies"], *data["obstacles"]):
        placed["friction"] = None
        if placed.get("inside"):
            placed["inside"] = None
    return Scene.model_validate(data)


def _row(out: Path, name: str, mode: str, scene: Scene, steps: int | None, device: str | None) -> dict[str, Any]:
    """Runs what is missing of a row, judges what is not yet judged, and returns the row as plain values."""
    label, folder = f"{ROWS[name].title}, {mode} mode", out / f"{name}-{mode}"
    if mode == "paper":
        if any(body.inside for body in scene.bodies if isinstance(body, Cloth)):
            print("note: the paper's mode has no pressure or volume inside of cloth; closed cloth is empty there", flush=True)
        scene = paper_mode(scene, ROWS[name].order)
    looks: list[tuple[float, int]] = []  # after each step: s of the processor, bytes
    done = _common.simulated(scene, folder, label, device, steps, lambda: looks.append((time.process_time(), used_memory())))
    made_from = hashlib.sha256(f"{scene.model_dump_json()} {done.frame_count}".encode()).hexdigest()
    known = _known(out, name, mode)
    if known and known["made_from"] == made_from:
        return known
    crossing = _common.intersections(done)
    totals = [sum(record["milliseconds"].values()) for record in done.stats]
    assembly = assemble(scene)
    row = {
        "row": name,
        "title": ROWS[name].title,
        "mode": mode,
        **dict(zip(COLUMNS, columns(assembly, done, ROWS[name].order if mode == "paper" else None), strict=True)),
        "steps": len(done.stats),
        "unconverged": sum(not record["converged"] for record in done.stats),
        "intersections": sum(crossing),
        "median ms": round(statistics.median(totals), 2),
        "p95 ms": round(float(np.percentile(totals, 95)), 2),
        **_used(looks),
        "energy gained, J": _gained(done),
        "away from default, mm": _away(out, name, done) if mode == "paper" else None,
        "degrees_of_freedom": 3 * _simulated(assembly)[-1].last,
        "device": done.meta.get("device"),
        "threads": done.meta.get("threads"),
        "made_from": made_from,
    }
    (out / f"{name}-{mode}.json").write_text(json.dumps(row, indent=1))
    return row


def _used(looks: Sequence[tuple[float, int]]) -> dict[str, Any]:
    """What a step takes of the processor, ms of all threads together in the median, and the most memory that the process had."""
    spent = [1e3 * (b[0] - a[0]) for a, b in itertools.pairwise(looks)]
    return {
        "processor ms": round(statistics.median(spent), 1) if spent else None,
        "memory, MiB": round(max(memory for _, memory in looks) / 2**20) if looks else None,
    }


def _known(out: Path, name: str, mode: str) -> dict[str, Any] | None:
    """The row as it was judged last."""
    file = out / f"{name}-{mode}.json"
    return json.loads(file.read_text()) if file.is_file() else None


def columns(assembly: Assembly, done: Run, order: int | None) -> tuple[str, ...]:
    """This run's cells of Table 1: averages over its steps, and the slowest and the fastest step."""
    simulated = _simulated(assembly)
    elements = sum(len(body.tets) or len(body.triangles) for body in simulated)
    triangles = np.concatenate([body.triangles for body in assembly.bodies])

    def mean(name: str) -> str:
        return _thousands(statistics.fmean(record[name] for record in done.stats))

    def milliseconds(stage: str) -> str:
        return f"{statistics.fmean(record['milliseconds'][stage] for record in done.stats):.1f}"

    rates = [1e3 / sum(record["milliseconds"].values()) for record in done.stats]
    return (
        str(len(simulated)),
        _thousands(3 * simulated[-1].last),
        _thousands(elements),
        f"{_thousands(len(triangles))} / {_thousands(len(unique_edges(triangles)))}",
        _thousands(done.stats[0]["constraints"]),
        mean("barriers"),
        "-" if order is None else str(order),  # Newton's method has none
        *map(mean, ("local_global", "outer", "linear_iterations")),
        *map(milliseconds, ("solver", "ccd", "barrier", "misc")),
        f"{min(rates):.2f} to {max(rates):.1f}",
    )


def _simulated(assembly: Assembly) -> list:
    return [body for body in assembly.bodies if not body.kinematic]


def _thousands(count: float) -> str:
    return f"{count / 1000:.0f}K" if count >= 10_000 else f"{count:.0f}"


def _gained(done: Run) -> float:
    """J: total energy at the last frame less that at the first; scripts and forces do work on some scenes."""
    from pdipc.audit import audit, replay

    first, last = (audit(*state).total for state in replay(done, [0, -1]))
    return float(f"{last - first:.4g}")


def _away(out: Path, name: str, done: Run) -> float | None:
    """mm: mean distance of the simulated vertices from where the default mode has them, at the last frame of both; None without it."""
    folder = out / f"{name}-default"
    if not (folder / "run.json").is_file():
        return None
    default = open_run(folder)
    frame = min(default.frame_count, done.frame_count) - 1
    apart = np.linalg.norm(default.positions(frame) - done.positions(frame), axis=1)
    return float(f"{1e3 * apart[~done.scripted].mean():.4g}")


# --- what is written ---


def _write(out: Path, found: list[dict[str, Any]], machine: str, small: bool) -> None:
    header = ("test", "", *COLUMNS, *JUDGED)
    lines: list[tuple[Any, ...]] = []
    for row in found:
        if not lines or lines[-1][0] != row["title"]:
            lines.append((row["title"], "paper, RTX 3090", *ROWS[row["row"]].paper, *("",) * len(JUDGED)))
        told = [row.get(name) for name in JUDGED]
        lines.append(
            (row["title"], f"here, {row['mode']}", *(row[name] for name in COLUMNS), *("" if x is None else x for x in told))
        )
    _common.write_table(out / "table1.csv", header, lines)
    size = "small scenes, not of the paper's size" if small else "the paper's size"
    (out / "table1.json").write_text(json.dumps({"machine": machine, "size": size, "rows": found}, indent=1))
    table = [
        f"| {' | '.join(header)} |",
        "|" + " --- |" * len(header),
        *(f"| {' | '.join(map(str, line))} |" for line in lines),
    ]
    (out / "table1.md").write_text(f"Here: {machine}; {size}.\n\n" + "\n".join(table) + "\n")


def _picture(out: Path, name: str, modes: Sequence[str]) -> None:
    """One row of pictures a mode, of the run's course."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(modes), len(SHOTS), figsize=(4 * len(SHOTS), 3.1 * len(modes)), layout="constrained", squeeze=False
    )
    runs = [open_run(out / f"{name}-{mode}") for mode in modes]
    last = min(done.frame_count for done in runs) - 1
    frames = [round(part * last) for part in SHOTS]
    for line, mode, done in zip(axes, modes, runs, strict=True):
        images = _common.pictures(done, frames, (800, 600), beside=None if done is runs[0] else runs[0])
        for axis, frame, image in zip(line, frames, images, strict=True):
            axis.imshow(image)
            axis.set_title(f"{mode} mode, {done.times[frame]:.2f} s", fontsize=10)
            axis.axis("off")
    figure.savefig(out / f"{name}.png", dpi=150)
    plt.close(figure)


def _films(out: Path, name: str, modes: Sequence[str]) -> None:
    """A film a mode, of at most so many frames."""
    for mode in modes:
        done = open_run(out / f"{name}-{mode}")
        settings = settings_of(done).model_copy(update={"size": FILM, "every": math.ceil(done.frame_count / FRAMES)})
        render_animation(done, out / f"{name}-{mode}.mp4", settings)


def _gallery(out: Path, names: Sequence[str]) -> None:
    """The pictures of the rows, one below the other."""
    from matplotlib.image import imread, imsave

    pictures = [imread(out / f"{name}.png")[:, :, :3] for name in names]
    width = min(picture.shape[1] for picture in pictures)
    imsave(out / "scenes.png", np.concatenate([picture[:, :width] for picture in pictures]))


def _conclude(out: Path, found: list[dict[str, Any]], machine: str, small: bool) -> Path:
    """The table on the screen, time against size as the picture, and the sentence."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from rich.console import Console
    from rich.table import Table

    console = Console(width=max(Console().width, 200))
    for row in found:
        table = Table("", "paper, RTX 3090", f"here, {row['mode']} mode", title=row["title"], title_justify="left")
        for column, theirs in zip(COLUMNS, ROWS[row["row"]].paper, strict=True):
            table.add_row(column, theirs, str(row[column]))
        for column in JUDGED:
            if row.get(column) is not None:
                table.add_row(column, "", str(row[column]))
        console.print(table)
    on_cpu = all(row.get("processor ms") and row["device"] == "cpu" for row in found)
    key, clock = ("processor ms", "ms of the processor") if on_cpu else ("median ms", "ms")
    figure, axis = plt.subplots(figsize=(7, 4.6), layout="constrained")
    told = []
    for mode, marker in zip(MODES, "os", strict=True):
        own = [row for row in found if row["mode"] == mode]
        size, took = ([row[column] for row in own] for column in ("degrees_of_freedom", key))
        if own:
            axis.loglog(size, took, marker, label=f"{mode} mode, median step")
            for row, x, y in zip(own, size, took, strict=True):
                axis.annotate(row["title"], (x, y), fontsize=7, xytext=(4, 3), textcoords="offset points")
        if len(set(size)) > 2:
            told.append(f"{mode} mode: time grows as DOF^{np.polyfit(np.log(size), np.log(took), 1)[0]:.2f}")
    axis.set(xlabel="degrees of freedom", ylabel=clock)
    axis.set_title(machine, fontsize=9)
    axis.legend()
    axis.grid(alpha=0.3)
    figure.savefig(out / "table1.png", dpi=150)
    plt.close(figure)
    seen = "; ".join(
        f"{mode} mode: {sum(row['intersections'] for row in own)} intersections, "
        f"{sum(row['unconverged'] for row in own)} of {sum(row['steps'] for row in own)} steps unconverged"
        for mode in MODES
        if (own := [row for row in found if row["mode"] == mode])
    )
    what = "small scenes, whose times cannot be compared" if small else "scenes of the paper's size"
    sentence = (
        f"Paper, Table 1: eight scenes without interpenetration. Here ({len({row['row'] for row in found})} of its rows, {what}; "
        f"{machine}; every frame judged by the witness): {'; '.join([seen, *told])}."
    )
    return _common.conclude(out / "table1.png", sentence)
