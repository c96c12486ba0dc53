"""A skirt on a moving body: `python benchmarks/dance.py [--figure] [--data FOLDER] [--steps N] [--substeps K] [--out FOLDER] [--device D]`.

The body is a vertex cache of 61 frames, 1/25 s apart, and intersects itself; the skirt hangs on its hips, held by friction alone. With `--figure` it is
made here, of capsules that walk and swing its hips, and the skirt is coarser: minutes in place of an hour. A step is a part of a frame. Every outer iteration is
judged by the exact witness. Writes a line a step, and the frames for `pdipc render`.
"""

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import pdipc
from pdipc.judge.witness import Watch
from pdipc.output.results import RunWriter
from pdipc.scene.generators import Capsule
from pdipc.simulation import stats_of

FRAMES, INTERVAL = 60, 0.04  # s
CLOTH = {
    "areal_density": 0.128,
    "membrane_stiffness": 2000.0,
    "bending_stiffness": 5.2e-5,
}  # woven polyester, docs/materials.md
WAIST, NARROW = (0.0, 0.85, -0.02), (0.7, 1.0, 0.7)  # where the skirt goes, m, and its scale


def capsule(a: np.ndarray, b: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of what is within `radius` of the segment from a to b."""
    length = float(np.linalg.norm(b - a))
    mesh = Capsule(radius=radius, length=length, cells=(8, 6)).mesh().surface()
    turn = Rotation.align_vectors([b - a], [(0.0, length, 0.0)])[0]
    return turn.apply(mesh.vertices) + (a + b) / 2, mesh.triangles


def figure(time: float) -> tuple[np.ndarray, np.ndarray]:
    """A trunk and two legs with knees that walk on the spot and swing their hips, at `time` s: parts that overlap, as those of characters do."""
    phase, much = 2 * np.pi * time / 0.8, min(1.0, time / 0.4)
    hips = np.array([0.03 * much * np.sin(phase), 0.95 + 0.01 * much * np.cos(2 * phase), 0.0])
    across, up = np.array([0.05, 0.0, 0.0]), np.array([0.1 * much * np.sin(phase + 0.5), 0.45, 0.05 * much * np.sin(phase)])
    parts = [capsule(hips - across, hips + across, 0.13), capsule(hips, hips + up, 0.10)]
    for side in (-1.0, 1.0):
        swing = 0.5 * much * side * np.sin(phase)
        bent = swing - 0.6 * much * max(0.0, side * np.cos(phase))
        top = hips + np.array([0.08 * side, -0.05, 0.0])
        knee = top + 0.42 * np.array([0.0, -np.cos(swing), np.sin(swing)])
        parts += [capsule(top, knee, 0.075), capsule(knee, knee + 0.4 * np.array([0.0, -np.cos(bent), np.sin(bent)]), 0.055)]
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    return np.concatenate([v for v, _ in parts]), np.concatenate([t + k for (_, t), k in zip(parts, first, strict=False)])


def walking(substeps: int, limit: float | None) -> pdipc.Scene:
    """A skirt of 2,880 triangles on the figure."""
    times = INTERVAL * np.arange(FRAMES + 1)
    moves = np.array([figure(time)[0] for time in times])
    skirt = {"shape": "skirt", "waist": 0.12, "hem": 0.3, "length": 0.35, "layers": 1, "cells": [72, 20]}
    body = {"vertices": moves[0], "triangles": figure(0.0)[1]}
    cache = {"vertices": moves, "times": times.tolist()}
    return posed(skirt, body, cache, substeps, limit, translation=(0.0, 1.2, 0.0))


def dancing(data: Path, substeps: int, limit: float | None) -> pdipc.Scene:
    """The body and the skirt of the shared data, in SI units."""
    skirt, body = np.load(data / "meshes/cloth/skirt_16k.npz"), np.load(data / "animated/rumba_body_61.npz")
    cache = {"vertices": body["V"].astype(np.float64), "times": (INTERVAL * np.arange(len(body["V"]))).tolist()}
    worn = {"vertices": skirt["V"], "triangles": skirt["F"]}
    body = {"vertices": cache["vertices"][0], "triangles": body["F"]}
    return posed(worn, body, cache, substeps, limit, scale=NARROW, translation=WAIST)


def posed(skirt: dict, body: dict, cache: dict, substeps: int, limit: float | None, **placed) -> pdipc.Scene:
    """A skirt on a body that a cache moves."""
    cloth = {**CLOTH, "strain_limit": limit}
    return pdipc.Scene(
        title="A skirt on a moving body",
        simulation={"time_step": INTERVAL / substeps, "steps": FRAMES * substeps},
        contact={"activation_distance": 2e-3, "friction": 0.4},
        bodies=[{"name": "skirt", "kind": "cloth", "mesh": skirt, "material": cloth, **placed}],
        obstacles=[{"name": "body", "mesh": body, "motion": {"cache": cache}}],
    )


class Witness:
    """Counts the outer iterations after which anything intersects; of pairs of triangles of the body, which may meet, there is no list."""

    def __init__(self, simulation: pdipc.Simulation):
        self.watch = Watch(simulation.triangles, simulation.model.assembly.obstacle)
        self.judged, self.wrong = 0, 0

    def __call__(self, x, x_end) -> None:
        self.judged += 1
        self.wrong += len(self.watch(x_end.numpy().astype(np.float64))) > 0


def stretches(rest: np.ndarray, x: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m,) the largest stretch of each triangle: its deformation's larger singular value, less 1."""

    def edges(points):
        return np.stack([points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2)], axis=2)

    r = np.linalg.qr(edges(rest), mode="r")
    return np.linalg.svd(edges(x) @ np.linalg.inv(r), compute_uv=False)[:, 0] - 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("PDIPC_DATA", "../shared/data")))
    parser.add_argument("--steps", type=int)
    parser.add_argument("--substeps", type=int, default=6, help="Steps in a frame.")
    parser.add_argument("--figure", action="store_true", help="The figure of capsules.")
    parser.add_argument("--limit", type=float, help="The cloth's limit of stretch, such as 0.08.")
    parser.add_argument("--out", type=Path, default=Path("results/dance"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=60.0, help="No further step is begun after so long.")
    options = parser.parse_args()
    made = (
        walking(options.substeps, options.limit) if options.figure else dancing(options.data, options.substeps, options.limit)
    )
    simulation = pdipc.Simulation(made, options.device)
    simulation.observe = witness = Witness(simulation)
    model, steps = simulation.model, options.steps or made.simulation.steps
    skirt = model.assembly.bodies[0]
    topology = {"triangles": model.triangles, **model.assembly.topology()}
    said = {
        "simulation": {"steps": steps},
        "bodies": [{"name": "skirt"}],
        "obstacles": [{"name": "body"}],
    }  # without 100 MB of vertices
    writer = RunWriter.create(options.out, json.dumps(said), topology, {"precision": model.real.name}, overwrite=True)
    began, records = time.monotonic(), []
    with writer:
        writer.append(0, 0.0, simulation.positions, {})
        for step in range(1, steps + 1):
            spent = time.process_time()
            result = simulation.step()
            spent = time.process_time() - spent
            x = simulation.positions
            stretch = stretches(model.assembly.rest_positions, x, skirt.triangles)
            place = skirt.triangles[stretch.argmax()]
            record = {**stats_of(result), "intersecting": witness.wrong, "judged": witness.judged, "cpu_ms": 1e3 * spent}
            record |= {"stretch": float(stretch.max()), "stretch_99.9": float(np.quantile(stretch, 0.999))}
            record |= {
                "stretch_at": x[place].mean(axis=0).tolist(),
                "stretch_at_rest": model.assembly.rest_positions[place].mean(axis=0).tolist(),
            }
            records.append(record)
            writer.append(step, simulation.state.time, x, record)
            print(
                f"{step:4d} outer {result.outer:3d} {'ok' if result.converged else result.message} searches {result.searches} "
                f"gap {1e6 * result.smallest_gap:.3g} um lag {1e3 * result.lag:.2g} mm stretch {100 * stretch.max():.1f} % ({100 * record['stretch_99.9']:.1f}) at {np.round(record['stretch_at'], 2)} "
                f"intersecting {witness.wrong} of {witness.judged}, {sum(result.milliseconds.values()):.0f} ms in the step",
                flush=True,
            )
            if time.monotonic() - began > 60.0 * options.minutes:
                break
    late = [k + 1 for k, record in enumerate(records) if not record["converged"]]
    worst = max(record["stretch"] for record in records)
    times = [sum(record["milliseconds"].values()) for record in records]
    print(
        f"{len(records)} steps, {len(late)} unconverged {late}, {witness.wrong} of {witness.judged} outer iterations intersect"
    )
    print(
        f"largest stretch {100 * worst:.1f} %, ms a step: median {np.median(times):.0f}, mean {np.mean(times):.0f}, worst {max(times):.0f}"
    )


if __name__ == "__main__":
    main()
