"""Meshes: reading them from files, and the few facts about them that the rest of the package needs."""

import contextlib
import importlib.util
import itertools
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.scene import files
from pdipc.scene.cells import CELL_FACES, MOST_CORNERS, tetrahedra, triangulate
from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import CORNERS, Contents, lines_left_out
from pdipc.scene.memory import free_memory, gib
from pdipc.scene.worker import Worker, failed

TET_SUFFIXES = (".msh", ".vtk", ".vtu", ".mesh", ".node", ".ele")
TRIANGLE_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".vtp", ".glb")
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SUFFIXES = (*TET_SUFFIXES, *TRIANGLE_SUFFIXES, ".npz", *USD_SUFFIXES, ".abc")
BYTES_PER_BYTE = 2  # of memory for a mesh file, at least: the file itself and its numbers
FLAT = 1e-9  # a tet or triangle of less than this part of its longest edge^3 or ^2 has no rest shape to speak of
TET_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])  # outward for a tet of positive volume


def _no_tets() -> np.ndarray:
    return np.zeros((0, 4), dtype=np.int32)


def _no_lines() -> np.ndarray:
    return np.zeros((0, 2), dtype=np.int32)


@dataclass
class Mesh:
    """A tetrahedral mesh, a triangle mesh, or the lines of a rod.

    vertices: (n, 3) float64, m. triangles: (m, 3) int32, the boundary of the tets where there are any, outward.
    tets: (t, 4) int32, of positive volume: (v1 - v0) x (v2 - v0) . (v3 - v0) > 0.
    lines: (s, 2) int32, of a rod, and joints: (j, 2) int32, lines that follow each other. notes: what was left out of the file, or converted, a sentence each.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    tets: np.ndarray = field(default_factory=_no_tets)
    notes: list[str] = field(default_factory=list)
    lines: np.ndarray = field(default_factory=_no_lines)
    joints: np.ndarray = field(default_factory=_no_lines)

    @staticmethod
    def of_lines(vertices: np.ndarray, lines: np.ndarray, notes: list[str] | None = None) -> "Mesh":
        """Lines (s, 2) alone."""
        none = np.zeros((0, 3), dtype=np.int32)
        return Mesh(np.asarray(vertices, dtype=np.float64), none, notes=notes or [], lines=np.asarray(lines, dtype=np.int32))

    def surface(self) -> "Mesh":
        """The triangles alone, with only the vertices that they use."""
        used, triangles = np.unique(self.triangles, return_inverse=True)
        return Mesh(self.vertices[used], triangles.reshape(-1, 3).astype(np.int32), notes=self.notes)

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


def longest_edges(vertices: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """(m,) lengths of the longest edge of each of elements (m, k), m."""
    corners = vertices[elements]
    return np.linalg.norm(corners[:, :, None] - corners[:, None], axis=-1).max(axis=(1, 2))


def flat_triangles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m,) bool: which triangles have no area to speak of."""
    size = np.abs(vertices).max(initial=0.0)
    if not 1e-100 < size < 1e100 and 0.0 < size < np.inf:  # whose squares would overflow, or vanish
        vertices = vertices / size
    return triangle_areas(vertices, triangles) <= FLAT * longest_edges(vertices, triangles) ** 2


def is_closed(triangles: np.ndarray) -> bool:
    """Whether every edge is passed once in each direction."""
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    forward, backward = (np.unique(way, axis=0) for way in (sides, sides[:, ::-1]))
    return len(forward) == len(sides) and np.array_equal(forward, backward)


def without_useless(mesh: Mesh, where: str, frames: Iterable[np.ndarray] = ()) -> Mesh:
    """A surface without the triangles that bound nothing: those without area, and repetitions of others; its notes say so.

    frames: (n, 3) places of the vertices at other times; what has an area at any of them stays. Raises SceneError where nothing does.
    """
    notes, triangles = list(mesh.notes), mesh.triangles
    with np.errstate(over="ignore", invalid="ignore"):
        flat = flat_triangles(mesh.vertices, triangles)
        for frame in itertools.takewhile(lambda _: flat.any(), frames):
            flat[flat] = flat_triangles(frame.astype(np.float64), triangles[flat])
    if flat.any():
        notes.append(f"{np.count_nonzero(flat)} triangles without an area were left out")
        triangles = triangles[~flat]
    if not len(triangles):
        raise SceneError(f"{where}: none of its {len(flat)} triangles has an area")
    once = np.sort(np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1])
    if len(once) < len(triangles):
        notes.append(f"{len(triangles) - len(once)} triangles that were there more than once were left out")
        triangles = triangles[once]
    return Mesh(mesh.vertices, triangles, notes=notes)


