"""A scene with every combination of some values, each simulated into a run folder of its own, on Dask; and a table of what came of it.

    sweep.json      the values, and which scene each run is of
    0000/, ...      a run folder a combination, in the order in which the last key changes fastest
    table.csv       a line a run: its values and its results, which have the same bits wherever they were computed
    times.csv       a line a run: how long it took, and from which step it went on when it had been stopped

Dask gives the run of a worker that dies to another one, which goes on from the run's last checkpoint. What workers and the caller share is the disk.
"""

import csv
import hashlib
import io
import itertools
import json
import os
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdipc.output.results import Run, RunError, RunLockedError, open_run
from pdipc.scene.errors import SceneError, SceneWarning
from pdipc.scene.load import load_scene

if TYPE_CHECKING:
    from distributed import Client

FORMAT = 1
MOST_RUNS = 100_000
LISTED = 5  # refused combinations that a message names
CONNECT_SECONDS = 10.0  # after which a scheduler counts as not there
LOCKED_SECONDS = 0.5  # between two looks at a run that another process writes
RESULTS = (
    "steps", "time_s", "unconverged", "outer", "linear_iterations", "truncations", "most_contacts", "smallest_gap_m", "residual_m",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One combination: its number, its values by key, and its scene as JSON, with files named in full."""

    number: int
    values: dict[str, Any]
    scene: str

    @property
    def folder(self) -> str:
        """The name of its run folder."""
        return f"{self.number:04d}"

    @cached_property
    def steps(self) -> int:
        """Those of its whole run."""
        return json.loads(self.scene)["simulation"]["steps"]

    def __str__(self) -> str:
        return ", ".join(f"{key} = {_text(value)}" for key, value in self.values.items())


@dataclass(frozen=True)
class Progress:
    """doing: "check" or "run". done of total; workers: how many there are at the moment."""

    doing: str
    done: int
    total: int
    workers: int


def combinations(scene: str | Path, settings: dict[str, list[Any]]) -> list[Case]:
    """Every combination of the values in `settings`, by dotted keys, for the scene of a file or bundled name.

    Raises SceneError where a key leads nowhere or a combination is no scene, before anything runs.
    """
    count = 1
    for values in settings.values():
        count *= len(values)
    if not settings or not count:
        raise SceneError("a sweep needs a key and values for it, such as contact.friction=0.1,0.3")
    if count > MOST_RUNS:
        raise SceneError(f"these values have {count} combinations; a sweep takes at most {MOST_RUNS}")
    cases = []
    for number, values in enumerate(itertools.product(*settings.values())):
        changes = dict(zip(settings, values, strict=True))
        cases.append(Case(number, changes, load_scene(scene, changes).model_dump_json()))
    return cases


def run_sweep(
    scene: str | Path,
    settings: dict[str, list[Any]],
    out_dir: str | Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> dict[int, str]:
    """Simulates every combination into `out_dir`, which every worker must see under the same name, and writes the table.

    scheduler: address of a Dask cluster, whose workers have this version of pdipc and should have one thread each. None: as many
    processes on this machine as `workers`, else as it has cores, which share its threads. resume: finish what was begun, by the
    same values. Returns what went wrong, by number of the run; the table says so, too.

    Raises SceneError, before anything runs, where any combination cannot be simulated; RunError where the folder does not take this
    sweep or the cluster is not there.
    """
    if scheduler is not None and workers is not None:
        raise ValueError("workers are those that the scheduler has; give one of the two")
    cases, folder = combinations(scene, settings), Path(out_dir).resolve()
    _prepare(folder, cases, settings, resume, overwrite)
    left = [case for case in cases if not _is_done(folder, case)]
    tell = progress or (lambda _: None)
    failures: dict[int, str] = {}
    resumed: dict[int, int] = {}
    if left:
        with _cluster(scheduler, min(workers or _cores(), len(left))) as client:
            _check(client, left, tell)
            for number, outcome in _each(client, "run", run_case, [(case, str(folder)) for case in left], tell):
                if isinstance(outcome, int):
                    resumed[number] = outcome
                else:
                    failures[number] = str(outcome)
    write_table(folder, cases, failures)
    _write_times(folder, cases, resumed)
    return failures


# --- on a worker ---


def check_case(case: Case, version: str) -> list[str]:
    """What is left out of the scene's files, a line each. Raises SceneError where it cannot be simulated, RunError for another version."""
    from pdipc import __version__
    from pdipc.scene.assembly import assemble
    from pdipc.scene.check import refuse
    from pdipc.scene.schema import Scene

    if version != __version__:
        raise RunError(f"a worker has pdipc {__version__}, and this is {version}")
    scene = Scene.model_validate_json(case.scene)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", SceneWarning)
        refuse(scene, assemble(scene), "float32" if scene.simulation.precision == "float32" else "float64")
    return [str(each.message) for each in told if issubclass(each.category, SceneWarning)]


def run_case(case: Case, folder: str) -> int | str:
    """Simulates, or goes on, in the case's folder below `folder`; returns the step that it began at, or what went wrong."""
    from pdipc.scene.schema import Scene
    from pdipc.simulation import run_scene

    own = Path(folder) / case.folder
    while True:
        try:
            begun = (own / "run.json").is_file()
            records = open_run(own).records if begun else []
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SceneWarning)  # `check_case` has told
                run_scene(Scene.model_validate_json(case.scene), own, resume=begun)
            return records[-1]["step"] if records else 0
        except RunLockedError:
            time.sleep(LOCKED_SECONDS)  # by a worker that was given up too early: it dies, or finishes
        except Exception as error:
            return str(error) or type(error).__name__  # the other runs go on


