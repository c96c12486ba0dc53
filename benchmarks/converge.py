"""Whether steps converge on scenes that nobody chose: `python benchmarks/converge.py [--scenes 200] [--seed 0] [--steps 12] [--seconds S] [-o FILE]`.

One or two bodies, solids of 1 kPa to 200 GPa or cloth, of 1 cm to 10 m, fly at each other and at a floor, a thin rod and a plate that comes down, with steps of
1/500 s to 1/25 s, both precisions, with and without friction. Speeds go with sizes: up to ten sizes a second. Each scene that cannot start is drawn again. Prints, and
writes, the share of steps that converged, and for each that did not: the scene's seed, the step, and what the step said; every frame is judged by the witness.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import numpy as np

import pdipc

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=3600.0, help="no new scene is begun after so long")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    begun, seed = time.perf_counter(), arguments.seed
    report = {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "date": time.strftime("%Y-%m-%d")}
    report |= {"seed": arguments.seed, "scenes": 0, "steps": 0, "waiting_steps": 0, "intersecting_frames": 0, "unconverged": []}
    outer = []
    while report["scenes"] < arguments.scenes and time.perf_counter() - begun < arguments.seconds:
        seed += 1
        try:
            simulation = pdipc.Simulation(draw(seed), "cpu")
        except pdipc.SceneError:
            continue
        report["scenes"] += 1
        obstacle = simulation.model.assembly.obstacle
        for k in range(arguments.steps):
            result = simulation.step()
            outer.append(result.outer)
            report["steps"] += 1
            hits = pdipc.find_intersections(simulation.positions, simulation.triangles, obstacle)
            report["intersecting_frames"] += bool(len(hits))
            report["waiting_steps"] += result.lag > 0.0
            if not result.converged:
                row = {"seed": seed, "step": k, "outer": result.outer, "message": result.message, "residual_m": result.residual}
                report["unconverged"].append(row)
                print(json.dumps(row), flush=True)
        report |= {"mean_outer": float(np.mean(outer)), "most_outer": int(max(outer)), "seconds": time.perf_counter() - begun}
        arguments.output.write_text(json.dumps(report, indent=1))
    print(json.dumps({k: v for k, v in report.items() if k != "unconverged"} | {"unconverged": len(report["unconverged"])}))


if __name__ == "__main__":
    main()
