"""The plain projective dynamics baseline: right where nothing collides, and blind to what it passes in a step."""

import numpy as np
import pytest

pytest.importorskip("cholespy", reason="needs cholespy (extra: benchmarks)")

from pdipc.baselines import common, energies
from pdipc.baselines import projective_dynamics as pd

G, H = 9.81, 0.01


def block(cells=(2, 2, 2), size=0.2, height=0.5, mu=2e4):
    x, tets = common.box((size,) * 3, cells, (0, height, 0))
    volumes = energies.tet_volumes(x, tets)
    return x, tets, common.lumped_tet_masses(len(x), tets, volumes, 1000.0), 2 * mu * volumes


def test_converges_to_the_minimum_that_newton_finds():
    ipc = pytest.importorskip("pdipc.baselines.ipc", reason="needs ipctk (extra: benchmarks)")
    x, tets, masses, weight = block(mu=2e3)
    terms = [energies.tet_strain(x, tets, weight), energies.tet_volume(x, tets, weight)]
    kinematic = x[:, 1] > 0.59
    bent = x + 0.02 * np.random.default_rng(0).standard_normal(x.shape) * ~kinematic[:, None]
    problem = pd.Problem(masses, terms, H, kinematic)
    mine, _ = pd.step(problem, pd.State(bent, np.zeros_like(x)), iterations=400)
    reference, info = ipc.step(ipc.Problem(masses, terms, H, kinematic), ipc.State(bent, np.zeros_like(x)), tolerance=1e-10)
    assert info.converged
    np.testing.assert_allclose(mine.positions, reference.positions, atol=1e-6)


def test_block_rests_on_a_plane_with_its_weight_on_the_collision_springs():
    x, tets, masses, weight = block(height=0.1)
    problem = pd.Problem(masses, [energies.tet_strain(x, tets, weight)], H, planes=[(np.zeros(3), np.array([0.0, 1.0, 0.0]))])
    state = pd.State(x, np.zeros_like(x))
    for _ in range(150):
        state, _ = pd.step(problem, state)
        state.velocities *= 0.9
    depth = -np.minimum(state.positions[:, 1], 0.0)
    assert problem.collision_weight * depth.sum() == pytest.approx(masses.sum() * G, rel=0.02)


@pytest.mark.parametrize(("thickness", "caught"), [(0.08, True), (0.008, False)])
def test_passes_through_a_thin_rod_only(thickness, caught):
    """10 m/s are 10 cm a step: more than either thickness, but no vertex may be inside the thin rod at the end of one."""
    x, tets, masses, weight = block(height=0.2 + thickness)
    x[:, 0] += 0.02  # a vertex column above the thick rod, none above the thin one
    rod, rod_tets = common.box((thickness, thickness, 1.0), (1, 1, 1))
    n = len(x)
    positions = np.concatenate([x, rod])
    masses = np.concatenate([masses, np.zeros(len(rod))])
    kinematic = np.arange(len(positions)) >= n
    terms = [energies.tet_strain(positions, tets, weight)]
    problem = pd.Problem(masses, terms, H, kinematic, surfaces=[common.boundary(rod_tets) + n])
    velocities = np.where(kinematic[:, None], 0.0, np.array([0.0, -10.0, 0.0]))
    state = pd.State(positions, velocities)
    touched = 0
    for _ in range(10):
        state, colliding = pd.step(problem, state)
        touched += colliding
    middle = state.positions[:n, 1].mean()
    assert (touched > 0) == caught
    assert caught or middle < -0.5


def test_inside_and_nearest_point_of_a_sphere():
    x, triangles = common.sphere(1.0, 3)
    points = np.random.default_rng(1).uniform(-1.3, 1.3, (300, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - 1) > 0.02
    inside = pd.winding_number(points, x[triangles]) > 0.5
    np.testing.assert_array_equal(inside[clear], radius[clear] < 1)
    nearest = pd.nearest_points(points, x[triangles])
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1), np.abs(radius - 1), atol=0.02)


def test_fig2_who_sticks_and_who_rebounds():
    traces = {method: pd.vertex_and_plane(method) for method in pd.METHODS}
    assert traces["pd"].heights.min() < 0  # sinks in
    for method in pd.METHODS[1:]:
        assert traces[method].heights.min() >= 0
    # truncated without a constraint: stays at the plane for good
    assert np.abs(traces["pd+ccd"].heights[10:]).max() < 1e-6
    assert traces["eq6"].velocities.max() > 0.1
    assert traces["barrier"].heights[-10:].max() < 5e-3  # inelastic, as implicit Euler has it


def test_vertex_on_the_barrier_carries_its_weight():
    trace = pd.vertex_and_plane("barrier", velocity=0.0, height=4e-3, steps=400, iterations=50)
    d, d_hat, kappa = trace.heights[-1], 5e-3, 100 / H**2
    s = d - d_hat
    assert kappa * (2 * s * np.log(d / d_hat) + s * s / d) == pytest.approx(G, rel=1e-3)