# --- the cluster ---


def _cores() -> int:
    from pdipc.device.threads import thread_count

    return thread_count()


@contextmanager
def _cluster(scheduler: str | None, workers: int) -> Iterator["Client"]:
    """A client of the cluster at an address, or of one of processes on this machine, which end with it."""
    from distributed import Client, LocalCluster

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise RunError(f'no Dask scheduler answers at "{scheduler}": {error}') from None
        with client:
            yield client
        return
    share = str(max(1, _cores() // workers))
    with (
        # without a limit of memory: Dask would end a worker for using more than an even share
        LocalCluster(
            n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address=None, env={"PDIPC_THREADS": share}
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def _each(
    client: "Client", doing: str, function: Callable, arguments: list[tuple], tell: Callable[[Progress], None]
) -> Iterator[tuple[int, Any]]:
    """The number of the case that each tuple of arguments begins with, and what the function makes of it on a worker, or raises."""
    from distributed import as_completed

    # not pure: what it does is on the disk, so the same call twice is two calls
    futures = {client.submit(function, *each, pure=False): each[0].number for each in arguments}

    def told(done: int) -> None:
        tell(Progress(doing, done, len(arguments), len(client.scheduler_info()["workers"])))

    told(0)
    finished = as_completed(list(futures))
    done = 0
    while done < len(arguments):
        if finished.is_empty():
            raise RunError("the Dask scheduler is gone; go on with --resume once there is one")
        future = finished.next()
        if future.cancelled():
            raise RunError("the Dask scheduler is gone, or has dropped what it was given; go on with --resume")
        yield futures.pop(future), future.exception() or future.result()
        future.release()  # else it would be computed again where a worker dies that has its result
        done += 1
        told(done)


def _check(client: "Client", cases: list[Case], tell: Callable[[Progress], None]) -> None:
    """Raises SceneError where a worker refuses a case; warns of what was left out of files."""
    from pdipc import __version__

    refused: list[tuple[int, Exception]] = []
    notes: dict[str, None] = {}
    for number, outcome in _each(client, "check", check_case, [(case, __version__) for case in cases], tell):
        if isinstance(outcome, list):
            notes |= dict.fromkeys(outcome)
        elif isinstance(outcome, ModuleNotFoundError):
            raise RunError(f"the workers have no pdipc: {outcome}")
        elif isinstance(outcome, SceneError):
            refused.append((number, outcome))
        else:
            raise outcome
    for note in notes:
        warnings.warn(note, SceneWarning, stacklevel=3)
    if refused:
        by_number = {case.number: case for case in cases}
        told = [f"{by_number[number]}: {error}" for number, error in sorted(refused, key=lambda each: each[0])]
        more = [f"... and {len(told) - LISTED} more"] if len(told) > LISTED else []
        listed = "\n  ".join([*told[:LISTED], *more])
        raise SceneError(f"{len(told)} of {len(cases)} combinations cannot be simulated:\n  {listed}")


# --- the folder ---


def _prepare(folder: Path, cases: list[Case], settings: dict[str, list[Any]], resume: bool, overwrite: bool) -> None:
    """Makes the folder, or sees that it holds this very sweep. Raises RunError."""
    if resume and overwrite:
        raise RunError("resume and overwrite exclude each other")
    said = {"format": FORMAT, "settings": settings, "scenes": [hashlib.sha256(c.scene.encode()).hexdigest() for c in cases]}
    described = folder / "sweep.json"
    present = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    if resume:
        if not described.is_file():
            raise RunError(f"{folder} holds no sweep to go on with")
        if json.loads(described.read_text(encoding="utf-8")) != json.loads(json.dumps(said)):
            raise RunError(
                f"{folder} holds a sweep of another scene or by other values; go on with its own, or name a new folder"
            )
        return
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder} is a file; a sweep needs a folder")
    if present and not described.is_file():
        raise RunError(f'{folder} holds other files, such as "{present[0]}"; name a new folder for the sweep')
    if present and not overwrite:
        raise RunError(f"{folder} holds a sweep already; go on with --resume, replace it with --overwrite, or name another")
    for name in present:
        if name in ("table.csv", "times.csv"):
            (folder / name).unlink()
        elif (folder / name / "run.json").is_file():
            shutil.rmtree(folder / name)
    folder.mkdir(parents=True, exist_ok=True)
    _write(described, json.dumps(said) + "\n")


def _is_done(folder: Path, case: Case) -> bool:
    own = folder / case.folder
    if not (own / "run.json").is_file():
        return False
    records = open_run(own).records
    return bool(records) and records[-1]["step"] >= case.steps


def write_table(folder: Path, cases: list[Case], failures: dict[int, str]) -> None:
    """table.csv of the runs in `folder`. A body stands for the mean of its vertices, of an obstacle nothing is said.

    unconverged, outer, linear_iterations and truncations are sums over all steps, most_contacts, smallest_gap_m and residual_m the extremes;
    positions_sha256 tells whether two runs ended at the same bits. What does not apply is empty.
    """
    lines, bodies = [], {}
    for case in cases:
        own = folder / case.folder
        run = open_run(own) if (own / "run.json").is_file() else None
        if run is None and case.number not in failures:
            failures[case.number] = f"{own} is not there; workers must see the same disk"
        results = {} if run is None or not run.records else _results(run)
        bodies |= dict.fromkeys(name for name in results if name not in RESULTS)
        lines.append(
            {
                "run": case.folder,
                **{key: _text(value) for key, value in case.values.items()},
                **{name: _text(value) for name, value in results.items()},
                "error": failures.get(case.number, ""),
            }
        )
    bodies.pop("positions_sha256", None)
    columns = ["run", *cases[0].values, *RESULTS, *bodies, "positions_sha256", "error"]
    _write_csv(folder / "table.csv", columns, lines)


def _results(run: Run) -> dict[str, Any]:
    stats = run.stats

    def known(name: str) -> list:
        return [record[name] for record in stats if record.get(name) is not None]

    values = (
        run.records[-1]["step"],
        float(run.times[-1]),
        sum(not each for each in known("converged")),
        *(sum(known(name)) for name in ("outer", "linear_iterations", "truncations")),
        max(known("barriers"), default=None),
        min(known("smallest_gap"), default=None),
        max(known("residual"), default=None),
    )
    found: dict[str, Any] = dict(zip(RESULTS, values, strict=True))
    positions = run.positions(-1)
    for number, (name, kind) in enumerate(zip(run.body_names, run.body_kinds, strict=True)):
        if kind != "obstacle":
            middle = positions[run.topology["body_of_vertex"] == number].mean(axis=0)
            found |= {f"{name}.{axis}_m": float(value) for axis, value in zip("xyz", middle, strict=True)}
    found["positions_sha256"] = hashlib.sha256(np.ascontiguousarray(positions).tobytes()).hexdigest()
    return found


def _write_times(folder: Path, cases: list[Case], resumed: dict[int, int]) -> None:
    lines = []
    for case in cases:
        stats = open_run(folder / case.folder).stats if (folder / case.folder / "run.json").is_file() else []
        seconds = sum(sum(record.get("milliseconds", {}).values()) for record in stats) / 1e3
        lines.append(
            {"run": case.folder, "seconds_of_steps": f"{seconds:.6g}", "resumed_at_step": resumed.get(case.number, "")}
        )
    _write_csv(folder / "times.csv", ["run", "seconds_of_steps", "resumed_at_step"], lines)


def _text(value: Any) -> str:
    """A value in a cell; the digits of a number give it back."""
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)


def _write_csv(path: Path, columns: list[str], lines: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    _write(path, text.getvalue())


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
