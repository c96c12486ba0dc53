"""USD in and out: what a stage had it has again, at the same places, in the same unit, axes and times; and what exports add."""

import numpy as np
import pytest
import trimesh

import pdipc
from pdipc.export import usd as writer
from pdipc.export.export import Excerpt, export
from pdipc.output.results import RunError, RunWriter, open_run
from pdipc.scene.assembly import assemble
from pdipc.scene.errors import SceneError
from tests.output import runs

Usd = pytest.importorskip("pxr.Usd")
from pxr import Gf, Sdf, UsdGeom, Vt  # noqa: E402

CELLS = 3
START = 1001.0
SINGLE = 2e-6  # m: what float32 leaves of positions in a stage in centimetres
SCENE = """
[simulation]
steps = 5
time_step = 0.0416666667
precision = "float64"
[[bodies]]
name = "sheet"
kind = "cloth"
mesh = "shot.usda</World/Set/Sheet>"
material = { areal_density = 0.3, young_modulus = 2e4 }
[[bodies]]
name = "cube"
kind = "solid"
mesh = "shot.usda</World/Cube>"
[[obstacles]]
name = "floor"
mesh = "shot.usda</World/Floor>"
"""


def make_stage(path):
    """Centimetres, z up, 24 frames a second from 1001 on. A sheet of quads with UVs and normals below a turned and scaled prim, a
    cube of tets, a floor.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(24.0)
    stage.SetFramesPerSecond(24.0)
    stage.SetStartTimeCode(START)
    stage.SetEndTimeCode(START + 10)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    place = UsdGeom.Xform.Define(stage, "/World/Set")
    place.AddTranslateOp().Set(Gf.Vec3d(0, 0, 31))
    place.AddRotateZOp().Set(30.0)
    place.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    side = np.linspace(-10.0, 10.0, CELLS + 1)
    points = np.array([[x, y, 0.0] for y in side for x in side])
    i = np.arange(CELLS)
    a = (i[:, None] * (CELLS + 1) + i).ravel()
    quads = np.stack([a, a + 1, a + CELLS + 2, a + CELLS + 1], axis=1)
    sheet = mesh(stage, "/World/Set/Sheet", points, quads.ravel(), np.full(len(quads), 4))
    st = UsdGeom.PrimvarsAPI(sheet.GetPrim()).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    st.Set(Vt.Vec2fArray.FromNumpy((points[quads.ravel(), :2] / 20 + 0.5).astype(np.float32)))
    sheet.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.tile([0, 0, 1], (len(points), 1)).astype(np.float32)))
    sheet.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    cube = pdipc.Scene(
        bodies=[{"name": "b", "kind": "solid", "mesh": {"shape": "box", "size": [20, 20, 20], "cells": [1, 1, 1]}}]
    )
    body = assemble(cube).bodies[0]
    corners = assemble(cube).positions + np.array([0, 0, 15])
    tets = UsdGeom.TetMesh.Define(stage, "/World/Cube")
    tets.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(body.tets)))
    ground = np.array([[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]], dtype=float)
    mesh(stage, "/World/Floor", ground, np.arange(4), np.array([4]))
    stage.GetRootLayer().Save()


def mesh(stage, path, points, corners, counts):
    made = UsdGeom.Mesh.Define(stage, path)
    made.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(corners, dtype=np.int32)))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(counts, dtype=np.int32)))
    return made


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """The folder with the stage, the scene, and its run."""
    folder = tmp_path_factory.mktemp("shot")
    make_stage(folder / "shot.usda")
    (folder / "scene.toml").write_text(SCENE)
    pdipc.run_scene(pdipc.load_scene(folder / "scene.toml"), folder / "run", device="cpu")
    return folder


@pytest.fixture(scope="module")
def back(shot):
    return Usd.Stage.Open(str(export(open_run(shot / "run"), "stage", shot / "out" / "cache.usda")))


def in_world(stage, path, code):
    """Points of a prim at a time in metres with y up, by USD's own transforms."""
    prim = stage.GetPrimAtPath(path)
    matrix = UsdGeom.XformCache(code).GetLocalToWorldTransform(prim)
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    points = [matrix.Transform(Gf.Vec3d(*map(float, p))) for p in UsdGeom.PointBased(prim).GetPointsAttr().Get(code)]
    return np.array([[unit * x, unit * z, -unit * y] for x, y, z in points])


