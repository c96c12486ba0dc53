"""Time per step on the benchmark scenes, by stage: `python benchmarks/simulation.py [NAME ...] [--steps N] [--seconds S]`.

Prints a table and writes benchmarks/results/simulation.json with the machine named. Each scene has a process of its own, so that
peak memory is its own. A scene that takes longer than --seconds is cut short, and says so. The last column counts intersections
of the last frame, by the independent witness. The growth exponent p says that a step of a cloth takes time ~ vertices^p.
"""

import argparse
import json
import math
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pdipc

H = 0.01


def solid(cells: int, size: float, at: tuple, **more) -> dict:
    mesh = {"shape": "box", "size": [size] * 3, "cells": [cells] * 3}
    material = {"young_modulus": 1e5, "poisson_ratio": 0.3, "density": 1000.0}
    return {"name": "block", "kind": "solid", "mesh": mesh, "translation": at, "material": material, **more}


def plane(name: str, height: float, **more) -> dict:
    return {"name": name, "mesh": {"shape": "plane", "size": 4.0}, "translation": [0, height, 0], **more}


def cloth_on_sphere(side: int) -> dict:
    mesh = {"shape": "grid", "size": [1.0, 1.0], "cells": [side - 1, side - 1]}
    material = {"areal_density": 0.2, "membrane_stiffness": 1000.0, "bending_stiffness": 1e-4}
    cloth = {"name": "cloth", "kind": "cloth", "mesh": mesh, "translation": [0.01, 0.32, 0.02], "rotation": [0, 7, 0]}
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.3, "cells": 20}}
    contact = {"activation_distance": 2e-3, "friction": 0.2}
    return {"bodies": [{**cloth, "material": material}], "obstacles": [ball], "contact": contact}


def block_on_floor(cells: int) -> dict:
    contact = {"activation_distance": 1e-3, "friction": 0.2}
    return {"bodies": [solid(cells, 0.2, (0, 0.15, 0))], "obstacles": [plane("floor", 0.0)], "contact": contact}


def squeezed_block(cells: int) -> dict:
    """Plates close on a block of 0.2 m to 30 % of its height within a second."""
    top = plane("top", 0.202, rotation=[180, 0, 0], motion={"velocity": [0, -0.14, 0], "end": 1.0})
    contact = {"activation_distance": 1e-3, "friction": 0.2}
    return {"bodies": [solid(cells, 0.2, (0, 0.101, 0))], "obstacles": [plane("floor", 0.0), top], "contact": contact}


def blocks_on_rod(cells: int) -> dict:
    """Two blocks, one after the other, fall over a rod a tenth as thick as their cells' diagonal."""
    first = solid(cells, 0.2, (0.03, 0.62, 0), velocity=[0, -1, 0])
    second = {**solid(cells, 0.2, (-0.02, 0.86, 0.03), velocity=[0, -1, 0], rotation=[0, 25, 0]), "name": "second"}
    rod = {"name": "rod", "mesh": {"shape": "cylinder", "radius": 0.0025, "length": 0.8, "cells": [2, 1]}}
    rod |= {"rotation": [90, 0, 0], "translation": [0, 0.5, 0]}
    contact = {"activation_distance": 1e-3, "friction": 0.05}
    return {"bodies": [first, second], "obstacles": [rod, plane("floor", 0.0)], "contact": contact}


SCENES = {
    "cloth 50x50": lambda: cloth_on_sphere(50),
    "cloth 100x100": lambda: cloth_on_sphere(100),
    "cloth 200x200": lambda: cloth_on_sphere(200),
    "block 10^3": lambda: block_on_floor(10),
    "block 20^3": lambda: block_on_floor(20),
    "squeezed block 10^3": lambda: squeezed_block(10),
    "two 8^3 blocks on a rod": lambda: blocks_on_rod(8),
}
GROWTH = ("cloth 50x50", "cloth 100x100", "cloth 200x200")


