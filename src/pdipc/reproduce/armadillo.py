"""Table 1, row "Armadillo" (Fig. 13, bottom): the authors' own scene, two pieces of cloth fall on an Armadillo and all are dragged."""

import statistics
from pathlib import Path

import numpy as np

from pdipc.collision.surface import unique_edges
from pdipc.output.results import Run
from pdipc.reproduce import _common
from pdipc.scene.assembly import Assembly, assemble
from pdipc.scene.schema import Scene

COLUMNS = ("bodies", "DOF", "elements", "triangles / edges", "constraints", "barriers", "order", "L-G", "outer", "linear")
COLUMNS += ("solver ms", "CCD ms", "barrier ms", "misc ms", "FPS")
PAPER = ("3", "78K", "77K", "45K / 68K", "99K", "11K", "3", "32", "10", "96", "29.9", "8.9", "2.8", "1.5", "19.4 to 112.0")
VIEW = (0.75, 0.25, -1.0)  # the Armadillo faces -z


def authors_scene(path: Path) -> Scene:
    """The published meshes and parameters; the user's hand is two forces. Weights of tets and triangles are 2 mu (config.xml).

    Its volume weight, 1/2000 of that of strain, is left out: Table 1's constraints do not count it either.
    """
    arrays = np.load(path)
    cloth = {"areal_density": 2500.0, "membrane_stiffness": 1e6, "poisson_ratio": 0.0, "bending_stiffness": 25.0}
    bodies = [
        {
            "name": name,
            "kind": "cloth",
            "mesh": {"vertices": arrays[f"{name}_points"], "triangles": arrays[f"{name}_triangles"]},
            "pins": [{"select": {"vertices": arrays[f"{name}_fixed"].tolist()}}],
            "material": cloth,
        }
        for name in ("cloth1", "cloth2")
    ]
    armadillo = {
        "name": "armadillo",
        "kind": "solid",
        "mesh": {"vertices": arrays["armadillo_points"], "tets": arrays["armadillo_tets"]},
        "pins": [{"select": {"vertices": arrays["armadillo_fixed"].tolist()}}],
        "material": {"density": 1000.0, "young_modulus": 2e6, "poisson_ratio": 0.0},
    }
    return Scene(
        title="The authors' Armadillo",
        simulation={"steps": 200, "gravity": (0.0, -9.8, 0.0)},
        contact={"activation_distance": 5e-3},
        bodies=[*bodies, armadillo],
        forces=[
            _drag("cloth1", (2.0, 4.9, -3.98), 0.4, (1e4, 8e3, 3e3), 1.2, 1.6),
            _drag("armadillo", (2.97, 3.47, 0.23), 0.35, (-3e3, 2e3, -6e3), 1.4, 1.8),
        ],
    )


def stand_in() -> Scene:
    """A small generated scene of the same kind, 1 m tall."""
    cloth = {"areal_density": 0.5, "membrane_stiffness": 300.0, "bending_stiffness": 1e-4}
    bodies = [
        {
            "name": f"cloth{k + 1}",
            "kind": "cloth",
            "mesh": {"shape": "grid", "size": (1.1, 1.1), "cells": (14, 14)},
            "translation": (0.0, 0.56 + 0.03 * k, -0.3),
            "velocity": (0.0, -1.5, 0.0),
            "pins": [{"select": {"nearest": (x, 0.56 + 0.03 * k, 0.25)}} for x in (-0.55, 0.55)],
            "material": cloth,
        }
        for k in range(2)
    ]
    body = {
        "name": "armadillo",
        "kind": "solid",
        "mesh": _common.creature(_common.BIPED, 0.1),
        "pins": [{"select": {"box": ((-1.0, -1.0, -1.0), (1.0, -0.35, 1.0))}}],
        "material": {"density": 1000.0, "young_modulus": 5e4, "poisson_ratio": 0.0},
    }
    return Scene(
        title="A generated stand-in for the authors' Armadillo",
        simulation={"steps": 25},
        contact={"activation_distance": 5e-3},
        bodies=[*bodies, body],
        forces=[
            _drag("cloth1", (0.55, 0.56, -0.85), 0.2, (0.5, 0.2, 0.0), 0.1, 0.2),
            _drag("armadillo", (0.42, 0.42, -0.25), 0.15, (0.0, 20.0, -40.0), 0.05, 0.2),
        ],
    )


