"""Runs the scenes with rods and draws their pictures: `python docs/draw_rods.py [-o FOLDER]`. Takes a minute."""

import argparse
import tempfile
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import pdipc
from pdipc.output.render import render

matplotlib.use("Agg")


def knot() -> pdipc.Scene:
    """An overhand knot that is pulled tight."""
    n = 140
    ends = [
        {"select": {"vertices": [0, 1]}, "motion": {"keyframes": [{"time": 0}, {"time": 1.0, "translation": (-0.22, 0, 0)}]}},
        {
            "select": {"vertices": [n - 1, n]},
            "motion": {"keyframes": [{"time": 0}, {"time": 1.0, "translation": (0.22, 0, 0)}]},
        },
    ]
    material = {"radius": 6e-3, "young_modulus": 1e7, "bending_stiffness": 1e-4, "twist_stiffness": 1e-4}
    rope = {"name": "rope", "kind": "rod", "mesh": {"shape": "knot", "segments": n}, "material": material, "pins": ends}
    simulation = {"time_step": 0.01, "steps": 110, "damping": 5.0, "gravity": (0, -2, 0)}
    return pdipc.Scene(bodies=[rope], simulation=simulation, contact={"friction": 0.2})


def ladder() -> pdipc.Scene:
    """A rope ladder, two ropes and rungs that are tied to them, and a ball that pushes it aside."""
    segments, rungs = 60, 6
    soft = {"radius": 5e-3, "stretch_stiffness": 2e3, "bending_stiffness": 2e-4, "twist_stiffness": 0.0, "density": 800.0}
    wood = {"radius": 8e-3, "young_modulus": 1e9, "density": 600.0}
    bodies, attachments = [], []
    for name, x in (("left", -0.13), ("right", 0.13)):
        pins = [{"select": {"nearest": (x, 0.45, 0.0)}}]
        mesh = {"shape": "rope", "length": 0.9, "segments": segments}
        body = {"name": name, "kind": "rod", "mesh": mesh, "rotation": (0, 0, 90), "translation": (x, 0, 0), "pins": pins}
        bodies.append({**body, "material": soft})
    for k in range(rungs):
        name, y = f"rung{k}", 0.45 - 0.9 / segments * (6 + 9 * k)
        mesh = {"shape": "rope", "length": 0.33, "segments": 11}
        bodies.append({"name": name, "kind": "rod", "mesh": mesh, "translation": (0.0, y, 0.0141), "material": wood})
        for rope in ("left", "right"):
            attachments.append({"bodies": (name, rope), "within": 0.026, "stiffness": 2e3})
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.18, "cells": 12}, "translation": (0.02, -0.45, -0.22)}
    push = {"keyframes": [{"time": 0}, {"time": 1.0, "translation": (0, 0.15, 0.28)}], "smooth": True}
    simulation = {"time_step": 0.01, "steps": 130, "damping": 1.0}
    return pdipc.Scene(
        bodies=bodies,
        obstacles=[{**ball, "motion": push}],
        attachments=attachments,
        simulation=simulation,
        contact={"friction": 0.3},
    )


# Which frames, from which side.
PICTURES = {"knot": (knot, (0, 70, 110), (0.1, 0.3, 1.0)), "rope_ladder": (ladder, (0, 80, 130), (0.9, 0.25, 0.8))}


def _cropped(image: np.ndarray) -> np.ndarray:
    """The part that is not background, and a margin."""
    rows, columns = (np.flatnonzero((np.abs(image - image[0, 0]) > 0.05).any(axis=(2, other))) for other in (1, 0))
    return image[max(0, rows[0] - 20) : rows[-1] + 20, max(0, columns[0] - 20) : columns[-1] + 20]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent)
    parser.add_argument("names", nargs="*", default=list(PICTURES))
    options = parser.parse_args()
    for name in options.names:
        made, frames, view = PICTURES[name]
        figure, axes = plt.subplots(1, len(frames), figsize=(6.4 * len(frames), 4.8), layout="constrained")
        with tempfile.TemporaryDirectory() as folder:
            pdipc.run_scene(made(), f"{folder}/run", device="cpu", certify=True)
            run = pdipc.open_run(f"{folder}/run")
            for frame, axis in zip(frames, axes, strict=True):
                render(run, frame, f"{folder}/{frame}.png", size=(960, 720), view=view)
                axis.imshow(_cropped(plt.imread(f"{folder}/{frame}.png")))
                axis.set(xticks=[], yticks=[], frame_on=False)
            met = sum(
                len(pdipc.find_intersections(run.positions(k), run.triangles, run.obstacle)) for k in range(run.frame_count)
            )
            loose = sum(not record["converged"] for record in run.stats)
            time = sum(sum(record["milliseconds"].values()) for record in run.stats) / len(run.stats)
            print(f"{name}: {met} intersections, {loose} unconverged steps, {time:.0f} ms a step")
        figure.savefig(options.output / f"{name}.png", dpi=60)


if __name__ == "__main__":
    main()
