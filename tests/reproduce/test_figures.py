"""The figures of simulations in their small size: files are written, and what the pictures show is so."""

import csv
import shutil

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="needs matplotlib (extra: pictures)")
pytest.importorskip("pyvista", reason="needs pyvista (extra: pictures)")

from pdipc.device.launch import Device
from pdipc.output.results import open_run
from pdipc.reproduce import _beside_ipc, _common, _scenes, _snapshots, fig9, fig10, fig11_ipc, fig12, fig13
from pdipc.scene import meshes
from pdipc.scene.load import load_scene


@pytest.fixture(autouse=True)
def generated(monkeypatch, tmp_path):
    """Small figures need no data; here there is none."""
    monkeypatch.setenv("PDIPC_DATA", str(tmp_path / "none"))


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def check_files(picture, told):
    """The PNG, the CSV and the sentence, which is printed last."""
    assert picture.stat().st_size > 20_000
    assert picture.with_suffix(".csv").is_file()
    sentence = picture.with_suffix(".txt").read_text()
    assert sentence.startswith("Paper, ") and "Here" in sentence
    assert told.endswith(sentence)


@pytest.mark.parametrize("capsules", [_common.DINOSAUR, _common.BIPED])
def test_generated_bodies(capsules):
    """Closed, of positive tets, in one piece and free of intersections."""
    body = _common.creature(capsules, 0.09)
    mesh = meshes.Mesh.of_tets(body["vertices"], body["tets"])
    assert meshes.tet_volumes(mesh.vertices, mesh.tets).min() > 0.0
    assert len(_common.find_intersections(mesh.vertices, mesh.triangles)) == 0
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(1.0, abs=0.2)


def test_patches_cover_every_triangle_once_and_boxes_hold_them():
    body = _common.creature(_common.BIPED, 0.09)
    mesh = meshes.Mesh.of_tets(body["vertices"], body["tets"])
    culling, patch = fig9.patches_of(mesh.vertices, mesh.triangles, Device("cpu", threads=1))
    listed = culling.surface.members[2]
    assert len(patch) == len(listed) == len(mesh.triangles)
    assert len(np.unique(np.sort(listed, axis=1), axis=0)) == len(mesh.triangles)
    low, high = fig9.boxes(culling, culling.tree.leaves.bit_length() - 1)
    corners = mesh.vertices[listed]
    assert np.all(corners >= low[patch][:, None] - 1e-6) and np.all(corners <= high[patch][:, None] + 1e-6)
    for level in range(culling.tree.leaves.bit_length()):  # every level holds the whole body
        low, high = fig9.boxes(culling, level)
        np.testing.assert_allclose(
            [low.min(axis=0), high.max(axis=0)], [mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], atol=1e-6
        )


def test_fig9(tmp_path, capsys):
    check_files(fig9.run(tmp_path, small=True, device="cpu"), capsys.readouterr().out)
    counts = [int(row["boxes"]) for row in rows(tmp_path / "fig9.csv")]
    assert counts[0] == 1 and counts == sorted(counts)
    volumes = [float(row["total_volume"]) for row in rows(tmp_path / "fig9.csv")]
    assert volumes[-1] < 0.7 * volumes[0]


def test_fig10(tmp_path, capsys):
    """Plain PD is held by the rods and passes the thin ones; ours is held by both and never intersects."""
    pytest.importorskip("cholespy", reason="needs cholespy (extra: benchmarks)")
    check_files(fig10.run(tmp_path, small=True, device="cpu"), capsys.readouterr().out)
    found = rows(tmp_path / "fig10.csv")
    last = {(row["rods"], row["method"]): float(row["part_below_the_rods"]) for row in found}
    assert last["thin rods", "plain PD"] > 0.9
    assert last["rods", "plain PD"] < 0.1
    assert max(last["rods", "this package"], last["thin rods", "this package"]) < 0.2
    crossing = {(row["rods"], row["method"]): 0 for row in found}
    for row in found:
        crossing[row["rods"], row["method"]] += int(row["intersections"])
    assert crossing["rods", "this package"] == crossing["thin rods", "this package"] == 0
    assert crossing["thin rods", "plain PD"] > 0


def test_fig12(tmp_path, capsys):
    """Nothing intersects, boards arrive, and both methods flatten the body alike."""
    pytest.importorskip("cholespy", reason="needs cholespy (extra: benchmarks)")
    pytest.importorskip("ipctk", reason="needs ipctk (extra: benchmarks)")
    check_files(fig12.run(tmp_path, small=True, device="cpu"), capsys.readouterr().out)
    found = rows(tmp_path / "fig12.csv")
    assert len(found) == 2 * fig12.SMALL_STEPS
    assert all(int(row["intersections"]) == 0 for row in found)
    assert all(row["converged"] == "True" for row in found)
    ours, theirs = open_run(tmp_path / "ours"), open_run(tmp_path / "ipc")
    x, y = ours.positions(-1), theirs.positions(-1)
    size = np.linalg.norm(np.ptp(x[~ours.scripted], axis=0))
    np.testing.assert_allclose(x[ours.scripted], y[ours.scripted], atol=1e-9)
    assert np.linalg.norm(x - y, axis=1).mean() < 3e-3 * size


