"""Table 1 by one command: the paper's cells beside ours, rows that are done are kept, and what a row cannot have is refused."""

import csv
import json

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("matplotlib", reason="needs matplotlib (extra: pictures)")
pytest.importorskip("pyvista", reason="needs pyvista (extra: pictures)")

import data

from pdipc.cli import app
from pdipc.output.results import open_run
from pdipc.reproduce import _common, _filled, _scenes, table1
from pdipc.scene.assembly import assemble
from pdipc.scene.check import check
from pdipc.scene.load import load_scene
from pdipc.scene.meshes import boundary, tet_volumes, triangle_areas

TABLE = {  # bodies, degrees of freedom, elements: Table 1 of the paper
    "dinosaur": (4, 69e3, 103e3),
    "dragon": (1, 80e3, 100e3),
    "armadillo": (3, 78e3, 77e3),
    "skirt": (1, 91e3, 59e3),
    "helicopters": (3, 150e3, 224e3),
    "bone_dragon": (4, 109e3, 89e3),
    "animals": (21, 218e3, 293e3),
    "halloween": (13, 249e3, 265e3),
}


def run(*options):
    return CliRunner().invoke(app, ["reproduce", "table1", "--small", *map(str, options)])


def test_both_modes_and_going_on(tmp_path, monkeypatch):
    """A row in both modes; called again, nothing is run or judged anew; with more steps, only those are."""
    monkeypatch.setattr(table1, "SHOTS", (1.0,))
    options = ["--rows", "dragon", "--mode", "both", "-o", tmp_path]
    told = run(*options, "--steps", 2)
    assert told.exit_code == 0, told.output
    with (tmp_path / "table1.csv").open() as file:
        paper, default, printed = csv.DictReader(file)
    assert (paper["bodies"], paper["L-G"], paper["FPS"]) == ("1", "44", "14.6 to 119.3")
    assert (default["bodies"], default["DOF"], default["order"], default["L-G"]) == ("1", "6132", "-", "0")
    assert printed["order"] == "3" and int(printed["L-G"]) > 0
    assert default["steps"] == "2" and default["intersections"] == printed["intersections"] == "0"
    assert default["unconverged"] == "0"
    assert float(default["processor ms"]) > 0.0 and 50 < int(default["memory, MiB"]) < 10_000
    assert float(printed["away from default, mm"]) > 0.0 and default["away from default, mm"] == ""
    assert "Here" in told.output and "every frame judged by the witness" in told.output.replace("\n", " ")
    written = json.loads((tmp_path / "table1.json").read_text())
    assert written["machine"] and len(written["rows"]) == 2
    for name in ("dragon.png", "scenes.png", "table1.png"):
        assert (tmp_path / name).stat().st_size > 20_000
    for mode in ("default", "paper"):
        assert (tmp_path / f"dragon-{mode}.mp4").stat().st_size > 1000
    before = open_run(tmp_path / "dragon-default").positions(-1)

    def not_again(*_):
        raise AssertionError("judged again")

    with monkeypatch.context() as patched:
        patched.setattr(_common, "intersections", not_again)
        patched.setattr(_common, "pictures", not_again)
        assert run(*options, "--steps", 2).exit_code == 0
    monkeypatch.setattr(table1, "_films", lambda *_: None)
    assert run("--rows", "dragon", "-o", tmp_path, "--steps", 3).exit_code == 0
    longer = open_run(tmp_path / "dragon-default")
    assert longer.frame_count == 4
    np.testing.assert_array_equal(longer.positions(2), before)


@pytest.mark.parametrize(
    "options, said",
    [
        (["table1", "--rows", "unicorn"], 'there is no "unicorn"; there are: dinosaur'),
        (["table1", "--mode", "fast"], "default, paper or both"),
        (["table1", "--steps", "0"], "--steps"),
        (["fig9", "--rows", "dragon"], "--rows"),
    ],
)
def test_what_is_refused(options, said, tmp_path):
    told = CliRunner().invoke(app, ["reproduce", *options, "--small", "-o", str(tmp_path / "out")])
    assert told.exit_code != 0
    assert said in " ".join(told.output.replace("│", " ").split())
    assert not list(tmp_path.rglob("run.json"))


