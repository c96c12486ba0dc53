"""Closed cloth that holds a pressure, a gas or a liquid: Laplace's law, Boyle's law, a kept volume, momentum."""

import numpy as np
import pytest
from scipy.optimize import brentq

import pdipc
from pdipc.audit import audit
from physics.scenes import floor, scene, watched

RADIUS, STRETCH = 0.1, 100.0  # m, N/m


def balloon(inside, *, cells=8, name="balloon", stretch=STRETCH, **more):
    """A spherical membrane without bending and lateral contraction."""
    material = {"membrane_stiffness": stretch, "poisson_ratio": 0.0, "bending_stiffness": 0.0}
    mesh = {"shape": "sphere", "radius": RADIUS, "cells": cells}
    return {"name": name, "kind": "cloth", "mesh": mesh, "material": material, "inside": inside, **more}


def settled(body, steps=4):
    """With a step of half a second and no gravity, implicit Euler goes to the static shape."""
    simulation = watched(scene([body], gravity=(0, 0, 0), time_step=0.5, tolerance=1e-6))
    for _ in range(steps):
        assert simulation.step().converged
    return simulation


def volume_of(simulation):
    return float(simulation.model.projector.cavities.volume.numpy()[0])


def stretch_of(simulation):
    """How much larger it is than at rest: by volume, which a polyhedron and its ball have alike."""
    start = simulation.model.assembly.positions
    corners = start[simulation.triangles]
    rest = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return np.cbrt(volume_of(simulation) / rest), rest


def laplace(pressure):
    """The stretch at which p = 2 T / r: the tension of this membrane is T = Y (s - 1) / s, its radius s R."""
    return brentq(lambda s: pressure - 2 * STRETCH * (s - 1) / s**2 / RADIUS, 1.0, 1.9)


@pytest.mark.parametrize("pressure", [20.0, 300.0])
def test_laplaces_law(pressure):
    found, _ = stretch_of(settled(balloon({"pressure": pressure})))
    assert found - 1 == pytest.approx(laplace(pressure) - 1, rel=0.02)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_a_gas_of_given_amount(exponent):
    """p V^g stays, and the overpressure is the one that Laplace's law asks for."""
    simulation = settled(balloon({"gas": 102500.0, "outside": 102000.0, "exponent": exponent}))
    stretch, rest = stretch_of(simulation)
    inside = 102500.0 * (rest / volume_of(simulation)) ** exponent
    pressure = float(simulation.model.projector.cavities.pressure.numpy()[0])
    assert pressure == pytest.approx(inside - 102000.0, rel=1e-6)
    assert 0.0 < pressure < 500.0
    assert stretch - 1 == pytest.approx(laplace(pressure) - 1, rel=0.05)


def test_a_liquid_keeps_its_volume_under_load():
    """A ball of liquid lands on the floor and spreads: its volume changes by no more than the mean pressure over its bulk modulus."""
    body = balloon({"bulk_modulus": 1e6}, cells=6, translation=(0, 0.103, 0), velocity=(0, -1.0, 0))
    simulation = watched(scene([body], [floor(1.0)], contact={"activation_distance": 2e-3}, time_step=0.01))
    start, count = stretch_of(simulation)[1], simulation.model.assembly.bodies[0].last
    changes, pressures, heights = [], [], []
    for _ in range(15):
        assert simulation.step().converged
        simulation.model.projector.cavities.measure(simulation.state.positions, simulation.state.remainders)
        changes.append(volume_of(simulation) / start - 1)
        heights.append(np.ptp(simulation.positions[:count, 1]))
        pressures.append(simulation.model.projector.cavities.pressure.numpy()[0])
    assert np.abs(changes).max() < 1e-3
    np.testing.assert_allclose(pressures, -1e6 * np.array(changes), rtol=1e-6)
    assert min(heights) < 1.8 * RADIUS  # it was squeezed


