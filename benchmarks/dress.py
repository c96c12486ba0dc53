"""A dress as a program wrote it: `python benchmarks/dress.py [--data FOLDER] [--tiers N] [--steps N] [--time-step H] [--out FOLDER]`.

The optional test data has a bodice and four tiers of a skirt, two panels each, 58,687 triangles, whose seams lie on each other: 746 pairs of triangles
intersect. It is loaded as an artist would: each layer is a cloth of its own, whose side seams are welded; layers are 1.5 % wider one by one from the inside
out, so that they lie on each other at the waist, and threads sew them to the bodice in 0.1 s. The body is drawn in by 1.5 mm, since the dress touches it, stands while
it is sewn, and then dances. The exact witness judges the state after every step. Writes a line a step, and the frames for `pdipc render`.
"""

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np

import pdipc
from pdipc.judge.witness import Watch
from pdipc.output.results import RunWriter
from pdipc.reproduce._scenes import inset
from pdipc.scene import sewing
from pdipc.simulation import stats_of

LAYERS = {
    "bodice": (0, 2),
    "tier1": (8, 9),
    "tier2": (6, 7),
    "tier3": (4, 5),
    "tier4": (1, 3),
}  # the panels of each, outermost tier first
COLORS = ("#8a3ba0", "#c8508a", "#d8709a", "#e890aa", "#f0b0c0")
AXIS = np.array([0.0, 0.0, -0.03])  # m, a point of the body's, about which layers are widened
WIDER = 0.015  # from layer to layer
CLOTH = {
    "areal_density": 0.128,
    "membrane_stiffness": 2000.0,
    "bending_stiffness": 5.2e-5,
    "weft_bending_stiffness": 2.6e-5,
    "warp": (0, 1, 0),
}
SEWN, INTERVAL = 0.1, 0.04  # s: how long sewing takes, and between frames of the body


def dress(data: Path, tiers: int, step: float, steps: int) -> pdipc.Scene:
    """The bodice and the `tiers` outermost tiers on the body."""
    raw, still = (np.load(data / "meshes/cloth" / f"{name}.npz") for name in ("tiered_skirt_59k_raw", "mannequin_25k"))
    used, part = sewing.parts(raw["F"])
    panel = np.full(len(raw["V"]), -1)
    panel[used] = part
    bodies, stitches = [], []
    for k, (name, panels) in enumerate(list(LAYERS.items())[: tiers + 1]):
        corners, triangles = np.unique(raw["F"][np.isin(panel[raw["F"][:, 0]], panels)], return_inverse=True)
        mesh = {"vertices": raw["V"][corners], "triangles": triangles.reshape(-1, 3)}
        wide = 1.0 + WIDER * (len(LAYERS) - k if k else 0)
        placed = {"scale": (wide, 1.0, wide), "translation": tuple(AXIS * (1.0 - np.array([wide, 1.0, wide])))}
        bodies.append(
            {
                "name": name,
                "kind": "cloth",
                "mesh": mesh,
                "material": CLOTH,
                "weld": 1e-3,
                "look": {"color": COLORS[k]},
                **placed,
            }
        )
        if k:
            waist = {"box": [[-1, 0.095, -1], [1, 0.2, 1]]}
            stitches.append({"bodies": (name, "bodice"), "within": 0.025, "select": waist, "duration": SEWN})
    moves = np.load(data / "animated/rumba_body_61.npz")["V"].astype(np.float64)
    moves += (still["V"] - moves[0]).mean(axis=0)
    moves = np.stack([inset(frame, still["F"], 1.5e-3) for frame in moves])
    times = [0.0, *(SEWN + 0.04 + INTERVAL * np.arange(len(moves))).tolist()]
    cache = {"vertices": np.concatenate([moves[:1], moves]), "times": times}
    body = {"name": "body", "mesh": {"vertices": moves[0], "triangles": still["F"]}, "motion": {"cache": cache}}
    return pdipc.Scene(
        title="A dress as a program wrote it",
        simulation={"time_step": step, "steps": steps},
        contact={"activation_distance": 1e-3, "friction": 0.4},
        bodies=bodies,
        obstacles=[{**body, "look": {"color": "#d8c4b2"}}],
        stitches=stitches,
    )


def seams(assembly, x: np.ndarray) -> np.ndarray:
    """(k,) m: how far apart the ends of all threads are."""
    ends = [(x[s.elements], s.weights) for s in assembly.stitches]
    return np.concatenate([np.linalg.norm(np.einsum("ek,ekd->ed", w, c[:, 1:]) - c[:, 0], axis=1) for c, w in ends])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("PDIPC_DATA", "../shared/data")))
    parser.add_argument("--tiers", type=int, default=4, choices=(1, 2, 3, 4), help="From the outermost on.")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--time-step", type=float, default=0.01, help="s")
    parser.add_argument("--out", type=Path, default=Path("results/dress"))
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    made = dress(options.data, options.tiers, options.time_step, options.steps)
    simulation = pdipc.Simulation(made, options.device)
    assembly = simulation.model.assembly
    watch = Watch(simulation.triangles, assembly.obstacle)
    print(f"{len(simulation.triangles)} triangles, {len(watch(simulation.positions))} pairs intersect at the start", flush=True)
    named = [{"name": body.name, "look": {"color": body.look.color}} for body in (*made.bodies, *made.obstacles)]
    said = {"simulation": {"steps": options.steps}, "bodies": named[:-1], "obstacles": named[-1:]}  # without 100 MB of vertices
    topology = {"triangles": simulation.triangles, **assembly.topology()}
    writer = RunWriter.create(
        options.out, json.dumps(said), topology, {"precision": simulation.model.real.name}, overwrite=True
    )
    with writer:
        writer.append(0, 0.0, simulation.positions, {})
        for step in range(1, options.steps + 1):
            spent = time.process_time()
            result = simulation.step()
            spent = time.process_time() - spent
            x = simulation.positions
            wrong, open_ = len(watch(x)), 1e3 * seams(assembly, x)
            writer.append(step, simulation.state.time, x, {**stats_of(result), "cpu_ms": 1e3 * spent, "intersecting": wrong})
            print(
                f"{step:4d} outer {result.outer:3d} {'ok' if result.converged else result.message} gap {1e6 * result.smallest_gap:.3g} um lag "
                f"{1e3 * result.lag:.2g} mm intersecting {wrong}, seams {np.median(open_):.2f} mm apart, most {open_.max():.2f}, {spent:.1f} s of CPU",
                flush=True,
            )


if __name__ == "__main__":
    main()
