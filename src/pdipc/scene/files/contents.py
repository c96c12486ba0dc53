"""What a mesh file holds, as it is written, before anything is cut."""

import codecs
import difflib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pdipc.scene.errors import SceneError

LISTED = 10  # parts of a file that a message names
# Corners of each kind of cell; the further vertices of cells of higher order follow them.
CORNERS = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
ORDER_AS_HEXAHEDRON = {"pixel": ("quad", [0, 1, 3, 2]), "voxel": ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6])}


@dataclass
class Contents:
    """What a mesh file holds.

    points: (n, 3); where it holds frames, those of the first. frames: (f, n, 3), and times: (f,) s, where it says them. cells: kind, as in `CORNERS`, and vertices (c, k). polygons: corners one after another, and corners of each.
    notes: what was left out or converted, a sentence each. repeats: whether the format writes shared vertices several times.
    """

    points: np.ndarray
    cells: list[tuple[str, np.ndarray]] = field(default_factory=list)
    polygons: tuple[np.ndarray, np.ndarray] = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    notes: list[str] = field(default_factory=list)
    repeats: bool = False
    frames: np.ndarray | None = None
    times: np.ndarray | None = None


class Damaged(ValueError):
    """A file that does not hold what its format says."""


def lines_left_out(count: int) -> str:
    """The note for lines between vertices, such as the sewing lines of a garment."""
    return f"{count} lines were left out; springs along them can be given as attachments with pairs"


def first_of(count: int) -> str:
    """The note for what moves and is wanted at one time."""
    return f"it moves or deforms at {count} times: it was read as it is at the start"


def no_such(path: Path, what: str, wanted: str, meshes: list[str]) -> SceneError:
    """That a file has no part, a prim or an object, of that name. meshes: the names of those that are."""
    near = difflib.get_close_matches(wanted, meshes, n=1)
    hint = f'; did you mean "{near[0]}"?' if near else ";"
    listed = ", ".join(meshes[:LISTED]) + (", ..." if len(meshes) > LISTED else "")
    return SceneError(f'mesh file "{path}": has no {what} "{wanted}"{hint} its meshes are: {listed or "none"}')


def backwards(corners: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The corners of polygons, one after another, with each polygon passed the other way round."""
    ends = np.cumsum(counts)
    within = np.arange(len(corners)) - np.repeat(ends - counts, counts)
    return corners[np.repeat(ends, counts) - 1 - within]


def text_of(path: Path) -> str:
    """The file as text with lines that end in a line feed: UTF-8 with or without a mark, or UTF-16 with one; other bytes are replaced."""
    data = path.read_bytes()
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def floats(words: list, width: int) -> np.ndarray:
    """(n, width) float64 of words, in one row or in rows."""
    return np.array(words, dtype=np.float64).reshape(-1, width)


def integers(words: list[str]) -> np.ndarray:
    """(n,) int64 of words. Raises Damaged where they are no whole numbers."""
    try:
        return np.array(words, dtype=np.int64)
    except ValueError:
        return whole(np.array(words, dtype=np.float64))  # "3.0" is a whole number, too


def whole(values: np.ndarray) -> np.ndarray:
    """The values as int64. Raises Damaged where they are no whole numbers."""
    if not np.all(np.abs(values) < 2.0**53) or np.any(values != np.floor(values)):
        raise Damaged("what must be whole numbers are none")
    return values.astype(np.int64)
