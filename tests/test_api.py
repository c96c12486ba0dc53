"""The public names: where they lead, that nothing heavy comes with them, and that a scene can be built from them."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import pdipc

OF_VERSION_0_1 = {
    "RunError",
    "Scene",
    "SceneError",
    "Simulation",
    "build",
    "check_scene",
    "find_intersections",
    "load_scene",
    "open_run",
    "run_scene",
    "run_sweep",
    "simulate",
    "step",
    "time_of_impact",
}


@pytest.mark.parametrize("name", pdipc.__all__)
def test_every_name_is_the_one_of_its_module(name):
    value = getattr(pdipc, name)
    path, _, attribute = pdipc._PUBLIC[name].partition(":")
    assert value.__module__ == path and value.__name__ == (attribute or name)
    assert value.__doc__


def test_lists_of_names_agree():
    """What runs, what type checkers read, and what `from pdipc import *` gives."""
    tree = ast.parse(Path(pdipc.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    typed = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            suffix = "" if alias.asname == alias.name else f":{alias.name}"
            typed[alias.asname] = f"{node.module}{suffix}"
    assert typed == pdipc._PUBLIC
    assert sorted(pdipc.__all__) == sorted(pdipc._PUBLIC)
    assert OF_VERSION_0_1 < set(pdipc.__all__) < set(dir(pdipc))
    assert Path(pdipc.__file__).with_name("py.typed").exists()
    with pytest.raises(AttributeError, match="no attribute 'Sceen'"):
        pdipc.Sceen  # noqa: B018


def test_import_loads_nothing_heavy():
    code = (
        "import sys, pdipc\n"
        "def heavy(): return {'warp', 'numpy', 'scipy', 'pydantic', 'meshio', 'trimesh', 'h5py', 'rich'} & set(sys.modules)\n"
        "assert not heavy(), heavy()\n"
        "pdipc.Cloth, pdipc.Motion, pdipc.check_scene\n"  # what a scene is made of does not need the device
        "assert 'pydantic' in heavy() and 'warp' not in heavy(), heavy()\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_a_scene_of_typed_tables_is_that_of_dictionaries():
    typed = pdipc.Scene(
        simulation=pdipc.SimulationSettings(time_step=0.005, steps=3),
        contact=pdipc.Contact(friction=0.2),
        bodies=[
            pdipc.Cloth(
                name="cloth",
                mesh={"shape": "grid", "cells": [4, 4]},
                material=pdipc.ClothMaterial(areal_density=0.3),
                pins=[pdipc.Pin(select=pdipc.Selection(vertices=[0]), motion=pdipc.Motion(velocity=(0.0, 0.1, 0.0)))],
            ),
            pdipc.Solid(name="block", mesh={"shape": "box"}, translation=(0.0, 2.0, 0.0)),
        ],
        obstacles=[pdipc.Obstacle(name="floor", mesh={"shape": "plane"}, translation=(0.0, -1.0, 0.0))],
        forces=[pdipc.Wind(velocity=(1.0, 0.0, 0.0))],
    )
    plain = pdipc.Scene(
        simulation={"time_step": 0.005, "steps": 3},
        contact={"friction": 0.2},
        bodies=[
            {
                "name": "cloth",
                "kind": "cloth",
                "mesh": {"shape": "grid", "cells": [4, 4]},
                "material": {"areal_density": 0.3},
                "pins": [{"select": {"vertices": [0]}, "motion": {"velocity": [0, 0.1, 0]}}],
            },
            {"name": "block", "kind": "solid", "mesh": {"shape": "box"}, "translation": [0, 2, 0]},
        ],
        obstacles=[{"name": "floor", "mesh": {"shape": "plane"}, "translation": [0, -1, 0]}],
        forces=[{"kind": "wind", "velocity": [1, 0, 0]}],
    )
    assert typed == plain
    assert pdipc.check_scene(typed) == []
