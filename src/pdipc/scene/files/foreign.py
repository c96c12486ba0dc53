"""Formats that other packages parse: VTK and others by meshio, glTF by trimesh, USD by its own library."""

import contextlib
import io
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import CORNERS, ORDER_AS_HEXAHEDRON, Contents, Damaged, backwards, first_of, no_such
from pdipc.scene.files.volumes import is_gmsh

MESHES = ("Mesh", "TetMesh")


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

    text = _glb_head(path)
    fans = _glb_fans(json.loads(text)) if text else 0
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
    if fans:
        notes.append(f"{fans} fans of triangles were left out; write them as triangles")
    moving = [name for name in ("skins", "animations", "targets", "EXT_mesh_gpu_instancing") if f'"{name}"'.encode() in text]
    if moving:
        notes.append(f"{' and '.join(moving)} were left out: the mesh is as it stands without them")
    return Contents(np.concatenate(points), [("triangle", np.concatenate(triangles))], notes=notes, repeats=True)


GLB_MODES = {None, 0, 1, 2, 3, 4, 5}  # of what is drawn: triangles, strips of them, lines and points; not fans
GLB_KNOWN = re.compile(
    r"KHR_(materials|texture|lights|mesh_quantization|xmp)\w*|EXT_texture\w*"
)  # that a file may require, as places hold without


def _glb_head(path: Path) -> bytes:
    """The JSON of a .glb; nothing where it is none."""
    with open(path, "rb") as file:
        head = file.read(20)
        return file.read(int.from_bytes(head[12:16], "little")) if head[:4] == b"glTF" and head[16:20] == b"JSON" else b""


def _glb_fans(tree: dict) -> int:
    """How many primitives are fans. Raises Damaged for what trimesh would read as something else without a word: places that an extension
    packs, that are sparse, or that are fractions of the largest whole number.
    """
    required = [name for name in tree.get("extensionsRequired", []) if not GLB_KNOWN.fullmatch(name)]
    if required:
        raise Damaged(f"it requires the extension {required[0][:60]}, which is not read; write it without")
    accessors, fans = tree.get("accessors", []), 0
    for mesh in tree.get("meshes", []):
        for primitive in mesh.get("primitives", []):
            fans += primitive.get("mode") not in GLB_MODES
            for which in (primitive.get("attributes", {}).get("POSITION"), primitive.get("indices")):
                if which is None:
                    continue
                if "sparse" in accessors[which]:
                    raise Damaged(f"its accessor {which} is sparse, which is not read; write it in full")
                if accessors[which].get("normalized"):
                    raise Damaged(f"its accessor {which} is normalized, which is not read for places; write them as float")
    return fans


def usd(path: Path, frames: bool = False, below: str | None = None) -> Contents:
    """All meshes of a stage, where they stand at its start, in metres with y up; frames: at all of its times from then on; below: only those of
    the prim at this path and below it.
    """
    try:
        from pxr import Usd
    except ImportError as error:
        raise SceneError(f'mesh file "{path}": reading USD needs the extra: pip install "pdipc[usd]"') from error
    stage = Usd.Stage.Open(str(path))  # its prims live no longer than it does
    start = usd_start(stage)
    first = Usd.TimeCode(start)
    root = stage.GetPseudoRoot() if below is None else _usd_prim(stage, path, below)
    prims, others, hidden = usd_meshes(root, first)
    found = Contents(np.zeros((0, 3)))
    broken = _usd_broken(stage)
    if not prims:
        said = "".join(f"; {each}" for each in broken)
        raise SceneError(f'mesh file "{path}": {"" if below is None else f"its prim {below} "}holds no Mesh{said}')
    convert, said = _units(stage)
    found.points = convert(_usd_points(prims, first))
    corners, counts, size = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], 0
    for prim in prims:
        own = len(prim.GetAttribute("points").Get(first))
        tets = prim.GetAttribute("tetVertexIndices" if prim.IsA("TetMesh") else "tetraIndices")
        if tets and tets.HasValue():
            # a mirror turns tets inside out; those of a whole block are turned back
            found.cells.append(("tetra", np.array(tets.Get(first)).reshape(-1, 4) + size))
        else:
            rows, sides = _usd_faces(prim, own, first)
            corners.append(rows + size)
            counts.append(sides)
        size += own
    found.polygons = np.concatenate(corners), np.concatenate(counts)
    samples = {time for prim in prims for time in _usd_times(prim)}
    times = sorted({start, *(time for time in samples if time > start)}) if len(samples) > 1 else [start]
    if frames and len(times) > 1:
        found.frames = np.stack([convert(_usd_points(prims, Usd.TimeCode(time))) for time in times])
        found.times = np.array(times) / stage.GetTimeCodesPerSecond()
    found.notes += said + broken
    if others:
        listed = ", ".join(f"{number} {kind}" for kind, number in sorted(others.items()))
        found.notes.append(f"prims were left out: {listed}")
    if hidden:
        found.notes.append(f"{hidden} invisible prims were left out")
    if len(times) > 1 and not frames:
        found.notes.append(first_of(len(times)))
    return found


def _usd_broken(stage) -> list[str]:
    """A note where other files that the stage names are not there, or cannot be read: what they hold is not in it."""
    errors = stage.GetCompositionErrors()
    if not errors:
        return []
    return [f"{len(errors)} parts of the stage could not be put together: {' '.join(str(errors[0]).split())[:200]}"]


