"""The simulator's default mode against IPC with the same energies: the same states, closing as tolerances shrink."""

import itertools

import numpy as np
import pytest

pytest.importorskip("ipctk", reason="needs ipctk (extra: benchmarks)")
pytest.importorskip("cholespy", reason="needs cholespy (extra: benchmarks)")

import pdipc
from pdipc.baselines.reference import Reference

FLOOR = 1e-7  # of the scene size: IPC's own steps are solved to 1e-8 of it, and their errors add up


def falling_box(tolerance):
    """A soft box thrown onto a floor, turned so that it lands on a corner."""
    body = {
        "name": "box",
        "kind": "solid",
        "mesh": {"shape": "box", "size": (0.2, 0.2, 0.2), "cells": (2, 2, 2)},
        "translation": (0, 0.125, 0),
        "rotation": (5, 3, 10),
        "velocity": (0.5, -1, 0),
        "material": {"young_modulus": 1e5, "poisson_ratio": 0.3, "density": 1000.0, "model": "arap"},
    }
    return make(body, {"name": "floor", "mesh": {"shape": "plane", "size": 10.0}}, tolerance)


def cloth_on_a_sphere(tolerance):
    """Beside its middle, so that no symmetry has to break: what buckles by rounding has no one solution."""
    body = {
        "name": "cloth",
        "kind": "cloth",
        "mesh": {"shape": "grid", "size": (0.3, 0.3), "cells": (6, 6)},
        "translation": (0.05, 0.125, 0.03),
        "rotation": (0, 20, 0),
        "material": {"membrane_stiffness": 100.0, "bending_stiffness": 3e-4},
    }
    return make(body, {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.12}}, tolerance)


def make(body, obstacle, tolerance):
    simulation = {"precision": "float64", "time_step": 0.01, "max_outer": 1000, "outer_tolerance": tolerance, "damping": 2.0}
    scene = pdipc.Scene(bodies=[body], obstacles=[obstacle], simulation=simulation, contact={"activation_distance": 2e-3})
    simulation = pdipc.Simulation(scene, device="cpu")
    # the baseline has a barrier for every pair, and knows nothing of flat faces that count as one
    simulation.work.candidates.flatten(np.zeros(simulation.work.candidates.flat.size, dtype=bool))
    return simulation


def motion(simulation, steps):
    """Positions after each step; (steps, n, 3)."""
    found = []
    for _ in range(steps):
        assert simulation.step().converged
        found.append(simulation.positions)
    return np.array(found)


@pytest.mark.parametrize(
    ("make_scene", "steps", "tolerances"),
    [
        (falling_box, 100, (1e-5, 1e-6, 1e-8)),
        (cloth_on_a_sphere, 30, (1e-6, 1e-7, 1e-8)),
        (cloth_on_a_sphere, 100, (1e-7, 1e-8)),
    ],
)
def test_same_states_as_ipc(make_scene, steps, tolerances):
    simulation = make_scene(tolerances[0])
    reference, size = Reference(simulation.model), simulation.model.assembly.scene_size
    expected, touched = [], 0
    for _ in range(steps):
        info = reference.step(tolerance=1e-8 * size)
        assert info.converged
        touched += np.isfinite(info.smallest_gap)
        expected.append(reference.state.positions)
    assert touched > 10
    errors = [np.abs(motion(make_scene(t), steps) - expected).max() / size for t in tolerances]
    assert errors[0] < 1e-3
    for previous, error in itertools.pairwise(errors):
        assert error < max(0.3 * previous, FLOOR)
