"""Barrier and friction as terms of a potential: forces and Hessians against differences, over random pairs of triangles."""

import numpy as np
import pytest
import warp as wp
from physics.scenes import scene

import pdipc
from pdipc.work import Work

PAIRS, D_HAT, STEP = 12, 0.05, 1e-7  # triangles of 0.3 m, the step of differences in m
PARALLEL = 1e-3  # squared sine below which a pair of edges is mollified


def near_triangles(rng, turned):
    """Two sheets of PAIRS loose triangles, each 5 mm to 5 cm above one of the other, 1 m apart; turned: by an angle, or at random."""
    low, high, faces = [], [], np.arange(3 * PAIRS).reshape(-1, 3)
    for k in range(PAIRS):
        angle = rng.uniform(0, 2 * np.pi) + np.array([0, 2.1, 4.2]) + rng.uniform(-0.3, 0.3, 3)
        a = np.stack([0.3 * np.cos(angle), rng.uniform(-0.02, 0.0, 3), 0.3 * np.sin(angle)], axis=1)
        by = rng.uniform(0.3, 1.5) if turned is None else np.radians(turned * rng.uniform(0.3, 1.0))
        turn = np.array([[np.cos(by), 0, np.sin(by)], [0, 1, 0], [-np.sin(by), 0, np.cos(by)]])
        low.append(a + np.array([k, 0, 0]))
        high.append(a @ turn.T * [1, 0.5, 1] + [k + rng.uniform(-0.01, 0.01), rng.uniform(0.02, 0.035), 0.01])
    bodies = [
        {"name": name, "kind": "cloth", "mesh": {"vertices": np.concatenate(x).tolist(), "triangles": faces.tolist()}}
        for name, x in (("low", low), ("high", high))
    ]
    for body in bodies:
        body["friction"] = 0.4
    contact = {"activation_distance": D_HAT, "friction_velocity": 0.1}
    return pdipc.build(scene(bodies, contact=contact, time_step=0.01), "cpu")


@pytest.fixture(params=[None, 1.5], ids=["any angle", "near-parallel"])
def work(request):
    model = near_triangles(np.random.default_rng(5), request.param)
    work = Work(model)
    work.list_pairs(model.initial_state().positions)
    assert int(work.pairs.count.numpy()[0]) > 5 * PAIRS
    return work


def upload(x):
    return wp.array(x, dtype=wp.vec3d, device="cpu")


def start(work):
    return work.model.initial_state().positions.numpy()


def barrier(work, x):
    """The energy, J, and the forces, N, at x."""
    work.list_pairs(upload(x))
    work.pairs.differentiate(upload(x))
    return work.pairs.energy_of_vertex.numpy().sum(), work.pairs.force_of_vertex.numpy().copy()


def applied(term, p):
    y = wp.zeros(len(p), dtype=wp.vec3d, device="cpu")
    term.apply(upload(p), y)
    return y.numpy()


def flag(value):
    return wp.array([value], dtype=wp.int32, device="cpu")


def assert_slope(plus, minus, step, force, direction, relative=1e-5):
    assert (plus - minus) / (2 * step) == pytest.approx(-(force * direction).sum(), rel=relative)


def mollified(work):
    """Which pairs are edges with the mollifier at work."""
    count, _, first = work.pairs.count.numpy()
    x, quads = start(work), work.pairs.quads.numpy()[:count]
    e1, e2 = x[quads[:, 1]] - x[quads[:, 0]], x[quads[:, 3]] - x[quads[:, 2]]
    c = (np.cross(e1, e2) ** 2).sum(axis=1) / ((e1**2).sum(axis=1) * (e2**2).sum(axis=1) * PARALLEL)
    return np.flatnonzero((np.arange(count) >= first) & (c < 1.0))