def center_of_mass(mesh: Mesh) -> np.ndarray:
    """Centroid of the tets, else of the triangles, else of the lines, of uniform density, m."""
    if len(mesh.lines):
        elements, weights = mesh.lines, longest_edges(mesh.vertices, mesh.lines)
    else:
        elements = mesh.tets if len(mesh.tets) else mesh.triangles
        weights = np.abs((tet_volumes if len(mesh.tets) else triangle_areas)(mesh.vertices, elements))
    centers = mesh.vertices[elements].mean(axis=1)
    return np.average(centers, axis=0, weights=weights) if weights.sum() > 0 else centers.mean(axis=0)


def locate(name: str) -> Path:
    """The file that a scene's mesh name means: a path, or `warp:FILE` for one of the assets that come with Warp; a prim stays behind it."""
    if not name.startswith("warp:"):
        return Path(name)
    spec = importlib.util.find_spec("warp")
    if spec is None or spec.origin is None:
        raise SceneError(f'mesh "{name}": Warp is not installed, so its assets are not there')
    return Path(spec.origin).parent / "examples" / "assets" / name.removeprefix("warp:")


def split_prim(path: Path) -> tuple[Path, str | None]:
    """The file and the prim of a name such as `shot.usda</World/Cloth>`, as USD itself writes them, or the object of an archive; None where it names none."""
    file, bracket, prim = str(path).partition("<")
    return (Path(file), prim[:-1].replace("\\", "/")) if bracket and prim.endswith(">") else (path, None)


def read(name: str | Path, worker: Worker | None = None) -> Mesh:
    """Reads a mesh file; see `SUFFIXES` for the formats. What it leaves out of the file is in the mesh's `notes`.

    worker: reads what other packages parse; None starts one where it is needed.
    Raises SceneError where the file is missing, has another format, cannot be read, or holds neither triangles nor tets.
    """
    path = locate(str(name))
    return guarded(path, lambda: from_contents(contents(path, worker), f'mesh file "{path}"'))


def read_lines(name: str | Path, worker: Worker | None = None) -> Mesh:
    """Reads the lines of a mesh file, for a rod: `l` of OBJ, L of .npz, cells of lines. Raises SceneError as `read` does."""
    path = locate(str(name))

    def lines() -> Mesh:
        found = contents(path, worker)
        cells = [rows[:, :2] for kind, rows in found.cells if kind == "line" and rows.ndim == 2 and rows.shape[1] >= 2]
        where = f'mesh file "{path}"'
        if not sum(map(len, cells)):
            raise SceneError(f"{where}: holds no lines; a rod needs lines between its vertices, such as l of an OBJ file")
        notes, rows = list(found.notes), np.concatenate(cells)
        if len(found.polygons[1]) or any(kind not in ("line", "vertex") and len(other) for kind, other in found.cells):
            notes.append("its faces and cells were left out: a rod takes the lines alone")
        points = np.asarray(found.points, dtype=np.float64)
        if points.ndim == 2 and points.shape[1] < 3:
            points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        return replace(lines_from_arrays(points, rows, where), notes=notes)

    return guarded(path, lines)


def lines_from_arrays(vertices: np.ndarray, lines: np.ndarray, where: str, drop_unused: bool = True) -> Mesh:
    """A rod's mesh from V (n, 3) and L (s, 2). Raises SceneError for indices out of range, and where there are no lines."""
    if not len(lines):
        raise SceneError(f"{where}: holds no lines; a rod needs at least one")
    check_indices(lines, len(vertices), "lines", where)
    if not drop_unused:
        return Mesh.of_lines(vertices, lines)
    used, lines = np.unique(lines, return_inverse=True)
    return Mesh.of_lines(vertices[used.astype(np.int64)], lines.reshape(-1, 2))


