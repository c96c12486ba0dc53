"""Formats that other packages parse: VTK and others by meshio, glTF by trimesh, USD by its own library."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np

from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import CORNERS, ORDER_AS_HEXAHEDRON, Contents, Damaged
from pdipc.scene.files.volumes import is_gmsh


def by_meshio(path: Path) -> Contents:
    import meshio

    form = {".vtk": "vtk", ".vtu": "vtu"}.get(path.suffix.lower()) or ("gmsh" if is_gmsh(path) else "ansys")
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path, file_format=form)
    except SystemExit as error:  # meshio prints what is wrong and ends the process on some files
        raise Damaged(" ".join(said.getvalue().split())) from error
    found = Contents(np.asarray(mesh.points, dtype=np.float64))
    polygons = [np.asarray(block.data) for block in mesh.cells if block.type.startswith("polygon")]
    counts = [np.full(len(block), block.shape[1]) for block in polygons if len(block)]
    if counts:
        found.polygons = np.concatenate([block.ravel() for block in polygons]), np.concatenate(counts)
    for block in mesh.cells:
        if block.type.startswith("polygon"):
            continue
        base = re.sub(r"^VTK_(LAGRANGE|BEZIER|HIGHER_ORDER)_|^VTK_QUADRATIC_|[0-9_]*$", "", block.type).lower()
        base = {"tetrahedron": "tetra", "quadrilateral": "quad", "curve": "line", "edge": "line"}.get(base, base)
        rows = block.data
        if base in ORDER_AS_HEXAHEDRON:
            base, order = ORDER_AS_HEXAHEDRON[base]
            rows = np.asarray(rows)[:, order]
        if base in CORNERS:
            found.cells.append((base, np.asarray(rows)))
        else:
            found.notes.append(f"{len(rows)} cells of the kind {block.type} were left out")
    return found


def glb(path: Path) -> Contents:
    import trimesh

    scene = trimesh.load_scene(path, process=False)
    kinds = {name: type(geometry).__name__ for name, geometry in scene.geometry.items()}
    points, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    notes, others = [], [name for name in kinds if kinds[name] != "Trimesh"]
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if kinds[name] == "Trimesh":
            mesh = scene.geometry[name]
            points.append(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])
            faces = np.asarray(mesh.faces)
            if len(faces) and (faces.min() < 0 or faces.max() >= len(mesh.vertices)):
                raise Damaged("a triangle names a vertex that is not there: index out of range")
            triangles.append((faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces) + count)
            count += len(mesh.vertices)
    if others:
        notes.append(f"{len(others)} lines or clouds of points were left out")
    head = path.read_bytes()[:20]
    length = int.from_bytes(head[12:16], "little") if head[:4] == b"glTF" else 0
    text = path.read_bytes()[20 : 20 + length]
    moving = [name for name in ("skins", "animations", "targets") if f'"{name}"'.encode() in text]
    if moving:
        notes.append(f"{' and '.join(moving)} were left out: the mesh is as it stands without them")
    return Contents(np.concatenate(points), [("triangle", np.concatenate(triangles))], notes=notes, repeats=True)


def usd(path: Path) -> Contents:
    try:
        from pxr import Usd, UsdGeom
    except ImportError as error:
        raise SceneError(f'mesh file "{path}": reading USD needs the extra: pip install "pdipc[usd]"') from error
    stage = Usd.Stage.Open(str(path))  # its prims live no longer than it does
    time = Usd.TimeCode.EarliestTime()
    placed = UsdGeom.XformCache(time)
    points, cells, corners, counts, notes = [], [], [], [], []
    others: dict[str, int] = {}
    hidden, moving, size = 0, 0, 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        kind = str(prim.GetTypeName())
        if not prim.IsA(UsdGeom.Gprim) and kind != "PointInstancer":
            continue
        if UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            hidden += 1
            continue
        if kind not in ("Mesh", "TetMesh"):
            others[kind] = others.get(kind, 0) + 1
            continue
        values = prim.GetAttribute("points").Get(time)
        if not values:
            raise Damaged(f'{kind} "{prim.GetPath()}" has no points')
        matrix = np.array(placed.GetLocalToWorldTransform(prim))  # for rows: p' = p M
        own = np.array(values, dtype=np.float64).reshape(-1, 3) @ matrix[:3, :3] + matrix[3, :3]
        mirrored = (np.linalg.det(matrix[:3, :3]) < 0) != (
            prim.GetAttribute("orientation").Get(time) == UsdGeom.Tokens.leftHanded
        )
        moving += _usd_moves(prim)
        tets = prim.GetAttribute("tetVertexIndices" if kind == "TetMesh" else "tetraIndices")
        if tets and tets.HasValue():
            # a mirror turns tets inside out; `from_contents` turns back those of a whole block
            cells.append(("tetra", np.array(tets.Get(time)).reshape(-1, 4) + size))
        else:
            sides = np.array(prim.GetAttribute("faceVertexCounts").Get(time), dtype=np.int64).ravel()
            rows = np.array(prim.GetAttribute("faceVertexIndices").Get(time), dtype=np.int64).ravel()
            if (len(sides) and sides.min() < 0) or sides.sum() != len(rows):
                raise Damaged(f'Mesh "{prim.GetPath()}" has {len(rows)} corners, and its faces say {sides.sum()}')
            if len(rows) and (rows.min() < 0 or rows.max() >= len(own)):
                raise Damaged(f'Mesh "{prim.GetPath()}" names vertex {rows.max()}; indices must be 0 to {len(own) - 1}')
            holes = prim.GetAttribute("holeIndices").Get(time)
            kept = np.ones(len(sides), dtype=bool)
            kept[[hole for hole in holes or [] if 0 <= hole < len(sides)]] = False
            if mirrored:
                ends = np.cumsum(sides)
                rows = rows[
                    np.concatenate([np.arange(e - 1, e - n - 1, -1) for e, n in zip(ends, sides, strict=True)] or [[]]).astype(
                        int
                    )
                ]
            corners.append(rows[np.repeat(kept, sides)] + size)
            counts.append(sides[kept])
        points.append(own)
        size += len(own)
    if not points:
        raise SceneError(f'mesh file "{path}": holds no Mesh')
    whole = np.concatenate(points)
    if UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        unit = UsdGeom.GetStageMetersPerUnit(stage)
        whole = whole * unit
        if unit != 1.0:
            notes.append(f"its unit of {unit:g} m was converted to m")
    else:
        notes.append("it does not say metersPerUnit: its numbers were taken as m")
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        whole = whole[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        notes.append("its z axis, which points up, was turned to y")
    if others:
        listed = ", ".join(f"{number} {kind}" for kind, number in sorted(others.items()))
        notes.append(f"what is no Mesh was left out: {listed}")
    if hidden:
        notes.append(f"{hidden} invisible prims were left out")
    if moving:
        notes.append(f"{moving} of its meshes move or deform: they were read as they are at the first time")
    if corners:
        return Contents(whole, cells, (np.concatenate(corners), np.concatenate(counts)), notes)
    return Contents(whole, cells, notes=notes)


def _usd_moves(prim) -> bool:
    from pxr import UsdGeom

    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
            return True
        if prim.IsA(UsdGeom.PointBased) and prim.GetAttribute("points").ValueMightBeTimeVarying():
            return True
        prim = prim.GetParent()
    return False
