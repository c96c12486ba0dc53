"""The IPC baseline against mechanics: it is the reference that the simulator is compared with."""

import numpy as np
import pytest

pytest.importorskip("ipctk", reason="needs ipctk (extra: benchmarks)")
pytest.importorskip("cholespy", reason="needs cholespy (extra: benchmarks)")

from pdipc.baselines import common, contact, energies, ipc

G, H, D_HAT, XI = 9.81, 0.01, 2e-3, 4e-5


def scene(cells=(2, 2, 2), size=0.2, gap=1e-3, mu=2e4, friction=0.0, squared=False, velocity=(0, 0, 0), tilt=0.0):
    """A soft block above a floor of two triangles; the plane falls by `tilt` radians towards +x, as gravity's frame sees it."""
    x, tets = common.box((size,) * 3, cells, (0, size / 2 + gap + XI, 0))
    ground, faces = common.sheet((4, 4), (1, 1))
    n = len(x)
    rest = np.concatenate([x, ground])
    volumes = energies.tet_volumes(rest, tets)
    masses = common.lumped_tet_masses(len(rest), tets, volumes, 1000.0)
    kinematic = np.arange(len(rest)) >= n
    surface = contact.Surface(rest, np.concatenate([common.boundary(tets), faces + n]), kinematic)
    kappa = np.where(kinematic, 0.0, masses[:n].mean() / H**2)
    if squared:
        touching = contact.SquaredDistanceBarrier(surface, rest, activation=D_HAT, mass=masses[:n].mean())
    else:
        touching = contact.DistanceBarrier(
            surface, rest, stiffness=kappa, activation=D_HAT, separation=XI, body=kinematic.astype(int), friction=friction
        )
    gravity = (G * np.sin(tilt), -G * np.cos(tilt), 0.0)
    terms = [energies.tet_strain(rest, tets, 2 * mu * volumes), energies.tet_volume(rest, tets, mu * volumes)]
    problem = ipc.Problem(masses, terms, H, kinematic, touching, gravity)
    velocities = np.where(kinematic[:, None], 0.0, np.asarray(velocity, dtype=float))
    return problem, ipc.State(rest.copy(), velocities)


def mean(problem, values):
    return problem.masses @ values / problem.masses.sum()


def advance(problem, state, steps, **options):
    """Steps, each of which must converge, lower its energy in every search and stay free of intersections."""
    infos = []
    for _ in range(steps):
        state, info = ipc.step(problem, state, **options)
        assert info.converged
        assert all(after <= limit for _, after, limit in info.energies)
        assert all(limit - before <= 1e-9 * problem.masses.sum() for before, _, limit in info.energies)  # only rounding, J a kg
        assert not problem.contact.surface.intersects(state.positions)
        infos.append(info)
    return state, infos


def test_free_fall_is_exact_to_implicit_euler():
    problem, state = scene(gap=1.0, velocity=(1.0, 2.0, -0.5))
    start, steps = mean(problem, state.positions), 10
    state, infos = advance(problem, state, steps, tolerance=1e-10)
    expected = start + steps * H * np.array([1.0, 2.0, -0.5]) + 0.5 * steps * (steps + 1) * H * H * np.array([0, -G, 0])
    np.testing.assert_allclose(mean(problem, state.positions), expected, atol=1e-10)
    assert max(info.iterations for info in infos) <= 2


@pytest.mark.parametrize("squared", [False, True])
def test_dropped_block_comes_to_rest_and_the_floor_carries_it(squared):
    problem, state = scene(squared=squared)
    problem.damping = 10.0
    problem.__post_init__()
    state, _ = advance(problem, state, 60, tolerance=1e-8)
    assert np.abs(state.velocities).max() < 1e-3
    gradient, _ = problem.contact.derivatives(state.positions)
    weight = problem.masses.sum() * G
    np.testing.assert_allclose(-gradient[problem.free, 1].sum(), weight, rtol=1e-2)
    np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-9 * weight)


def test_impact_with_tight_tolerance():
    problem, state = scene(velocity=(0.3, -2.0, 0.1))
    _, infos = advance(problem, state, 8, tolerance=1e-10)
    assert min(info.smallest_gap for info in infos) > 0
    assert max(info.residual for info in infos) <= 1e-10


def test_block_slides_down_a_slope_as_coulomb_says():
    tilt, mu, steps = np.radians(30), 0.3, 30
    problem, state = scene(cells=(1, 1, 1), gap=0.0006, mu=1e6, friction=mu, tilt=tilt)
    state, _ = advance(problem, state, 10, friction_iterations=10)
    early = mean(problem, state.velocities)[0]
    state, _ = advance(problem, state, steps, friction_iterations=10)
    acceleration = (mean(problem, state.velocities)[0] - early) / (steps * H)
    assert acceleration == pytest.approx(G * (np.sin(tilt) - mu * np.cos(tilt)), rel=0.02)


def test_a_rising_floor_lifts_the_block():
    problem, state = scene()
    targets = state.positions.copy()
    for _ in range(5):
        targets[problem.kinematic, 1] += 0.02  # ten times d_hat a step
        state, info = ipc.step(problem, state, targets=targets)
        assert info.converged
        assert info.lag == 0.0
        assert not problem.contact.surface.intersects(state.positions)
    assert state.positions[problem.free, 1].min() > 0.1


@pytest.mark.parametrize("squared", [False, True])
def test_derivatives_of_the_barrier(squared):
    """Two blocks turned against each other so that vertices, edges and faces meet; the mollifier frozen."""
    x, tets = common.box((0.2,) * 3, (1, 1, 1))
    angle = np.radians([30.0, 25.0])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c[0], -s[0], 0], [s[0], c[0], 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c[1], -s[1]], [0, s[1], c[1]]])
    faces = common.boundary(tets)
    other = x @ turn.T
    other[:, 1] += 0.1 - other[:, 1].min() + 0.01
    rest = np.concatenate([x, other])
    surface = contact.Surface(rest, np.concatenate([faces, faces + len(x)]), np.zeros(len(rest), dtype=bool))
    if squared:
        touching = contact.SquaredDistanceBarrier(surface, rest, activation=0.06, mass=1.0)
        touching.stiffness = 1e3
    else:
        body = np.repeat([0, 1], len(x))
        touching = contact.DistanceBarrier(surface, rest, stiffness=10.0, activation=0.06, separation=1e-3, body=body)
        assert {True, False} == {bool(k) for k in np.ptp(touching.pairs(rest).slope, axis=2).min(axis=1)}
    gradient, hessian = touching.derivatives(rest, psd=False)
    projected = touching.derivatives(rest)[1].toarray()
    assert np.linalg.eigvalsh(0.5 * (projected + projected.T)).min() > -1e-8 * np.abs(projected).max()
    step = 1e-6
    numeric, second = np.zeros(rest.size), np.zeros((rest.size, rest.size))
    for i in range(rest.size):
        e = np.zeros(rest.size)
        e[i] = step
        up, down = rest + e.reshape(-1, 3), rest - e.reshape(-1, 3)
        numeric[i] = (touching.energy(up, rest) - touching.energy(down, rest)) / (2 * step)
        second[i] = (touching.derivatives(up)[0] - touching.derivatives(down)[0]).ravel() / (2 * step)
    np.testing.assert_allclose(gradient.ravel(), numeric, atol=1e-5 * np.abs(numeric).max())
    np.testing.assert_allclose(hessian.toarray(), second, atol=1e-3 * np.abs(second).max())
