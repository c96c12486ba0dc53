"""Mesh files taken apart: points and cells of every kind as they are written, and what was left out.

`pdipc.scene.meshes` makes triangles and tetrahedra of them. Formats that other packages parse are read in a process of their own,
see `pdipc.scene.worker`.
"""

import contextlib
import io
import re
import struct
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pdipc.scene.errors import SceneError

# Corners of each kind of cell; the further vertices of cells of higher order follow them.
CORNERS = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
ORDER_AS_HEXAHEDRON = {"pixel": ("quad", [0, 1, 3, 2]), "voxel": ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6])}


@dataclass
class Contents:
    """What a mesh file holds.

    points: (n, 3). cells: kind, as in `CORNERS`, and vertices (c, k). polygons: corners one after another, and corners of each.
    notes: what was left out or converted, a sentence each. repeats: whether the format writes shared vertices several times.
    """

    points: np.ndarray
    cells: list[tuple[str, np.ndarray]] = field(default_factory=list)
    polygons: tuple[np.ndarray, np.ndarray] = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    notes: list[str] = field(default_factory=list)
    repeats: bool = False


class Damaged(ValueError):
    """A file that does not hold what its format says."""


def parse(path: Path) -> Contents:
    """The contents of a file of a known format. Raises whatever its reader does; SceneError where its message is whole."""
    return READERS[path.suffix.lower()](path)


def is_foreign(path: Path) -> bool:
    """Whether another package parses this file."""
    return READERS[path.suffix.lower()] in (_meshio, _glb, _usd) or (path.suffix.lower() == ".msh" and not _is_gmsh(path))


# --- NumPy ---


def _npz(path: Path) -> Contents:
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > 100 * path.stat().st_size + 2**30:
        raise Damaged(f"it would unpack to {size / 2**30:.3g} GiB")
    with np.load(path) as data:
        if "V" not in data:
            raise SceneError(f'mesh file "{path}": holds {list(data)}; needed: V and T (tets) or F (triangles)')
        cells = [(kind, data[name]) for kind, name in (("tetra", "T"), ("triangle", "F")) if name in data]
        return Contents(data["V"], cells)


# --- surfaces ---


def _obj(path: Path) -> Contents:
    """Wavefront OBJ: v, f and l; indices count from 1, or back from the last vertex so far."""
    points, corners, counts, lines, others = [], [], [], 0, set()
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        key, *values = line.split() or [""]
        if key == "v":
            if len(values) < 3:
                raise Damaged(f"line {number} has {len(values)} coordinates of a vertex; needed: 3")
            points.append(values[:3])
        elif key == "f":
            if len(values) < 3:
                raise Damaged(f"line {number} has a face of {len(values)} vertices; needed: at least 3")
            counts.append(len(values))
            for value in values:
                index = int(value.partition("/")[0])
                if index == 0 or index < -len(points):
                    raise Damaged(f"line {number} names vertex {index}; vertices count from 1, or back from -1")
                corners.append(index - 1 if index > 0 else len(points) + index)
        elif key == "l":
            lines += max(0, len(values) - 1)
        elif key in ("p", "curv", "curv2", "surf"):
            others.add(key)
    found = Contents(_floats(points, 3), polygons=(np.array(corners, dtype=np.int64), np.array(counts, dtype=np.int64)))
    if lines:
        found.notes.append(lines_left_out(lines))
    if others:
        found.notes.append(f"elements other than faces were left out: {', '.join(sorted(others))}")
    return found


def lines_left_out(count: int) -> str:
    return f"{count} lines were left out; springs along them can be given as attachments with pairs"


