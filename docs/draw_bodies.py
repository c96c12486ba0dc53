"""Runs the scenes of garments, closed cloth, rods and rigid bodies and draws their pictures: `python docs/draw_bodies.py [-o FOLDER] [NAME ...]`. Takes minutes."""

import argparse
import tempfile
import time
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import pdipc
from pdipc.pictures.render import Picture, render

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


def chain() -> pdipc.Scene:
    """A chain of steel rings that falls taut between a held ring and a heavy ball."""
    torus = {"shape": "torus", "major_radius": 0.05, "minor_radius": 0.01, "cells": (4, 20)}
    steel = {"density": 7800.0, "shape_stiffness": 1e10}
    bodies = []
    for k in range(6):
        turned = (90, 90 * ((k + 1) % 2), 0)
        body = {"name": f"ring{k}", "kind": "rigid", "mesh": torus, "material": steel, "rotation": turned}
        bodies.append({**body, "translation": (0.065 * (k + 1), 0, 0), "rotation": (90 * (k % 2), 0, 0)})
    swing = {"keyframes": [{"time": 0}, {"time": 0.4, "translation": (0, 0.05, 0)}], "smooth": True}
    held = {"name": "held", "mesh": torus, "motion": swing, "rotation": (90, 0, 0)}
    post = {
        "name": "post",
        "mesh": {"shape": "cylinder", "radius": 0.04, "length": 0.4, "cells": (10, 4)},
        "rotation": (90, 0, 0),
    }
    post["translation"] = (0.1, -0.28, 0)
    simulation = {"time_step": 0.005, "steps": 110, "damping": 0.5}
    return pdipc.Scene(
        bodies=bodies, obstacles=[held, post], simulation=simulation, contact={"friction": 0.2, "activation_distance": 5e-4}
    )


def everything() -> pdipc.Scene:
    """A cloth, a solid, ropes and rigid bodies fall on each other over a ball."""
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.15, "cells": 12}}
    sheet = {
        "name": "sheet",
        "kind": "cloth",
        "mesh": {"shape": "grid", "size": (0.5, 0.5), "cells": (16, 16)},
        "translation": (0, 0.18, 0),
    }
    bodies: list = [{**sheet, "minimum_separation": 1e-3}]
    soft = {"shape": "box", "size": (0.12, 0.08, 0.12), "cells": (4, 3, 4)}
    bodies.append(
        {"name": "soft", "kind": "solid", "mesh": soft, "translation": (0.03, 0.26, 0), "material": {"young_modulus": 5e4}}
    )
    for k, (x, z, turn) in enumerate([(0.0, 0.02, 20.0), (0.02, -0.03, -30.0)]):
        rope = {
            "name": f"rope{k}",
            "kind": "rod",
            "mesh": {"shape": "rope", "length": 0.5, "segments": 40},
            "rotation": (0, turn, 0),
        }
        material = {"radius": 6e-3, "stretch_stiffness": 2e3, "bending_stiffness": 1e-4, "twist_stiffness": 1e-4}
        bodies.append({**rope, "translation": (x, 0.32 + 0.02 * k, z), "material": material})
    steel = {"density": 3000.0}
    cube = {"shape": "box", "size": (0.06, 0.06, 0.06), "cells": (1, 1, 1)}
    bodies.append(
        {
            "name": "cube",
            "kind": "rigid",
            "mesh": cube,
            "translation": (0.0, 0.42, 0.0),
            "rotation": (30, 0, 40),
            "material": steel,
        }
    )
    ring = {"shape": "torus", "major_radius": 0.05, "minor_radius": 0.015, "cells": (6, 24)}
    bodies.append({"name": "ring", "kind": "rigid", "mesh": ring, "translation": (-0.05, 0.5, 0.03), "material": steel})
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 4.0}, "translation": (0, -0.15, 0)}
    simulation = {"time_step": 0.01, "steps": 50}
    return pdipc.Scene(bodies=bodies, obstacles=[ball, floor], simulation=simulation, contact={"friction": 0.4})


