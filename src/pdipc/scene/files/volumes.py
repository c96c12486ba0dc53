"""The formats of volume meshes: Gmsh, Medit and TetGen."""

import re
from pathlib import Path
from typing import Literal

import numpy as np

from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import Contents, Damaged, floats, integers, text_of, whole

GMSH_KINDS = {  # element types of Gmsh: what they are, and their number of vertices
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8), 6: ("wedge", 6),
    7: ("pyramid", 5), 8: ("line", 3), 9: ("triangle", 6), 10: ("quad", 9), 11: ("tetra", 10), 12: ("hexahedron", 27),
    13: ("wedge", 18), 14: ("pyramid", 14), 15: ("vertex", 1), 16: ("quad", 8), 17: ("hexahedron", 20), 18: ("wedge", 15),
    19: ("pyramid", 13), 20: ("triangle", 9), 21: ("triangle", 10), 22: ("triangle", 12), 23: ("triangle", 15),
    24: ("triangle", 15), 25: ("triangle", 21), 26: ("line", 4), 27: ("line", 5), 28: ("line", 6), 29: ("tetra", 20),
    30: ("tetra", 35), 31: ("tetra", 56), 36: ("quad", 16), 37: ("quad", 25), 38: ("quad", 36), 92: ("hexahedron", 64),
    93: ("hexahedron", 125),
}  # fmt: skip


HEAD = re.compile(rb"\s*\$MeshFormat\s+(2(?:\.\d+)?|4(?:\.[01])?)\s+([01])\s+(\d+)[^\n]*\n")


def is_gmsh(path: Path) -> bool:
    """Whether a file that calls itself .msh is one of Gmsh."""
    with open(path, "rb") as file:
        return file.read(200).lstrip().startswith(b"$")


def is_known(path: Path) -> bool:
    """Whether `msh` reads a file that calls itself .msh."""
    with open(path, "rb") as file:
        return HEAD.match(file.read(4096)) is not None


def msh(path: Path) -> Contents:
    """Gmsh, versions 2.x, 4.0 and 4.1, text or binary."""
    data = path.read_bytes()
    head = HEAD.match(data)
    if head is None:
        raise Damaged("it does not begin with $MeshFormat of version 2 or 4")
    version, binary, size = head[1].decode("ascii"), head[2] == b"1", int(head[3])
    order: Literal["<", ">"] = "<"
    if binary and int.from_bytes(data[head.end() : head.end() + 4], "little") != 1:
        order = ">"
    if binary and size not in (4, 8):
        raise Damaged(f"its numbers have {size} bytes; needed: 4 or 8")

    def section(*names: str) -> tuple[str, "_Words | _Bytes"]:
        for name in names:
            begin = re.search(rb"\$" + name.encode() + rb"[ \t\r]*\n", data)
            if begin and re.search(rb"^\$" + name.encode() + rb"[ \t\r]*\n", data[begin.end() :], re.MULTILINE):
                raise Damaged(f"it has more than one ${name}")
            if begin:
                end = data.find(b"$End" + name.encode(), begin.end())
                inside = data[begin.end() : None if end < 0 or binary else end]
                return name, _Bytes(inside, name, order, f"u{size}") if binary else _Words(inside, name)
        raise Damaged(f"it has no ${names[0]}")

    (name, nodes), (_, elements) = section("Nodes", "ParametricNodes"), section("Elements")
    if version.startswith("4"):
        older = version != "4.1"
        numbers, points = (_nodes_40 if older else _nodes_4)(nodes)
        cells = _elements_4(elements, older)
    else:
        numbers, points = _nodes_2(nodes, parametric=name == "ParametricNodes")
        cells = _elements_2(elements)
    return Contents(points, [(kind, _places(numbers, named, "an element")) for kind, named in cells])


def _nodes_4(take: "_Words | _Bytes") -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) and points (n, 3) of Gmsh 4.1."""
    numbers, points = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for _ in range(take.sizes(4)[0]):
        dimension, _, parametric = take.ints(3)
        count = take.sizes(1)[0]
        numbers.append(take.sizes(count))
        points.append(take.reals(count, 3 + (dimension if parametric else 0))[:, :3])
    return np.concatenate(numbers), np.concatenate(points)


def _nodes_40(take: "_Words | _Bytes") -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) and points (n, 3) of Gmsh 4.0, where each node is a row of its own."""
    numbers, points = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for _ in range(take.sizes(2)[0]):
        _, dimension, parametric = take.ints(3)
        number, point = take.numbered(take.sizes(1)[0], dimension if parametric else 0)
        numbers.append(number)
        points.append(point)
    return np.concatenate(numbers), np.concatenate(points)


