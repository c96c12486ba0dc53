"""Scenes: which come with the package, whether one can be simulated, how to write one."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pdipc.cli.app import SceneArgument, command, fail, load, outside_of_runs, scene_file

if TYPE_CHECKING:
    from pdipc.scene.finding import Finding


@command()
def scenes(plain: Annotated[bool, typer.Option("--plain", help="Names only, one a line.")] = False) -> None:
    """List the bundled scenes; they can be run by name."""
    import tomllib

    from pdipc.scene.load import bundled_scenes

    names = bundled_scenes()
    width = max(map(len, names), default=0)
    for name, path in names.items():
        title = "" if plain else tomllib.loads(path.read_text(encoding="utf-8")).get("title", "")
        typer.echo(name if plain else f"{name:{width}}  {title}")


@command("check-scene")
def check_scene(
    scene: SceneArgument,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the start, with what intersects in red: .png.")
    ] = None,
    repair: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Separate what intersects at the start, and write the scene with it: .toml."),
    ] = None,
) -> None:
    """List everything that keeps a scene from being simulated; exit code 2 if something cannot be read, else 1 if there is anything."""
    from pdipc.scene.check import check_file

    for option, path, suffix in (("--picture", picture, ".png"), ("--repair", repair, ".toml")):
        if path is not None and path.suffix != suffix:
            raise typer.BadParameter(f'"{path}"; it must end in {suffix}', param_hint=option)
        outside_of_runs(path, option)
    if picture is not None:
        _draw_start(scene, picture)
    if repair is not None:
        _repair(scene, repair)
        return
    findings, notes = check_file(scene_file(scene))
    for note in notes:
        typer.echo(f"note: {note}")
    _tell(scene, findings)
    typer.echo(f"{scene}: can be simulated")


def _tell(scene: str, findings: "list[Finding]") -> None:
    """Prints the findings, and ends the command where there are any."""
    for finding in findings:
        typer.echo(f"- {finding}")
    if findings:
        fail(f"{scene}: {len(findings)} to put right", 1 if all(finding.readable for finding in findings) else 2)


def _draw_start(scene: str, picture: Path) -> None:
    from pdipc.pictures.starts import draw_start
    from pdipc.scene.assembly import assemble
    from pdipc.scene.check import prepare

    loaded = load(scene)
    assembly = assemble(loaded)
    prepare(loaded, assembly, "float32" if loaded.simulation.precision == "float32" else "float64")
    pairs = draw_start(assembly, picture)
    typer.echo(f"{picture}: {pairs} pairs of triangles intersect at the start")


def _repair(scene: str, out: Path) -> None:
    from pdipc.scene.repair import repaired

    loaded = load(scene)
    made, moved, findings = repaired(loaded, "float32" if loaded.simulation.precision == "float32" else "float64")
    for note in moved:
        typer.echo(f"note: {note}")
    _tell(scene, findings)
    out.parent.mkdir(parents=True, exist_ok=True)
    made.save(out)
    typer.echo(f"{out}: can be simulated" + ("" if moved else "; nothing had to be moved"))


@command()
def new(file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to write; it ends in .toml.")]) -> None:
    """Write a commented scene to start from; it runs as it is."""
    if file.suffix != ".toml":
        raise typer.BadParameter(f'"{file}"; it must end in .toml', param_hint="FILE")
    outside_of_runs(file, "FILE")
    try:
        with open(file, "x", encoding="utf-8") as made:
            made.write(START)
    except FileExistsError:
        fail(f"{file} exists already; name another file")
    typer.echo(f"{file}: change it, then: pdipc check-scene {file}, pdipc view {file}, pdipc run {file}")


@command()
def schema(
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Default: print it.")] = None,
) -> None:
    """The JSON schema of scenes, for editors that complete and check TOML."""
    from pdipc.scene.schema import Scene

    text = json.dumps(Scene.model_json_schema(), indent=2) + "\n"
    if out is None:
        typer.echo(text, nl=False)
    else:
        out.write_text(text, encoding="utf-8")
        typer.echo(f"{out}: name it in the first line of a scene: #:schema {out}")


START = """\
# A scene of pdipc. Units are SI: m, kg, s, N, Pa; y points up; orientations are in degrees. Keys that are left out have defaults:
# docs/scene_format.md lists them all. `pdipc schema -o pdipc.schema.json` writes what an editor needs to complete and check this
# file; then begin it with the line:  #:schema pdipc.schema.json

title = "My scene"

[simulation]
time_step = 0.01                 # s
steps = 100
gravity = [0.0, -9.81, 0.0]      # m/s^2

[contact]
friction = 0.3                   # of all pairs; a body may set its own
# activation_distance = 1e-3     # m: surfaces nearer than this push each other off; default: 1e-3 of the scene's size

# A soft body. Its mesh is a shape (box, sphere, cylinder, capsule, torus) or a file of tetrahedra: mesh = "part.msh".
# A closed surface, such as an .obj, is filled with: tetrahedralize = true
[[bodies]]
name = "block"
kind = "solid"
mesh = { shape = "box", size = [0.2, 0.2, 0.2], cells = [4, 4, 4] }
translation = [0.0, 0.4, 0.0]    # m: the middle of the box goes here
rotation = [20.0, 0.0, 10.0]     # degrees, about x, then y, then z
material = { young_modulus = 1e5, poisson_ratio = 0.4, density = 1000.0 }   # Pa, 1, kg/m^3
# velocity = [0.0, -1.0, 0.0]    # m/s, at the start

# A cloth, held at two corners. Its mesh is a grid, or a file of triangles.
[[bodies]]
name = "cloth"
kind = "cloth"
mesh = { shape = "grid", size = [0.8, 0.8], cells = [24, 24] }
translation = [0.0, 0.2, 0.0]
material = { areal_density = 0.2, membrane_stiffness = 1000.0, bending_stiffness = 1e-4 }   # kg/m^2, N/m, N m

[[bodies.pins]]
select = { nearest = [-0.4, 0.2, -0.4] }   # or: box, sphere, vertices, all

[[bodies.pins]]
select = { nearest = [0.4, 0.2, -0.4] }

# Obstacles feel nothing; they rest, or move as told.
[[obstacles]]
name = "floor"
mesh = { shape = "plane", size = 4.0 }

# [[obstacles]]
# name = "ball"
# mesh = { shape = "sphere", radius = 0.08 }
# translation = [0.0, 0.09, 0.0]
# motion = { velocity = [0.1, 0.0, 0.0], end = 1.0 }

# [[forces]]
# kind = "wind"
# velocity = [3.0, 0.0, 0.0]     # m/s
"""
