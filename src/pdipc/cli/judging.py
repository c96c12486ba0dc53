"""Runs before the judges: `pdipc check`, `pdipc certify`, `pdipc audit`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pdipc.cli.app import RunArgument, command, fail, metres, outside_of_runs, progress

if TYPE_CHECKING:
    import numpy as np

    from pdipc.audit import Audit
    from pdipc.output.results import Run

LISTED = 20  # intersecting pairs that `check` prints of a frame


@command()
def check(folder: RunArgument) -> None:
    """Judge every frame with the independent, exact intersection test; exit code 1 if anything intersects."""
    from pdipc.judge.witness import find_intersections
    from pdipc.output.results import open_run

    opened = open_run(folder)
    bad = 0
    with progress("frame", opened.frame_count) as advance:
        for frame in range(opened.frame_count):
            pairs = find_intersections(opened.positions(frame), opened.triangles, opened.obstacle)
            if len(pairs):
                bad += 1
                typer.echo(f"frame {frame}, t = {opened.times[frame]:g} s: {len(pairs)} pairs of triangles intersect")
                _print_pairs(opened, pairs)
            advance(frame + 1, f"{bad} intersect")
    if bad:
        fail(f"{bad} of {opened.frame_count} frames intersect")
    typer.echo(f"{opened.frame_count} frames of {len(opened.triangles)} triangles: no intersection")


def _print_pairs(opened: "Run", pairs: "np.ndarray") -> None:
    for pair in pairs[:LISTED].tolist():
        named = (f'triangle {triangle} of "{opened.body_names[opened.body_of_triangle[triangle]]}"' for triangle in pair)
        typer.echo("  " + " and ".join(named))
    if len(pairs) > LISTED:
        typer.echo(f"  ... and {len(pairs) - LISTED} more")


@command()
def certify(folder: RunArgument) -> None:
    """Replay the motions that `pdipc run --certify` recorded with an independent judge; exit code 1 at any hit."""
    from pdipc.judge.certify import certify as replay
    from pdipc.output.results import open_run

    opened = open_run(folder)
    with progress("step", max(0, opened.frame_count - 1)) as advance:
        certificate = replay(opened, progress=lambda step, motions: advance(step, f"{motions} motions"))
    for hit in certificate.hits[:LISTED]:
        typer.echo(f"step {hit.step}, outer iteration {hit.outer}: {hit.what}")
    typer.echo(f"judge         {certificate.judge}")
    typer.echo(f"segments      {certificate.segments}")
    typer.echo(f"pairs judged  {certificate.pairs}")
    typer.echo(f"  very close  {certificate.close} of them, told apart by exact arithmetic only")
    typer.echo(f"hits          {len(certificate.hits)}")
    typer.echo(f"smallest gap  {metres(certificate.smallest_gap)}")
    typer.echo(f"time          {certificate.seconds:.1f} s")
    if certificate.hits:
        fail(f"{len(certificate.hits)} pairs meet: something passed through something")
    typer.echo(f"certified: in none of the {certificate.segments} motions that were made did anything touch")


@command()
def audit(
    folder: RunArgument,
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Plot it: .png, .svg or .pdf.")] = None,
    forces: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write contact forces, N, and pressures, Pa, at every vertex, with the bodies: .npz."
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table, and the contact force on each body, N: .csv.")
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Takes every so many frames.")] = 1,
) -> None:
    """Energies, momenta and contact forces of a run, step by step."""
    import numpy as np

    from pdipc import audit as audits
    from pdipc.output.results import open_run

    for option, path, suffixes in (
        ("--forces", forces, (".npz",)),
        ("--csv", csv, (".csv",)),
        ("--output", out, (".png", ".svg", ".pdf")),
    ):
        if path is not None and path.suffix not in suffixes:
            raise typer.BadParameter(f'"{path}"; it must end in {" or ".join(suffixes)}', param_hint=option)
        outside_of_runs(path, option)
    opened = open_run(folder)
    taken = range(0, opened.frame_count, every)
    typer.echo(_AUDIT_HEAD)
    rows, resultants, at_vertices = [], [], []
    for frame, state in zip(taken, audits.replay(opened, taken), strict=True):
        row = audits.audit(*state)
        typer.echo(f"{opened.records[frame]['step']:6} " + " ".join(f"{value:11.4g}" for value in _numbers(row)))
        rows.append(row)
        resultants.append(audits.body_forces(*state))
        if forces is not None:
            at_vertices.append((audits.contact_forces(*state), audits.contact_pressures(*state)))
    if forces is not None:
        force, pressure = (np.array(values, dtype=np.float32) for values in zip(*at_vertices, strict=True))
        bodies = {name: opened.topology[name] for name in ("body_names", "body_kinds", "body_of_vertex")}
        np.savez_compressed(forces, time=opened.times[taken], force=force, pressure=pressure, **bodies)
        typer.echo(str(forces))
    if csv is not None:
        _write_csv(csv, [opened.records[frame] for frame in taken], rows, resultants)
        typer.echo(str(csv))
    if out is not None:
        from pdipc.output.plot import plot_audits

        plot_audits(rows, resultants, out)
        typer.echo(str(out))


_AUDITED = ("kinetic", "elastic", "barrier", "gravity", "total", "px", "py", "pz", "Lx", "Ly", "Lz")
_UNITS = 5 * ("J",) + 3 * ("kg m/s",) + 3 * ("kg m^2/s",)
_AUDIT_HEAD = (
    "energies in J, momentum p in kg m/s, angular momentum L about the origin in kg m^2/s; without what is scripted\n"
    + " ".join(["  step", *(f"{name:>11}" for name in _AUDITED)])
)


def _numbers(row: "Audit") -> list[float]:
    energies = (row.kinetic, row.elastic, row.barrier, row.gravity, row.total)
    return [float(value) for value in (*energies, *row.linear_momentum, *row.angular_momentum)]


def _write_csv(path: Path, records: list[dict[str, Any]], rows: list["Audit"], resultants: list[dict]) -> None:
    """A line a frame, with digits that give the same float64 back; the columns name their units."""
    import csv

    bodies = list(resultants[0]) if resultants else []
    head = ["step", "time [s]", *(f"{name} [{unit}]" for name, unit in zip(_AUDITED, _UNITS, strict=True))]
    head += [f"F{axis} on {body} [N]" for body in bodies for axis in "xyz"]
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(head)
        for record, row, on in zip(records, rows, resultants, strict=True):
            table.writerow([record["step"], record["time"], *_numbers(row), *(float(x) for body in bodies for x in on[body])])
