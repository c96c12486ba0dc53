"""Convergence on hard scenes: `python benchmarks/hard.py [--scenes NAME ...] [--data FOLDER] [--steps N] [--pictures FOLDER] [--states FOLDER] [-o FILE]`.

Runs each scene of `hard_scenes.py` at full length, and writes as it goes, a row a scene: the share of steps that converged (and of those in which
something scripted waits), median and worst ms by the wall clock, the median by the processor, outer iterations, the true error of sampled steps
(each is taken again from the same state at 1e-6 m/s), inverted tets at most and at the end, the fastest vertex, frames with intersections by the
witness and by IPC Toolkit where it is installed, and the load of the machine. --states keeps where steps begin that do not converge; --pictures draws
each scene, and all of them in one.
"""

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path

import hard_scenes
import numpy as np
from scoreboard import inverted

import pdipc
from pdipc.drive import step
from pdipc.model import Model
from pdipc.output.results import RunWriter
from pdipc.simulation import stats_of

RESULTS = Path(__file__).parent / "results" / "hard.json"
SAMPLES, STRICT = 4, 1e-6  # steps, m/s


def true_errors(scene: pdipc.Scene, states: list[dict]) -> list[float]:
    """m: of one step from each state, against the same step at a far stricter tolerance. Steps of which that does not converge tell nothing."""
    fine = scene.model_copy(deep=True)
    fine.simulation.tolerance, fine.simulation.max_outer = STRICT, 1000
    coarse, exact = (pdipc.Simulation(each, "cpu") for each in (scene, fine))
    errors = []
    for state in states:
        ends = [step(s.model, s.model.state_from(state), s.work) for s in (coarse, exact)]
        if all(end.converged and end.lag == 0.0 for end in ends):
            errors.append(float(np.linalg.norm(np.subtract(*(end.state.positions.numpy() for end in ends)), axis=1).max()))
    return errors


def toolkit(simulation: pdipc.Simulation):
    """A function positions -> whether bodies intersect by IPC Toolkit, or None where it is not installed. Obstacles may pass through each other."""
    try:
        import ipctk
    except ImportError:
        return None
    mesh = ipctk.CollisionMesh(simulation.positions, ipctk.edges(simulation.triangles), simulation.triangles)
    mesh.can_collide = ipctk.make_static_obstacle_filter(int((~simulation.model.assembly.obstacle).sum()))  # bodies come first
    return lambda x: bool(ipctk.has_intersections(mesh, x))


class Recorder:
    """The frames of a run, for `pdipc render`."""

    def __init__(self, folder: Path, scene: pdipc.Scene, model: Model):
        said = {"picture": scene.picture.model_dump(mode="json"), "simulation": {"steps": scene.simulation.steps}}
        for kind in ("bodies", "obstacles"):
            said[kind] = [{"name": body.name, "look": body.look.model_dump(mode="json")} for body in getattr(scene, kind)]
        topology = {"triangles": model.triangles, **model.assembly.topology()}
        self.writer = RunWriter.create(folder, json.dumps(said), topology, {"precision": model.real.name}, overwrite=True)

    def __call__(self, number: int, simulation: pdipc.Simulation, record: dict) -> None:
        self.writer.append(number, simulation.state.time, simulation.positions, record)


