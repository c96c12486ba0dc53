"""Default mode against IPC: how far apart, and how much faster: `python benchmarks/accuracy.py [--steps 100] [--small]`.

An Armadillo of 9K tets (optional data, else a ball) is flattened between two boards, and three bodies fall into a box. Both run on
the same CPU in one go, from the same model: same meshes, masses, energies, barrier and minimum separation. IPC is the projected Newton of
pdipc.baselines with a supernodal Cholesky. Writes benchmarks/results/accuracy.json.
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from pathlib import Path

import numpy as np

import pdipc
from pdipc.baselines.common import Cholesky
from pdipc.baselines.reference import Reference
from pdipc.drive import Work, step

DATA = Path(os.environ.get("PDIPC_DATA", Path(__file__).parents[2] / "shared" / "data"))
TOLERANCE = 1e-6  # m, of IPC's Newton iterations


def flattened(small: bool) -> pdipc.Scene:
    """A body 0.5 m high between two boards that close to 40 % of its height."""
    path, mesh = DATA / "meshes/tet/armadillo_9k.npz", {"shape": "sphere", "radius": 0.25, "cells": 4}
    if path.exists() and not small:
        arrays = np.load(path)
        x = arrays["V"] - arrays["V"].min(axis=0)
        mesh = {"vertices": 0.5 * x / x[:, 1].max() - np.array([0.0, 0.25, 0.0]), "tets": arrays["T"]}
    body = {"name": "body", "kind": "solid", "mesh": mesh, "material": {"young_modulus": 1e5, "poisson_ratio": 0.3}}
    board = {"shape": "plane", "size": 3.0}
    close = {"velocity": (0, -0.3, 0), "end": 0.5}
    above = {"name": "upper", "mesh": board, "rotation": (180, 0, 0), "translation": (0, 0.255, 0), "motion": close}
    close = {"velocity": (0, 0.3, 0), "end": 0.5}
    below = {"name": "lower", "mesh": board, "translation": (0, -0.255, 0), "motion": close}
    return scene([body], [above, below])


def three_bodies(small: bool) -> pdipc.Scene:
    """A ball, a block and a torus fall into a box without a lid."""
    cells = 3 if small else 6
    shapes = {
        "ball": {"shape": "sphere", "radius": 0.12, "cells": cells},
        "block": {"shape": "box", "size": (0.2, 0.2, 0.2), "cells": (cells, cells, cells)},
        "torus": {"shape": "torus", "major_radius": 0.12, "minor_radius": 0.05, "cells": (2 if small else 4, 4 * cells)},
    }
    bodies = [
        {
            "name": name,
            "kind": "solid",
            "mesh": mesh,
            "translation": (0.03 * k, 0.2 + 0.28 * k, 0.02 * k),
            "rotation": (20.0 * k, 0.0, 15.0 * k),
            "material": {"young_modulus": 2e5, "poisson_ratio": 0.3},
        }
        for k, (name, mesh) in enumerate(shapes.items())
    ]
    walls = [((0, 0, 0), (0, 0, 0)), ((-0.3, 0.5, 0), (0, 0, -90)), ((0.3, 0.5, 0), (0, 0, 90))]
    walls += [((0, 0.5, -0.3), (90, 0, 0)), ((0, 0.5, 0.3), (-90, 0, 0))]
    size = {"shape": "plane", "size": 1.0}
    obstacles = [{"name": f"wall{k}", "mesh": size, "translation": at, "rotation": r} for k, (at, r) in enumerate(walls)]
    return scene(bodies, obstacles)


def scene(bodies: list, obstacles: list) -> pdipc.Scene:
    simulation = {"precision": "float64", "nonlinear_solver": "local-global", "linear_tolerance": 1e-2}
    return pdipc.Scene(bodies=bodies, obstacles=obstacles, simulation=simulation, contact={"activation_distance": 2e-3})


def ours(made: pdipc.Scene, steps: int, tolerance: float) -> tuple[np.ndarray, list[float], dict]:
    """Positions of the simulated vertices (steps, n, 3), seconds of each step, and counts."""
    simulation = made.simulation.model_copy(update={"outer_tolerance": tolerance})
    model = pdipc.build(made.model_copy(update={"simulation": simulation}), "cpu")
    free, work, state = model.free.numpy() > 0, Work(model), model.initial_state()
    path, seconds, outer, unconverged = [], [], [], 0
    for _ in range(steps):
        begin = time.perf_counter()
        result = step(model, state, work)
        seconds.append(time.perf_counter() - begin)
        state, unconverged = result.state, unconverged + (not result.converged)
        path.append(state.positions.numpy()[free])
        outer.append(result.outer)
    return np.array(path), seconds, {"outer": statistics.fmean(outer), "unconverged": unconverged}


def measure(name: str, made: pdipc.Scene, steps: int) -> dict:
    """Runs both; distances are relative to the size of the simulated bodies at the start."""
    model = pdipc.build(made, "cpu")
    free = model.free.numpy() > 0
    size = float(np.ptp(model.initial_state().positions.numpy()[free], axis=0).max())
    runs = {tolerance: ours(made, steps, tolerance) for tolerance in (1e-4, 1e-5)}  # the default, and a tenth of it
    reference, path, seconds, newton, unconverged = Reference(model), [], [], [], 0
    for k in range(steps):
        info = reference.step(tolerance=TOLERANCE)
        path.append(reference.state.positions[free])
        seconds.append(info.seconds)
        newton.append(info.iterations)
        unconverged += not info.converged
        if sys.stderr.isatty():
            print(f"\r{name}: IPC step {k + 1} of {steps}, {info.seconds:.2f} s   ", end="", file=sys.stderr, flush=True)
    row = {
        "scene": name,
        "vertices": int(free.sum()),
        "tets": sum(len(body.tets) for body in model.assembly.bodies),
        "steps": steps,
        "IPC": {"ms": 1e3 * statistics.median(seconds), "Newton": statistics.fmean(newton), "unconverged": unconverged},
    }
    print(f"\n{name}: IPC {row['IPC']['ms']:.0f} ms a step, {row['IPC']['Newton']:.1f} Newton iterations")
    for tolerance, (own, took, counts) in runs.items():
        away = np.linalg.norm(own - np.array(path), axis=2).max(axis=1) / size
        row[f"tolerance {tolerance:g}"] = {
            "ms": 1e3 * statistics.median(took),
            "ratio of medians": statistics.median(seconds) / statistics.median(took),
            "ratio of means": statistics.fmean(seconds) / statistics.fmean(took),
            "largest distance": float(away.max()),
            "distance over steps": away.tolist(),
            **counts,
        }
        told = {k: v for k, v in row[f"tolerance {tolerance:g}"].items() if not isinstance(v, list)}
        print(f"  tolerance {tolerance:g}: " + ", ".join(f"{k} {v:.3g}" for k, v in told.items()))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--small", action="store_true", help="coarse bodies; nothing is written")
    options = parser.parse_args()
    rows = [
        measure("three bodies in a box", three_bodies(options.small), options.steps),
        measure("Armadillo flattened", flattened(options.small), options.steps),
    ]
    if not options.small:
        cpu = next((x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in x), "")
        machine = {"machine": f"{cpu or platform.machine()}, {os.cpu_count()} cores", "load_average": os.getloadavg()[0]}
        out = Path(__file__).parent / "results" / "accuracy.json"
        out.write_text(json.dumps(machine | {"linear solver of IPC": Cholesky.name, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
