"""What is changed between steps: approached, held up, refused; never jumped to, never intersecting, and to the same bits again."""

import re
from pathlib import Path

import numpy as np
import pytest
from physics.scenes import cloth, floor, scene, solid, watched

import pdipc

CONTACT = {"activation_distance": 2e-3, "minimum_separation": 4e-4}


def box(name, size, at, **more):
    return {"name": name, "mesh": {"shape": "box", "size": size, "cells": [1, 1, 1]}, "translation": at, **more}


def fastest(simulation):
    """m/s, of what is simulated."""
    free = simulation.model.free_vertices
    return np.linalg.norm(simulation.state.velocities.numpy()[free], axis=1).max()


def test_a_pose_is_approached_at_its_speed_and_reached():
    """Free of anything in the way: a straight way and an even turn, then exactly the pose."""
    sheet = cloth("sheet", (0.1, 0.1), (1, 1), at=(0.0, 3.0, 0.0))
    simulation = watched(
        scene([sheet], [box("tool", [0.2, 0.1, 0.1], (1.0, 0.0, 0.0), rotation=(0, 0, 30))], gravity=[0, 0, 0])
    )
    position, rotation = simulation.pose("tool")
    assert position == pytest.approx([1.0, 0.0, 0.0])
    assert rotation[:, 0] == pytest.approx([np.cos(np.pi / 6), 0.5, 0.0])
    simulation.set_pose("tool", position=(1.05, 0.0, 0.0), speed=1.0)
    before = simulation.positions
    for step in range(5):
        assert simulation.step().lag == 0.0
        motion = simulation.positions - before
        before = simulation.positions
        assert motion[4:] == pytest.approx(np.tile([0.01, 0.0, 0.0], (8, 1)), abs=1e-12), step
    simulation.set_pose("tool", rotation=(0.0, 90.0, 0.0), speed=2.0)
    for _ in range(12):
        simulation.step()
        assert np.linalg.norm(simulation.positions - before, axis=1).max() < 2.0 * 0.01 + 1e-12
        before = simulation.positions
    position, rotation = simulation.pose("tool")
    assert position == pytest.approx([1.05, 0.0, 0.0], abs=1e-12)
    assert rotation == pytest.approx(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), abs=1e-9)
    corners = simulation.positions[4:] - position
    assert np.abs(corners).max(axis=0) == pytest.approx([0.05, 0.05, 0.1], abs=1e-9), "it is turned"


@pytest.mark.parametrize("settings", [{}, {"nonlinear_solver": "local-global"}], ids=["newton", "local-global"])
def test_a_jumping_pose_pushes_a_cloth_and_shoots_nothing_away(settings):
    """From above a held sheet to below it, in one command: the sheet is pushed along, and holds the box up once it is tight."""
    pins = [{"select": {"box": [[-1, -1, -1], [-0.149, 1, 1]]}}, {"select": {"box": [[0.149, -1, -1], [1, 1, 1]]}}]
    sheet = cloth("sheet", (0.3, 0.3), (6, 6), pins=pins, material={"membrane_stiffness": 2000.0})
    simulation = watched(
        scene([sheet], [box("tool", [0.1, 0.1, 0.1], (0, 0.06, 0))], contact=CONTACT, **settings, max_outer=20)
    )
    simulation.set_pose("tool", position=(0.0, -5.0, 0.0), speed=2.0)
    for _ in range(8):
        result = simulation.step()
        assert fastest(simulation) < 5.0
    position, _ = simulation.pose("tool")
    assert position[1] > -0.25, "it has not passed"
    lowest_of_tool = simulation.positions[49:, 1].min()
    assert simulation.positions[:49, 1].min() < lowest_of_tool
    assert result.chords == 1
    simulation.set_pose("tool", position=(0.0, 0.2, 0.0), speed=2.0)
    results = [simulation.step() for _ in range(16)]
    assert simulation.pose("tool")[0] == pytest.approx([0.0, 0.2, 0.0], abs=1e-6), "it can go back whenever it is told"
    assert results[-1].lag == 0.0