def _off(path: Path) -> Contents:
    """Object File Format, as text."""
    words = re.sub(r"#[^\n]*", "", path.read_text(encoding="utf-8", errors="replace")).split()
    head = re.fullmatch(r"(ST)?(C)?(N)?OFF", words[0]) if words else None
    if head is None:
        raise Damaged(f'it begins with "{words[0][:20] if words else ""}"; needed: OFF')
    if words[1:2] == ["BINARY"]:
        raise Damaged("it is binary; only text is read")
    n, faces = int(words[1]), int(words[2])
    at, width = 4, 3 + 3 * bool(head[3]) + 4 * bool(head[2]) + 2 * bool(head[1])
    if not 0 <= n * width <= len(words) - at:
        raise Damaged(f"its head says {n} vertices, and the file ends before")
    points = _floats(words[at : at + n * width], width)[:, :3]
    # what follows a face, its colour, has no count: faces are lines
    lines = re.sub(r"#[^\n]*", "", path.read_text(encoding="utf-8", errors="replace")).splitlines()
    rows = [row for row in (line.split() for line in lines) if row]
    seen, start = 0, 0
    while seen < at + n * width and start < len(rows):
        seen += len(rows[start])
        start += 1
    rows = rows[start : start + faces]
    if seen != at + n * width or len(rows) < faces or any(len(row) <= int(row[0]) for row in rows):
        raise Damaged(f"its head says {faces} faces, and they are not there, a line each")
    counts = np.array([int(row[0]) for row in rows], dtype=np.int64)
    corners = np.array([int(index) for row in rows for index in row[1 : 1 + int(row[0])]], dtype=np.int64)
    return Contents(points, polygons=(corners, counts))