def sleeve() -> pdipc.Scene:
    """Two panels that are sewn around an arm, which then moves."""
    cloth = {"areal_density": 0.2, "membrane_stiffness": 300.0, "bending_stiffness": 2e-5}
    mesh = {"shape": "grid", "size": (0.35, 0.21), "cells": (20, 12)}
    bodies = [
        {"name": name, "kind": "cloth", "mesh": mesh, "translation": (0, height, 0), "material": cloth}
        for name, height in (("front", 0.07), ("back", -0.07))
    ]
    seams = [
        {"bodies": ("front", "back"), "within": 0.2, "select": {"box": [[-1, -1, low], [1, 1, high]]}, "duration": 0.3}
        for low, high in ((0.1, 0.2), (-0.2, -0.1))
    ]
    bent = {"keyframes": [{"time": 0.4}, {"time": 1.4, "rotation": (0, 0, 30)}], "center": (-0.3, 0, 0)}
    arm = {"name": "arm", "mesh": {"shape": "capsule", "radius": 0.05, "length": 0.5, "cells": (8, 10)}}
    arm |= {"rotation": (0, 0, 90), "motion": bent, "look": {"color": "#d8c4b2"}}
    contact = {"activation_distance": 1e-3, "friction": 0.6}
    return pdipc.Scene(bodies=bodies, obstacles=[arm], stitches=seams, contact=contact, simulation={"steps": 150})


def pillows() -> pdipc.Scene:
    """Three flat boxes of cloth that a gas fills, on a floor."""
    pillow = {
        "name": "pillow",
        "kind": "cloth",
        "mesh": {"shape": "box", "size": (0.4, 0.02, 0.4), "cells": (12, 1, 12)},
        "translation": (0, 0.05, 0),
        "material": {"areal_density": 0.3, "membrane_stiffness": 400.0, "bending_stiffness": 1e-4},
        "inside": {"gas": 101325.0, "volume": 0.011, "rise": 0.3},
        "copies": {"counts": (1, 3, 1), "spacing": (0, 0.12, 0)},
    }
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 2.0}}
    contact = {"activation_distance": 3e-3, "friction": 0.5}
    return pdipc.Scene(bodies=[pillow], obstacles=[floor], contact=contact, simulation={"steps": 100})


def tunic() -> pdipc.Scene:
    """Two flat panels of woven cloth that are sewn at the shoulders and the sides around a body, which then turns."""
    wide, tall, neck, armhole = 0.40, 0.44, 0.09, 0.13
    woven = {"areal_density": 0.2, "membrane_stiffness": 1000.0, "weft_stiffness": 400.0, "shear_stiffness": 60.0}
    woven |= {"bending_stiffness": 6e-5, "weft_bending_stiffness": 1.5e-5, "warp": (0, 1, 0)}
    mesh = {"shape": "grid", "size": (wide, tall), "cells": (18, 20)}
    bodies = [
        {"name": name, "kind": "cloth", "mesh": mesh, "rotation": (90, 0, 0), "translation": (0, 0.0, z), "material": woven}
        for name, z in (("front", 0.14), ("back", -0.14))
    ]
    for body, color in zip(bodies, ("#c8508a", "#8a50c8"), strict=True):
        body["look"] = {"color": color}
        body["pins"] = [
            {"select": {"box": [[-1, 0.5 * tall - 0.01, -1], [1, 1, 1]]}, "axes": "y", "stiffness": 50.0, "end": 0.45}
        ]
    x, y = 0.5 * wide, 0.5 * tall
    places = [[[-x - 0.01, -1, -1], [-x + 0.01, y - armhole, 1]], [[x - 0.01, -1, -1], [x + 0.01, y - armhole, 1]]]
    places += [[[-1, y - 0.01, -1], [-neck, y + 0.01, 1]], [[neck, y - 0.01, -1], [1, y + 0.01, 1]]]
    seams = [{"bodies": ("front", "back"), "within": 0.3, "select": {"box": place}, "duration": 0.4} for place in places]
    turn = {"keyframes": [{"time": 0.5}, {"time": 1.2, "rotation": (0, 60, 0)}], "smooth": True, "center": (0, 0, 0)}
    skin = {"motion": turn, "look": {"color": "#d8c4b2"}}
    trunk = {"shape": "capsule", "radius": 0.1, "length": 0.4, "cells": (10, 10)}
    shoulders = {"shape": "capsule", "radius": 0.045, "length": 0.3, "cells": (8, 10)}
    obstacles = [
        {"name": "trunk", "mesh": trunk, "translation": (0, -0.06, 0), **skin},
        {"name": "shoulders", "mesh": shoulders, "rotation": (0, 0, 90), "translation": (0, 0.12, 0), **skin},
        {"name": "neck", "mesh": {"shape": "capsule", "radius": 0.04, "length": 0.2}, "translation": (0, 0.24, 0), **skin},
    ]
    contact = {"activation_distance": 2e-3, "friction": 0.3}
    return pdipc.Scene(bodies=bodies, obstacles=obstacles, stitches=seams, contact=contact, simulation={"steps": 130})