def _drag(body: str, center: tuple, radius: float, force: tuple, start: float, end: float) -> dict:
    return {
        "kind": "vertices",
        "body": body,
        "select": {"sphere": (center, radius)},
        "force": force,
        "start": start,
        "end": end,
    }


def row(assembly: Assembly, run: Run) -> tuple[str, ...]:
    """This run's row of Table 1: averages over its steps, and the slowest and the fastest step."""
    simulated = [body for body in assembly.bodies if not body.kinematic]
    elements = sum(len(body.tets) or len(body.triangles) for body in simulated)
    triangles = np.concatenate([body.triangles for body in simulated])

    def mean(name: str) -> str:
        return f"{statistics.fmean(record[name] for record in run.stats):.0f}"

    def milliseconds(stage: str) -> str:
        return f"{statistics.fmean(record['milliseconds'][stage] for record in run.stats):.1f}"

    rates = [1e3 / sum(record["milliseconds"].values()) for record in run.stats]
    return (
        str(len(simulated)),
        _thousands(3 * simulated[-1].last),
        _thousands(elements),
        f"{_thousands(len(triangles))} / {_thousands(len(unique_edges(triangles)))}",
        _thousands(run.stats[0]["constraints"]),
        mean("barriers"),
        "-",  # the default solver, two-level PCG, has none
        *map(mean, ("local_global", "outer", "linear_iterations")),
        *map(milliseconds, ("solver", "ccd", "barrier", "misc")),
        f"{min(rates):.2f} to {max(rates):.1f}",
    )


def _thousands(count: int) -> str:
    return f"{count / 1000:.0f}K" if count >= 10_000 else str(count)


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes armadillo.csv (the row), armadillo_steps.csv, armadillo.txt and armadillo.png to `out_dir`; returns the PNG.

    small, or without the optional data: a generated stand-in.
    """
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    path = None if small else _common.data("paper_armadillo/placed.npz")
    scene = authors_scene(path) if path else stand_in()
    done = _common.simulated(scene, out / "run", "armadillo", device)
    pairs = _common.intersections(done)
    ours = row(assemble(scene), done)
    _common.write_table(out / "armadillo.csv", ("", *COLUMNS), [("paper, RTX 3090", *PAPER), ("here", *ours)])
    header = ("step", "outer", "local_global", "linear_iterations", "barriers", "converged", "smallest_gap", "intersections")
    rows = [[*(record[name] for name in header[:-1]), found] for record, found in zip(done.stats, pairs[1:], strict=True)]
    _common.write_table(out / "armadillo_steps.csv", header, rows)
    for name, theirs, mine in zip(COLUMNS, PAPER, ours, strict=True):
        print(f"{name:18} {theirs:>14} {mine:>14}")
    _draw(done, out / "armadillo.png")
    what = "the authors' scene" if path else "a small generated stand-in, not the authors' scene; its row cannot be compared"
    sentence = (
        f"Paper, Table 1 and Fig. 13: dragged at will, the Armadillo under two cloths never interpenetrates. Here ({what}): "
        f"{sum(pairs)} intersections in {len(done.stats)} steps; {ours[8]} outer iterations a step on average (paper: 10), "
        f"{sum(not record['converged'] for record in done.stats)} steps ended unconverged, "
        f"at most {max(record['barriers'] for record in done.stats)} barriers."
    )
    return _common.conclude(out / "armadillo.png", sentence)


def _draw(done: Run, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    frames = [round(part * (done.frame_count - 1)) for part in (0.3, 0.65, 0.85, 1.0)]
    figure, axes = plt.subplots(1, 4, figsize=(12, 3.9), layout="constrained")
    images = _common.pictures(done, frames, (600, 660), VIEW)
    for axis, frame, image in zip(axes, frames, images, strict=True):
        axis.imshow(image)
        axis.set_title(f"step {frame}", fontsize=10)
        axis.axis("off")
    figure.savefig(path, dpi=110)
    plt.close(figure)
