"""USD stages as productions have them: instances, mirrors, left-handed faces, hidden prims, keys that begin before the shot, other rates."""

import numpy as np
import pytest

import pdipc
from pdipc.export import usd as writer
from pdipc.export.export import export
from pdipc.output.results import open_run
from pdipc.scene.assembly import assemble

Usd = pytest.importorskip("pxr.Usd")
from pxr import Gf, Sdf, UsdGeom, Vt  # noqa: E402

from tests.export.test_usd import in_world, mesh  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::pdipc.scene.errors.SceneWarning")
START, FRAMES = 101.0, 4
SINGLE = 2e-6  # m: what float32 leaves of positions in a stage in centimetres
SCENE = """
[simulation]
steps = 4
time_step = {step}
precision = "float64"
[[bodies]]
name = "flag"
kind = "cloth"
mesh = "shot.usda</World/Set/Flag>"
material = {{ areal_density = 0.3, young_modulus = 2e4 }}
[[bodies]]
name = "copy"
kind = "cloth"
mesh = "shot.usda</World/Second/Flag>"
[[obstacles]]
name = "arm"
mesh = "shot.usda</World/Hinge/Arm>"
motion = {{ cache = "shot.usda</World/Hinge/Arm>" }}
"""


def quads(n, size):
    """Points (n + 1)^2 of a sheet, and the corners of its faces, which face up."""
    side = np.linspace(-size, size, n + 1)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return np.array([[x, y, 0.0] for y in side for x in side]), np.stack([a, a + 1, a + n + 2, a + n + 1], axis=1)


def make(folder, rate):
    """A flag, which is a file of its own, in inches: referenced below a mirrored and turned Xform, and once more as an instance; beside it a
    hidden mesh. Its faces are left-handed and have normals, UVs and a GeomSubset. An arm turns about a hinge by two keys, of which the first is
    before the start.
    """
    part = Usd.Stage.CreateNew(str(folder / "flag.usda"))
    UsdGeom.SetStageUpAxis(part, UsdGeom.Tokens.z)
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/Asset").GetPrim())
    points, corners = quads(3, 10.0)
    flag = mesh(part, "/Asset/Flag", points, corners[:, ::-1].ravel(), np.full(len(corners), 4))
    flag.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    flag.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.tile([0, 0, 1], (len(points), 1)).astype(np.float32)))
    flag.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    st = UsdGeom.PrimvarsAPI(flag.GetPrim()).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy((points[:, :2] / 20 + 0.5).astype(np.float32)))
    UsdGeom.Subset.CreateGeomSubset(flag, "Stripe", UsdGeom.Tokens.face, Vt.IntArray([0, 1, 2]))
    hidden = mesh(part, "/Asset/Flag_proxy", points + np.array([0, 0, 0.5]), corners.ravel(), np.full(len(corners), 4))
    hidden.MakeInvisible()
    part.GetRootLayer().Save()

    stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(START)
    stage.SetEndTimeCode(START + 20)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    for name, height, mirror in (("Set", 100, -1), ("Second", 150, 1)):
        place = UsdGeom.Xform.Define(stage, f"/World/{name}")
        place.GetPrim().GetReferences().AddReference("./flag.usda")
        place.GetPrim().SetInstanceable(name == "Second")
        place.AddTranslateOp().Set(Gf.Vec3d(5, 10, height))
        place.AddRotateXYZOp().Set(Gf.Vec3f(10, 20, 30))
        place.AddScaleOp().Set(Gf.Vec3f(2.54 * mirror, 2.54, 2.54))
    hinge = UsdGeom.Xform.Define(stage, "/World/Hinge")
    turn = hinge.AddRotateZOp()
    turn.Set(0.0, START - 10)
    turn.Set(180.0, START + 10)
    arm = UsdGeom.Xform.Define(stage, "/World/Hinge/Arm")
    arm.AddTranslateOp().Set(Gf.Vec3d(20, 0, 0))
    points, corners = quads(1, 5.0)
    mesh(stage, "/World/Hinge/Arm/Mesh", points, corners.ravel(), np.array([4]))
    stage.GetRootLayer().Save()


@pytest.fixture(scope="module", params=[24.0, 30.0, 60.0])
def shot(tmp_path_factory, request):
    """The stage before, the stage after, the run."""
    folder = tmp_path_factory.mktemp("stages")
    make(folder, request.param)
    (folder / "scene.toml").write_text(SCENE.format(step=1 / request.param))
    pdipc.run_scene(pdipc.load_scene(folder / "scene.toml"), folder / "run", device="cpu")
    run = open_run(folder / "run")
    back = Usd.Stage.Open(str(export(run, "stage", folder / "elsewhere" / "cache.usdc")))
    return Usd.Stage.Open(str(folder / "shot.usda")), back, run


