"""External forces on the device against the same formulas in NumPy."""

import numpy as np
import pytest
import warp as wp
from physics.scenes import cloth, floor, scene, solid

import pdipc
from pdipc.integration.loads import Loads
from pdipc.model import build

FORCES = [
    {"kind": "wind", "velocity": [3.0, 1.0, -2.0], "start": 0.5},
    {"kind": "wind", "velocity": [0.0, 0.0, 4.0], "end": 1.0, "bodies": ["sheet"], "drag": 0.4},
    {"kind": "wind", "velocity": [10.0, 90.0, 0.0], "start": 1.1},  # which gives way within the step
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
        loads.external.pulled = (np.array(vertices, dtype=np.int64), size * rng.standard_normal((len(vertices), 3)))
        x = (model.assembly.positions + 0.05 * rng.standard_normal((model.vertex_count, 3))).astype(model.real.numpy)
        v = rng.standard_normal(x.shape).astype(model.real.numpy)
        loads.update(time, *(wp.array(each, dtype=model.real.vec3, device="cpu") for each in (x, v)))
        expected = loads.external.accelerations(time, x.astype(np.float64), v.astype(np.float64))
        np.testing.assert_allclose(loads.acceleration.numpy(), expected, atol=tolerance * np.abs(expected).max())
        seen.append(np.abs(expected - model.external.gravity).max())
    assert min(seen) > 0.1  # some wind or force acts at each time


def free_plate(speed, h, steps, precision="float64"):
    """(steps,) m/s: of a free cloth that wind of the given speed meets head-on; and the largest of a vertex."""
    wind = [{"kind": "wind", "velocity": [0.0, speed, 0.0]}]
    simulation = {"precision": precision, "time_step": h, "gravity": [0.0, 0.0, 0.0]}
    made = pdipc.Scene(bodies=[cloth("sheet", [1.0, 1.0], [4, 4])], forces=wind, simulation=simulation)
    run = pdipc.Simulation(made, "cpu")
    mass = run.model.external.mass
    mean, largest = np.zeros(steps), 0.0
    for step in range(steps):
        assert run.step().converged
        velocities = run.state.velocities.numpy().astype(np.float64)
        mean[step] = mass @ velocities[:, 1] / mass.sum()
        largest = max(largest, np.linalg.norm(velocities, axis=1).max())
    return mean, largest


def exact_speed(speed, time):
    """dv/dt = k (U - v)^2 from rest, with k = air_density drag / (2 areal_density) of the default cloth."""
    k = 0.5 * 1.2 / 0.2
    return speed * k * speed * time / (1.0 + k * speed * time)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("speed", [10.0, 40.0, 100.0, 1000.0])
def test_no_wind_drives_a_free_plate_past_the_air(speed, precision):
    """It gains on the air in every step, and is never further than a sixth of the wind's speed from the exact solution."""
    h = 0.01
    mean, largest = free_plate(speed, h, 50, precision)
    assert np.all(np.diff(mean) > 0.0)
    assert 0.9 * speed < mean[-1] <= largest < speed
    assert np.abs(mean - exact_speed(speed, h * np.arange(1, 51))).max() < speed / 6.0


def test_the_error_of_a_free_plate_halves_with_the_step():
    """Below 4 % of the wind's speed at k h U = 0.15, and so on."""
    errors = []
    for h in (5e-4, 2.5e-4, 1.25e-4):
        steps = round(0.02 / h)
        mean, _ = free_plate(100.0, h, steps)
        errors.append(np.abs(mean - exact_speed(100.0, h * np.arange(1, steps + 1))).max() / 100.0)
    assert errors[0] < 0.04
    assert [errors[0] / errors[1], errors[1] / errors[2]] == pytest.approx([2.0, 2.0], abs=0.2)


def test_a_cloth_that_gravity_and_wind_carry_comes_to_its_terminal_speed():
    """That of the formula, where drag balances weight: drag is not weakened where it is weak."""
    weight, rate = 0.2 * 9.81, 0.5 * 1.2
    body = cloth("sheet", [1.0, 1.0], [4, 4])
    still = [{"kind": "wind", "velocity": [0.0, 0.0, 0.0]}]
    simulation = pdipc.Simulation(pdipc.Scene(bodies=[body], forces=still, simulation={"precision": "float64"}), "cpu")
    for _ in range(150):
        simulation.step()
    assert simulation.state.velocities.numpy()[:, 1] == pytest.approx(-np.sqrt(weight / rate), rel=1e-4)


def test_a_held_cloth_in_a_storm_is_no_faster_than_the_air():
    speed = 100.0
    body = cloth("flag", [1.0, 1.0], [6, 6], pins=[{"select": {"box": [[-1, -1, -1], [-0.49, 1, 1]]}}])
    wind = [{"kind": "wind", "velocity": [0.7 * speed, 0.5 * speed, 0.5 * speed]}]
    simulation = pdipc.Simulation(pdipc.Scene(bodies=[body], forces=wind, simulation={"precision": "float64"}), "cpu")
    for _ in range(30):
        simulation.step()
        assert np.linalg.norm(simulation.state.velocities.numpy(), axis=1).max() < speed


def test_a_pull_that_is_let_go_no_longer_acts():
    body = solid("block", [0.1, 0.1, 0.1], [1, 1, 1])
    simulation = pdipc.Simulation(scene([body], [], gravity=[0.0, 0.0, 0.0], tolerance=1e-8), "cpu")
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
    simulation.work.loads.external.pulled = (np.array([3]), np.array([[0.0, np.nan, 0.0]]))
    result = simulation.step()
    assert not result.converged
    assert "not finite" in result.message
    assert np.array_equal(simulation.positions, before)
