"""Motion without contact, and bodies that carry their weight: against analytic solutions."""

import numpy as np
import pytest

from pdipc.audit import barrier_forces

from .scenes import cloth, floor, scene, solid, watched

G = 9.81


def run(simulation, steps):
    results = [simulation.step() for _ in range(steps)]
    assert all(result.converged for result in results), [r.message for r in results if not r.converged][:1]
    return results


def mean_of(simulation, values):
    mass = simulation.model.external.mass
    return (mass[:, None] * values).sum(axis=0) / mass.sum()


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_projectile_is_exact_to_implicit_euler(precision):
    h, steps, v0 = 0.01, 20, np.array([1.0, 2.0, -0.5])
    body = solid("box", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 1, 0), velocity=tuple(v0))
    solved = {"float64": 1e-6, "float32": 1e-4}[precision]  # m/s: errors of the steps add up
    simulation = watched(
        scene([body], time_step=h, precision=precision, tolerance=solved, contact={"activation_distance": 2e-3})
    )
    start = mean_of(simulation, simulation.positions)
    run(simulation, steps)
    # implicit Euler: v_k = v_0 + k h g and x_k = x_0 + k h v_0 + k (k + 1) / 2 h^2 g
    expected = start + steps * h * v0 + 0.5 * steps * (steps + 1) * h * h * np.array([0, -G, 0])
    tolerance = {"float64": 1e-8, "float32": 2e-5}[precision]
    np.testing.assert_allclose(mean_of(simulation, simulation.positions), expected, atol=tolerance)


def test_hanging_bar_stretches_as_analytically():
    """A bar hung at its top under its own weight stretches by rho g L^2 / (2 E) where Poisson's ratio is zero."""
    length, young, density = 1.0, 2e5, 1000.0
    expected = density * G * length**2 / (2 * young)
    errors = []
    for cells in (4, 8):
        top = {"select": {"box": [(-1, length / 2 - 1e-6, -1), (1, 1, 1)]}}
        bar = solid("bar", (0.2, length, 0.2), (1, cells, 1), young=young, density=density, pins=[top])
        simulation = watched(scene([bar], time_step=0.05, damping=8.0, outer_tolerance=1e-7, max_outer=200))
        run(simulation, 80)
        drop = simulation.model.assembly.positions[:, 1].min() - simulation.positions[:, 1].min()
        errors.append(abs(drop - expected) / expected)
    assert errors[1] < 0.02
    assert errors[1] < errors[0] or errors[0] < 0.005


def test_block_at_rest_carries_its_weight():
    size, cells, gap = 0.2, 3, 1e-3
    body = solid("block", (size,) * 3, (cells,) * 3, at=(0, size / 2 + gap, 0), young=1e5)
    contact = {"activation_distance": 2e-3, "friction": 0.3}
    simulation = watched(scene([body], [floor()], contact=contact, damping=5.0, time_step=0.01))
    run(simulation, 100)
    model = simulation.model
    force = barrier_forces(model, simulation.state, simulation.work)
    weight = model.external.mass.sum() * G
    np.testing.assert_allclose(force[: model.assembly.bodies[0].last, 1].sum(), weight, rtol=0.01)
    speed = np.abs(simulation.state.velocities.numpy()).max()
    assert speed < 1e-4


def test_flat_sheet_finer_than_the_activation_distance_stays_at_rest():
    """Edges of 5 mm with d_hat = 5 mm, as a 200 x 200 cloth of one metre has: no barrier acts within it at rest."""
    sheet = cloth("sheet", (0.1, 0.1), (20, 20))
    simulation = watched(scene([sheet], contact={"activation_distance": 5e-3}, gravity=(0, 0, 0)))
    run(simulation, 5)
    np.testing.assert_allclose(simulation.positions, simulation.model.assembly.positions, atol=1e-9)
