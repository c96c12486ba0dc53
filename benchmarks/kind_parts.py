"""Random materials and bodies of every kind, for `kind_scenes`. y is up, SI units."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.random import Generator

KINDS = ("cloth", "pillow", "rod", "rigid", "solid")
Parts = dict[str, Any]  # of a scene


def between(rng: Generator, low: float, high: float) -> float:
    """Of all magnitudes alike."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# --- materials ---


def woven(rng: Generator, size: float) -> dict:
    """Cloth that may be stiffer along its warp than along its weft, and that may have a strain limit."""
    stretch, bend = between(rng, 20.0, 2e4), between(rng, 1e-6, 1e-3) * size
    material = {"areal_density": between(rng, 0.05, 1.0), "membrane_stiffness": stretch, "bending_stiffness": bend}
    if rng.random() < 0.6:
        material["weft_bending_stiffness"] = bend * between(rng, 0.05, 20.0)
    if rng.random() < 0.4:
        material["weft_stiffness"] = stretch * between(rng, 0.1, 10.0)
    if rng.random() < 0.3:
        material["strain_limit"] = float(rng.uniform(0.03, 0.3))
    if {"weft_bending_stiffness", "weft_stiffness"} & material.keys():
        material["warp"] = [1.0, 0.3, float(rng.uniform(-1.0, 1.0))]
    return material


def sewn(rng: Generator, size: float) -> dict:
    """Woven cloth that holds its shape while seams pull at it."""
    material = woven(rng, size)
    material["membrane_stiffness"] = max(100.0, material["membrane_stiffness"])
    material.pop("strain_limit", None)
    return material


def cord(rng: Generator, size: float) -> dict:
    material = {"radius": size * between(rng, 0.005, 0.03), "young_modulus": between(rng, 1e5, 1e9)}
    return {**material, "density": between(rng, 300.0, 8000.0)}


def bent(rng: Generator, material: dict, least: float, most: float, twists: tuple[float, ...]) -> dict:
    """The rod with a part of the bending stiffness of a solid one; twists: parts of it, one of which resists twisting."""
    bend = material["young_modulus"] * np.pi * material["radius"] ** 4 / 4.0 * between(rng, least, most)
    return {**material, "bending_stiffness": bend, "twist_stiffness": bend * float(rng.choice(twists))}


# --- bodies ---


def thing(rng: Generator, name: str, kind: str, size: float, at: tuple[float, float, float]) -> dict:
    """A body of that kind that flies slowly, turned anyhow."""
    body = {"name": name, "kind": "cloth" if kind == "pillow" else kind, "translation": [float(each) for each in at]}
    body |= {"rotation": rng.uniform(-180.0, 180.0, 3).tolist(), "velocity": (rng.normal(0.0, 1.0, 3) * np.sqrt(size)).tolist()}
    return {**body, "friction": float(rng.choice([0.0, 0.1, 0.3, 0.6, 1.0])), **OF_KIND[kind](rng, size)}


def sheet(rng: Generator, size: float) -> dict:
    cells = int(rng.integers(6, 13))
    return {"mesh": {"shape": "grid", "size": [0.8 * size] * 2, "cells": [cells] * 2}, "material": woven(rng, size)}


def pillow(rng: Generator, size: float) -> dict:
    """Closed cloth with a pressure, a gas or a liquid inside."""
    sides = 0.5 * size, 0.06 * size, 0.4 * size
    gas = {"gas": 101325.0, "volume": float(np.prod(sides)) * between(rng, 1.0, 3.0), "rise": 0.1}
    liquid = {
        "bulk_modulus": between(rng, 1e4, 1e6),
        "volume": float(np.prod(sides)) * between(rng, 0.9, 1.5),
        "rise": 0.05,
    }
    pressure = between(rng, 5.0, 500.0) * size
    which = rng.integers(3)
    plain = ("areal_density", "membrane_stiffness", "bending_stiffness")
    material = {key: value for key, value in woven(rng, size).items() if key in plain}
    inside = [{"pressure": min(pressure, material["membrane_stiffness"] / size)}, gas, liquid][which]  # more would burst it
    return {"mesh": {"shape": "box", "size": list(sides), "cells": [6, 1, 6]}, "material": material, "inside": inside}


def rod(rng: Generator, size: float) -> dict:
    """A rope, a ring, or a coil, which is not stiffer than its own material."""
    segments, material = int(rng.integers(12, 40)), cord(rng, size)
    rope = {"shape": "rope", "length": size * between(rng, 0.4, 1.2), "segments": segments}
    ring = {"shape": "ring", "radius": 0.25 * size, "segments": segments}
    coil = {"shape": "coil", "radius": 0.12 * size, "height": 0.3 * size, "turns": 3, "segments": 42}
    mesh = [rope, ring, coil][rng.integers(3)]
    if mesh is coil:
        material["radius"] = min(material["radius"], 0.02 * size)
    elif rng.random() < 0.5:
        material = bent(rng, material, 1e-3, 1.0, (0.0, 0.5, 1.0))
    return {"mesh": mesh, "material": material}


def rigid(rng: Generator, size: float) -> dict:
    meshes = [
        {"shape": "box", "size": [size * between(rng, 0.1, 0.4) for _ in range(3)], "cells": [1, 1, 1]},
        {"shape": "torus", "major_radius": 0.2 * size, "minor_radius": 0.05 * size, "cells": [4, 16]},
        {"shape": "sphere", "radius": 0.15 * size, "cells": 6},
        {"shape": "capsule", "radius": 0.06 * size, "length": 0.3 * size, "cells": [4, 4]},
        {"shape": "cylinder", "radius": 0.1 * size, "length": 0.3 * size, "cells": [6, 3]},
    ]
    turning = rng.normal(0.0, 5.0, 3).tolist()
    return {"mesh": meshes[rng.integers(5)], "material": {"density": between(rng, 100.0, 8000.0)}, "angular_velocity": turning}


def solid(rng: Generator, size: float) -> dict:
    material = {"young_modulus": between(rng, 1e4, 1e7), "poisson_ratio": float(rng.uniform(0.0, 0.48))}
    mesh = {"shape": "box", "size": [0.3 * size, 0.2 * size, 0.25 * size], "cells": [4, 3, 3]}
    return {"mesh": mesh, "material": {**material, "density": between(rng, 100.0, 2000.0)}}


OF_KIND: dict[str, Callable[[Generator, float], dict]] = dict(zip(KINDS, (sheet, pillow, rod, rigid, solid), strict=True))


def floor(size: float, height: float = 0.0) -> dict:
    return {"name": "floor", "mesh": {"shape": "plane", "size": 20.0 * size}, "translation": [0.0, height, 0.0]}
