"""Meshes: reading them from files, and the few facts about them that the rest of the package needs."""

import contextlib
import importlib.util
import io
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pdipc.scene.errors import SceneError

TET_SUFFIXES = (".msh", ".vtk", ".vtu", ".mesh", ".node", ".ele")
TRIANGLE_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")
SUFFIXES = (*TET_SUFFIXES, *TRIANGLE_SUFFIXES, ".npz", ".usd", ".usda", ".usdc")
TET_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])  # outward for a tet of positive volume


def _no_tets() -> np.ndarray:
    return np.zeros((0, 4), dtype=np.int32)


@dataclass
class Mesh:
    """A tetrahedral mesh, or a triangle mesh.

    vertices: (n, 3) float64, m. triangles: (m, 3) int32, the boundary of the tets where there are any, outward.
    tets: (t, 4) int32, of positive volume: (v1 - v0) x (v2 - v0) . (v3 - v0) > 0.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    tets: np.ndarray = field(default_factory=_no_tets)

    def surface(self) -> "Mesh":
        """The triangles alone, with only the vertices that they use."""
        used, triangles = np.unique(self.triangles, return_inverse=True)
        return Mesh(self.vertices[used], triangles.reshape(-1, 3).astype(np.int32))

    @staticmethod
    def of_tets(vertices: np.ndarray, tets: np.ndarray) -> "Mesh":
        """A tetrahedral mesh with its boundary; vertices that no tet uses are dropped."""
        used, tets = np.unique(tets, return_inverse=True)
        tets = tets.reshape(-1, 4).astype(np.int32)
        return Mesh(np.asarray(vertices, dtype=np.float64)[used], boundary(tets), tets)


def boundary(tets: np.ndarray) -> np.ndarray:
    """The (m, 3) triangles that belong to one tet only, outward for tets of positive volume."""
    faces = tets[:, TET_FACES].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[counts == 1])].astype(np.int32)


def tet_volumes(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """(t,) signed volumes, m^3."""
    a, b, c, d = np.moveaxis(vertices[tets], 1, 0)
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0


def triangle_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m,) areas, m^2."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def center_of_mass(mesh: Mesh) -> np.ndarray:
    """Centroid of the tets, else of the triangles, of uniform density, m."""
    elements = mesh.tets if len(mesh.tets) else mesh.triangles
    weights = np.abs((tet_volumes if len(mesh.tets) else triangle_areas)(mesh.vertices, elements))
    centers = mesh.vertices[elements].mean(axis=1)
    return np.average(centers, axis=0, weights=weights) if weights.sum() > 0 else centers.mean(axis=0)


def locate(name: str) -> Path:
    """The file that a scene's mesh name means: a path, or `warp:FILE` for one of the assets that come with Warp."""
    if not name.startswith("warp:"):
        return Path(name)
    spec = importlib.util.find_spec("warp")
    if spec is None or spec.origin is None:
        raise SceneError(f'mesh "{name}": Warp is not installed, so its assets are not there')
    return Path(spec.origin).parent / "examples" / "assets" / name.removeprefix("warp:")


def read(name: str | Path) -> Mesh:
    """Reads a mesh file; see `SUFFIXES` for the formats.

    Raises SceneError where the file is missing, has another format, cannot be read, or holds neither triangles nor tets.
    """
    path = locate(str(name))
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise SceneError(f'mesh file "{path}": the format "{suffix}" is not known; allowed: {" ".join(SUFFIXES)}')
    if not path.is_file():
        raise SceneError(f'mesh file "{path}": there is no such file')
    try:
        if suffix == ".npz":
            vertices, tets, triangles = _read_npz(path)
        elif suffix in (".node", ".ele"):
            vertices, tets, triangles = _read_tetgen(path)
        elif suffix.startswith(".usd"):
            vertices, tets, triangles = _read_usd(path)
        elif suffix in TET_SUFFIXES:
            vertices, tets, triangles = _read_meshio(path)
        else:
            vertices, tets, triangles = _read_trimesh(path)
    except SceneError:
        raise
    except Exception as error:
        raise SceneError(f'mesh file "{path}": cannot be read as {suffix}: {error}') from error
    return from_arrays(vertices, tets, triangles, f'mesh file "{path}"')


