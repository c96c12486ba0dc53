"""Figure 10: a dinosaur falls on rods, and on rods of a tenth of their thickness, by plain projective dynamics and by this package."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output.results import Run
from pdipc.reproduce import _common
from pdipc.scene.assembly import Assembly, assemble
from pdipc.scene.schema import Scene

RODS = {"rods": 0.06, "thin rods": 0.006}  # radius, m: the paper's reduction by 90 %
PLACES = (-0.3, 0.0, 0.3)  # of the three rods, m
DENSITY, YOUNG_MODULUS = 1000.0, 2e5  # kg/m^3, Pa; as rigid as possible: Poisson's ratio is 0
SPEED = 1.5  # m/s: that of a fall of 11 cm, which is left out
ITERATIONS = 10  # local-global iterations of plain projective dynamics
VIEW = (0.45, 0.35, 1.0)


def falling(radius: float, small: bool) -> Scene:
    """The dinosaur, lying on its side, 5 mm above three rods along z. 1 m tall, 0.4 m wide, 1.2 m from head to tail."""
    path = None if small else _common.data("meshes/tet/dinosaur_97k.npz")
    cell = 0.08 if small else 0.025
    mesh: Any = str(path) if path else _common.creature(_common.DINOSAUR, cell)
    lowest = np.load(path)["V"][:, 0].min() if path else mesh["vertices"][:, 0].min()
    rods = [
        {
            "name": f"rod {k + 1}",
            "mesh": {"shape": "cylinder", "radius": radius, "length": 1.6, "cells": (4, 1)},
            "rotation": (90.0, 0.0, 0.0),
            "translation": (x, -radius, 0.0),
        }
        for k, x in enumerate(PLACES)
    ]
    body = {
        "name": "dinosaur",
        "kind": "solid",
        "mesh": mesh,
        "rotation": (0.0, 0.0, 90.0),
        "translation": (0.0, 0.005 - lowest, 0.0),
        "velocity": (0.0, -SPEED, 0.0),
        "material": {"density": DENSITY, "young_modulus": YOUNG_MODULUS, "poisson_ratio": 0.0, "model": "arap"},
    }
    return Scene(
        title="A dinosaur falls on rods",
        simulation={"steps": 24 if small else 40},
        contact={"activation_distance": 1e-3, "friction": 0.2},
        bodies=[body],
        obstacles=rods,
    )


def plain(assembly: Assembly, time_step: float) -> Callable[[int, _common.Arrays], tuple[_common.Arrays, dict]]:
    """The step of plain projective dynamics: the same ARAP energy, and collisions where a vertex is inside a rod."""
    from pdipc.baselines import common, energies
    from pdipc.baselines import projective_dynamics as pd

    x, tets = assembly.rest_positions, assembly.tets
    volumes = energies.tet_volumes(x, tets)
    problem = pd.Problem(
        common.lumped_tet_masses(len(x), tets, volumes, DENSITY),
        [energies.tet_strain(x, tets, YOUNG_MODULUS * volumes)],  # 2 mu = E at Poisson's ratio 0
        time_step,
        assembly.scripted,
        surfaces=[body.triangles for body in assembly.bodies if body.kinematic],
    )

    def step(_: int, arrays: _common.Arrays) -> tuple[_common.Arrays, dict]:
        state = pd.State(arrays["positions"], arrays["velocities"])
        state, touching = pd.step(problem, state, iterations=ITERATIONS)
        return {"positions": state.positions, "velocities": state.velocities}, {"touching": touching}

    return step


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig10.csv, fig10.txt and fig10.png to `out_dir`; returns the PNG. small: a generated dinosaur of some 400 vertices."""
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    runs: dict[tuple[str, str], Run] = {}
    for rods, radius in RODS.items():
        scene = falling(radius, small)
        label = rods.replace(" ", "-")
        step = plain(assemble(scene), scene.simulation.time_step)
        runs[rods, "plain PD"] = _common.stepped(scene, out / f"{label}-plain", f"{rods}, plain PD", step)
        runs[rods, "this package"] = _common.simulated(scene, out / f"{label}-ours", f"{rods}, this package", device)
    rows, crossing, below = [], {}, {}
    for key, done in runs.items():
        under = [_below(done, frame, RODS[key[0]]) for frame in range(done.frame_count)]
        found = _common.intersections(done)
        crossing[key], below[key] = sum(count > 0 for count in found), under[-1]
        rows += [(*key, frame, *counts) for frame, counts in enumerate(zip(under, found, strict=True))]
    _common.write_table(out / "fig10.csv", ("rods", "method", "step", "part_below_the_rods", "intersections"), rows)
    _draw(runs, crossing, out / "fig10.png")
    seen = "; ".join(
        f"{method} on {rods}: {crossing[rods, method]} of {done.frame_count} frames intersect, {below[rods, method]:.0%} of the "
        "vertices end below"
        for (rods, method), done in runs.items()
    )
    sentence = f"Paper, Fig. 10: plain PD lets the dinosaur through rods thinned by 90 %, this method never does. Here: {seen}."
    return _common.conclude(out / "fig10.png", sentence)


def _below(done: Run, frame: int, radius: float) -> float:
    """The part of the dinosaur's vertices that are lower than the underside of the rods."""
    return float(np.mean(done.positions(frame)[~done.scripted, 1] < -2 * radius))


def _draw(runs: dict[tuple[str, str], Run], crossing: dict[tuple[str, str], int], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    last = next(iter(runs.values())).frame_count - 1
    frames = [round(part * last) for part in (0, 0.25, 0.5, 0.75)]
    figure, axes = plt.subplots(len(runs), len(frames), figsize=(11, 9.6), layout="constrained")
    for line, (key, done) in zip(axes, runs.items(), strict=True):
        images = _common.pictures(done, frames, (560, 460), VIEW, framed=[0, frames[1]])
        for axis, frame, image in zip(line, frames, images, strict=True):
            axis.imshow(image)
            axis.axis("off")
            if line is axes[0]:
                axis.set_title(f"step {frame}", fontsize=10)
        told = f"{key[1]}, {key[0]}\n{crossing[key]} of {last + 1} frames intersect"
        line[0].text(-0.08, 0.5, told, rotation=90, ha="center", va="center", transform=line[0].transAxes, fontsize=9)
    figure.savefig(path, dpi=100)
    plt.close(figure)
