"""Sewn cloth: seams close in their time, to what they are told or as near as contact lets them, and hold what they must."""

import numpy as np
import pytest

from physics.scenes import cloth, scene, watched

H = 0.01
SHEET = {"areal_density": 0.2, "membrane_stiffness": 100.0, "bending_stiffness": 1e-6}


def two_strips(nonlinear=None, **stitch):
    """Two strips end to end, 4 cm apart, of meshes that do not match; sewn along the ends that face each other."""
    left = cloth("left", (0.2, 0.1), (6, 3), at=(-0.12, 0, 0), material=SHEET)
    right = cloth("right", (0.2, 0.1), (6, 4), at=(0.12, 0, 0), material=SHEET)
    more = {"nonlinear_solver": nonlinear} if nonlinear else {}
    made = scene([left, right], contact={"activation_distance": 2e-3}, gravity=(0, 0, 0), time_step=H, damping=20.0, **more)
    seam = {"box": [[0.0, -1, -1], [0.021, 1, 1]]}
    made.stitches = [{"bodies": ["right", "left"], "within": 0.05, "select": seam, "duration": 0.1, **stitch}]
    return made


def distances(simulation):
    x = simulation.positions
    return np.concatenate(
        [
            np.linalg.norm(np.einsum("ek,ekd->ed", s.weights, x[s.elements[:, 1:]]) - x[s.elements[:, 0]], axis=1)
            for s in simulation.model.assembly.stitches
        ]
    )


@pytest.mark.parametrize("nonlinear", ["newton", "local-global"])
def test_a_seam_closes_to_the_gap_that_contact_keeps(nonlinear):
    simulation = watched(two_strips(nonlinear))
    gap = 2e-3 * 1.02
    for k in range(20):
        assert simulation.step().converged
        length = simulation.model.assembly.stitches[0].lengths((k + 1) * H)
        assert (distances(simulation) <= length + 2e-3).all()
        assert (distances(simulation) > 0.02 * 2e-3).all()  # the minimum separation, which contact keeps
    assert distances(simulation) == pytest.approx(gap, rel=0.02)


def test_a_seam_of_no_length_is_held_off_by_the_barrier():
    """Threads pull to zero; what is left is where they and the barrier balance, beyond the minimum separation."""
    simulation = watched(two_strips(length=0.0))
    for _ in range(20):
        result = simulation.step()
        assert result.converged
    found = distances(simulation)
    assert (found > 4e-5).all() and (found < 2.04e-3).all() and result.smallest_gap > 0.0
    assert result.barriers > 0


def test_threads_are_loose_before_they_are_sewn_and_hold_a_weight_after():
    """A strip hangs from a held one by its seam alone: the threads carry its weight, k times how much longer they are than told."""
    top = cloth(
        "top", (0.1, 0.02), (4, 1), rotation=(90, 0, 0), at=(0, 0.02, 0), pins=[{"select": {"all": True}}], material=SHEET
    )
    low = cloth("low", (0.1, 0.1), (4, 4), rotation=(90, 0, 0), at=(0, -0.05, 0), material=SHEET)
    made = scene([top, low], contact={"activation_distance": 1e-3}, time_step=0.02, damping=10.0)
    made.stitches = [{"bodies": ["low", "top"], "within": 0.011, "length": 0.01, "stiffness": 20.0, "start": 0.03}]
    simulation = watched(made)
    simulation.step()
    assert simulation.positions[10:].mean(axis=0)[1] < -0.05 - 0.9 * 9.81 * 0.02**2 / 1.2  # it falls freely
    for _ in range(80):
        assert simulation.step().converged
    (stitch,) = simulation.model.assembly.stitches
    x = simulation.positions
    along = np.einsum("ek,ekd->ed", stitch.weights, x[stitch.elements[:, 1:]]) - x[stitch.elements[:, 0]]
    length = np.linalg.norm(along, axis=1)
    pull = (20.0 * np.maximum(0.0, length - 0.01) * along[:, 1] / length).sum()
    assert pull == pytest.approx(0.2 * 0.01 * 9.81, rel=1e-3)


def test_a_rigid_cube_hangs_from_a_sheet_by_its_threads():
    """At rest the threads carry its weight, and its sides stay as long as they were."""
    box = {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]}
    cube = {"name": "cube", "kind": "rigid", "mesh": box, "translation": [0, 0.305, 0]}
    corners = [{"select": {"nearest": [x, 0.36, z]}} for x in (-0.15, 0.15) for z in (-0.15, 0.15)]
    stiff = {"membrane_stiffness": 2000.0, "areal_density": 0.2}
    sheet = cloth("sheet", (0.3, 0.3), (6, 6), at=(0, 0.36, 0), pins=corners, material=stiff)
    made = scene([sheet, cube], contact={"activation_distance": 1e-3}, time_step=0.2, damping=5.0)
    made.stitches = [
        {"bodies": ["sheet", "cube"], "within": 0.006, "onto": "surface", "select": {"all": True}, "length": 0.004}
    ]
    simulation = watched(made)
    for _ in range(15):
        result = simulation.step()
        assert result.converged
    (stitch,) = simulation.model.assembly.stitches
    x = simulation.positions
    along = np.einsum("ek,ekd->ed", stitch.weights, x[stitch.elements[:, 1:]]) - x[stitch.elements[:, 0]]
    length = np.linalg.norm(along, axis=1)
    pull = (2000.0 * np.maximum(0.0, length - 0.004) * along[:, 1] / length).sum()
    assert len(length) == 9 and result.barriers == 0
    assert -pull == pytest.approx(1.0 * 9.81, rel=2e-3)
    sides = np.linalg.norm(x[49:][:, None] - x[49:], axis=2).max()
    assert sides == pytest.approx(0.1 * np.sqrt(3), rel=1e-5)
