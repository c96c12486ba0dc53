"""Figure 12: an Armadillo flattened between two boards, by this package and by IPC with the same energies."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output.results import Run
from pdipc.reproduce import _common
from pdipc.scene import meshes
from pdipc.scene.assembly import Assembly, assemble
from pdipc.scene.schema import Scene

STEPS, SMALL_STEPS = 40, 12  # until the boards are closed
FINAL, SMALL_FINAL = 0.3, 0.6  # of the distance of the boards that is then left
IPC_STEPS = 12  # IPC goes no further, for its steps take up to a minute
H = 0.01  # s
DENSITY, YOUNG_MODULUS = 1000.0, 5e4  # kg/m^3, Pa; as rigid as possible: Poisson's ratio is 0
GAP = 0.005  # between body and boards at the start, m
TOLERANCE = 1e-4  # of IPC, in scene sizes: the default of this package
VIEW = (0.6, 0.5, 1.0)


def flattened(small: bool) -> Scene:
    """A body of unit size on its back, without gravity, between boards that close steadily."""
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


def newton(assembly: Assembly) -> Callable[[int, _common.Arrays], tuple[_common.Arrays, dict]]:
    """The step of IPC, projected Newton: the same ARAP energy, activation distance and minimum separation."""
    from pdipc.baselines import common, contact, energies, ipc

    x, tets, scripted = assembly.rest_positions, assembly.tets, assembly.scripted
    volumes = energies.tet_volumes(x, tets)
    masses = common.lumped_tet_masses(len(x), tets, volumes, DENSITY)
    barrier = contact.DistanceBarrier(
        contact.Surface(x, assembly.triangles, scripted),
        x,
        stiffness=np.where(scripted, 0.0, masses[~scripted].mean() / H**2),
        activation=assembly.activation_distance,
        separation=assembly.minimum_separation,
        body=assembly.body_of_vertex,
    )
    terms = [energies.tet_strain(x, tets, YOUNG_MODULUS * volumes)]  # 2 mu = E at Poisson's ratio 0
    problem = ipc.Problem(masses, terms, H, scripted, barrier, (0.0, 0.0, 0.0))

    def step(k: int, arrays: _common.Arrays) -> tuple[_common.Arrays, dict]:
        targets = assembly.positions.copy()
        targets[assembly.kinematic_vertices] = assembly.kinematic_positions((k + 1) * H)
        state = ipc.State(arrays["positions"], arrays["velocities"])
        state, info = ipc.step(problem, state, targets=targets, tolerance=TOLERANCE * assembly.scene_size)
        stats = {"outer": info.iterations, "converged": info.converged, "seconds": info.seconds}
        return {"positions": state.positions, "velocities": state.velocities}, stats

    return step


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig12.csv, fig12.txt and fig12.png to `out_dir`; returns the PNG.

    The Armadillo of 55K tets of the optional data, of which IPC makes the first steps only; small, or without the data: a generated body.
    """
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    scene = flattened(small)
    assembly = assemble(scene)
    shorter = scene.model_copy(deep=True)
    shorter.simulation.steps = min(IPC_STEPS, scene.simulation.steps)
    theirs = _common.stepped(shorter, out / "ipc", "IPC", newton(assembly))
    ours = _common.simulated(scene, out / "ours", "this package", device)
    rows, found = [], {}
    for method, done in (("IPC", theirs), ("this package", ours)):
        found[method] = _common.intersections(done)
        for record, pairs in zip(done.stats, found[method][1:], strict=True):
            seconds = record.get("seconds") or sum(record["milliseconds"].values()) / 1e3
            rows.append((method, record["step"], record["outer"], record["converged"], seconds, pairs))
    header = ("method", "step", "outer_iterations", "converged", "seconds", "intersections")
    _common.write_table(out / "fig12.csv", header, rows)
    _draw(theirs, ours, rows, out / "fig12.png")
    common = len(theirs.stats)  # the steps that both took
    part = max(1, common // 4)

    def ends(method: str, last: int) -> str:
        """Iterations at the beginning and at the end of the first `last` steps."""
        counts = [row[2] for row in rows if row[0] == method][:last]
        return f"{np.mean(counts[:part]):.1f} to {np.mean(counts[-part:]):.1f}"

    free, done = ~assembly.scripted, ours.stats
    left = np.ptp(ours.positions(-1)[free, 1]) / np.ptp(assembly.positions[free, 1])
    apart = np.linalg.norm((ours.positions(common) - theirs.positions(-1))[free], axis=1).mean() / assembly.scene_size
    spent = {method: sum(row[4] for row in rows if row[0] == method and row[1] <= common) for method in found}
    sentence = (
        "Paper, Fig. 12: outer iterations rise from 8 to 54 as the boards close, without interpenetration, 67 times faster than "
        f"IPC (GPU against CPU). Here ({len(assembly.tets)} tets, flattened to {left:.0%} of their thickness; both methods on one "
        f"machine): outer iterations rise from {ends('this package', len(done))} in {len(done)} steps, of which "
        f"{sum(not record['converged'] for record in done)} end unconverged; Newton iterations of IPC from {ends('IPC', common)} in "
        f"{common} steps (IPC goes no further than {IPC_STEPS}), where states differ by {apart:.2%} of the body's size on average "
        f"and IPC has taken {spent['IPC'] / spent['this package']:.1f} times as long; {sum(found['this package'])} and "
        f"{sum(found['IPC'])} intersections."
    )
    return _common.conclude(out / "fig12.png", sentence)


def _draw(theirs: Run, ours: Run, rows: list[tuple], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    last = ours.frame_count - 1
    frames = [0, min(theirs.frame_count - 1, last // 3), round(0.75 * last), last]  # the second is one that IPC has, too
    figure = plt.figure(figsize=(11, 9.2), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.7, 1.0))
    upper, lower = parts
    for line, (method, done) in zip(upper.subplots(2, len(frames)), (("IPC", theirs), ("this package", ours)), strict=True):
        there = [frame for frame in frames if frame < done.frame_count]
        for axis, image, frame in zip(line, _common.pictures(done, there, (640, 480), VIEW, [0]), there, strict=False):
            axis.imshow(image)
            axis.set_title(f"{method}, step {frame}", fontsize=10)
        for axis in line:
            axis.axis("off")
    for axis, column, what in zip(lower.subplots(1, 2), (2, 4), ("outer (Newton) iterations", "seconds a step"), strict=True):
        for method, color in (("IPC", "C1"), ("this package", "C0")):
            own = [row for row in rows if row[0] == method]
            axis.semilogy([row[1] for row in own], [row[column] for row in own], ".-", color=color, label=method)
        axis.set_xlabel("step")
        axis.set_ylabel(what)
        axis.grid(alpha=0.3)
        axis.legend()
    figure.savefig(path, dpi=100)
    plt.close(figure)
