"""Whatever a scene or a mesh file holds, what is wrong with it is one error with the file and the place; nothing hangs."""

import datetime
import os
import re
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import pdipc
from pdipc.cli import app
from pdipc.collision import candidates
from pdipc.scene import assembly, check, generators, load, memory, meshes
from pdipc.scene.errors import SceneError, SceneWarning

GRID = {"shape": "grid", "cells": [2, 2]}
BALL = '[[bodies]]\nname = "ball"\nkind = "solid"\nmesh = { shape = "sphere", cells = 4 }\n'


def cloth(**tables) -> dict:
    return {"name": "c", "kind": "cloth", "mesh": GRID, **tables}


def refused(tmp_path, text: str, name: str = "a.toml") -> str:
    """What the command line says of a scene file; every failure ends with exit code 2."""
    (tmp_path / name).write_text(text)
    result = CliRunner().invoke(app, ["run", str(tmp_path / name), "-o", str(tmp_path / "out")])
    assert result.exit_code == 2, result.output
    assert str(tmp_path / name) in result.stderr
    with pytest.raises(SceneError):
        assembly.assemble(load.load_scene(tmp_path / name))
    checked = CliRunner().invoke(app, ["check-scene", str(tmp_path / name)])
    assert checked.exit_code == 2
    return result.stderr


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("[[0, 0, 0], [1, {a = 1}, 0], [0, 0, 1]]", r"must be numbers; \[1\]\[1\] is {'a': 1}"),
        ("[[0, 0, 0], 1979-05-27, [0, 0, 1]]", r"\[1\] is 1979-05-27"),
        ("[[0, 0, 0], [1, 0, 1979-05-27], [0, 0, 1]]", r"\[1\]\[2\] is 1979-05-27"),
        ('[[0, 0, 0], [1, 0, "1"], [0, 0, 1]]', r'\[1\]\[2\] is "1"'),
        ("[[0, 0, 0], [1, 0, true], [0, 0, 1]]", r"\[1\]\[2\] is True"),
        ("[[0, 0, 0], [1, 0], [0, 0, 1]]", "must be numbers that 64 bits hold|has the shape"),
        ("{a = 1}", "must be a list of lists of 3 numbers"),
        ("1", "must be a list of lists of 3 numbers"),
        (f"[[0, 0, 0], [1, 0, {10**400}], [0, 0, 1]]", "int too large to convert to float"),
    ],
)
def test_vertices_that_are_no_table_of_numbers(tmp_path, value, message):
    text = f'[[bodies]]\nname = "c"\nkind = "cloth"\nmesh = {{ vertices = {value}, triangles = [[0, 1, 2]] }}\n'
    told = refused(tmp_path, text)
    assert re.search(r'bodies\[0\] \("c"\)\.mesh\.vertices = .*(' + message + ")", told), told


@pytest.mark.parametrize("value", [np.array(1.0), np.array([[1j, 0, 0]]), np.array([[True, False, True]]), np.array([["a", "b", "c"]]),
                                   np.array([[datetime.date(2020, 1, 1)] * 3]), {"a": 1}, None, np.zeros((2, 3, 3))])  # fmt: skip
def test_arrays_of_other_kinds_in_python(value):
    with pytest.raises(SceneError, match="vertices"):
        pdipc.Scene(bodies=[cloth(mesh={"vertices": value, "triangles": [[0, 1, 2]]})])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "1" * 5000, "is not valid TOML: Exceeds the limit"),
        ("a = " + "[" * 100_000, "nested too deep"),
        ("a = " + "[" * 50_000 + "]" * 50_000, "nested too deep"),
        (f"title = {10**400}\n" + BALL, "title = a whole number of 1329 bits: must be a valid string"),
        (f"[simulation]\nsteps = {10**400}\n" + BALL, "simulation.steps = a whole number of 1329 bits"),
        (f"[simulation]\ntime_step = {10**400}\n" + BALL, "simulation.time_step = a whole number of 1329 bits"),
        ("[simulation]\ntime_step = 1e-200\n" + BALL, "simulation.time_step = 1e-200: must be at least 1e-09 s"),
        ("[simulation]\ntime_step = true\n" + BALL, "simulation.time_step = True: must be a number"),
        ('[simulation]\ntime_step = "0.01"\n' + BALL, 'simulation.time_step = "0.01": must be a number'),
        ('[simulation]\nsteps = "5"\n' + BALL, 'simulation.steps = "5": must be a number'),
        (BALL + "translation = [1, false, 0]", r"translation[1] = False: must be a number"),
        (BALL + 'pins = [{ select = { all = "yes" } }]', 'select.all = "yes": must be a valid boolean'),
        (BALL.replace("4", '"4"'), 'mesh.cells = "4": must be a number'),
        (BALL.replace("ball", "b" * 100_000), "name = "),
        (BALL.replace('{ shape = "sphere", cells = 4 }', f'"{"m" * 100_000}.obj"'), "mesh"),
        (BALL + "k" * 100_000 + " = 1", "unknown key"),
        (BALL + "[[attachments]]\nbodies = ['ball', 'ball']\npairs = [[0, 100000000000000000000]]", "100000000000000000000"),
    ],
)
def test_numbers_names_and_depths_without_measure(tmp_path, text, message):
    told = refused(tmp_path, text)
    assert message in told
    assert len(told) < 3000