def test_bodies_are_prims_and_the_scene_has_their_materials(shot):
    scene = pdipc.load_scene(shot / "scene.toml")
    assembly = assemble(scene)
    names = {body.name: body for body in assembly.bodies}
    assert {name: body.last - body.first for name, body in names.items()} == {"sheet": 16, "cube": 8, "floor": 4}
    assert len(names["sheet"].triangles) == 2 * CELLS**2 and len(names["cube"].tets) > 4
    original = Usd.Stage.Open(str(shot / "shot.usda"))
    for name, path in (("sheet", "/World/Set/Sheet"), ("cube", "/World/Cube"), ("floor", "/World/Floor")):
        own = slice(names[name].first, names[name].last)
        np.testing.assert_allclose(assembly.positions[own], in_world(original, path, START), atol=1e-9)
    assert names["sheet"].material.young_modulus == 2e4
    scene.save(shot / "saved.toml")
    assert "shot.usda</World/Set/Sheet>" in (shot / "saved.toml").read_text()
    assert pdipc.load_scene(shot / "saved.toml") == scene


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("shot.usda</World/Shet>", r'no prim "/World/Shet".*/World/Set/Sheet, /World/Cube, /World/Floor'),
        ("shot.usda<World>", 'no prim "World"'),
        ("other.obj</World>", "only USD and Alembic files have named parts"),
        ("none.usda</World>", "no such file"),
    ],
)
def test_prims_that_are_not_there_are_told(shot, name, said):
    (shot / "other.obj").write_text("v 0 0 0\n")
    with pytest.raises(SceneError, match=said):
        assemble(pdipc.Scene(bodies=[{"name": "b", "kind": "cloth", "mesh": str(shot / name)}]))


def test_the_same_prims_unit_axes_and_times_come_out(shot, back):
    original = Usd.Stage.Open(str(shot / "shot.usda"))
    there, here = ([(str(p.GetPath()), p.GetTypeName()) for p in stage.Traverse()] for stage in (original, back))
    assert here == there
    assert (UsdGeom.GetStageUpAxis(back), UsdGeom.GetStageMetersPerUnit(back)) == ("Z", 0.01)
    assert (back.GetTimeCodesPerSecond(), back.GetFramesPerSecond()) == (24.0, 24.0)
    assert (back.GetStartTimeCode(), back.GetEndTimeCode()) == (START, START + 10)
    assert back.GetDefaultPrim().GetPath() == "/World"
    for path in ("/World/Set/Sheet", "/World/Cube"):
        assert UsdGeom.PointBased(back.GetPrimAtPath(path)).GetPointsAttr().GetTimeSamples() == [START + k for k in range(6)]
    for name in ("faceVertexIndices", "faceVertexCounts", "primvars:st", "primvars:st:indices"):
        before, after = (stage.GetPrimAtPath("/World/Set/Sheet").GetAttribute(name).Get() for stage in (original, back))
        assert after == before, name
    assert not back.GetRootLayer().GetPrimAtPath("/World/Floor"), "what does not move is not written"


def test_points_are_where_the_run_has_them(shot, back):
    run = open_run(shot / "run")
    of_vertex = run.topology["body_of_vertex"]
    for frame in range(run.frame_count):
        x = run.positions(frame)
        np.testing.assert_allclose(in_world(back, "/World/Set/Sheet", START + frame), x[of_vertex == 0], atol=SINGLE)
        np.testing.assert_allclose(in_world(back, "/World/Cube", START + frame), x[of_vertex == 1], atol=SINGLE)
    assert run.positions(5)[of_vertex == 0, 1].mean() < run.positions(0)[of_vertex == 0, 1].mean() - 0.05


def test_velocities_lead_from_frame_to_frame_and_normals_follow(back):
    sheet = UsdGeom.Mesh(back.GetPrimAtPath("/World/Set/Sheet"))
    for frame in range(1, 6):
        before, now = (np.array(sheet.GetPointsAttr().Get(START + k)) for k in (frame - 1, frame))
        speeds = np.array(sheet.GetVelocitiesAttr().Get(START + frame))
        np.testing.assert_allclose(speeds / 24.0, now - before, atol=2e-5)
    faces = np.array(sheet.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
    tri = trimesh.Trimesh(now, np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]), process=False)
    normals = np.array(sheet.GetNormalsAttr().Get(START + 5))
    assert (np.einsum("ij,ij->i", normals, tri.vertex_normals) > 0.95).all(), "theirs are weighted by angle"


def test_an_exported_prim_is_a_cache_again(shot, back):
    """The sheet as an obstacle that deforms: the same places at the same times."""
    name = f"{back.GetRootLayer().realPath}</World/Set/Sheet>"
    scene = pdipc.Scene(
        bodies=[{"name": "b", "kind": "cloth", "mesh": {"shape": "grid", "cells": [2, 2]}, "translation": [0, 5, 0]}],
        obstacles=[{"name": "o", "mesh": name, "motion": {"cache": name}}],
    )
    trajectory = assemble(scene).bodies[1].trajectory
    np.testing.assert_allclose(trajectory.frames.times, np.arange(6) / 24.0, atol=1e-12)
    run = open_run(shot / "run")
    for frame in (0, 3):
        x = run.positions(frame)[run.topology["body_of_vertex"] == 0]
        np.testing.assert_allclose(trajectory.apply(None, frame / 24.0), x, atol=SINGLE)


def test_what_has_no_prim_is_refused(shot, tmp_path):
    runs.write(tmp_path / "run", steps=2)
    with pytest.raises(RunError, match='"ball" is no prim of a USD stage'):
        export(open_run(tmp_path / "run"), "stage", tmp_path / "out.usda")
    with pytest.raises(RunError, match="is the stage itself"):
        export(open_run(shot / "run"), "stage", shot / "shot.usda")


