"""Runs for people and other programs: `pdipc render`, `pdipc export`, `pdipc view`."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pdipc.cli.app import RunArgument, command, load, outside_of_runs, progress

if TYPE_CHECKING:
    from pdipc.output.results import Run
    from pdipc.scene.looks import Picture


class Format(StrEnum):
    """Export formats."""

    usd = "usd"
    stage = "stage"
    mdd = "mdd"
    pc2 = "pc2"
    ply = "ply"
    obj = "obj"
    vtk = "vtk"
    paraview = "paraview"


class Color(StrEnum):
    """What colours a picture."""

    body = "body"
    pressure = "pressure"


class Obstacles(StrEnum):
    """How obstacles are drawn."""

    auto = "auto"
    solid = "solid"
    translucent = "translucent"
    hidden = "hidden"


CAMERA, FILM, BODIES, STYLE = "Camera", "Film", "Bodies", "Style"  # panels of the help


# Arguments: the options of the command.
# Long: by their descriptions.
@command()
def render(
    folder: RunArgument,
    out: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help=".png or .jpg, .gif or .mp4.")],
    frame: Annotated[
        int | None, typer.Option(help="Frame of a still picture; negative counts from the end. Default: -1.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size in pixels. Default: 1280x800, of a film 960x600.")
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            rich_help_panel=CAMERA,
            help="Direction from what is seen to the camera; y is up. Default: 0.7,0.42,1.",
        ),
    ] = None,
    position: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", rich_help_panel=CAMERA, help="Where the camera stands, m, in place of --view."),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", rich_help_panel=CAMERA, help="What it looks at, m. Default: the middle of the bodies."),
    ] = None,
    zoom: Annotated[float | None, typer.Option(rich_help_panel=CAMERA, help="2 shows everything twice as large.")] = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="A:B", rich_help_panel=FILM, help="First and last frame; negative ones count from the end."),
    ] = None,
    every: Annotated[int | None, typer.Option(min=1, rich_help_panel=FILM, help="Takes every so many frames.")] = None,
    fps: Annotated[
        float | None,
        typer.Option(rich_help_panel=FILM, help="Frames shown a second. Default: in the time that it took, at most 50."),
    ] = None,
    color: Annotated[
        Color | None, typer.Option(rich_help_panel=BODIES, help="A colour for each body, or the pressure of contact.")
    ] = None,
    top: Annotated[
        float | None, typer.Option(metavar="PA", rich_help_panel=BODIES, help="Pressure of the last colour, Pa.")
    ] = None,
    paint: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=COLOR", rich_help_panel=BODIES, help="Colour of a body, such as ball=#3f87c5."),
    ] = None,
    opacity: Annotated[
        list[str] | None, typer.Option(metavar="NAME=PART", rich_help_panel=BODIES, help="Opacity of a body, such as wall=0.3.")
    ] = None,
    hide: Annotated[list[str] | None, typer.Option(metavar="NAME", rich_help_panel=BODIES, help="Leaves a body out.")] = None,
    obstacles: Annotated[
        Obstacles | None, typer.Option(rich_help_panel=BODIES, help="auto: translucent where they hide bodies.")
    ] = None,
    background: Annotated[
        str | None, typer.Option(metavar="COLOR", rich_help_panel=STYLE, help='A colour, or "transparent" for .png.')
    ] = None,
    ground: Annotated[
        str | None,
        typer.Option(
            metavar="auto|none|Y", rich_help_panel=STYLE, help="Draws large flat obstacles as ground; or one at a height, m."
        ),
    ] = None,
    sharp_edge: Annotated[
        float | None,
        typer.Option(
            metavar="DEGREES", rich_help_panel=STYLE, help="Sharper edges are not shaded smoothly; 0: flat triangles."
        ),
    ] = None,
    edges: Annotated[bool, typer.Option("--edges", rich_help_panel=STYLE, help="Draws the edges of meshes.")] = False,
    wireframe: Annotated[bool, typer.Option("--wireframe", rich_help_panel=STYLE, help="Draws nothing but edges.")] = False,
    no_shadows: Annotated[
        bool, typer.Option("--no-shadows", rich_help_panel=STYLE, help="Leaves shadows and shade out.")
    ] = False,
) -> None:
    """Make a picture or a film of a run. Options come before what the scene says in its tables `picture` and `look`."""
    from pdipc.output.results import open_run
    from pdipc.pictures import render as pictures

    suffix = out.suffix.lower()
    if suffix not in (*pictures.STILL, *pictures.MOVING):
        raise typer.BadParameter(
            f'"{out}"; it must end in one of: {", ".join((*pictures.STILL, *pictures.MOVING))}', param_hint="--output"
        )
    still = suffix in pictures.STILL
    for option, given, wanted in (
        ("--frame", frame, True),
        ("--frames", frames, False),
        ("--every", every, False),
        ("--fps", fps, False),
    ):
        if given is not None and still is not wanted:
            raise typer.BadParameter(f'has no effect on "{out}", a {"picture" if still else "film"}', param_hint=option)
    given = {
        "size": _numbers(size, "--size", "x", 2, "1280x800", int),
        "view": _numbers(view, "--view", ",", 3, "0.7,0.42,1"),
        "position": _numbers(position, "--position", ",", 3, "2,1,3"),
        "target": _numbers(target, "--target", ",", 3, "0,0.5,0"),
        "zoom": zoom,
        "frames": _numbers(frames, "--frames", ":", 2, "10:-1", int),
        "every": every,
        "fps": fps,
        "color": color and color.value,
        "top": top,
        "obstacles": obstacles and obstacles.value,
        "background": background,
        "ground": _height(ground),
        "sharp_edge": sharp_edge,
        "edges": edges or None,
        "wireframe": wireframe or None,
        "shadows": False if no_shadows else None,
    }
    _checked({}, {**given, "top": None})  # of the options alone: these errors name them
    outside_of_runs(out)
    opened = open_run(folder)
    if position or view:
        _drop(opened, "position", "view")
    settings = _checked(opened.scene.get("picture") or {}, given)
    _repaint(opened, paint or [], opacity or [], hide or [])
    if still:
        pictures.render(opened, -1 if frame is None else frame, out, settings)
    else:
        taken = pictures.taken(opened, settings)[0]
        field = None
        if settings.color == "pressure":
            with progress("pressure", len(taken)) as advance:
                field = pictures.pressure(opened, taken, settings.top, lambda done: advance(done, ""))
        with progress("frame", len(taken)) as advance:
            pictures.render_animation(opened, out, settings, field, lambda done, of: advance(done, ""))
    typer.echo(str(out))


def _numbers(text: str | None, option: str, between: str, count: int, like: str, kind: type = float) -> tuple | None:
    """The numbers of an option such as 1280x800."""
    try:
        numbers = None if text is None else tuple(kind(part) for part in text.lower().split(between))
        if numbers is not None and len(numbers) != count:
            raise ValueError
    except ValueError:
        raise typer.BadParameter(f'"{text}"; it must be like {like}', param_hint=option) from None
    return numbers


def _height(ground: str | None) -> str | float | None:
    try:
        return ground if ground in (None, "auto", "none") else float(ground)
    except ValueError:
        raise typer.BadParameter(f'"{ground}"; it must be auto, none or a height, m', param_hint="--ground") from None


def _checked(scene: dict[str, Any], given: dict[str, Any]) -> "Picture":
    """The scene's settings with those that are given. Raises BadParameter that names the option."""
    from pdipc.scene.errors import SceneError
    from pdipc.scene.looks import Picture

    options = {name: value for name, value in given.items() if value is not None}
    try:
        return Picture(**{**scene, **options})
    except SceneError as error:
        name = next((name for name in options if str(error).startswith(name)), None)
        said = str(error).removeprefix(f"{name}: ")
        raise typer.BadParameter(said, param_hint=name and f"--{name.replace('_', '-')}") from None


