"""VTK's formats: the legacy one (.vtk), and XML (.vtu, .vtp), as text or binary, compressed or not. Cells of every kind come out, or are told of.

(meshio leaves out what it does not know, such as voxels and strips of triangles, and reads no surfaces of .vtk.)
"""

import base64
import binascii
import lzma
import re
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import numpy as np

from pdipc.scene.files.contents import ORDER_AS_HEXAHEDRON, Contents, Damaged, floats, integers
from pdipc.scene.memory import gib

FIXED = {  # cells with a given number of vertices, by their number in VTK: what they are, and how many
    1: ("vertex", 1), 3: ("line", 2), 5: ("triangle", 3), 8: ("pixel", 4), 9: ("quad", 4), 10: ("tetra", 4), 11: ("voxel", 8),
    12: ("hexahedron", 8), 13: ("wedge", 6), 14: ("pyramid", 5), 21: ("line", 3), 22: ("triangle", 6), 23: ("quad", 8),
    24: ("tetra", 10), 25: ("hexahedron", 20), 26: ("wedge", 15), 27: ("pyramid", 13), 28: ("quad", 9), 29: ("hexahedron", 27),
    30: ("quad", 6), 31: ("wedge", 12), 32: ("wedge", 18), 33: ("hexahedron", 24), 34: ("triangle", 7), 35: ("line", 4),
    37: ("pyramid", 19),
}  # fmt: skip
ARBITRARY = ("line", "triangle", "quad", "tetra", "hexahedron", "wedge", "pyramid")
FREE = {68 + k: kind for k, kind in enumerate(ARBITRARY)} | {75 + k: kind for k, kind in enumerate(ARBITRARY)}  # of any order
POLY_VERTEX, POLY_LINE, STRIP, POLYGON = 2, 4, 6, 7
SURFACE = {"VERTICES": POLY_VERTEX, "LINES": POLY_LINE, "POLYGONS": POLYGON, "TRIANGLE_STRIPS": STRIP}
XML_SURFACE = {"Verts": POLY_VERTEX, "Lines": POLY_LINE, "Polys": POLYGON, "Strips": STRIP}
LEGACY_TYPES = {
    "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4", "unsigned_int": "u4", "long": "i8",
    "unsigned_long": "u8", "float": "f4", "double": "f8", "vtkidtype": "i4", "vtktypeint64": "i8", "vtktypeint32": "i4",
}  # fmt: skip
XML_TYPES = {f"{name}{bits}": f"{name[0].lower()}{bits // 8}" for name in ("Int", "UInt") for bits in (8, 16, 32, 64)}
XML_TYPES |= {"Float32": "f4", "Float64": "f8"}


def _sort(found: Contents, kinds: np.ndarray, corners: np.ndarray, ends: np.ndarray) -> None:
    """Adds cells to what was found. kinds: (c,) by VTK's numbers; corners: vertices of all, one after another; ends: (c,) where each ends."""
    sizes = np.diff(ends, prepend=0)
    if len(kinds) != len(ends) or sizes.min(initial=0) < 0 or (len(ends) and ends[-1] != len(corners)):
        raise Damaged(
            f"it has {len(kinds)} kinds of cells, {len(ends)} cells and {len(corners)} corners, which do not fit together"
        )
    polygons = []
    for kind in dict.fromkeys(kinds.tolist()):  # each once, in their order
        which = np.flatnonzero(kinds == kind)
        for size in dict.fromkeys(sizes[which].tolist()):
            these = which[sizes[which] == size]
            rows = corners[ends[these, None] - size + np.arange(size)]
            if kind == POLYGON:
                polygons.append((rows.ravel(), np.full(len(rows), size)))
            elif kind in FIXED:
                name, needed = FIXED[kind]
                if size != needed:
                    raise Damaged(f"a {name} has {size} vertices; needed: {needed}")
                name, order = ORDER_AS_HEXAHEDRON.get(name, (name, list(range(size))))
                found.cells.append((name, rows[:, order]))
            elif kind in FREE:
                found.cells.append((FREE[kind], rows))
            elif kind == POLY_LINE:
                found.cells += [("line", rows[:, k : k + 2]) for k in range(size - 1)]
            elif kind == STRIP:  # every second triangle is turned
                found.cells += [("triangle", rows[:, [k, k + 1 + k % 2, k + 2 - k % 2]]) for k in range(size - 2)]
            elif kind == POLY_VERTEX:
                found.cells.append(("vertex", rows.reshape(-1, 1)))
            elif kind != 0:
                found.notes.append(f"{len(rows)} cells of VTK's kind {kind} were left out")
    if polygons:
        corners, counts = (
            np.concatenate([old, *new]) for old, new in zip(found.polygons, zip(*polygons, strict=True), strict=True)
        )
        found.polygons = corners, counts