def test_times_unit_axes_and_prims_are_those_of_the_stage(shot):
    before, after, _ = shot
    for stage in shot[:2]:
        assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 0.01)
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (START, START + 20)
        assert stage.GetDefaultPrim().GetPath() == "/World"
    assert after.GetTimeCodesPerSecond() == before.GetTimeCodesPerSecond() == after.GetFramesPerSecond()
    there, here = (
        [(str(p.GetPath()), str(p.GetTypeName())) for p in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())]
        for stage in (before, after)
    )
    assert here == there
    for path in ("/World/Set/Flag", "/World/Second/Flag"):
        samples = UsdGeom.Mesh(after.GetPrimAtPath(path)).GetPointsAttr().GetTimeSamples()
        assert samples == [START + k for k in range(FRAMES + 1)], path


@pytest.mark.parametrize(("number", "path"), [(0, "/World/Set/Flag"), (1, "/World/Second/Flag")])
def test_points_below_mirrors_references_and_in_instances_go_as_the_run_does(shot, number, path):
    _, after, run = shot
    own = run.topology["body_of_vertex"] == number
    for frame in range(FRAMES + 1):
        np.testing.assert_allclose(in_world(after, path, START + frame), run.positions(frame)[own], atol=SINGLE)
    fallen = run.positions(0)[own, 1].mean() - run.positions(FRAMES)[own, 1].mean()
    h = 1.0 / after.GetTimeCodesPerSecond()
    assert fallen == pytest.approx(9.81 * h * h * FRAMES * (FRAMES + 1) / 2, rel=1e-3)


def test_left_handed_normals_stay_on_their_side_and_the_rest_is_kept(shot):
    before, after, _ = shot
    for path in ("/World/Set/Flag", "/World/Second/Flag"):
        prim, original = UsdGeom.Mesh(after.GetPrimAtPath(path)), UsdGeom.Mesh(before.GetPrimAtPath(path))
        there, here = (np.array(each.GetNormalsAttr().Get(START + FRAMES)) for each in (original, prim))
        assert (np.einsum("ij,ij->i", there, here) > 0.99).all()
        assert prim.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        st = [UsdGeom.PrimvarsAPI(each.GetPrim()).GetPrimvar("st").Get() for each in (original, prim)]
        assert st[0] == st[1] and len(st[0]) == 16
        (subset,) = UsdGeom.Subset.GetAllGeomSubsets(prim)
        assert list(subset.GetIndicesAttr().Get()) == [0, 1, 2]
        assert UsdGeom.Imageable(after.GetPrimAtPath(f"{path}_proxy")).ComputeVisibility() == UsdGeom.Tokens.invisible


def test_an_animated_place_is_followed_around_from_the_start_of_the_shot(shot):
    """90 degrees at the start, by 9 more a frame; on a straight way from key to key the arm would go through its hinge."""
    before, after, run = shot
    own = run.topology["body_of_vertex"] == 2
    for frame in range(FRAMES + 1):
        x = run.positions(frame)[own]
        np.testing.assert_allclose(x, in_world(before, "/World/Hinge/Arm/Mesh", START + frame), atol=SINGLE)
        np.testing.assert_allclose(x, in_world(after, "/World/Hinge/Arm/Mesh", START + frame), atol=SINGLE)
        angle = np.radians(90.0 + 9.0 * frame)
        np.testing.assert_allclose(x.mean(axis=0), 0.2 * np.array([np.cos(angle), 0, -np.sin(angle)]), atol=SINGLE)
    velocities = UsdGeom.Mesh(after.GetPrimAtPath("/World/Hinge/Arm/Mesh")).GetVelocitiesAttr().Get(START + 2)
    np.testing.assert_allclose(np.array(velocities), 0.0, atol=1e-3, err_msg="its place moves, not its points within")


