"""Obstacles that deform: what caches of every kind say is where their vertices are, and cloth keeps clear of them."""

import numpy as np
import pytest

import pdipc
from pdipc.scene import assembly, check, frames, generators
from pdipc.scene.errors import SceneError
from pdipc.scene.load import load_scene
from pdipc.scene.schema import Deformation, FrameArrays, Obstacle

SHEET = generators.Grid(size=(1, 1), cells=(6, 6)).mesh()
TIMES = np.array([0.0, 0.1, 0.3])


def wave(points: np.ndarray, time: float) -> np.ndarray:
    """A hump that rises in the middle."""
    return points + np.column_stack(
        [0 * points[:, 0], time * np.exp(-8 * (points[:, 0] ** 2 + points[:, 2] ** 2)), 0 * points[:, 0]]
    )


FRAMES = np.stack([wave(SHEET.vertices, time) for time in TIMES])


def scene(cache, mesh=None, **tables) -> pdipc.Scene:
    """A cloth above an obstacle with a cache."""
    mesh = {"vertices": SHEET.vertices, "triangles": SHEET.triangles} if mesh is None else mesh
    floor = {"name": "o", "mesh": mesh, "motion": {"cache": cache, **tables}}
    cloth = {
        "name": "c",
        "kind": "cloth",
        "mesh": {"shape": "grid", "cells": [8, 8], "size": [0.8, 0.8]},
        "translation": [0.01, 0.02, 0],
    }
    return pdipc.Scene(bodies=[cloth], obstacles=[floor], contact={"activation_distance": 2e-3, "friction": 0.3})


def whereabouts(given: pdipc.Scene, time: float) -> np.ndarray:
    assert check.check(given) == []
    return assembly.assemble(given).kinematic_positions(time)


ARRAYS = {"vertices": FRAMES, "times": TIMES.tolist()}


@pytest.mark.parametrize(
    ("time", "right"), [(-1.0, 0.0), (0.0, 0.0), (0.05, 0.05), (0.1, 0.1), (0.25, 0.25), (0.3, 0.3), (9.0, 0.3)]
)
def test_vertices_go_straight_from_frame_to_frame(time, right):
    assert whereabouts(scene(ARRAYS), time) == pytest.approx(wave(SHEET.vertices, right))
    assert whereabouts(scene(ARRAYS, start=2.0), time + 2.0) == pytest.approx(wave(SHEET.vertices, right))


def test_a_cache_is_scaled_turned_and_put_where_its_mesh_is():
    given = scene(ARRAYS)
    given.obstacles[0].scale = (2.0, 1.0, 3.0)
    given.obstacles[0].rotation = (0.0, 90.0, 0.0)
    given.obstacles[0].translation = (0.0, -1.0, 5.0)
    x, y, z = wave(SHEET.vertices, 0.2).T
    assert whereabouts(given, 0.2) == pytest.approx(np.column_stack([3 * z, y - 1, 5 - 2 * x]))


