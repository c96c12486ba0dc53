"""Runs before the judges: `pdipc check`, `pdipc certify`, `pdipc audit`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdipc.cli.app import RunArgument, command, fail, metres, outside_of_runs, progress

if TYPE_CHECKING:
    import numpy as np

    from pdipc.audit import Audit
    from pdipc.output.forces import ContactForces
    from pdipc.output.results import Run

LISTED = 20  # intersecting pairs that `check` prints of a frame


@command()
def check(folder: RunArgument) -> None:
    """Judge every frame with the independent, exact intersection test; exit code 1 if anything intersects."""
    from pdipc.judge.witness import find_intersections
    from pdipc.output.results import open_run

    opened = open_run(folder)
    bad, quarantined = 0, [0, 0]
    with progress("frame", opened.frame_count) as advance:
        for frame in range(opened.frame_count):
            pairs = find_intersections(opened.positions(frame), opened.triangles, opened.obstacle)
            excused = opened.excused(frame, pairs)
            if opened.quarantined(frame):
                quarantined[0] += 1
                quarantined[1] += int(excused.any())
            pairs = pairs[~excused]
            if len(pairs):
                bad += 1
                typer.echo(f"frame {frame}, t = {opened.times[frame]:g} s: {len(pairs)} pairs of triangles intersect")
                _print_pairs(opened, pairs)
            advance(frame + 1, f"{bad} intersect")
    if bad:
        fail(f"{bad} of {opened.frame_count} frames intersect")
    typer.echo(f"{opened.frame_count} frames of {len(opened.triangles)} triangles: no intersection")
    if quarantined[0]:
        named = " and ".join(
            f'"{name}"' for name in dict.fromkeys(n for pair in opened.records[0].get("quarantined", ()) for n in pair)
        )
        typer.echo(
            f"except of bodies in quarantine: in {quarantined[0]} frames some ignored each other ({named}), and in {quarantined[1]} they intersect"
        )


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
    if certificate.ignored:
        typer.echo(f"quarantined   {certificate.ignored} pairs of bodies that ignored each other: not judged, not certified")
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
            metavar="FILE", help="Write normal forces, friction, N, and pressures, Pa, at every vertex, with the bodies: .npz."
        ),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the table, and the contact forces on each body and of each on each other: .csv."
        ),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Takes every so many frames.")] = 1,
) -> None:
    """Energies, momenta and contact forces of a run, step by step."""
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
    rows, contacts = [], []
    for frame, state in zip(taken, audits.replay(opened, taken), strict=True):
        row = audits.audit(*state)
        typer.echo(f"{opened.records[frame]['step']:6} " + " ".join(f"{value:11.4g}" for value in _numbers(row)))
        rows.append(row)
        contacts.append(opened.forces(frame))
    if taken:
        _print_forces(opened, taken[-1], contacts[-1])
    if forces is not None:
        _write_forces(forces, opened, taken)
        typer.echo(str(forces))
    if csv is not None:
        _write_csv(csv, opened, taken, rows, contacts)
        typer.echo(str(csv))
    if out is not None:
        from pdipc.pictures.plot import plot_audits

        plot_audits(rows, opened.body_names, contacts, out)
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


def _print_forces(opened: "Run", frame: int, contact: "ContactForces | None") -> None:
    """A line for each side of each pair of bodies that touched in the step that led to the frame."""
    step = opened.records[frame]["step"]
    if contact is None:
        typer.echo(f"no forces of contact are recorded for step {step}")
        return
    typer.echo(f"forces of contact in step {step}, N, and their torque about the centre of what they act on, N m: x, y, z each")
    for pair, *values in zip(contact.touching(), contact.normal, contact.friction, contact.torque, strict=True):
        told = (f"{name} ({', '.join(f'{x:.4g}' for x in value)})" for name, value in zip(_OF_FORCES, values, strict=True))
        typer.echo(f'  on "{pair[0]}" by "{pair[1]}": ' + ", ".join(told))
    if not len(contact.pairs):
        typer.echo("  no bodies touch")


_OF_FORCES = {"normal": "N", "friction": "N", "torque": "N m"}


def _write_forces(path: Path, opened: "Run", taken: range) -> None:
    import numpy as np

    from pdipc.audit import vertex_forces
    from pdipc.output.forces import pressures

    found = [
        (*both, pressures(both[0], opened.positions(frame), opened.triangles))
        for frame, both in zip(taken, vertex_forces(opened, taken), strict=True)
    ]
    normal, friction, pressure = (np.array(values, dtype=np.float32) for values in zip(*found, strict=True))
    if np.isnan(friction[1:]).any():
        typer.echo("note: friction at vertices is unknown (NaN): record it with `pdipc run --forces`", err=True)
    bodies = {name: opened.topology[name] for name in ("body_names", "body_kinds", "body_of_vertex")}
    arrays = {"time": opened.times[taken], "normal": normal, "friction": friction, "pressure": pressure, **bodies}
    np.savez_compressed(path, **arrays)


def _write_csv(path: Path, opened: "Run", taken: range, rows: list["Audit"], contacts: "list[ContactForces | None]") -> None:
    """A line a frame, with digits that give the same float64 back; the columns name their units. Forces: of all contact on each body,
    then those of each body on each other that it ever touches; nan where none are recorded, as at the start.
    """
    import csv

    import numpy as np

    touching = sorted({pair for contact in contacts if contact is not None for pair in contact.touching()})
    sides = [(name, None) for name in opened.body_names] + touching
    head = ["step", "time [s]", *(f"{name} [{unit}]" for name, unit in zip(_AUDITED, _UNITS, strict=True))]
    head += [
        f"{what} {axis} on {body}{f' by {by}' if by else ''} [{unit}]"
        for body, by in sides
        for what, unit in _OF_FORCES.items()
        for axis in "xyz"
    ]
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(head)
        for frame, row, contact in zip(taken, rows, contacts, strict=True):
            record, values = opened.records[frame], np.full((len(sides), 3, 3), np.nan)
            if contact is not None:
                on = (contact.on(*side) for side in sides)
                values = np.array([[force.normal, force.friction, force.torque] for force in on])
            table.writerow([record["step"], record["time"], *_numbers(row), *values.ravel().tolist()])