# --- legacy ---


def is_known(path: Path) -> bool:
    """Whether `legacy` reads a file that calls itself .vtk; grids without cells of their own are left to others."""
    with open(path, "rb") as file:
        return re.search(rb"\n\s*DATASET\s+(UNSTRUCTURED_GRID|POLYDATA)\b", file.read(2048), re.IGNORECASE) is not None


class _Legacy:
    """Lines and numbers of a legacy file, from where the last ones ended."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0
        version = re.match(r"# vtk DataFile Version (\d+)", self.line(), re.IGNORECASE)
        if version is None:
            raise Damaged("it does not begin with # vtk DataFile Version")
        self.version = int(version[1])
        self.raw_line()  # the title, which may be empty
        form = self.line().upper()
        if form not in ("ASCII", "BINARY"):
            raise Damaged(f'its third line is "{form[:20]}"; needed: ASCII or BINARY')
        self.binary = form == "BINARY"

    def raw_line(self) -> str:
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        line, self.at = self.data[self.at : end], end + 1
        return line.decode("utf-8", errors="replace").strip()

    def line(self) -> str:
        """The next line that is not empty; "" at the end."""
        while self.at < len(self.data):
            if line := self.raw_line():
                return line
        return ""

    def array(self, count: int, kind: str) -> np.ndarray:
        """(count,) numbers of a type by its name."""
        name = LEGACY_TYPES.get(kind.lower())
        if name is None or count < 0:
            raise Damaged(f"{count} numbers of the type {kind} cannot be read")
        if self.binary:
            size = count * np.dtype(name).itemsize
            values = (
                np.frombuffer(self.data[self.at : self.at + size], dtype=f">{name}")[:count] if count else np.zeros(0, name)
            )
            self.at += size
        else:
            words = self.data[self.at :].split(None, min(count, len(self.data)))
            self.at = len(self.data) - (len(words[count]) if len(words) > count else 0)
            texts = [word.decode("ascii", errors="replace") for word in words[:count]]
            values = floats(texts, 1).ravel() if name[0] == "f" else integers(texts) if texts else np.zeros(0, dtype=np.int64)
        if len(values) < count:
            raise Damaged(f"it ends before the {count} numbers that it says")
        return values.astype(np.float64 if name[0] == "f" else np.int64)

    def cells(self, number: int, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Corners, one after another, and where those of each cell end."""
        if self.version >= 5:
            parts = []
            for name, count in (("OFFSETS", number), ("CONNECTIVITY", size)):
                words = self.line().split()
                if len(words) != 2 or words[0].upper() != name:
                    raise Damaged(f'it has "{" ".join(words)[:40]}" where {name} must be')
                parts.append(self.array(count, words[1]))
            return parts[1], parts[0][1:]
        numbers, at, heads = self.array(size, "int"), 0, []
        for _ in range(number):
            if at >= size or not 0 <= numbers[at] < size - at:
                raise Damaged("its cells do not have the vertices that they say")
            heads.append(at)
            at += 1 + int(numbers[at])
        if at != size:
            raise Damaged(f"its {number} cells have {at} numbers, and it says {size}")
        starts = np.array(heads, dtype=np.int64)
        return np.delete(numbers, starts), np.cumsum(numbers[starts])