def _drop(opened: "Run", *names: str) -> None:
    """Forgets settings of the scene's that an option stands for."""
    opened.scene["picture"] = {name: value for name, value in (opened.scene.get("picture") or {}).items() if name not in names}


def _repaint(opened: "Run", paint: list[str], opacity: list[str], hide: list[str]) -> None:
    """Puts looks into the run's scene, as it is in memory."""
    placed = {each["name"]: each for each in (*opened.scene["bodies"], *opened.scene.get("obstacles", ()))}
    for option, entries in (("--paint", paint), ("--opacity", opacity), ("--hide", [f"{name}=" for name in hide])):
        for entry in entries:
            name, equals, value = entry.rpartition("=")
            if not equals:
                raise typer.BadParameter(
                    f'"{entry}"; it must be like ball={"red" if option == "--paint" else "0.3"}', param_hint=option
                )
            if name not in placed:
                raise typer.BadParameter(f'"{name}" is no body of the scene; it has: {", ".join(placed)}', param_hint=option)
            look = placed[name]["look"] = placed[name].get("look") or {}
            if option == "--hide":
                look["visible"] = False
            else:
                look[option[2:].replace("paint", "color")] = _look(option, value)


def _look(option: str, value: str) -> Any:
    """A colour or an opacity. Raises BadParameter for what is none."""
    from pdipc.scene.errors import SceneError
    from pdipc.scene.looks import Look

    try:
        return Look(color=value).color if option == "--paint" else Look(opacity=float(value)).opacity
    except (SceneError, ValueError) as error:
        raise typer.BadParameter(str(error), param_hint=option) from None