def _stl(path: Path) -> Contents:
    """Stereolithography, text or binary: triangles without shared vertices."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + 50 * count:
        facets = np.frombuffer(data, dtype=[("head", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")], offset=84)
        points = facets["corners"].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid":
        words = data.decode("ascii", errors="replace").split()
        at = [k for k, word in enumerate(words) if word.lower() == "vertex"]
        points = _floats([words[k + 1 : k + 4] for k in at], 3)
        if len(points) % 3:
            raise Damaged(f"it holds {len(points)} vertices, which are no whole triangles")
    else:
        raise Damaged(f"its head says {count} triangles, {84 + 50 * count} bytes, and it has {len(data)} bytes")
    return Contents(points, [("triangle", np.arange(len(points)).reshape(-1, 3))], repeats=True)


PLY_TYPES = dict(
    zip(
        "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64".split(),
        "i1 u1 i2 u2 i4 u4 f4 f8 i1 u1 i2 u2 i4 u4 f4 f8".split(),
        strict=True,
    )
)


def _ply(path: Path) -> Contents:
    """Polygon File Format, text or binary; faces may have different numbers of corners."""
    data = path.read_bytes()
    ended = re.search(rb"end_header[ \t]*\r?\n", data[: 1 << 20])
    if not data.startswith(b"ply") or ended is None:
        raise Damaged('it has no head from "ply" to "end_header"')
    layout, elements = "", []  # name, count, [(name, type of a list's count or None, type)]
    for line in data[: ended.start()].decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", name, _]:
                layout = name
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", count, kind, name]:
                elements[-1][2].append((name, PLY_TYPES[count], PLY_TYPES[kind]))
            case ["property", kind, name]:
                elements[-1][2].append((name, None, PLY_TYPES[kind]))
    if layout not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise Damaged(f'its format is "{layout}"; needed: ascii, binary_little_endian or binary_big_endian')
    take = _PlyText(data[ended.end() :]) if layout == "ascii" else _PlyBinary(data[ended.end() :], "<>"["big" in layout])
    points, polygons, notes = np.zeros((0, 3)), Contents.polygons, []
    for name, count, properties in elements:
        if count < 0:
            raise Damaged(f"its head says {count} of {name}")
        columns, lists = take.element(name, count, properties)
        if name == "vertex":
            if not {"x", "y", "z"} <= set(columns):
                raise Damaged("its vertices have no x, y and z")
            points = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float64)
        elif name == "face":
            if not {"vertex_indices", "vertex_index"} & set(lists):
                raise Damaged("its faces have no vertex_indices")
            polygons = lists.get("vertex_indices") or lists["vertex_index"]
        elif name == "tristrips":
            notes.append(f"{count} strips of triangles were left out; write them as faces")
        elif name == "edge" and count:
            notes.append(lines_left_out(count))
    return Contents(points, polygons=polygons, notes=notes)


class _PlyText:
    """Elements of a PLY file one after another, as words."""

    def __init__(self, data: bytes):
        self.words, self.at = data.decode("ascii", errors="replace").split(), 0

    def element(self, name: str, count: int, properties: list) -> tuple[dict, dict]:
        """Columns of single values (count,) and of lists (all values, counts), by property."""
        if all(of_count is None for _, of_count, _ in properties):
            width = len(properties)
            table = _floats(self._take(count * width, name), width) if width else np.zeros((count, 0))
            return {own: table[:, k] for k, (own, _, _) in enumerate(properties)}, {}
        values: dict[str, list] = {own: [] for own, _, _ in properties}
        counts: dict[str, list] = {own: [] for own, of_count, _ in properties if of_count}
        for _ in range(count):
            for own, of_count, _ in properties:
                size = int(self._take(1, name)[0]) if of_count else 1
                if of_count:
                    counts[own].append(size)
                values[own] += self._take(size, name)
        numbers = {own: np.array(values[own], dtype=np.float64) for own in values}
        lists = {own: (_whole(numbers.pop(own)), np.array(sizes, dtype=np.int64)) for own, sizes in counts.items()}
        return numbers, lists

    def _take(self, size: int, name: str) -> list[str]:
        if not 0 <= size <= len(self.words) - self.at:
            raise Damaged(f"it ends within its elements of the kind {name}")
        self.at += size
        return self.words[self.at - size : self.at]


class _PlyBinary:
    """Elements of a PLY file one after another, as bytes."""

    def __init__(self, data: bytes, order: str):
        self.data, self.order, self.at = data, order, 0

    def element(self, name: str, count: int, properties: list) -> tuple[dict, dict]:
        """Columns of single values (count,) and of lists (all values, counts), by property."""
        lists = [own for own, of_count, _ in properties if of_count]
        sizes = self._sizes(properties) if lists and count else {}
        row = self._row(properties, sizes)
        if row.itemsize * count <= len(self.data) - self.at:
            table = np.frombuffer(self.data, row, count, self.at)
            if all(np.all(table[f"{own} count"] == sizes[own]) for own in lists if count):
                self.at += row.itemsize * count
                singles = {own: table[own] for own, of_count, _ in properties if not of_count}
                return singles, {own: (table[own].ravel(), table[f"{own} count"].astype(np.int64)) for own in lists}
        if not lists:
            raise Damaged(f"it ends within its elements of the kind {name}")
        return self._one_by_one(name, count, properties)

    def _row(self, properties: list, sizes: dict[str, int]) -> np.dtype:
        fields = []
        for own, of_count, kind in properties:
            fields += [(f"{own} count", self.order + of_count)] if of_count else []
            fields += [(own, self.order + kind, (sizes.get(own, 0),) if of_count else ())]
        return np.dtype(fields)

    def _sizes(self, properties: list) -> dict[str, int]:
        """The lengths of the lists of the first row."""
        at, sizes = self.at, {}
        for own, of_count, kind in properties:
            size = 1
            if of_count:
                sizes[own] = size = self._number(at, of_count, own)
                at += np.dtype(of_count).itemsize
            at += size * np.dtype(kind).itemsize
        return sizes

    def _number(self, at: int, kind: str, name: str) -> int:
        width = np.dtype(kind).itemsize
        if at + width > len(self.data):
            raise Damaged(f"it ends within its elements of the kind {name}")
        size = int(np.frombuffer(self.data, self.order + kind, 1, at)[0])
        if not 0 <= size * width <= len(self.data):
            raise Damaged(f"a list of {size} values is longer than the file")
        return size

    def _one_by_one(self, name: str, count: int, properties: list) -> tuple[dict, dict]:
        codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
        values: dict[str, list] = {own: [] for own, _, _ in properties}
        counts: dict[str, list] = {own: [] for own, of_count, _ in properties if of_count}
        for _ in range(count):
            for own, of_count, kind in properties:
                size = 1
                if of_count:
                    size = self._number(self.at, of_count, name)
                    self.at += np.dtype(of_count).itemsize
                    counts[own].append(size)
                width = size * np.dtype(kind).itemsize
                if self.at + width > len(self.data):
                    raise Damaged(f"it ends within its elements of the kind {name}")
                values[own] += struct.unpack_from(f"{self.order}{size}{codes[kind]}", self.data, self.at)
                self.at += width
        arrays = {own: np.array(values[own]) for own in values}
        return arrays, {own: (arrays.pop(own), np.array(sizes, dtype=np.int64)) for own, sizes in counts.items()}


# --- volumes ---

GMSH_KINDS = {  # element types of Gmsh: what they are, and their number of vertices
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8), 6: ("wedge", 6),
    7: ("pyramid", 5), 8: ("line", 3), 9: ("triangle", 6), 10: ("quad", 9), 11: ("tetra", 10), 12: ("hexahedron", 27),
    13: ("wedge", 18), 14: ("pyramid", 14), 15: ("vertex", 1), 16: ("quad", 8), 17: ("hexahedron", 20), 18: ("wedge", 15),
    19: ("pyramid", 13), 20: ("triangle", 9), 21: ("triangle", 10), 22: ("triangle", 12), 23: ("triangle", 15),
    24: ("triangle", 15), 25: ("triangle", 21), 26: ("line", 4), 27: ("line", 5), 28: ("line", 6), 29: ("tetra", 20),
    30: ("tetra", 35), 31: ("tetra", 56), 36: ("quad", 16), 37: ("quad", 25), 38: ("quad", 36), 92: ("hexahedron", 64),
    93: ("hexahedron", 125),
}  # fmt: skip


def _is_gmsh(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(200).lstrip().startswith(b"$")


def _msh(path: Path) -> Contents:
    """Gmsh, versions 2.x and 4.1, text or binary; anything else that calls itself .msh goes to meshio."""
    if not _is_gmsh(path):
        return _meshio(path)
    data = path.read_bytes()
    head = re.search(rb"\$MeshFormat\s+(\S+)\s+([01])\s+(\d+)[^\n]*\n", data[:4096])
    if head is None:
        raise Damaged("its $MeshFormat is not there, or is no version, kind and size")
    version, binary, size = head[1].decode("ascii", errors="replace"), head[2] == b"1", int(head[3])
    if not (version == "2" or version.startswith("2.") or version == "4.1"):
        return _meshio(path)
    order = "<"
    if binary and int.from_bytes(data[head.end() : head.end() + 4], "little") != 1:
        order = ">"
    if binary and size not in (4, 8):
        raise Damaged(f"its numbers have {size} bytes; needed: 4 or 8")

    def section(*names: str) -> tuple[str, "_Words | _Bytes"]:
        for name in names:
            begin = re.search(rb"\$" + name.encode() + rb"[ \t\r]*\n", data)
            if begin:
                end = data.find(b"$End" + name.encode(), begin.end())
                inside = data[begin.end() : None if end < 0 or binary else end]
                return name, _Bytes(inside, name, order, f"u{size}") if binary else _Words(inside, name)
        raise Damaged(f"it has no ${names[0]}")

    (name, nodes), (_, elements) = section("Nodes", "ParametricNodes"), section("Elements")
    if version == "4.1":
        numbers, points = _nodes_4(nodes)
        cells = _elements_4(elements)
    else:
        numbers, points = _nodes_2(nodes, parametric=name == "ParametricNodes")
        cells = _elements_2(elements)
    sorting = np.argsort(numbers, kind="stable")
    ascending = numbers[sorting]
    if np.any(ascending[1:] == ascending[:-1]):
        raise Damaged("two of its nodes have one number")
    found = []
    for kind, named in cells:
        place = np.minimum(np.searchsorted(ascending, named), max(0, len(ascending) - 1))
        known = ascending[place] == named if len(ascending) else np.zeros(named.shape, dtype=bool)
        if not known.all():
            raise Damaged(f"an element names node {named[~known][0]}, which is not there")
        found.append((kind, sorting[place]))
    return Contents(points, found)


def _nodes_4(take: "_Words | _Bytes") -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) and points (n, 3) of Gmsh 4.1."""
    numbers, points = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for _ in range(take.sizes(4)[0]):
        dimension, _, parametric = take.ints(3)
        count = take.sizes(1)[0]
        numbers.append(take.sizes(count))
        points.append(take.reals(count, 3 + (dimension if parametric else 0))[:, :3])
    return np.concatenate(numbers), np.concatenate(points)


