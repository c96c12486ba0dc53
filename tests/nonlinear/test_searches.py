"""Line searches that CCD interferes with, obstacles that push, and what rounding leaves: scenes that once ended at the cap."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from physics.scenes import rod, scene, solid

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


@pytest.mark.parametrize(("seed", "steps"), [(17, 9), (6, 7)])
def test_a_step_goes_on_while_barriers_change(seed, steps, monkeypatch):
    """The first motions out of a stiff barrier are shorter than the tolerance, however far the way is that it opens."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import converge

    from pdipc.drive import step

    drawn = converge.draw(seed)
    simulation = pdipc.Simulation(drawn, "cpu")
    for _ in range(steps):
        state = simulation.state.arrays()
        result = simulation.step()
    assert result.converged
    strict = converge.strictly(drawn, simulation)
    again = step(strict.model, strict.model.state_from(state), strict.work)
    error = np.linalg.norm(again.state.positions.numpy() - simulation.positions, axis=1).max()
    assert error <= 3.0 * simulation.model.settings.tolerance


def test_local_global_steps_with_friction_are_not_ended_for_a_potential_that_they_do_not_lower():
    """Friction follows their iterate and has no potential: that none fell a dozen times over says nothing."""
    block = solid(
        "block", (0.2, 0.2, 0.2), (2, 2, 2), young=1e8, poisson=0.3, velocity=(1.0, -1.0, 0.0), rotation=(10.0, 20.0, 30.0)
    )
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 4.0}, "translation": (0.0, -0.2, 0.0)}
    strict = {"nonlinear_solver": "local-global", "tolerance": 1e-8, "max_outer": 300}
    simulation = pdipc.Simulation(scene([block], [floor], contact={"friction": 0.5}, **strict), "cpu")
    results = [simulation.step() for _ in range(14)]
    assert all(result.converged for result in results), [result.message for result in results if not result.converged]


@pytest.mark.parametrize("young", [1e5, 1e9, 1e11])
def test_what_spins_by_more_than_a_radian_a_step_is_not_stretched_by_it(young):
    """Of steel, the first step once took 77 outer iterations: straight ones, of which each stretched it."""
    spin = {"angular_velocity": (45.0, 150.0, 15.0)}
    block = solid("block", (0.2, 0.1, 0.1), (4, 2, 2), young=young, poisson=0.3, **spin)
    simulation = pdipc.Simulation(scene([block], gravity=(0, 0, 0), time_step=0.01), "cpu")
    results = [simulation.step() for _ in range(4)]
    assert all(result.converged for result in results)
    assert max(result.outer for result in results) <= 10


@pytest.mark.parametrize("young", [1e6, 1e9, 2e11])
def test_what_is_hinged_turns_about_its_hinge(young):
    """A door of steel once took 110 outer iterations a step: straight ones, of which each stretched it."""
    pins = [{"select": {"box": ((-0.21, -0.02, -0.11), (-0.19, 0.0, 0.11))}}]  # vertices on a line
    spin = {"angular_velocity": (0.0, 0.0, 100.0), "velocity": (0.0, 20.0, 0.0)}
    door = solid("door", (0.4, 0.02, 0.2), (8, 1, 4), young=young, poisson=0.3, pins=pins, **spin)
    simulation = pdipc.Simulation(scene([door], time_step=0.01), "cpu")
    assert (~simulation.model.free_vertices).sum() == 5
    results = [simulation.step() for _ in range(8)]
    assert all(result.converged for result in results)
    assert max(result.outer for result in results) <= 10
    extents = simulation.positions[:, 2].max() - simulation.positions[:, 2].min()
    assert extents == pytest.approx(0.2, rel=1e-2)


def test_a_stiff_body_under_a_fast_plate_keeps_its_shape(monkeypatch):
    """Truncation cuts its vertices unevenly, and what the plate pushes need not lose energy: once that stretched a body of 80 GPa for good."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import converge

    drawn = converge.draw(5131)
    drawn.simulation.precision = "float64"
    simulation = pdipc.Simulation(drawn, "cpu")
    results = [simulation.step() for _ in range(11)]
    assert all(result.converged for result in results), [result.message for result in results if not result.converged]
    assert max(result.outer for result in results) <= 200


@pytest.mark.parametrize(("seed", "steps"), [(77, 31), (93, 32)])
def test_cloth_at_its_limit_that_is_pulled_stays_at_it(seed, steps, monkeypatch):
    """Where something lands on it meanwhile: one long step once stretched it to four times its limit, with 1e9 J, and ended at the cap."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import kind_scenes
    import kinds

    _, drawn = kind_scenes.draw(seed)
    drawn.simulation.precision = "float64"
    simulation = pdipc.Simulation(drawn, "cpu")
    worst = 0.0
    for _ in range(steps):
        result = simulation.step()
        assert result.converged, result.message
        assert result.outer <= 200
        worst = max(worst, kinds.stretched(replace(simulation.model.assembly, positions=simulation.positions)))
    assert 0.9 < worst < 1.02


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


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_rope_on_a_line_does_not_turn_about_it(precision):
    """There the small motions of one that hangs or hardly sags are large angles."""
    ropes = []
    for k, select in enumerate(
        [{"box": ((-0.51, -1.0, -1.0), (-0.49, 1.0, 1.0))}, {"box": ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))}]
    ):
        pins = [{"select": select}] if k == 0 else [{"select": {"vertices": [0, 20]}}]
        ropes.append(rod(f"rope{k}", 1.0, 20, radius=0.01, at=(0.0, 0.3 * k, 0.0), pins=pins))
    simulation = pdipc.Simulation(scene(ropes, precision=precision), "cpu")
    results = [simulation.step() for _ in range(12)]
    assert all(result.converged for result in results), [result.message for result in results]
    assert max(result.outer for result in results) <= 12
