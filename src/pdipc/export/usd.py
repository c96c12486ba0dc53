"""Runs as USD: a stage of their own, or a layer over the stage that the scene's meshes came from (docs/usd_and_blender.md)."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pdipc.output.results import Run, RunError
from pdipc.pictures.render import OBSTACLE, PALETTE, SHARP_EDGE
from pdipc.scene.files.foreign import usd_meshes, usd_start
from pdipc.scene.meshes import USD_SUFFIXES, split_prim
from pdipc.scene.motion import rotation_matrix

WRITTEN = (".usd", ".usda", ".usdc")
WHOLE = 1e-6  # rates and time codes that are nearer than this part to a whole number, or to a rate of film and television, are meant to be it
SAME_PLACE = 1e-5  # of a body's size: a point of the stage and a vertex that are no further apart are the same
NEIGHBOURS = 12  # tets near a point among which the one that it is in is looked for
SAME_NORMAL = 0.999  # cosine between the normals of corners that are shaded as one


def rate_of(run: Run) -> float:
    """Frames a second: what the times between frames mean, such as 24 for steps of 0.0416667 s."""
    if run.frame_count < 2:
        return 24.0
    rate = (run.frame_count - 1) / float(run.times[-1] - run.times[0])
    for meant in (round(rate), round(rate * 1.001) / 1.001):
        if meant > 0 and abs(rate - meant) <= WHOLE * rate:
            return float(meant)
    return rate


def time_codes(run: Run, rate: float, start: float = 0.0) -> list[float]:
    """Of each frame: its time in units of 1 / rate s."""
    codes = start + (run.times - run.times[0]) * rate
    whole = np.round(codes)
    return np.where(np.abs(codes - whole) <= WHOLE * np.maximum(1.0, np.abs(whole)), whole, codes).tolist()


def moving(run: Run) -> np.ndarray:
    """(bodies,) bool: whether any vertex of a body ever leaves its place."""
    of_vertex, first = run.topology["body_of_vertex"], run.positions(0)
    found = np.zeros(len(run.body_names), dtype=bool)
    for frame in range(1, run.frame_count):
        found[of_vertex[np.any(run.positions(frame) != first, axis=1)]] = True
        if found.all():
            break
    return found


def motion(run: Run, frame: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Positions (n, 3), m, at start and end of the motion that ends at a frame, at the first of the one that begins there; and its time, s."""
    last = min(max(1, frame), run.frame_count - 1)
    first = max(0, last - 1)
    return run.positions(first), run.positions(last), float(run.times[last] - run.times[first]) or 1.0


# --- normals ---


@dataclass
class Shading:
    """Which corners of a mesh's faces are shaded as one. corners: (c,) vertices of faces, one face after another; counts: (f,) corners of
    each; groups: (c,) which group a corner is of; where it is `corners` itself, each vertex is a group.
    """

    corners: np.ndarray
    counts: np.ndarray
    groups: np.ndarray

    @staticmethod
    def by_edges(points: np.ndarray, triangles: np.ndarray) -> "Shading | None":
        """Corners at a vertex belong together across edges that are not sharp; None where no edge is."""
        corners, counts = triangles.ravel(), np.full(len(triangles), 3)
        normals = _face_normals(points, corners, counts)[1]
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        order = np.lexsort(sides.T)
        same = np.flatnonzero((sides[order][1:] == sides[order][:-1]).all(axis=1))
        a, b = order[same] // 3, order[same + 1] // 3
        sharp = np.einsum("ij,ij->i", normals[a], normals[b]) < np.cos(np.radians(SHARP_EDGE))
        if not sharp.any():
            return None
        pairs = []
        for vertex in sides[order[same]].T:  # the two corners of an edge's two triangles at each of its ends
            place = [3 * face + np.argmax(triangles[face] == vertex[:, None], axis=1) for face in (a, b)]
            pairs.append(np.stack([each[~sharp] for each in place]))
        joined = np.concatenate(pairs, axis=1)
        graph = scipy.sparse.coo_array((np.ones(joined.shape[1]), joined), shape=(len(corners), len(corners)))
        return Shading(corners, counts, connected_components(graph, directed=False)[1])

    def normals(self, points: np.ndarray) -> np.ndarray:
        """(g, 3) unit normals of the groups, for vertices at points (n, 3): those of their faces, by area."""
        area = np.repeat(_face_normals(points, self.corners, self.counts)[0], self.counts, axis=0)
        total = np.zeros((max(int(self.groups.max()) + 1, len(points) if self.groups is self.corners else 0), 3))
        np.add.at(total, self.groups, area)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.divide(total, length, out=np.tile([0.0, 0.0, 1.0], (len(total), 1)), where=length > 0.0)