def _elements_4(take: "_Words | _Bytes") -> list[tuple[str, np.ndarray]]:
    cells = []
    for _ in range(take.sizes(4)[0]):
        kind, corners = _gmsh_kind(take.ints(3)[2])
        count = take.sizes(1)[0]
        cells.append((kind, take.sizes(count * (1 + corners)).reshape(-1, 1 + corners)[:, 1:]))
    return cells


def _nodes_2(take: "_Words | _Bytes", parametric: bool) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) and points (n, 3) of Gmsh 2; with parameters on curves and surfaces, which are left out."""
    count = take.count()
    if not parametric:
        return take.numbered(count)
    numbers, points = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for _ in range(count):
        number, point = take.numbered(1)
        dimension, _ = take.ints(2)
        take.reals(1, dimension if dimension in (1, 2) else 0)
        numbers.append(number)
        points.append(point)
    return np.concatenate(numbers), np.concatenate(points)


def _elements_2(take: "_Words | _Bytes") -> list[tuple[str, np.ndarray]]:
    rows: dict[int, list[np.ndarray]] = {}
    left = take.count()
    while left > 0:
        if isinstance(take, _Words):
            (_, number, tags), block = take.ints(3), 1
        else:
            number, block, tags = take.ints(3)
        if block < 1 or tags < 0:
            raise Damaged(f"a block of {block} elements with {tags} tags is not possible")
        width = tags + _gmsh_kind(number)[1] + (not isinstance(take, _Words))
        rows.setdefault(number, []).append(take.ints(block * width).reshape(block, width)[:, -_gmsh_kind(number)[1] :])
        left -= block
    return [(_gmsh_kind(number)[0], np.concatenate(blocks)) for number, blocks in rows.items()]


def _gmsh_kind(number: int) -> tuple[str, int]:
    if number not in GMSH_KINDS:
        raise Damaged(f"its elements of type {number} are not known")
    return GMSH_KINDS[number]


class _Words:
    """What a section says as text, from its begin on."""

    def __init__(self, data: bytes, name: str):
        self.words, self.at, self.name = data.decode("ascii", errors="replace").split(), 0, name

    def take(self, count: int) -> list[str]:
        if not 0 <= count <= len(self.words) - self.at:
            raise Damaged(f"{self.name} ends before all that it says is there")
        self.at += count
        return self.words[self.at - count : self.at]

    def ints(self, count: int) -> np.ndarray:
        return _integers(self.take(count))

    def count(self) -> int:
        return int(self.take(1)[0])

    sizes = ints

    def reals(self, count: int, width: int) -> np.ndarray:
        """(count, width)."""
        if count < 0 or width < 0:
            raise Damaged(f"{self.name} says {count} rows of {width}")
        return _floats(self.take(count * width), width) if width else np.zeros((count, 0))

    def numbered(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows of a number and three coordinates."""
        words = self.take(4 * count)
        rows = _floats(words, 4)
        return _integers(words[::4]), rows[:, 1:]