def test_a_cache_of_one_archive_with_its_mesh(tmp_path):
    np.savez(tmp_path / "a.npz", V=FRAMES.astype(np.float32), F=SHEET.triangles, times=TIMES)
    np.savez(tmp_path / "b.npz", V=FRAMES.astype(np.float32), F=SHEET.triangles)
    (tmp_path / "a.toml").write_text(
        '[[bodies]]\nname = "c"\nkind = "cloth"\nmesh = { shape = "grid", cells = [8, 8] }\ntranslation = [0, 0.1, 0]\n'
        '[[obstacles]]\nname = "o"\nmesh = "a.npz"\nmotion = { cache = "a.npz" }\n'
        '[[obstacles]]\nname = "p"\nmesh = "a.npz"\ntranslation = [3, 0, 0]\nmotion = { cache = "b.npz", frame_rate = 10 }\n'
    )
    given = load_scene(tmp_path / "a.toml")
    found = whereabouts(given, 0.2)
    assert found[:49] == pytest.approx(wave(SHEET.vertices, 0.2), abs=1e-6)
    assert found[49:] - [3, 0, 0] == pytest.approx(wave(SHEET.vertices, 0.3), abs=1e-6), "the third frame, after 0.2 s"
    assert assembly.assemble(given).notes == []
    given.obstacles[0].motion = None
    with pytest.warns(pdipc.scene.errors.SceneWarning, match="it holds 3 frames: the first was taken"):
        assembly.assemble(given)
    (tmp_path / "run.json").write_text(given.model_dump_json())
    assert load_scene(tmp_path / "run.json") == given


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off"])
def test_a_sequence_of_files(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    for number, points in zip((8, 9, 10), FRAMES, strict=True):  # in the order of numbers, not of letters
        trimesh.Trimesh(points, SHEET.triangles, process=False).export(tmp_path / f"f_{number}{suffix}")
    given = scene(str(tmp_path / f"f_*{suffix}"), mesh=str(tmp_path / f"f_8{suffix}"), frame_rate=10.0)
    assert whereabouts(given, 0.15) == pytest.approx(wave(SHEET.vertices, 0.2), abs=1e-6)
    trimesh.Trimesh(FRAMES[0], SHEET.triangles[:, ::-1], process=False).export(tmp_path / f"f_11{suffix}")
    (finding,) = check.check(given)
    assert f'"f_11{suffix}" has other vertices or faces than "f_8{suffix}"' in str(finding)


def test_time_samples_of_usd(tmp_path):
    usd, geometry = (
        pytest.importorskip("pxr.Usd", reason='the extra "usd" is not installed'),
        pytest.importorskip("pxr.UsdGeom"),
    )
    stage = usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    geometry.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(50)
    root = geometry.Xform.Define(stage, "/root")
    root.AddTranslateOp().Set((0, 0, 0), 101)
    root.GetOrderedXformOps()[0].Set((20, 0, 0), 116)
    prim = geometry.Mesh.Define(stage, "/root/m")
    prim.CreateFaceVertexCountsAttr([3] * len(SHEET.triangles))
    prim.CreateFaceVertexIndicesAttr([int(k) for k in SHEET.triangles.ravel()])
    points = prim.CreatePointsAttr()
    for code, frame in zip((101, 106, 116), FRAMES, strict=True):
        points.Set([tuple(map(float, 100 * point)) for point in frame], code)
    stage.Save()
    given = scene(str(tmp_path / "a.usda"), mesh=str(tmp_path / "a.usda"))
    assert whereabouts(given, 0.2) == pytest.approx(wave(SHEET.vertices, 0.2) + np.array([0.2 * 10 / 15, 0, 0]), abs=1e-6)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"V": FRAMES}, "says no times; give the frames a second as frame_rate"),
        ({"V": FRAMES, "times": TIMES[:2]}, "holds 3 frames and times of the shape (2,)"),
        ({"V": FRAMES, "times": TIMES[::-1]}, "times must be numbers in ascending order"),
        ({"V": FRAMES + np.array([0, np.inf, 0]), "times": TIMES}, "frame 0, vertex 0 = [-0.5, inf, -0.5] is not finite"),
        ({"V": FRAMES[:, :-1], "times": TIMES}, "the cache has frames of 48 vertices; its mesh has 49"),
        ({"V": FRAMES[0]}, "holds one frame only; needed: several"),
        ({"W": FRAMES}, "needed: V and T (tets), F (triangles) or L (lines)"),
        ({"V": FRAMES.astype(complex), "times": TIMES}, "V holds complex128; it must hold real numbers"),
        (None, "there is no such file"),
    ],
)
def test_caches_that_are_none_are_refused_with_the_place(tmp_path, arrays, message):
    with np.errstate(invalid="ignore"):
        if arrays is not None:
            np.savez(tmp_path / "a.npz", **arrays)
    (finding,) = check.check(scene(str(tmp_path / "a.npz")))
    assert finding.where == 'obstacle "o"' and message in str(finding)
    assert "a.npz" in str(finding) or "cache has" in str(finding)


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ({"cache": 5}, r"motion.cache = 5: must be a file, a pattern of files"),
        ({"cache": "a.npz", "velocity": [1, 0, 0]}, r"motion.velocity = \[1, 0, 0\]: unknown key"),
        ({"cache": {"vertices": [[0, 0, 0]], "times": [0]}}, r"motion.cache.vertices = .*must be a list of lists of 3 numbers"),
        ({"cache": {"vertices": np.zeros((2, 3, 2)), "times": [0, 1]}}, r"has the shape \(2, 3, 2\)"),
    ],
)
def test_tables_of_caches_that_are_wrong(motion, message):
    with pytest.raises(SceneError, match=message):
        Obstacle(name="o", mesh="a.obj", motion=motion)


def test_a_pattern_without_files_is_said():
    (finding,) = check.check(scene("nowhere/a_*.obj", frame_rate=25.0))
    assert "0 files go by this pattern" in str(finding)


