"""External forces on the device against the same formulas in NumPy."""

import numpy as np
import pytest
import warp as wp

import pdipc
from pdipc.forces import Loads
from pdipc.model import build

from .scenes import cloth, floor, scene, solid

FORCES = [
    {"kind": "wind", "velocity": [3.0, 1.0, -2.0], "start": 0.5},
    {"kind": "wind", "velocity": [0.0, 0.0, 4.0], "end": 1.0, "bodies": ["sheet"], "drag": 0.4},
    {"kind": "vertices", "body": "block", "select": {"all": True}, "force": [0.0, 2.0, 0.0], "start": 0.2, "end": 0.7},
]


def blown(precision):
    bodies = [cloth("sheet", [0.4, 0.4], [5, 5], at=(0, 1, 0)), solid("block", [0.1, 0.1, 0.1], [2, 2, 2])]
    return pdipc.Scene(bodies=bodies, forces=FORCES, simulation={"precision": precision})


@pytest.mark.parametrize("precision,tolerance", [("float64", 1e-13), ("float32", 1e-5)])
def test_loads_are_those_of_the_formulas(precision, tolerance):
    """In every window of time, for moving vertices, with a pull by hand that is replaced and let go."""
    model = build(blown(precision), "cpu")
    loads, rng = Loads(model.device, model.real, model.external), np.random.default_rng(0)
    pulls = {0.0: (), 0.25: ([0, 3, 3], 5.0), 0.6: ([1], -1.0), 0.8: (), 1.2: ()}
    seen = []
    for time, pull in pulls.items():
        vertices, size = (pull or ([], 0.0))[:2]
        model.external.pulled = (np.array(vertices, dtype=np.int64), size * rng.standard_normal((len(vertices), 3)))
        x = (model.assembly.positions + 0.05 * rng.standard_normal((model.vertex_count, 3))).astype(model.real.numpy)
        v = rng.standard_normal(x.shape).astype(model.real.numpy)
        loads.update(time, *(wp.array(each, dtype=model.real.vec3, device="cpu") for each in (x, v)))
        expected = model.external.accelerations(time, x.astype(np.float64), v.astype(np.float64))
        np.testing.assert_allclose(loads.acceleration.numpy(), expected, atol=tolerance * np.abs(expected).max())
        seen.append(np.abs(expected - model.external.gravity).max())
    assert min(seen) > 0.1  # some wind or force acts at each time


def test_a_pull_that_is_let_go_no_longer_acts():
    body = solid("block", [0.1, 0.1, 0.1], [1, 1, 1])
    simulation = pdipc.Simulation(scene([body], [], gravity=[0.0, 0.0, 0.0]), "cpu")
    weight = simulation.model.external.mass.sum()
    every = np.arange(8)
    speeds = []
    for force in (1.0, 0.0):
        mass = simulation.model.external.mass
        pull = (every, mass[:, None] * [force, 0.0, 0.0]) if force else (every[:0], np.zeros((0, 3)))
        simulation.set_vertex_force(*pull)
        for _ in range(3):
            simulation.step()
        speeds.append((mass @ simulation.state.velocities.numpy())[0] / weight)
    h = simulation.model.settings.time_step
    assert speeds == pytest.approx([3 * h, 3 * h], rel=1e-6)


@pytest.mark.parametrize(
    ("vertices", "forces", "told"),
    [
        ([0], [[0.0, np.nan, 0.0]], "the force on vertex 0 is .*nan.*finite"),
        ([0, 1], [[0.0, 1.0, 0.0]], r"\(2,\) vertices and \(1, 3\) forces"),
        ([-1], [[0.0, 1.0, 0.0]], "there is no vertex -1"),
        ([1000], [[0.0, 1.0, 0.0]], "there is no vertex 1000"),
        ([27], [[0.0, 1.0, 0.0]], "vertex 27 follows a script"),
        ([0.5], [[0.0, 1.0, 0.0]], "vertices are float64; they must be whole numbers"),
        (["0"], [[0.0, 1.0, 0.0]], "they must be whole numbers"),
    ],
)
def test_bad_pulls_are_refused(vertices, forces, told):
    made = scene([solid("block", [0.1, 0.1, 0.1], [2, 2, 2], at=(0, 1, 0))], [floor()])
    simulation = pdipc.Simulation(made, "cpu")
    with pytest.raises(ValueError, match=told):
        simulation.set_vertex_force(vertices, forces)


def test_a_force_that_is_no_number_ends_the_step_where_it_began():
    """Should one arise in spite of all, the step says so and keeps the last state."""
    simulation = pdipc.Simulation(scene([solid("block", [0.1, 0.1, 0.1], [2, 2, 2], at=(0, 1, 0))]), "cpu")
    before = simulation.positions
    simulation.model.external.pulled = (np.array([3]), np.array([[0.0, np.nan, 0.0]]))
    result = simulation.step()
    assert not result.converged
    assert "not finite" in result.message
    assert np.array_equal(simulation.positions, before)