def test_thin_pillows_fill_with_gas_in_single_precision():
    """What a gas releases hides nothing: the energies that steps are judged by count from the last iterate."""
    mesh = {"shape": "box", "size": (0.4, 0.02, 0.4), "cells": (12, 1, 12)}
    pillow = {
        "name": "pillow",
        "kind": "cloth",
        "mesh": mesh,
        "translation": (0, 0.05, 0),
        "material": {"areal_density": 0.3, "membrane_stiffness": 400.0, "bending_stiffness": 1e-4},
        "inside": {"gas": 1e5, "volume": 3.6 * 0.4 * 0.4 * 0.02, "rise": 0.2},
        "copies": {"counts": (1, 2, 1), "spacing": (0, 0.12, 0)},
    }
    contact = {"activation_distance": 3e-3, "friction": 0.5}
    simulation = pdipc.Simulation(scene([pillow], [floor(2.0)], precision="float32", contact=contact), "cpu")
    assert all(simulation.step().outer <= 30 for _ in range(10))  # of 100


def test_momentum_of_a_filled_body_stays():
    """Inflating within a step changes neither linear nor angular momentum, beyond what implicit Euler loses of the latter."""
    body = balloon({"gas": 110000.0, "rise": 0.1}, cells=4, velocity=(1.0, 0.5, 0), angular_velocity=(0, 0, 2.0))
    simulation = watched(scene([body], gravity=(0, 0, 0), time_step=0.005, tolerance=1e-5))
    first = audit(simulation.model, simulation.state, simulation.work)
    for _ in range(10):
        assert simulation.step().converged
    last = audit(simulation.model, simulation.state, simulation.work)
    scale = np.abs(first.linear_momentum).max()
    np.testing.assert_allclose(last.linear_momentum, first.linear_momentum, atol=1e-4 * scale)
    about = [a.angular_momentum - np.cross(simulation.positions.mean(axis=0), a.linear_momentum) for a in (last,)]
    assert about[0][2] > 0.5 * first.angular_momentum[2]


def test_what_cannot_hold_anything_is_refused():
    sheet = {"name": "sheet", "kind": "cloth", "mesh": {"shape": "grid", "cells": [2, 2]}, "inside": {"pressure": 1.0}}
    (found,) = pdipc.check_scene(scene([sheet]))
    assert str(found).startswith('body "sheet": inside: holds nothing: 8 edges of the cloth have a triangle on one side only')
    ball = balloon({"pressure": 1.0}, cells=4)
    for more in ({"nonlinear_solver": "local-global"}, {"inner_iterations": 5}):
        (found,) = pdipc.check_scene(scene([ball], **more))
        assert str(found).startswith('body "balloon": inside: needs the Newton solver')
    (found,) = pdipc.check_scene(scene([ball], contact={"method": "paper"}))
    assert "needs the Newton solver" in str(found)
    for wrong, message in (
        ({}, "exactly one of pressure, gas, bulk_modulus"),
        ({"pressure": 1.0, "volume": 1.0}, "volume has no effect"),
        ({"bulk_modulus": 1.0, "exponent": 1.4}, "exponent has no effect on bulk_modulus"),
    ):
        with pytest.raises(pdipc.SceneError, match=message):
            scene([balloon(wrong)])


def test_area_stiffness_resists_a_change_of_area():
    """Pulled along one axis by a force F per length, plane stress with K on top: the area grows by F / (Y + 2 K) for nu = 0, small strains."""
    young, area, pull = 100.0, 300.0, 0.05
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    of = {"membrane_stiffness": young, "poisson_ratio": 0.0, "bending_stiffness": 0.0, "area_stiffness": area}
    body = {
        "name": "sheet",
        "kind": "cloth",
        "mesh": {"vertices": points, "triangles": np.array([[0, 2, 1], [0, 3, 2]])},
        "material": of,
    }
    simulation = pdipc.Simulation(scene([body], gravity=(0, 0, 0), time_step=1.0, tolerance=1e-9), device="cpu")
    simulation.set_vertex_force(np.arange(4), 0.5 * pull * np.array([[-1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]]))
    for _ in range(8):
        simulation.step()
    x = simulation.positions[:3]
    grown = np.stack([x[1] - x[0], x[2] - x[0]], axis=1) @ np.linalg.inv([[1.0, 1.0], [0.0, 1.0]])  # F of the first triangle
    strains = np.linalg.svd(grown, compute_uv=False) - 1
    # stress: Y e1 + K (e1 + e2) = F, Y e2 + K (e1 + e2) = 0
    assert strains.sum() == pytest.approx(pull / (young + 2 * area), rel=0.01)
    assert strains[0] == pytest.approx(pull * (young + area) / (young * (young + 2 * area)), rel=0.01)