def test_a_pose_inside_a_body_that_cannot_give_way_is_held_and_reported():
    block = solid("block", (0.1, 0.1, 0.1), (2, 2, 2), at=(0, 0.0, 0), young=1e7, pins=[{"select": {"all": True}}])
    simulation = watched(scene([block], [box("tool", [0.05, 0.05, 0.05], (0.0, 0.1, 0.0))], contact=CONTACT))
    simulation.set_pose("tool", position=(0.0, 0.0, 0.0), rotation=(0.0, 45.0, 0.0))
    for _ in range(12):
        result = simulation.step()
    assert result.lag > 0.0
    assert f'obstacle "tool" is {result.lag:.3g} m behind its target, where something is in its way' in result.message
    assert 0.075 < simulation.pose("tool")[0][1] < 0.076
    assert fastest(simulation) == 0.0 if simulation.model.free_vertices.any() else True


@pytest.mark.parametrize("commanded", [False, True], ids=["script", "command"])
def test_two_obstacles_that_close_on_a_cloth_until_they_would_overlap(commanded):
    """They come as near as the cloth between them lets them, wait there, say so, and let it go unharmed."""
    motions = ({}, {}) if commanded else [{"motion": {"velocity": [0, v, 0], "end": 0.08}} for v in (1.0, -1.0)]
    jaws = [
        box(name, [0.1, 0.05, 0.1], (0, y, 0), **m)
        for (name, y), m in zip((("low", -0.06), ("high", 0.06)), motions, strict=True)
    ]
    sheet = cloth("sheet", (0.2, 0.2), (6, 6), at=(0.01, 0.0, 0.01), rotation=(0, 20, 0))
    simulation = watched(scene([sheet], jaws, contact=CONTACT, gravity=[0, 0, 0]))
    if commanded:
        simulation.set_pose("low", position=(0, 0.02, 0)), simulation.set_pose("high", position=(0, -0.02, 0))
    for _ in range(14):
        result = simulation.step()
        assert result.converged and result.outer < 60
        assert fastest(simulation) < 3.0
    low, high = simulation.positions[49:57, 1].max(), simulation.positions[57:, 1].min()
    assert 2 * 4e-4 < high - low < 0.01, "there is room for the cloth"
    assert result.lag > 0.01 if not commanded else result.lag > 1e-3
    assert "behind its target" in result.message
    simulation.set_pose("low", position=(0, -0.1, 0)), simulation.set_pose("high", position=(0, 0.1, 0))
    for _ in range(15):
        result = simulation.step()
        assert fastest(simulation) < 3.0
    assert result.lag == 0.0


def test_jaws_that_would_overlap_open_again_as_their_script_does():
    """Each closes to 20 mm beyond the middle, where the other is, and opens: held with the cloth in between, then where the script is."""
    ways, jaws = [{"time": 0}, {"time": 0.08}, {"time": 0.1}, {"time": 0.18}], []
    for name, side in (("low", -1.0), ("high", 1.0)):
        keyframes = [{**key, "translation": [0, y, 0]} for key, y in zip(ways, (0, -0.08 * side, -0.08 * side, 0), strict=True)]
        jaws.append(box(name, [0.1, 0.05, 0.1], (0, 0.06 * side, 0), motion={"keyframes": keyframes}))
    sheet = cloth("sheet", (0.2, 0.2), (6, 6), at=(0.01, 0.0, 0.01), rotation=(0, 20, 0))
    simulation = watched(scene([sheet], jaws, contact=CONTACT, gravity=[0, 0, 0]))
    lags = []
    while simulation.state.time < 0.205:
        lags.append(simulation.step().lag)
        assert fastest(simulation) < 3.0
    assert max(lags) > 0.03 and lags[-1] == 0.0
    np.testing.assert_allclose(simulation.pose("low")[0], [0, -0.06, 0], atol=1e-9)


