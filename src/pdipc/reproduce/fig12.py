"""Figure 12: an Armadillo flattened between two boards, by this package and by IPC with the same energies."""

from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output.results import Run
from pdipc.reproduce import _beside_ipc, _common
from pdipc.scene import meshes
from pdipc.scene.assembly import assemble
from pdipc.scene.schema import Scene

STEPS, SMALL_STEPS = 40, 12  # until the boards are closed
FINAL, SMALL_FINAL = 0.3, 0.6  # of the distance of the boards that is then left
H = 0.01  # s
DENSITY, YOUNG_MODULUS = 1000.0, 5e4  # kg/m^3, Pa; as rigid as possible: Poisson's ratio is 0
GAP = 0.005  # between body and boards at the start, m
VIEW = (0.6, 0.5, 1.0)


def flattened(small: bool) -> Scene:
    """A body of unit size that lies, without gravity, between boards that close steadily."""
    path = None if small else _common.data("meshes/tet/armadillo_55k.npz")
    if path:
        mesh = meshes.read(path)
        x, tets = mesh.vertices, mesh.tets
    else:
        body = _common.creature(_common.BIPED, 0.12 if small else 0.05)
        x, tets = body["vertices"], body["tets"]
    x = (x - 0.5 * (x.min(axis=0) + x.max(axis=0))) / np.ptp(x, axis=0).max()
    x = x @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # y becomes -z, z becomes y
    half = x[:, 1].max() + GAP
    steps, final = (SMALL_STEPS, SMALL_FINAL) if small else (STEPS, FINAL)
    boards = []
    for name, side in (("lower board", -1), ("upper board", 1)):
        closing = {"keyframes": [{"time": 0.0}, {"time": steps * H, "translation": (0.0, -side * half * (1.0 - final), 0.0)}]}
        board = {"shape": "box", "size": (1.8, 0.03, 1.8), "cells": (1, 1, 1)}
        boards.append({"name": name, "mesh": board, "translation": (0.0, side * (half + 0.015), 0.0), "motion": closing})
    body = {
        "name": "armadillo",
        "kind": "solid",
        "mesh": {"vertices": x, "tets": tets},
        "material": {"density": DENSITY, "young_modulus": YOUNG_MODULUS, "poisson_ratio": 0.0, "model": "arap"},
    }
    simulation = {"steps": steps, "time_step": H, "gravity": (0.0, 0.0, 0.0)}
    return Scene(title="A flattened Armadillo", simulation=simulation, bodies=[body], obstacles=boards)


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig12.csv, fig12.txt and fig12.png to `out_dir`; returns the PNG.

    The Armadillo of 55K tets of the optional data; small, or without the data: a generated body.
    """
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    scene = flattened(small)
    assembly = assemble(scene)
    ours = _beside_ipc.ours(scene, out / "ours", device)
    theirs = _beside_ipc.theirs(scene, out / "ipc")
    rows, found = [], {}
    for method, done in (("IPC", theirs), ("this package", ours)):
        found[method] = _common.intersections(done)
        for record, pairs in zip(done.stats, found[method][1:], strict=True):
            rows.append((method, record["step"], record["outer"], record["converged"], record[_beside_ipc.TIME], pairs))
    header = ("method", "step", "outer_iterations", "converged", "seconds", "intersections")
    _common.write_table(out / "fig12.csv", header, rows)
    _draw(theirs, ours, rows, out / "fig12.png")
    part = max(1, len(ours.stats) // 8)

    def told(method: str, done: Run) -> str:
        """Iterations at the beginning and at the end of a run, and steps that did not converge."""
        counts = [record["outer"] for record in done.stats]
        unconverged = sum(not record["converged"] for record in done.stats)
        return (
            f"of {method} rise from {np.mean(counts[:part]):.1f} to {np.mean(counts[-part:]):.1f} in {len(counts)} steps, of which "
            f"{unconverged} end unconverged, with {sum(found[method])} intersections"
        )

    free = ~assembly.scripted
    left = np.ptp(ours.positions(-1)[free, 1]) / np.ptp(assembly.positions[free, 1])
    apart = np.linalg.norm((ours.positions(-1) - theirs.positions(-1))[free], axis=1).mean() / assembly.scene_size
    spent = {method: sum(row[4] for row in rows if row[0] == method) for method in found}
    sentence = (
        "Paper, Fig. 12: outer iterations rise from 8 to 54 as the boards close, without interpenetration, 67 times faster than "
        f"IPC (GPU against CPU). Here ({len(assembly.tets)} tets, flattened to {left:.0%} of their thickness; both methods on one "
        f"machine): outer iterations {told('this package', ours)}; Newton iterations {told('IPC', theirs)}. At the end states differ "
        f"by {apart:.2%} of the body's size on average, and IPC has taken {spent['IPC'] / spent['this package']:.1f} times as long."
    )
    return _common.conclude(out / "fig12.png", sentence)


def _draw(theirs: Run, ours: Run, rows: list[tuple], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    last = ours.frame_count - 1
    frames = [0, last // 3, round(0.75 * last), last]
    figure = plt.figure(figsize=(12, 10), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.7, 1.0))
    upper, lower = parts
    for line, (method, done) in zip(upper.subplots(2, len(frames)), (("IPC", theirs), ("this package", ours)), strict=True):
        for axis, image, frame in zip(line, _common.pictures(done, frames, (640, 480), VIEW, [0]), frames, strict=True):
            axis.imshow(image)
            axis.set_title(f"{method}, step {frame}", fontsize=10)
            axis.axis("off")
    for axis, column, what in zip(
        lower.subplots(1, 2), (2, 4), ("outer (Newton) iterations", "processor seconds a step"), strict=True
    ):
        for method, color in (("IPC", "C1"), ("this package", "C0")):
            own = [row for row in rows if row[0] == method]
            axis.semilogy([row[1] for row in own], [row[column] for row in own], ".-", color=color, label=method)
        axis.set_xlabel("step")
        axis.set_ylabel(what)
        axis.grid(alpha=0.3)
        axis.legend()
    figure.savefig(path, dpi=200)
    plt.close(figure)