def strips() -> pdipc.Scene:
    """Three strips of one cloth, cut along its warp, at 45 degrees and along its weft, hang over an edge."""
    cloth = {"areal_density": 0.2, "membrane_stiffness": 300.0, "bending_stiffness": 1.2e-4, "weft_bending_stiffness": 1.5e-5}
    mesh = {"shape": "grid", "size": (0.11, 0.02), "cells": (28, 5)}
    bodies = []
    for k, (name, warp) in enumerate((("warp", (1, 0, 0)), ("bias", (1, 0, 1)), ("weft", (0, 0, 1)))):
        strip = {"name": name, "kind": "cloth", "mesh": mesh, "translation": (0, 0, 0.04 * (k - 1))}
        held = [{"select": {"box": [[-1, -1, -1], [-0.0175, 1, 1]]}}]
        strip |= {"material": {**cloth, "warp": warp}, "pins": held, "look": {"color": ("#b04030", "#c89030", "#3060b0")[k]}}
        bodies.append(strip)
    table = {"name": "table", "mesh": {"shape": "box", "size": (0.06, 0.08, 0.16), "cells": (1, 1, 1)}}
    table |= {"translation": (-0.05, -0.0405, 0), "look": {"color": "#b0b0b0"}}
    simulation = {"time_step": 0.02, "steps": 100, "damping": 2.0}
    return pdipc.Scene(bodies=bodies, obstacles=[table], simulation=simulation, contact={"activation_distance": 4e-4})


# Which frames, from which side.
PICTURES = {
    "knot": (knot, (0, 70, 110), (0.1, 0.3, 1.0)),
    "rope_ladder": (ladder, (0, 80, 130), (0.9, 0.25, 0.8)),
    "chain": (chain, (0, 45, 110), (0.3, 0.2, 1.0)),
    "all_kinds": (everything, (0, 25, 50), (0.7, 0.4, 1.0)),
    "sleeve": (sleeve, (0, 40, 150), (0.4, 0.3, 1.0)),
    "pillows": (pillows, (0, 30, 90), (0.5, 0.35, 1.0)),
    "tunic": (tunic, (0, 50, 130), (0.4, 0.3, 1.0)),
    "strips": (strips, (100,), (0.6, 0.1, 1.0)),
}


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
        figure, axes = plt.subplots(1, len(frames), figsize=(6.4 * len(frames), 4.8), layout="constrained", squeeze=False)
        with tempfile.TemporaryDirectory() as folder:
            spent = time.process_time()
            pdipc.run_scene(made(), f"{folder}/run", device="cpu")
            spent = time.process_time() - spent
            run = pdipc.open_run(f"{folder}/run")
            for frame, axis in zip(frames, axes[0], strict=True):
                render(run, frame, f"{folder}/{frame}.png", Picture(size=(960, 720), view=view, obstacles="solid"))
                axis.imshow(_cropped(plt.imread(f"{folder}/{frame}.png")))
                axis.set(xticks=[], yticks=[], frame_on=False)
            met = sum(
                len(pdipc.find_intersections(run.positions(k), run.triangles, run.obstacle)) for k in range(run.frame_count)
            )
            loose = sum(not record["converged"] for record in run.stats)
            steps = len(run.stats)
            wall = sum(sum(record["milliseconds"].values()) for record in run.stats) / steps
            outer = sum(record["outer"] for record in run.stats) / steps
            print(
                f"{name}: {steps} steps, {met} intersections, {loose} unconverged steps, {outer:.1f} outer iterations, {wall:.0f} ms "
                f"and {1e3 * spent / steps:.0f} ms of CPU a step",
                flush=True,
            )
        figure.savefig(options.output / f"{name}.png", dpi=60)


if __name__ == "__main__":
    main()
