"""Exports are read back and are what was written."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from pdipc.export.export import export
from pdipc.output.results import RunError, open_run
from tests.output import runs


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    runs.write(folder, steps=3)
    return open_run(folder)


def test_ply(run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    export(run, "ply", tmp_path / "out")
    assert len(list((tmp_path / "out").iterdir())) == 4
    for frame in (0, 3):
        mesh = trimesh.load(tmp_path / f"out/frame_{frame:06d}.ply", process=False)
        np.testing.assert_array_equal(mesh.vertices, run.positions(frame))
        np.testing.assert_array_equal(mesh.faces, run.triangles)


def test_obj(run, tmp_path):
    export(run, "obj", tmp_path / "out")
    lines = (tmp_path / "out/frame_000002.obj").read_text().splitlines()
    vertices = [[float(x) for x in line.split()[1:]] for line in lines if line.startswith("v ")]
    faces = [[int(x) for x in line.split()[1:]] for line in lines if line.startswith("f ")]
    np.testing.assert_array_equal(vertices, run.positions(2))
    np.testing.assert_array_equal(np.array(faces) - 1, run.triangles)
    assert [line[2:] for line in lines if line.startswith("o ")] == ["ball", "cloth", "floor"]


def test_vtk(run, tmp_path):
    meshio = pytest.importorskip("meshio")
    pvd = export(run, "vtk", tmp_path / "out")
    sets = ElementTree.parse(pvd).getroot().findall("Collection/DataSet")
    np.testing.assert_array_equal([float(entry.get("timestep")) for entry in sets], run.times)
    mesh = meshio.read(pvd.parent / sets[-1].get("file"))
    np.testing.assert_array_equal(mesh.points, run.positions(3))
    np.testing.assert_array_equal(mesh.cells_dict["tetra"], run.tets)
    surface = run.triangles[run.body_of_triangle > 0]
    np.testing.assert_array_equal(mesh.cells_dict["triangle"], surface)
    np.testing.assert_array_equal(mesh.cell_data_dict["body"]["triangle"], run.body_of_triangle[run.body_of_triangle > 0])


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_usd(run, tmp_path, suffix):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    path = export(run, "usd", tmp_path / f"run{suffix}")
    stage = usd.Stage.Open(str(path))
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert [mesh.GetPrim().GetName() for mesh in meshes] == ["b0_ball", "b1_cloth", "b2_floor"]
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(0.03)
    for body, mesh in enumerate(meshes):
        vertices, triangles = run.skins[body].sources, run.skins[body].triangles
        assert mesh.GetPointsAttr().GetTimeSamples() == ([0.0, 1.0, 2.0, 3.0] if body < 2 else [])  # the floor stays
        for frame in (0, 2):
            points = np.array(mesh.GetPointsAttr().Get(frame))
            np.testing.assert_array_equal(points, run.positions(frame)[vertices].astype(np.float32))
        np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), triangles)


def test_bad_requests_are_refused(run, tmp_path):
    with pytest.raises(ValueError, match="usd, stage, mdd, pc2, ply, obj, vtk"):
        export(run, "stl", tmp_path / "out")
    pytest.importorskip("pxr")
    with pytest.raises(ValueError, match=r"\.usdc"):
        export(run, "usd", tmp_path / "run.fbx")
    writer, _ = runs.begin(tmp_path / "empty")
    (writer.folder / "stats.jsonl").write_text("")
    with pytest.raises(RunError, match="no frames"):
        export(open_run(writer.folder), "ply", tmp_path / "out")


def test_paraview_has_a_piece_for_each_body(tmp_path):
    """As VTK's own reader finds it: pieces by name, at each time, with velocities that are differences and pressures of contact."""
    import pdipc

    vtk_io = pytest.importorskip("vtkmodules.vtkIOHDF")
    pyvista = pytest.importorskip("pyvista")
    body = {"kind": "solid", "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]}}
    scene = pdipc.Scene(
        bodies=[
            {"name": "low", "translation": [0.0, 0.0503, 0.0], **body},
            {"name": "high", "translation": [0.0, 0.5, 0.0], "material": {"young_modulus": 1e6}, **body},
        ],
        obstacles=[{"name": "floor", "mesh": {"shape": "plane"}}],
        contact={"activation_distance": 1e-3},
    )
    pdipc.run_scene(scene, tmp_path / "run", steps=3, device="cpu")
    run = open_run(tmp_path / "run")
    reader = vtk_io.vtkHDFReader()
    reader.SetFileName(str(export(run, "paraview", tmp_path / "run.vtkhdf")))
    reader.UpdateInformation()
    of_vertex = run.topology["body_of_vertex"]
    assert reader.GetNumberOfSteps() == 4
    for frame in range(4):
        reader.SetStep(frame)
        reader.Update()
        found = reader.GetOutput()
        assert found.GetNumberOfPartitionedDataSets() == 3
        for number, name in enumerate(("low", "high", "floor")):
            assert found.GetMetaData(number).Get(found.NAME()) == name
            mesh = pyvista.wrap(found.GetPartition(number, 0))
            own = of_vertex == number
            np.testing.assert_allclose(mesh.points, run.positions(frame)[own], rtol=0, atol=1e-7)
            np.testing.assert_allclose(mesh["displacement"], (run.positions(frame) - run.positions(0))[own], rtol=0, atol=1e-7)
            assert set(mesh["body"]) == {number}
            assert set(mesh["material"]) == {(0, 1, -1)[number]}
            if frame:
                velocity = (run.positions(frame) - run.positions(frame - 1))[own] / 0.01
                np.testing.assert_allclose(mesh["velocity"], velocity, rtol=1e-5, atol=1e-5)
            assert (mesh["pressure"].max() > 0.0) == (name != "high")
    with pytest.raises(ValueError, match=r"ends in .vtkhdf"):
        export(run, "paraview", tmp_path / "run.vtk")
