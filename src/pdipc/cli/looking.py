"""Runs for people and other programs: `pdipc render`, `pdipc export`, `pdipc view`."""

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdipc.cli.app import RunArgument, command, load, outside_of_runs

if TYPE_CHECKING:
    from pdipc.output.render import Field
    from pdipc.output.results import Run


class Format(StrEnum):
    """Export formats."""

    usd = "usd"
    ply = "ply"
    obj = "obj"
    vtk = "vtk"


class Color(StrEnum):
    """What colours the bodies of a picture."""

    body = "body"
    pressure = "pressure"


@command()
def render(
    folder: RunArgument,
    out: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help=".png or .jpg, .gif or .mp4.")],
    frame: Annotated[int, typer.Option(help="Frame of a still picture; negative counts from the end.")] = -1,
    every: Annotated[int, typer.Option(min=1, help="Takes every so many frames into an animation.")] = 1,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size in pixels.")] = "1280x800",
    view: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Direction from what is seen to the camera; y is up. Default: 0.7,0.42,1."),
    ] = None,
    color: Annotated[Color, typer.Option(help="A colour for each body, or the pressure of contact on it.")] = Color.body,
) -> None:
    """Make a picture or an animation of a run."""
    from pdipc.output import render as pictures
    from pdipc.output.results import open_run

    try:
        width, height = (int(part) for part in size.lower().split("x"))
        if min(width, height) < 16 or max(width, height) > pictures.LARGEST:
            raise ValueError
    except ValueError:
        raise typer.BadParameter(
            f'"{size}"; it must be like 1280x800, each 16 to {pictures.LARGEST}', param_hint="--size"
        ) from None
    try:
        x, y, z = pictures.VIEW if view is None else (float(part) for part in view.split(","))
        if not 0.0 < x * x + y * y + z * z < float("inf"):
            raise ValueError
    except ValueError:
        raise typer.BadParameter(f'"{view}"; it must be like 0.7,0.42,1', param_hint="--view") from None
    suffix = out.suffix.lower()
    if suffix not in (*pictures.STILL, *pictures.MOVING):
        raise typer.BadParameter(
            f'"{out}"; it must end in one of: {", ".join((*pictures.STILL, *pictures.MOVING))}', param_hint="--output"
        )
    outside_of_runs(out)
    opened = open_run(folder)
    if suffix in pictures.STILL:
        field = _pressure(opened, [frame]) if color is Color.pressure else None
        pictures.render(opened, frame, out, size=(width, height), view=(x, y, z), field=field)
    else:
        field = _pressure(opened, range(0, opened.frame_count, every)) if color is Color.pressure else None
        pictures.render_animation(opened, out, every=every, size=(width, height), view=(x, y, z), field=field)
    typer.echo(str(out))


def _pressure(opened: "Run", frames: "Iterable[int]") -> "Field":
    """Contact pressure on the given frames; the last colour stands for what one in a hundred loaded vertices exceeds."""
    import numpy as np

    from pdipc.audit import vertex_forces
    from pdipc.forces import pressures
    from pdipc.output.render import Field

    found = {
        frame: pressures(normal, opened.positions(frame), opened.triangles)
        for frame, (normal, _) in zip(frames, vertex_forces(opened, frames), strict=True)
    }
    loaded = np.concatenate([values[values > 0.0] for values in found.values()])
    return Field("contact pressure, Pa", found.__getitem__, float(np.quantile(loaded, 0.99)) if len(loaded) else 1.0)


@command()
def export(
    folder: RunArgument,
    to: Annotated[Format, typer.Option("--format", help="usd: one animated file; ply, obj: a file a frame; vtk: PVD and VTU.")],
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="PATH", help="Default: beside the run folder.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Takes every so many frames.")] = 1,
    bodies: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only this body or obstacle, with all its copies; may be given several times."),
    ] = None,
) -> None:
    """Write the frames of a run for other programs."""
    from pdipc.output import export as exports
    from pdipc.output.results import open_run

    outside_of_runs(out)
    opened = open_run(folder)
    resolved = folder.resolve()
    default = resolved.with_name(f"{resolved.name}.usdc" if to is Format.usd else f"{resolved.name}_{to.value}")
    typer.echo(str(exports.export(exports.Excerpt(opened, every, bodies or None), to.value, out or default)))


@command()
def view(
    what: Annotated[str, typer.Argument(metavar="DIR|SCENE", help="A run folder to play, or a scene to simulate live.")],
    host: Annotated[str, typer.Option(help='Who may watch: "localhost", or "0.0.0.0" for other machines too.')] = "localhost",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page; if it is taken, the next free one.")] = 8080,
    device: Annotated[str | None, typer.Option(help='"cpu" or "cuda:0".')] = None,
    allow: Annotated[
        list[str] | None,
        typer.Option(
            "--allow-origin", metavar="ORIGIN", help="A page elsewhere that may connect too, such as https://host:8443."
        ),
    ] = None,
) -> None:
    """Watch a run, or a scene while it is simulated, in the browser; there, bodies can be dragged with the mouse.

    The address that is printed has a token in it, which is new each time: whoever has it may watch and drag.
    """
    from pdipc import viewer
    from pdipc.output.results import open_run

    if Path(what).is_dir():
        viewer.play(open_run(what), host, port, allow or ())
    else:
        viewer.simulate(load(what), host, port, device, allow or ())