def _face_normals(points: np.ndarray, corners: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(f, 3) normals of polygons, of the length of twice their area, and of length 1."""
    ends = np.cumsum(counts)
    following = np.arange(1, len(corners) + 1)
    following[ends - 1] = ends - counts
    face = np.repeat(np.arange(len(counts)), counts)
    area = np.zeros((len(counts), 3))
    middle = np.zeros((len(counts), 3))
    np.add.at(middle, face, points[corners])
    spokes = points[corners] - (middle / counts[:, None])[face]
    np.add.at(area, face, np.cross(spokes, spokes[following]))
    length = np.linalg.norm(area, axis=1, keepdims=True)
    return area, np.divide(area, length, out=np.zeros_like(area), where=length > 0.0)


# --- a stage of its own ---


def export_usd(run: Run, path: Path, fps: float | None = None) -> Path:
    """One .usd, .usda or .usdc file: a mesh a body below /Run, rods as tubes, y up, metres; points and velocities over time, what never moves once, and
    normals where a body has sharp edges. fps: frames a second of the stage; None: as many as the run has.
    """
    from pxr import Gf, Usd, UsdGeom, Vt

    _usd_name(path)
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rate = fps or rate_of(run)
    codes = time_codes(run, rate)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Run").GetPrim())
    moves, start = moving(run), run.positions(0)
    written = []
    for body, (name, kind) in enumerate(zip(run.body_names, run.body_kinds, strict=True)):
        skin = run.skins[body]
        triangles = skin.triangles
        mesh = UsdGeom.Mesh.Define(stage, f"/Run/{_identifier(name, body)}")
        mesh.GetPrim().SetMetadata("comment", name)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, dtype=np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles.ravel(), dtype=np.int32)))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(kind == "cloth")
        color = OBSTACLE if kind == "obstacle" else PALETTE[body % len(PALETTE)]
        linear = [(int(color[k : k + 2], 16) / 255.0) ** 2.2 for k in (1, 3, 5)]
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*linear)])
        out = _MeshWriter(mesh, Shading.by_edges(skin.points(start), triangles))
        written.append((skin, out))
        if not moves[body]:
            out.write(skin.points(start), None, Usd.TimeCode.Default())
    for frame, code in enumerate(codes):
        positions, (before, after, seconds) = run.positions(frame), motion(run, frame)
        for (skin, out), moved in zip(written, moves, strict=True):
            if moved:
                speeds = (skin.points(after) - skin.points(before)) / seconds
                out.write(skin.points(positions), speeds, Usd.TimeCode(code))
    stage.GetRootLayer().Save()
    return path


class _MeshWriter:
    """Points of a mesh, and what follows from them, at times."""

    def __init__(self, mesh, shading: Shading | None):
        from pxr import Sdf, UsdGeom, Vt

        self.mesh, self.shading, self.normals = mesh, shading, None
        if shading is not None:
            primvars = UsdGeom.PrimvarsAPI(mesh.GetPrim())
            self.normals = primvars.CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying)
            self.normals.SetIndices(Vt.IntArray.FromNumpy(shading.groups.astype(np.int32)))

    def write(self, points: np.ndarray, speeds: np.ndarray | None, time) -> None:
        single = _vectors(points)
        self.mesh.CreatePointsAttr().Set(single, time)
        self.mesh.CreateExtentAttr().Set(_vectors(np.array([points.min(axis=0), points.max(axis=0)])), time)
        if speeds is not None:
            self.mesh.CreateVelocitiesAttr().Set(_vectors(speeds), time)
        if self.shading is not None and self.normals is not None:
            self.normals.Set(_vectors(self.shading.normals(points)), time)


def _vectors(values: np.ndarray):
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _usd_name(path: Path) -> None:
    if path.suffix.lower() not in WRITTEN:
        raise ValueError(f'"{path}": a USD file that is written ends in one of: {", ".join(WRITTEN)}')


def _identifier(name: str, body: int) -> str:
    """A USD name: letters, digits and _; the body's number keeps names apart."""
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in f"b{body}_{name}")


