"""Default mode against IPC: how far apart, and how much faster: `python benchmarks/accuracy.py [--steps 100] [--small]`.

An Armadillo of 9K tets (optional data, else a ball) is flattened between two boards, and three bodies fall into a box. Both run on
the same CPU in one go, from the same model: same meshes, masses, energies, barrier and minimum separation. IPC is the projected Newton of
pdipc.baselines with a supernodal Cholesky. Every step of IPC is taken by our own solver as well, from the same state. Writes benchmarks/results/accuracy.json.
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
from pdipc.baselines import ipc
from pdipc.baselines.common import Cholesky
from pdipc.baselines.reference import Reference
from pdipc.drive import Work, step
from pdipc.model import Model

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
    board = triangle(3.0)
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
    wall = triangle(2.0)
    obstacles = [{"name": f"wall{k}", "mesh": wall, "translation": at, "rotation": r} for k, (at, r) in enumerate(walls)]
    return scene(bodies, obstacles)


def triangle(size: float) -> dict:
    """One, that faces up: here several in a plane count as the polygon that they make, whose inner edges do not push, in IPC they do."""
    return {"vertices": np.array([[-1.0, 0.0, -1.0], [0.0, 0.0, 2.0], [1.0, 0.0, -1.0]]) * size, "triangles": [[0, 1, 2]]}


def scene(bodies: list, obstacles: list) -> pdipc.Scene:
    """In double precision and with the energies that IPC has here as well."""
    for body in bodies:
        body["material"]["model"] = "arap"
    contact = {"activation_distance": 2e-3}
    return pdipc.Scene(bodies=bodies, obstacles=obstacles, simulation={"precision": "float64"}, contact=contact)


def built(made: pdipc.Scene, tolerance: float | None) -> Model:
    """tolerance: m of a step, in place of the default."""
    speed = None if tolerance is None else tolerance / made.simulation.time_step
    return pdipc.build(made.model_copy(update={"simulation": made.simulation.model_copy(update={"tolerance": speed})}), "cpu")


class Ours:
    """A run of our own, timed, and each step taken once more from where IPC starts it."""

    def __init__(self, made: pdipc.Scene, tolerance: float | None):
        self.model = built(made, tolerance)
        self.tolerance = self.model.settings.tolerance
        self.run, self.state = Work(self.model), self.model.initial_state()
        step(self.model, self.state, self.run)  # compiles
        self.single = Work(self.model)
        self.path, self.seconds, self.outer = [], [], []
        self.unconverged = self.unconverged_single = 0
        self.differences, self.lower = [], []

    def advance(self, problem: ipc._Step, before: ipc.State, after: ipc.State, number: int) -> None:
        begin = time.process_time()
        result = step(self.model, self.state, self.run)
        self.seconds.append(time.process_time() - begin)
        self.state = result.state
        self.path.append(self.state.positions.numpy())
        self.outer.append(result.outer)
        self.unconverged += not result.converged
        arrays = {"positions": before.positions, "velocities": before.velocities, "accelerations": 0.0 * before.velocities}
        arrays |= {"time": number * self.model.settings.time_step, "step": number}
        result = step(self.model, self.model.state_from(arrays), self.single)
        x, free = result.state.positions.numpy(), self.model.free_vertices
        self.unconverged_single += not result.converged
        self.differences.append(float(np.linalg.norm(x - after.positions, axis=1)[free].max()))
        self.lower.append(problem.energy(x, x) - problem.energy(after.positions, after.positions))

    def row(self, path: np.ndarray, seconds: list[float], size: float) -> dict:
        free = self.model.free_vertices
        away = np.linalg.norm(np.array(self.path) - path, axis=2)[:, free].max(axis=1) / size
        differences = np.array(self.differences)
        apart = differences > 3.0 * self.tolerance
        return {
            "tolerance, m": self.tolerance,
            "ms": 1e3 * statistics.median(self.seconds),
            "ratio of medians": statistics.median(seconds) / statistics.median(self.seconds),
            "ratio of means": statistics.fmean(seconds) / statistics.fmean(self.seconds),
            "outer": statistics.fmean(self.outer),
            "unconverged": self.unconverged,
            "single steps unconverged": self.unconverged_single,
            "median difference / tolerance": float(np.median(differences) / self.tolerance),
            "steps apart by more than 3 tolerances": int(apart.sum()),
            "of these with less potential than IPC's": int((np.array(self.lower)[apart] < 0.0).sum()),
            "largest difference, m": float(differences.max()),
            "largest distance of the runs / size": float(away.max()),
            "differences, m": self.differences,
            "potential above IPC's, J": self.lower,
            "distances of the runs / size": away.tolist(),
        }


def measure(name: str, made: pdipc.Scene, steps: int) -> dict:
    """Runs both; distances of runs are relative to the size of the simulated bodies at the start. Times are of the processor."""
    model = built(made, None)
    free = model.free_vertices
    size = float(np.ptp(model.initial_state().positions.numpy()[free], axis=0).max())
    runs = {"default": Ours(made, None), "1e-6 m": Ours(made, 1e-6)}
    reference, path, seconds, newton, unconverged = Reference(model), [], [], [], 0
    for k in range(steps):
        before = reference.state
        acceleration = model.external.accelerations(reference.time, before.positions, before.velocities)
        begin = time.process_time()
        info = reference.step(tolerance=TOLERANCE)
        seconds.append(time.process_time() - begin)
        path.append(reference.state.positions)
        newton.append(info.iterations)
        unconverged += not info.converged
        potential = ipc._Step(reference.problem, before, acceleration, TOLERANCE)
        for each in runs.values():
            each.advance(potential, before, reference.state, k)
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
    for label, own in runs.items():
        row[label] = own.row(np.array(path), seconds, size)
        told = {k: v for k, v in row[label].items() if not isinstance(v, list)}
        print(f"  {label}: " + ", ".join(f"{k} {v:.3g}" for k, v in told.items()), flush=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--small", action="store_true", help="coarse bodies; nothing is written")
    options = parser.parse_args()
    scenes, rows = {"three bodies in a box": three_bodies, "Armadillo flattened": flattened}, []
    for name, made in scenes.items():
        rows.append(measure(name, made(options.small), options.steps))
        if options.small:
            continue
        cpu = next((x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in x), "")
        machine = {"machine": f"{cpu or platform.machine()}, {os.cpu_count()} cores", "load_average": os.getloadavg()[0]}
        out = Path(__file__).parent / "results" / "accuracy.json"
        machine |= {"date": time.strftime("%Y-%m-%d"), "threads": os.environ.get("PDIPC_THREADS", "auto")}
        out.write_text(json.dumps(machine | {"linear solver of IPC": Cholesky.name, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
