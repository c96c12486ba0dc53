"""Random scenes of garments, closed cloth, rods, rigid bodies and solids that meet: `draw(seed)`. y is up, SI units."""

import kind_ties
import numpy as np
from kind_parts import KINDS, Parts, bent, between, cord, floor, sewn, thing, woven
from numpy.random import Generator

import pdipc

STEPS = {"mixed": 40, "garment": 45, "knot": 60, "chain": 60, "ladder": 50, "stack": 45, "hammock": 50, "skirt": 50}


def mixed(rng: Generator, size: float) -> Parts:
    """Three to five bodies of any kinds fall onto a ball, one after the other, each fast enough to reach the one below."""
    bodies = []
    for k, kind in enumerate(rng.choice(KINDS, rng.integers(3, 6))):
        aside = rng.uniform(-0.05, 0.05, 2) * size
        body = thing(rng, f"body{k}_{kind}", str(kind), size, (aside[0], (0.55 + 1.05 * k) * size, aside[1]))
        body["velocity"][1] = -1.2 * float(np.sqrt(2.0 * 9.81 * (0.9 * k + 0.1) * size)) - 0.3 * k
        bodies.append(body)
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.3 * size, "cells": 10}}
    return {"bodies": bodies, "obstacles": [ball, floor(size, -0.3 * size)]}


def garment(rng: Generator, size: float) -> Parts:
    """A sleeve of two woven panels of different meshes is sewn on an arm, which then moves."""
    length, radius, closing = 0.9 * size, 0.11 * size, float(rng.uniform(0.1, 0.3))
    width, off = float(rng.uniform(1.35, 1.7)) * np.pi * radius * 0.85, radius + float(rng.uniform(0.02, 0.07)) * size
    cells = np.array([rng.integers(8, 15), rng.integers(5, 9)])

    def panel(name: str, height: float, more: int) -> dict:
        mesh = {"shape": "grid", "size": [0.6 * length, width], "cells": [int(cells[0]) + more, int(cells[1])]}
        return {"name": name, "kind": "cloth", "mesh": mesh, "translation": [0.0, height, 0.0], "material": sewn(rng, size)}

    def seam(low: float, high: float) -> dict:
        box = [[-9.0 * size, -9.0 * size, low], [9.0 * size, 9.0 * size, high]]
        return {"bodies": ["front", "back"], "within": 4.0 * radius, "select": {"box": box}, "duration": closing}

    turned = [float(rng.uniform(-20, 20)), float(rng.uniform(-30, 30)), float(rng.uniform(20, 60))]
    motion = {"keyframes": [{"time": 1.3 * closing}, {"time": 1.3 * closing + 0.5, "rotation": turned}]}
    arm = {"name": "arm", "mesh": {"shape": "capsule", "radius": radius, "length": 1.1 * length, "cells": [8, 12]}}
    arm |= {"rotation": [0.0, 0.0, 90.0], "motion": {**motion, "center": [-0.6 * length, 0.0, 0.0]}}
    panels = [panel("front", off, 0), panel("back", -off, int(rng.integers(0, 4)))]
    seams = [seam(0.49 * width, 0.51 * width), seam(-0.51 * width, -0.49 * width)]
    return {"bodies": panels, "obstacles": [arm], "stitches": seams}


def knot(rng: Generator, size: float) -> Parts:
    """A knot is drawn tight by its ends."""
    segments, speed = int(rng.integers(70, 120)), 0.25 * size
    thin = {"radius": size * float(rng.uniform(0.004, 0.008)), "young_modulus": between(rng, 1e6, 1e8)}
    material = bent(rng, {**thin, "density": between(rng, 300.0, 8000.0)}, 0.003, 0.3, (0.0, 1.0))
    ends = [
        {"select": {"vertices": [0, 1]}, "motion": {"velocity": [-speed, 0.0, 0.0]}},
        {"select": {"vertices": [segments - 1, segments]}, "motion": {"velocity": [speed, 0.0, 0.0]}},
    ]
    rope = {"name": "rope", "kind": "rod", "mesh": {"shape": "knot", "length": size, "segments": segments}, "pins": ends}
    return {"bodies": [{**rope, "material": material, "friction": float(rng.choice([0.0, 0.2, 0.5]))}]}