def test_vertices_of_an_obstacle_and_points_of_pins_are_approached():
    sheet = cloth(
        "sheet", (0.2, 0.2), (4, 4), pins=[{"select": {"vertices": [0]}}, {"select": {"vertices": [4]}, "stiffness": 100.0}]
    )
    simulation = watched(scene([sheet], [floor(0.5, at=(0, -0.05, 0))], contact=CONTACT, gravity=[0, 0, 0]))
    ground = simulation.positions[25:]
    simulation.set_vertices("floor", ground + np.array([[0, 0.02, 0], [0, 0, 0], [0, 0, 0], [0, 0.01, 0]]), speed=0.5)
    simulation.set_pin("sheet", (-0.1, 0.06, -0.1), pin=0, speed=2.0)
    simulation.set_pin("sheet", [[-0.1, 0.06, 0.1]], pin=1)
    simulation.step()
    assert simulation.positions[25:] - ground == pytest.approx(np.array([[0, 0.005, 0], [0, 0, 0], [0, 0, 0], [0, 0.0025, 0]]))
    assert simulation.positions[0] == pytest.approx([-0.1, 0.02, -0.1])
    assert simulation.state.reached.anchors == pytest.approx(np.array([[-0.1, 0.01, 0.1]]))
    for _ in range(9):
        simulation.step()
    assert simulation.positions[25] == pytest.approx(ground[0] + [0, 0.02, 0], abs=1e-9)
    assert simulation.positions[0] == pytest.approx([-0.1, 0.06, -0.1], abs=1e-9)
    with pytest.raises(ValueError, match='obstacle "floor" deforms and has no pose; lead it with set_vertices'):
        simulation.set_pose("floor", (0, 0, 0))


def test_positions_of_a_body_are_a_new_start_and_judged_as_one():
    held = [{"select": {"vertices": [0]}}]
    bodies = [
        solid("block", (0.1, 0.1, 0.1), (1, 1, 1), at=(0, 0.2, 0)),
        cloth("sheet", (0.2, 0.2), (3, 3), at=(0.0, 0.1, 0.0), pins=held),
    ]
    simulation = watched(scene(bodies, [floor(2.0)], contact=CONTACT))
    simulation.step()
    block, before = simulation.positions[:8], simulation.state.arrays()
    for motion, said in (
        (
            [0.0, -0.1, 0.0],
            'body "block" cannot be put there:\n  body "block" and body "sheet": .* pairs of triangles intersect',
        ),
        ([0.5, 2e-4 - block[:, 1].min(), 0.0], 'body "block" and obstacle "floor": .* start too close'),
        ([0.0, -0.0499, np.nan], r'positions of body "block"\[0, 2\] is nan; it must be a number'),
    ):
        with pytest.raises(ValueError, match=said):
            simulation.set_positions("block", block + motion)
        assert np.array_equal(simulation.state.arrays()["positions"], before["positions"])
    with pytest.raises(ValueError, match='vertex 0 of body "sheet" is held exactly'):
        simulation.set_positions("sheet", simulation.positions[8:24] + np.array([0, 0.01, 0]))
    simulation.set_positions("block", block + np.array([3.0, 1.0, 0.0]))
    simulation.set_velocities("block", (0.0, 2.0, 0.0))
    simulation.step()
    assert simulation.positions[:8] == pytest.approx(block + np.array([3.0, 1.0 + 0.01 * (2.0 - 9.81 * 0.01), 0.0]), abs=1e-6)
    closed = scene([bodies[0]], [box("house", [1, 1, 1], (3, 0.5, 0))], contact=CONTACT)
    simulation = watched(closed)
    with pytest.raises(ValueError, match='body "block": starts inside obstacle "house"'):
        simulation.set_positions("block", simulation.positions[:8] + np.array([3.0, 0.3, 0.0]))


