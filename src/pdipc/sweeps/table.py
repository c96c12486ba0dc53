"""The tables of a sweep: what came of each run, and how long it took."""

import csv
import hashlib
import io
import os
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output.results import Run, open_run
from pdipc.sweeps.cases import Case, text_of

RESULTS = (
    "steps", "time_s", "unconverged", "outer", "linear_iterations", "truncations", "most_contacts", "smallest_gap_m", "residual_m",
)  # fmt: skip


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
                **{key: text_of(value) for key, value in case.values.items()},
                **{name: text_of(value) for name, value in results.items()},
                "error": failures.get(case.number, ""),
            }
        )
    bodies.pop("positions_sha256", None)
    keys = dict.fromkeys(key for case in cases for key in case.values)
    columns = ["run", *keys, *RESULTS, *bodies, "positions_sha256", "error"]
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


def write_times(folder: Path, cases: list[Case], resumed: dict[int, int]) -> None:
    lines = []
    for case in cases:
        stats = open_run(folder / case.folder).stats if (folder / case.folder / "run.json").is_file() else []
        seconds = sum(sum(record.get("milliseconds", {}).values()) for record in stats) / 1e3
        lines.append(
            {"run": case.folder, "seconds_of_steps": f"{seconds:.6g}", "resumed_at_step": resumed.get(case.number, "")}
        )
    _write_csv(folder / "times.csv", ["run", "seconds_of_steps", "resumed_at_step"], lines)


def _write_csv(path: Path, columns: list[str], lines: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    write(path, text.getvalue())


def write(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