def test_barrier_forces_are_the_negative_gradient(work):
    x, rng = start(work), np.random.default_rng(0)
    _, force = barrier(work, x)
    for _ in range(4):
        direction = rng.standard_normal(x.shape)
        plus, minus = (barrier(work, x + sign * STEP * direction)[0] for sign in (1, -1))
        assert_slope(plus, minus, STEP, force, direction)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12 * np.abs(force).sum())
    np.testing.assert_allclose(np.cross(x, force).sum(axis=0), 0.0, atol=1e-12 * np.abs(force).sum() * PAIRS)


def test_barrier_hessian_is_the_derivative_of_the_forces():
    """As it is, where no edges are near-parallel: with what turns the normal and moves the witness points."""
    model = near_triangles(np.random.default_rng(6), None)
    work, x, rng = Work(model), model.initial_state().positions.numpy(), np.random.default_rng(1)
    barrier(work, x)
    assert not len(mollified(work))
    work.pairs.project = flag(0)
    for _ in range(4):
        p = rng.standard_normal(x.shape)
        barrier(work, x)
        found = applied(work.pairs, p)
        expected = -(barrier(work, x + STEP * p)[1] - barrier(work, x - STEP * p)[1]) / (2 * STEP)
        assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def test_a_mollified_pairs_hessian_is_the_positive_part():
    """Of B as a function of d and c: k J^T (d2 s) J with its one negative eigenvalue set to zero, s = c (2 - c) b(d)."""
    work = Work(near_triangles(np.random.default_rng(5), 1.5))
    pairs, x = work.pairs, start(work)
    barrier(work, x)
    chosen = mollified(work)
    assert len(chosen) > 5
    names = ("quads", "weights", "normals", "gaps", "activation", "stiffness", "lever", "hessian", "slope")
    of = {name: getattr(pairs, name).numpy() for name in names}

    def c_of(points):
        e1, e2 = points[1] - points[0], points[3] - points[2]
        return (np.cross(e1, e2) ** 2).sum() / ((e1**2).sum() * (e2**2).sum() * PARALLEL)

    for k in chosen:
        points, d, d_hat = x[of["quads"][k]], of["gaps"][k], of["activation"][k]
        turn = np.zeros(12)
        for i, e in enumerate(np.eye(12).reshape(12, 4, 3)):
            turn[i] = (c_of(points + 1e-7 * e) - c_of(points - 1e-7 * e)) / 2e-7
        jacobian = np.stack([np.outer(of["weights"][k], of["normals"][k]).ravel(), turn])
        c = c_of(points)
        kappa = of["stiffness"][k] / (c * (2 - c))
        log, s = np.log(d / d_hat), d - d_hat
        b0, b1, b2 = -s * s * log, -2 * s * log - s * s / d, -2 * log - 4 * s / d + (s / d) ** 2
        second = np.array([[c * (2 - c) * b2, b1 * (2 - 2 * c)], [b1 * (2 - 2 * c), -2 * b0]])
        exact = kappa * jacobian.T @ second @ jacobian
        value, vector = np.linalg.eigh(exact)
        expected = vector @ np.diag(np.maximum(value, 0)) @ vector.T
        lever = of["lever"][k].ravel()
        found = of["hessian"][k] * np.outer(lever, lever)
        assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
        gradient = kappa * (np.array([c * (2 - c) * b1, (2 - 2 * c) * b0]) @ jacobian)
        np.testing.assert_allclose(of["slope"][k].ravel(), gradient, atol=1e-6 * np.abs(gradient).max())


def dense(term, n):
    return np.stack([applied(term, e.reshape(n, 3)).ravel() for e in np.eye(3 * n)], axis=1)


def test_projected_barrier_hessian_is_symmetric_and_positive(work):
    x = start(work)
    barrier(work, x)
    work.pairs.project = flag(1)
    h = dense(work.pairs, len(x))
    assert np.abs(h - h.T).max() < 1e-12 * np.abs(h).max()
    assert np.linalg.eigvalsh(h)[0] > -1e-10 * np.abs(h).max()
    blocks = h.reshape(len(x), 3, len(x), 3)[np.arange(len(x)), :, np.arange(len(x))]
    np.testing.assert_allclose(work.pairs.diagonal.numpy(), blocks, atol=1e-12 * np.abs(h).max())


