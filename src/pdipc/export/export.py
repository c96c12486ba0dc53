"""The frames of a run for other programs: USD, point caches, PLY, OBJ, VTK."""

from pathlib import Path

import numpy as np

from pdipc.export import point_cache, usd
from pdipc.export.paraview import export_paraview
from pdipc.output.results import Run, RunError

FORMATS = ("usd", "stage", "mdd", "pc2", "ply", "obj", "vtk", "paraview")


class Excerpt(Run):
    """Every so many frames of a run, and of its bodies only those of the given names, with their copies; all where None.

    whole: the run; taken: the frames; vertices: (k,) its vertices.
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
        self.whole, self.taken = run, list(range(run.frame_count))[::every]
        self.vertices = np.flatnonzero(np.array(kept)[of_vertex])
        number = np.full(len(of_vertex), -1, dtype=np.int32)
        number[self.vertices] = np.arange(len(self.vertices))

        def own(elements: np.ndarray) -> np.ndarray:
            return number[elements[np.array(kept)[of_vertex[elements[:, 0]]]]].reshape(-1, elements.shape[1])

        self.folder, self.meta, self.scene, self.records = run.folder, run.meta, run.scene, run.records[::every]
        self.topology = {
            "triangles": own(run.triangles),
            "tets": own(run.tets),
            "body_of_vertex": (np.cumsum(kept) - 1)[of_vertex[self.vertices]],
            "scripted": run.scripted[self.vertices],
            "body_names": run.topology["body_names"][kept],
            "body_kinds": run.topology["body_kinds"][kept],
            "body_radii": run.topology["body_radii"][kept],
        }

    def positions(self, frame: int) -> np.ndarray:
        """(k, 3) m, of the vertices that the excerpt has."""
        return self.whole.positions(self.taken[frame])[self.vertices]


def export(run: Run, to: str, path: str | Path, fps: float | None = None) -> Path:
    """Writes all frames of `run` in the format `to` and returns where: see the function of each format.

    fps: frames a second of the file, for usd. Raises RunError for a run without frames, ValueError for an unknown format or suffix,
    or a rate that the format does not have.
    """
    if to not in FORMATS:
        raise ValueError(f'"{to}" is no export format; there are: {", ".join(FORMATS)}')
    if run.frame_count == 0:
        raise RunError(f"{run.folder} has no frames")
    if fps is not None and to != "usd":
        raise ValueError(f"frames a second can be chosen for usd, not for {to}")
    path = Path(path)
    (path.parent if to in ("usd", "stage", "paraview") else path).mkdir(parents=True, exist_ok=True)
    if to == "usd":
        return usd.export_usd(run, path, fps)
    writers = {
        "stage": usd.export_stage,
        "mdd": point_cache.export_mdd,
        "pc2": point_cache.export_pc2,
        "ply": export_ply,
        "obj": export_obj,
        "vtk": export_vtk,
        "paraview": export_paraview,
    }
    return writers[to](run, path)


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
    from trimesh.exchange.ply import export_ply as written

    drawn = _Surfaces(run)
    for frame in range(run.frame_count):
        mesh = trimesh.Trimesh(drawn.points(run.positions(frame)), drawn.triangles, process=False)
        mesh.face_attributes["body"] = drawn.body.astype(np.int32)
        data = written(mesh, vertex_normal=False, include_attributes=True)
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
    elements: list = [(kind, vertices) for kind, vertices, _ in drawn]
    bodies: list = [body for _, _, body in drawn]
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">', "<Collection>"]
    for frame in range(run.frame_count):
        name = f"frame_{frame:06d}.vtu"
        meshio.Mesh(run.positions(frame), elements, cell_data={"body": bodies}).write(folder / name)
        lines.append(f'<DataSet timestep="{float(run.times[frame])!r}" part="0" file="{name}"/>')
    (folder / "run.pvd").write_text("\n".join([*lines, "</Collection>", "</VTKFile>", ""]))
    return folder / "run.pvd"
