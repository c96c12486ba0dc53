"""Positions of vertices over time: from files with frames, and from files that are one frame each."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdipc.scene import meshes
from pdipc.scene.errors import SceneError
from pdipc.scene.files.contents import Contents
from pdipc.scene.memory import free_memory, gib
from pdipc.scene.worker import Worker


@dataclass
class Frames:
    """points: (f, n, 3) m. times: (f,) s, ascending; the first is 0."""

    points: np.ndarray
    times: np.ndarray


def read_frames(name: str, frame_rate: float | None, worker: Worker | None = None) -> tuple[Frames, Contents]:
    """The frames of a file, or of all files of a pattern such as "body_*.obj", and what the first of them holds beside.

    frame_rate: frames a second, for files that say no times. Raises SceneError where files cannot be read, or do not go together.
    """
    if "*" in name:
        points, contents = _sequence(name, worker)
        return timed(points, None, frame_rate, f'cache "{name}"'), contents
    path = meshes.locate(name)
    contents = meshes.contents(path, worker, frames=True)
    where = f'cache "{path}"'
    if contents.frames is None:
        raise SceneError(
            f"{where}: holds one frame only; needed: several, in .npz as V (frames, n, 3), in USD and Alembic as time samples"
        )
    return timed(contents.frames, contents.times, frame_rate, where), contents


def timed(points: np.ndarray, times: np.ndarray | None, frame_rate: float | None, where: str) -> Frames:
    """Frames at their times, or at a rate. Raises SceneError where they are not as `Frames` says."""
    if points.ndim != 3 or points.shape[2] != 3 or points.dtype.kind not in "iuf":
        raise SceneError(
            f"{where}: frames have the shape {points.shape} and are {points.dtype}; they must be numbers (frames, n, 3)"
        )
    if frame_rate is not None:
        times = np.arange(len(points)) / frame_rate
    elif times is None:
        raise SceneError(f"{where}: says no times; give the frames a second as frame_rate")
    times = np.asarray(times)
    if times.shape != points.shape[:1] or times.dtype.kind not in "iuf":
        raise SceneError(f"{where}: holds {len(points)} frames and times of the shape {times.shape}; each frame needs one")
    if not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise SceneError(f"{where}: times must be numbers in ascending order")
    for number, frame in enumerate(points):  # one by one: a cache may fill the memory
        if not np.isfinite(frame).all():
            vertex = int(np.argmin(np.isfinite(frame).all(axis=1)))
            raise SceneError(f"{where}: frame {number}, vertex {vertex} = {frame[vertex].tolist()} is not finite")
    return Frames(points, times - times[0])


def _sequence(pattern: str, worker: Worker | None) -> tuple[np.ndarray, Contents]:
    """(f, n, 3) points of files in the order of the numbers in their names, and what the first holds."""
    where = Path(pattern)
    try:
        paths = sorted(where.parent.glob(where.name), key=_by_number)
    except (OSError, ValueError, NotImplementedError) as error:
        raise SceneError(f'cache "{pattern}": is no pattern of files: {error}') from error
    if len(paths) < 2:
        raise SceneError(f'cache "{pattern}": {len(paths)} files go by this pattern; needed: at least two frames')
    first = meshes.contents(paths[0], worker)
    needed, free = len(paths) * first.points.size * 8, free_memory()
    if needed > free:
        raise SceneError(f'cache "{pattern}": {len(paths)} frames need {gib(needed)} of memory, and {gib(free)} are free')
    points = np.empty((len(paths), *first.points.shape))
    for number, path in enumerate(paths):
        one = meshes.contents(path, worker)
        if not _alike(one, first):
            raise SceneError(f'cache "{pattern}": "{path.name}" has other vertices or faces than "{paths[0].name}"')
        points[number] = one.points
    return points, first


def _alike(one: Contents, other: Contents) -> bool:
    """Whether two files have as many vertices, and the same cells and polygons."""
    tables = [[*contents.polygons, *(rows for _, rows in contents.cells)] for contents in (one, other)]
    same = [np.array_equal(a, b) for a, b in zip(*tables, strict=False)]
    return one.points.shape == other.points.shape and len(tables[0]) == len(tables[1]) and all(same)


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Key of the order that people expect: frame_9 before frame_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
