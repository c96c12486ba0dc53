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
from pdipc.scene.load import bundled_scenes, load_scene
from tests.physics.scenes import cloth, floor, solid


def same(a: pdipc.Scene, b: pdipc.Scene) -> bool:
    return a.model_dump_json() == b.model_dump_json()


@pytest.mark.parametrize("name", bundled_scenes())
def test_bundled_scenes(name, tmp_path):
    scene = load_scene(name)
    scene.save(tmp_path / "saved.toml")
    assert same(load_scene(tmp_path / "saved.toml"), scene)


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
