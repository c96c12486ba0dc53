"""Worlds side by side: each ends at the bits that it has alone, whatever the others do; files, folders, resuming; the page's examples."""

import re
from pathlib import Path

import numpy as np
import pytest
from physics.scenes import floor, scene, solid
from typer.testing import CliRunner

import pdipc
from pdipc.barrier import pairs
from pdipc.cli import app
from pdipc.device import launch
from pdipc.output.results import RunError, open_run
from pdipc.scene.errors import SceneError
from pdipc.scene.worlds import scenes_of

PAGE = Path(__file__).parents[2] / "docs" / "worlds.md"
FINGER = {"name": "finger", "mesh": {"shape": "box", "size": [0.02, 0.04, 0.06], "cells": [1, 1, 1]}}
VARIANTS = [
    {"contact.friction": 0.1},
    {"contact.friction": 0.6, "bodies.cube.material.young_modulus": 1e6},
    {"bodies": {"cube": {"velocity": [0.4, -1.0, 0.0]}}},  # tables within tables say the same
    {"simulation.substeps": 2, "obstacles.finger.translation": [-0.09, 0.05, 0.0]},
]


@pytest.fixture(autouse=True)
def two_threads(monkeypatch):
    monkeypatch.setenv("PDIPC_THREADS", "2")


def pushed(worlds=None, **simulation):
    """A finger pushes a soft cube over a floor."""
    cube = solid("cube", [0.1, 0.1, 0.1], [2, 2, 2], at=(0, 0.0505, 0))
    made = scene([cube], [floor(2.0), {**FINGER, "translation": [-0.065, 0.05, 0.0]}], **simulation)
    made.worlds = worlds
    return made


def push(world, number, step):
    world.set_pose("finger", position=[-0.065 + 0.004 * step * (1 + number), 0.05, 0.0])
    if number == 1:
        world.set_gravity([0.0, -3.0, 0.0])


def alone(one, number, steps):
    simulation, results = pdipc.Simulation(one, "cpu"), []
    for step in range(steps):
        push(simulation, number, step)
        results.append(simulation.step(forces=True))
    return simulation, results


def test_each_world_has_the_bits_that_it_has_alone(monkeypatch):
    """Also where a world takes its steps again, with more room for its pairs, while the others do not."""
    monkeypatch.setattr(pairs, "FIRST_PAIRS", 8)
    monkeypatch.setattr(pairs, "PAIRS_OF_EACH", 0.0)
    worlds = pdipc.Worlds(pushed(), VARIANTS, device="cpu")
    grown = {step: set() for step in range(5)}
    for number, world in enumerate(worlds):
        grow = world.work.grow
        monkeypatch.setattr(world.work, "grow", lambda grow=grow, number=number: grown[step].add(number) or grow())
    results = []
    for step in range(5):
        for number, world in enumerate(worlds):
            push(world, number, step)
        results.append(worlds.step(forces=True))
    assert any(0 < len(those) < len(worlds) for those in grown.values())
    for number, one in enumerate(scenes_of(pushed(), VARIANTS)):
        simulation, own = alone(one, number, 5)
        np.testing.assert_array_equal(worlds[number].positions, simulation.positions)
        for together, single in zip((each[number] for each in results), own, strict=True):
            assert (together.outer, together.linear_iterations) == (single.outer, single.linear_iterations)
            np.testing.assert_array_equal(together.forces.on("cube").normal, single.forces.on("cube").normal)
    assert len({worlds[number].positions.tobytes() for number in range(len(worlds))}) == len(worlds)


def test_copies_share_the_place_and_do_not_meet():
    """They stand in one another: a pair of two worlds would stop the first step."""
    worlds = pdipc.Worlds(pushed(worlds=3), device="cpu")
    assert worlds.positions.shape == (3, worlds[0].model.vertex_count, 3)
    assert len({id(world.model.assembly) for world in worlds}) == 1 and len({id(world.model) for world in worlds}) == 3
    begun = worlds.checkpoint()
    for step in range(3):
        push(worlds[2], 1, step)
        worlds.step()
    ended = worlds.positions
    np.testing.assert_array_equal(ended[0], ended[1])
    assert np.abs(ended[0] - ended[2]).max() > 1e-3
    worlds.restore(begun)
    for step in range(3):
        push(worlds[0], 1, step)
        worlds.step()
    np.testing.assert_array_equal(worlds.positions, ended[[2, 1, 0]])
    worlds.reset()
    np.testing.assert_array_equal(worlds.positions[1], begun[1]["positions"])


def test_a_key_that_is_none_is_refused_where_the_scene_is_made():
    """It was written by `save` as it is, into a file that does not load."""
    made = pushed()
    with pytest.raises(pdipc.SceneError, match=r'"bodies\.my cube\.friction": is no key; .* bodies\."a b"\.friction'):
        pdipc.Scene(bodies=made.bodies, worlds=[{"bodies.my cube.friction": 0.1}])


def test_where_one_raises_the_others_make_their_step():
    worlds = pdipc.Worlds(pushed(), 3, device="cpu")
    worlds.step()
    wrong = worlds[1].state.positions.numpy().copy()
    wrong[-8:, 0] += 0.02  # the finger into the cube's side
    worlds[1].state.positions.assign(wrong)
    with pytest.raises(ValueError, match="pairs of triangles that intersect") as raised:
        worlds.step()
    assert raised.value.__notes__ == ["in world 1 of 3"]
    assert [world.steps_done for world in worlds] == [2, 1, 2]
    np.testing.assert_array_equal(worlds[0].positions, worlds[2].positions)