def from_arrays(
    vertices: np.ndarray, tets: np.ndarray | None, triangles: np.ndarray | None, where: str, drop_unused: bool = True
) -> Mesh:
    """A mesh from V (n, 3), T (t, 4) and F (m, 3); where there are tets, their boundary takes the place of F.

    A whole mesh of negative tets is an orientation convention and is turned; mixed signs are left for the check to report.
    """
    try:
        vertices = np.array(vertices, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{where}: vertices must be numbers: {error}") from error
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise SceneError(f"{where}: vertices have the shape {vertices.shape}; they must be (n, 3) with n > 0")
    kind, elements, width = ("tets", tets, 4) if tets is not None and len(tets) else ("triangles", triangles, 3)
    elements = np.zeros((0, width)) if elements is None else np.asarray(elements)
    if len(elements) == 0:
        raise SceneError(f"{where}: holds neither triangles nor tetrahedra")
    if elements.ndim != 2 or elements.shape[1] != width:
        raise SceneError(f"{where}: {kind} have the shape {elements.shape}; they must be (m, {width})")
    if elements.dtype.kind not in "iuf" or not np.all(elements == np.floor(elements)):
        raise SceneError(f"{where}: {kind} must be whole numbers")
    elements = elements.astype(np.int64)
    if elements.min() < 0 or elements.max() >= len(vertices):
        row = int(np.flatnonzero(((elements < 0) | (elements >= len(vertices))).any(axis=1))[0])
        raise SceneError(
            f"{where}: {kind}[{row}] = {elements[row].tolist()} is out of range; indices must be 0 to {len(vertices) - 1}"
        )
    elements = elements.astype(np.int32)
    if kind == "triangles":
        mesh = Mesh(vertices, elements)
        return mesh.surface() if drop_unused else mesh
    if np.all(tet_volumes(vertices, elements) < 0):
        elements = elements[:, [0, 2, 1, 3]]
    return Mesh.of_tets(vertices, elements) if drop_unused else Mesh(vertices, boundary(elements), elements)


def _read_npz(path: Path):
    with np.load(path) as data:
        if "V" not in data:
            raise SceneError(f'mesh file "{path}": holds {list(data)}; needed: V and T (tets) or F (triangles)')
        return data["V"], data.get("T"), data.get("F")


def _read_meshio(path: Path):
    import meshio

    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
    except SystemExit as error:  # meshio prints what is wrong and ends the process on some files
        raise ValueError(" ".join(said.getvalue().split())) from error
    cells = mesh.cells_dict
    if not {"tetra", "triangle"} & set(cells):
        raise SceneError(
            f'mesh file "{path}": holds cells of the kinds {", ".join(cells) or "none"}; needed: tetra (of four vertices) or triangle'
        )
    return _three(mesh.points), cells.get("tetra"), cells.get("triangle")


def _three(points: np.ndarray) -> np.ndarray:
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _read_trimesh(path: Path):
    import trimesh

    # merge_norm and merge_tex: a mesh cut along seams of its normals or textures is one surface here
    mesh = trimesh.load(path, force="mesh", process=False)
    if len(mesh.faces) == 0:
        raise SceneError(f'mesh file "{path}": holds no triangles')
    if np.isfinite(mesh.vertices).all() and mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices):
        mesh.merge_vertices(merge_norm=True, merge_tex=True)
    return mesh.vertices, None, mesh.faces


def _read_tetgen(path: Path):
    def rows(file: Path) -> np.ndarray:
        if not file.is_file():
            raise SceneError(f'mesh file "{path}": needs "{file.name}" beside it')
        lines = [line.split("#")[0].split() for line in file.read_text().splitlines()]
        lines = [line for line in lines if line]
        count = int(lines[0][0])
        if len(lines) <= count:
            raise SceneError(f'mesh file "{file}": its first line says {count} rows, and {len(lines) - 1} are there')
        return np.array([[float(x) for x in line] for line in lines[1 : count + 1]])

    nodes, elements = rows(path.with_suffix(".node")), rows(path.with_suffix(".ele"))
    return nodes[:, 1:4], elements[:, 1:5] - nodes[0, 0], None


def _read_usd(path: Path):
    try:
        from pxr import Usd
    except ImportError as error:
        raise SceneError(f'mesh file "{path}": reading USD needs the extra: pip install "pdipc[usd]"') from error
    stage = Usd.Stage.Open(str(path))  # its prims live no longer than it does
    for prim in stage.Traverse():
        if prim.GetTypeName() != "Mesh":
            continue
        points = np.array(prim.GetAttribute("points").Get(), dtype=np.float64)
        tets = prim.GetAttribute("tetraIndices")
        if tets and tets.HasValue():
            return points, np.array(tets.Get()).reshape(-1, 4), None
        counts = np.array(prim.GetAttribute("faceVertexCounts").Get())
        corners = np.array(prim.GetAttribute("faceVertexIndices").Get())
        first = np.cumsum(counts) - counts
        fans = [first[counts > k + 1, None] + np.array([0, k, k + 1]) for k in range(1, int(counts.max()) - 1)]
        return points, None, corners[np.concatenate(fans)]
    raise SceneError(f'mesh file "{path}": holds no Mesh')


def tetrahedralize(mesh: Mesh, where: str) -> Mesh:
    """Fills a closed surface with tets (fTetWild; the surface is approximated within 1e-3 of its bounding box).

    Raises SceneError where pytetwild is not installed or makes no tets.
    """
    try:
        import pytetwild
    except ImportError as error:
        raise SceneError(
            f'{where}: "tetrahedralize" needs the extra: pip install "pdipc[tetrahedralize]"; or give a tetrahedral mesh'
        ) from error
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # it leaves a file where it works
        vertices, tets = pytetwild.tetrahedralize(mesh.vertices, mesh.triangles, optimize=True)[:2]  # pyright: ignore
    if len(tets) == 0:
        sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        rim = int(np.count_nonzero(np.unique(sides, axis=0, return_counts=True)[1] == 1))
        raise SceneError(
            f'{where}: "tetrahedralize" found no inside to fill; the surface must be closed, and {rim} of its edges belong to one '
            "triangle only"
        )
    return from_arrays(vertices, tets, None, f"{where}, tetrahedralized")
