"""The paper's mode, the default mode and IPC on the same ten small scenes: a table. Not in the paper."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.drive import step
from pdipc.model import Model, State, build
from pdipc.reproduce import _common
from pdipc.scene.schema import Scene
from pdipc.work import Work

COLUMNS = (
    "outer",
    "L-G",
    "linear",
    "ms",
    "unconverged",
    "rest height error, mm",
    "rebound",
    "momentum error",
    "distance to IPC",
)
MODES = ("paper", "default", "IPC")
WITHOUT_GRAVITY = {"gravity": (0.0, 0.0, 0.0)}


@dataclass
class Case:
    """A scene, and what of it is measured: momentum where nothing acts from outside, rebound where a body falls freely on a floor,
    rest where it lies still at the end (mean height against IPC's).
    """

    bodies: list[dict]
    obstacles: list[dict]
    steps: int = 60
    simulation: dict | None = None
    contact: dict | None = None
    measured: tuple[str, ...] = ()

    def scene(self, mode: str, steps: int) -> Scene:
        contact = {"activation_distance": 1e-3, **(self.contact or {})}
        if mode == "paper":
            contact |= {"method": "paper"}
        simulation = {"precision": "float64", "steps": steps, **(self.simulation or {})}
        return Scene(simulation=simulation, contact=contact, bodies=self.bodies, obstacles=self.obstacles)


def block(name: str, at: tuple, cells: int = 3, young: float = 1e5, **more: Any) -> dict:
    """A cube of 0.1 m, with the energies that IPC has here as well."""
    mesh = {"shape": "box", "size": (0.1, 0.1, 0.1), "cells": (cells, cells, cells)}
    material = {"young_modulus": young, "poisson_ratio": 0.0, "density": 1000.0, "model": "arap"}
    return {"name": name, "kind": "solid", "mesh": mesh, "translation": at, "material": material, **more}


def sheet(cells: int, at: tuple, **more: Any) -> dict:
    """A cloth of 0.3 m."""
    mesh = {"shape": "grid", "size": (0.3, 0.3), "cells": (cells, cells)}
    return {"name": "cloth", "kind": "cloth", "mesh": mesh, "translation": at, **more}


def floor(name: str = "floor", size: float = 2.0, **more: Any) -> dict:
    """A plane that faces up, whose inner edge is not below the bodies: without friction it would push them aside."""
    return {"name": name, "mesh": {"shape": "plane", "size": size}, "translation": (0.7, 0.0, -0.2), **more}


def cases() -> dict[str, Case]:
    """Ten scenes, from one impact to sliding, squeezing and cloth."""
    ball = {"shape": "sphere", "radius": 0.05, "cells": 4}
    rod = {"shape": "cylinder", "radius": 0.005, "length": 0.4, "cells": [8, 4]}
    plate = floor("plate", rotation=(180, 0, 0), translation=(0.7, 0.107, 0.2), motion={"velocity": (0, -0.1, 0), "end": 0.4})
    away: dict[str, Any] = {"velocity": (-1, 0, 0)}
    return {
        "stiff box falls": Case([block("box", (0, 0.1, 0), young=1e8)], [floor()], 60, {}, {}, ("rebound", "rest")),
        "soft box falls": Case([block("box", (0, 0.1, 0))], [floor()], 60, {}, {}, ("rebound", "rest")),
        "tilted box falls": Case([block("box", (0, 0.12, 0), rotation=(10, 0, 25))], [floor()]),
        "two boxes collide": Case(
            [block("a", (-0.08, 0, 0), velocity=(1, 0, 0)), block("b", (0.08, 0.013, 0.021), **away)],
            [],
            20,
            WITHOUT_GRAVITY,
            {},
            ("momentum",),
        ),
        "two boxes stacked": Case(
            [block("a", (0, 0.052, 0)), block("b", (0.01, 0.155, 0.01), rotation=(0, 20, 0))], [floor()], measured=("rest",)
        ),
        "box slides": Case(
            [block("box", (0.005 * np.sin(0.3), 0.0515, 0), rotation=(0, 0, 17.2))],
            [floor(rotation=(0, 0, 17.2), translation=(0.7 * np.cos(0.3), 0.7 * np.sin(0.3) - 0.0015, -0.2))],
            60,
            {},
            {"activation_distance": 2e-3},
        ),
        "box squeezed": Case([block("box", (0, 0.0525, 0))], [floor(), plate], measured=("rest",)),
        "box on a rod": Case(
            [block("box", (0.004, 0.08, 0), 4, velocity=(0, -1, 0))],
            [{"name": "rod", "mesh": rod, "rotation": (90, 0, 0)}],
            40,
        ),
        "ball on a cloth": Case(
            [
                sheet(12, (0, 0, 0), pins=[{"select": {"box": ((x - 0.02, -1, -1), (x + 0.02, 1, 1))}} for x in (-0.15, 0.15)]),
                {
                    "name": "ball",
                    "kind": "solid",
                    "mesh": ball,
                    "translation": (0.01, 0.08, 0.0),
                    "material": {"model": "arap"},
                },
            ],
            [],
            60,
        ),
        "cloth on a ball": Case([sheet(14, (0.01, 0.06, 0))], [{"name": "ball", "mesh": ball}], 30),
    }


def measure(case: Case, mode: str, steps: int, device: str | None) -> tuple[dict[str, float], np.ndarray]:
    """A run: what the table says of it, and the last positions of the simulated vertices (n, 3)."""
    model = build(case.scene(mode, steps), device)
    free = model.free.numpy() > 0
    mass = model.mass.numpy()[free].astype(float)
    positions, velocities, seconds, counts, unconverged = [], [], [], [], 0

    def keep(x: np.ndarray, v: np.ndarray) -> None:
        positions.append(x[free].astype(float))
        velocities.append((mass[:, None] * v[free]).sum(axis=0) / mass.sum())

    for x, v, took, count, converged in _ipc(model, steps) if mode == "IPC" else _ours(model, steps):
        keep(x, v)
        seconds.append(took)
        counts.append(count)
        unconverged += not converged
    total = np.array(velocities)
    start = (mass[:, None] * model.initial_state().velocities.numpy()[free]).sum(axis=0) / mass.sum()
    found: dict[str, float] = dict(
        zip(COLUMNS, (*np.mean(counts, axis=0), 1e3 * float(np.median(seconds)), unconverged), strict=False)
    )
    if "rebound" in case.measured:
        down = total[:, 1].min()
        found["rebound"] = float(total[int(total[:, 1].argmin()) :, 1].max() / -down)
    if "momentum" in case.measured:
        speed = np.linalg.norm(model.initial_state().velocities.numpy()[free], axis=1).max()
        found["momentum error"] = float(np.abs(total - start).max() / speed)
    return found, np.array(positions)


def _ours(model: Model, steps: int):
    work, state = Work(model), model.initial_state()
    for _ in range(steps):
        begin = time.perf_counter()
        result = step(model, state, work)
        state: State = result.state
        took = time.perf_counter() - begin
        x, v = state.positions.numpy(), state.velocities.numpy()
        yield x, v, took, (result.outer, result.local_global, result.linear_iterations), result.converged


def _ipc(model: Model, steps: int):
    from pdipc.baselines.reference import Reference

    reference = Reference(model)
    for _ in range(steps):
        info = reference.step(tolerance=1e-6)
        yield (
            reference.state.positions,
            reference.state.velocities,
            info.seconds,
            (info.iterations, np.nan, np.nan),
            info.converged,
        )


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes modes.csv, modes.md (the table), modes.txt and modes.png to `out_dir`; returns the PNG. small: three scenes, 12 steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    chosen = cases()
    if small:
        chosen = {name: chosen[name] for name in ("stiff box falls", "two boxes collide", "box slides")}
    table: dict[str, dict[str, dict[str, float]]] = {}
    distances: dict[str, dict[str, np.ndarray]] = {}
    with _common.progress("modes", 3 * len(chosen)) as advance:
        for number, (name, case) in enumerate(chosen.items()):
            steps, paths = min(case.steps, 12) if small else case.steps, {}
            table[name], distances[name] = {}, {}
            for k, mode in enumerate(reversed(MODES)):
                table[name][mode], paths[mode] = measure(case, mode, steps, device)
                size = np.ptp(paths["IPC"][0], axis=0).max()
                away = np.linalg.norm(paths[mode] - paths["IPC"], axis=2).max(axis=1) / size
                if mode != "IPC" and "rest" in case.measured:
                    height = [paths[each][-1, :, 1].mean() for each in (mode, "IPC")]
                    table[name][mode]["rest height error, mm"] = 1e3 * float(height[0] - height[1])
                if mode != "IPC":
                    table[name][mode]["distance to IPC"] = float(away.max())
                    distances[name][mode] = away
                advance(3 * number + k + 1, f"{name}: {mode}")
    rows = [
        (name, mode, *(table[name][mode].get(column, float("nan")) for column in COLUMNS)) for name in chosen for mode in MODES
    ]
    _common.write_table(out / "modes.csv", ("scene", "mode", *COLUMNS), rows)
    (out / "modes.md").write_text(_markdown(rows))
    figure, axes = plt.subplots(2, -(-len(chosen) // 2), figsize=(14, 5.4), layout="constrained", squeeze=False)
    for axis in axes.ravel()[len(chosen) :]:
        axis.axis("off")
    for axis, (name, found) in zip(axes.ravel(), distances.items(), strict=False):
        for mode, away in found.items():
            axis.semilogy(
                np.arange(1, len(away) + 1), np.maximum(away, 1e-9), label=mode, color={"paper": "C0", "default": "C1"}[mode]
            )
        axis.set_title(name, fontsize=10)
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=9)
    axes[0, 0].set_ylabel("distance to IPC / size")
    axes[-1, 0].set_ylabel("distance to IPC / size")
    for axis in axes[-1]:
        axis.set_xlabel("step")
    figure.suptitle("Largest distance of a vertex from where IPC puts it")
    figure.savefig(out / "modes.png", dpi=110)
    plt.close(figure)
    told = ", ".join(
        f"{mode}: up to {max(table[name][mode]['distance to IPC'] for name in chosen):.2g} of the size away from IPC, "
        f"median {np.median([table[name][mode]['distance to IPC'] for name in chosen]):.1g}"
        for mode in ("paper", "default")
    )
    faster = np.median([table[name]["IPC"]["ms"] / table[name]["default"]["ms"] for name in chosen])
    return _common.conclude(
        out / "modes.png",
        f"Not in the paper: its mode, the default mode and IPC on {len(chosen)} small scenes. Here: {told}; the default mode takes "
        f"1/{faster:.0f} of IPC's time a step in the median.",
    )


def _markdown(rows: list[tuple]) -> str:
    lines = [f"| scene | mode | {' | '.join(COLUMNS)} |", "|" + " --- |" * (len(COLUMNS) + 2)]
    for name, mode, *values in rows:
        lines.append(f"| {name} | {mode} | {' | '.join('' if np.isnan(v) else f'{v:.3g}' for v in values)} |")
    return "\n".join(lines) + "\n"