def contents(path: Path, worker: Worker | None = None, frames: bool = False) -> Contents:
    """What a mesh file, or a prim of one, holds, before it is cut; frames: with all frames. Raises SceneError as `read` does."""
    path, prim = split_prim(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise SceneError(
            f'mesh file "{_short(path)}": the format "{_short(suffix)}" is not known; allowed: {" ".join(SUFFIXES)}'
        )
    if not is_file(path):
        raise SceneError(f'mesh file "{_short(path)}": there is no such file')
    if prim is not None and suffix not in (*USD_SUFFIXES, ".abc"):
        raise SceneError(f'mesh file "{_short(path)}": has no prim "{prim}"; only USD and Alembic files have named parts')

    def read() -> Contents:
        needed, free = BYTES_PER_BYTE * path.stat().st_size, free_memory()
        if needed > free:
            raise SceneError(f'mesh file "{path}": needs at least {gib(needed)} of memory, and {gib(free)} are free')
        if not files.is_foreign(path):
            return files.parse(path, frames)
        with contextlib.nullcontext(worker) if worker else Worker() as reader:
            return reader.read(path, frames, prim)

    return guarded(path, read)


def guarded(path: Path, reading: Callable[[], Any]) -> Any:
    """What `reading` a file gives. Raises SceneError in place of whatever a damaged file leads to."""
    try:
        return reading()
    except SceneError:
        raise
    except Exception as error:
        raise SceneError(failed(path, error)) from error


def is_file(path: Path) -> bool:
    """Whether there is a file; False also for names that no file can have, and links that go round in circles."""
    try:
        return path.is_file()
    except (OSError, ValueError, RuntimeError):
        return False


def _short(text: object) -> str:
    return str(text) if len(str(text)) <= 300 else f"{str(text)[:300]}..."


def from_contents(contents: Contents, where: str, whole: bool = False) -> Mesh:
    """A mesh of what a file holds: its cells cut into tets, else its polygons cut into triangles, and a note for what is left out.

    whole: with all vertices of the file in their order, as frames have them; else only those that are used, and each place once.
    Raises SceneError where it holds neither.
    """
    notes = list(contents.notes)
    if contents.frames is not None and not whole:
        notes.append(f"it holds {len(contents.frames)} frames: the first was taken")
    points = np.asarray(contents.points, dtype=np.float64)
    if points.ndim == 2 and points.shape[1] < 3:
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))  # what is flat lies in the plane of x and y
    blocks: dict[str, list[np.ndarray]] = {kind: [] for kind in CORNERS}
    higher: dict[str, int] = {}
    for kind, rows in contents.cells:
        if not rows.size:
            continue
        corners = CORNERS[kind]
        if rows.ndim != 2 or rows.shape[1] < corners:
            name = {"tetra": "tets", "triangle": "triangles"}.get(kind, kind)
            raise SceneError(f"{where}: {name} have the shape {rows.shape}; they must be (m, {corners})")
        if rows.shape[1] > corners:
            higher[kind] = higher.get(kind, 0) + len(rows)
        blocks[kind].append(rows[:, :corners])
    if higher:
        listed = ", ".join(f"{count} {kind}" for kind, count in higher.items())
        notes.append(f"cells of higher order were reduced to their corners: {listed}")
    for kind, given in blocks.items():
        for rows in given:
            name = {"tetra": "tets", "triangle": "triangles"}.get(kind, kind)
            check_indices(rows, len(points), name, where)
    cells = {kind: np.concatenate(given).astype(np.int64) for kind, given in blocks.items() if sum(map(len, given))}
    corners, counts = contents.polygons
    if len(corners) and (corners.min() < 0 or corners.max() >= len(points)):
        worst = int(corners[(corners < 0) | (corners >= len(points))][0])
        raise SceneError(f"{where}: a face names vertex {worst}, which is out of range; indices must be 0 to {len(points) - 1}")
    solids = [_tets(points, kind, cells[kind]) for kind in CELL_FACES if kind in cells]
    faces = [(corners, counts)]
    for kind, size in (("triangle", 3), ("quad", 4)):
        if kind in cells:
            faces.append((cells[kind].ravel(), np.full(len(cells[kind]), size)))
    corners, counts = (np.concatenate(parts) for parts in zip(*faces, strict=True))
    lines = np.sort(cells.get("line", np.zeros((0, 2), dtype=np.int64)), axis=1)
    if solids:
        loose = _not_among(_rings(corners, counts), _cell_faces(cells))
        if loose:
            notes.append(f"{loose} faces that bound no cell were left out")
        tets = np.concatenate(solids)
        kept = np.unique(np.sort(tets, axis=1), axis=0, return_index=True)[1]
        if len(kept) < len(tets):
            notes.append(f"{len(tets) - len(kept)} tets that were there twice were left out")
            tets = tets[np.sort(kept)]
        notes += _lines(lines, tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]])
        return replace(from_arrays(points, tets, None, where, drop_unused=not whole), notes=notes)
    small = counts < 3
    if small.any():
        notes.append(f"{np.count_nonzero(small)} faces of fewer than three corners were left out")
        corners, counts = corners[np.repeat(~small, counts)], counts[~small]
    if counts.max(initial=0) > MOST_CORNERS:
        raise SceneError(f"{where}: a face has {counts.max()} corners; at most {MOST_CORNERS} are cut, so give smaller ones")
    triangles, crossed = triangulate(points, corners, counts)
    if crossed:
        notes.append(f"{crossed} polygons cross themselves, so that no way to cut them is right")
    if not len(triangles):
        others = ", ".join(kind for kind in cells) or "none"
        raise SceneError(f"{where}: holds no triangles: cells of the kinds {others}; needed: tetra or other cells, or faces")
    notes += _lines(lines, triangles[:, [[0, 1], [1, 2], [2, 0]]])
    points, merged = (points, None) if whole else _merge(points)
    if merged is not None:
        triangles = merged[triangles]
        if not contents.repeats:
            notes.append(f"{len(merged) - len(points)} vertices that lie exactly on others were merged with them")
    flat = np.any(triangles == triangles[:, [1, 2, 0]], axis=1)
    if flat.any() and not flat.all():
        notes.append(f"{np.count_nonzero(flat)} triangles that have a corner twice were left out")
        triangles = triangles[~flat]
    return replace(from_arrays(points, None, triangles, where, drop_unused=not whole), notes=notes)


