"""A sweep from its beginning, or from where it was stopped, to its table."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pdipc.output.results import RunError, open_run
from pdipc.scene.errors import SceneError
from pdipc.sweeps.cases import Case, combinations, run_case
from pdipc.sweeps.cluster import Progress, check, cluster_of, cores, each_of
from pdipc.sweeps.table import write, write_table, write_times

FORMAT = 1


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
    prepare(folder, cases, settings, resume, overwrite)
    left = [case for case in cases if not is_done(folder, case)]
    tell = progress or (lambda _: None)
    failures: dict[int, str] = {}
    resumed: dict[int, int] = {}
    if left:
        with cluster_of(scheduler, min(workers or cores(), len(left))) as client:
            try:
                check(client, left, tell)
            except (SceneError, RunError):
                _forget(folder)
                raise
            for number, outcome in each_of(client, "run", run_case, [(case, str(folder)) for case in left], tell):
                if isinstance(outcome, int):
                    resumed[number] = outcome
                else:
                    failures[number] = str(outcome)
    write_table(folder, cases, failures)
    write_times(folder, cases, resumed)
    return failures


def prepare(folder: Path, cases: list[Case], settings: dict[str, Any], resume: bool, overwrite: bool) -> None:
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
    write(described, json.dumps(said) + "\n")


def _forget(folder: Path) -> None:
    """Leaves no trace of a sweep that was refused before any run: the next one may have the folder's name."""
    if [entry.name for entry in folder.iterdir()] == ["sweep.json"]:
        (folder / "sweep.json").unlink()
        folder.rmdir()


def is_done(folder: Path, case: Case) -> bool:
    own = folder / case.folder
    if not (own / "run.json").is_file():
        return False
    records = open_run(own).records
    return bool(records) and records[-1]["step"] >= case.steps