class _Bytes:
    """What a section says as bytes, from its begin on."""

    def __init__(self, data: bytes, name: str, order: str, size: str):
        self.data, self.at, self.name, self.order, self.size = data, 0, name, order, size

    def take(self, kind: str | list, count: int) -> np.ndarray:
        dtype = np.dtype(kind).newbyteorder(self.order)
        count = int(count)
        if not 0 <= count * dtype.itemsize <= len(self.data) - self.at:
            raise Damaged(f"{self.name} ends before all that it says is there")
        self.at += count * dtype.itemsize
        return np.frombuffer(self.data, dtype, count, self.at - count * dtype.itemsize)

    def ints(self, count: int) -> np.ndarray:
        return self.take("i4", count).astype(np.int64)

    def sizes(self, count: int) -> np.ndarray:
        return self.take(self.size, count).astype(np.int64)

    def count(self) -> int:
        line = self.data[self.at : self.at + 40].split(b"\n")[0]
        self.at += len(line) + 1
        return int(line)

    def reals(self, count: int, width: int) -> np.ndarray:
        """(count, width)."""
        return self.take("f8", int(count) * int(width)).reshape(int(count), int(width))

    def numbered(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows of a number and three coordinates."""
        rows = self.take([("number", "i4"), ("point", "f8", 3)], count)
        return rows["number"].astype(np.int64), rows["point"].astype(np.float64)


MEDIT_KINDS = {  # keywords of Medit: what they are, and their number of vertices
    "Vertices": ("vertex", 0), "Edges": ("line", 2), "EdgesP2": ("line", 3), "Triangles": ("triangle", 3),
    "TrianglesP2": ("triangle", 6), "Quadrilaterals": ("quad", 4), "QuadrilateralsQ2": ("quad", 9),
    "Tetrahedra": ("tetra", 4), "TetrahedraP2": ("tetra", 10), "Hexahedra": ("hexahedron", 8), "Hexaedra": ("hexahedron", 8),
    "HexahedraQ2": ("hexahedron", 27), "Prisms": ("wedge", 6), "Pentahedra": ("wedge", 6), "Pyramids": ("pyramid", 5),
}  # fmt: skip


def _medit(path: Path) -> Contents:
    """Medit's text format: keywords, each with a count and rows; white space of every kind counts alike."""
    take = _Words(re.sub(rb"#[^\n]*", b"", path.read_bytes()), "the file")
    dimension, points, cells = 3, None, []
    if take.take(1)[0].lower() != "meshversionformatted":
        raise Damaged(f'it begins with "{take.words[0][:20]}"; needed: MeshVersionFormatted')
    keywords = {name.lower(): kind for name, kind in MEDIT_KINDS.items()}
    while take.at < len(take.words):
        word = take.take(1)[0].lower()
        take.name = word[:40]
        if word == "end":
            break
        if word == "dimension":
            dimension = take.count()
            if dimension not in (2, 3):
                raise Damaged(f"its dimension is {dimension}; needed: 2 or 3")
        elif word == "vertices":
            points = take.reals(take.count(), dimension + 1)[:, :dimension]
        elif word in keywords:
            kind, corners = keywords[word]
            rows = take.count()
            cells.append((kind, take.ints(rows * (corners + 1)).reshape(-1, corners + 1)[:, :corners] - 1))
        # what any other keyword says are numbers, which are passed over
    if points is None:
        raise Damaged("it has no Vertices")
    return Contents(points, cells)


def _tetgen(path: Path) -> Contents:
    def rows(file: Path) -> np.ndarray:
        if not file.is_file():
            raise SceneError(f'mesh file "{path}": needs "{file.name}" beside it')
        lines = [line.split("#")[0].split() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
        lines = [line for line in lines if line]
        count = int(lines[0][0]) if lines else 0
        if count < 1:
            raise Damaged(f'"{file.name}" says {count} rows')
        if len(lines) <= count:
            raise SceneError(f'mesh file "{file}": its first line says {count} rows, and {len(lines) - 1} are there')
        return np.array([[float(x) for x in line] for line in lines[1 : count + 1]])

    nodes, elements = rows(path.with_suffix(".node")), rows(path.with_suffix(".ele"))
    if nodes.ndim != 2 or nodes.shape[1] < 4 or elements.ndim != 2 or elements.shape[1] < 5:
        raise Damaged("its rows must be: number, x, y, z; and: number, four or ten vertices")
    corners = 10 if elements.shape[1] >= 11 else 4
    return Contents(nodes[:, 1:4], [("tetra", _whole(elements[:, 1 : 1 + corners] - nodes[0, 0]))])


# --- formats that other packages parse ---


def _meshio(path: Path) -> Contents:
    import meshio

    form = {".vtk": "vtk", ".vtu": "vtu"}.get(path.suffix.lower()) or ("gmsh" if _is_gmsh(path) else "ansys")
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


def _glb(path: Path) -> Contents:
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


def _usd(path: Path) -> Contents:
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
            if len(sides) and sides.min() < 0 or sides.sum() != len(rows):
                raise Damaged(f'Mesh "{prim.GetPath()}" has {len(rows)} corners, and its faces say {sides.sum()}')
            if len(rows) and (rows.min() < 0 or rows.max() >= len(own)):
                raise Damaged(f'Mesh "{prim.GetPath()}" names vertex {rows.max()}; indices must be 0 to {len(own) - 1}')
            holes = prim.GetAttribute("holeIndices").Get(time)
            kept = np.ones(len(sides), dtype=bool)
            kept[[hole for hole in holes or [] if 0 <= hole < len(sides)]] = False
            if mirrored:
                ends = np.cumsum(sides)
                rows = rows[np.concatenate([np.arange(e - 1, e - n - 1, -1) for e, n in zip(ends, sides, strict=True)] or [[]]).astype(int)]
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


# --- numbers ---


def _floats(words: list, width: int) -> np.ndarray:
    """(n, width) float64 of words, in one row or in rows."""
    return np.array(words, dtype=np.float64).reshape(-1, width)


def _integers(words: list[str]) -> np.ndarray:
    try:
        return np.array(words, dtype=np.int64)
    except ValueError:
        return _whole(np.array(words, dtype=np.float64))  # "3.0" is a whole number, too


def _whole(values: np.ndarray) -> np.ndarray:
    if not np.all(np.abs(values) < 2.0**53) or np.any(values != np.floor(values)):
        raise Damaged("what must be whole numbers are none")
    return values.astype(np.int64)


READERS = {
    ".msh": _msh, ".vtk": _meshio, ".vtu": _meshio, ".mesh": _medit, ".node": _tetgen, ".ele": _tetgen,
    ".obj": _obj, ".ply": _ply, ".stl": _stl, ".off": _off, ".glb": _glb,
    ".npz": _npz, ".usd": _usd, ".usda": _usd, ".usdc": _usd,
}  # fmt: skip