def test_json_nested_too_deep_and_of_another_kind(tmp_path):
    assert "nested too deep" in refused(tmp_path, "[" * 100_000, "a.json")
    assert "holds a list; a scene is a table" in refused(tmp_path, "[]", "b.json")
    nested: list = []
    for _ in range(5000):
        nested = [nested]
    with pytest.raises(SceneError, match="title"):
        pdipc.Scene(title=nested, bodies=[cloth()])


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="no links here")
@pytest.mark.parametrize("table", ['"name": "\\ud800"', '"name": "c", "mesh": "\\ud800.obj"', '"name": "c", "\\udfff": 1'])
def test_json_with_half_a_character(tmp_path, table):
    """Which cannot be printed; whole ones written by halves can be."""
    told = refused(tmp_path, '{"bodies": [{"kind": "cloth", "mesh": {"shape": "grid"}, ' + table + "}]}", "a.json")
    assert re.search(r"is not valid JSON: .*surrogates not allowed", told), told
    text = '{"bodies": [{"kind": "cloth", "mesh": {"shape": "grid"}, "name": "\\ud83d\\ude00"}]}'
    (tmp_path / "a.json").write_text(text)
    assert load.load_scene(tmp_path / "a.json").bodies[0].name == "\U0001f600"


@pytest.mark.parametrize(
    "key",
    [
        "a." * 100_000 + "b = 1",
        '"a" . ' * 100_000 + "b = 1",
        "[" + "a." * 100_000 + "b]",
        "c = {" + "'a'." * 100_000 + "b = 1}",
    ],
)
def test_keys_of_very_many_names(tmp_path, key):
    """Python's reader takes hours for these."""
    begun = time.process_time()
    assert "nested too deep" in refused(tmp_path, f"{BALL}\n{key}\n")
    assert time.process_time() - begun < 20.0


def test_texts_full_of_words_and_quotes_are_looked_through_in_time():
    begun = time.process_time()
    for text in (
        "x" * 1_000_000,
        'x "' * 500_000,
        "0.5, " * 300_000,
        "a.b.c " * 200_000,
        '"' * 1_000_000,
        ("a." * 99 + "\n") * 5_000,
    ):
        assert load.DOTTED.search(text) is None
    assert time.process_time() - begun < 5.0


def test_links_in_circles_and_paths_too_long(tmp_path):
    for a, b in (("a.toml", "b.toml"), ("b.toml", "a.toml"), ("a.obj", "b.obj"), ("b.obj", "a.obj")):
        (tmp_path / a).symlink_to(tmp_path / b)
    for name in (tmp_path / "a.toml", "x" * 5000 + ".toml", "a\0b.toml", "x/" * 5000):
        with pytest.raises(SceneError, match="there is no such file"):
            load.load_scene(name)
    with pytest.raises(SceneError, match=r"no path to a file|no such file"):
        (tmp_path / "c.toml").write_text(BALL.replace('{ shape = "sphere", cells = 4 }', '"a.obj"'))
        pdipc.Simulation(load.load_scene(tmp_path / "c.toml"), "cpu")
    for name in ("x" * 5000 + ".obj", "a\0b.obj", str(tmp_path / "a.obj")):
        with pytest.raises(SceneError, match="there is no such file"):
            meshes.read(name)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            {"name": "s", "kind": "solid", "mesh": {"shape": "box", "cells": [4096, 4096, 4096]}},
            "68719476736 cells need at least 1.47e+05 GiB of memory",
        ),
        (cloth(copies={"counts": [100_000, 100_000, 100_000]}), "1000000000000000 copies of 9 vertices need at least"),
    ],
)
def test_what_needs_more_memory_than_there_is_says_how_much(body, message):
    (finding,) = check.check(pdipc.Scene(bodies=[body]))
    assert f'body "{body["name"]}": {message}' in str(finding)
    assert " GiB are free; take fewer c" in str(finding)


