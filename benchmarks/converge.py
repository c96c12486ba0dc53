"""Whether steps converge on scenes that nobody chose: `python benchmarks/converge.py [--scenes 200] [--true 60] [--seed 0] [--steps 12] [--seconds S] [-o FILE]`.

One or two bodies, solids of 1 kPa to 200 GPa or cloth, of 1 cm to 10 m, fly at each other and at a floor, a thin rod and a plate that comes down, with steps of
1/500 s to 1/25 s, both precisions, with and without friction. Speeds go with sizes: up to ten sizes a second. Each scene that cannot start is drawn again. Prints, and
writes, the share of steps that converged, and for each that did not: the scene's seed, the step, and what the step said; every frame is judged by the witness. Of the first
scenes, as many as --true says, each step is taken again, from the same state, at a thousandth of the tolerance: how far the two ends are from each other, where
both converged, is the true error.
"""

import argparse
import json
import os
import platform
import time
import warnings
from pathlib import Path

import numpy as np

import pdipc
from pdipc.drive import step
from pdipc.scene.reach import unresolved

RESULTS = Path(__file__).parent / "results" / "converge.json"


def draw(seed: int) -> pdipc.Scene:
    rng = np.random.default_rng(seed)
    size, h = 10.0 ** rng.uniform(-2.0, 1.0), 1.0 / rng.integers(25, 501)
    fastest = min(20.0, 10.0 * size)
    bodies = []
    for k in range(rng.integers(1, 3)):
        place = {
            "name": f"body{k}",
            "translation": (
                size * np.array([rng.uniform(-0.3, 0.3), rng.uniform(0.4, 0.6) + 0.7 * k, rng.uniform(-0.3, 0.3)])
            ).tolist(),
            "rotation": rng.uniform(0.0, 90.0, 3).tolist(),
            "velocity": rng.uniform(-fastest, fastest, 3).tolist(),
            "angular_velocity": rng.uniform(-10.0, 10.0, 3).tolist(),
        }
        if rng.random() < 0.6:
            young = 10.0 ** rng.uniform(3.0, np.log10(2e11))
            cells = rng.integers(1, 4, 3).tolist()
            mesh = {"shape": "box", "size": (size * np.array([0.3, 0.2, 0.2])).tolist(), "cells": cells}
            material = {"young_modulus": young, "poisson_ratio": rng.uniform(0.1, 0.45), "density": 1000.0}
            bodies.append({**place, "kind": "solid", "mesh": mesh, "material": material})
        else:
            mesh = {"shape": "grid", "size": [0.4 * size, 0.4 * size], "cells": rng.integers(3, 9, 2).tolist()}
            bodies.append({**place, "kind": "cloth", "mesh": mesh})
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 4.0 * size}}
    rod = {
        "name": "rod",
        "mesh": {"shape": "cylinder", "radius": size * 10.0 ** rng.uniform(-3.0, -1.3), "length": size, "cells": [8, 1]},
    }
    rod |= {"rotation": [90.0, rng.uniform(0.0, 90.0), 0.0], "translation": [0.0, 0.12 * size, 0.0]}
    plate = {"name": "plate", "mesh": {"shape": "plane", "size": size}, "rotation": [180.0, 0.0, 0.0]}
    plate |= {"translation": [0.0, 2.0 * size, 0.0], "motion": {"velocity": [0.0, -rng.uniform(0.0, fastest), 0.0]}}
    return pdipc.Scene(
        simulation={"time_step": h, "precision": str(rng.choice(["float32", "float64"]))},
        contact={"friction": float(rng.choice([0.0, 0.5]))},
        bodies=bodies,
        obstacles=[floor, rod, plate],
    )


def strictly(scene: pdipc.Scene, simulation: pdipc.Simulation) -> pdipc.Simulation:
    """The same scene at a thousandth of the tolerance, a hundredth where float32 tells no more."""
    strict = scene.model_copy(deep=True)
    part = 1e-3 if simulation.model.real.name == "float64" else 1e-2
    strict.simulation.tolerance = part * simulation.model.settings.tolerance / scene.simulation.time_step
    strict.simulation.max_outer = 1000
    return pdipc.Simulation(strict, "cpu")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--true", type=int, default=60, help="scenes whose steps are solved again")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=3600.0, help="no new scene is begun after so long")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", pdipc.SceneWarning)  # rows have it
    begun, seed = time.perf_counter(), arguments.seed
    report = {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "date": time.strftime("%Y-%m-%d")}
    report |= {"seed": arguments.seed, "scenes": 0, "steps": 0, "waiting_steps": 0, "intersecting_frames": 0, "unconverged": []}
    outer, errors = [], []
    while report["scenes"] < arguments.scenes and time.perf_counter() - begun < arguments.seconds:
        seed += 1
        scene = draw(seed)
        try:
            simulation = pdipc.Simulation(scene, "cpu")
        except pdipc.SceneError:
            continue
        strict = strictly(scene, simulation) if report["scenes"] < arguments.true else None
        report["scenes"] += 1
        obstacle = simulation.model.assembly.obstacle
        told = simulation.model.real.name == "float32" and bool(unresolved(scene, simulation.model.assembly))
        for k in range(arguments.steps):
            state = simulation.state.arrays() if strict else {}
            result = simulation.step()
            if strict and result.converged and result.lag == 0.0:
                again = step(strict.model, strict.model.state_from(state), strict.work)
                if again.converged and again.lag == 0.0:
                    moved = again.state.positions.numpy() - simulation.positions
                    error = float(np.linalg.norm(moved, axis=1).max() / simulation.model.settings.tolerance)
                    errors.append({"seed": seed, "step": k, "tolerances": error})
            outer.append(result.outer)
            report["steps"] += 1
            hits = pdipc.find_intersections(simulation.positions, simulation.triangles, obstacle)
            report["intersecting_frames"] += bool(len(hits))
            report["waiting_steps"] += result.lag > 0.0
            if not result.converged:
                row = {"seed": seed, "step": k, "outer": result.outer, "message": result.message, "residual_m": result.residual}
                row["told"] = told  # at the start, that float32 does not resolve a body
                report["unconverged"].append(row)
                print(json.dumps(row), flush=True)
        worst = sorted(errors, key=lambda row: -row["tolerances"])
        report["true_errors"] = {
            "steps": len(errors),
            "above_1": sum(row["tolerances"] > 1.0 for row in errors),
            "worst": worst[:5],
        }
        report |= {"mean_outer": float(np.mean(outer)), "most_outer": int(max(outer)), "seconds": time.perf_counter() - begun}
        arguments.output.write_text(json.dumps(report, indent=1))
    print(json.dumps({k: v for k, v in report.items() if k != "unconverged"} | {"unconverged": len(report["unconverged"])}))


if __name__ == "__main__":
    main()