def test_points_within_tets_follow_them():
    """A surface that was filled with tets has other vertices than these: an affine map of the tets is one of the points."""
    made = assemble(
        pdipc.Scene(bodies=[{"name": "b", "kind": "solid", "mesh": {"shape": "box", "size": [1, 1, 1], "cells": [2, 2, 2]}}])
    )
    x, tets = made.positions, made.bodies[0].tets
    points = np.random.default_rng(7).uniform(-0.51, 0.51, (200, 3))
    stage = Usd.Stage.CreateInMemory()
    prim = mesh(stage, "/M", points, np.arange(198), np.full(66, 3)).GetPrim()
    vertices, weights = writer._bind(points, x, np.arange(len(x)), tets, 1.7, prim, "b")
    affine = np.array([[1.0, 0.2, 0.0], [0.0, 0.7, 0.1], [0.3, 0.0, 1.1]])
    found = np.einsum("pk,pkd->pd", weights, (x @ affine.T + 2.0)[vertices])
    np.testing.assert_allclose(found, points @ affine.T + 2.0, atol=1e-12)
    assert weights.min() > -0.3, "each is in, or next to, its tet"


# --- a stage of the run's own ---


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A run whose cloth alone moves, above a box, with frames at 24 a second as a rounded time step gives them."""
    folder = tmp_path_factory.mktemp("own") / "run"
    positions, topology = runs.parts()
    with RunWriter.create(folder, '{"bodies": []}', topology, {"precision": "float64"}) as out:
        for step in range(4):
            moved = positions.copy()
            moved[topology["body_of_vertex"] == 1, 1] -= 0.01 * step**2
            out.append(step, 0.0416667 * step, moved, {})
    return open_run(folder)


def test_rates_are_exact_and_what_is_still_is_written_once(own, tmp_path):
    stage = Usd.Stage.Open(str(export(own, "usd", tmp_path / "run.usdc")))
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (24.0, 0.0, 3.0)
    ball, cloth, floor = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    assert cloth.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0, 3.0]
    for still in (ball, floor):
        assert still.GetPointsAttr().GetTimeSamples() == [] and len(still.GetPointsAttr().Get())
        assert not still.GetVelocitiesAttr().HasValue()
    down = np.array([cloth.GetVelocitiesAttr().Get(k)[0][1] for k in range(4)]) * 0.0416667
    np.testing.assert_allclose(down, [-0.01, -0.01, -0.03, -0.05], rtol=1e-5)
    every = Usd.Stage.Open(str(export(Excerpt(own, every=2), "usd", tmp_path / "half.usdc")))
    assert every.GetTimeCodesPerSecond() == 12.0


@pytest.mark.parametrize(("rate", "step"), [(24.0, 0.0416667), (30000 / 1001, 1001 / 30000), (100.0, 0.01), (29.7, 1 / 29.7)])
def test_a_rate_is_what_the_step_means(rate, step):
    run = type("Run", (), {"frame_count": 50, "times": np.cumsum(np.full(50, step))})()
    assert writer.rate_of(run) == pytest.approx(rate, rel=1e-9)


def test_another_rate_keeps_the_times(own, tmp_path):
    stage = Usd.Stage.Open(str(export(own, "usd", tmp_path / "run.usdc", fps=60.0)))
    cloth = next(prim for prim in stage.Traverse() if prim.GetName() == "b1_cloth")
    codes = np.array(UsdGeom.Mesh(cloth).GetPointsAttr().GetTimeSamples())
    np.testing.assert_allclose(codes / stage.GetTimeCodesPerSecond(), own.times, atol=1e-7)
    with pytest.raises(ValueError, match="not for obj"):
        export(own, "obj", tmp_path / "out", fps=24.0)


def test_sharp_edges_have_normals_and_round_ones_none():
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    shading = writer.Shading.by_edges(box.vertices, box.faces)
    normals = shading.normals(box.vertices)[shading.groups].reshape(-1, 3, 3)
    np.testing.assert_allclose(normals, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-12)
    assert len(np.unique(shading.groups)) == 24, "each corner of a box has three normals"
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert writer.Shading.by_edges(ball.vertices, ball.faces) is None
    tube = trimesh.creation.cylinder(1.0, 2.0, sections=24)
    shading = writer.Shading.by_edges(tube.vertices, tube.faces)
    corners = tube.vertices[shading.corners]
    round_side = np.abs(np.repeat(tube.face_normals[:, 2], 3)) < 0.5
    outward = corners[:, :2] / np.linalg.norm(corners[:, :2], axis=1, keepdims=True).clip(1e-9)
    smooth = np.einsum("ij,ij->i", shading.normals(tube.vertices)[shading.groups][:, :2], outward)
    assert smooth[round_side].min() > 0.98, "the round side is smooth, its rims are sharp"