@pytest.fixture
def colliding(monkeypatch):
    """Two helicopters of few elements that meet in the second of two steps."""

    def scene(name, cells):
        data = load_scene(name).model_dump()
        data["simulation"]["steps"] = 2
        data["bodies"] = data["bodies"][:2]
        for body, x in zip(data["bodies"], (-0.36, 0.36), strict=True):
            body["mesh"]["cells"] = 10
            body["translation"] = (x, *body["translation"][1:])
        return type(load_scene(name)).model_validate(data)

    monkeypatch.setattr(_scenes, "refined", scene)
    monkeypatch.setattr(_snapshots, "PANEL", (160, 120))
    return scene("rubber_helicopters", {})


def test_helicopters_beside_ipc(tmp_path, capsys, colliding):
    """Both come to the same end, in contact, and none intersects; times are positive."""
    pytest.importorskip("cholespy", reason="needs cholespy (extra: benchmarks)")
    pytest.importorskip("ipctk", reason="needs ipctk (extra: benchmarks)")
    check_files(fig11_ipc.run(tmp_path, small=True, device="cpu"), capsys.readouterr().out)
    found = rows(tmp_path / "fig11_ipc.csv")
    assert [int(row["step"]) for row in found] == [1, 2]
    assert max(int(row["barriers"]) for row in found) > 0
    for who in ("this package", "IPC"):
        assert all(row[f"converged of {who}"] == "True" and float(row[f"seconds of {who}"]) > 0.0 for row in found)
    assert float(found[-1]["mean distance, m"]) < 1e-5
    assert "intersections 0 and 0" in (tmp_path / "fig11_ipc.txt").read_text()
    again = _beside_ipc.single_steps(_beside_ipc.with_arap(colliding), open_run(tmp_path / "ours"), [2], tmp_path / "again")
    apart = np.linalg.norm(again.positions(-1) - open_run(tmp_path / "ours").positions(2), axis=1)
    assert apart.mean() < 1e-5  # the second step, from where ours starts it


def test_a_log_is_told_of_progress():
    """A line each minute and one at the end, with what is left at the rate so far; a run that goes on began at what it had."""
    lines, now = [], [0.0]
    advance = _common.lines_of_progress("row", 20, lines.append, lambda: now[0])
    for done in range(11, 21):
        now[0] += 30.0
        advance(done, f"contacts {done}")
    assert lines == [
        f"row: {done}/20 contacts {done}, {left} left"
        for done, left in zip((12, 14, 16, 18, 20), ("0:04:00", "0:03:00", "0:02:00", "0:01:00", "0:00:00"), strict=True)
    ]


def test_snapshots(tmp_path, capsys, monkeypatch):
    """A figure of two rows: each is run once, judged at every frame, and drawn as a line of panels; a large picture goes on top."""
    from matplotlib.image import imread

    begun = []

    def shortened(name):
        scene = load_scene(name)
        scene.simulation.steps = 2
        begun.append(name)
        return scene

    monkeypatch.setattr(_snapshots, "load_scene", shortened)
    monkeypatch.setattr(_snapshots, "PANEL", (160, 120))
    monkeypatch.setattr(_snapshots, "WIDE", (300, 200))
    check_files(fig13.run(tmp_path, small=True, device="cpu"), capsys.readouterr().out)
    assert begun == ["dragon", "armadillo"]
    image = imread(tmp_path / "fig13.png")
    assert image.shape[:2] == (2 * 120 + _snapshots.GAP, 4 * 160 + 3 * _snapshots.GAP)
    found = rows(tmp_path / "fig13.csv")
    assert [row["row"] for row in found] == ["dragon", "dragon", "armadillo", "armadillo"]
    assert all(row["intersections"] == "0" and row["converged"] == "True" for row in found)
    stacked = _snapshots._stacked([np.zeros((20, 30, 3), dtype=np.uint8), np.zeros((10, 12, 3), dtype=np.uint8)])
    assert stacked.shape == (30 + _snapshots.GAP, 30, 3)
    assert np.all(stacked[20 : 20 + _snapshots.GAP] == 255) and np.all(stacked[-10:, :9] == 255)
    assert np.all(stacked[-10:, 9:21] == 0)


def test_a_stopped_figure_goes_on_where_it_was(tmp_path):
    """The same bits as without a stop; a run of another scene is begun anew."""
    scene = load_scene("armadillo")
    scene.simulation.steps = 3
    whole = _common.simulated(scene, tmp_path / "whole", "whole", "cpu").positions(-1)
    part = tmp_path / "part"
    shutil.copytree(tmp_path / "whole", part)
    (part / "checkpoints" / "000003.npz").unlink()
    again = _common.simulated(scene, part, "part", "cpu")
    assert again.frame_count == 4
    np.testing.assert_array_equal(again.positions(-1), whole)
    scene.simulation.steps = 2
    assert _common.simulated(scene, part, "other", "cpu").frame_count == 3
