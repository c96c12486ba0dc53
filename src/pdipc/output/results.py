"""A run as a folder that survives a kill at any moment.

    run.json        what made it: versions, device, precision
    scene.json      the scene as it was read
    topology.npz    triangles, tets, body_of_vertex, scripted, body_names, body_kinds, body_radii
    frames/         000000.npy, ...: positions (n, 3) of each step, m
    stats.jsonl     a line per frame: step, time, statistics of the step
    run.vtkhdf      the same frames for ParaView, up to the last checkpoint
    forces/         000001.npz, ...: forces of contact in each step, see `pdipc.output.forces.ContactForces`
    checkpoints/    the last two states, bit for bit
    segments/       with --certify: the ends of every committed motion
    run.lock        who is writing, while somebody is: see `lock`

Every file is written under a temporary name and then renamed; a frame counts once its line in stats.jsonl is complete.
run.vtkhdf alone grows in place: it is derived from the frames and written anew where a kill damaged it, see `vtkhdf`.
"""

import errno
import importlib
import json
import math
import numbers
import os
import platform
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output import lock
from pdipc.output.forces import ContactForces
from pdipc.output.skins import Skin, skin

FORMAT = 1
FOLDERS = ("frames", "forces", "checkpoints", "segments")
NAMES = {"run.json", "scene.json", "topology.npz", "stats.jsonl", "run.vtkhdf", *FOLDERS, lock.NAME}
CHECKPOINTS_KEPT = 2
NO_ROOM = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC), None}  # None: what NumPy says of a full disk
# what reading a damaged file can raise: RuntimeError where an archive calls itself encrypted or packed in another way, MemoryError where
# an array says that it is huge, TypeError and AttributeError where one kind of file stands in for another
UNREADABLE = (
    *(OSError, ValueError, EOFError, KeyError, TypeError, AttributeError, RuntimeError, MemoryError),
    *(zipfile.BadZipFile, zlib.error),
)


class RunError(RuntimeError):
    """A run folder that cannot be read, resumed or written."""


class RunLockedError(RunError):
    """A run folder that another process is writing."""