def usd_start(stage) -> float:
    """The time code that a simulation begins at: the stage's start; where it says none, its first time sample, or 0."""
    if stage.HasAuthoredMetadata("startTimeCode"):
        return stage.GetStartTimeCode()
    return min((time for prim in stage.Traverse() if prim.GetTypeName() in MESHES for time in _usd_times(prim)), default=0.0)


def usd_meshes(root, first) -> tuple[list, dict[str, int], int]:
    """The meshes that are simulated of a prim and all below it, in their order; what else has a shape, by kind; how many prims are invisible."""
    from pxr import Usd, UsdGeom

    prims, others, hidden = [], {}, 0
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()):
        kind = str(prim.GetTypeName())
        if not UsdGeom.Gprim(prim) and kind not in ("PointInstancer", "Skeleton"):
            continue
        purpose = UsdGeom.Imageable(prim).ComputePurpose()
        if UsdGeom.Imageable(prim).ComputeVisibility(first) == UsdGeom.Tokens.invisible:
            hidden += 1
            continue
        if purpose in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):  # they stand for what is there as well
            kind = f"{kind} of purpose {purpose}"
        elif kind in MESHES and prim.GetAttribute("points").Get(first):
            prims.append(prim)
            continue
        elif kind in MESHES:
            kind = f"{kind} without points"
        others[kind] = others.get(kind, 0) + 1
    return prims, others, hidden


def _usd_prim(stage, path: Path, wanted: str):
    """The prim at a path. Raises SceneError, with the prims that are meshes, where there is none."""
    from pxr import Sdf

    prim = stage.GetPrimAtPath(wanted) if Sdf.Path.IsValidPathString(wanted) and Sdf.Path(wanted).IsAbsolutePath() else None
    if prim:
        return prim
    there = [str(prim.GetPath()) for prim in stage.Traverse() if prim.GetTypeName() in MESHES]
    raise no_such(path, "prim", wanted, there)


def _usd_points(prims: list, time) -> np.ndarray:
    """(n, 3) points of all prims at a time, in the stage's coordinates."""
    from pxr import UsdGeom

    placed, points = UsdGeom.XformCache(time), []
    for prim in prims:
        values = prim.GetAttribute("points").Get(time)
        if not values:
            raise Damaged(f'{prim.GetTypeName()} "{prim.GetPath()}" has no points')
        matrix = np.array(placed.GetLocalToWorldTransform(prim))  # for rows: p' = p M
        points.append(np.array(values, dtype=np.float64).reshape(-1, 3) @ matrix[:3, :3] + matrix[3, :3])
    return np.concatenate(points)


def _usd_faces(prim, size: int, time) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the faces of a Mesh, one after another, and corners of each; without holes, and facing outward in the stage."""
    from pxr import UsdGeom

    sides = np.array(prim.GetAttribute("faceVertexCounts").Get(time), dtype=np.int64).ravel()
    rows = np.array(prim.GetAttribute("faceVertexIndices").Get(time), dtype=np.int64).ravel()
    if (len(sides) and sides.min() < 0) or sides.sum() != len(rows):
        raise Damaged(f'Mesh "{prim.GetPath()}" has {len(rows)} corners, and its faces say {sides.sum()}')
    if len(rows) and (rows.min() < 0 or rows.max() >= size):
        raise Damaged(f'Mesh "{prim.GetPath()}" names a vertex that is not there; indices must be 0 to {size - 1}')
    matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim))
    left = prim.GetAttribute("orientation").Get(time) == UsdGeom.Tokens.leftHanded
    if (np.linalg.det(matrix[:3, :3]) < 0) != left:
        rows = backwards(rows, sides)
    kept = np.ones(len(sides), dtype=bool)
    kept[[hole for hole in prim.GetAttribute("holeIndices").Get(time) or [] if 0 <= hole < len(sides)]] = False
    return rows[np.repeat(kept, sides)], sides[kept]


def _usd_times(prim) -> list[float]:
    """The time codes at which a prim's points are given; where its place is animated, whole ones, too: between keys prims turn, which points that go
    straight do not follow.
    """
    from pxr import UsdGeom

    times, keys = list(prim.GetAttribute("points").GetTimeSamples()), []
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            keys += UsdGeom.Xformable(prim).GetTimeSamples()
        prim = prim.GetParent()
    return [*times, *keys, *np.arange(np.ceil(min(keys)), max(keys)).tolist()] if keys else times


def _units(stage) -> tuple[Callable[[np.ndarray], np.ndarray], list[str]]:
    """What turns a stage's points into metres with y up, and the notes that say so."""
    from pxr import UsdGeom

    unit, notes = 1.0, ["it does not say metersPerUnit: its numbers were taken as m"]
    if UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        unit = UsdGeom.GetStageMetersPerUnit(stage)
        notes = [f"its unit of {unit:g} m was converted to m"] if unit != 1.0 else []
    if not (np.isfinite(unit) and unit > 0.0):
        raise Damaged(f"its metersPerUnit is {unit:g}; needed: a number above 0")
    axis = UsdGeom.GetStageUpAxis(stage)
    if axis not in (UsdGeom.Tokens.y, UsdGeom.Tokens.z):
        raise Damaged(f'its upAxis is "{axis}"; needed: Y or Z')
    upright = axis == UsdGeom.Tokens.y
    if not upright:
        notes.append("its z axis, which points up, was turned to y")

    def convert(points: np.ndarray) -> np.ndarray:
        return points * unit if upright else points[:, [0, 2, 1]] * [unit, unit, -unit]

    return convert, notes
