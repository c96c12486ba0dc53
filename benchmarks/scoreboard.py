"""The scenes that peers are measured on, by pdipc: `python benchmarks/scoreboard.py [--scenes s2_10 ...] [--tolerance M_PER_S] [-o FILE]`.

Prints, and writes to benchmarks/results/scoreboard.json, for each scene (`peer_scenes.py`): seconds for the 100 steps, median, 95th
percentile and worst step in ms, all by the wall clock and the median by the processor; outer and linear iterations; barriers; unconverged steps;
the largest estimated error and force residual; intersecting frames, judged by the witness; inverted tets; and the true error of sampled steps, which are
taken again from the same state at a tolerance of 1e-7 m/s. Beside it stand figures of STARK (tolerance 0.01 m/s, two threads) and of the original
IPC on the very same scenes, *recorded* on two cores of the same kind, not in this run.
"""

import argparse
import json
import os
import platform
import resource
import sys
import time
from pathlib import Path

import numpy as np
import peer_scenes

import pdipc
from pdipc.drive import step

RESULTS = Path(__file__).parent / "results" / "scoreboard.json"
# Recorded: total s and median ms of 100 steps, wall clock.
STARK = {"s1_50": (52.0, 419.5), "s2_10": (1.71, 10.3), "s2_20": (10.5, 71.0), "s3_8": (9.71, 69.1), "s4_10": (20.8, 54.1)}
ORIGINAL_IPC = {
    "s2_10": (104.9, 1048.9),
    "s3_8": (375.0, 3750.2),
    "s4_10": (84.0, 840.1),
}  # two were cut short: steps times their mean
SAMPLES = 3


def inverted(positions: np.ndarray, tets: list[np.ndarray]) -> int:
    """Tets of negative volume."""
    count = 0
    for each in tets:
        a, b, c, d = (positions[each[:, k]] for k in range(4))
        count += int((np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) <= 0).sum())
    return count


def true_errors(scene: pdipc.Scene, states: list) -> list[float]:
    """m: of one step from each state, against the same step at a tolerance of 1e-7 m/s."""
    errors = []
    fine = scene.model_copy(deep=True)
    fine.simulation.tolerance, fine.simulation.max_outer = 1e-7, 2000
    ends = []
    for each in (scene, fine):
        simulation = pdipc.Simulation(each, "cpu")
        own = []
        for state in states:
            result = step(simulation.model, simulation.model.state_from(state), simulation.work)
            own.append(result.state.positions.numpy())
        ends.append(own)
    for coarse, exact in zip(*ends, strict=True):
        errors.append(float(np.linalg.norm(coarse - exact, axis=1).max()))
    return errors


def measure(name: str, tolerance: float | None, steps: int) -> dict:
    """One row."""
    scene = peer_scenes.scene(name)
    if tolerance is not None:
        scene.simulation.tolerance = tolerance
    simulation = pdipc.Simulation(scene, "cpu")
    simulation.step()
    simulation.reset()
    tets = [body.tets for body in simulation.model.assembly.bodies if len(body.tets)]
    wall, processor, results, frames, states = [], [], [], [], []
    sampled = set(np.linspace(5, steps - 1, SAMPLES).astype(int))
    for k in range(steps):
        if k in sampled:
            states.append(simulation.state.arrays())
        begun, cpu = time.perf_counter(), time.process_time()
        results.append(simulation.step())
        wall.append(time.perf_counter() - begun)
        processor.append(time.process_time() - cpu)
        frames.append(simulation.positions)
    obstacle = simulation.model.assembly.obstacle
    hits = sum(bool(len(pdipc.find_intersections(x, simulation.triangles, obstacle))) for x in frames[:: max(1, steps // 25)])
    stark, original = STARK.get(name), ORIGINAL_IPC.get(name)
    return {
        "scene": name,
        "steps": steps,
        "tolerance_m": simulation.model.settings.tolerance,
        "total_s": sum(wall),
        "median_ms": 1e3 * float(np.median(wall)),
        "p95_ms": 1e3 * float(np.percentile(wall, 95)),
        "worst_ms": 1e3 * max(wall),
        "median_processor_ms": 1e3 * float(np.median(processor)),
        "outer": float(np.mean([r.outer for r in results])),
        "linear": float(np.mean([r.linear_iterations for r in results])),
        "barriers": float(np.mean([r.barriers for r in results])),
        "unconverged": sum(not r.converged for r in results),
        "estimated_error_m": max(r.residual for r in results),
        "force_residual_N": max(r.force_residual for r in results),
        "true_error_m": max(true_errors(scene, states)),
        "intersecting_frames": hits,
        "inverted_tets": max(inverted(x, tets) for x in frames),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "stark_recorded_total_s": stark and stark[0],
        "stark_recorded_median_ms": stark and stark[1],
        "ipc_recorded_median_ms": original and original[1],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="*", default=["s2_10", "s4_10", "s3_8", "s2_20", "s1_50"])
    parser.add_argument("--tolerance", type=float, help="m/s; absent: the default")
    parser.add_argument("--steps", type=int, default=peer_scenes.STEPS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    report = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": sys.version.split()[0],
        "date": time.strftime("%Y-%m-%d"),
        "rows": [],
    }
    for name in arguments.scenes:
        row = measure(name, arguments.tolerance, arguments.steps)
        row["load"] = os.getloadavg()[0]
        report["rows"].append(row)
        print(json.dumps({k: round(v, 6) if isinstance(v, float) else v for k, v in row.items()}), flush=True)
        arguments.output.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
