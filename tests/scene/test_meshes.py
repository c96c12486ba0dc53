"""Mesh files in every format give back what was written; what cannot be read is refused with the file's name."""

import meshio
import numpy as np
import pytest
import trimesh

from pdipc.scene import generators, meshes
from pdipc.scene.errors import SceneError

BALL = generators.Sphere(radius=0.5, cells=4).mesh()


def shape_of(mesh: meshes.Mesh) -> tuple[float, float]:
    """Volume enclosed by the triangles, and their area: both independent of numbering."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6, meshes.triangle_areas(mesh.vertices, mesh.triangles).sum()


@pytest.mark.parametrize("suffix", [".msh", ".vtk", ".vtu", ".mesh"])
def test_tets_from_meshio_formats(tmp_path, suffix):
    file = tmp_path / f"ball{suffix}"
    meshio.Mesh(BALL.vertices, [("tetra", BALL.tets)]).write(file)
    mesh = meshes.read(file)
    assert mesh.tets.shape == BALL.tets.shape
    assert mesh.triangles.shape == BALL.triangles.shape
    assert shape_of(mesh) == pytest.approx(shape_of(BALL), rel=1e-6)


@pytest.mark.parametrize("first", [0, 1])
def test_tets_from_tetgen_files(tmp_path, first):
    nodes = "\n".join(f"{i + first} {x:.17g} {y:.17g} {z:.17g}" for i, (x, y, z) in enumerate(BALL.vertices))
    elements = "\n".join(f"{i + first} {' '.join(map(str, tet + first))}" for i, tet in enumerate(BALL.tets))
    (tmp_path / "ball.node").write_text(f"# nodes\n{len(BALL.vertices)} 3 0 0\n{nodes}\n")
    (tmp_path / "ball.ele").write_text(f"{len(BALL.tets)} 4 0\n{elements}\n")
    for name in ("ball.node", "ball.ele"):
        assert np.array_equal(meshes.read(tmp_path / name).tets, BALL.tets)
    (tmp_path / "ball.ele").write_text(f"{len(BALL.tets) + 1} 4 0\n{elements}\n")
    with pytest.raises(SceneError, match=rf"says {len(BALL.tets) + 1} rows, and {len(BALL.tets)} are there"):
        meshes.read(tmp_path / "ball.node")
    (tmp_path / "ball.ele").unlink()
    with pytest.raises(SceneError, match=r'needs "ball\.ele" beside it'):
        meshes.read(tmp_path / "ball.node")


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off", ".glb"])
def test_triangles_from_trimesh_formats(tmp_path, suffix):
    surface = BALL.surface()
    file = tmp_path / f"ball{suffix}"
    trimesh.Trimesh(surface.vertices, surface.triangles, process=False).export(file)
    mesh = meshes.read(file)
    assert len(mesh.vertices) == len(surface.vertices), "vertices that a format repeats are one vertex"
    assert mesh.triangles.shape == surface.triangles.shape
    assert shape_of(mesh) == pytest.approx(shape_of(surface), rel=1e-5)


def test_npz_with_tets_or_triangles(tmp_path):
    np.savez(tmp_path / "t.npz", V=BALL.vertices, T=BALL.tets[:, [0, 2, 1, 3]])
    np.savez(tmp_path / "f.npz", V=BALL.vertices, F=BALL.triangles, T=[])
    np.savez(tmp_path / "x.npz", W=BALL.vertices)
    tets = meshes.read(tmp_path / "t.npz")
    assert meshes.tet_volumes(tets.vertices, tets.tets).min() > 0, "a mesh of negative tets is another convention: turned"
    triangles = meshes.read(tmp_path / "f.npz")
    assert len(triangles.tets) == 0
    assert len(triangles.vertices) == len(np.unique(BALL.triangles)), "vertices that nothing uses are dropped"
    with pytest.raises(SceneError, match=r"holds \['W'\]; needed: V and T"):
        meshes.read(tmp_path / "x.npz")


def test_bear_of_warp_has_tets():
    pytest.importorskip("pxr", reason='the extra "usd" is not installed')
    bear = meshes.read("warp:bear.usd")
    assert len(bear.tets) == 5354
    assert meshes.tet_volumes(bear.vertices, bear.tets).min() > 0
    assert len(meshes.read("warp:bunny.usd").triangles) == 12200


def test_polygons_of_usd_become_triangles(tmp_path):
    usd = pytest.importorskip("pxr.Usd", reason='the extra "usd" is not installed')
    geometry = pytest.importorskip("pxr.UsdGeom")
    stage = usd.Stage.CreateNew(str(tmp_path / "two.usda"))
    prim = geometry.Mesh.Define(stage, "/mesh")
    prim.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)])
    prim.CreateFaceVertexCountsAttr([4, 3])
    prim.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 3, 2, 4])
    stage.Save()
    mesh = meshes.read(tmp_path / "two.usda")
    assert len(mesh.triangles) == 3
    assert meshes.triangle_areas(mesh.vertices, mesh.triangles).sum() == pytest.approx(1.5)


def test_a_surface_is_filled_with_tets():
    pytest.importorskip("pytetwild", reason='the extra "tetrahedralize" is not installed')
    surface = generators.Box(size=(1, 1, 1), cells=(1, 1, 1)).mesh().surface()
    solid = meshes.tetrahedralize(surface, "here")
    volumes = meshes.tet_volumes(solid.vertices, solid.tets)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(1.0, rel=2e-2)
    with pytest.raises(SceneError, match=r"here: .* no inside to fill; the surface must be closed, and 4 of its edges"):
        meshes.tetrahedralize(generators.Plane().mesh(), "here")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", "", r'the format ".xyz" is not known; allowed: .msh'),
        ("a.obj", None, "there is no such file"),
        ("a.msh", "nonsense", "cannot be read as .msh"),
        ("a.vtk", "# vtk DataFile Version 3.0\nx\nASCII\nDATASET FIELD\n", "cannot be read as .vtk: .*FIELD"),
        (
            "a.mesh",
            "MeshVersionFormatted 2\nDimension 3\nVertices\n1\n0 0 0 0\nEnd\n",
            "cells of the kinds none; needed: tetra",
        ),
        ("a.ply", "nonsense", "cannot be read as .ply"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "holds no triangles"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "(out of range|index 8 is out of bounds)"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(SceneError, match=message) as caught:
        meshes.read(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.parametrize(
    ("tets", "triangles", "message"),
    [
        (None, [[0, 1, 4]], r"triangles\[0\] = \[0, 1, 4\] is out of range; indices must be 0 to 3"),
        ([[0, 1, 2, -1]], None, r"tets\[0\] = .* out of range"),
        (None, None, "neither triangles nor tetrahedra"),
        (None, [[0.5, 1, 2]], "whole numbers"),
        (None, [["a", "b", "c"]], "whole numbers"),
    ],
)
def test_bad_arrays_are_refused(tets, triangles, message):
    with pytest.raises(SceneError, match=message):
        meshes.from_arrays(np.eye(4, 3), tets, triangles, "here")


def test_vertices_that_are_no_numbers_are_refused():
    with pytest.raises(SceneError, match="here: vertices must be numbers"):
        meshes.from_arrays(np.array([["a", "b", "c"]]), None, [[0, 0, 0]], "here")
