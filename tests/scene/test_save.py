"""Scenes that are saved load to the same scene."""

import tomllib
import typing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

import pdipc
from pdipc.scene import save, schema
from pdipc.scene.assembly import assemble
from pdipc.scene.check import check
from pdipc.scene.generators import Grid
from pdipc.scene.load import bundled_scenes, load_scene
from tests.physics.scenes import cloth, floor, solid


def same(a: pdipc.Scene, b: pdipc.Scene) -> bool:
    return a.model_dump_json() == b.model_dump_json()


@pytest.mark.parametrize("name", bundled_scenes())
def test_bundled_scenes(name, tmp_path):
    scene = load_scene(name)
    scene.save(tmp_path / "saved.toml")
    assert same(load_scene(tmp_path / "saved.toml"), scene)


def everything() -> pdipc.Scene:
    """Each kind of body, mesh, motion, pin, link, force and world that a scene may have."""
    sheet = Grid(size=(1.0, 1.0), cells=(3, 3)).mesh()
    corners, triangles = sheet.vertices, sheet.triangles
    arrays = {"vertices": corners, "triangles": triangles}
    turn = {"keyframes": [{"time": 0.0}, {"time": 1.0, "rotation": [0, 270, 0]}], "smooth": True, "turns": "shortest"}
    pins = [
        {"select": {"nearest": [0, 3, 0]}, "motion": turn},
        {"select": {"box": [[-1, 2, -1], [0, 4, 1]]}, "axes": "yz", "stiffness": 30.0, "start": 0.1, "end": 0.2},
        {"select": {"sphere": [[0, 3, 0], 0.1]}, "follow": "hand", "end": 0.5},
    ]
    box, woven = {"shape": "box", "size": [0.1] * 3}, {"warp": [1, 0, 0], "weft_stiffness": 50.0, "strain_limit": 1.05}
    rest = {"scale": 0.5, "mesh": arrays}
    cache = {"vertices": np.stack([corners, corners / 3]), "times": [0.0, 0.3]}
    return pdipc.Scene(
        title='a "quoted" title',
        simulation={"precision": "float64", "budget_ms": 4.5},
        contact={"start": "separate", "quarantine": [["soft", "ring"]]},
        bodies=[
            {"name": "soft", "kind": "solid", "mesh": box, "copies": {"counts": [2, 1, 1]}, "look": {"color": "red"}},
            {"name": "ring", "kind": "rigid", "mesh": {"shape": "torus"}, "angular_velocity": [1, 0, 0]},
            {"name": "rope", "kind": "rod", "mesh": {"shape": "rope", "length": 0.5}, "material": {"radius": 2e-3}},
            {"name": "my sheet", "kind": "cloth", "mesh": {"shape": "grid"}, "material": woven, "pins": pins},
            {"name": "ball", "kind": "cloth", "mesh": {"shape": "sphere"}, "inside": {"gas": 101325.0}},
            {"name": "cut", "kind": "cloth", "mesh": {**arrays, "start": corners + 1.0}, "rest": rest, "weld": 1e-6},
        ],
        obstacles=[
            {"name": "hand", "mesh": box, "motion": {"angular_velocity": [0, 1, 0], "center": [0, 3, 0], "end": 1.0}},
            {"name": "ground", "mesh": arrays, "motion": {"cache": cache}},
            {"name": "tank", "mesh": box, "scale": [9, 8, 7], "inward": True},
        ],
        attachments=[{"bodies": ["rope", "my sheet"], "pairs": [[0, 1], [2, 3]], "rest_length": 0.1}],
        stitches=[{"bodies": ["my sheet", "cut"], "points": [[0, [1, 2], [0.25, 0.75]]], "duration": 0.5}],
        forces=[
            {"kind": "wind", "velocity": [1, 0, 0], "bodies": ["cut"], "start": 0.1},
            {"kind": "vertices", "body": "soft", "select": {"all": True}, "force": [0, 1, 0], "end": 2.0},
        ],
        picture={"view": [1, 0.2, 1], "color": "pressure", "top": 1e3},
        worlds=[{"contact.friction": 0.1, 'bodies."my sheet".material.strain_limit': 1.1}, {}],
    )