def measure(name: str, steps: int, seconds: float) -> dict:
    simulation = pdipc.Simulation(pdipc.Scene(simulation={"time_step": H, "steps": steps}, **SCENES[name]()), "cpu")
    simulation.step()  # compiles
    simulation.reset()
    results, times, begun = [], [], time.perf_counter()
    while len(results) < steps and time.perf_counter() - begun < seconds:
        start = time.perf_counter()
        results.append(simulation.step())
        times.append(1e3 * (time.perf_counter() - start))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # before the witness takes its own
    found = pdipc.find_intersections(simulation.positions, simulation.triangles, simulation.model.assembly.obstacle)
    stages = {key: statistics.fmean(r.milliseconds[key] for r in results) for key in results[0].milliseconds}
    return {
        "scene": name,
        "vertices": simulation.model.vertex_count,
        "steps": len(results),
        "asked": steps,
        **spread(times),
        "outer": statistics.fmean(r.outer for r in results),
        "local_global": statistics.fmean(r.local_global for r in results),
        "linear_iterations": statistics.fmean(r.linear_iterations for r in results),
        "barriers": statistics.fmean(r.barriers for r in results),
        "unconverged": sum(not r.converged for r in results),
        "stages_ms": stages,
        "peak_memory_mb": peak,
        "intersections": len(found),
        "times_ms": [round(each, 2) for each in times],
    }


def spread(times: list[float]) -> dict:
    """Median, quartiles, mean and largest."""
    quartiles = statistics.quantiles(times, n=4) if len(times) > 1 else 3 * times
    return {
        "median_ms": statistics.median(times),
        "quartiles_ms": [quartiles[0], quartiles[2]],
        "mean_ms": statistics.fmean(times),
        "max_ms": max(times),
    }


def machine() -> str:
    """The processor's name and the number of cores."""
    info = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.split(":")[1].strip() for line in info if "model name" in line), platform.processor())
    return f"{model}, {os.cpu_count()} cores"


def growth(rows: list[dict]) -> float | None:
    """Exponent p of time ~ vertices^p between the smallest and the largest cloth, over the steps that both took."""
    found = {row["scene"]: row for row in rows}
    if not {GROWTH[0], GROWTH[-1]} <= found.keys():
        return None
    small, large = found[GROWTH[0]], found[GROWTH[-1]]
    common = min(small["steps"], large["steps"])
    cost = [statistics.fmean(row["times_ms"][:common]) for row in (small, large)]
    return math.log(cost[1] / cost[0]) / math.log(large["vertices"] / small["vertices"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *SCENES], default=[], metavar="NAME", help=", ".join(SCENES))
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--alone", action="store_true", help="Measure one NAME in this process and print JSON.")
    options = parser.parse_args()
    if options.alone:
        print(json.dumps(measure(options.names[0], options.steps, options.seconds)))
        return
    rows = []
    for name in options.names or SCENES:
        command = [sys.executable, __file__, name, "--alone", "--steps", str(options.steps), "--seconds", str(options.seconds)]
        row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])
        rows.append(row)
        stages = " ".join(f"{key} {value:.1f}" for key, value in row["stages_ms"].items())
        low, high = row["quartiles_ms"]
        print(
            f"{name:24} {row['steps']:4}/{row['asked']} steps  median {row['median_ms']:8.1f} ({low:.1f} to {high:.1f})  "
            f"mean {row['mean_ms']:8.1f}  max {row['max_ms']:8.1f} ms  outer {row['outer']:5.1f}  unconverged "
            f"{row['unconverged']:3}  [{stages}]  {row['peak_memory_mb']:.0f} MB  intersections {row['intersections']}",
            flush=True,
        )
    exponent = growth(rows)
    if exponent is not None:
        print(f"growth: time ~ vertices^{exponent:.2f} from {GROWTH[0]} to {GROWTH[-1]}")
    report = {"machine": machine(), "load_average": os.getloadavg()[0], "growth_exponent": exponent, "rows": rows}
    out = Path(__file__).parent / "results" / "simulation.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
