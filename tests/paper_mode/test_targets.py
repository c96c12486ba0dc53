"""The paper's mode: Eq. (6), its weights and its stopping, against the formulas."""

import numpy as np
import pytest
import warp as wp
from physics.scenes import Witness, floor, scene, solid, watched

import pdipc
from pdipc.drive import Work


def near_floor(**contact):
    """A block 0.5 mm above the floor, d_hat = 1 mm: its lowest vertices' pairs are active."""
    block = solid("block", (0.1, 0.1, 0.1), (2, 2, 2), at=(0, 0.0505, 0))
    contact = {"method": "paper", "activation_distance": 1e-3, "minimum_separation": 1e-6, **contact}
    return scene([block], [floor(0.5)], contact=contact, time_step=0.01)


def frozen(model, motion, fraction=None):
    """Work with the pairs frozen at the start, of which `motion` (n, 3) is expected."""
    work, x = Work(model), model.initial_state().positions
    x_tilde = wp.array(x.numpy() + motion, dtype=model.real.vec3, device="cpu")
    made = None if fraction is None else wp.full(model.vertex_count, model.real.scalar(fraction), device="cpu")
    work.pairs.expect(x, x_tilde, made)
    work.list_pairs(x)
    return work, x


@pytest.mark.parametrize("eps", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("fraction", [None, 0.25])
def test_targets_are_those_of_eq_6(eps, fraction):
    """Against a floor: y = x + (1 - t_I) (I - (1 + eps) n n^T) motion for vertices that approach."""
    model = pdipc.build(near_floor(restitution=eps), "cpu")
    motion = np.zeros((model.vertex_count, 3))
    motion[:27] = [0.002, -0.01, 0.001]
    work, x = frozen(model, motion, fraction)
    lowest = np.flatnonzero(x.numpy()[:27, 1] < 1e-3)
    assert len(lowest) == 9
    weight, drag = work.pairs.scalar.numpy(), work.pairs.drag.numpy()
    left = 1.0 if fraction is None else 1.0 - fraction
    expected = left * np.array([0.002, eps * 0.01, 0.001])
    for v in lowest:
        assert weight[v] > 0.0
        np.testing.assert_allclose(drag[v] / weight[v], expected, rtol=1e-9, atol=1e-15)  # y - x
    others = np.setdiff1d(np.arange(model.vertex_count), lowest)
    assert np.all(weight[others] == 0.0)


def test_weights_are_the_barrier_and_the_mass():
    """w = kappa b(d) / d_hat^2 + least m / h^2, with b of Eq. (4), times the vertex's part in each pair."""
    model = pdipc.build(near_floor(), "cpu")
    work, x = frozen(model, np.zeros((model.vertex_count, 3)))
    d, d_hat = work.pairs.gaps.numpy()[0], work.pairs.activation.numpy()[0]
    assert d == pytest.approx(0.5e-3 - 1e-6, rel=1e-6)
    barrier = -((d - d_hat) ** 2) * np.log(d / d_hat)
    mass, count = model.mass.numpy(), int(work.pairs.count.numpy()[0])
    quads, shares = work.pairs.quads.numpy()[:count], np.abs(work.pairs.weights.numpy()[:count])
    stiffness = work.pairs.stiffness.numpy()[:count]
    assert stiffness.max() == pytest.approx(model.kappa.numpy()[0])
    lightest = np.where(model.free.numpy()[quads] > 0, mass[quads], np.inf).min(axis=1)
    for v in np.flatnonzero(x.numpy()[:27, 1] < 1e-3):
        part = np.where(quads == v, shares, 0.0).sum(axis=1)
        expected = (part * (stiffness * barrier / d_hat**2 + lightest / 0.01**2)).sum()
        assert work.pairs.scalar.numpy()[v] == pytest.approx(expected, rel=1e-9)


def test_bodies_that_part_are_not_turned_back():
    model = pdipc.build(near_floor(restitution=1.0), "cpu")
    motion = np.zeros((model.vertex_count, 3))
    motion[:27] = [0.002, 0.01, 0.001]
    work, x = frozen(model, motion)
    for v in np.flatnonzero(x.numpy()[:27, 1] < 1e-3):
        np.testing.assert_allclose(work.pairs.drag.numpy()[v] / work.pairs.scalar.numpy()[v], motion[v], rtol=1e-9)


def test_impulses_of_a_pair_add_up_to_nothing():
    """The rebound is split by inverse mass: the targets of a pair have the momentum of its motion."""
    low = solid("low", (0.1, 0.1, 0.1), (2, 2, 2), at=(0, 0, 0))
    top = solid("top", (0.1, 0.1, 0.1), (1, 1, 1), at=(0.013, 0.1005, 0.021), rotation=(0, 20, 0), density=3000.0)
    contact = {"method": "paper", "activation_distance": 1e-3, "restitution": 0.5}
    model = pdipc.build(scene([low, top], contact=contact), "cpu")
    motion = np.where(np.arange(model.vertex_count)[:, None] < 27, [0.0, 0.004, 0.0], [0.001, -0.006, 0.0])
    work, _ = frozen(model, motion)
    pairs, mass = work.pairs, model.mass.numpy()
    count = int(pairs.count.numpy()[0])
    assert count > 4
    for q, a, n, impulse in zip(
        *(array.numpy()[:count] for array in (pairs.quads, pairs.weights, pairs.normals, pairs.impulse)), strict=True
    ):
        after = motion[q] + (a * impulse / mass[q])[:, None] * n
        np.testing.assert_allclose((mass[q, None] * after).sum(axis=0), (mass[q, None] * motion[q]).sum(axis=0), atol=1e-12)
        before_n, after_n = (a[:, None] * motion[q]).sum(axis=0) @ n, (a[:, None] * after).sum(axis=0) @ n
        if before_n < 0:
            assert after_n == pytest.approx(-0.5 * before_n, rel=1e-9)
        else:
            assert impulse == 0.0


def test_energy_is_that_of_the_targets():
    """The gathered energy of the constraints, and its gradient, which linearize adds."""
    model = pdipc.build(near_floor(restitution=0.5), "cpu")
    motion = np.zeros((model.vertex_count, 3))
    motion[:27] = [0.002, -0.01, 0.001]
    work, x = frozen(model, motion)
    rng = np.random.default_rng(0)
    place = x.numpy() + 1e-3 * rng.standard_normal((model.vertex_count, 3))

    def energy(at):
        out = wp.zeros(model.vertex_count, dtype=wp.float64, device="cpu")
        work.pairs.vertex_energy(x, wp.array(at, dtype=wp.vec3d, device="cpu"), out)
        return out.numpy().sum()

    force = wp.zeros(model.vertex_count, dtype=wp.vec3d, device="cpu")
    work.pairs.linearize(x, wp.array(place, dtype=wp.vec3d, device="cpu"), x, force)
    direction = rng.standard_normal(place.shape)
    step = 1e-6
    slope = (energy(place + step * direction) - energy(place - step * direction)) / (2 * step)
    assert slope == pytest.approx(-(force.numpy() * direction).sum(), rel=1e-6)
    target = x.numpy() + np.divide(
        work.pairs.drag.numpy(),
        work.pairs.scalar.numpy()[:, None],
        where=work.pairs.scalar.numpy()[:, None] > 0,
        out=np.zeros_like(place),
    )
    assert energy(target) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("solver", ["auto", "pcg", "two-level", "chebyshev", "sor"])
def test_every_solver_gives_the_same_step(solver):
    """Scalar diagonals go to every solver; the paper's is A-Jacobi."""

    def run(**simulation):
        block = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 0.105, 0), rotation=(0, 0, 0), velocity=(0, -1, 0))
        made = watched(
            scene(
                [block],
                [floor()],
                contact={"method": "paper", "activation_distance": 2e-3},
                linear_tolerance=1e-9,
                linear_iterations=2000,
                **simulation,
            )
        )
        made.step()
        return made.positions

    np.testing.assert_allclose(run(linear_solver=solver), run(linear_solver="gauss-seidel"), atol=1e-7)


def test_a_body_at_rest_begins_to_fall():
    """As printed the outer loop is never entered where the predictor does not move: the body would hang in the air."""
    made = pdipc.Simulation(scene([solid("block", (0.1, 0.1, 0.1), (1, 1, 1))], contact={"method": "paper"}), "cpu")
    for _ in range(10):
        made.step()
    assert made.state.velocities.numpy()[:, 1] == pytest.approx(-0.981, rel=1e-6)


def test_resting_contact_is_feasible_and_wrong_in_the_way_that_is_documented():
    """The block is not held at the barrier's distance: truncation stops it, ever nearer. The guarantee holds all the same."""
    block = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 0.11, 0))
    contact = {"activation_distance": 2e-3}
    gaps = {}
    for method in ("paper", "barrier"):
        made = pdipc.Simulation(scene([block], [floor()], contact={**contact, "method": method}), "cpu")
        made.observe = Witness(made)
        for _ in range(60):
            result = made.step()
        gaps[method] = result.smallest_gap
    assert gaps["barrier"] > 1e-3
    assert 0.0 < gaps["paper"] < 1e-4