def legacy(path: Path) -> Contents:
    """Unstructured grids and surfaces of the legacy format, up to version 5."""
    file = _Legacy(path.read_bytes())
    found, cells, kinds = Contents(np.zeros((0, 3))), None, None
    while (line := file.line()) and not line.upper().startswith(("POINT_DATA", "CELL_DATA")):
        words = line.split()
        match [words[0].upper(), *words[1:]]:
            case ["DATASET", _]:
                pass
            case ["METADATA"]:
                while file.at < len(file.data) and file.raw_line():
                    pass
            case ["FIELD", _, number]:
                for _ in range(int(number)):
                    _, width, count, kind = file.line().split()
                    file.array(int(width) * int(count), kind)
            case ["POINTS", number, kind]:
                found.points = file.array(3 * int(number), kind).reshape(-1, 3).astype(np.float64)
            case ["CELLS", number, size]:
                cells = file.cells(int(number), int(size))
            case ["CELL_TYPES", number]:
                kinds = file.array(int(number), "int")
            case [name, number, size] if name in SURFACE:
                corners, ends = file.cells(int(number), int(size))
                _sort(found, np.full(len(ends), SURFACE[name]), corners, ends)
            case _:
                raise Damaged(f'"{line[:40]}" is not known here')
    if (cells is None) != (kinds is None):
        raise Damaged("it has no CELLS, or no CELL_TYPES")
    if cells is not None and kinds is not None:
        _sort(found, kinds, *cells)
    return found


# --- XML ---