def test_only_obstacles_deform():
    with pytest.raises(SceneError, match="cache"):
        pdipc.Scene(
            bodies=[
                {
                    "name": "c",
                    "kind": "cloth",
                    "mesh": "a.obj",
                    "pins": [{"select": {"all": True}, "motion": {"cache": "a.npz"}}],
                }
            ]
        )


def test_a_cloth_is_lifted_by_a_hump_that_rises_and_never_meets_it():
    sim = pdipc.Simulation(scene(ARRAYS), "cpu")
    obstacle = sim.model.assembly.obstacle
    for _ in range(40):
        sim.step()
        assert not len(pdipc.find_intersections(sim.positions, sim.triangles, obstacle))
    assert sim.positions[obstacle] == pytest.approx(FRAMES[-1], abs=1e-6), "nothing was in its way"
    assert 0.3 < sim.positions[~obstacle, 1].max() < 0.32
    assert sim.work.script.rigid() == []


def test_a_run_with_a_cache_resumes_to_the_same_bits(tmp_path):
    np.savez(tmp_path / "a.npz", V=FRAMES, F=SHEET.triangles, times=TIMES)
    given = scene(str(tmp_path / "a.npz"), mesh=str(tmp_path / "a.npz"))
    whole = pdipc.run_scene(given, tmp_path / "whole", steps=12, device="cpu", certify=True)
    pdipc.run_scene(given, tmp_path / "cut", steps=6, device="cpu")
    cut = pdipc.run_scene(load_scene(tmp_path / "cut" / "scene.json"), tmp_path / "cut", steps=12, device="cpu", resume=True)
    assert np.array_equal(pdipc.open_run(tmp_path / "whole").positions(12), pdipc.open_run(tmp_path / "cut").positions(12)), (
        whole,
        cut,
    )
    from pdipc.judge.certify import certify

    assert certify(pdipc.open_run(tmp_path / "whole")).hits == []


def test_triangles_that_open_later_stay():
    closed = SHEET.vertices.copy()
    closed[24] = closed[25]
    cache = {"vertices": np.stack([closed, SHEET.vertices, closed]), "times": [0, 1, 2]}
    whole = assembly.assemble(scene(cache))
    assert len(whole.bodies[1].triangles) == len(SHEET.triangles)
    assert check.check(scene(cache)) == []
    cache["vertices"] = np.stack([closed] * 3)
    with pytest.warns(pdipc.scene.errors.SceneWarning, match="2 triangles without an area were left out"):
        assembly.assemble(scene(cache))


def test_a_cloth_caught_between_parts_that_close_is_held_and_what_closes_lags():
    """Two plates of one obstacle close on a cloth until they would overlap: no vertex is shot away, nothing meets."""
    n = len(SHEET.vertices)
    closing = np.stack(
        [
            np.concatenate([SHEET.vertices - np.array([0, gap, 0]), SHEET.vertices + np.array([0, gap, 0])])
            for gap in (0.02, -0.005)
        ]
    )
    mesh = {"vertices": closing[0], "triangles": np.concatenate([SHEET.triangles, SHEET.triangles[:, ::-1] + n])}
    cloth = {
        "name": "c",
        "kind": "cloth",
        "mesh": {"shape": "grid", "cells": [5, 5], "size": [0.5, 0.5]},
        "translation": [0.01, 0.001, 0.02],
    }
    obstacle = {"name": "o", "mesh": mesh, "motion": {"cache": {"vertices": closing, "times": [0.0, 0.2]}}}
    given = pdipc.Scene(bodies=[cloth], obstacles=[obstacle], contact={"activation_distance": 2e-3})
    sim = pdipc.Simulation(given, "cpu")
    held = sim.model.assembly.obstacle
    for _ in range(25):
        sim.step()
        assert not len(pdipc.find_intersections(sim.positions, sim.triangles, held))
        assert np.linalg.norm(sim.state.velocities.numpy()[: held.argmax()], axis=1).max() < 20.0
    lag = np.abs(sim.positions[held] - closing[-1]).max()
    assert lag > 4e-3, "the plates wait for each other where the cloth is"
    assert np.abs(sim.positions[~held, 1]).max() < 0.02


def test_frames_know_their_order_and_rate():
    found = frames.timed(FRAMES, None, 25.0, "here")
    assert found.times == pytest.approx([0.0, 0.04, 0.08])
    assert frames.timed(FRAMES, np.array([5.0, 6.0, 8.0]), None, "here").times.tolist() == [0, 1, 3], (
        "they count from the first"
    )
    assert Deformation(cache=FrameArrays(**ARRAYS)).cache == FrameArrays(**ARRAYS)