def test_an_interrupt_leaves_nothing_running(monkeypatch):
    begin, begun = launch.Graph.begin, []

    def interrupted(graph, tell):
        if len(begun) == 2:
            raise KeyboardInterrupt
        begun.append(begin(graph, tell))
        return begun[-1]

    worlds = pdipc.Worlds(pushed(), 3, device="cpu")
    worlds.step()
    with monkeypatch.context() as patched:
        patched.setattr(launch.Graph, "begin", interrupted)
        with pytest.raises(KeyboardInterrupt):
            worlds.step()
    assert all(replay.done() for replay in begun)
    assert [world.steps_done for world in worlds] == [1, 1, 1]
    worlds.step()
    simulation = pdipc.Simulation(pushed(), "cpu")
    for _ in range(2):
        simulation.step()
    np.testing.assert_array_equal(worlds.positions, np.tile(simulation.positions, (3, 1, 1)))


@pytest.mark.parametrize(
    ("worlds", "told"),
    [
        (0, "worlds = 0: must be 1 to 10000 worlds"),
        ([], r"worlds = \[\]: must be 1 to 10000 worlds"),
        (True, "worlds = True: must be a number of copies, or a list of tables"),
        ([{}, {"contact.frition": 1.0}], r'worlds\[1\]: contact.frition = 1.0: unknown key; did you mean "friction"'),
        ([{"bodies.ball.velocity": [0, 0, 0]}], r'worlds\[0\]: "bodies.ball.velocity": bodies has no "ball"'),
        ([{"worlds": 2}], r"worlds\[0\]: a world has no worlds in it"),
        ([{"bodies.cube.translation": [0, 0.02, 0]}], "world 0: the scene cannot be simulated"),
        ([{}, {"simulation.device": "cuda:7"}], "worlds share a device"),
    ],
)
def test_what_is_wrong_is_refused(worlds, told):
    with pytest.raises(SceneError, match=told):
        pdipc.Worlds(pushed(), worlds)


def test_one_simulation_refuses_a_scene_of_several():
    with pytest.raises(SceneError, match=r"a model is of one world; .*pdipc\.Worlds"):
        pdipc.Simulation(pushed(worlds=2))
    with pytest.raises(ValueError, match="worlds are of one scene"):
        pdipc.Worlds([pushed(), pushed()], 2)
    with pytest.raises(SceneError, match="there are no worlds"):
        pdipc.Worlds([])


def test_a_check_tells_in_which_world(tmp_path):
    path = tmp_path / "several.toml"
    worlds = [{}, {"bodies.cube.translation": [0.0, 0.02, 0.0]}, {"bodies": {"cube": {"friction": 0.2}}}]
    pushed(worlds=worlds).save(path)
    assert pdipc.load_scene(path) == pushed(worlds=worlds)
    (finding,) = pdipc.check_scene(pdipc.load_scene(path))
    assert finding.where.startswith("world 1: ")
    everywhere = pushed(worlds=worlds[1:2] * 2)
    assert not any(finding.where.startswith("world") for finding in pdipc.check_scene(pushed(worlds=2)))
    assert pdipc.check_scene(everywhere)[0].where == finding.where.removeprefix("world 1: ")
    (unreadable,) = pdipc.check_scene(pushed(worlds=[{"contact.frition": 1.0}]))
    assert not unreadable.readable and "worlds[0]" in unreadable.where


def contents(folder):
    """What must be the same: all but times."""
    run = open_run(folder)
    untimed = [{name: value for name, value in record.items() if name != "milliseconds"} for record in run.records]
    return untimed, [run.positions(frame).tobytes() for frame in range(run.frame_count)], run.scene


def test_a_run_of_worlds_is_the_runs_of_each_stopped_or_not(tmp_path):
    several = pushed(worlds=[*VARIANTS[:2], {"simulation.steps": 2}], steps=3)
    for number, one in enumerate(scenes_of(several)):
        pdipc.run_scene(one, tmp_path / f"alone{number}", device="cpu")
    told = []

    def stop(info):
        told.append((info.step, info.steps))
        if info.step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pdipc.run_worlds(several, tmp_path / "all", device="cpu", progress=stop)
    assert told == [(k, 8) for k in range(1, 5)]
    assert not (tmp_path / "all/table.csv").exists()
    for number in range(3):  # each has saved the step that it was in
        assert open_run(tmp_path / f"all/{number:04d}").records[-1]["step"] >= 1
    with pytest.raises(RunError, match="holds a run of another scene"):
        pdipc.run_worlds(pushed(worlds=VARIANTS[:3], steps=3), tmp_path / "all", device="cpu", resume=True)
    pdipc.run_worlds(several, tmp_path / "all", device="cpu", resume=True)
    for number in range(3):
        assert contents(tmp_path / f"all/{number:04d}") == contents(tmp_path / f"alone{number}")
    header, *rows = (tmp_path / "all/table.csv").read_text().splitlines()
    assert header.startswith("run,contact.friction,bodies.cube.material.young_modulus,simulation.steps,steps,")
    assert [row.split(",")[:5] for row in rows] == [
        ["0000", "0.1", "", "", "3"],
        ["0001", "0.6", "1000000.0", "", "3"],
        ["0002", "", "", "2", "2"],
    ]
    with pytest.raises(RunError, match=r"it holds 3: name one, such as .*0000"):
        open_run(tmp_path / "all")


def test_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    (tables,) = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    Path("push.toml").write_text(tables, encoding="utf-8")
    (command,) = re.findall(r"```sh\npdipc (.*?)\n```", text, flags=re.DOTALL)
    result = CliRunner().invoke(app, command.split())
    assert result.exit_code == 0, result.output
    assert "worlds in folders 0000 to" in result.output and Path("pushed/table.csv").is_file()
    assert CliRunner().invoke(app, ["check-scene", "push.toml"]).exit_code == 0
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(block, names)
    assert names["best"] in range(len(names["worlds"]))