def test_a_stage_comes_in_again_after_it_went_out(shot, tmp_path):
    """The flag of the layer as a body, and the whole of its motion as a cache: at the places of the run, at its times."""
    _, after, run = shot
    name = f"{after.GetRootLayer().realPath}</World/Set/Flag>"
    scene = pdipc.Scene(
        bodies=[{"name": "b", "kind": "cloth", "mesh": {"shape": "grid", "cells": [2, 2]}, "translation": [0, 5, 0]}],
        obstacles=[{"name": "o", "mesh": name, "motion": {"cache": name}}],
    )
    body = assemble(scene).bodies[1]
    np.testing.assert_allclose(body.trajectory.frames.times, run.times[: FRAMES + 1], atol=1e-9)
    for frame in (0, FRAMES):
        x = run.positions(frame)[run.topology["body_of_vertex"] == 0]
        np.testing.assert_allclose(body.trajectory.apply(None, float(run.times[frame])), x, atol=SINGLE)


@pytest.mark.parametrize("how", ["uniform", "vertex", "faceVarying", "faceVarying, indexed", "uniform, indexed", "constant"])
def test_normals_follow_in_whichever_way_they_are_given(how):
    """A flat sheet that is folded along its middle: normals of faces turn with them, those at the fold stay shared where they were shared; one for
    all of the mesh is no longer right and is blocked.
    """
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    points, corners = quads(2, 1.0)
    sheet = mesh(stage, "/Sheet", points, corners.ravel(), np.full(len(corners), 4))
    interpolation = how.split(",")[0]
    count = {"uniform": 4, "vertex": 9, "faceVarying": 16, "constant": 1}[interpolation]
    if how.endswith("indexed"):
        primvar = UsdGeom.PrimvarsAPI(sheet).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, interpolation)
        primvar.Set(Vt.Vec3fArray([(0, 0, 1)]))
        primvar.SetIndices(Vt.IntArray([0] * count))
    else:
        sheet.CreateNormalsAttr(Vt.Vec3fArray([(0, 0, 1)] * count))
        sheet.SetNormalsInterpolation(interpolation)
    own = np.repeat(np.arange(9)[:, None], 4, axis=1)
    prim = writer._Prim(stage, sheet.GetPrim(), 0.0, own, np.eye(4)[np.zeros(9, dtype=int)])
    folded = points.copy()
    folded[points[:, 0] > 0, 2] = 1.0  # by 45 degrees
    prim.write(folded, 1.0, [(points, 0.0), (folded, 1.0)], 1.0)
    if how == "constant":
        assert not sheet.GetNormalsAttr().HasValue()
        return
    primvar = UsdGeom.PrimvarsAPI(sheet).GetPrimvar("normals")
    found = np.array(primvar.ComputeFlattened(1.0) if primvar.HasValue() else sheet.GetNormalsAttr().Get(1.0))
    assert len(found) == count
    of_face = np.array([[0, 0, 1], [-1, 0, 1] / np.sqrt(2)] * 2)
    if interpolation == "uniform":
        np.testing.assert_allclose(found, of_face, atol=1e-6)
        return
    x = points[corners.ravel()] if interpolation == "faceVarying" else points
    np.testing.assert_allclose(found[x[:, 0] < 0], np.tile(of_face[0], ((x[:, 0] < 0).sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(found[x[:, 0] > 0], np.tile(of_face[1], ((x[:, 0] > 0).sum(), 1)), atol=1e-6)
    shared = found[x[:, 0] == 0]
    np.testing.assert_allclose(shared, np.tile(shared[0], (len(shared), 1)), atol=1e-6)
    assert 0.1 < -shared[0, 0] < 0.7, "between the two"


def test_a_package_is_read_and_written_over_but_not_written(tmp_path):
    """shot.usdz: one file of what make() has made; the layer over it has the points of the run."""
    from pxr import UsdUtils

    make(tmp_path, 24.0)
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "shot.usda"), str(tmp_path / "packed.usdz"))
    (tmp_path / "scene.toml").write_text(SCENE.format(step=1 / 24).replace("shot.usda", "packed.usdz"))
    pdipc.run_scene(pdipc.load_scene(tmp_path / "scene.toml"), tmp_path / "run", device="cpu")
    run = open_run(tmp_path / "run")
    stage = Usd.Stage.Open(str(export(run, "stage", tmp_path / "cache.usda")))
    assert (UsdGeom.GetStageUpAxis(stage), stage.GetStartTimeCode()) == ("Z", START)
    x = run.positions(FRAMES)[run.topology["body_of_vertex"] == 0]
    np.testing.assert_allclose(in_world(stage, "/World/Set/Flag", START + FRAMES), x, atol=SINGLE)
    with pytest.raises(ValueError, match="a USD file that is written ends in one of"):
        export(run, "usd", tmp_path / "out.usdz")
