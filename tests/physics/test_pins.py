"""Pins: along some axes, for some time, with a surface, on seams; against closed forms."""

import numpy as np
import pytest

import pdipc
from pdipc.scene.errors import SceneError
from pdipc.simulation import run_scene
from physics.scenes import cloth, floor, scene, solid, watched

H = 0.01
EVERY = {"all": True}


def box(name="box", at=(0.0, 0.0, 0.0), **more):
    return {"name": name, "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]}, "translation": at, **more}


def rotated(points, degrees, about=(0.0, 0.0, 0.0)):
    """About the y axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (points - about) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + about


@pytest.mark.parametrize("solver", ["newton", "local-global"])
def test_a_pin_along_one_axis_leaves_the_others_free(solver):
    """A block on springs along y, under a load aslant: along x it falls freely, along y it comes to rest where the springs balance it."""
    stiffness = 100.0
    block = solid("block", (0.1, 0.1, 0.1), (1, 1, 1), young=1e6, pins=[{"select": EVERY, "axes": "y", "stiffness": stiffness}])
    made = scene(
        [block], gravity=[2.0, -5.0, 0.0], time_step=H, damping=0.0, nonlinear_solver=solver, tolerance=1e-5, max_outer=500
    )
    simulation = pdipc.Simulation(made, "cpu")
    start, steps, y, v = simulation.positions, 20, 0.0, 0.0
    mass = simulation.model.external.mass.sum()
    for _ in range(steps):
        assert simulation.step().converged
        v = (v - 5.0 * H - 8 * stiffness / mass * H * y) / (
            1 + 8 * stiffness / mass * H * H
        )  # implicit Euler of the oscillator
        y += H * v
    moved = simulation.model.external.mass @ (simulation.positions - start) / mass
    assert moved[[0, 2]] == pytest.approx([2.0 * H * H * steps * (steps + 1) / 2, 0.0], abs=1e-5)
    assert moved[1] == pytest.approx(y, rel=1e-2)
    assert y < -4e-3


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_rigid_body_on_a_rail_with_friction(precision):
    """Along the rail it falls as fast as it would freely, and a cloth of friction beside it is no matter: once this did not begin."""
    rail = {"select": EVERY, "axes": "yz", "stiffness": 1e5}
    block = {**box("block"), "kind": "rigid", "pins": [rail]}
    sheet = cloth("sheet", (0.3, 0.3), (4, 4), at=(0.0, -0.2, 0.0), pins=[{**rail, "axes": "y"}])
    made = scene([block, sheet], contact={"friction": 0.5}, gravity=[2.0, -1.0, 0.0], time_step=H, precision=precision)
    simulation = pdipc.Simulation(made, "cpu")
    start, steps = simulation.positions, 10
    for _ in range(steps):
        assert simulation.step().converged
    moved = simulation.positions - start
    fallen = 2.0 * H * H * steps * (steps + 1) / 2
    assert moved[:, 0] == pytest.approx(fallen, rel=1e-2)
    assert np.abs(moved[:8, 1:]).max() < 1e-4


def test_a_pin_holds_for_its_time_and_lets_go():
    """Free fall, caught where it is, then led by a motion from there, then free fall from rest: all exactly."""
    motion = {"velocity": [0.0, 0.0, 0.5], "start": 0.1}
    block = solid("block", (0.1, 0.1, 0.1), (1, 1, 1), pins=[{"select": EVERY, "start": 0.05, "end": 0.15, "motion": motion}])
    simulation = watched(scene([block], gravity=[0.0, -10.0, 0.0], time_step=H, tolerance=1e-8))
    start = simulation.positions
    fallen = 10.0 * H * H * 15  # of 1 + 2 + ... + 5 steps
    expected = [10.0 * H * H * n * (n + 1) / 2 for n in range(1, 6)] + [fallen] * 10
    for step, fall in enumerate(expected):
        simulation.step()
        z = max(0.0, 0.5 * (H * (step + 1) - 0.1))
        assert simulation.positions - start == pytest.approx(np.tile([0.0, -fall, z], (8, 1)), abs=1e-9), step
    assert simulation.state.velocities.numpy() == pytest.approx(np.tile([0.0, 0.0, 0.5], (8, 1)), abs=1e-6)
    simulation.step(), simulation.step()
    expected = [0.0, -fallen - 10.0 * H * H * 3, 0.025 + 2 * 0.5 * H]
    assert simulation.positions - start == pytest.approx(np.tile(expected, (8, 1)), abs=1e-8), (
        "it lets go at the speed of the motion"
    )
    simulation.reset()
    simulation.step()
    assert simulation.positions - start == pytest.approx(np.tile([0.0, -10.0 * H * H, 0.0], (8, 1)), abs=1e-9)


def test_pins_that_begin_later_go_on_to_the_same_bits(tmp_path):
    pins = [
        {"select": {"vertices": [0]}, "start": 0.02, "end": 0.09},
        {"select": {"vertices": [4]}, "start": 0.03, "stiffness": 50.0, "motion": {"angular_velocity": [0, 9.0, 0]}},
        {"select": {"vertices": [20]}, "start": 0.04, "follow": "box"},
    ]
    turning = box(at=(0.0, -0.2, 0.0), motion={"angular_velocity": [0.0, 20.0, 0.0]})
    made = scene([cloth("sheet", (0.2, 0.2), (4, 4), pins=pins)], [turning], steps=12)
    run_scene(made, tmp_path / "whole")
    run_scene(made, tmp_path / "cut", steps=6)
    run_scene(made, tmp_path / "cut", resume=True)
    whole, cut = (pdipc.open_run(tmp_path / name) for name in ("whole", "cut"))
    assert all(np.array_equal(whole.positions(k), cut.positions(k)) for k in range(13))
    caught, later = whole.positions(2), whole.positions(9)
    assert np.array_equal(caught[0], later[0])
    assert not np.array_equal(later[0], whole.positions(12)[0])
    assert whole.positions(12)[20] == pytest.approx(rotated(whole.positions(4)[20], np.degrees(20.0 * 0.08)), abs=1e-9)


def test_what_is_glued_to_an_obstacle_moves_with_it_by_script_and_by_command():
    pins = [{"select": {"vertices": [0, 1, 2]}, "follow": "box"}]
    sheet = cloth("sheet", (0.2, 0.2), (2, 2), at=(0.2, 0.0, 0.0), pins=pins)
    spin = {"angular_velocity": [0.0, 10.0, 0.0], "end": 0.05}
    simulation = watched(scene([sheet], [box(motion=spin)], gravity=[0, 0, 0]))
    start = simulation.positions
    for step in range(5):
        assert simulation.step().lag == 0.0
        turned = rotated(start, np.degrees(0.1 * (step + 1)))
        assert simulation.positions[[0, 1, 2, *range(9, 17)]] == pytest.approx(turned[[0, 1, 2, *range(9, 17)]], abs=1e-9)
    simulation.set_pose("box", position=(0.0, 0.05, 0.0), rotation=(0.0, 0.0, 0.0))
    for _ in range(20):
        simulation.step()
    assert simulation.positions[:3] == pytest.approx(start[:3] + np.array([0.0, 0.05, 0.0]), abs=1e-9)
    with pytest.raises(ValueError, match=r'pins\[0\].* moves with "box"; lead that'):
        simulation.set_pin("sheet", (0.0, 0.0, 0.0))


def test_what_is_glued_to_an_obstacle_that_deforms_keeps_its_place_on_the_surface():
    plane = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, -1], [1, 0, 1]])
    tilted = plane @ np.array([[1.0, 0.3, 0], [0, 1, 0], [0, 0, 1]])  # y += 0.3 x
    cache = {"vertices": np.stack([plane, tilted]), "times": [0.0, 0.05]}
    ground = {"name": "ground", "mesh": {"vertices": plane, "triangles": [[0, 1, 2], [1, 3, 2]]}, "motion": {"cache": cache}}
    sheet = cloth("sheet", (0.4, 0.4), (2, 2), at=(0.0, 0.02, 0.0), pins=[{"select": {"vertices": [0]}, "follow": "ground"}])
    simulation = watched(scene([sheet], [ground], gravity=[0, 0, 0]))
    start = simulation.positions[0]
    for _ in range(6):
        simulation.step()
    normal = np.array([-0.3, 1.0, 0.0]) / np.sqrt(1.09)
    expected = [start[0], 0.3 * start[0], start[2]] + 0.02 * normal
    assert simulation.positions[0] == pytest.approx(expected, abs=1e-9)
    simulation.set_vertices("ground", plane, speed=10.0)
    for _ in range(5):
        simulation.step()
    assert simulation.positions[0] == pytest.approx(start, abs=1e-9)


def test_springs_to_the_surface_of_a_body_pull_both():
    """Two blocks without weight; one is thrown, and takes the other along. Momentum stays, and the springs keep their length."""
    pin = {"select": {"nearest": [0.3, 0.0, 0.0]}, "follow": "other", "stiffness": 500.0}
    one = solid("one", (0.1, 0.1, 0.1), (1, 1, 1), at=(0.3, 0.0, 0.0), velocity=[0.5, 0.0, 0.0], pins=[pin])
    other = solid("other", (0.1, 0.1, 0.1), (2, 2, 2))
    simulation = watched(scene([one, other], gravity=[0, 0, 0], tolerance=1e-5))
    (held,) = simulation.model.assembly.pins
    (element,), (weights,) = held.elements, held.weights
    mass = simulation.model.external.mass

    def length():
        x = simulation.positions
        return np.linalg.norm(weights @ x[element[1:]] - x[element[0]])

    before, rest = mass @ simulation.state.velocities.numpy(), length()
    for _ in range(40):
        assert simulation.step().converged
    after = mass @ simulation.state.velocities.numpy()
    assert after == pytest.approx(before, abs=1e-5 * np.linalg.norm(before))
    assert (mass[8:] @ simulation.state.velocities.numpy()[8:])[0] > 0.1 * before[0]
    assert length() == pytest.approx(rest, rel=0.2)


def test_a_pin_on_a_seam_holds_what_is_sewn():
    """Two panels hang from the seam between them."""
    panels = [cloth(name, (0.2, 0.1), (4, 2), at=(0.0, 0.0, z)) for name, z in (("back", -0.051), ("front", 0.051))]
    panels[0]["pins"] = [{"select": {"seam": True}}]
    seam = {"bodies": ["back", "front"], "within": 0.01, "stiffness": 100.0}
    made = pdipc.Scene(bodies=panels, stitches=[seam], contact={"activation_distance": 1e-3})
    simulation = watched(made)
    held = simulation.model.assembly.pins[0].vertices
    start = simulation.positions
    assert np.array_equal(held, np.flatnonzero(start[:15, 2] > -0.002))
    for _ in range(25):
        simulation.step()
    assert np.array_equal(simulation.positions[held], start[held])
    assert simulation.positions[:15, 1].min() < -0.05
    assert simulation.positions[15:, 1].min() < -0.05
    joined = np.flatnonzero(start[15:, 2] < 0.002) + 15
    assert simulation.positions[joined, 1].min() > -0.02


@pytest.mark.parametrize(
    ("pin", "said"),
    [
        ({"axes": "y"}, 'axes = "y" needs a stiffness: what is held exactly is held along all axes'),
        ({"axes": "yy", "stiffness": 1.0}, r'axes = "yy": must be one to three of the letters x, y and z.*; is "yy"'),
        ({"start": 1.0, "end": 0.5}, "end = 0.5 s must be later than start = 1.0 s"),
        ({"follow": "floor", "motion": {}}, "follow excludes motion"),
        ({"follow": "floor", "stiffness": 1.0, "end": 1.0}, "follow with a stiffness takes no start and no end"),
        ({"follow": "roof"}, r'pins\[0\].follow: there is no body "roof"; there are: sheet, other, floor'),
        ({"follow": "sheet"}, r'pins\[0\].follow: body "sheet" cannot follow itself'),
        ({"follow": "other"}, "what is held exactly follows obstacles only; give the pin a stiffness"),
    ],
)
def test_pins_that_say_nothing_are_refused(pin, said):
    sheets = [cloth(name, (1, 1), (1, 1), at=(0, y, 0)) for name, y in (("sheet", 1), ("other", 2))]
    sheets[0]["pins"] = [{"select": EVERY, **pin}]
    with pytest.raises(SceneError, match=said):
        pdipc.build(scene(sheets, [floor()]), "cpu")


def test_exact_pins_may_share_vertices_one_after_the_other():
    pins = [{"select": EVERY, "end": 0.1}, {"select": EVERY, "start": 0.1}]
    assert pdipc.check_scene(scene([cloth("sheet", (1, 1), (1, 1), pins=pins)])) == []
    pins[1]["start"] = 0.05
    (found,) = pdipc.check_scene(scene([cloth("sheet", (1, 1), (1, 1), pins=pins)]))
    assert "4 vertices are held exactly by more than one pin at a time" in str(found)


def test_pins_are_saved_and_read_as_they_are(tmp_path):
    pins = [
        {"select": {"seam": True}, "axes": "zx", "stiffness": 2.0, "start": 0.5},
        {"select": {"vertices": [0]}, "follow": "floor", "end": 1.0},
    ]
    made = scene([cloth("sheet", (1, 1), (1, 1), at=(0, 1, 0), pins=pins)], [floor()])
    made.save(tmp_path / "scene.toml")
    assert pdipc.load_scene(tmp_path / "scene.toml") == made
    assert made.bodies[0].pins[0].axes == "xz"
    assert "selects no vertex" in str(pdipc.check_scene(made)[0])


def test_commands_to_pins_that_began_later_go_on_to_the_same_bits():
    pins = [
        {"select": {"vertices": [0]}, "start": 0.02, "end": 0.05},
        {"select": {"vertices": [3]}, "start": 0.02, "stiffness": 9.0},
    ]
    made = scene([cloth("sheet", (0.4, 0.4), (3, 3), pins=pins)], [floor(at=(0, -1, 0))])
    whole, again = (pdipc.Simulation(made, "cpu") for _ in range(2))
    for step in range(7):
        if step == 3:
            whole.set_pin("sheet", (0.0, 0.05, 0.0), pin=0)
            whole.set_pin("sheet", (0.0, 0.1, 0.0), pin=1)
        if step == 4:
            again.restore(whole.checkpoint())
        whole.step()
        if step >= 4:
            again.step()
    ends = [each.checkpoint() for each in (whole, again)]
    assert all(np.array_equal(ends[0][name], ends[1][name]) for name in ends[0])
    assert not np.array_equal(ends[0]["caught_1_points"], ends[0]["reached_anchors"]), "it was led on"


def test_what_is_glued_to_a_rigid_obstacle_moves_with_it_where_a_command_deforms_it():
    """At the start or later: a rigid obstacle becomes one that deforms."""
    pins = [{"select": {"vertices": [0]}, "follow": "box"}, {"select": {"vertices": [8]}, "follow": "box", "start": 0.02}]
    sheet = cloth("sheet", [0.3, 0.3], [2, 2], at=(0, 0.3, 0), pins=pins)
    simulation = pdipc.Simulation(scene([sheet], [box()], gravity=[0, 0, 0]), "cpu")
    shift = np.array([0.01, 0.02, 0.0])
    held = simulation.positions[0]
    for _ in range(2):
        simulation.set_vertices("box", simulation.positions[9:] + shift, speed=10.0)
        simulation.step()
    assert np.allclose(simulation.positions[0], held + 2 * shift)
    caught = simulation.positions[8]
    simulation.set_vertices("box", simulation.positions[9:] + shift, speed=10.0)
    simulation.step()
    assert np.allclose(simulation.positions[[0, 8]], [held + 3 * shift, caught + shift])