def _tets(points: np.ndarray, kind: str, cells: np.ndarray) -> np.ndarray:
    """(t, 4) tets of cells of one kind; a kind whose cells are all turned inside out is another convention, and is turned."""
    tets = tetrahedra(kind, cells)
    with np.errstate(over="ignore", invalid="ignore"):
        turned = len(tets) > 0 and np.all(tet_volumes(points, tets) <= 0)
    return tets[:, [0, 2, 1, 3]] if turned else tets


def _cell_faces(cells: dict[str, np.ndarray]) -> np.ndarray:
    """(f, 4) sorted vertices of the faces of all cells that have a volume; -1 stands before those of a triangle."""
    rings = [
        _rings(cells[kind][:, face].ravel(), np.full(len(cells[kind]), len(face)))
        for kind in CELL_FACES
        if kind in cells
        for face in CELL_FACES[kind]
    ]
    return np.concatenate(rings)


def _rings(corners: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(p, w) sorted vertices of polygons, w at least 4; -1 stands before those of polygons with fewer corners."""
    table = np.full((len(counts), max(4, counts.max(initial=0))), -1, dtype=np.int64)
    first = np.cumsum(counts) - counts
    rows = np.repeat(np.arange(len(counts)), counts)
    table[rows, np.arange(len(corners)) - np.repeat(first, counts)] = corners
    return np.sort(table, axis=1)


def _not_among(rows: np.ndarray, known: np.ndarray) -> int:
    """How many of the rows (p, w) are not among the rows of `known` (q, 4)."""
    if rows.shape[1] > known.shape[1]:
        known = np.pad(known, ((0, 0), (rows.shape[1] - known.shape[1], 0)), constant_values=-1)
    _, number = np.unique(np.concatenate([known, rows]), axis=0, return_inverse=True)
    number = number.ravel()
    return int(np.count_nonzero(~np.isin(number[len(known) :], number[: len(known)])))


def _lines(lines: np.ndarray, edges: np.ndarray) -> list[str]:
    if not len(lines):
        return []
    edges = np.sort(edges.reshape(-1, 2), axis=1)
    _, number = np.unique(np.concatenate([edges, lines]), axis=0, return_inverse=True)
    loose = int(np.count_nonzero(~np.isin(number.ravel()[len(edges) :], number.ravel()[: len(edges)])))
    return [lines_left_out(loose)] if loose else []


def _merge(points: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """The points without those that lie exactly on an earlier one, and the new number of each; None where all differ."""
    _, first, number = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)  # + 0.0: -0.0 is 0.0
    if len(first) == len(points):
        return points, None
    order = np.argsort(first)
    rank = np.empty(len(first), dtype=np.int64)
    rank[order] = np.arange(len(first))
    return points[first[order]], rank[number.ravel()]


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
    check_indices(elements, len(vertices), kind, where)
    elements = elements.astype(np.int32)
    if kind == "triangles":
        mesh = Mesh(vertices, elements)
        return mesh.surface() if drop_unused else mesh
    if np.all(tet_volumes(vertices, elements) < 0):
        elements = elements[:, [0, 2, 1, 3]]
    return Mesh.of_tets(vertices, elements) if drop_unused else Mesh(vertices, boundary(elements), elements)


def check_indices(elements: np.ndarray, count: int, kind: str, where: str) -> None:
    """Raises SceneError where elements (m, k) are not whole numbers from 0 to count - 1."""
    if elements.dtype.kind not in "iuf" or not np.all(elements == np.floor(elements)):
        raise SceneError(f"{where}: {kind} must be whole numbers")
    outside = ((elements < 0) | (elements >= count)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        found = [int(index) for index in elements[row]]
        raise SceneError(f"{where}: {kind}[{row}] = {found} is out of range; indices must be 0 to {count - 1}")


def tetrahedralize(mesh: Mesh, where: str) -> Mesh:
    """Fills a closed surface with tets (fTetWild; the surface is approximated within 1e-3 of its bounding box).

    Raises SceneError where pytetwild is not installed or makes no tets.
    """
    try:
        import pytetwild  # pyright: ignore[reportMissingImports]  (an extra)
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
