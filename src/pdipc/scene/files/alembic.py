"""Alembic archives (.abc): what Blender, Houdini, Maya and Marvelous Designer hand over."""

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import Contents, Damaged, backwards, first_of, no_such
from pdipc.scene.memory import free_memory, gib

CLOSE = 1e-6  # s: samples of different objects that are nearer to each other are of one time
OGAWA, HDF5 = b"Ogawa", b"\x89HDF"  # how files of the two kinds of archives begin


class Samples:
    """Something over time: what it is at its samples, and in between in a straight line; before the first and after the last as there.

    times: s, ascending; at most one where all samples are alike.
    """

    def __init__(self, source: Any, array: Callable[[Any], np.ndarray], where: str):
        """source: a property or a schema of the archive. array: of one of its values."""
        self.source, self.array, self.where = source, array, where
        sampling, count = source.getTimeSampling(), source.getNumSamples()
        self.times = [sampling.getSampleTime(k) for k in range(min(count, 1) if source.isConstant() else count)]
        if not np.isfinite(self.times).all() or any(b <= a for a, b in itertools.pairwise(self.times)):
            raise Damaged(f'the times of "{where}" do not ascend')

    def at(self, time: float) -> np.ndarray:
        """Its value at a time, s."""
        after = int(np.searchsorted(self.times, time))
        if after in (0, len(self.times)):
            return self._sample(min(after, len(self.times) - 1))
        last, (begin, end) = self._sample(after), self.times[after - 1 : after + 1]
        if time == end:
            return last
        first = self._sample(after - 1)
        if first.shape != last.shape:
            raise Damaged(f'"{self.where}" has {len(first)} vertices at {begin:g} s, and {len(last)} at {end:g} s')
        return first + (time - begin) / (end - begin) * (last - first)

    def _sample(self, number: int) -> np.ndarray:
        from alembic3d import Abc  # pyright: ignore  (an extra)

        when = Abc.ISampleSelector(self.times[number])  # of a number, alembic3d takes it for a time
        return self.array(self.source.getValue(when))