def chain(rng: Generator, size: float) -> Parts:
    """Rigid rings hang in each other, the first held, and swing against a post."""
    radius = 0.12 * size
    minor = radius * float(rng.uniform(0.14, 0.24))
    mesh = {"shape": "torus", "major_radius": radius, "minor_radius": minor, "cells": [4, 18]}
    apart = 2.0 * radius - 2.25 * minor
    rings = []
    for k in range(rng.integers(3, 7)):
        ring = {"name": f"ring{k}", "kind": "rigid", "mesh": mesh, "material": {"density": between(rng, 500.0, 8000.0)}}
        rings.append({**ring, "rotation": [90.0 * (k % 2), 0.0, 0.0], "translation": [apart * (k + 1), 0.0, 0.0]})
    held = {"name": "held", "mesh": mesh, "rotation": [90.0, 0.0, 0.0]}
    post = {"name": "post", "mesh": {"shape": "cylinder", "radius": 0.1 * size, "length": size, "cells": [8, 4]}}
    post |= {"rotation": [90.0, 0.0, 0.0], "translation": [0.25 * size, -0.6 * size, 0.0]}
    return {"bodies": rings, "obstacles": [held, post], "contact": {"activation_distance": 1.5e-3 * size}}


def ladder(rng: Generator, size: float) -> Parts:
    """A rope ladder of rods, and what is thrown at it."""
    segments, rungs, width, radius = int(rng.integers(20, 36)), int(rng.integers(3, 6)), 0.28 * size, 0.008 * size
    soft = {"radius": radius, "stretch_stiffness": between(rng, 300.0, 5e3) * size, "twist_stiffness": 0.0, "density": 800.0}
    soft |= {"bending_stiffness": between(rng, 1e-5, 1e-3) * size**3}
    wood = {"radius": 1.4 * radius, "young_modulus": between(rng, 1e7, 5e9), "density": 600.0}
    bodies, ties = [], []
    for name, x in (("left", -0.5 * width), ("right", 0.5 * width)):
        rope = {"name": name, "kind": "rod", "mesh": {"shape": "rope", "length": size, "segments": segments}, "material": soft}
        top = [{"select": {"nearest": [x, 0.5 * size, 0.0]}}]
        bodies.append({**rope, "rotation": [0.0, 0.0, 90.0], "translation": [x, 0.0, 0.0], "pins": top})
    for k in range(rungs):
        height = 0.5 * size - size / segments * (3 + (segments - 4) * k // rungs)
        rung = {"name": f"rung{k}", "kind": "rod", "mesh": {"shape": "rope", "length": 1.3 * width, "segments": 10}}
        bodies.append({**rung, "translation": [0.0, height, 2.55 * radius], "material": wood})
        ties += [{"bodies": (f"rung{k}", side), "within": 4.0 * radius, "stiffness": 2e3} for side in ("left", "right")]
    thrown = thing(
        rng, "thrown", str(rng.choice(("rigid", "pillow", "solid"))), 0.6 * size, (0.05 * size, -0.1 * size, -0.45 * size)
    )
    thrown["velocity"] = [0.0, float(np.sqrt(size)), 4.0 * float(np.sqrt(size))]
    return {"bodies": [*bodies, thrown], "attachments": ties}


def stack(rng: Generator, size: float) -> Parts:
    """Pillows on each other, and something rigid that falls on top."""
    count = int(rng.integers(2, 4))
    below = thing(rng, "pillow", "pillow", size, (0.0, 0.12 * size, 0.0)) | {"rotation": [0.0] * 3, "velocity": [0.0] * 3}
    below["copies"] = {"counts": [1, count, 1], "spacing": [0.0, 0.25 * size, 0.0]}
    top = thing(rng, "top", "rigid", 0.7 * size, (0.0, (0.27 + 0.25 * count) * size, 0.0))
    return {"bodies": [below, top], "obstacles": [floor(size)]}


def hammock(rng: Generator, size: float) -> Parts:
    """A sheet hangs by its corners on rods, and two things fall into it."""
    fabric = woven(rng, size)
    fabric["membrane_stiffness"] = max(200.0, fabric["membrane_stiffness"])
    mesh = {"shape": "grid", "size": [0.8 * size] * 2, "cells": [10, 10]}
    bodies, ties = [{"name": "sheet", "kind": "cloth", "mesh": mesh, "material": fabric}], []
    for k, (x, z) in enumerate(0.4 * size * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])):
        material = {**cord(rng, 0.5 * size), "radius": 0.008 * size, "young_modulus": between(rng, 1e7, 1e9)}
        rope = {"name": f"rope{k}", "kind": "rod", "mesh": {"shape": "rope", "length": 0.5 * size, "segments": 10}}
        rope |= {"rotation": [0.0, 0.0, 90.0], "translation": [x, 0.27 * size, z], "material": material}
        bodies.append({**rope, "pins": [{"select": {"nearest": [x, 0.52 * size, z]}}]})
        ties.append({"bodies": (f"rope{k}", "sheet"), "within": 0.03 * size, "stiffness": between(rng, 200.0, 5e3)})
    for k, kind in enumerate(rng.choice(("rigid", "rod", "pillow", "solid"), 2)):
        fallen = thing(rng, f"fallen{k}_{kind}", str(kind), 0.6 * size, (0.0, (0.45 + 0.75 * k) * size, 0.0))
        bodies.append(fallen | {"velocity": [0.0, -1.5 * (1 + k) * float(np.sqrt(size)), 0.0]})
    return {"bodies": bodies, "attachments": ties}


