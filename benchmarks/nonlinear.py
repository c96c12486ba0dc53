"""Newton's method beside local-global iterations at equal error: `python benchmarks/nonlinear.py [--picture FILE] [-o FILE]`.

One step of a tilted block that hits a floor, from soft to steel, the same energy (as rigid as possible) and the same state for both: at tolerances from 1 m/s to
1e-6 m/s, how far the end is from the same step at 1e-9 m/s by Newton's method, how long it took (processor time of one thread, the least of three), and how many
iterations (of Newton, or local-global ones).
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import numpy as np

import pdipc
from pdipc.drive import step

RESULTS = Path(__file__).parent / "results" / "nonlinear.json"
STIFFNESS = {"1e4 Pa, gel": 1e4, "1e6 Pa, rubber": 1e6, "1e8 Pa, plastic": 1e8, "2e11 Pa, steel": 2e11}
SOLVERS = ("newton", "local-global")
TOLERANCES = [10.0**-k for k in range(7)]  # m/s
REPEATS, BEFORE = 3, 7


def scene(young: float, solver: str, tolerance: float, max_outer: int = 400) -> pdipc.Scene:
    block = {"name": "block", "kind": "solid", "mesh": {"shape": "box", "size": [0.2] * 3, "cells": [6] * 3}}
    block |= {"translation": [0, 0.19, 0], "rotation": [10, 20, 5], "velocity": [0, -1, 0]}
    block["material"] = {"young_modulus": young, "poisson_ratio": 0.3, "density": 1000.0, "model": "arap"}
    simulation = {"nonlinear_solver": solver, "tolerance": tolerance, "max_outer": max_outer}
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 4.0}}
    return pdipc.Scene(simulation=simulation, contact={"activation_distance": 2e-3}, bodies=[block], obstacles=[floor])


def solved(simulation: pdipc.Simulation, state: dict) -> tuple[np.ndarray, pdipc.StepResult, float]:
    """Where the step from a state ends, its result, and the processor's time, s."""
    times = []
    for _ in range(REPEATS):
        start = simulation.model.state_from(state)
        begun = time.process_time()
        result = step(simulation.model, start, simulation.work)
        times.append(time.process_time() - begun)
    return result.state.positions.numpy(), result, min(times)


def measure(name: str, young: float) -> list[dict]:
    exact = pdipc.Simulation(scene(young, "newton", 1e-9, 2000), "cpu")
    for _ in range(BEFORE):
        exact.step()
    state = exact.state.arrays()
    end, result, _ = solved(exact, state)
    rows = [{"case": name, "barriers": result.barriers, "exact_converged": result.converged}]
    for solver in SOLVERS:
        for tolerance in TOLERANCES:
            simulation = pdipc.Simulation(scene(young, solver, tolerance), "cpu")
            x, result, seconds = solved(simulation, state)
            rows.append(
                {
                    "case": name,
                    "solver": solver,
                    "tolerance_m_per_s": tolerance,
                    "error_m": float(np.linalg.norm(x - end, axis=1).max()),
                    "seconds": seconds,
                    "iterations": result.outer if solver == "newton" else result.local_global,
                    "outer": result.outer,
                    "linear": result.linear_iterations,
                    "converged": result.converged,
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    return rows


def draw(rows: list[dict], file: Path) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    figure, axes = plt.subplots(2, len(STIFFNESS), figsize=(15, 6.2), sharex="row", sharey="row", layout="constrained")
    for column, case in enumerate(STIFFNESS):
        for solver, color in zip(SOLVERS, ("#2f6fb0", "#d1702b"), strict=True):
            own = [row for row in rows if row["case"] == case and row.get("solver") == solver]
            error = np.maximum([row["error_m"] for row in own], 1e-12)
            for axis, key, scale in ((axes[0, column], "seconds", 1e3), (axes[1, column], "iterations", 1.0)):
                across = scale * np.array([row[key] for row in own])
                axis.loglog(across, error, "-", color=color, label=solver)
                done = np.array([row["converged"] for row in own])
                axis.plot(across[done], error[done], "o", color=color)
                axis.plot(across[~done], error[~done], "x", color=color)
                axis.grid(alpha=0.3)
                axis.xaxis.set_minor_formatter(NullFormatter())
        axes[0, column].set_title(case)
        axes[0, column].set_xlabel("ms of the processor")
        axes[1, column].set_xlabel("iterations")
    for axis in axes[:, 0]:
        axis.set_ylabel("error, m")
    axes[0, 0].plot([], [], "x", color="black", label="not converged, and told so")
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--drawn", action="store_true", help="draws what the output file holds already")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    os.environ.setdefault("PDIPC_THREADS", "1")
    if options.drawn:
        draw(json.loads(options.output.read_text())["rows"], options.picture)
        return
    rows = [row for name, young in STIFFNESS.items() for row in measure(name, young)]
    machine = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "date": time.strftime("%Y-%m-%d"),
    }
    options.output.write_text(json.dumps({**machine, "load": os.getloadavg()[0], "rows": rows}, indent=1))
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
