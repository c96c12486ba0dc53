"""`pdipc sweep`: a scene with every combination of some values."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdipc.cli.app import SceneArgument, command, fail, outside_of_runs, progress, scene_file

if TYPE_CHECKING:
    from pdipc.sweeps import Progress


@command()
def sweep(
    scene: SceneArgument,
    settings: Annotated[
        list[str],
        typer.Option(
            "--set", metavar="KEY=VALUES", help="Values of a key, such as contact.friction=0.1,0.3; may be given several times."
        ),
    ],
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="Default: sweeps/<scene>.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster; default: processes on this machine.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes on this machine; default: as many as cores.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the sweep in the folder.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the sweep in the folder.")] = False,
) -> None:
    """Simulate every combination of some values, each into a run folder, and make a table of the results (CSV)."""
    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--workers is for this machine; a scheduler has workers of its own", param_hint="--workers")
    if resume and overwrite:
        raise typer.BadParameter("--resume and --overwrite exclude each other")
    from pdipc.scene.vary import parse_setting

    values: dict[str, list] = {}
    for text in settings:
        key, given = parse_setting(text)
        if key in values:
            raise typer.BadParameter(f'"{key}" is there twice; give its values after commas', param_hint="--set")
        values[key] = given
    folder = out or Path("sweeps") / Path(scene).stem
    outside_of_runs(folder / "table.csv")
    try:
        failures = _swept(scene_file(scene), values, folder, scheduler, workers, resume, overwrite)
    except KeyboardInterrupt:
        typer.echo(f"pdipc: stopped; what is done is in {folder}: give the same command with --resume", err=True)
        raise typer.Exit(130) from None  # what shells expect
    for number, said in sorted(failures.items()):
        typer.echo(f"run {number:04d}: {said}", err=True)
    typer.echo(str(folder / "table.csv"))
    if failures:
        fail(f"{len(failures)} runs failed; the others are in the table")


def _swept(
    scene: str | Path,
    values: dict[str, list],
    folder: Path,
    scheduler: str | None,
    workers: int | None,
    resume: bool,
    overwrite: bool,
) -> dict[int, str]:
    from pdipc.sweeps import run_sweep

    total = 1
    for each in values.values():
        total *= len(each)
    with progress("run", total) as advance:

        def tell(at: "Progress") -> None:
            doing = "checked" if at.doing == "check" else "simulated"
            advance(total - at.total + at.done, f"{doing}, {at.workers} workers" if at.workers else "waiting for a worker")

        options = {"scheduler": scheduler, "workers": workers, "resume": resume, "overwrite": overwrite}
        return run_sweep(scene, values, folder, **options, progress=tell)
