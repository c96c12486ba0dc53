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

pytest.importorskip("pxr.Usd")
from tests.export.test_usd import SCENE, SINGLE, make_stage

BLENDER = sys.executable if importlib.util.find_spec("bpy") else os.environ.get("BPY_PYTHON", "")


@pytest.mark.skipif(not BLENDER, reason="no bpy here; pip install bpy, or name a Python that has it in BPY_PYTHON")
def test_blender_shows_the_run(tmp_path):
    make_stage(tmp_path / "shot.usda")
    (tmp_path / "scene.toml").write_text(SCENE)
    pdipc.run_scene(pdipc.load_scene(tmp_path / "scene.toml"), tmp_path / "run", device="cpu")
    run = open_run(tmp_path / "run")
    stage = export(run, "stage", tmp_path / "cache.usda")
    caches = export(run, "mdd", tmp_path / "caches")
    script = Path(__file__).with_name("in_blender.py")
    command = [BLENDER, str(script), str(stage), str(caches), str(tmp_path / "out.npz")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
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