# --- over the stage that the scene came from ---


def export_stage(run: Run, path: Path) -> Path:
    """A layer over the USD stage that the scene's meshes came from: the same prims, unit, axes, rate and start, with points that go as
    the run did. What the run does not move, and all else of the stage, such as UVs and materials, stays as it is.

    Raises RunError where the scene's moving bodies are no prims of one stage, or have other vertices than these.
    """
    from pxr import Sdf, Usd, UsdGeom

    _usd_name(path)
    moves = moving(run)
    tables = [table for table in (*run.scene["bodies"], *run.scene.get("obstacles", []))]
    found: dict[str, list[tuple[int, dict[str, Any], str | None]]] = {}
    for table in tables:
        bodies = [k for k, name in enumerate(run.body_names) if name == table["name"] or name.startswith(f"{table['name']}[")]
        if not any(moves[k] for k in bodies):
            continue
        source = table["mesh"]
        file, prim = split_prim(Path(source)) if isinstance(source, str) else (Path(), None)
        if file.suffix.lower() not in USD_SUFFIXES:
            raise RunError(f'"{table["name"]}" is no prim of a USD stage; export it as usd, which writes a stage of its own')
        if len(bodies) != 1 or table.get("copies"):
            raise RunError(f'"{table["name"]}" has {len(bodies)} copies, and the stage has one prim for them; export it as usd')
        found.setdefault(str(file), []).append((bodies[0], table, prim))
    if len(found) != 1:
        raise RunError(f"what moves comes from {len(found)} USD stages; needed: one")
    ((file, bodies),) = found.items()
    original = Usd.Stage.Open(file)
    if path.resolve() == Path(file).resolve():
        raise RunError(f"{path} is the stage itself; name another file")
    path.unlink(missing_ok=True)
    layer = Sdf.Layer.CreateNew(str(path))
    layer.subLayerPaths.append(os.path.relpath(file, path.resolve().parent).replace(os.sep, "/"))
    stage = Usd.Stage.Open(layer)
    if original.HasAuthoredMetadata(UsdGeom.Tokens.upAxis):  # of a stage's metadata, only its own layer's counts
        UsdGeom.SetStageUpAxis(stage, UsdGeom.GetStageUpAxis(original))
    if UsdGeom.StageHasAuthoredMetersPerUnit(original):
        UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.GetStageMetersPerUnit(original))
    rate = original.GetTimeCodesPerSecond()
    codes = time_codes(run, rate, begin := usd_start(original))
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(original.GetFramesPerSecond())
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(max(codes[-1], original.GetEndTimeCode()))
    if original.HasDefaultPrim():
        stage.SetDefaultPrim(stage.GetPrimAtPath(original.GetDefaultPrim().GetPath()))
    start = run.positions(0)
    prims = [
        each for body, table, below in bodies for each in _prims_of(stage, original, run, start, body, table, below, begin)
    ]
    for frame, code in enumerate(codes):
        positions, (before, after, seconds) = run.positions(frame), motion(run, frame)
        last = min(max(1, frame), len(codes) - 1)
        for prim in prims:
            prim.write(positions, code, [(before, codes[max(0, last - 1)]), (after, codes[last])], seconds)
    layer.Save()
    return path