def measure(name: str, scene: pdipc.Scene, steps: int | None, pictures: Path | None, states: Path | None) -> dict:
    """One row."""
    simulation = pdipc.Simulation(scene, "cpu")
    simulation.step()
    simulation.reset()
    model, steps = simulation.model, steps or scene.simulation.steps
    obstacle = model.assembly.obstacle
    tets = [body.tets for body in model.assembly.bodies if len(body.tets)]
    recorder = Recorder(pictures / name, scene, model) if pictures else None
    intersects = toolkit(simulation)
    wall, processor, results, unconverged, turned, fastest = [], [], [], [], [], 0.0
    witnessed, by_toolkit, sampled = 0, 0, []
    chosen = set(np.linspace(0.1 * steps, steps - 1, SAMPLES).astype(int))
    for k in range(steps):
        before = simulation.state.arrays()
        begun, cpu = time.perf_counter(), time.process_time()
        result = simulation.step()
        wall.append(time.perf_counter() - begun)
        processor.append(time.process_time() - cpu)
        x = simulation.positions
        results.append(stats_of(result))
        if k in chosen:
            sampled.append(before)
        if not result.converged:
            unconverged.append({"step": k, "outer": result.outer, "message": result.message, "residual_m": result.residual})
            if states:
                np.savez(states / f"{name}_{k:04d}.npz", **before)
        turned.append(inverted(x, tets))
        fastest = max(fastest, float(np.linalg.norm(simulation.state.velocities.numpy()[~obstacle], axis=1).max()))
        witnessed += bool(len(pdipc.find_intersections(x, simulation.triangles, obstacle)))
        by_toolkit += bool(intersects and intersects(x))
        if recorder:
            recorder(k, simulation, results[-1])
    if recorder:
        recorder.writer.close()
    errors = true_errors(scene, sampled)
    return {
        "scene": name,
        "title": scene.title,
        "vertices": int((~obstacle).sum()),
        "steps": steps,
        "converged_share": 1.0 - len(unconverged) / steps,
        "waiting_steps": sum(r["lag"] > 0.0 for r in results),
        "total_s": sum(wall),
        "median_ms": 1e3 * float(np.median(wall)),
        "worst_ms": 1e3 * max(wall),
        "median_processor_ms": 1e3 * float(np.median(processor)),
        "worst_over_median_outer": max(r["outer"] for r in results) / float(np.median([r["outer"] for r in results])),
        "outer": float(np.mean([r["outer"] for r in results])),
        "linear": float(np.mean([r["linear_iterations"] for r in results])),
        "barriers": max(r["barriers"] for r in results),
        "smallest_gap_m": min(r["smallest_gap"] or np.inf for r in results),
        "tolerance_m": model.settings.tolerance,
        "true_error_m": max(errors, default=None),
        "true_errors_sampled": len(errors),
        "inverted_tets_most": max(turned),
        "inverted_tets_end": turned[-1],
        "fastest_m_per_s": fastest,
        "intersecting_frames": witnessed,
        "intersecting_frames_toolkit": by_toolkit if intersects else None,
        "load": os.getloadavg()[0],
        "unconverged": unconverged,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="*", default=[*hard_scenes.SCENES, *hard_scenes.DATA_SCENES])
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("PDIPC_DATA", "../shared/data")))
    parser.add_argument("--steps", type=int, help="absent: each scene at full length")
    parser.add_argument("--pictures", type=Path, help="a folder for frames and pictures")
    parser.add_argument("--states", type=Path, help="a folder for the states that unconverged steps begin at")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    report = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": sys.version.split()[0],
        "date": time.strftime("%Y-%m-%d"),
        "rows": [],
    }
    for folder in filter(None, (options.pictures, options.states)):
        folder.mkdir(parents=True, exist_ok=True)
    for name in options.scenes:
        if name in hard_scenes.SCENES:
            scene = hard_scenes.SCENES[name]()
        elif options.data.is_dir():
            scene = hard_scenes.DATA_SCENES[name](options.data)
        else:
            print(f"{name}: left out, there is no folder {options.data}", flush=True)
            continue
        row = measure(name, scene, options.steps, options.pictures, options.states)
        report["rows"].append(row)
        short = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in row.items() if k != "unconverged"}
        print(json.dumps(short | {"unconverged": len(row["unconverged"])}), flush=True)
        options.output.write_text(json.dumps(report, indent=1))
    if options.pictures:
        compose(options.pictures)


def compose(folder: Path) -> None:
    """Draws each run, and all in one picture."""
    import matplotlib.pyplot as plt

    from pdipc.output.results import open_run
    from pdipc.pictures.render import render, settings_of

    runs = {name: open_run(folder / name) for name in hard_scenes.SHOWN if (folder / name).is_dir()}
    columns = 4
    figure, axes = plt.subplots(
        -(-len(runs) // columns), columns, figsize=(19.2, 3.4 * -(-len(runs) // columns)), layout="constrained"
    )
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[], frame_on=False)
    for axis, (name, run) in zip(axes.ravel(), runs.items(), strict=False):
        shown, file = min(hard_scenes.SHOWN[name], run.frame_count - 1), folder / f"{name}.png"
        render(run, shown, file, settings_of(run).model_copy(update={"size": (1200, 800)}))
        axis.imshow(plt.imread(file))
        axis.set_xlabel(name.replace("_", " "), fontsize=15)
    figure.savefig(folder / "hard.png", dpi=100)


if __name__ == "__main__":
    main()