class RunWriter:
    """Writes a run, alone: the folder is locked until `close`, or the end of a `with`. Made by `create` or `resume`.

    What cannot be written, as on a full disk, raises RunError; the run goes on from its last checkpoint once there is room.
    """

    def __init__(self, run: "Run", held: lock.Lock):
        self.folder = run.folder
        self.topology = run.topology
        self.real = run.meta.get("precision", "float64")
        self.frames = [(record["step"], record["time"]) for record in run.records]
        self._held = held

    @classmethod
    def create(
        cls, folder: str | Path, scene: str, topology: dict[str, Any], meta: dict[str, Any], overwrite: bool = False
    ) -> "RunWriter":
        """A new run in `folder`. scene: as JSON. topology: arrays and lists by name, see above; meta: plain values.

        Raises RunError where the folder holds a run already, unless `overwrite`, and always where it holds anything else or is being
        written.
        """
        folder = Path(folder)
        with _room(folder):
            if folder.exists() and not folder.is_dir():
                raise RunError(f"{folder} is a file; a run needs a folder")
            present = (
                {entry.name for entry in folder.iterdir() if not entry.name.endswith(".tmp")} if folder.exists() else set()
            )
        # a run whose making was killed has no run.json yet, but a lock; without either, the files are somebody else's
        if foreign := sorted(present - NAMES if present & {"run.json", lock.NAME} else present):
            raise RunError(f'{folder} holds other files, such as "{foreign[0]}"; name a new folder for the run')
        if "run.json" in present and not overwrite:
            raise RunError(f"{folder} holds a run already; go on with --resume, replace it with --overwrite, or name another")
        with _room(folder):
            folder.mkdir(parents=True, exist_ok=True)
        held = _lock(folder)
        try:
            with _room(folder):
                for name in ("run.json", *sorted(present - {"run.json", lock.NAME})):
                    _remove(folder / name)
                for path in folder.glob("*.tmp"):
                    _remove(path)
                for name in ("frames", "checkpoints"):
                    (folder / name).mkdir(exist_ok=True)
                _write_text(folder / "scene.json", scene)
                _write_arrays(folder / "topology.npz", topology)
                _write_text(folder / "stats.jsonl", "")
                _write_text(folder / "run.json", json.dumps({"format": FORMAT, **_versions(), **meta}, indent=2) + "\n")
            return cls(open_run(folder), held)
        except BaseException:
            held.release()
            raise

    @classmethod
    def resume(cls, folder: str | Path) -> "RunWriter":
        """Goes on after the last valid checkpoint of the run in `folder`; what was written after it is dropped. A run that was killed
        before its first step begins again.

        Raises RunError where there is no run or no valid checkpoint, and where it is being written.
        """
        open_run(folder)
        held = _lock(Path(folder))
        try:
            run = open_run(folder)  # as the last writer left it
            checkpoint = _latest_checkpoint(run)
            if checkpoint is None and run.stats:
                raise RunError(f"{folder} has no valid checkpoint to go on from; start again with --overwrite")
            last = -1 if checkpoint is None else checkpoint[0]
            with _room(run.folder):
                kept = [record for record in run.records if record["step"] <= last]
                for record in kept:
                    if not _frame(run.folder, record["step"]).is_file():
                        raise RunError(f"{_frame(run.folder, record['step'])} is not there; start again with --overwrite")
                _write_text(run.folder / "stats.jsonl", "".join(_line(record) for record in kept))
                for path in [*run.folder.glob("*.tmp"), *run.folder.glob("*/*.tmp")]:
                    _remove(path)
                for name in FOLDERS:
                    for path in run.folder.glob(f"{name}/*.np?"):
                        if _step_of(path) > last:
                            _remove(path)
            writer = cls(open_run(folder), held)
            if writer.frames:
                writer._update_vtkhdf()
            return writer
        except BaseException:
            held.release()
            raise

    def close(self) -> None:
        """Lets others write."""
        self._held.release()

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def expects(self, step: int) -> None:
        """Raises RunError where `step` does not follow the last frame."""
        if self.frames and step != self.frames[-1][0] + 1:
            last = self.frames[-1][0]
            raise RunError(f"{self.folder} has frames up to step {last}; step {step} cannot follow: a run has one way")

    def append(
        self,
        step: int,
        time: float,
        positions: np.ndarray,
        stats: dict[str, Any],
        forces: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Adds the frame of `step`: positions (n, 3), m, at `time`, s, and the statistics of the step; forces: those of
        `ContactForces.arrays`.
        """
        positions = np.asarray(positions)
        single = positions.astype(np.float32)
        lossless = np.array_equal(single.astype(np.float64), positions)  # what a float32 simulation gives
        with _room(self.folder):
            _write(_frame(self.folder, step), lambda file: np.save(file, single if lossless else positions))
            if forces is not None:
                (self.folder / "forces").mkdir(exist_ok=True)
                _write_arrays(self.folder / "forces" / f"{step:06d}.npz", forces)
            with open(self.folder / "stats.jsonl", "a", encoding="utf-8") as file:
                file.write(_line({"step": int(step), "time": float(time), **stats}))
        self.frames.append((int(step), float(time)))

    def checkpoint(self, step: int, arrays: dict[str, Any]) -> None:
        """Saves the state after `step`, bit for bit, drops all but the last two, and brings run.vtkhdf up to date."""
        with _room(self.folder):
            folder = self.folder / "checkpoints"
            _write_arrays(folder / f"{step:06d}.npz", arrays)
            for path in sorted(folder.glob("*.npz"), key=_step_of)[:-CHECKPOINTS_KEPT]:
                _remove(path)
        self._update_vtkhdf()

    def _update_vtkhdf(self) -> None:
        """Adds to run.vtkhdf the frames it lacks."""
        from pdipc.output import vtkhdf

        times = np.array([time for _, time in self.frames])
        paths = [_frame(self.folder, step) for step, _ in self.frames]
        with _room(self.folder):
            vtkhdf.update(self.folder / "run.vtkhdf", self.topology, self.real, times, paths)

    def latest_checkpoint(self) -> tuple[int, dict[str, np.ndarray]] | None:
        """Step and arrays of the newest checkpoint that is whole and whose frames are all there; None where there is none."""
        return _latest_checkpoint(open_run(self.folder))

    def append_segments(self, step: int, outer: int, start: np.ndarray, end: np.ndarray) -> None:
        """Records the motion (n, 3) -> (n, 3), m, that outer iteration `outer` of `step` committed."""
        with _room(self.folder):
            (self.folder / "segments").mkdir(exist_ok=True)
            _write_arrays(self.folder / "segments" / f"{step:06d}_{outer:04d}.npz", {"start": start, "end": end})


def _lock(folder: Path) -> lock.Lock:
    try:
        with _room(folder):
            return lock.Lock(folder)
    except lock.LockedError as error:
        raise RunLockedError(str(error)) from None


def resumable_step(run: "Run") -> int:
    """The step that `RunWriter.resume` goes on from; 0, too, where a run begins again."""
    checkpoint = _latest_checkpoint(run)
    return 0 if checkpoint is None else checkpoint[0]


def _latest_checkpoint(run: "Run") -> tuple[int, dict[str, np.ndarray]] | None:
    steps = {record["step"] for record in run.records}
    for path in sorted((run.folder / "checkpoints").glob("*.npz"), key=_step_of, reverse=True):
        try:
            if _step_of(path) in steps:
                return _step_of(path), _read_arrays(path)
        except UNREADABLE:
            continue
    return None


def _frame(folder: Path, step: int) -> Path:
    """The file of the frame after a step."""
    return folder / "frames" / f"{step:06d}.npy"


def _step_of(path: Path) -> int:
    """Of a file of frames, checkpoints or segments; -1 of one that is none."""
    step = path.stem.split("_")[0]
    return int(step) if step.isascii() and step.isdigit() else -1


@contextmanager
def _room(folder: Path) -> Iterator[None]:
    """Turns what the system says of a full disk, a limit or a missing right into RunError."""
    try:
        yield
    except OSError as error:
        name = str(error.filename or folder)
        name = name if len(name) <= 300 else f"{name[:300]}..."
        said = f"{name} cannot be written: {error.strerror or error}"
        if error.errno in NO_ROOM:
            said += "; what there is so far is kept: make room, then go on with --resume"
        raise RunError(said) from error


class Run:
    """A run that was written, or is being written; opened by `open_run`.

    folder: where it is. meta: versions, device, precision. scene: the scene as a dict, see `pdipc.scene.schema.Scene`.
    topology: arrays by name. records: a dict per frame, with its step, time and statistics.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.meta: dict[str, Any] = _read_json(folder / "run.json")
        if self.meta.get("format") != FORMAT:
            raise RunError(f"{folder / 'run.json'}: format {self.meta.get('format')}; this version reads format {FORMAT}")
        self.scene: dict[str, Any] = _read_json(folder / "scene.json")
        self.topology = _read_topology(folder / "topology.npz")
        self.records = _read_records(folder / "stats.jsonl")
        told = {record["step"] for record in self.records}
        lost = [path for path in sorted((folder / "frames").glob("*.npy")) if -1 < _step_of(path) < max(told, default=0)]
        lost = [path for path in lost if _step_of(path) not in told]
        if lost:
            raise RunError(f"{folder / 'stats.jsonl'} has no line for {lost[0].name}, and lines for what comes after it")

    @property
    def frame_count(self) -> int:
        """Number of frames; frame 0 is the start."""
        return len(self.records)

    @property
    def times(self) -> np.ndarray:
        """(frame_count,) s."""
        return np.array([record["time"] for record in self.records])

    @property
    def stats(self) -> list[dict[str, Any]]:
        """Statistics, a dict a step; the start has none."""
        return [record for record in self.records if record["step"] > 0]

    def positions(self, frame: int) -> np.ndarray:
        """(n, 3) float64, m. Negative frames count from the end. Raises IndexError where there is no such frame."""
        try:
            record = self.records[frame]
        except IndexError:
            raise IndexError(f"{self.folder} has no frame {frame}; it has {self.frame_count} frames") from None
        path = _frame(self.folder, record["step"])
        try:
            found = _regular(np.load, path)
            if not isinstance(found, np.ndarray):
                raise ValueError("it holds several arrays")
        except UNREADABLE as error:
            raise _unreadable(path, error) from error
        right = (len(self.topology["body_of_vertex"]), 3)
        if found.shape != right or found.dtype.kind != "f":
            raise RunError(
                f"{path} holds {found.dtype} of shape {found.shape}; it must hold floating-point numbers of shape {right}"
            )
        wrong = np.flatnonzero(~np.isfinite(found).all(axis=1))
        if len(wrong):
            raise RunError(f"{path}: vertex {wrong[0]} is at {found[wrong[0]].tolist()}; it must be finite")
        return found.astype(np.float64)

    def quarantined(self, frame: int) -> list[tuple[int, int]]:
        """Pairs of bodies, by ascending numbers, that ignored each other in the step that led to `frame`, so that they may intersect in it."""
        numbers = {name: number for number, name in enumerate(self.body_names)}
        named = self.records[frame].get("quarantined", ())
        return [(min(a, b), max(a, b)) for a, b in ((numbers[one], numbers[other]) for one, other in named)]

    def excused(self, frame: int, pairs: np.ndarray) -> np.ndarray:
        """(k,) bool: which pairs (k, 2) of triangles belong to bodies that ignored each other in the step that led to `frame`."""
        owner = np.sort(self.body_of_triangle[pairs], axis=1)
        found = [np.all(owner == pair, axis=1) for pair in self.quarantined(frame)]
        return np.any(found, axis=0) if found else np.zeros(len(pairs), dtype=bool)

    def forces(self, frame: int) -> ContactForces | None:
        """Forces of contact in the step that led to `frame`; None at the start and where none were recorded.

        Raises IndexError where there is no such frame, RunError where the file is damaged.
        """
        step = self.records[frame]["step"]
        path = self.folder / "forces" / f"{step:06d}.npz"
        if not path.is_file():
            return None
        try:
            arrays, rows, n = _read_arrays(path), None, len(self.topology["body_of_vertex"])
            rows = len(arrays["pairs"])
            right = {"pairs": (rows, 2), **dict.fromkeys(("normal", "friction", "torque"), (rows, 3))}
            right["centers"] = (len(self.body_names), 3)
            if "vertices" in arrays:
                loaded = len(arrays["vertices"])
                right |= {"vertices": (loaded,), **dict.fromkeys(("vertex_normal", "vertex_friction"), (loaded, 3))}
            for name, shape in right.items():
                if arrays[name].shape != shape:
                    raise ValueError(f"{name} has the shape {arrays[name].shape}; it must be {shape}")
            for name, below in (("pairs", len(self.body_names)), ("vertices", n)):
                if name in arrays and arrays[name].size and not 0 <= arrays[name].min() <= arrays[name].max() < below:
                    raise ValueError(f"{name} names what is not there")
            return ContactForces.from_arrays(self.body_names, n, {name: arrays[name] for name in right})
        except UNREADABLE as error:
            raise _unreadable(path, error) from error

    @property
    def triangles(self) -> np.ndarray:
        """(m, 3) int32: all surfaces."""
        return self.topology["triangles"]

    @property
    def tets(self) -> np.ndarray:
        """(t, 4) int32: those of all solids."""
        return self.topology["tets"]

    @cached_property
    def scripted(self) -> np.ndarray:
        """(n,) bool: vertices whose motion is prescribed."""
        return self.topology["scripted"]

    @cached_property
    def obstacle(self) -> np.ndarray:
        """(n,) bool: vertices of obstacles, which may pass through each other."""
        return (np.array(self.body_kinds) == "obstacle")[self.topology["body_of_vertex"]]

    @cached_property
    def body_names(self) -> list[str]:
        """Names of bodies, then of obstacles."""
        return [str(name) for name in self.topology["body_names"]]

    @cached_property
    def body_kinds(self) -> list[str]:
        """Per body: "solid", "cloth", "rod" or "obstacle"."""
        return [str(kind) for kind in self.topology["body_kinds"]]

    @cached_property
    def body_of_triangle(self) -> np.ndarray:
        """(m,) index into body_names."""
        return self.topology["body_of_vertex"][self.triangles[:, 0]]

    def skin(self, body: int) -> Skin:
        """What is drawn of one body."""
        return skin(self.triangles[self.body_of_triangle == body], float(self.topology["body_radii"][body]))

    @cached_property
    def skins(self) -> list[Skin]:
        """What is drawn of each body."""
        return [self.skin(body) for body in range(len(self.body_names))]

    def _repr_html_(self) -> str:
        """The last frame and a summary, for notebooks."""
        return importlib.import_module("pdipc.viewer.inline").html_of_run(self)  # by name: see there

    def show(self, height: int = 500) -> Any:
        """Plays it in a frame of a notebook, `height` pixels high; `close()` of what is returned ends it. Needs the extra "viewer"."""
        return importlib.import_module("pdipc.viewer.inline").show_run(self, height)

    def segments(self) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
        """Step, outer iteration, start (n, 3) and end (n, 3) of every motion recorded for the frames that count."""
        last = self.records[-1]["step"] if self.records else -1
        named = ((path, path.stem.split("_")) for path in (self.folder / "segments").glob("*.npz"))
        numbered = [(int(parts[0]), int(parts[1]), path) for path, parts in named if len(parts) == 2]
        for step, outer, path in sorted(numbered):
            if step <= last:
                try:
                    arrays = _read_arrays(path)
                    yield step, outer, arrays["start"].astype(np.float64), arrays["end"].astype(np.float64)
                except UNREADABLE as error:
                    raise _unreadable(path, error) from error


def open_run(folder: str | Path) -> Run:
    """Reads the run in `folder`. Raises RunError where there is none, or it is damaged."""
    folder = Path(folder)
    try:
        there = folder.exists()
    except (OSError, ValueError) as error:  # a name that no folder can have
        raise _unreadable(Path(_short(str(folder))), error) from error
    if not there:
        raise RunError(f"{folder} does not exist")
    if not (folder / "run.json").exists():
        runs = sorted(own.parent.name for own in folder.glob("*/run.json"))
        hint = f"; it holds {len(runs)}: name one, such as {folder / runs[0]}" if runs else ""
        raise RunError(f"{folder} is not a run folder: it has no run.json{hint}")
    return Run(folder)


# --- files ---


def _write(path: Path, write: Callable) -> None:
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            write(file)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        error.filename = error.filename or str(path)
        raise


def _write_text(path: Path, text: str) -> None:
    _write(path, lambda file: file.write(text.encode()))


def _write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    named: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    _write(path, lambda file: np.savez(file, **named))


def _regular(read: Callable, path: Path, **options: Any) -> Any:
    """What `read` makes of a file; a pipe or a device, at which it might wait forever, is not opened."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError("it is no regular file")
    return read(path, **options)


def _unreadable(path: Path, error: BaseException) -> RunError:
    said = "it needs more memory than there is" if isinstance(error, MemoryError) else " ".join(str(error).split())
    said = said or type(error).__name__
    return RunError(f"{path} cannot be read: {said if len(said) <= 300 else said[:297] + '...'}")


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    with _regular(np.load, path) as arrays:  # verifies the checksum of each
        return {name: arrays[name] for name in arrays.files}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(_regular(Path.read_text, path, encoding="utf-8"))
    except UNREADABLE as error:
        raise _unreadable(path, error) from error
    if not isinstance(found, dict):
        raise RunError(f"{path} holds {_short(found)}; it must hold a table")
    return found


# Of topology.npz: kind of numbers and shape, where a letter stands for a length that all arrays agree on.
ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "triangles": ("iu", ("triangles", 3)),
    "tets": ("iu", ("tets", 4)),
    "body_of_vertex": ("iu", ("vertices",)),
    "scripted": ("b", ("vertices",)),
    "body_names": ("U", ("bodies",)),
    "body_kinds": ("U", ("bodies",)),
    "body_radii": ("f", ("bodies",)),
}


def _read_topology(path: Path) -> dict[str, np.ndarray]:
    try:
        found = _read_arrays(path)
    except UNREADABLE as error:
        raise _unreadable(path, error) from error
    if "body_names" in found:
        found.setdefault("body_radii", np.zeros(found["body_names"].shape))  # runs of earlier versions have no rods
    lengths: dict[str, int] = {}
    for name, (kinds, shape) in ARRAYS.items():
        if name not in found:
            raise RunError(f'{path} lacks the array "{name}"')
        array = found[name]
        right = tuple(lengths.setdefault(n, k) if isinstance(n, str) else n for n, k in zip(shape, array.shape, strict=False))
        if array.ndim != len(shape) or array.shape != right or (array.dtype.kind not in kinds and array.size):
            raise RunError(
                f"{path}: {name} holds {array.dtype} of shape {array.shape}; it must be ({', '.join(map(str, shape))})"
            )
    for name, below in (("triangles", "vertices"), ("tets", "vertices"), ("body_of_vertex", "bodies")):
        wrong = found[name][(found[name] < 0) | (found[name] >= lengths[below])]
        if len(wrong):
            raise RunError(f"{path}: {name} names number {wrong[0]} of {lengths[below]} {below}")
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(name, str) for name in value)


# What readers rely on in a line of stats.jsonl; a step may tell more.
STEP, TIME = (
    ("a whole number that rises from line to line", _is_count),
    ("a number of seconds that rises from line to line", _is_number),
)
FIELDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "smallest_gap": ("a number or null", lambda value: value is None or _is_number(value)),
    "residual": ("a number or null", lambda value: value is None or _is_number(value)),
    "converged": ("true or false", lambda value: isinstance(value, bool)),
    "outer": ("a whole number", _is_count),
    "barriers": ("a whole number", _is_count),
    "message": ("text", lambda value: isinstance(value, str)),
    "quarantined": ("a list of pairs of names", lambda value: isinstance(value, list) and all(map(_is_pair, value))),
    "milliseconds": ("a table of numbers", lambda value: isinstance(value, dict) and all(map(_is_number, value.values()))),
}


def _read_records(path: Path) -> list[dict[str, Any]]:
    """The complete lines; a last one that a kill cut short does not count."""
    records: list[dict[str, Any]] = []
    try:
        lines = _regular(Path.read_text, path, encoding="utf-8").split("\n")[:-1]
    except UNREADABLE as error:
        raise _unreadable(path, error) from error
    last = {"step": -1, "time": -math.inf}
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        try:
            record = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise RunError(f"{where}: {error}") from error
        if not isinstance(record, dict):
            raise RunError(f"{where} holds {_short(record)}; it must hold a table")
        for name, (right, fits) in {"step": STEP, "time": TIME}.items():
            if not fits(record.get(name)) or record[name] <= last[name]:
                raise RunError(f"{where}: {name} is {_short(record.get(name))}; it must be {right}")
        for name, (right, fits) in FIELDS.items():
            if name in record and not fits(record[name]):
                raise RunError(f"{where}: {name} is {_short(record[name])}; it must be {right}")
        records.append(record)
        last = record
    return records


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _line(record: dict[str, Any]) -> str:
    return json.dumps({name: _plain(value) for name, value in record.items()}, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """JSON's kinds of value: NumPy's scalars and arrays unwrapped, None for what is not finite."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": f"{platform.system()} {platform.machine()}"}
    for name in ("pdipc", "warp-lang", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