def skirt(rng: Generator, size: float) -> Parts:
    """A skirt whose rest shape is a flat fan, its seam welded, on hips that turn; something flies into it."""
    rows, columns, waist = 6, int(rng.integers(16, 28)), 0.2 * size
    hem, height = waist * float(rng.uniform(1.2, 2.2)), 0.5 * size
    part, angle = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 2.0 * np.pi, columns + 1), indexing="ij")
    radius = waist + 0.6 * (hem - waist) * part
    worn = np.stack([radius * np.cos(angle), 0.4 * size - 0.9 * height * part, radius * np.sin(angle)], -1).reshape(-1, 3)
    slant = np.hypot(height, hem - waist)
    inner = waist / (hem - waist) * slant  # of the fan
    turn, ray = angle * waist / inner, inner + slant * part
    flat = np.stack([ray * np.cos(turn), ray * np.sin(turn), np.zeros_like(ray)], -1).reshape(-1, 3)
    i, j = (each.ravel() for each in np.indices((rows - 1, columns)))
    a = i * (columns + 1) + j
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    odd = (i + j) % 2 == 1
    triangles = np.concatenate([np.where(odd, [a, b, c], [a, b, d]).T, np.where(odd, [b, d, c], [a, d, c]).T])
    material = sewn(rng, size)
    if "warp" in material:
        material["warp"] = [1.0, 0.3, 0.0]
    cloth = {"name": "skirt", "kind": "cloth", "mesh": {"vertices": worn, "triangles": triangles}, "weld": 0.02 * size}
    cloth |= {"rest": {"mesh": {"vertices": flat, "triangles": triangles}}, "material": material}
    turned = {"time": 0.5, "translation": [0.15 * size, 0.0, 0.05 * size], "rotation": [0.0, 90.0, 20.0]}
    hips = {"name": "hips", "mesh": {"shape": "capsule", "radius": 0.17 * size, "length": 0.3 * size, "cells": [8, 8]}}
    hips |= {"translation": [0.0, 0.45 * size, 0.0], "motion": {"keyframes": [{"time": 0.05}, turned]}}
    hit = thing(rng, "hit", str(rng.choice(("rod", "rigid", "solid"))), 0.5 * size, (0.75 * size, 0.2 * size, 0.0))
    hit["velocity"] = [-4.0 * float(np.sqrt(size)), 0.5, 0.0]
    return {"bodies": [{**cloth, "translation": [0.0, 0.1 * size, 0.0]}, hit], "obstacles": [hips, floor(size, -0.5 * size)]}


FAMILIES = (mixed, garment, knot, chain, ladder, stack, hammock, skirt), kind_ties.FAMILIES
IN_TURN = 64  # seeds of the first families, then as many of the others, and so on


def draw(seed: int) -> tuple[str, pdipc.Scene]:
    """A family's name and a scene of it, 5 cm to 2 m large, in float32 or float64. Raises pdipc.SceneError where it cannot be."""
    families = FAMILIES[seed // IN_TURN % len(FAMILIES)]
    rng, family = np.random.default_rng(seed), families[seed % len(families)]
    size = between(rng, 0.05, 2.0)
    parts = family(rng, size)
    contact = {"activation_distance": 3e-3 * size, "friction": float(rng.choice([0.0, 0.1, 0.3, 0.6]))}
    parts["contact"] = contact | parts.get("contact", {})
    step = 0.005 if family is chain else float(rng.choice([0.005, 0.01]))
    simulation = {
        "time_step": step,
        "steps": STEPS.get(family.__name__, 50),
        "precision": str(rng.choice(["float64", "float32"])),
    }
    return family.__name__, pdipc.Scene(simulation=simulation, **parts)