class _Xml:
    """The arrays of an XML file."""

    def __init__(self, data: bytes):
        appended = re.search(rb"<AppendedData[^>]*?encoding\s*=\s*[\"'](\w+)[\"'][^>]*>\s*_", data)
        self.appended, self.encoding = b"", ""
        if appended:  # raw bytes are no XML
            self.appended, self.encoding = data[appended.end() :], appended[1].decode()
            data = data[: appended.start()] + b"</VTKFile>"
        try:
            self.root = ElementTree.fromstring(data)
        except ElementTree.ParseError as error:
            raise Damaged(f"it is no XML: {error}") from error
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self.head = np.dtype(self.order + XML_TYPES.get(self.root.get("header_type", "UInt32"), "u4"))
        compressor = self.root.get("compressor")
        if compressor not in (None, "vtkZLibDataCompressor", "vtkLZMADataCompressor"):
            raise Damaged(f"it is compressed by {compressor}; write it with vtkZLibDataCompressor, or without")
        self.compressor = compressor

    def array(self, element: ElementTree.Element) -> np.ndarray:
        """Numbers of a DataArray, float64 or int64."""
        kind, form = XML_TYPES.get(element.get("type", "")), element.get("format", "ascii")
        if kind is None:
            raise Damaged(f'a DataArray has the type "{element.get("type")}"')
        if form == "ascii":
            words = (element.text or "").split()
            values = floats(words, 1).ravel() if kind[0] == "f" else integers(words) if words else np.zeros(0)
        else:
            if form == "appended":
                data = self.appended[int(element.get("offset", "0")) :]
                plain = self.encoding == "raw"
                data = data if plain else data.split(b"<", 1)[0]
            else:
                data, plain = (element.text or "").strip().encode(), False
            content = self.uncompressed(data, plain) if self.compressor else self.sized(data, plain)
            size = np.dtype(kind).itemsize
            if len(content) % size:
                raise Damaged(f"a DataArray has {len(content)} bytes, which are no {element.get('type')}")
            values = np.frombuffer(content, dtype=self.order + kind)
        return values.astype(np.float64 if kind[0] == "f" else np.int64)

    def sized(self, data: bytes, plain: bool) -> bytes:
        """Bytes after a head that says how many they are."""
        width = self.head.itemsize
        if not data:
            return b""
        head = data[:width] if plain else self.decoded(data, width)
        end = width + int(np.frombuffer(head, self.head)[0])
        content = data[width:end] if plain else self.decoded(data, end)[width:]
        if len(content) != end - width:
            raise Damaged("a DataArray is shorter than it says")
        return content

    def uncompressed(self, data: bytes, plain: bool) -> bytes:
        """Blocks after a head: how many, the size of each and of the last where that is smaller, and their compressed sizes."""
        width = self.head.itemsize
        if not data:
            return b""

        def numbers(count: int) -> list[int]:
            return np.frombuffer(data[: count * width] if plain else self.decoded(data, count * width), self.head).tolist()

        blocks, size, rest = numbers(3)
        if blocks > len(data):
            raise Damaged(f"a DataArray says that it has {blocks} blocks")
        packed = numbers(3 + blocks)[3:]
        taken = (3 + blocks) * width
        taken = taken if plain else -(-taken // 3) * 4
        content = data[taken : taken + sum(packed)] if plain else self.decoded(data[taken:], sum(packed))
        if (blocks - 1) * size + (rest or size) > 100 * len(data) + 2**30:
            raise Damaged(f"a DataArray would unpack to {gib(blocks * size)}")
        parts, at = [], 0
        for number, length in enumerate(packed):
            whole = rest if number == blocks - 1 and rest else size
            parts.append(self.unpacked(content[at : at + length], whole))
            at += length
        return b"".join(parts)

    def unpacked(self, block: bytes, size: int) -> bytes:
        try:
            if self.compressor == "vtkZLibDataCompressor":
                content = zlib.decompressobj().decompress(block, size + 1)
            else:
                content = lzma.LZMADecompressor().decompress(block, size + 1)
        except (zlib.error, lzma.LZMAError, OverflowError) as error:
            raise Damaged(f"a block cannot be decompressed: {error}") from error
        if len(content) != size:
            raise Damaged(f"a block has {len(content)} bytes, and its head says {size}")
        return content

    def decoded(self, text: bytes, count: int) -> bytes:
        """The first `count` bytes of text in base 64."""
        try:
            content = base64.b64decode(text[: -(-count // 3) * 4], validate=True)
        except binascii.Error as error:
            raise Damaged(f"a DataArray is not in base 64: {error}") from error
        if len(content) < count:
            raise Damaged("a DataArray is shorter than it says")
        return content[:count]


def xml(path: Path) -> Contents:
    """Unstructured grids (.vtu) and surfaces (.vtp), all pieces of them."""
    file = _Xml(path.read_bytes())
    grid = next((each for each in file.root if each.tag in ("UnstructuredGrid", "PolyData")), None)
    if grid is None:
        raise Damaged(f'it holds "{file.root.get("type")}"; needed: UnstructuredGrid or PolyData')
    found, count = Contents(np.zeros((0, 3))), 0
    for piece in grid.iter("Piece"):
        points = piece.find("Points/DataArray")
        if points is None:
            continue
        width = int(points.get("NumberOfComponents", "3"))
        places = file.array(points)
        if width not in (1, 2, 3) or len(places) % width:
            raise Damaged(f"{len(places)} coordinates are no points of {width}")
        places = np.pad(places.reshape(-1, width), ((0, 0), (0, 3 - width))).astype(np.float64)
        found.points = np.concatenate([found.points, places])
        for table in piece:
            if table.tag != "Cells" and table.tag not in XML_SURFACE:
                continue
            arrays = {each.get("Name"): file.array(each) for each in table.iter("DataArray")}
            corners, ends = (arrays.get(name, np.zeros(0, dtype=np.int64)) for name in ("connectivity", "offsets"))
            kinds = arrays.get("types", np.zeros(0)) if table.tag == "Cells" else np.full(len(ends), XML_SURFACE[table.tag])
            if len(corners) and (corners.min() < 0 or corners.max() >= len(places)):
                raise Damaged(f"a cell names a vertex out of range; indices must be 0 to {len(places) - 1}")
            _sort(found, kinds.astype(np.int64), corners.astype(np.int64) + count, ends.astype(np.int64))
        count += len(places)
    return found