@pytest.mark.parametrize("slip", [0.3, 1.0, 5.0], ids=["sticking", "at the threshold", "sliding"])
def test_friction_is_a_potential_of_the_slip(work, slip):
    """Forces and Hessians of lagged friction; where it is to be a bound, it lies above the exact one."""
    x, rng = start(work), np.random.default_rng(2)
    barrier(work, x)
    term = work.method.friction
    term.grow()
    term.lag()
    u = slip * work.model.settings.slip_threshold * rng.standard_normal(x.shape)
    step = 1e-5 * work.model.settings.slip_threshold

    def at(u, project=0):
        term.differentiate(upload(u), flag(project))
        return term.energy_of_vertex.numpy().sum(), term.force_of_vertex.numpy().copy()

    for _ in range(3):
        p = rng.standard_normal(x.shape)
        (plus, force_plus), (minus, force_minus) = at(u + step * p), at(u - step * p)
        _, force = at(u)
        assert_slope(plus, minus, step, force, p)
        assert np.abs(applied(term, p) + (force_plus - force_minus) / (2 * step)).max() < 1e-3 * np.abs(applied(term, p)).max()
        assert (force * u).sum() < 0.0  # it takes energy
    exact = dense(term, len(x))
    at(u, 1)
    bound = dense(term, len(x))
    assert np.linalg.eigvalsh(bound - exact)[0] > -1e-10 * np.abs(bound).max()
    assert np.linalg.eigvalsh(exact)[0] > -1e-10 * np.abs(bound).max()


def test_friction_is_bounded_by_coulombs_law(work):
    """Of each pair: mu times the normal force where it slides, proportionally less where it sticks."""
    x = start(work)
    barrier(work, x)
    term = work.method.friction
    term.grow()
    term.lag()
    u = np.random.default_rng(3).standard_normal(x.shape)  # far beyond the threshold
    term.differentiate(upload(u), flag(0))
    count = int(work.pairs.count.numpy()[0])
    slope = np.linalg.norm(work.pairs.slope.numpy()[:count].sum(axis=1), axis=1)
    plain = np.setdiff1d(np.arange(count), mollified(work))
    weights, lever = work.pairs.weights.numpy()[plain], work.pairs.slope.numpy()[plain]
    largest = np.abs(weights).argmax(axis=1)
    rows = np.arange(len(plain))
    normal = np.linalg.norm(lever[rows, largest], axis=1) / np.abs(weights[rows, largest])
    assert slope.max() < 1e-9 * normal.max()  # the forces of a pair add up to nothing
    np.testing.assert_allclose(np.linalg.norm(term.force.numpy()[plain], axis=1), 0.4 * normal, rtol=1e-9)


@pytest.mark.parametrize("projected", [1, 0])
def test_rows_make_the_same_product(work, projected):
    """The assembled Hessian against pair by pair; a motion of all vertices together is felt by neither."""
    rng, x = np.random.default_rng(8), start(work)
    barrier(work, x)
    pairs, friction = work.method.pairs, work.method.friction
    pairs.freeze(work.candidates, upload(x))
    pairs.project = flag(projected)
    pairs.differentiate(upload(x))
    friction.lag()
    friction.differentiate(upload(1e-4 * rng.standard_normal(x.shape)), flag(projected))
    for term in (pairs, friction):
        rows = term.assemble(len(term.ends))
        ends, lengths, columns, values = (a.numpy() for a in (rows.ends, rows.lengths, rows.columns, rows.values))
        assert lengths.max() > 2
        for p in (rng.standard_normal(x.shape), np.ones_like(x)):
            product = np.zeros_like(p)
            for i, length in enumerate(lengths):
                low = 3 * (ends[i - 1] if i else 0)
                own = columns[low : low + length]
                assert len(np.unique(own)) == length
                product[i] = np.einsum("eij,ej->i", values[low : low + length], p[own] - p[i])
            expected = applied(term, p)
            scale = np.abs(values).max()
            assert np.abs(product - expected).max() < 1e-11 * scale