def test_files_larger_than_the_memory_are_not_read(tmp_path, monkeypatch):
    for name in ("a.obj", "a.toml"):
        with open(tmp_path / name, "wb") as file:
            file.truncate(10_000)
    monkeypatch.setattr(meshes, "free_memory", lambda: 15_000)
    monkeypatch.setattr(load, "free_memory", lambda: 15_000)
    with pytest.raises(SceneError, match=r"a.obj.: needs at least .* GiB of memory, and .* are free"):
        meshes.read(tmp_path / "a.obj")
    with pytest.raises(SceneError, match=r"a.toml.: needs about .* GiB of memory, and .* are free"):
        load.load_scene(tmp_path / "a.toml")


def test_the_memory_that_shapes_and_copies_need_is_about_what_is_said(monkeypatch):
    """Half of it would not be enough, by Python's own count."""
    import tracemalloc

    for body in (
        {"name": "s", "kind": "solid", "mesh": {"shape": "box", "cells": [20, 20, 20]}},
        {"name": "s", "kind": "cloth", "mesh": {"shape": "grid", "cells": [200, 200]}},
        {"name": "s", "kind": "cloth", "mesh": {"shape": "grid", "cells": [50, 50]}, "copies": {"counts": [30, 1, 1]}},
    ):
        asked: list[int] = []
        monkeypatch.setattr(assembly, "_need", lambda size, *_, asked=asked: asked.append(size))
        tracemalloc.start()
        assembly.assemble(pdipc.Scene(bodies=[body]))
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert 0.5 * used < sum(asked) < 1.5 * used


def test_positions_that_overflow_are_said_beside_what_else_is_wrong():
    scene = pdipc.Scene(
        bodies=[
            cloth(translation=[1.7e308, 0, 0], scale=1.7e308),
            cloth(name="far", translation=[0, 2e9, 0]),
            cloth(name="d", pins=[{"select": {"sphere": [[9, 9, 9], 1]}}]),
        ],
        attachments=[{"bodies": ["c", "d"], "within": 1.0}],
    )
    text = "\n".join(map(str, check.check(scene)))
    assert 'body "c": rest_positions of 3 vertices are not finite' in text
    assert 'body "far": rest_positions of 9 vertices are beyond 1e+09 m' in text
    assert 'body "d", pins[0].select = ' in text
    fast = check.check(pdipc.Scene(bodies=[cloth(velocity=[0, 1e30, 0])]))
    assert "velocities of 9 vertices are beyond 1e+09 m/s" in str(fast[0])


@pytest.mark.parametrize(
    "motion",
    [
        {"keyframes": [{"time": 0}, {"time": 1, "translation": [1e30, 0, 0]}]},
        {"velocity": [0, 1e300, 0]},
        {"angular_velocity": [0, 1e308, 1e308]},
    ],
)
def test_motions_that_lead_out_of_all_bounds(motion):
    plane = {"name": "o", "mesh": {"shape": "plane"}, "translation": [0, -1, 0], "motion": motion}
    (finding,) = check.check(pdipc.Scene(bodies=[cloth()], obstacles=[plane]))
    assert finding.where == 'obstacle "o"' and "its motion leads" in str(finding) and "within 1e+09 m" in str(finding)


