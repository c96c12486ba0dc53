"""Line searches that CCD interferes with, obstacles that push, and what rounding leaves: scenes that once ended at the cap."""

from pathlib import Path

import pytest
from physics.scenes import scene, solid

import pdipc

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize(
    ("seed", "steps"),
    [
        (3, 5),  # a cloth of 7 mm: CCD cut the halved step again, unevenly, and no further half of that descended
        (19, 9),  # float32, 235 MPa: forces of rounding moved nothing that the potential showed
    ],
)
def test_every_step_converges(seed, steps, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import converge

    simulation = pdipc.Simulation(converge.draw(seed), "cpu")
    for _ in range(steps):
        result = simulation.step()
        assert result.converged, result.message


@pytest.mark.parametrize("speed", [1.0, 8.0])
def test_a_plate_pushes_what_is_in_its_way(speed):
    """By ten times d_hat a step and by eighty: the iterations of a step do not count how often d_hat fits into its way."""
    block = solid("block", (0.2, 0.2, 0.2), (3, 3, 3), young=1e5, poisson=0.3)
    plate = {"name": "plate", "mesh": {"shape": "box", "size": [0.4, 0.04, 0.4], "cells": [1, 1, 1]}}
    plate |= {"translation": (0.0, -0.1215, 0.0), "motion": {"velocity": (0.0, speed, 0.0)}}
    simulation = pdipc.Simulation(scene([block], [plate], contact={"activation_distance": 1e-3}, gravity=(0, 0, 0)), "cpu")
    results = [simulation.step() for _ in range(8)]
    assert all(result.converged and result.lag == 0.0 for result in results)
    assert max(result.outer for result in results) <= 25
    assert simulation.state.velocities.numpy()[:64, 1].mean() > 0.5 * speed
