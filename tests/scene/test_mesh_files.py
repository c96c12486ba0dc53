"""What mesh files hold comes out whole: areas, volumes and counts that follow from the files; what does not is said."""

import base64
import json
import struct
import time
import zlib

import meshio
import numpy as np
import pytest

from pdipc.scene import cells, generators, meshes, worker
from pdipc.scene.errors import SceneError
from pdipc.scene.files import surfaces

QUAD_AND_TRIANGLES = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 1], [1, 0, 1], [2, 0, 1]], dtype=float)


def area(mesh: meshes.Mesh) -> float:
    return meshes.triangle_areas(mesh.vertices, mesh.triangles).sum()


def volume(mesh: meshes.Mesh) -> float:
    volumes = meshes.tet_volumes(mesh.vertices, mesh.tets)
    assert volumes.min() > 0
    return volumes.sum()


# --- cutting ---


def polygon_area(ring: np.ndarray) -> float:
    return np.linalg.norm(np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)) / 2


@pytest.mark.parametrize("seed", range(30))
def test_concave_polygons_keep_their_area_and_all_their_corners(seed):
    """Stars in any plane, with corners on straight sides, whose neighbours would be torn off without them."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 12))
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n
    ring = rng.uniform(0.2, 1.0, n)[:, None] * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    k = int(rng.integers(n))
    ring = np.insert(ring, k + 1, 0.5 * (ring[k] + ring[(k + 1) % n]), axis=0)
    points = (ring @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T + rng.normal(size=3)) * 10.0 ** rng.uniform(-3, 3)
    triangles, crossed = cells.triangulate(points, np.arange(n + 1), np.array([n + 1]))
    areas = meshes.triangle_areas(points, triangles)
    assert (len(triangles), crossed) == (n - 1, 0)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(polygon_area(points - points[0]), rel=1e-9)
    assert set(triangles.ravel()) == set(range(n + 1))


def test_a_concave_quad_is_cut_within_itself():
    points = np.array([[0, 0, 0], [2, 0, 0], [0.2, 0, 0.2], [0, 0, 2]], dtype=float)
    for shift in range(4):
        triangles, crossed = cells.triangulate(points, np.roll(np.arange(4), shift), np.array([4]))
        assert crossed == 0
        assert meshes.triangle_areas(points, triangles).sum() == pytest.approx(polygon_area(points))


@pytest.mark.parametrize("ring", [[0, 2, 1, 3], [0, 2, 4, 1, 3]])
def test_polygons_that_cross_themselves_are_counted(ring):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-0.5, 0.5, 0]], dtype=float)
    assert cells.triangulate(points, np.array(ring), np.array([len(ring)]))[1] == 1


def box_cells(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points, numbered at random, and cells of one kind that fill a box of 2 x 3 x 2."""
    shape = np.array([2, 3, 2])
    grid = np.indices(tuple(shape + 1)).reshape(3, -1).T
    number = rng.permutation(len(grid)).reshape(tuple(shape + 1))
    points = np.empty((len(grid), 3))
    points[number.ravel()] = grid
    found = []
    for x, y, z in np.indices(tuple(shape)).reshape(3, -1).T:
        low, high = number[x : x + 2, y : y + 2, z], number[x : x + 2, y : y + 2, z + 1]
        corner = [low[0, 0], low[1, 0], low[1, 1], low[0, 1], high[0, 0], high[1, 0], high[1, 1], high[0, 1]]
        if kind == "hexahedron":
            found.append(corner)
        elif kind == "wedge":
            found += [[corner[k] for k in wedge] for wedge in ([0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7])]
        else:
            points = np.append(points, [[x + 0.5, y + 0.5, z + 0.5]], axis=0)
            found += [[*(corner[k] for k in face[::-1]), len(points) - 1] for face in cells.CELL_FACES["hexahedron"]]
    return points, np.array(found)


@pytest.mark.parametrize("kind", ["hexahedron", "wedge", "pyramid"])
@pytest.mark.parametrize("seed", range(5))
def test_cells_are_cut_so_that_neighbours_agree(kind, seed):
    """The tets fill the box, and every face that is not on its surface belongs to two of them."""
    points, given = box_cells(kind, np.random.default_rng(seed))
    tets = cells.tetrahedra(kind, given)
    volumes = meshes.tet_volumes(points, tets)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(12.0)
    skin = meshes.boundary(tets)
    assert meshes.triangle_areas(points, skin).sum() == pytest.approx(2 * (6 + 6 + 4))


def test_a_collapsed_hexahedron_is_cut_into_what_it_fills():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1]], dtype=float)
    wedge = np.array([[0, 1, 2, 3, 4, 5, 5, 4]])  # its upper side is an edge
    assert meshes.tet_volumes(points, cells.tetrahedra("hexahedron", wedge)).sum() == pytest.approx(0.5)