def test_full_sizes_need_data(tmp_path, monkeypatch):
    monkeypatch.setenv("PDIPC_DATA", str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match="PDIPC_DATA"):
        _scenes.falling_dinosaur()


@pytest.mark.parametrize("row", ["dinosaur", "armadillo", "skirt"])
def test_full_sizes(row, monkeypatch):
    """Bodies, degrees of freedom and elements within 10 % of the table; the scene can be simulated."""
    data.path("manifest.json")
    monkeypatch.setenv("PDIPC_DATA", str(data.FOLDER))
    scene = table1.ROWS[row].full()
    assembly = assemble(scene)
    bodies, freedom, elements = TABLE[row]
    simulated = [body for body in assembly.bodies if not body.kinematic]
    assert len(simulated) == bodies
    assert 3 * simulated[-1].last == pytest.approx(freedom, rel=0.1)
    assert sum(len(body.tets) or len(body.triangles) for body in simulated) == pytest.approx(elements, rel=0.1)
    assert check(assembly) == []


def test_paper_mode_keeps_the_bodies():
    """It changes how contact is solved, and nothing else."""
    scene = load_scene("armadillo")
    printed = table1.paper_mode(scene, 3)
    assert printed.contact.method == "paper" and printed.contact.friction == 0.0 and printed.simulation.solver_order == 3
    assert printed.model_dump(include={"bodies", "forces"}) == scene.model_dump(include={"bodies", "forces"})


def test_paper_mode_takes_every_row():
    """Also that whose closed cloth is filled, which the mode cannot do."""
    for row in ("halloween", "skirt"):
        assert check(table1.paper_mode(load_scene(table1.ROWS[row].bundled), 2)) == []


def test_filled(tmp_path, monkeypatch):
    """An open, doubled surface is filled to the volume that it winds around; the second call reads what the first kept."""
    monkeypatch.setenv("PDIPC_CACHE", str(tmp_path))
    body = load_scene("dragon").bodies[0].mesh.model_copy(update={"name": "turtle"}).mesh()
    triangles = np.concatenate([body.triangles[6:], body.triangles[6:9]])  # a hole, and three faces twice
    mesh = _filled.filled(7.0 * body.vertices, triangles, 2000, "turtle")
    assert len(mesh["tets"]) == pytest.approx(2000, rel=0.05)
    volumes = tet_volumes(mesh["vertices"], mesh["tets"])
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(343.0 * tet_volumes(body.vertices, body.tets).sum(), rel=0.1)
    (kept,) = tmp_path.glob("*.npz")
    monkeypatch.setattr(_filled, "stuffed", None)
    np.testing.assert_array_equal(_filled.filled(7.0 * body.vertices, triangles, 2000, "turtle")["tets"], mesh["tets"])
    assert kept.is_file()


def test_a_finer_surface_keeps_the_shape():
    """So many more vertices, all on the surface; volume and area stay, and neighbours still match."""
    body = load_scene("dragon").bodies[0].mesh.model_copy(update={"name": "pig", "cells": 10}).mesh()
    points, tets = _filled.with_finer_surface(body.vertices, body.tets, 500)
    assert len(points) == len(body.vertices) + 500
    volumes = tet_volumes(points, tets)
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(tet_volumes(body.vertices, body.tets).sum())
    surface = boundary(tets)
    assert len(surface) == len(body.triangles) + 2 * 500
    assert triangle_areas(points, surface).sum() == pytest.approx(triangle_areas(body.vertices, body.triangles).sum())
    assert set(range(len(body.vertices), len(points))) <= set(surface.ravel().tolist())