@dataclass
class Shape:
    """An object of an archive that is more than a place. name: its path, such as /World/Flag. kind: as the archive calls it.

    mesh: its schema, and points: (n, 3) over time, where it is a mesh. places: (4, 4) over time, for rows, p' = p M, and the
    schemas that they are of: where it stands, and what it is below, the nearest first. shown: objects, itself or above it, that say whether they are visible.
    """

    name: str
    kind: str
    mesh: Any
    points: Samples | None
    places: list[Samples]
    shown: list[Any]

    @property
    def moving(self) -> list[Samples]:
        """What of it changes with time."""
        return [each for each in (self.points, *self.places) if each is not None and len(each.times) > 1]

    @property
    def face_times(self) -> list[float]:
        """s: when its faces are said; more than once where they are not the same at all times."""
        properties = self.mesh.getFaceIndicesProperty(), self.mesh.getFaceCountsProperty()
        return sorted({time for each in properties for time in Samples(each, np.array, self.name).times})

    def matrix(self, time: float) -> np.ndarray:
        """(4, 4): where it stands, for rows."""
        from alembic3d import Abc  # pyright: ignore  (an extra)

        matrix = np.eye(4)
        for place in self.places:
            matrix = matrix @ place.at(time)
            if not place.source.getInheritsXforms(Abc.ISampleSelector(time)):
                break
        return matrix

    def placed(self, time: float) -> np.ndarray:
        """(n, 3): its points in the world."""
        assert self.points is not None
        matrix = self.matrix(time)
        return self.points.at(time) @ matrix[:3, :3] + matrix[3, :3]

    def faces(self, time: float, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Corners of its faces, one after another, and corners of each, without holes. size: vertices that there are.

        An archive's faces are clockwise seen from outside; here they are the other way round, as in every other format.
        """
        from alembic3d import Abc  # pyright: ignore  (an extra)

        when = Abc.ISampleSelector(time)
        properties = self.mesh.getFaceIndicesProperty(), self.mesh.getFaceCountsProperty()
        corners, counts = (np.array(each.getValue(when), dtype=np.int64) for each in properties)
        if (len(counts) and counts.min() < 0) or counts.sum() != len(corners):
            raise Damaged(f'mesh "{self.name}" has {len(corners)} corners, and its faces say {counts.sum()}')
        if len(corners) and (corners.min() < 0 or corners.max() >= size):
            raise Damaged(f'mesh "{self.name}" names a vertex that is not there; indices must be 0 to {size - 1}')
        if np.linalg.det(self.matrix(time)[:3, :3]) >= 0:  # a mirror image is the other way round as it is
            corners = backwards(corners, counts)
        kept = np.ones(len(counts), dtype=bool)
        holes = self.mesh.getHolesProperty() if self.kind == "SubD" else None
        if holes and holes.valid() and holes.getNumSamples():
            kept[[hole for hole in np.array(holes.getValue(when)) if 0 <= hole < len(counts)]] = False
        return corners[np.repeat(kept, counts)], counts[kept]


def archive(path: Path, frames: bool = False, below: str | None = None) -> Contents:
    """All meshes of an archive, where they stand at its start; frames: at all of their times from then on; below: only those of the object at
    this path and below it.

    Its start is the first sample of whatever moves in it, so that the parts of one archive keep time with each other.
    """
    try:
        from alembic3d import Abc  # pyright: ignore  (an extra)
    except ImportError as error:
        raise SceneError(f'mesh file "{path}": reading Alembic needs the extra: pip install "pdipc[alembic]"') from error
    _head(path)
    try:
        source = Abc.IArchive(str(path))  # its objects live no longer than it does
    except RuntimeError as error:  # which says no more than "Unknown core type"
        raise Damaged("it is damaged, or was cut off") from error
    try:
        everything = list(_shapes(source.getTop()))
    except UnicodeDecodeError as error:
        raise Damaged("a name in it is no text") from error
    start = min((each.times[0] for shape in everything for each in shape.moving), default=0.0)
    shapes = everything if below is None else _part(path, everything, below)
    shown = [shape for shape in shapes if not _hidden(shape, start)]
    meshes, others = [], {}
    for shape in shown:
        if shape.points is not None and shape.points.times and len(shape.points.at(start)):
            meshes.append(shape)
        else:
            kind = shape.kind if shape.points is None else f"{shape.kind} without points"
            others[kind] = others.get(kind, 0) + 1
    notes = _left_out(others, len(shapes) - len(shown))
    if not meshes:
        said = "".join(f"; {each}" for each in notes)
        raise SceneError(f'mesh file "{path}": {"" if below is None else f"its object {below} "}holds no mesh{said}')
    found = Contents(np.concatenate([shape.placed(start) for shape in meshes]), notes=notes)
    sizes = [len(shape.points.at(start)) for shape in meshes if shape.points]
    faces = [shape.faces(start, size) for shape, size in zip(meshes, sizes, strict=True)]
    firsts = np.cumsum([0, *sizes])
    found.polygons = (
        np.concatenate([corners + first for (corners, _), first in zip(faces, firsts, strict=False)]),
        np.concatenate([counts for _, counts in faces]),
    )
    times = _apart([start, *(time for shape in meshes for each in shape.moving for time in each.times if time > start)])
    if frames and len(times) > 1:
        for shape, size, first in zip(meshes, sizes, faces, strict=True):
            _keeps_faces(shape, size, first, start)
        found.times, found.frames = np.array(times), _frames(meshes, sizes, times, path)
    elif len(times) > 1:
        found.notes.append(first_of(len(times)))
    found.notes += _changing(meshes, shapes, found.frames is not None)
    return found


def _head(path: Path) -> None:
    """Raises Damaged where a file is no archive that can be read, by its first bytes."""
    with open(path, "rb") as file:
        head = file.read(8)
    if head.startswith(HDF5):
        raise Damaged("it is an archive of the old kind, HDF5; write it as Ogawa, the kind of Alembic since 1.5")
    if not head.startswith(OGAWA):
        raise Damaged("it is no Alembic archive")
    if head[5:6] != b"\xff":
        raise Damaged("it was not written to its end; write it again")


def _shapes(top: Any) -> Iterator[Shape]:
    """All that is in an archive but places, in its order. Raises Damaged for a place of another version of the format."""
    from alembic3d import Abc, AbcGeom  # pyright: ignore  (an extra)

    whole = Abc.WrapExistingFlag.kWrapExisting
    waiting: list[tuple[Any, list[Samples], list[Any]]] = [(top, [], [])]
    while waiting:
        each, places, shown = waiting.pop()
        name, header = each.getFullName(), each.getHeader()
        schema = header.getMetaData().get("schema")
        if AbcGeom.GetVisibilityProperty(each).valid():
            shown = [each, *shown]
        if AbcGeom.IXform.matches(header):
            place = Samples(AbcGeom.IXform(each, whole).getSchema(), _matrix_of, name)
            places = [place, *places] if place.times else places
        elif schema.startswith("AbcGeom_Xform"):
            raise Damaged(f'"{name}" has a place of the version {schema}, which is not read')
        elif AbcGeom.IPolyMesh.matches(header) or AbcGeom.ISubD.matches(header):
            kind, wrap = ("PolyMesh", AbcGeom.IPolyMesh) if AbcGeom.IPolyMesh.matches(header) else ("SubD", AbcGeom.ISubD)
            mesh = wrap(each, whole).getSchema()
            yield Shape(name, kind, mesh, Samples(mesh.getPositionsProperty(), _points_of, name), places, shown)
        elif schema and not schema.startswith("AbcGeom_FaceSet"):  # those are faces of a mesh, by name
            yield Shape(name, re.sub(r"^Abc[A-Za-z]*_|_v\d+$", "", schema), None, None, places, shown)
        waiting += [(each.getChild(k), places, shown) for k in reversed(range(each.getNumChildren()))]


def _points_of(value: Any) -> np.ndarray:
    return np.array(value, dtype=np.float64).reshape(-1, 3)


def _matrix_of(value: Any) -> np.ndarray:
    return np.array(value.getMatrix(), dtype=np.float64)


def _part(path: Path, shapes: list[Shape], wanted: str) -> list[Shape]:
    """The object at a path and those below it. Raises SceneError, with the meshes that there are, where it holds nothing."""
    found = [shape for shape in shapes if shape.name == wanted or shape.name.startswith(f"{wanted.rstrip('/')}/")]
    if not found:
        raise no_such(path, "object", wanted, [shape.name for shape in shapes if shape.mesh is not None])
    return found


def _hidden(shape: Shape, time: float) -> bool:
    """Whether it is invisible: the nearest that says so, itself or something that it is below, decides."""
    from alembic3d import Abc, AbcGeom  # pyright: ignore  (an extra)

    said = [
        int(AbcGeom.GetVisibility(each, Abc.ISampleSelector(time))) for each in shape.shown
    ]  # 1: visible, 0: not, -1: no word
    return next((value == 0 for value in said if value >= 0), False)


def _left_out(others: dict[str, int], hidden: int) -> list[str]:
    """Notes for what is no mesh, by kind, and for how many objects are invisible."""
    listed = ", ".join(f"{number} {kind}" for kind, number in sorted(others.items()))
    notes = [f"objects were left out: {listed}"] if others else []
    return notes + ([f"{hidden} invisible objects were left out"] if hidden else [])


def _changing(meshes: list[Shape], shapes: list[Shape], frames: bool) -> list[str]:
    """Notes for what changes with time, or would be drawn finer, and is taken as it is at the start."""
    from alembic3d import AbcGeom  # pyright: ignore  (an extra)

    cages = sum(shape.kind == "SubD" for shape in meshes)
    faces = 0 if frames else sum(len(shape.face_times) > 1 for shape in meshes)
    visible = [shape for shape in shapes if shape.mesh is not None]
    visible = sum(any(not AbcGeom.GetVisibilityProperty(each).isConstant() for each in shape.shown) for shape in visible)
    notes = [f"{cages} subdivision surfaces were taken as their cages"] if cages else []
    notes += [f"the faces of {faces} meshes change with time: they were read as they are at the start"] if faces else []
    return notes + ([f"{visible} meshes appear or vanish with time: they were taken as at the start"] if visible else [])


def _apart(times: list[float]) -> list[float]:
    """The times in their order, without those that are another one but for rounding."""
    kept: list[float] = []
    for time in sorted(times):
        if not kept or time - kept[-1] > CLOSE:
            kept.append(time)
    return kept


def _keeps_faces(shape: Shape, size: int, first: tuple[np.ndarray, np.ndarray], start: float) -> None:
    """Raises Damaged where a mesh has other vertices or faces later than at the start."""
    assert shape.points is not None
    for time in shape.face_times[1:]:
        count = len(shape.points.at(time))
        if time > start and not (count == size and all(map(np.array_equal, shape.faces(time, count), first))):
            raise Damaged(
                f'mesh "{shape.name}" has other faces at {time:g} s than at the start; what deforms must keep its own'
            )


def _frames(meshes: list[Shape], sizes: list[int], times: list[float], path: Path) -> np.ndarray:
    """(f, n, 3): all points at all times. Raises SceneError where they need more memory than there is."""
    needed, free = len(times) * sum(sizes) * 24, free_memory()
    if needed > free:
        raise SceneError(f'mesh file "{path}": its {len(times)} frames need {gib(needed)} of memory, and {gib(free)} are free')
    points, firsts = np.empty((len(times), sum(sizes), 3)), np.cumsum([0, *sizes])
    for number, time in enumerate(times):
        for shape, first, size in zip(meshes, firsts, sizes, strict=False):
            placed = shape.placed(time)
            if len(placed) != size:
                raise Damaged(f'mesh "{shape.name}" has {size} vertices at the start, and {len(placed)} at {time:g} s')
            points[number, first : first + size] = placed
    return points