def test_all_that_a_scene_may_have(tmp_path):
    scene = everything()
    scene.save(tmp_path / "saved.toml")
    assert same(load_scene(tmp_path / "saved.toml"), scene)
    given = {name for name in schema.Scene.model_fields if getattr(scene, name) != schema.Scene.model_fields[name].default}
    assert given == set(schema.Scene.model_fields) - {"description"}, "this test is to hold every table"


def test_what_was_changed_since_and_nothing_else(tmp_path):
    scene = pdipc.Scene(bodies=[cloth("sheet", [1.0, 1.0], [3, 3])])
    scene.simulation.steps = 7  # a table that was not given
    scene.bodies[0].material.bending = "curved"
    scene.obstacles.append(pdipc.Scene(bodies=[solid("b", (1, 1, 1), (1, 1, 1))], obstacles=[floor()]).obstacles[0])
    scene.save(tmp_path / "saved.toml")
    found = load_scene(tmp_path / "saved.toml")
    assert same(found, scene)
    assert tomllib.loads((tmp_path / "saved.toml").read_text())["simulation"] == {"steps": 7}
    assert found.bodies[0].material.model_fields_set == scene.bodies[0].material.model_fields_set
    assert "contact" not in (tmp_path / "saved.toml").read_text()


def test_arrays_keep_their_bits(tmp_path):
    vertices = np.random.default_rng(0).normal(size=(40, 3)) * np.logspace(-12, 6, 40)[:, None]
    mesh = {"vertices": vertices, "triangles": [[0, 1, 2], [1, 2, 3]]}
    scene = pdipc.Scene(bodies=[{"name": 'a "b" \\ \n \x7f ü', "kind": "cloth", "mesh": mesh}])
    scene.save(tmp_path / "saved.toml")
    found = load_scene(tmp_path / "saved.toml")
    assert np.array_equal(found.bodies[0].mesh.vertices, vertices)
    assert found.bodies[0].name == scene.bodies[0].name


@pytest.mark.parametrize("elsewhere", [False, True])
def test_mesh_files_are_found_from_where_it_is_saved(tmp_path, monkeypatch, elsewhere):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/sheet.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    scene = pdipc.Scene(bodies=[{"name": "sheet", "kind": "cloth", "mesh": "meshes/sheet.obj"}])
    folder = tmp_path / "saved" if elsewhere else tmp_path
    folder.mkdir(exist_ok=True)
    scene.save(folder / "scene.toml")
    monkeypatch.chdir("/")
    assert len(assemble(load_scene(folder / "scene.toml")).positions) == 3
    assert ('mesh = "meshes/sheet.obj"' in (folder / "scene.toml").read_text()) is not elsewhere


def test_only_toml_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.toml"):
        pdipc.Scene(bodies=[cloth("sheet", [1.0, 1.0], [3, 3])]).save(tmp_path / "scene.json")


def test_every_key_that_names_a_file_is_known():
    """Those that loading takes as relative to the scene's file."""
    found = set()

    def look(annotation, key):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            for name, field in annotation.model_fields.items():
                look(field.annotation, name)
                look(typing.Annotated[(str, *field.metadata)] if field.metadata else str, name)
        for part in typing.get_args(annotation):
            if getattr(part, "func", None) is schema._resolve:
                found.add(key)
            elif not isinstance(part, str):
                look(part, key)

    look(pdipc.Scene, "")
    assert found == set(save.FILES)


def test_caches_are_found_from_where_it_is_saved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    np.savez("still.npz", V=np.stack([corners, corners + np.array([0, 0.1, 0])]), times=[0.0, 1.0])
    mesh = {"vertices": corners, "triangles": [[0, 1, 2]]}
    obstacle = {"name": "o", "mesh": mesh, "motion": {"cache": "still.npz"}}
    scene = pdipc.Scene(bodies=[cloth("sheet", [1.0, 1.0], [3, 3], at=(0, 1, 0))], obstacles=[obstacle])
    (tmp_path / "saved").mkdir()
    scene.save(tmp_path / "saved/scene.toml")
    monkeypatch.chdir("/")
    assert not check(load_scene(tmp_path / "saved/scene.toml"))


numbers = st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**63), 2**63 - 1)
plain = st.recursive(
    numbers | st.booleans() | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.from_regex("[a-z_]+", fullmatch=True), inner, max_size=3),
    max_leaves=20,
)


@given(plain)
def test_any_value_is_toml(value):
    assert tomllib.loads(f"value = {save._value(value)}")["value"] == value
