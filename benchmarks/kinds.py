"""Random scenes of every kind of body: `python benchmarks/kinds.py [--scenes 64] [--seed 0] [--seconds S] [--limit S] [-o FILE]`.

Cloth with warp and weft, pillows, rods, rigid bodies and solids fall on each other; sleeves are sewn, knots tightened, rigid chains swing, things are thrown at
rope ladders, into hammocks and skirts (`kind_scenes.py`, seeds 0 to 63); they are tied to each other, welded, sewn on, pressed and led (`kind_ties.py`, seeds 64 to 127). The independent
witness judges every outer iteration, through which bodies move on straight lines. Prints, and writes as it goes, what each scene took and each step that did not converge, and what motion without
sense would show in: the fastest vertex, m/s, by how much the worst rigid body was strained, and how much of its limit the most stretched cloth used. A scene that takes more CPU than --limit is cut short, and says so.
"""

import argparse
import json
import os
import time
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from kind_scenes import draw
from simulation import machine

import pdipc
from pdipc.judge.witness import Watch
from pdipc.scene.assembly import Assembly
from pdipc.scene.check_garments import stretches

RESULTS = Path(__file__).parent / "results" / "kinds.json"


def strained(assembly: Assembly) -> float:
    """The largest strain of a rigid body: by how much what its four points span is longer, or shorter, one way than at rest."""
    worst = 0.0
    for body in assembly.bodies:
        if len(body.handles):
            now, rest = (x[body.handles[1:]] - x[body.handles[0]] for x in (assembly.positions, assembly.rest_positions))
            worst = max(worst, np.abs(np.linalg.svd(np.linalg.solve(rest, now))[1] - 1.0).max())
    return float(worst)


def stretched(assembly: Assembly) -> float:
    """The largest strain of cloth that has a limit, in parts of it."""
    worst = 0.0
    for body in assembly.bodies:
        limit = getattr(body.material, "strain_limit", None)
        if limit is not None:
            worst = max(worst, (stretches(assembly, body)[1].max() - 1.0) / limit)
    return float(worst)


def simulate(seed: int, limit: float) -> dict:
    """limit: s of this process, whatever else the machine does."""
    row: dict = {"seed": seed}
    try:
        row["family"], scene = draw(seed)
        simulation = pdipc.Simulation(scene, "cpu")
    except pdipc.SceneError as error:
        return {**row, "refused": str(error)}
    watch = Watch(simulation.triangles, simulation.model.assembly.obstacle)
    states, intersecting = 0, 0

    def judge(_, end) -> None:
        nonlocal states, intersecting
        states += 1
        intersecting += bool(len(watch(end.numpy().astype(np.float64))))

    simulation.observe = judge
    results, begun = [], time.process_time()
    row |= {"fastest": 0.0, "strained": 0.0, "stretched": 0.0}
    while len(results) < scene.simulation.steps and time.process_time() - begun < limit:
        results.append(simulation.step())
        now = replace(simulation.model.assembly, positions=simulation.positions.astype(np.float64))
        speed = float(np.linalg.norm(simulation.velocities, axis=1).max())
        for name, value in (("fastest", speed), ("strained", strained(now)), ("stretched", stretched(now))):
            row[name] = max(row[name], value)
    times = [sum(result.milliseconds.values()) for result in results]
    row |= {"precision": scene.simulation.precision, "steps": len(results), "asked": scene.simulation.steps}
    row |= {"states": states, "intersecting": intersecting, "finite": bool(np.isfinite(simulation.positions).all())}
    row |= {"outer": float(np.mean([result.outer for result in results])), "most": max(result.outer for result in results)}
    row |= {"median_ms": float(np.median(times)), "worst_ms": max(times)}
    row["unconverged"] = [
        {"step": k, "outer": result.outer, "message": result.message}
        for k, result in enumerate(results)
        if not result.converged
    ]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=3600.0, help="no new scene is begun after so long")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds of CPU that a scene may take")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", pdipc.SceneWarning)
    begun, rows = time.perf_counter(), []
    for seed in range(arguments.seed, arguments.seed + arguments.scenes):
        if time.perf_counter() - begun > arguments.seconds:
            break
        try:
            rows.append(simulate(seed, arguments.limit))
        except Exception:  # one broken scene must not hide the others
            rows.append({"seed": seed, "broken": traceback.format_exc()})
        print(json.dumps(rows[-1]), flush=True)
        ran = [row for row in rows if "steps" in row]
        report = {"machine": machine(), "load_average": os.getloadavg()[0], "date": time.strftime("%Y-%m-%d")}
        report |= {
            "scenes": len(ran),
            "refused": sum("refused" in row for row in rows),
            "broken": sum("broken" in row for row in rows),
        }
        report |= {name: sum(row[name] for row in ran) for name in ("steps", "states", "intersecting")}
        report["unconverged"] = sum(len(row["unconverged"]) for row in ran)
        arguments.output.write_text(json.dumps({**report, "rows": rows}, indent=1))
    print(json.dumps(report))


if __name__ == "__main__":
    main()