def _elements_4(take: "_Words | _Bytes", older: bool) -> list[tuple[str, np.ndarray]]:
    """Cells of Gmsh 4.1; older: of 4.0."""
    cells = []
    for _ in range(take.sizes(2 if older else 4)[0]):
        kind, corners = _gmsh_kind(take.ints(3)[2])
        count = take.sizes(1)[0]
        rows = (take.ints if older else take.sizes)(count * (1 + corners))
        cells.append((kind, rows.reshape(-1, 1 + corners)[:, 1:]))
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
        return integers(self.take(count))

    def count(self) -> int:
        return int(self.take(1)[0])

    sizes = ints

    def reals(self, count: int, width: int) -> np.ndarray:
        """(count, width)."""
        if count < 0 or width < 0:
            raise Damaged(f"{self.name} says {count} rows of {width}")
        return floats(self.take(count * width), width) if width else np.zeros((count, 0))

    def numbered(self, count: int, more: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Rows of a number and three coordinates, and of `more` numbers that are left out."""
        if not 0 <= more <= 3:
            raise Damaged(f"{self.name} says that nodes have {more} parameters")
        words = self.take((4 + more) * count)
        rows = floats(words, 4 + more)
        return integers(words[:: 4 + more]), rows[:, 1:4]


class _Bytes:
    """What a section says as bytes, from its begin on."""

    def __init__(self, data: bytes, name: str, order: Literal["<", ">"], size: str):
        self.data, self.at, self.name, self.size = data, 0, name, size
        self.order: Literal["<", ">"] = order

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

    def numbered(self, count: int, more: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Rows of a number and three coordinates, and of `more` numbers that are left out."""
        if not 0 <= more <= 3:
            raise Damaged(f"{self.name} says that nodes have {more} parameters")
        rows = self.take([("number", "i4"), ("point", "f8", 3), ("more", "f8", (int(more),))], count)
        return rows["number"].astype(np.int64), rows["point"].astype(np.float64)


MEDIT_KINDS = {  # keywords of Medit: what they are, and their number of vertices
    "Vertices": ("vertex", 0), "Edges": ("line", 2), "EdgesP2": ("line", 3), "Triangles": ("triangle", 3),
    "TrianglesP2": ("triangle", 6), "Quadrilaterals": ("quad", 4), "QuadrilateralsQ2": ("quad", 9),
    "Tetrahedra": ("tetra", 4), "TetrahedraP2": ("tetra", 10), "Hexahedra": ("hexahedron", 8), "Hexaedra": ("hexahedron", 8),
    "HexahedraQ2": ("hexahedron", 27), "Prisms": ("wedge", 6), "Pentahedra": ("wedge", 6), "Pyramids": ("pyramid", 5),
}  # fmt: skip


MEDIT_HIGHER = re.compile(r"(edges|triangles|quadrilaterals|tetrahedra|hexahedra|prisms|pyramids)[pq]\d")  # but for those above


def medit(path: Path) -> Contents:
    """Medit's text format: keywords, each with a count and rows; white space of every kind counts alike."""
    take = _Words(re.sub(r"#[^\n]*", "", text_of(path)).encode(), "the file")
    dimension, points, cells, notes = 3, None, [], []
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
        elif MEDIT_HIGHER.fullmatch(word):
            notes.append(f"{take.count()} cells of the kind {word} were left out")
        # what any other keyword says are numbers, which are passed over
    if points is None:
        raise Damaged("it has no Vertices")
    return Contents(points, cells, notes=notes)


def tetgen(path: Path) -> Contents:
    def rows(file: Path) -> tuple[np.ndarray, list[str]]:
        if not file.is_file():
            raise SceneError(f'mesh file "{path}": needs "{file.name}" beside it')
        lines = [line.split("#")[0].split() for line in text_of(file).split("\n")]
        lines = [line for line in lines if line]
        count = int(lines[0][0]) if lines else 0
        if count < 1:
            raise Damaged(f'"{file.name}" says {count} rows')
        if len(lines) <= count:
            raise SceneError(f'mesh file "{file}": its first line says {count} rows, and {len(lines) - 1} are there')
        return np.array([[float(x) for x in line] for line in lines[1 : count + 1]]), lines[0]

    (nodes, _), (elements, head) = rows(path.with_suffix(".node")), rows(path.with_suffix(".ele"))
    if nodes.ndim != 2 or nodes.shape[1] < 4 or elements.ndim != 2 or elements.shape[1] < 5:
        raise Damaged("its rows must be: number, x, y, z; and: number, four or ten vertices")
    corners = 10 if elements.shape[1] >= 11 and head[1:2] == ["10"] else 4  # attributes may follow
    named = whole(elements[:, 1 : 1 + corners])
    return Contents(nodes[:, 1:4], [("tetra", _places(whole(nodes[:, 0]), named, "a tet"))])


def _places(numbers: np.ndarray, named: np.ndarray, what: str) -> np.ndarray:
    """Rows of the nodes that are named by their numbers. Raises Damaged for numbers that are there twice, or not at all."""
    sorting = np.argsort(numbers, kind="stable")
    ascending = numbers[sorting]
    if np.any(ascending[1:] == ascending[:-1]):
        raise Damaged("two of its nodes have one number")
    place = np.minimum(np.searchsorted(ascending, named), max(0, len(ascending) - 1))
    known = ascending[place] == named if len(ascending) else np.zeros(named.shape, dtype=bool)
    if not known.all():
        raise Damaged(f"{what} names node {named[~known][0]}, which is not there")
    return sorting[place]