def test_gravity_and_wind_change_from_the_next_step_on_and_for_one_simulation_only():
    sheet = cloth("sheet", (0.2, 0.2), (2, 2))
    wind = [{"kind": "wind", "velocity": [0.0, 0.0, 0.0]}]
    made = pdipc.Scene(bodies=[sheet], forces=wind, simulation={"gravity": [0, 0, 0]})
    model = pdipc.build(made, "cpu")
    one, other = pdipc.Simulation(model), pdipc.Simulation(model)
    one.set_gravity((0.0, 0.0, -2.0))
    mass = model.external.mass
    one.set_vertex_force(np.array([0]), np.array([[mass.sum(), 0.0, 0.0]]))
    one.step(), other.step()
    mean = mass @ one.state.velocities.numpy() / mass.sum()
    assert mean == pytest.approx([0.01, 0.0, -0.02], abs=1e-5)
    assert np.abs(other.state.velocities.numpy()).max() < 1e-25, "nothing of it is the model's"
    one.reset()
    one.set_wind((0.0, 3.0, 0.0))
    one.step(), other.step()
    assert one.state.velocities.numpy()[:, 1].min() > 0.05
    assert np.abs(one.state.velocities.numpy()[:, [0, 2]]).max() < 1e-12
    assert np.abs(other.state.velocities.numpy()).max() < 1e-25
    with pytest.raises(ValueError, match="there is no wind 1; the scene has 1"):
        one.set_wind((0, 0, 0), wind=1)
    with pytest.raises(ValueError, match=r"gravity\[1\] is inf; it must be a number"):
        one.set_gravity((0, np.inf, 0))


def test_commands_and_state_go_on_to_the_same_bits():
    def made():
        sheet = cloth("sheet", (0.3, 0.3), (4, 4), at=(0.01, 0.02, 0), pins=[{"select": {"vertices": [0]}, "stiffness": 20.0}])
        jaws = [box("tool", [0.1, 0.1, 0.1], (0, 0.1, 0)), floor(1.0)]
        return pdipc.Simulation(pdipc.Scene(bodies=[sheet], obstacles=jaws, contact=CONTACT), "cpu")

    whole = made()
    for simulation in (whole,):
        simulation.set_pose("tool", (0, 0.06, 0), (0, 60, 20))
        simulation.set_pin("sheet", (0.0, 0.1, 0.0))
        simulation.set_gravity((0.0, -5.0, 0.0))
        for _ in range(3):
            simulation.step()
    arrays = whole.checkpoint()
    again = made()
    again.restore(arrays)
    for _ in range(4):
        whole.step(), again.step()
    ends = [each.checkpoint() for each in (whole, again)]
    assert all(np.array_equal(ends[0][name], ends[1][name]) for name in ends[0])
    whole.reset()
    assert whole.work.script.leads == {}
    other = pdipc.Simulation(scene([cloth("c", (1, 1), (1, 1))]), "cpu")
    with pytest.raises(ValueError, match=r"the checkpoint holds \d+ vertices; the model has 4"):
        other.restore(arrays)


def test_commands_to_nobody_and_of_nothing_are_refused():
    simulation = pdipc.Simulation(scene([cloth("sheet", (1, 1), (1, 1), at=(0, 1, 0))], [floor()]), "cpu")
    for command, said in (
        (lambda: simulation.set_pose("roof", (0, 0, 0)), 'there is no obstacle "roof"; obstacles: floor'),
        (lambda: simulation.set_pose("sheet", (0, 0, 0)), 'there is no obstacle "sheet"'),
        (lambda: simulation.set_pose("floor", (0, 0)), r"position have the shape \(2,\); it must be \(3,\)"),
        (lambda: simulation.set_pose("floor", (0, "a", 0)), "position must be numbers"),
        (lambda: simulation.set_pose("floor", (0, 0, 0), speed=0.0), "speed is 0.0 m/s; it must be more than 0"),
        (lambda: simulation.set_pose("floor", rotation=np.ones((3, 3))), "rotation is no rotation matrix"),
        (lambda: simulation.set_vertices("floor", np.zeros((3, 3))), r'vertices of obstacle "floor" have the shape'),
        (lambda: simulation.set_pin("sheet", (0, 0, 0)), 'body "sheet" has no pin 0; it has 0'),
        (lambda: simulation.set_positions("floor", np.zeros((4, 3))), 'there is no body "floor"; bodies: sheet'),
    ):
        with pytest.raises(ValueError, match=said):
            command()