def test_check_scene_finds_in_one_pass_what_tables_and_what_geometry_have_wrong(tmp_path):
    (tmp_path / "a.toml").write_text(
        "titel = 1\n[simulation]\nsteps = -1\n"
        + '[[bodies]]\nname = "a"\nkind = "cloth"\nmesh = { shape = "grid" }\n'
        + '[[bodies]]\nname = "b"\nkind = "cloth"\nmesh = { shape = "grid" }\nrotation = [90, 0, 0]\n'
        + '[[bodies]]\nname = "wrong"\nkind = "cloth"\nmesh = { shape = "grid", cell = 1 }\n'
        + '[[bodies]]\nname = "a"\nkind = "cloth"\nmesh = { shape = "grid" }\n'
        + '[[bodies]]\nname = "lost"\nkind = "cloth"\nmesh = "nowhere.obj"\n'
        + '[[attachments]]\nbodies = ["a", "wrong"]\npairs = [[0, 0]]\n'
        + '[[attachments]]\nbodies = ["a", 5]\npairs = [[0, 0]]\n'
        + '[[attachments]]\nbodies = ["a", "unknown"]\npairs = [[0, 0]]\n'
    )
    result = CliRunner().invoke(app, ["check-scene", str(tmp_path / "a.toml")])
    assert result.exit_code == 2
    lines = result.stdout.splitlines()
    for start in (
        "- titel = 1: unknown key",
        "- simulation.steps = -1: must be",
        '- bodies[2] ("wrong").mesh.cell = 1: unknown key',
        "- attachments[1].bodies[1] = 5: must be",
        "- the scene: names must be unique; used more than once: a",
        '- body "lost": mesh file',
        '- attachments[2]: there is no body "unknown"',
        '- body "a" and body "b": ',
    ):
        assert any(line.startswith(start) for line in lines), (start, lines)
    assert len(lines) == 8


def test_what_is_left_out_of_files_is_said_everywhere(tmp_path):
    grid = generators.Grid(size=(1, 1), cells=(2, 2)).mesh()
    lines = [f"v {x} {y} {z}" for x, y, z in grid.vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in grid.triangles]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "l 1 9"]))
    (tmp_path / "a.toml").write_text('[[bodies]]\nname = "c"\nkind = "cloth"\nmesh = "a.obj"\n')
    note = 'note: body "c": 1 lines were left out'
    checked = CliRunner().invoke(app, ["check-scene", str(tmp_path / "a.toml")])
    assert checked.exit_code == 0 and note in checked.stdout
    assert note in CliRunner().invoke(app, ["info", str(tmp_path / "a.toml")]).stderr
    with pytest.warns(SceneWarning, match='body "c": 1 lines were left out'):
        assembly.assemble(load.load_scene(tmp_path / "a.toml"))


# --- obstacles need be no manifolds ---


def test_obstacles_may_be_no_manifolds_and_lose_what_bounds_nothing():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0], [0, -1, 0], [2, 0, 0], [-1, 0, 0], [-1, 0, 1]]
    triangles = [[0, 1, 2], [0, 2, 3], [2, 0, 4], [2, 1, 0], [0, 1, 5], [0, 6, 7], [1, 1, 2]]
    plane = {"name": "o", "mesh": {"vertices": vertices, "triangles": triangles}}
    scene = pdipc.Scene(bodies=[cloth(translation=[5, 0, 0])], obstacles=[plane])
    assert check.check(scene) == []
    with pytest.warns(SceneWarning) as told:
        whole = assembly.assemble(scene)
    assert whole.triangles[-4:].tolist() == [[9, 10, 11], [9, 11, 12], [11, 9, 13], [9, 15, 16]]
    assert [str(each.message) for each in told] == [
        'obstacle "o": 2 triangles without an area were left out',
        'obstacle "o": 1 triangles that were there more than once were left out',
    ]
    flat = {"name": "o", "mesh": {"vertices": vertices, "triangles": [[0, 1, 5]]}}
    (finding,) = check.check(pdipc.Scene(bodies=[cloth(translation=[5, 0, 0])], obstacles=[flat]))
    assert str(finding) == 'obstacle "o": none of its 1 triangles has an area'


