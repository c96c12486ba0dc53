"""run.vtkhdf: the frames of a run in VTK's own format for meshes over time, which ParaView (5.12 or newer) opens as it is.

VTKHDF 2.0, an UnstructuredGrid with Steps (docs.vtk.org, "VTKHDF format specification"): cells are stored once, and every step
refers to them; a step adds its points alone, one chunk of HDF5.

The file is derived from frames/*.npy and may be lost at any time. It is written in HDF5's format of 1.10, which marks a file that
is open for writing: one that a kill left half-written is refused by every reader, and `update` writes it anew.
"""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np

CELL_TYPES = {"tetra": 10, "triangle": 5, "line": 3}  # VTK's numbers
# without locks: a run goes on while a reader holds the file, and what was written stays where it is
OPENED = {"libver": ("v110", "v110"), "locking": False}
DAMAGED = (OSError, KeyError, ValueError, RuntimeError)  # what h5py raises, by the place of the damage
STEPS_PER_CHUNK = 1024  # of the small arrays with an entry per step
SLACK = 1 << 18  # bytes that HDF5 takes beyond the arrays, at most


def cells(topology: dict[str, np.ndarray]) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """What is drawn: the tets of solids, the triangles of cloth and obstacles, the lines of rods. Kind, vertices (k, 2 to 4), body (k,)."""
    of_vertex, triangles = topology["body_of_vertex"], topology["triangles"]
    kind = np.asarray(topology["body_kinds"])[of_vertex[triangles[:, 0]]]
    surfaces, lines = triangles[(kind != "solid") & (kind != "rod")], triangles[kind == "rod", :2]
    elements = {"tetra": topology["tets"], "triangle": surfaces, "line": lines}
    return [(kind, found, of_vertex[found[:, 0]].astype(np.int32)) for kind, found in elements.items() if len(found)]


def update(path: Path, topology: dict[str, np.ndarray], real: str, times: np.ndarray, frames: list[Path]) -> None:
    """Appends to the file the frames it lacks; writes it anew where it is missing, damaged, or holds what the run does not.

    real: "float32" or "float64", what positions are stored as. times: (k,) s. frames: k .npy files of positions (n, 3), m.
    Raises OSError where there is no room for it: then the file is as it was, or is written anew the next time.
    """
    frame_bytes = 3 * len(topology["body_of_vertex"]) * np.dtype(real).itemsize
    if _appended(path, times, frames, frame_bytes):
        return
    temporary = path.with_name(path.name + ".tmp")
    try:
        _must_fit(temporary, len(frames) * frame_bytes + 2 * sum(array.nbytes for array in topology.values()) + SLACK)
        with h5py.File(temporary, "w", **OPENED) as file:
            root = file.create_group("VTKHDF")
            _write_mesh(root, topology, real)
            _append(root, times, frames)
        os.replace(temporary, path)
    except DAMAGED as error:
        temporary.unlink(missing_ok=True)
        number, reason = getattr(error, "errno", None), getattr(error, "strerror", None)
        raise OSError(number or errno.EIO, reason or str(error), str(path)) from error


def _must_fit(path: Path, more: int) -> None:
    """Raises OSError where the disk, or a limit on files, has no room for so many more bytes at the end of the file.

    HDF5 does not survive finding that out: it complains on stderr, and keeps what it could not write for later.
    """
    if shutil.disk_usage(path.parent).free < more:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    if not hasattr(os, "posix_fallocate"):
        return
    with open(path, "ab") as file:
        size = file.tell()
        try:
            os.posix_fallocate(file.fileno(), size, more)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # disks that cannot reserve
                raise
        finally:
            file.truncate(size)


def _appended(path: Path, times: np.ndarray, frames: list[Path], frame_bytes: int) -> bool:
    """Brings a file up to date that begins as the run does; False where it does not, by its times and its last frame."""
    try:
        with h5py.File(path, "r+", **OPENED) as file:
            root: Any = file["VTKHDF"]
            size, held = root["NumberOfPoints"][0], root["Steps"].attrs["NSteps"]
            if not np.array_equal(root["Steps/Values"][:held], times[:held]):
                return False
            if not np.array_equal(root["Points"][(held - 1) * size : held * size], np.load(frames[held - 1])):
                return False
            _must_fit(path, (len(frames) - int(held)) * frame_bytes + SLACK)
            _append(root, times, frames)
            return True
    except DAMAGED:
        return False


def _write_mesh(root: h5py.Group, topology: dict[str, np.ndarray], real: str) -> None:
    """All but the points, with no step yet."""
    kinds, elements, bodies = zip(*cells(topology), strict=True)
    corners = np.concatenate([np.full(len(found), found.shape[1]) for found in elements])
    points = len(topology["body_of_vertex"])
    root.attrs["Version"] = np.array([2, 0])
    root.attrs["Type"] = np.bytes_("UnstructuredGrid")
    root["NumberOfPoints"] = np.array([points])
    root["NumberOfCells"] = np.array([len(corners)])
    root["NumberOfConnectivityIds"] = np.array([corners.sum()])
    root["Types"] = np.repeat(np.array([CELL_TYPES[kind] for kind in kinds], np.uint8), [len(found) for found in elements])
    root["Offsets"] = np.concatenate([[0], np.cumsum(corners)])
    root["Connectivity"] = np.concatenate([found.ravel() for found in elements]).astype(np.int64)
    root["CellData/body"] = np.concatenate(bodies)
    root.create_dataset("Points", (0, 3), real, maxshape=(None, 3), chunks=(points, 3))
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = 0

    def per_step(name: str, dtype: str = "i8", shape: tuple[int, ...] = (), value: int = 0) -> None:
        """An array whose entries are `value` where nothing else is written."""
        sizes = {"maxshape": (None, *shape), "chunks": (STEPS_PER_CHUNK, *shape)}
        steps.create_dataset(name, (0, *shape), dtype, fillvalue=value, **sizes)

    per_step("Values", "f8")
    per_step("PointOffsets")
    per_step("PartOffsets")
    per_step("NumberOfParts", value=1)
    per_step("CellOffsets", shape=(1,))
    per_step("ConnectivityIdOffsets", shape=(1,))
    per_step("CellDataOffsets/body")


def _append(root: Any, times: np.ndarray, frames: list[Path]) -> None:
    """Adds the frames after the last step. NSteps comes last: until then an interrupt leaves the steps there were."""
    points, steps = root["Points"], root["Steps"]
    size = int(root["NumberOfPoints"][0])
    held, count = int(steps.attrs["NSteps"]), len(times)
    points.resize(count * size, axis=0)
    for frame in range(held, count):
        points[frame * size : (frame + 1) * size] = np.load(frames[frame])
    for array in (*(steps[name] for name in steps if name != "CellDataOffsets"), steps["CellDataOffsets/body"]):
        array.resize(count, axis=0)
    steps["Values"][held:] = times[held:]
    steps["PointOffsets"][held:] = np.arange(held, count) * size
    steps.attrs.modify("NSteps", count)