def test_the_page_on_commands_runs_as_it_stands():
    text = (Path(__file__).parents[2] / "docs" / "control.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "control.md", "exec"), {})


def paddle():
    sheet = cloth("sheet", (0.2, 0.2), (3, 3), at=(0.0, 0.02, 0.0))
    made = scene([sheet], [box("paddle", [0.3, 0.02, 0.3], (0, 0, 0))], contact=CONTACT)
    made.simulation.steps = 4
    return made


def test_a_recording_without_commands_is_the_run_of_its_scene(tmp_path):
    pdipc.run_scene(paddle(), tmp_path / "run", device="cpu")
    simulation = pdipc.Simulation(paddle(), "cpu")
    with simulation.record(tmp_path / "recorded"):
        for _ in range(4):
            assert simulation.step().forces is not None
    simulation.step()  # of which nothing is written
    run, recorded = pdipc.open_run(tmp_path / "run"), pdipc.open_run(tmp_path / "recorded")
    assert recorded.frame_count == run.frame_count == 5 and recorded.scene == run.scene
    assert "live" in recorded.meta and "live" not in run.meta
    for frame in range(5):
        assert np.array_equal(run.positions(frame), recorded.positions(frame))
    assert np.array_equal(run.forces(4).on("sheet").normal, recorded.forces(4).on("sheet").normal)
    (mine,), (its,) = (sorted((each.folder / "checkpoints").iterdir())[-1:] for each in (recorded, run))
    assert mine.read_bytes() == its.read_bytes()


def test_what_commands_did_is_recorded(tmp_path):
    simulation = pdipc.Simulation(paddle(), "cpu")
    simulation.set_pose("paddle", (0, 0.04, 0))
    with simulation.record(tmp_path / "run"):
        seen = [simulation.positions]
        for _ in range(4):
            simulation.step()
            seen.append(simulation.positions)
    run = pdipc.open_run(tmp_path / "run")
    assert seen[-1][16:, 1].min() > seen[0][16:, 1].min() + 0.03  # the paddle has gone up,
    for frame, positions in enumerate(seen):  # and so it is written
        assert run.positions(frame) == pytest.approx(positions, abs=1e-7)
        assert not len(pdipc.find_intersections(run.positions(frame), run.triangles, run.obstacle))


def test_a_recording_has_one_way(tmp_path):
    """It begins at the start, and a step that does not follow the last one is refused before it is taken."""
    simulation = pdipc.Simulation(paddle(), "cpu")
    simulation.step()
    with pytest.raises(pdipc.RunError, match="begins at the start, and 1 steps are done; reset first"):
        simulation.record(tmp_path / "late").__enter__()
    assert not (tmp_path / "late").exists()
    simulation.reset()
    with simulation.record(tmp_path / "run"):
        with pytest.raises(pdipc.RunError, match=r"run is being recorded"):
            simulation.record(tmp_path / "second").__enter__()
        simulation.step()
        simulation.reset()
        with pytest.raises(pdipc.RunError, match="up to step 1; step 1 cannot follow"):
            simulation.step()
    assert simulation.steps_done == 0 and pdipc.open_run(tmp_path / "run").frame_count == 2
    with pytest.raises(pdipc.RunError, match="holds a run already"):
        simulation.record(tmp_path / "run").__enter__()
    with simulation.record(tmp_path / "run", overwrite=True):
        simulation.step()


def test_a_reset_and_an_earlier_state_take_commands_back():
    """What a command led goes back to its script, also where that never moves it; it went on to where it had been told to go."""
    scene = pdipc.Scene(
        simulation={"gravity": [0, 0, 0]},
        bodies=[{"name": "cloth", "kind": "cloth", "mesh": {"shape": "grid", "cells": [2, 2]}, "translation": [0, 1, 0]}],
        obstacles=[box("box", [0.2] * 3, [0, 0, 0])],
    )
    simulation = pdipc.Simulation(scene, "cpu")
    simulation.step()
    start, earlier = simulation.positions[9:], simulation.checkpoint()
    for back in (simulation.reset, lambda: simulation.restore(earlier)):
        simulation.set_pose("box", (0, -1, 0), speed=10.0)
        for _ in range(2):
            simulation.step()
        assert np.allclose(simulation.positions[9:], start - [0, 0.2, 0])
        back()
        simulation.step()
        assert np.array_equal(simulation.positions[9:], start) and np.allclose(simulation.pose("box")[0], 0.0)
