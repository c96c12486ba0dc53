"""Blender, headless, opens exports and shows the run: with `bpy` in this Python, or in the one that BPY_PYTHON names."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pdipc
from pdipc.export.export import export
from pdipc.output.results import open_run
from pdipc.scene import meshes
from pdipc.scene.frames import read_frames

Usd = pytest.importorskip("pxr.Usd")
from tests.export.test_usd import SCENE, SINGLE, make_stage  # noqa: E402

FROM_BLENDER = """
[simulation]
steps = 11
time_step = 0.0333333333
precision = "float64"
[[bodies]]
name = "sheet"
kind = "cloth"
mesh = "shot.usdc</root/Stand/Sheet>"
[[obstacles]]
name = "spinner"
mesh = "shot.usdc</root/Spinner>"
motion = { cache = "shot.usdc</root/Spinner>" }
"""
BLENDER = sys.executable if importlib.util.find_spec("bpy") else os.environ.get("BPY_PYTHON", "")


pytestmark = pytest.mark.skipif(not BLENDER, reason="no bpy here; pip install bpy, or name a Python that has it in BPY_PYTHON")


def blender(script, *arguments):
    command = [BLENDER, str(Path(__file__).with_name(script)), "--", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]


def test_blender_shows_the_run(tmp_path):
    make_stage(tmp_path / "shot.usda")
    (tmp_path / "scene.toml").write_text(SCENE)
    pdipc.run_scene(pdipc.load_scene(tmp_path / "scene.toml"), tmp_path / "run", device="cpu")
    run = open_run(tmp_path / "run")
    stage = export(run, "stage", tmp_path / "cache.usda")
    caches = export(run, "mdd", tmp_path / "caches")
    blender("in_blender.py", stage, caches, tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as file:
        shown = {name: file[name] for name in file.files}
    assert {"World", "Sheet", "Floor"} <= set(shown["objects"])  # a parent of one mesh is merged with it
    assert shown["fps"] == 24.0 and shown["range"][0] == 1001
    assert (shown["polygons"] == 4).all() and len(shown["uvs"]) == shown["polygons"].sum()
    assert shown["uvs"].min() == 0.0 and shown["uvs"].max() == 1.0
    own = run.topology["body_of_vertex"] == 0
    for frame in range(6):
        x = run.positions(frame)[own] * [1, 1, -1]
        expected = x[:, [0, 2, 1]]  # Blender has z up
        np.testing.assert_allclose(shown["stage"][frame], expected, atol=SINGLE, err_msg=f"stage, frame {frame}")
        np.testing.assert_allclose(shown["mdd"][frame], expected, atol=SINGLE, err_msg=f"mdd, frame {frame}")


def test_a_scene_of_blenders_goes_out_and_comes_back(tmp_path):
    """Made and exported by Blender, with a parent's scale and an object that turns by keys; simulated; shown by Blender: the sheet falls onto the
    cube as in the run, and the cube turns as it did before.
    """
    blender("from_blender.py", "make", tmp_path / "shot.usdc")
    (tmp_path / "scene.toml").write_text(FROM_BLENDER)
    pdipc.run_scene(pdipc.load_scene(tmp_path / "scene.toml"), tmp_path / "run", device="cpu")
    run = open_run(tmp_path / "run")
    stage = export(run, "stage", tmp_path / "cache.usdc")
    shown = []
    for name in (tmp_path / "shot.usdc", stage):
        blender("from_blender.py", "show", name, tmp_path / "out.npz")
        with np.load(tmp_path / "out.npz") as file:
            shown.append({key: file[key] for key in file.files})
    before, after = shown
    assert before["start"] == after["start"] == 1  # Blender's frames are the stage's time codes; its rate stays its own
    rates = [Usd.Stage.Open(str(name)).GetTimeCodesPerSecond() for name in (tmp_path / "shot.usdc", stage)]
    assert rates == [30.0, 30.0]
    np.testing.assert_allclose(after["Spinner"], before["Spinner"], atol=SINGLE)
    turned = before["Spinner"][-1] - before["Spinner"][0]
    assert np.linalg.norm(turned, axis=1).max() > 0.4
    np.testing.assert_allclose(after["Sheet"][0], before["Sheet"][0], atol=SINGLE)
    of_vertex = run.topology["body_of_vertex"]
    for frame in range(12):
        for number, name in enumerate(("Sheet", "Spinner")):
            x = run.positions(frame)[of_vertex == number] * [1, 1, -1]
            np.testing.assert_allclose(after[name][frame], x[:, [0, 2, 1]], atol=SINGLE, err_msg=f"{name}, frame {frame}")
    assert after["Sheet"][-1][:, 2].min() < after["Sheet"][0][:, 2].min() - 0.3


def test_an_archive_of_blenders_is_read_as_blender_shows_it(tmp_path):
    pytest.importorskip("alembic3d", reason='the extra "alembic" is not installed')
    blender("from_blender.py", "make_alembic", tmp_path / "shot.abc", tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as file:
        shown = {name: file[name][..., [0, 2, 1]] * [1, 1, -1] for name in file.files}  # Blender has z up
    assert meshes.read(tmp_path / "shot.abc").notes == [
        "objects were left out: 1 Camera",
        "it moves or deforms at 12 times: it was read as it is at the start",
    ]
    for name, path in (("Sheet", "/Stand/Sheet"), ("Mirrored", "/Mirrored")):
        contents = meshes.contents(Path(f"{tmp_path}/shot.abc<{path}>"))
        np.testing.assert_allclose(contents.points, shown[name][0], atol=SINGLE)
    for name in ("Spinner", "Bag"):
        frames, _ = read_frames(f"{tmp_path}/shot.abc</{name}>", None)
        np.testing.assert_allclose(frames.times * 30, np.arange(12), atol=1e-9)
        np.testing.assert_allclose(frames.points, shown[name], atol=SINGLE)
    for name in ("Spinner", "Bag", "Mirrored"):
        mesh = meshes.read(f"{tmp_path}/shot.abc</{name}>")
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
        assert np.einsum("ij,ij->", np.cross(a, b), c) > 0, "it faces outward"
