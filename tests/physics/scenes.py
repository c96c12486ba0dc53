"""Small scenes for the physics tests, and the witness that watches every outer iteration."""

from dataclasses import replace

import numpy as np

import pdipc
from pdipc.scene import check


def solid(name, size, cells, *, at=(0, 0, 0), rotation=(0, 0, 0), young=1e5, poisson=0.0, density=1000.0, **more):
    """A box of the given edge lengths with its centre at `at`."""
    mesh = {"shape": "box", "size": size, "cells": cells}
    material = {"young_modulus": young, "poisson_ratio": poisson, "density": density}
    return {"name": name, "kind": "solid", "mesh": mesh, "translation": at, "rotation": rotation, "material": material, **more}


def cloth(name, size, cells, *, at=(0, 0, 0), rotation=(0, 0, 0), **more):
    """A flat sheet in the plane y = 0 before rotation."""
    mesh = {"shape": "grid", "size": size, "cells": cells}
    return {"name": name, "kind": "cloth", "mesh": mesh, "translation": at, "rotation": rotation, **more}


def rod(
    name, length, segments, *, at=(0, 0, 0), rotation=(0, 0, 0), radius=5e-3, young=1e6, poisson=0.3, density=1000.0, **more
):
    """A straight rod along x before rotation, its middle at `at`."""
    mesh = {"shape": "rope", "length": length, "segments": segments}
    stiffness = {name: more.pop(name) for name in ("stretch_stiffness", "bending_stiffness", "twist_stiffness") if name in more}
    material = {"radius": radius, "young_modulus": young, "poisson_ratio": poisson, "density": density, **stiffness}
    return {"name": name, "kind": "rod", "mesh": mesh, "translation": at, "rotation": rotation, "material": material, **more}


def floor(size=10.0, *, rotation=(0, 0, 0), name="floor", at=(0, 0, 0), **more):
    """A plane that faces up."""
    mesh = {"shape": "plane", "size": size}
    return {"name": name, "mesh": mesh, "rotation": rotation, "translation": at, **more}


def scene(bodies, obstacles=(), *, contact=None, **simulation):
    """A scene from tables, as a scene file would give them."""
    simulation = {"precision": "float64", **simulation}
    return pdipc.Scene(bodies=list(bodies), obstacles=list(obstacles), simulation=simulation, contact=contact or {})


class Witness:
    """Watches every committed motion of a simulation: at its end no two triangles, nor segments of rods, may intersect."""

    def __init__(self, simulation):
        self.triangles, self.checked = simulation.triangles, 0
        self.obstacle = simulation.model.assembly.obstacle

    def __call__(self, x, x_end):
        found = pdipc.find_intersections(np.asarray(x_end.numpy(), dtype=np.float64), self.triangles, self.obstacle)
        assert len(found) == 0, f"triangles {found[:3].tolist()} intersect"
        self.checked += 1


def watched(scene_or_model):
    """A simulation whose every outer iteration is judged by the witness."""
    simulation = pdipc.Simulation(scene_or_model, device="cpu")
    simulation.observe = Witness(simulation)
    return simulation


def too_near(simulation):
    """What is nearer than its minimum separation, the thickness of rods and cloth: measured without the code of the contact."""
    assembly = replace(simulation.model.assembly, positions=simulation.positions)
    return list(check.too_close(assembly, set(), "float64"))


def clean(simulation):
    """Whether no two triangles, nor segments of rods, intersect."""
    return len(pdipc.find_intersections(simulation.positions, simulation.triangles, simulation.model.assembly.obstacle)) == 0