def test_polygons_without_measure_end_soon():
    """A polygon that crosses itself everywhere, one on a line, a large one; and one that is refused for its size."""
    rng = np.random.default_rng(0)
    line = np.column_stack([np.linspace(0, 1, 500), np.zeros(500), np.zeros(500)])
    round_ = np.exp(2j * np.pi * np.arange(1000) / 1000)
    begun = time.process_time()
    for points, crosses in (
        (rng.random((500, 3)), 1),
        (line, 0),
        (np.column_stack([round_.real, round_.imag, 0 * round_.real]), 0),
    ):
        triangles, crossed = cells.triangulate(points, np.arange(len(points)), np.array([len(points)]))
        assert (len(triangles), crossed) == (len(points) - 2, crosses)
    assert time.process_time() - begun < 30.0
    many = cells.MOST_CORNERS + 1
    contents = meshes.Contents(np.zeros((many, 3)), polygons=(np.arange(many), np.array([many])))
    with pytest.raises(SceneError, match=f"here: a face has {many} corners; at most {cells.MOST_CORNERS} are cut"):
        meshes.from_contents(contents, "here")


# --- formats ---


@pytest.mark.parametrize(
    ("name", "options"), [("a.vtk", {}), ("a.vtu", {}), ("a.msh", {"file_format": "gmsh22"}), ("a.mesh", {})]
)
@pytest.mark.parametrize("binary", [True, False])
def test_quads_beside_triangles(tmp_path, name, options, binary):
    if name != "a.mesh":
        options = {**options, "binary": binary}
    mixed = [("quad", [[0, 1, 4, 3]]), ("triangle", [[1, 2, 5], [1, 5, 4]])]
    meshio.Mesh(QUAD_AND_TRIANGLES, mixed).write(tmp_path / name, **options)
    mesh = meshes.read(tmp_path / name)
    assert (len(mesh.triangles), area(mesh), mesh.notes) == (4, pytest.approx(2.0), [])


@pytest.mark.parametrize(
    ("name", "options"), [("a.vtk", {}), ("a.vtu", {}), ("a.msh", {"file_format": "gmsh22"}), ("a.mesh", {})]
)
def test_hexahedra_and_wedges_beside_tets(tmp_path, name, options):
    points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2, 3)], dtype=float)
    hexahedron = [0, 1, 5, 4, 8, 9, 13, 12]
    wedges = [[1, 2, 6, 9, 10, 14], [1, 6, 5, 9, 14, 13]]
    tets = generators.Box(size=(1, 1, 1), cells=(1, 1, 1)).mesh()
    number = [int(np.argmin(np.abs(points - (vertex + np.array([2.5, 0.5, 0.5]))).sum(axis=1))) for vertex in tets.vertices]
    mixed = [("hexahedron", [hexahedron]), ("wedge", wedges), ("tetra", np.array(number)[tets.tets])]
    meshio.Mesh(points, mixed).write(tmp_path / name, **options)
    mesh = meshes.read(tmp_path / name)
    assert volume(mesh) == pytest.approx(3.0)
    assert len(mesh.tets) == 6 + 6 + 6
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([3, 1, 1])


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("version", ["gmsh", "gmsh22"])
def test_hexahedra_of_gmsh(tmp_path, binary, version):
    points, given = box_cells("hexahedron", np.random.default_rng(0))
    meshio.Mesh(points, [("hexahedron", given)]).write(tmp_path / "a.msh", file_format=version, binary=binary)
    assert volume(meshes.read(tmp_path / "a.msh")) == pytest.approx(12.0)


def test_cells_of_second_order_are_reduced_with_a_word(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    middles = [0.5 * (corners[a] + corners[b]) for a, b in ((0, 1), (1, 2), (0, 2), (0, 3), (2, 3), (1, 3))]
    meshio.Mesh([*corners, *middles], [("tetra10", [list(range(10))])]).write(tmp_path / "a.msh", file_format="gmsh")
    mesh = meshes.read(tmp_path / "a.msh")
    assert (len(mesh.vertices), volume(mesh)) == (4, pytest.approx(1 / 6))
    assert mesh.notes == ["cells of higher order were reduced to their corners: 1 tetra"]


def test_faces_and_lines_that_bound_no_cell_are_said(tmp_path):
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 0, 0], [6, 0, 0], [5, 1, 0]]
    mixed = [("tetra", [[0, 1, 2, 3]]), ("triangle", [[0, 2, 1], [4, 5, 6]]), ("line", [[0, 1], [4, 5], [5, 6]])]
    meshio.Mesh(points, mixed).write(tmp_path / "a.vtu")
    mesh = meshes.read(tmp_path / "a.vtu")
    assert mesh.notes[0] == "1 faces that bound no cell were left out"
    assert mesh.notes[1].startswith("2 lines were left out")


