"""Sheets that buckle: the start is next to a saddle, where steps of a projected Hessian are short and tell little of what is left."""

import numpy as np
import pytest

import pdipc

TOLERANCE = 1e-4  # m


def squeezed(stiffness, tolerance, noise):
    """A sheet that was cut a ninth longer than it is, flat but for `noise`, m, its two ends held."""
    cells = 10
    grid = np.stack(np.meshgrid(np.linspace(0, 0.36, cells + 1), np.linspace(0, 0.4, cells + 1), indexing="ij"), axis=-1)
    flat = np.insert(grid.reshape(-1, 2), 1, 0.0, axis=1)
    quads = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (q.ravel() for q in (quads[:-1, :-1], quads[1:, :-1], quads[1:, 1:], quads[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])
    held = np.flatnonzero((flat[:, 0] == 0.0) | (flat[:, 0] == 0.36)).tolist()
    noise = noise * np.random.default_rng(3).standard_normal(len(flat))
    cloth = {
        "name": "sheet",
        "kind": "cloth",
        "mesh": {"vertices": flat + np.stack([0 * noise, noise, 0 * noise], axis=1), "triangles": triangles},
        "rest": {"mesh": {"vertices": flat / [0.9, 1.0, 1.0], "triangles": triangles}},
        "material": {"young_modulus": stiffness},
        "pins": [{"select": {"vertices": held}}],
    }
    scene = pdipc.Scene(bodies=[cloth], simulation={"gravity": [0, 0, 0], "time_step": 0.02, "tolerance": tolerance})
    return pdipc.Simulation(scene, "cpu")


@pytest.mark.parametrize("noise", [1e-7, 1e-4])
@pytest.mark.parametrize("stiffness", [1e5, 1e6])
def test_a_step_away_from_a_saddle_ends_at_a_minimum(stiffness, noise):
    simulation = squeezed(stiffness, TOLERANCE, noise)
    result = simulation.step()
    assert result.converged, result.message
    height = np.ptp(simulation.positions[:, 1])
    assert height > 0.01  # it has buckled
    exact = squeezed(stiffness, 1e-9, noise)
    assert exact.step().converged
    assert np.ptp(exact.positions[:, 1]) == pytest.approx(height, abs=10 * TOLERANCE * 0.02)