class _Prim:
    """A mesh prim of the stage, and which vertices of the run its points are. points (p, 4) and weights (p, 4): of each point."""

    def __init__(self, stage, prim, begin: float, points: np.ndarray, weights: np.ndarray):
        from pxr import UsdGeom

        self.mesh, self.points, self.weights = UsdGeom.PointBased(prim), points, weights
        self.unit = UsdGeom.GetStageMetersPerUnit(stage) if UsdGeom.StageHasAuthoredMetersPerUnit(stage) else 1.0
        self.upright = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
        self.shading = _authored_shading(prim, begin)
        # by the prim's own orientation, as its faces are; a mirror turns faces and normals alike
        self.outward = -1.0 if UsdGeom.Gprim(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded else 1.0

    def write(self, positions: np.ndarray, code: float, ends: list[tuple[np.ndarray, float]], seconds: float) -> None:
        """ends: positions (n, 3), m, and time codes of the two ends of a motion, which takes so many seconds: what velocities are made of. They
        are those of points within the prim, which may move itself.
        """
        from pxr import Usd

        time = Usd.TimeCode(code)
        local = self._local(positions, code)
        before, after = (self._local(*end) for end in ends)
        self.mesh.GetPointsAttr().Set(_vectors(local), time)
        self.mesh.CreateVelocitiesAttr().Set(_vectors((after - before) / seconds), time)
        self.mesh.CreateExtentAttr().Set(_vectors(np.array([local.min(axis=0), local.max(axis=0)])), time)
        if self.shading is not None:
            attribute, shading, rows = self.shading
            normals = shading.normals(local) * self.outward
            attribute.Set(_vectors(normals if rows is None else normals[rows]), time)

    def _local(self, positions: np.ndarray, code: float) -> np.ndarray:
        """(p, 3) in the prim's own coordinates at a time."""
        from pxr import Usd, UsdGeom

        matrix = np.array(UsdGeom.XformCache(Usd.TimeCode(code)).GetLocalToWorldTransform(self.mesh.GetPrim()))  # p' = p M
        return (self._to_stage(positions) - matrix[3, :3]) @ np.linalg.inv(matrix[:3, :3])

    def _to_stage(self, values: np.ndarray) -> np.ndarray:
        """(p, 3) in the stage's unit and axes, of values at the run's vertices."""
        bound = np.einsum("pk,pkd->pd", self.weights, values[self.points]) / self.unit
        return bound if self.upright else np.column_stack([bound[:, 0], -bound[:, 2], bound[:, 1]])


def _authored_shading(prim, begin: float) -> "tuple[Any, Shading, np.ndarray | None] | None":
    """The attribute that has a mesh's normals, which corners share one, and of which group each of its values is (None: one of each, in
    order); None where it has none. Normals of another kind than by corner, vertex or face are blocked: they would be wrong.
    """
    from pxr import Usd, UsdGeom

    mesh, first = UsdGeom.Mesh(prim), Usd.TimeCode(begin)
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        attribute, how, values = primvar.GetAttr(), primvar.GetInterpolation(), np.array(primvar.ComputeFlattened(first))
        if primvar.IsIndexed():  # faces that shared a normal may not for long
            primvar.BlockIndices()
    else:
        attribute, how = mesh.GetNormalsAttr(), mesh.GetNormalsInterpolation()
        values = np.array(attribute.Get(first)) if attribute and attribute.HasValue() else None
    if values is None or not prim.IsA(UsdGeom.Mesh):
        return None
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(first), dtype=np.int64)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(first), dtype=np.int64)
    if how in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying):
        return attribute, Shading(corners, counts, corners), None
    if how == UsdGeom.Tokens.uniform:
        return attribute, Shading(corners, counts, np.repeat(np.arange(len(counts)), counts)), None
    if how != UsdGeom.Tokens.faceVarying or len(values) != len(corners):
        attribute.Block()
        return None
    groups, count = np.full(len(corners), -1), 0
    order = np.argsort(corners, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(corners[order])) + 1):
        alike = values[own] @ values[own].T > SAME_NORMAL
        label = connected_components(scipy.sparse.csr_matrix(alike.astype(np.int8)), directed=False)[1]
        groups[own], count = count + label, count + label.max() + 1
    return attribute, Shading(corners, counts, groups), groups


