"""The frames of a run for other programs: USD, PLY, OBJ, VTK."""

from pathlib import Path

import numpy as np

from pdipc.output.render import OBSTACLE, PALETTE
from pdipc.output.results import Run, RunError

FORMATS = ("usd", "ply", "obj", "vtk")
USD_SUFFIXES = (".usd", ".usda", ".usdc")


class Excerpt(Run):
    """Every so many frames of a run, and of its bodies only those of the given names, with their copies; all where None.

    Raises RunError for a name that the run does not have.
    """

    def __init__(self, run: Run, every: int = 1, bodies: list[str] | None = None):
        base = [name.partition("[")[0] if name.endswith("]") else name for name in run.body_names]
        if unknown := set(bodies or []) - {*run.body_names, *base}:
            raise RunError(
                f'{run.folder} has no body "{sorted(unknown)[0]}"; it has: {", ".join(dict.fromkeys(run.body_names))}'
            )
        kept = [bodies is None or bool({name, short} & set(bodies)) for name, short in zip(run.body_names, base, strict=True)]
        of_vertex = run.topology["body_of_vertex"]
        self._run, self._every = run, every
        self._vertices = np.flatnonzero(np.array(kept)[of_vertex])
        number = np.full(len(of_vertex), -1, dtype=np.int32)
        number[self._vertices] = np.arange(len(self._vertices))

        def own(elements: np.ndarray) -> np.ndarray:
            return number[elements[np.array(kept)[of_vertex[elements[:, 0]]]]].reshape(-1, elements.shape[1])

        self.folder, self.meta, self.scene, self.records = run.folder, run.meta, run.scene, run.records[::every]
        self.topology = {
            "triangles": own(run.triangles),
            "tets": own(run.tets),
            "body_of_vertex": (np.cumsum(kept) - 1)[of_vertex[self._vertices]],
            "scripted": run.scripted[self._vertices],
            "body_names": run.topology["body_names"][kept],
            "body_kinds": run.topology["body_kinds"][kept],
            "body_radii": run.topology["body_radii"][kept],
        }

    def positions(self, frame: int) -> np.ndarray:
        """(k, 3) m, of the vertices that the excerpt has."""
        return self._run.positions(range(self._run.frame_count)[:: self._every][frame])[self._vertices]


def export(run: Run, to: str, path: str | Path) -> Path:
    """Writes all frames of `run` in the format `to` and returns where: see the function of each format.

    Raises RunError for a run without frames, ValueError for an unknown format or suffix.
    """
    if to not in FORMATS:
        raise ValueError(f'"{to}" is no export format; there are: {", ".join(FORMATS)}')
    if run.frame_count == 0:
        raise RunError(f"{run.folder} has no frames")
    path = Path(path)
    (path.parent if to == "usd" else path).mkdir(parents=True, exist_ok=True)
    return {"usd": export_usd, "ply": export_ply, "obj": export_obj, "vtk": export_vtk}[to](run, path)


class _Surfaces:
    """All vertices of a run, then the tubes of its rods. triangles: (m, 3) of these points; body: (m,) which each belongs to."""

    def __init__(self, run: Run):
        is_rod = np.array(run.body_kinds) == "rod"
        first, triangles, body = len(run.topology["body_of_vertex"]), [run.triangles[~is_rod[run.body_of_triangle]]], []
        body.append(run.body_of_triangle[~is_rod[run.body_of_triangle]])
        self.tubes = [run.skins[rod] for rod in np.flatnonzero(is_rod)]
        for rod, tube in zip(np.flatnonzero(is_rod), self.tubes, strict=True):
            triangles.append(tube.triangles + first)
            body.append(np.full(len(tube.triangles), rod))
            first += len(tube.sources)
        self.triangles, self.body = np.concatenate(triangles), np.concatenate(body)

    def points(self, positions: np.ndarray) -> np.ndarray:
        """(p, 3) m."""
        return np.concatenate([positions, *(tube.points(positions) for tube in self.tubes)])


def export_ply(run: Run, folder: Path) -> Path:
    """frame_000000.ply, ...: the surfaces, binary, in float64, each triangle with its body's number; rods as tubes, after all vertices."""
    import trimesh

    drawn = _Surfaces(run)
    for frame in range(run.frame_count):
        mesh = trimesh.Trimesh(drawn.points(run.positions(frame)), drawn.triangles, process=False)
        mesh.face_attributes["body"] = drawn.body.astype(np.int32)
        data = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False, include_attributes=True)
        (folder / f"frame_{frame:06d}.ply").write_bytes(data)
    return folder


def export_obj(run: Run, folder: Path) -> Path:
    """frame_000000.obj, ...: the surfaces, an object a body, with digits that give the same float64 back; rods as tubes."""
    faces, drawn = [], _Surfaces(run)
    for body, name in enumerate(run.body_names):
        corners = drawn.triangles[drawn.body == body] + 1
        faces.append(f"o {name}\n" + "".join(f"f {a} {b} {c}\n" for a, b, c in corners.tolist()))
    for frame in range(run.frame_count):
        vertices = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in drawn.points(run.positions(frame)).tolist())
        (folder / f"frame_{frame:06d}.obj").write_text(vertices + "".join(faces))
    return folder


def export_vtk(run: Run, folder: Path) -> Path:
    """run.pvd, with all times, and frame_000000.vtu, ...: the mesh of run.vtkhdf, for programs that do not read that."""
    import meshio

    from pdipc.output.vtkhdf import cells

    drawn = cells(run.topology)
    elements = [(kind, vertices) for kind, vertices, _ in drawn]
    bodies = [body for _, _, body in drawn]
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">', "<Collection>"]
    for frame in range(run.frame_count):
        name = f"frame_{frame:06d}.vtu"
        meshio.Mesh(run.positions(frame), elements, cell_data={"body": bodies}).write(folder / name)
        lines.append(f'<DataSet timestep="{float(run.times[frame])!r}" part="0" file="{name}"/>')
    (folder / "run.pvd").write_text("\n".join([*lines, "</Collection>", "</VTKFile>", ""]))
    return folder / "run.pvd"


def export_usd(run: Run, path: Path) -> Path:
    """One .usd, .usda or .usdc file: a mesh a body below /Run, rods as tubes, points over time in seconds, y up, metres."""
    from pxr import Gf, Usd, UsdGeom, Vt

    if path.suffix.lower() not in USD_SUFFIXES:
        raise ValueError(f'"{path}": a USD file ends in one of: {", ".join(USD_SUFFIXES)}')
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rate = (run.frame_count - 1) / float(run.times[-1]) if run.frame_count > 1 else 24.0
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(run.frame_count - 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Run").GetPrim())
    meshes = []
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
        meshes.append((skin, mesh.CreatePointsAttr(), mesh.CreateExtentAttr()))
    for frame in range(run.frame_count):
        positions = run.positions(frame)
        for skin, points, extent in meshes:
            own = np.ascontiguousarray(skin.points(positions).astype(np.float32))
            points.Set(Vt.Vec3fArray.FromNumpy(own), frame)
            extent.Set(Vt.Vec3fArray.FromNumpy(np.array([own.min(axis=0), own.max(axis=0)])), frame)
    stage.GetRootLayer().Save()
    return path


def _identifier(name: str, body: int) -> str:
    """A USD name: letters, digits and _; the body's number keeps names apart."""
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in f"b{body}_{name}")