@command()
def export(
    folder: RunArgument,
    to: Annotated[
        Format,
        typer.Option(
            "--format",
            help="usd: one animated file; stage: a layer over the USD stage that the scene's meshes came from; mdd, pc2: point caches, a "
            "file a body; ply, obj: a file a frame; vtk: PVD and VTU; paraview: one file with a piece a body, velocity, displacement and pressure.",
        ),
    ],
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="PATH", help="Default: beside the run folder.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Takes every so many frames.")] = 1,
    bodies: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only this body or obstacle, with all its copies; may be given several times."),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(min=0.001, help="Frames a second of a USD file; default: the run's. Frames keep their times."),
    ] = None,
) -> None:
    """Write the frames of a run for other programs."""
    from pdipc.export import export as exports
    from pdipc.output.results import open_run

    outside_of_runs(out)
    opened = open_run(folder)
    resolved = folder.resolve()
    suffix = {Format.usd: ".usdc", Format.stage: "_stage.usda", Format.paraview: ".vtkhdf"}.get(to, f"_{to.value}")
    default = resolved.with_name(resolved.name + suffix)
    typer.echo(str(exports.export(exports.Excerpt(opened, every, bodies or None), to.value, out or default, fps)))


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
    record: Annotated[Path | None, typer.Option(metavar="DIR", help="Writes what is simulated into a new run folder.")] = None,
) -> None:
    """Watch a run, or a scene while it is simulated, in the browser; there, bodies can be dragged with the mouse.

    The address that is printed has a token in it, which is new each time: whoever has it may watch and drag.
    """
    from pdipc import viewer
    from pdipc.output.results import open_run

    if Path(what).is_dir():
        for option, given in (("--record", record), ("--device", device)):
            if given is not None:
                raise typer.BadParameter(f"has no effect on {what}, a run that is played back", param_hint=option)
        viewer.play(open_run(what), host, port, allow or ())
    else:
        watched = what if Path(what).is_file() else None  # an edited scene is read again; bundled ones stay as they are
        viewer.simulate(load(what), host, port, device, allow or (), record, watched)