def _prims_of(
    stage, original, run: Run, start: np.ndarray, body: int, table: dict[str, Any], below: str | None, begin: float
) -> list[_Prim]:
    """The mesh prims that a body was read from at the time code `begin`, each bound to the body's vertices. What is in an instance is made none in the
    layer, since it has points of its own now.
    """
    from pxr import Usd, UsdGeom

    first, prims = Usd.TimeCode(begin), []
    scale = np.broadcast_to(table.get("scale", 1.0), 3)
    place = rotation_matrix(table.get("rotation", (0.0, 0.0, 0.0))) * scale
    own = np.flatnonzero(run.topology["body_of_vertex"] == body)
    tets = run.tets[run.topology["body_of_vertex"][run.tets[:, 0]] == body] if len(run.tets) else run.tets
    size = float(np.linalg.norm(np.ptp(start[own], axis=0)))
    for path in [prim.GetPath() for prim in _own_meshes(stage, below, first)]:
        while (prim := stage.GetPrimAtPath(path)).IsInstanceProxy():
            _outermost_instance(prim).SetInstanceable(False)
        matrix = np.array(UsdGeom.XformCache(first).GetLocalToWorldTransform(prim))
        points = np.array(prim.GetAttribute("points").Get(first), dtype=np.float64) @ matrix[:3, :3] + matrix[3, :3]
        unit = UsdGeom.GetStageMetersPerUnit(original) if UsdGeom.StageHasAuthoredMetersPerUnit(original) else 1.0
        upright = UsdGeom.GetStageUpAxis(original) == UsdGeom.Tokens.y
        points = points * unit if upright else points[:, [0, 2, 1]] * [unit, unit, -unit]
        points = points @ place.T + table.get("translation", (0.0, 0.0, 0.0))
        prims.append(_Prim(original, prim, begin, *_bind(points, start, own, tets, size, prim, table["name"])))
    return prims


def _own_meshes(stage, below: str | None, first) -> list:
    return usd_meshes(stage.GetPseudoRoot() if below is None else stage.GetPrimAtPath(below), first)[0]


def _outermost_instance(prim):
    while not prim.IsInstance() or prim.IsInstanceProxy():
        prim = prim.GetParent()
    return prim


def _bind(
    points: np.ndarray, start: np.ndarray, own: np.ndarray, tets: np.ndarray, size: float, prim: Any, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (p, 4) and weights (p, 4) of points: the vertex at their place, else where they are in the tets."""
    from pxr import Usd

    distance, nearest = cKDTree(start[own]).query(points)
    vertices, weights = np.repeat(own[nearest][:, None], 4, axis=1), np.zeros((len(points), 4))
    weights[:, 0] = 1.0
    loose = np.flatnonzero(distance > SAME_PLACE * size)
    if not len(loose):
        return vertices, weights
    used = prim.GetAttribute("faceVertexIndices").Get(Usd.TimeCode.EarliestTime())
    if not len(tets):
        loose = np.intersect1d(loose, np.array(used)) if used else loose  # a point of no face was left out of the simulation
        if len(loose):
            raise RunError(f'point {loose[0]} of {prim.GetPath()} is no vertex of "{name}" at the start; export the run as usd')
        return vertices, weights
    corners = start[tets]
    _, near = cKDTree(corners.mean(axis=1)).query(points[loose], k=min(NEIGHBOURS, len(tets)))
    near = near.reshape(len(loose), -1)
    edges = np.swapaxes(corners[near][:, :, 1:] - corners[near][:, :, :1], 2, 3)
    inner = np.linalg.solve(edges, (points[loose][:, None] - corners[near][:, :, 0])[..., None])[..., 0]
    part = np.concatenate([1.0 - inner.sum(axis=2, keepdims=True), inner], axis=2)
    best = np.argmax(part.min(axis=2), axis=1)
    rows = np.arange(len(loose))
    vertices[loose], weights[loose] = tets[near[rows, best]], part[rows, best]
    return vertices, weights