def test_cloth_comes_to_rest_on_an_obstacle_that_is_no_manifold():
    """Three walls that share one edge, and a floor that is there twice."""
    vertices = [[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [0, 0, -1], [0, 0, 1], [0, -1, -1], [0, -1, 1]]
    triangles = [[0, 3, 4], [3, 5, 4], [4, 5, 1], [5, 2, 1], [4, 6, 5], [6, 7, 5], [4, 3, 0]]
    floor = {"name": "o", "mesh": {"vertices": vertices, "triangles": triangles}}
    scene = pdipc.Scene(bodies=[cloth(translation=[0.03, 0.01, 0], velocity=[0, -1, 0])], obstacles=[floor])
    with pytest.warns(SceneWarning, match="more than once"):
        sim = pdipc.Simulation(scene, "cpu")
    for _ in range(10):
        sim.step()
        assert not len(pdipc.find_intersections(sim.positions, sim.triangles, sim.model.assembly.obstacle))
    assert 0 < sim.positions[:9, 1].min() < 2e-3


# --- one body that is near to itself ---


def layers(start_gap: float, rest_gap: float, separation: float) -> pdipc.Scene:
    sheet = generators.Grid(size=(1, 1), cells=(3, 3)).mesh()
    n = len(sheet.vertices)
    rest, start = (
        np.concatenate([sheet.vertices, sheet.vertices + np.array([0.03, gap, 0.02])]) for gap in (rest_gap, start_gap)
    )
    mesh = {"vertices": rest, "triangles": np.concatenate([sheet.triangles, sheet.triangles + n]), "start": start}
    contact = {"minimum_separation": separation, "activation_distance": 1e-3}
    return pdipc.Scene(bodies=[{"name": "c", "kind": "cloth", "mesh": mesh}], contact=contact)


@pytest.mark.parametrize(
    ("start", "rest", "refused_at"),
    [
        (5e-4, 0.3, 1e-3),  # nearer than the separation of what is far apart at rest
        (2e-3, 0.3, None),
        (5e-4, 5e-4, None),  # at rest it is as near: a fifth of that is kept
        (2.1e-4, 1e-3, None),
        (1.9e-4, 1e-3, 2e-4),
        (1e-18, 1e-18, 1e-8),  # nothing could move
        (1e-18, 0.3, 1e-3),
    ],
)
def test_layers_of_one_body_nearer_than_their_separation(start, rest, refused_at):
    found = check.check(layers(start, rest, 1e-3))
    assert bool(found) == (refused_at is not None)
    if found:
        assert str(found[0]).startswith('body "c": ')
        assert f"the nearest {start:.3g} m apart near (" in str(found[0])
        assert f"their gap must be more than {refused_at:.3g} m" in str(found[0])


def test_the_rule_is_that_of_the_collision_detection():
    assert check.REST_SEPARATION == candidates.REST_SEPARATION


def test_the_place_of_a_single_gap_is_named():
    sheet = generators.Grid(size=(1, 1), cells=(20, 20)).mesh()
    upper = sheet.vertices + np.array([0.01, 0.05, 0.01])
    upper[100, 1] = 1e-18
    mesh = {
        "vertices": np.concatenate([sheet.vertices, upper]),
        "triangles": np.concatenate([sheet.triangles, sheet.triangles + 441]),
    }
    (finding,) = check.check(pdipc.Scene(bodies=[{"name": "c", "kind": "cloth", "mesh": mesh}]))
    assert upper[100] == pytest.approx([-0.29, 1e-18, 0.31])
    assert "m apart near (-0.29, " in str(finding) and ", 0.31) m;" in str(finding)


def test_memory_that_is_free_is_that_of_the_machine_or_of_its_container(monkeypatch, tmp_path):
    whole = memory.free_memory()
    assert whole > 0
    (tmp_path / "memory.max").write_text("1000\n")
    (tmp_path / "memory.current").write_text("400\n")
    monkeypatch.setattr(memory, "CONTAINER", tmp_path)
    assert memory.free_memory() == 600
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.free_memory() == pytest.approx(whole, rel=0.5)


def test_obstacles_are_judged_also_where_no_body_is_right(tmp_path):
    """One pass finds what is wrong in the tables and what is wrong in the files that they name."""
    for bodies in ("bodies = []\n", "bodies = 3\n", '[[bodies]]\nname = "c"\nkind = "clth"\n'):
        (tmp_path / "a.toml").write_text(
            bodies + '[simulation]\ntime_step = -1\n[[obstacles]]\nname = "o"\nmesh = "none.obj"\n'
        )
        found = [str(finding) for finding in check.check_file(tmp_path / "a.toml")[0]]
        assert len(found) == 3
        assert any(line.startswith("bodies") for line in found) and any("time_step" in line for line in found)
        assert re.search(r'obstacle "o".*none\.obj.*no such file', found[-1])


@pytest.mark.parametrize("place", [1e30, 1e200, 1e300])
def test_a_rigid_body_beyond_all_numbers(place):
    body = {"name": "r", "kind": "rigid", "mesh": {"shape": "box", "cells": [1, 1, 1]}, "translation": [place, 0, 0]}
    with np.errstate(all="ignore"):
        (found,) = check.check(pdipc.Scene(bodies=[body]))
    assert re.search(r'body "r": rest_positions .* beyond 1e\+09 m', str(found))


def test_gravity_beyond_all_numbers():
    (found,) = check.check(pdipc.Scene(simulation={"gravity": [0, -1e300, 0]}, bodies=[cloth()]))
    assert str(found).startswith("simulation.gravity: is [0.0, -1e+300, 0.0]")