GMSH_41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
1
3 1 "vol"
$EndPhysicalNames
$Entities
0 0 1 2
1 0 0 0 1 1 1 0 0
1 0 0 0 1 1 1 1 1 0
2 0 0 0 1 1 1 0 0
$EndEntities
$Nodes
2 5 1 9
{block}
3 2 0 1
9
1 1 1
$EndNodes
$Elements
3 3 1 3
2 1 2 1
1 1 3 2
3 1 4 1
2 1 2 3 4
3 2 4 1
3 2 3 4 9
$EndElements
"""


@pytest.mark.parametrize(
    "block",
    [
        "3 1 0 4\n1\n2\n3\n4\n0 0 0\n1 0 0\n0 1 0\n0 0 1",
        "2 1 1 4\n1\n2\n3\n4\n0 0 0 .1 .2\n1 0 0 .3 .4\n0 1 0 .5 .6\n0 0 1 .7 .8",  # with parameters on a surface
    ],
)
def test_gmsh_with_several_entities_of_which_one_has_a_name(tmp_path, block):
    (tmp_path / "a.msh").write_text(GMSH_41.format(block=block))
    mesh = meshes.read(tmp_path / "a.msh")
    assert len(mesh.vertices) == 5
    assert volume(mesh) == pytest.approx(1 / 6 + 1 / 3)


def test_gmsh_2_with_parametric_nodes(tmp_path):
    nodes = "1 0 0 0 0 1\n2 1 0 0 1 1 0.5\n3 0 1 0 2 1 0.5 0.5\n4 0 0 1 3 1"
    (tmp_path / "a.msh").write_text(
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$ParametricNodes\n4\n{nodes}\n$EndParametricNodes\n"
        "$Elements\n2\n1 15 2 0 1 1\n2 4 2 0 1 1 2 3 4\n$EndElements\n"
    )
    assert volume(meshes.read(tmp_path / "a.msh")) == pytest.approx(1 / 6)


def test_medit_with_line_breaks_anywhere(tmp_path):
    (tmp_path / "a.mesh").write_text(
        "MeshVersionFormatted 2\n\nDimension\n3\n# a comment 1 2 3\nVertices 4\n0 0 0 0\n1 0 0\n0 0 1 0 0\n0 0 1 0\n\n"
        "Tetrahedra 1\n1 2 3 4 9\n\nCorners\n1\n1\nRequiredVertices\n1\n2\nEnd\n"
    )
    assert volume(meshes.read(tmp_path / "a.mesh")) == pytest.approx(1 / 6)


def test_obj_indices_count_back_from_where_they_stand(tmp_path):
    block = "v {0} 0 0\nv {1} 0 0\nv {1} 0 1\nf -3/1/1 -1//2 \\\n-2\n"
    (tmp_path / "a.obj").write_text(block.format(0, 1) + block.format(2, 3))
    mesh = meshes.read(tmp_path / "a.obj")
    assert mesh.triangles.tolist() == [[0, 2, 1], [3, 5, 4]]
    assert area(mesh) == pytest.approx(1.0)


def test_sewing_lines_of_an_obj_are_said(tmp_path):
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 0 1 # x\nv 0 1 0\nv 1 1 0\nv 1 1 1\nf 1 2 3\nf 4 5 6\nl 1 4\nl 2 5 6\n"
    )
    (note,) = meshes.read(tmp_path / "a.obj").notes
    assert note.startswith("2 lines were left out") and "attachments" in note  # the third is an edge


@pytest.mark.parametrize("order", ["<", ">", "text"])
def test_ply_with_faces_of_several_sizes(tmp_path, order):
    faces, extra = [[0, 3, 4, 1], [1, 4, 5], [1, 5, 2]], [[7], [], [1, 2]]
    layout = {"<": "binary_little_endian", ">": "binary_big_endian", "text": "ascii"}[order]
    head = (
        f"ply\nformat {layout} 1.0\ncomment x\nelement vertex 6\nproperty float x\nproperty double y\nproperty float z\nproperty uchar red\n"
        "element face 3\nproperty uchar flags\nproperty list uchar int vertex_indices\nproperty list uchar short more\nend_header\n"
    )
    with open(tmp_path / "a.ply", "wb") as file:
        file.write(head.encode())
        for x, y, z in QUAD_AND_TRIANGLES:
            file.write(f"{x} {y} {z} 255\n".encode() if order == "text" else struct.pack(f"{order}fdfB", x, y, z, 255))
        for face, more in zip(faces, extra, strict=True):
            if order == "text":
                file.write((" ".join(map(str, [3, len(face), *face, len(more), *more])) + "\n").encode())
            else:
                file.write(struct.pack(f"{order}BB{len(face)}iB{len(more)}h", 3, len(face), *face, len(more), *more))
    mesh = meshes.read(tmp_path / "a.ply")
    assert (len(mesh.triangles), area(mesh)) == (4, pytest.approx(2.0))


def test_off_with_polygons_and_colours(tmp_path):
    (tmp_path / "a.off").write_text(
        "COFF # a comment\n6 3 0\n"
        + "\n".join(" ".join(map(str, [*p, 255, 0, 0])) for p in QUAD_AND_TRIANGLES)
        + "\n\n4 0 3 4 1 255 0 0\n3 1 4 5\n3 1 5 2 0.1 0.2 0.3\n"
    )
    assert area(meshes.read(tmp_path / "a.off")) == pytest.approx(2.0)


def test_vertices_on_others_are_merged_with_a_word(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nv 1 0 0\nv 0 0 1\nv 1 0 1.000000001\nf 1 2 3\nf 5 4 6\n")
    mesh = meshes.read(tmp_path / "a.obj")
    assert len(mesh.vertices) == 4
    assert mesh.notes == ["2 vertices that lie exactly on others were merged with them"]


# --- USD ---


def stage(path, unit=None, axis=None):
    usd, geometry = (
        pytest.importorskip("pxr.Usd", reason='the extra "usd" is not installed'),
        pytest.importorskip("pxr.UsdGeom"),
    )
    made = usd.Stage.CreateNew(str(path))
    if unit:
        geometry.SetStageMetersPerUnit(made, unit)
    if axis:
        geometry.SetStageUpAxis(made, axis)
    return made, geometry


def square(made, geometry, name, at=(0, 0, 0), side=1.0):
    prim = geometry.Mesh.Define(made, name)
    prim.CreatePointsAttr([(at[0] + x * side, at[1] + y * side, at[2]) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    prim.CreateFaceVertexCountsAttr([4])
    prim.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    return prim


def test_all_meshes_of_usd_where_they_stand_in_metres_y_up(tmp_path):
    made, geometry = stage(tmp_path / "a.usda", 0.01, "Z")
    root = geometry.Xform.Define(made, "/root")
    root.AddTranslateOp().Set((0, 0, 100))
    root.AddScaleOp().Set((2, 2, 2))
    square(made, geometry, "/root/a", side=50.0)
    square(made, geometry, "/root/b", at=(100, 0, 0), side=50.0)
    square(made, geometry, "/root/hidden", side=50.0).MakeInvisible()
    geometry.Sphere.Define(made, "/root/ball")
    geometry.Mesh.Define(made, "/root/empty")
    square(made, geometry, "/root/standin", side=50.0).CreatePurposeAttr(geometry.Tokens.proxy)
    geometry.Mesh.Define(made, "/root/off").GetPrim().SetActive(False)
    made.Save()
    mesh = meshes.read(tmp_path / "a.usda")
    assert area(mesh) == pytest.approx(2.0)
    assert mesh.vertices.min(axis=0) == pytest.approx([0, 1, -1]) and mesh.vertices.max(axis=0) == pytest.approx([3, 1, 0])
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert np.all(np.cross(b - a, c - a)[:, 1] > 0), "what faced up in z faces up in y"
    assert mesh.notes == [
        "its unit of 0.01 m was converted to m",
        "its z axis, which points up, was turned to y",
        "prims were left out: 1 Mesh of purpose proxy, 1 Mesh without points, 1 Sphere",
        "1 invisible prims were left out",
    ]


def test_mirrors_holes_and_left_hands_of_usd(tmp_path):
    made, geometry = stage(tmp_path / "a.usda", 1.0)
    mirrored = square(made, geometry, "/mirrored")
    mirrored.AddScaleOp().Set((-1, 1, 1))
    square(made, geometry, "/left", at=(2, 0, 0)).CreateOrientationAttr(geometry.Tokens.leftHanded)
    holed = square(made, geometry, "/holed", at=(4, 0, 0))
    holed.GetFaceVertexCountsAttr().Set([3, 3])
    holed.GetFaceVertexIndicesAttr().Set([0, 1, 2, 0, 2, 3])
    holed.CreateHoleIndicesAttr([1])
    made.Save()
    mesh = meshes.read(tmp_path / "a.usda")
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    normal = np.cross(b - a, c - a)[:, 2] / 2
    middle = (a + b + c)[:, 0] / 3
    assert normal[middle < 0] == pytest.approx([0.5, 0.5]), "a mirror image keeps its outside"
    assert normal[(middle > 2) & (middle < 4)] == pytest.approx([-0.5, -0.5])
    assert normal[middle > 4] == pytest.approx([0.5])


def test_usd_that_moves_or_has_no_unit_is_said(tmp_path):
    made, geometry = stage(tmp_path / "a.usda")
    points = square(made, geometry, "/a").GetPointsAttr()
    later = [(x, y, 5) for x, y, _ in points.Get()]
    points.Clear()
    points.Set([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], 3.0)
    points.Set(later, 9.0)
    made.Save()
    mesh = meshes.read(tmp_path / "a.usda")
    assert mesh.vertices[:, 2] == pytest.approx(1.0)
    assert mesh.notes == [
        "it does not say metersPerUnit: its numbers were taken as m",
        "it moves or deforms at 2 times: it was read as it is at the start",
    ]


GRID_HEAD = "# vtk DataFile Version 3.0\n\nASCII\nDATASET {}\nPOINTS 8 float\n0 0 0 1 0 0 0 1 0 1 1 0 0 0 1 1 0 1 0 1 1 1 1 1\n"


@pytest.mark.parametrize(
    ("text", "area_right", "volume_right"),
    [
        ("UNSTRUCTURED_GRID|CELLS 1 9\n8 0 1 2 3 4 5 6 7\nCELL_TYPES 1\n11\n", 6.0, 1.0),  # a voxel
        (
            "UNSTRUCTURED_GRID|CELLS 2 10\n4 0 1 2 3\n4 4 5 6 7\nCELL_TYPES 2\n8\n8\nPOINT_DATA 8\nSCALARS a float\n",
            2.0,
            0.0,
        ),  # pixels
        ("POLYDATA|VERTICES 1 2\n1 0\nTRIANGLE_STRIPS 1 9\n8 0 1 2 3 6 7 4 5\n", 3.0, 0.0),  # three sides of a cube
        ("POLYDATA|FIELD f 1\nx 1 2 int\n5 6\nPOLYGONS 2 9\n3 0 1 3\n4 4 5 7 6\nCELL_DATA 2\n", 1.5, 0.0),
    ],
)
def test_cells_that_other_readers_of_vtk_leave_out(tmp_path, text, area_right, volume_right):
    kind, cells_of = text.split("|")
    (tmp_path / "a.vtk").write_text(GRID_HEAD.format(kind) + cells_of)
    mesh = meshes.read(tmp_path / "a.vtk")
    assert area(mesh) == pytest.approx(area_right)
    if volume_right:
        assert volume(mesh) == pytest.approx(volume_right)
    assert mesh.notes == []


@pytest.mark.parametrize("compressor", ["None", "ZLib", "LZMA"])
@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended", "encoded"])
def test_every_encoding_of_vtk_itself(tmp_path, mode, compressor):
    """Grids and surfaces, with heads of 32 and 64 bits, of both orders of bytes, in several blocks; the legacy versions too."""
    vtk = pytest.importorskip("vtk")
    ball = vtk.vtkSphereSource()
    strips = vtk.vtkStripper()
    strips.SetInputConnection(ball.GetOutputPort())
    strips.Update()
    surface, grid = strips.GetOutput(), vtk.vtkUnstructuredGrid()
    image = vtk.vtkImageData()
    image.SetDimensions(3, 3, 3)
    append = vtk.vtkAppendFilter()
    append.AddInputData(image)
    append.Update()
    grid = append.GetOutput()  # of eight voxels
    measure = vtk.vtkMassProperties()
    measure.SetInputConnection(ball.GetOutputPort())
    for bits, big in ((32, True), (64, False)):
        for data, writer, name in (
            (grid, vtk.vtkXMLUnstructuredGridWriter(), "a.vtu"),
            (surface, vtk.vtkXMLPolyDataWriter(), "a.vtp"),
        ):
            writer.SetInputData(data)
            writer.SetFileName(str(tmp_path / name))
            getattr(writer, f"SetDataModeTo{'Appended' if mode == 'encoded' else mode}")()
            writer.SetEncodeAppendedData(mode == "encoded")
            getattr(writer, f"SetCompressorTypeTo{compressor}")()
            getattr(writer, f"SetHeaderTypeToUInt{bits}")()
            writer.SetByteOrder(0 if big else 1)
            writer.SetBlockSize(256)
            writer.Write()
        assert volume(meshes.read(tmp_path / "a.vtu")) == pytest.approx(8.0)
        assert area(meshes.read(tmp_path / "a.vtp")) == pytest.approx(measure.GetSurfaceArea(), rel=1e-5)
    for data, writer in ((grid, vtk.vtkUnstructuredGridWriter()), (surface, vtk.vtkPolyDataWriter())):
        writer.SetInputData(data)
        writer.SetFileName(str(tmp_path / "a.vtk"))
        writer.SetFileVersion(42 if mode == "Ascii" else 51)
        writer.SetFileType(1 if compressor == "None" else 2)
        writer.Write()
        mesh = meshes.read(tmp_path / "a.vtk")
        assert (volume(mesh) if data is grid else area(mesh)) == pytest.approx(
            8.0 if data is grid else measure.GetSurfaceArea(), rel=1e-5
        )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("CELLS 1 9", "CELLS 1 8", "do not have the vertices"),
        ("CELLS 1 9", "CELLS 1 99", "could not convert string"),
        ("8 0 1 2 3 4 5 6 7", "8 0 1 2 3 4 5 6 9", "out of range"),
        ("\n11\n", "\n12 13\n", "12 13|not known"),
        ("\n11\n", "\n10\n", "a tetra has 8 vertices; needed: 4"),
        ("8 float", "8 flaot", "type flaot"),
        ("ASCII", "ASKII", "needed: ASCII or BINARY"),
        ("CELL_TYPES 1\n11\n", "", "no CELL_TYPES"),
    ],
)
def test_damaged_files_of_vtk(tmp_path, old, new, message):
    good = GRID_HEAD.format("UNSTRUCTURED_GRID") + "CELLS 1 9\n8 0 1 2 3 4 5 6 7\nCELL_TYPES 1\n11\n"
    (tmp_path / "a.vtk").write_text(good.replace(old, new))
    with pytest.raises(SceneError, match=rf"a\.vtk.*({message})"):
        meshes.read(tmp_path / "a.vtk")


@pytest.mark.parametrize(("head", "message"), [('upAxis = "X"', "needed: Y or Z"), ("metersPerUnit = 0", "a number above 0")])
def test_a_stage_without_a_right_unit_or_axis(tmp_path, head, message):
    pytest.importorskip("pxr", reason='the extra "usd" is not installed')
    mesh = "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\npoint3f[] points = [(0, 0, 0), (1, 0, 0), (0, 0, 1)]"
    (tmp_path / "a.usda").write_text(f'#usda 1.0\n(\n{head}\n)\ndef Mesh "m"\n{{\n{mesh}\n}}\n')
    with pytest.raises(SceneError, match=message):
        meshes.read(tmp_path / "a.usda")


def test_a_glb_says_what_it_leaves_out(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    box = trimesh.creation.box((1, 1, 1))
    scene.add_geometry(box, node_name="one")
    scene.add_geometry(box, node_name="two", transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.add_geometry(trimesh.load_path(np.array([[[0, 0, 0], [1, 0, 5.0]]])))
    scene.export(tmp_path / "a.glb")
    mesh = meshes.read(tmp_path / "a.glb")
    assert (len(mesh.vertices), area(mesh)) == (16, pytest.approx(12.0))
    assert mesh.notes == ["1 lines or clouds of points were left out"]


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE_OFF = "OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
TRIANGLE_MEDIT = "MeshVersionFormatted 2\nDimension 3\nVertices 3\n0 0 0 0\n1 0 0 0\n0 2 0 0\nTriangles 1\n1 2 3 0\n"


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(
    ("name", "text"), [("a.obj", SQUARE + "f 1 2 3 4\n"), ("a.off", SQUARE_OFF), ("a.mesh", TRIANGLE_MEDIT)]
)
def test_marks_that_editors_put_before_a_text_cost_no_vertex(tmp_path, name, text, coding):
    (tmp_path / name).write_text(text.replace("\n", "\r\n"), encoding=coding, newline="")
    mesh = meshes.read(tmp_path / name)
    assert (area(mesh), mesh.notes) == (pytest.approx(1.0), [])


def test_only_line_ends_end_the_lines_of_an_obj(tmp_path):
    """Not what Python also takes for one, such as the marks of old printers in the name of a group."""
    (tmp_path / "a.obj").write_text(SQUARE + "g one\x85f 1 2 3\ng two\u2028v 9 9 9\x0cf 1 2 3\nf 1 2 3 4\n", encoding="utf-8")
    mesh = meshes.read(tmp_path / "a.obj")
    assert (len(mesh.vertices), area(mesh)) == (4, pytest.approx(1.0))


LOOP = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\n{}endloop\nendfacet\n"


def test_stl_with_a_vertex_in_its_name_and_with_loops_of_four(tmp_path):
    (tmp_path / "a.stl").write_text(f"solid my outer vertex\n{LOOP.format('')}endsolid my outer vertex\n")
    assert area(meshes.read(tmp_path / "a.stl")) == pytest.approx(0.5)
    (tmp_path / "a.stl").write_text("solid " + LOOP.format("").replace("\n", " ") + "endsolid")
    assert area(meshes.read(tmp_path / "a.stl")) == pytest.approx(0.5)
    (tmp_path / "a.stl").write_text("solid four\n" + 3 * LOOP.format("vertex 0 1 0\n") + "endsolid four\n")
    with pytest.raises(SceneError, match="holds 12 vertices in 3 loops; needed: three in each"):
        meshes.read(tmp_path / "a.stl")


def test_elements_of_a_ply_that_are_no_faces_are_said(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"element {name} 1\nproperty list uchar int vertex_indices\n" for name in ("tet", "face")) + "end_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n" + 2 * "4 0 1 2 3\n")
    mesh = meshes.read(tmp_path / "a.ply")
    assert (area(mesh), mesh.notes) == (pytest.approx(1.0), ["1 elements of the kind tet were left out"])


TETS = ("0 0 0", "1 0 0", "0 1 0", "0 0 1", "1 1 1")  # volumes 1/6 and 1/3


@pytest.mark.parametrize("numbers", [(0, 1, 2, 3, 4), (1, 2, 3, 4, 5), (3, 1, 5, 2, 4), (10, 20, 30, 40, 50)])
@pytest.mark.parametrize("attributes", [0, 7])
def test_nodes_of_tetgen_go_by_their_numbers(tmp_path, numbers, attributes):
    (tmp_path / "a.node").write_text("5 3 0 0\n" + "".join(f"{k} {x}\n" for k, x in zip(numbers, TETS, strict=True)))
    rows = [" ".join(str(numbers[k]) for k in tet) + attributes * " 9" for tet in ((0, 1, 2, 3), (1, 2, 3, 4))]
    (tmp_path / "a.ele").write_text(f"2 4 {attributes}\n1 {rows[0]}\n2 {rows[1]}\n")
    mesh = meshes.read(tmp_path / "a.ele")
    assert (volume(mesh), mesh.notes) == (pytest.approx(0.5), [])
    (tmp_path / "a.ele").write_text(f"1 4 0\n1 {numbers[0]} {numbers[1]} {numbers[2]} 99\n")
    with pytest.raises(SceneError, match="a tet names node 99, which is not there"):
        meshes.read(tmp_path / "a.ele")


@pytest.mark.parametrize("parametric", [False, True])
@pytest.mark.parametrize("binary", [False, True])
def test_gmsh_4_0(tmp_path, binary, parametric):
    """Where the numbers of nodes and elements stand in another order than in 4.1."""
    points = [[float(x) for x in row.split()] + [0.5, 0.5] * parametric for row in TETS]
    tets = [(1, 1, 2, 3, 4), (2, 2, 3, 4, 5)]
    if binary:
        nodes = struct.pack("<2Q3iQ", 1, 5, 1, 2, int(parametric), 5)
        nodes += b"".join(struct.pack(f"<i{len(row)}d", k, *row) for k, row in enumerate(points, 1))
        elements = struct.pack("<2Q3iQ", 1, 2, 1, 3, 4, 2) + b"".join(struct.pack("<5i", *row) for row in tets)
        head = b"4 1 8\n" + struct.pack("<i", 1)
    else:
        nodes = f"1 5\n1 2 {int(parametric)} 5\n" + "\n".join(" ".join(map(str, [k, *row])) for k, row in enumerate(points, 1))
        elements = "1 2\n1 3 4 2\n" + "\n".join(" ".join(map(str, row)) for row in tets)
        nodes, elements, head = nodes.encode(), elements.encode(), b"4 0 8"
    parts = [(b"MeshFormat", head), (b"Nodes", nodes), (b"Elements", elements)]
    (tmp_path / "a.msh").write_bytes(b"".join(b"$%s\n%s\n$End%s\n" % (name, inside, name) for name, inside in parts))
    assert volume(meshes.read(tmp_path / "a.msh")) == pytest.approx(0.5)


def test_gmsh_with_two_tables_of_elements_is_not_read_by_half(tmp_path):
    table = "$Elements\n1\n1 4 2 0 1 {}\n$EndElements\n"
    nodes = "$Nodes\n5\n" + "".join(f"{k} {x}\n" for k, x in enumerate(TETS, 1)) + "$EndNodes\n"
    text = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n" + nodes + table.format("1 2 3 4") + table.format("2 3 4 5")
    (tmp_path / "a.msh").write_text(text)
    with pytest.raises(SceneError, match=r"more than one \$Elements"):
        meshes.read(tmp_path / "a.msh")


def test_cells_of_third_order_of_medit_are_said(tmp_path):
    (tmp_path / "a.mesh").write_text(TRIANGLE_MEDIT + "TrianglesP3 2\n" + 2 * "1 2 3 1 2 3 1 2 3 1 0\n" + "End\n")
    mesh = meshes.read(tmp_path / "a.mesh")
    assert (area(mesh), mesh.notes) == (pytest.approx(1.0), ["2 cells of the kind trianglesp3 were left out"])


@pytest.mark.parametrize("values", [np.eye(3) * 1j, np.zeros((3, 3), "M8[s]"), np.eye(3).astype(str), np.eye(3, dtype=bool)])
def test_archives_of_other_things_than_numbers(tmp_path, values):
    np.savez(tmp_path / "a.npz", V=values, F=np.array([[0, 1, 2]]))
    with pytest.raises(SceneError, match=r"V holds .*; it must hold real numbers"):
        meshes.read(tmp_path / "a.npz")


def test_archives_that_need_more_memory_than_there_is(tmp_path, monkeypatch):
    """What is packed into little counts, too."""
    np.savez_compressed(tmp_path / "a.npz", V=np.zeros((1_000_000, 3)), F=np.array([[0, 1, 2]]))
    assert (tmp_path / "a.npz").stat().st_size < 100_000
    monkeypatch.setattr(surfaces, "free_memory", lambda: 50_000_000)
    with pytest.raises(SceneError, match=r"needs about 0\.0894 GiB of memory, and 0\.0466 GiB are free"):
        meshes.read(tmp_path / "a.npz")


def test_a_vtu_that_unpacks_to_too_much_is_not_unpacked(tmp_path):
    block, count = zlib.compress(bytes(1 << 24)), 200
    packed = base64.b64encode(struct.pack(f"<{3 + count}Q", count, 1 << 24, 0, *[len(block)] * count)) + base64.b64encode(
        block * count
    )
    array = f'<DataArray type="Float64" NumberOfComponents="3" format="binary">{packed.decode()}</DataArray>'
    (tmp_path / "a.vtu").write_text(
        '<VTKFile type="UnstructuredGrid" byte_order="LittleEndian" header_type="UInt64" compressor="vtkZLibDataCompressor">'
        f"<UnstructuredGrid><Piece><Points>{array}</Points></Piece></UnstructuredGrid></VTKFile>"
    )
    with pytest.raises(SceneError, match=r"a DataArray would unpack to 3\.12 GiB"):
        meshes.read(tmp_path / "a.vtu")


def glb(path, primitives: list[dict], **more) -> None:
    """A unit square in the plane of x and y, and indices 0, 1, 2, 0, 2, 3, in a file with these primitives."""
    places, indices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4"), np.array([0, 1, 2, 0, 2, 3], "<u4")
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, **each} for each in primitives]}],
        "buffers": [{"byteLength": places.nbytes + indices.nbytes}],
        "bufferViews": [
            {"buffer": 0, "byteLength": places.nbytes},
            {"buffer": 0, "byteOffset": places.nbytes, "byteLength": indices.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5125, "count": 6, "type": "SCALAR"},
        ],
    }
    for name, change in more.items():
        tree[name] = change(tree[name]) if callable(change) else change
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = places.tobytes() + indices.tobytes()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def test_primitives_of_a_glb(tmp_path):
    pytest.importorskip("trimesh")
    glb(tmp_path / "a.glb", [{"indices": 1}])
    mesh = meshes.read(tmp_path / "a.glb")
    assert (area(mesh), mesh.notes) == (pytest.approx(1.0), [])
    glb(tmp_path / "a.glb", [{"indices": 1}, {"mode": 6}], extensionsRequired=["KHR_materials_unlit"])
    mesh = meshes.read(tmp_path / "a.glb")
    assert (area(mesh), mesh.notes) == (pytest.approx(1.0), ["1 fans of triangles were left out; write them as triangles"])
    glb(tmp_path / "a.glb", [{"indices": 1}], nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}])
    assert any("EXT_mesh_gpu_instancing were left out" in note for note in meshes.read(tmp_path / "a.glb").notes)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "requires the extension KHR_draco_mesh_compression"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "requires the extension EXT_meshopt_compression"),
        ({"accessors": lambda given: [{**given[0], "sparse": {"count": 1}}, given[1]]}, "its accessor 0 is sparse"),
        ({"accessors": lambda given: [{**given[0], "normalized": True}, given[1]]}, "its accessor 0 is normalized"),
    ],
)
def test_glbs_whose_places_would_be_read_wrongly(tmp_path, more, said):
    pytest.importorskip("trimesh")
    glb(tmp_path / "a.glb", [{"indices": 1}], **more)
    with pytest.raises(SceneError, match=said):
        meshes.read(tmp_path / "a.glb")


@pytest.mark.parametrize("what", ["references", "payload"])
def test_parts_of_a_stage_that_are_not_there_are_said(tmp_path, what):
    pytest.importorskip("pxr", reason='the extra "usd" is not installed')
    mesh = "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\npoint3f[] points = [(0, 0, 0), (1, 0, 0), (0, 0, 1)]"
    lost = f'def Xform "lost" ({what} = @not_there.usda@)\n{{\n}}\n'
    (tmp_path / "a.usda").write_text(f'#usda 1.0\n(\nmetersPerUnit = 1\n)\ndef Mesh "m"\n{{\n{mesh}\n}}\n{lost}')
    mesh = meshes.read(tmp_path / "a.usda")
    assert area(mesh) == pytest.approx(0.5)
    assert (
        len(mesh.notes) == 1
        and "1 parts of the stage could not be put together: Could not open asset @not_there" in mesh.notes[0]
    )
    (tmp_path / "a.usda").write_text(f"#usda 1.0\n{lost}")
    with pytest.raises(SceneError, match=r"holds no Mesh; 1 parts .* Could not open asset @not_there\.usda@"):
        meshes.read(tmp_path / "a.usda")


# --- the process that reads what others parse ---


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('(1 "meshio 5.3.5")\n(2 3)\n(10 (0 1 1b 0))\n(12 (0 1 30 0))\n(301', "took more than 1 s"),
        ("nonsense", "cannot be read as .msh"),
    ],
)
def test_parsers_that_never_end_are_ended(tmp_path, monkeypatch, text, message):
    monkeypatch.setattr(worker, "SECONDS", 1.0)  # of work; how long that takes by the clock is the machine's
    monkeypatch.setattr(worker, "WAITING", 600.0)
    (tmp_path / "a.msh").write_text(text)
    begun = time.monotonic()
    with pytest.raises(SceneError, match=message) as caught:
        meshes.read(tmp_path / "a.msh")
    assert str(tmp_path / "a.msh") in str(caught.value)
    assert time.monotonic() - begun < 300.0


def test_one_process_reads_many_files_and_goes_on_after_a_failure(tmp_path, monkeypatch):
    monkeypatch.setattr(worker, "SECONDS", 1.0)  # of work; how long that takes by the clock is the machine's
    monkeypatch.setattr(worker, "WAITING", 600.0)
    meshio.Mesh(QUAD_AND_TRIANGLES, [("triangle", [[1, 2, 5]])]).write(tmp_path / "good.msh", file_format="ansys")
    (tmp_path / "bad.msh").write_text("nonsense")
    (tmp_path / "endless.msh").write_text("(10 (0 1 1b 0))\n(301")
    with worker.Worker() as reader:
        first = meshes.read(tmp_path / "good.msh", reader)
        process = reader.process
        for name in ("bad.msh", "endless.msh"):
            with pytest.raises(SceneError):
                meshes.read(tmp_path / name, reader)
        again = meshes.read(tmp_path / "good.msh", reader)
    assert np.array_equal(first.vertices, again.vertices)
    assert process.poll() is not None and reader.process is None, "none is left behind"


def test_bytes_that_are_no_text_are_an_error_with_the_place(tmp_path):
    pytest.importorskip("pxr", reason='the extra "usd" is not installed')
    (tmp_path / "a.usda").write_bytes(b'#usda 1.0\ndef Mesh "m"\n{\n    point3f[] points = [(0, 0, \xff\xfe0)]\n}\n')
    with pytest.raises(SceneError, match=r"cannot be read as \.usda: .*a\.usda:4"):
        meshes.read(tmp_path / "a.usda")
