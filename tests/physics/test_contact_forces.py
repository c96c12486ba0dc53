"""Forces of contact in a step against mechanics: balance, reaction, Coulomb's law, a held ball, a couple."""

import numpy as np
import pytest

import pdipc
from pdipc.output.forces import ContactForces

from .scenes import floor, scene, solid

G = 9.81
H = 0.01
NEAR = {"activation_distance": 2e-3}


def block(name="block", at=(0.0, 0.1015, 0.0), **more):
    """8 kg."""
    return solid(name, (0.2, 0.2, 0.2), (2, 2, 2), at=at, young=1e6, **more)


def stepped(made, steps):
    """The simulation, and the result and the change of momentum over H, (n, 3) N, of its last step."""
    simulation = pdipc.Simulation(made, "cpu")
    for _ in range(steps - 1):
        simulation.step()
    before = simulation.state.velocities.numpy().astype(np.float64)
    result = simulation.step(forces=True)
    mass = simulation.model.external.mass[:, None]
    return simulation, result.forces, mass * (simulation.state.velocities.numpy() - before) / H


WAYS = {
    "default": {},
    "substeps": {"substeps": 3},
    "local-global": {"nonlinear_solver": "local-global", "max_outer": 1000},
    "restitution": {"contact": {"restitution": 0.5, **NEAR}},
    "paper": {"contact": {"method": "paper", **NEAR}},
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("steps", [5, 40])
def test_forces_are_the_change_of_momentum(way, steps):
    """Of a block that falls on a floor, in the impact and at rest: m dv / h = F + m g. And the floor feels the reaction."""
    settings = {"contact": {"friction": 0.3, **NEAR}, "time_step": H, "tolerance": 1e-6, **WAYS[way]}
    simulation, forces, change = stepped(scene([block(at=(0, 0.1075, 0), velocity=(0.1, 0, 0))], [floor()], **settings), steps)
    weight = 8.0 * G
    on = forces.on("block")
    assert on.total[1] > 0.2 * weight
    np.testing.assert_allclose(on.total - np.array([0, weight, 0]), change.sum(axis=0), atol=1e-3 * weight)
    if steps == 40 and way != "paper":
        assert on.total[1] == pytest.approx(weight, rel=1e-3)
    np.testing.assert_allclose(forces.on("floor").total, -on.total, atol=1e-9 * weight)
    np.testing.assert_allclose(forces.on("floor", "block").total, -on.total, atol=1e-9 * weight)
    # on vertices: the same sums, and the torque about the centre of mass that they make
    first = simulation.model.assembly.bodies[0]
    own = slice(first.first, first.last)
    at_vertices = (forces.vertex_normal + forces.vertex_friction)[own]
    np.testing.assert_allclose(at_vertices.sum(axis=0), on.total, atol=1e-9 * weight)
    if way != "substeps":  # of these the centre moves
        arms = simulation.positions[own] - forces.centers[0]
        np.testing.assert_allclose(np.cross(arms, at_vertices).sum(axis=0), on.torque, atol=1e-9 * weight)


@pytest.mark.parametrize("method", ["barrier", "paper"])
def test_a_block_at_rest_weighs_what_it_weighs(method):
    """78.5 N, in both modes; each block of a stack bears what is above it."""
    blocks = [block("low"), block("high", at=(0, 0.303, 0))]
    contact = {"method": method, **NEAR}
    _, forces, _ = stepped(scene(blocks, [floor()], contact=contact, time_step=H, damping=8.0), 80)
    weight = 8.0 * G
    assert forces.on("low", "floor").total[1] == pytest.approx(2 * weight, rel=0.01)
    assert forces.on("high").total[1] == pytest.approx(weight, rel=0.01)
    assert forces.on("high", "floor").total == pytest.approx(np.zeros(3))
    np.testing.assert_allclose(forces.on("low", "high").total, -forces.on("high", "low").total, atol=1e-9 * weight)
    assert sorted(forces.touching()) == [("floor", "low"), ("high", "low"), ("low", "floor"), ("low", "high")]


def test_friction_of_a_sliding_block_is_mu_times_the_normal_force():
    friction = 0.25
    contact = {"friction": friction, **NEAR}
    made = scene([block(velocity=(2.0, 0, 0))], [floor()], contact=contact, time_step=H, tolerance=1e-6)
    _, forces, _ = stepped(made, 30)
    on = forces.on("block")
    assert on.normal[1] == pytest.approx(8.0 * G, rel=0.05)
    assert np.linalg.norm(on.friction[[0, 2]]) == pytest.approx(friction * on.normal[1], rel=1e-3)
    assert on.friction[0] < 0.0 and abs(on.normal[0]) < 1e-9 * on.normal[1]


def held_ball(steps, **simulation):
    """A ball between two fingers that close by 2.5 mm and hold it."""
    radius, gap, squeeze = 0.03, 1e-3, 2.5e-3
    material = {"young_modulus": 2e5, "poisson_ratio": 0.4, "density": 500.0}
    ball = {"name": "ball", "kind": "solid", "mesh": {"shape": "sphere", "radius": radius, "cells": 6}, "material": material}

    def finger(name, side):
        closed = {"time": 0.1, "translation": [-side * squeeze, 0, 0]}
        return {
            "name": name,
            "mesh": {"shape": "box", "size": [0.02, 0.06, 0.06], "cells": [1, 2, 2]},
            "translation": [side * (radius + gap + 0.01), 0, 0],
            "motion": {"keyframes": [{"time": 0.0}, closed], "smooth": True},
        }

    contact = {"friction": 0.8, "activation_distance": 5e-4}
    made = scene([ball], [finger("left", -1), finger("right", 1)], contact=contact, time_step=H, **simulation)
    return stepped(made, steps)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_two_fingers_feel_half_of_the_ball_that_they_hold(precision):
    """At the default tolerance, within 2 %."""
    simulation, forces, _ = held_ball(35, precision=precision)
    half = 0.5 * G * simulation.model.external.mass.sum()
    left, right = forces.on("left"), forces.on("right")
    assert left.total[1] == pytest.approx(-half, rel=0.02)
    assert right.total[1] == pytest.approx(-half, rel=0.02)
    assert left.total[0] < -5 * half  # squeezed,
    assert left.total[0] == pytest.approx(-right.total[0], rel=0.02)  # alike from both sides
    assert abs(left.normal[1]) < 1e-3 * half  # friction is what carries: a flat finger pushes straight


def test_a_couple_has_a_torque_and_no_force():
    """Two heads press on the ends of a bar that is held in its middle, one down and one up."""
    middle = {"select": {"box": [[-0.051, -1, -1], [0.051, 1, 1]]}}
    bar = solid("bar", (0.4, 0.04, 0.04), (8, 1, 1), young=1e6, pins=[middle])
    heads = [
        {
            "name": name,
            "mesh": {"shape": "box", "size": [0.04, 0.02, 0.08], "cells": [1, 1, 1]},
            "translation": [side * 0.18, side * (0.02 + 0.01 + 2e-3), 0],
            "motion": {"keyframes": [{"time": 0.0}, {"time": 0.1, "translation": [0, -side * 4e-3, 0]}]},
        }
        for name, side in (("right", 1), ("left", -1))
    ]
    made = scene([bar], heads, contact=NEAR, time_step=H, gravity=(0, 0, 0), damping=10.0, tolerance=1e-7)
    _, forces, _ = stepped(made, 60)
    down, up = forces.on("bar", "right"), forces.on("bar", "left")
    size = up.total[1]
    assert down.total[1] < 0.0 < size
    np.testing.assert_allclose(down.total, -up.total, atol=0.02 * size)  # the mesh is not quite symmetric
    assert forces.on("bar").torque[2] == pytest.approx(-2 * 0.18 * size, rel=0.12)  # the heads are 0.04 wide
    assert np.abs(forces.on("bar").torque[:2]).max() < 0.1 * 0.18 * size
    # on the head, about its own middle: what is left of the arm; about the bar's middle it is the reaction
    shifted = forces.on("right").torque + np.cross(forces.centers[1] - forces.centers[0], forces.on("right").total)
    np.testing.assert_allclose(shifted, -down.torque, atol=1e-9 * size)


def test_a_run_keeps_the_forces_of_each_step(tmp_path):
    """Those of `Simulation.step`, to the bit, also where it was stopped and resumed; at vertices where asked for."""
    made = scene([block(at=(0.1, 0.105, 0))], [floor()], contact={"friction": 0.3, **NEAR}, time_step=H)
    for name, steps in (("whole", (8,)), ("resumed", (3, 8))):
        for k, last in enumerate(steps):
            pdipc.run_scene(made, tmp_path / name, steps=last, device="cpu", forces=True, resume=k > 0)
    pdipc.run_scene(made, tmp_path / "without", steps=8, device="cpu")
    runs = {name: pdipc.open_run(tmp_path / name) for name in ("whole", "resumed", "without")}
    simulation = pdipc.Simulation(made, "cpu")
    assert runs["whole"].forces(0) is None
    for frame in range(1, 9):
        expected = simulation.step(forces=True).forces
        kept = {name: run.forces(frame) for name, run in runs.items()}
        for name in ("pairs", "normal", "friction", "torque", "centers", "vertex_normal", "vertex_friction"):
            for run in ("whole", "resumed"):
                assert np.array_equal(getattr(kept[run], name), getattr(expected, name))
        assert np.array_equal(kept["without"].normal, expected.normal)
        assert kept["without"].vertex_normal is None
    assert expected.on("block", "floor").normal[1] > 0.0
    with pytest.raises(ValueError, match="forces on vertices were not kept"):
        runs["without"].forces(-1).pressures(simulation.positions, simulation.triangles)


def test_a_damaged_file_of_forces_is_told(tmp_path):
    pdipc.run_scene(scene([block()], [floor()], contact=NEAR), tmp_path / "run", steps=1, device="cpu")
    opened, path = pdipc.open_run(tmp_path / "run"), tmp_path / "run" / "forces" / "000001.npz"
    with np.load(path) as arrays:
        good = dict(arrays)
    for wrong, told in (
        ({"normal": good["normal"][:1]}, "normal has the shape"),
        ({"pairs": good["pairs"] + 7}, "pairs names"),
    ):
        np.savez(path, **{**good, **wrong})
        with pytest.raises(pdipc.RunError, match=f"000001.npz cannot be read: {told}"):
            opened.forces(1)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(pdipc.RunError, match=r"000001\.npz cannot be read"):
        opened.forces(1)


def test_forces_of_names_that_do_not_exist_are_refused():
    empty = np.zeros((0, 3))
    forces = ContactForces(("a", "b"), np.zeros((0, 2), dtype=np.int32), empty, empty, empty, np.zeros((2, 3)))
    assert forces.on("a", "b").total == pytest.approx(np.zeros(3))
    with pytest.raises(KeyError, match='no body "c"; there are: a, b'):
        forces.on("c")


def test_friction_is_bounded_by_the_normal_forces_that_a_step_ends_with():
    """A block is thrown at a plate that comes down: before the step has converged its contacts are squeezed, and push a hundred times as hard as
    they do in the end. Friction that kept those normal forces was 2 and 7 times the normal force."""
    thrown = solid("thrown", (0.372, 0.248, 0.248), (2, 3, 2), at=(-0.282, 0.576, 0.321), young=888e3, poisson=0.376)
    thrown |= {"rotation": [71.1, 0.902, 17.9], "velocity": [-5.13, 11.0, -2.39], "angular_velocity": [-6.36, 7.21, 8.14]}
    plate = {"name": "plate", "mesh": {"shape": "plane", "size": 1.24}, "rotation": [180.0, 0.0, 0.0]}
    plate |= {"translation": [0.0, 2.48, 0.0], "motion": {"velocity": [0.0, -11.1, 0.0]}}
    rod = {"name": "rod", "mesh": {"shape": "cylinder", "radius": 0.00724, "length": 1.24, "cells": [8, 1]}}
    rod |= {"rotation": [90.0, 58.2, 0.0], "translation": [0.0, 0.149, 0.0]}
    simulation = pdipc.Simulation(
        scene([thrown], [floor(4.96), plate, rod], contact={"friction": 0.5}, time_step=0.00794), "cpu"
    )
    touched = 0
    for _ in range(11):
        result = simulation.step(forces=True)
        normal, friction = (
            float(np.linalg.norm(force, axis=1).sum()) for force in (result.forces.normal, result.forces.friction)
        )
        assert result.converged
        assert friction <= 0.6 * normal
        touched += normal > 0.0
    assert touched >= 2


def test_friction_rubs_with_the_normal_forces_of_where_a_step_starts():
    """As incremental potential contact has it, so that a step is one minimum. A block lands while it slides: whatever it is pushed with
    at the end of a step rubs in the next one, and nothing of an earlier one is left.
    """
    sliding = block(at=(0.0, 0.11, 0.0), velocity=(3.0, -0.5, 0.0))
    simulation = pdipc.Simulation(scene([sliding], [floor(20.0)], contact={"friction": 0.3, **NEAR}), "cpu")
    pushed, hardest = 0.0, 0.0
    for _ in range(12):
        result = simulation.step(forces=True)
        on = result.forces.on("block")
        assert result.converged
        assert on.friction[0] == pytest.approx(-0.3 * pushed, rel=1e-3, abs=1e-6)
        pushed = on.normal[1]
        hardest = max(hardest, pushed)
    assert hardest > 3.0 * 8.0 * G  # it came down, and did not only rest


def test_bodies_that_rub_and_part_descend_together():
    """Friction of where a step starts is one potential of both bodies, however far they are from each other when it ends."""
    low, high = block("low"), block("high", at=(0.0, 0.3025, 0.0))
    made = scene([low, high], [floor(20.0)], contact={"friction": 0.5, **NEAR})
    simulation = pdipc.Simulation(made, "cpu")
    for _ in range(4):
        simulation.step()
    simulation.set_velocities("high", (5.0, 20.0, 0.0))
    result = simulation.step(forces=True)
    assert result.converged
    assert result.forces.on("high", "low").friction[0] < -1.0
    assert result.forces.on("high", "low").normal[1] == 0.0  # they are apart
    assert set(simulation.work.method.islands.label.numpy()[:2]) == {0}
