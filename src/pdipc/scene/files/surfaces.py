"""NumPy archives, and the formats of surfaces: Wavefront OBJ, OFF, STL and PLY."""

import itertools
import re
import struct
import zipfile
from pathlib import Path

import numpy as np

from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import Contents, Damaged, floats, lines_left_out, text_of, whole
from pdipc.scene.memory import free_memory, gib

ARRAYS_OF_WORK = 4  # times as much memory as its arrays take to make a mesh of them


def npz(path: Path) -> Contents:
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > 100 * path.stat().st_size + 2**30:
        raise Damaged(f"it would unpack to {gib(size)}")
    if ARRAYS_OF_WORK * size > free_memory():
        raise SceneError(
            f'mesh file "{path}": needs about {gib(ARRAYS_OF_WORK * size)} of memory, and {gib(free_memory())} are free'
        )
    with np.load(path) as data:
        if "V" not in data:
            raise SceneError(f'mesh file "{path}": holds {list(data)}; needed: V and T (tets), F (triangles) or L (lines)')
        cells = [(kind, data[name]) for kind, name in (("tetra", "T"), ("triangle", "F"), ("line", "L")) if name in data]
        vertices = data["V"]
        if vertices.dtype.kind not in "iuf":
            raise SceneError(f'mesh file "{path}": V holds {vertices.dtype}; it must hold real numbers')
        if vertices.ndim != 3 or not len(vertices):
            return Contents(vertices, cells)
        return Contents(vertices[0], cells, frames=vertices, times=data.get("times"))


def obj(path: Path) -> Contents:
    """Wavefront OBJ: v, f and l; indices count from 1, or back from the last vertex so far."""
    points, corners, counts, lines, others = [], [], [], [], set()

    def index(value: str, number: int) -> int:
        found = int(value.partition("/")[0])
        if found == 0 or found < -len(points):
            raise Damaged(f"line {number} names vertex {found}; vertices count from 1, or back from -1")
        return found - 1 if found > 0 else len(points) + found

    text = text_of(path).replace("\\\n", " ")
    for number, line in enumerate(text.split("\n"), 1):
        key, *values = line.partition("#")[0].split() or [""]
        if key == "v":
            if len(values) < 3:
                raise Damaged(f"line {number} has {len(values)} coordinates of a vertex; needed: 3")
            points.append(values[:3])
        elif key == "f":
            if len(values) < 3:
                raise Damaged(f"line {number} has a face of {len(values)} vertices; needed: at least 3")
            counts.append(len(values))
            for value in values:
                corners.append(index(value, number))
        elif key == "l":
            chain = [index(value, number) for value in values]
            lines += itertools.pairwise(chain)
        elif key in ("p", "curv", "curv2", "surf"):
            others.add(key)
    cells = [("line", np.array(lines, dtype=np.int64))] if lines else []
    found = Contents(floats(points, 3), cells, (np.array(corners, dtype=np.int64), np.array(counts, dtype=np.int64)))
    if others:
        found.notes.append(f"elements other than faces were left out: {', '.join(sorted(others))}")
    return found


def off(path: Path) -> Contents:
    """Object File Format, as text: a line for each vertex, which may say a normal or a colour, too, and for each face."""
    text = re.sub(r"#[^\n]*", "", text_of(path))
    rows = [row for row in (line.split() for line in text.split("\n")) if row]
    if not rows or not re.fullmatch(r"(ST)?C?N?OFF", rows[0][0]):
        raise Damaged(f'it begins with "{text.strip()[:20]}"; needed: OFF')
    if "BINARY" in rows[0]:
        raise Damaged("it is binary; only text is read")
    head, rows = (rows[0][1:], rows[1:]) if len(rows[0]) > 1 else (rows[1] if len(rows) > 1 else [], rows[2:])
    n, faces = (int(word) for word in [*head, "0", "0"][:2])
    if n < 0 or faces < 0 or len(rows) < n + faces:
        raise Damaged(f"its head says {n} vertices and {faces} faces, and {len(rows)} lines follow")
    if any(len(row) < 3 for row in rows[:n]):
        raise Damaged("a vertex has fewer than three coordinates")
    polygons = [(int(row[0]), row) for row in rows[n : n + faces]]
    if any(not 0 <= size < len(row) for size, row in polygons):
        raise Damaged("a face has fewer vertices than it says")
    corners = [int(index) for size, row in polygons for index in row[1 : 1 + size]]
    counts = np.array([size for size, _ in polygons], dtype=np.int64)
    return Contents(floats([row[:3] for row in rows[:n]], 3), polygons=(np.array(corners, dtype=np.int64), counts))


def stl(path: Path) -> Contents:
    """Stereolithography, text or binary: triangles without shared vertices."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + 50 * count:
        facets = np.frombuffer(data, dtype=[("head", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")], offset=84)
        points = facets["corners"].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        text = data.decode("ascii", errors="replace").replace("\r", "\n")
        named = re.sub(r"^[ \t]*(end)?solid\b[^\n]*", "", text, flags=re.IGNORECASE | re.MULTILINE)
        words = (named if "facet" in named.lower() else text).split()  # a name may have any words in it
        at = [k for k, word in enumerate(words) if word.lower() == "vertex"]
        points = floats([words[k + 1 : k + 4] for k in at], 3)
        loops = sum(word.lower() == "outer" for word in words)
        if len(points) != 3 * loops:
            raise Damaged(f"it holds {len(points)} vertices in {loops} loops; needed: three in each")
    else:
        raise Damaged(f"its head says {count} triangles, {84 + 50 * count} bytes, and it has {len(data)} bytes")
    return Contents(points, [("triangle", np.arange(len(points)).reshape(-1, 3))], repeats=True)


PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


def ply(path: Path) -> Contents:
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
        elif count:
            notes.append(f"{count} elements of the kind {name[:40]} were left out")
    return Contents(points, polygons=polygons, notes=notes)


class _PlyText:
    """Elements of a PLY file one after another, as words."""

    def __init__(self, data: bytes):
        self.words, self.at = data.decode("ascii", errors="replace").split(), 0

    def element(self, name: str, count: int, properties: list) -> tuple[dict, dict]:
        """Columns of single values (count,) and of lists (all values, counts), by property."""
        if all(of_count is None for _, of_count, _ in properties):
            width = len(properties)
            table = floats(self._take(count * width, name), width) if width else np.zeros((count, 0))
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
        lists = {own: (whole(numbers.pop(own)), np.array(sizes, dtype=np.int64)) for own, sizes in counts.items()}
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
