"""The command line: run, check, certify, render, export, ...

Errors are one message. Exit codes: 0 good, 1 failure, 2 usage, or input that cannot be read or simulated.
"""

import functools
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    import numpy as np

    from pdipc.output.render import Field
    from pdipc.output.results import Run
    from pdipc.scene.schema import Scene

INTERRUPTED = 130  # what shells expect after Ctrl-C
LISTED = 20  # intersecting pairs that `check` prints of a frame

app = typer.Typer(
    help="Soft bodies and cloth in contact that never pass through each other.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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


class Precision(StrEnum):
    """Working precisions."""

    auto = "auto"
    float32 = "float32"
    float64 = "float64"


SceneArgument = Annotated[str, typer.Argument(metavar="SCENE", help="A .toml or .json file, or the name of a bundled scene.")]
RunArgument = Annotated[Path, typer.Argument(metavar="DIR", help="A run folder, as `pdipc run` writes it.")]


def fail(message: str, code: int = 1) -> NoReturn:
    """Prints one message to stderr and ends with an exit code."""
    typer.echo(f"pdipc: {message}", err=True)
    raise typer.Exit(code)


def _tell(message: Warning | str, category: type[Warning], *where: Any) -> None:
    """Prints what a scene's files leave out as a line of its own; other warnings as Python does."""
    from pdipc.scene.errors import SceneWarning

    if issubclass(category, SceneWarning):
        typer.echo(f"pdipc: note: {message}", err=True)
    else:
        typer.echo(warnings.formatwarning(message, category, *where[:2]), err=True, nl=False)


def command(*args: Any, **kwargs: Any) -> Callable[[Callable], Callable]:
    """Registers a command whose expected errors become one message without a traceback."""

    def register(function: Callable) -> Callable:
        @app.command(*args, **kwargs)
        @functools.wraps(function)
        def guarded(*given: Any, **options: Any) -> None:
            from pdipc.output.results import RunError
            from pdipc.scene.errors import SceneError

            try:
                with warnings.catch_warnings():
                    warnings.showwarning = _tell
                    function(*given, **options)
            except BrokenPipeError:
                # the reader, such as `head`, has seen enough; nothing more can be printed, not even at exit
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise typer.Exit(1) from None
            except (RunError, OSError, ValueError, IndexError) as error:  # SceneError is a ValueError
                if "PDIPC_TRACEBACK" in os.environ:
                    raise
                said, scene = str(error), str(options.get("scene", ""))
                if isinstance(error, SceneError) and scene not in said:
                    said = f'"{scene}": {said}'
                fail(said, 2 if isinstance(error, SceneError | RunError) else 1)
            except ImportError as error:
                fail(_missing(error))
            except KeyboardInterrupt:
                typer.echo("pdipc: interrupted", err=True)
                raise typer.Exit(INTERRUPTED) from None

        return guarded

    return register


EXTRAS = {
    "pictures": ("pyvista", "vtkmodules", "imageio", "matplotlib"),
    "usd": ("pxr",),
    "viewer": ("viser",),
    "witness": ("ipctk",),
    "tetrahedralize": ("pytetwild",),
    "benchmarks": ("cholespy",),
}


def _missing(error: ImportError) -> str:
    package = (error.name or "").partition(".")[0]
    for extra, packages in EXTRAS.items():
        if package in packages:
            return f'this needs the package "{package}"; install it with: pip install "pdipc[{extra}]"'
    return str(error)


def _version(wanted: bool) -> None:
    if wanted:
        from pdipc import __version__

        typer.echo(f"pdipc {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Soft bodies and cloth in contact that never pass through each other."""


# --- running ---


@command()
def run(
    scene: SceneArgument,
    out: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Run folder; default: runs/<scene>.")
    ] = None,
    device: Annotated[str | None, typer.Option(help='"cpu" or "cuda:0"; default: the scene\'s, else CUDA if present.')] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Number of steps; default: the scene's.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint in the run folder.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in the folder.")] = False,
    budget_ms: Annotated[
        float | None, typer.Option(min=0.001, help="No further outer iteration of a step after this time, ms.")
    ] = None,
    certify: Annotated[bool, typer.Option("--certify", help="Record every motion for `pdipc certify`.")] = False,
    solver: Annotated[str | None, typer.Option(help="Linear solver of the global step.")] = None,
    precision: Annotated[Precision | None, typer.Option(help="Working precision.")] = None,
    audited: Annotated[
        bool, typer.Option("--audit", help="Print energies and momenta at the end, as `pdipc audit` does.")
    ] = False,
) -> None:
    """Simulate a scene into a folder."""
    from pdipc.output.results import open_run

    if resume and overwrite:
        raise typer.BadParameter("--resume and --overwrite exclude each other")
    loaded = load(scene)
    overrides = {"linear_solver": solver, "precision": precision and precision.value, "budget_ms": budget_ms}
    for name, value in overrides.items():
        if value is not None:
            _override(loaded, name, value)
    folder = out or Path("runs") / Path(scene).stem
    begun = 0
    if resume:
        earlier = open_run(folder)
        begun = earlier.frame_count - 1
        _same_scene(earlier, loaded, folder)
        device = _same_device(earlier, device, folder)

    from pdipc.simulation import run_scene

    total = loaded.simulation.steps if steps is None else steps
    began = time.monotonic()
    done = None

    def advanced(info) -> None:
        nonlocal done
        done = info.step
        advance(info)

    try:
        with _progress(total) as advance:
            run_scene(
                loaded,
                folder,
                steps=steps,
                device=device,
                resume=resume,
                overwrite=overwrite,
                certify=certify,
                progress=advanced,
            )
    except KeyboardInterrupt:
        if done is None:
            typer.echo("pdipc: interrupted before a step was taken", err=True)
            raise typer.Exit(INTERRUPTED) from None
        options = "".join(
            f" {name} {value}"
            for name, value in (
                ("--steps", steps),
                ("--solver", solver),
                ("--precision", precision and precision.value),
                ("--budget-ms", budget_ms),
            )
            if value is not None
        )
        typer.echo(
            f"pdipc: stopped after step {done} of {total}, everything is saved in {folder}; go on with:\n"
            f"  pdipc run {scene} -o {folder}{options}{' --certify' if certify else ''} --resume",
            err=True,
        )
        raise typer.Exit(INTERRUPTED) from None
    if resume and begun >= total:
        typer.echo(f"{folder} has {begun} steps already; nothing was added to it")
    _summary(folder, time.monotonic() - began)
    if audited:
        audit(folder)


def load(scene: str) -> "Scene":
    """The scene of a file or bundled name, or that of a run folder."""
    from pdipc.scene.load import load_scene

    return load_scene(scene_file(scene))


def scene_file(scene: str) -> str | Path:
    """The scene file of a run folder; anything else as it is."""
    from pdipc.scene.meshes import is_file

    folder = Path(scene)
    return folder / "scene.json" if is_file(folder / "run.json") else scene


def _override(scene: "Scene", name: str, value: Any) -> None:
    from pdipc.scene.errors import SceneError

    try:
        setattr(scene.simulation, name, value)
    except SceneError as error:
        option = "solver" if name == "linear_solver" else name.replace("_", "-")
        said = str(error).partition(": ")[2]
        raise typer.BadParameter(f'"{value}": {said}', param_hint=f"--{option}") from None


def _same_scene(earlier: "Run", scene: "Scene", folder: Path) -> None:
    """Raises RunError where a resumed run would not be the one that began."""
    import json

    from pdipc.output.results import RunError

    def differing(a: Any, b: Any, path: str) -> str | None:
        if isinstance(a, dict) and isinstance(b, dict):
            for name in sorted({*a, *b}):
                found = differing(a.get(name), b.get(name), f"{path}.{name}" if path else name)
                if found:
                    return found
            return None
        if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
            return next(filter(None, (differing(*both, f"{path}[{i}]") for i, both in enumerate(zip(a, b, strict=True)))), None)
        return None if a == b else path

    then, now = earlier.scene, json.loads(scene.model_dump_json())
    for data in (then, now):
        data.get("simulation", {}).pop("steps", None)
    where = differing(then, now, "")
    if where:
        raise RunError(f"{folder} holds a run of another scene ({where} differs); resume it with its own scene and options")


def _same_device(earlier: "Run", device: str | None, folder: Path) -> str | None:
    from pdipc.output.results import RunError

    used = earlier.meta.get("device")
    if device is not None and used is not None and device != used:
        raise RunError(f"{folder} was run on {used}; going on with --device {device} would not give the same results")
    return used


@contextmanager
def _progress(total: int):
    """Yields a function to call after each step. Ctrl-C raises KeyboardInterrupt there, between two steps; twice, at once."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    interrupted = False

    def interrupt(signum, frame) -> None:
        nonlocal interrupted
        at_once, interrupted = interrupted or not stepping, True
        if at_once:
            raise KeyboardInterrupt

    bar = Progress(
        TextColumn("step"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[told]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
    stepping = False
    last = time.monotonic()
    previous = signal.signal(signal.SIGINT, interrupt)
    try:
        with bar:
            task = bar.add_task("step", total=total, told="preparing")

            def advance(info) -> None:
                nonlocal stepping, last
                stepping, now, result = True, time.monotonic(), info.result
                told = f"outer {result.outer:<3d} contacts {result.barriers:<6d} gap {metres(result.smallest_gap)}"
                bar.update(task, completed=info.step, total=info.steps, told=f"{told}  {1000 * (now - last):.0f} ms/step")
                last = now
                if interrupted:
                    raise KeyboardInterrupt

            yield advance
    except Exception:
        if interrupted:  # some libraries turn an interrupt into an error of their own, or lose it: `advance` raises it then
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, previous)


def metres(length: float | None) -> str:
    """A length for people: "1.20 mm"; "none" where it is None or infinite."""
    if length is None or length == float("inf"):
        return "none"
    for unit, size in (("m", 1.0), ("mm", 1e-3), ("um", 1e-6)):
        if abs(length) >= size:
            return f"{length / size:.3g} {unit}"
    return f"{length / 1e-9:.3g} nm"


def _summary(folder: Path, seconds: float) -> None:
    from pdipc.output.results import open_run

    done = open_run(folder)
    gaps = [record["smallest_gap"] for record in done.stats if record.get("smallest_gap") is not None]
    stopped = sum(not record.get("converged", True) for record in done.stats)
    typer.echo(f"{folder}: {done.frame_count - 1} steps, {done.times[-1]:g} s simulated, {seconds:.1f} s of work")
    typer.echo(f"smallest gap {metres(min(gaps, default=None))}")
    if stopped:
        typer.echo(f"{stopped} steps ended at the limit of outer iterations before convergence; they are free of intersections")


# --- judging ---


@command()
def check(folder: RunArgument) -> None:
    """Judge every frame with the independent, exact intersection test; exit code 1 if anything intersects."""
    from pdipc.judge.witness import find_intersections
    from pdipc.output.results import open_run

    opened = open_run(folder)
    bad = 0
    for frame in range(opened.frame_count):
        pairs = find_intersections(opened.positions(frame), opened.triangles, opened.obstacle)
        if len(pairs):
            bad += 1
            typer.echo(f"frame {frame}, t = {opened.times[frame]:g} s: {len(pairs)} pairs of triangles intersect")
            _print_pairs(opened, pairs)
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
    certificate = replay(opened)
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


@command("check-scene")
def check_scene(scene: SceneArgument) -> None:
    """List everything that keeps a scene from being simulated; exit code 2 if something cannot be read, else 1 if there is anything."""
    from pdipc.scene.check import check_file

    findings, notes = check_file(scene_file(scene))
    for note in notes:
        typer.echo(f"note: {note}")
    for finding in findings:
        typer.echo(f"- {finding}")
    if findings:
        fail(f"{scene}: {len(findings)} to put right", 1 if all(finding.readable for finding in findings) else 2)
    typer.echo(f"{scene}: can be simulated")


@command()
def audit(
    folder: RunArgument,
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Plot it: .png, .svg or .pdf.")] = None,
    forces: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write contact forces, N, and pressures, Pa, at every vertex: .npz.")
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Takes every so many frames.")] = 1,
) -> None:
    """Energies, momenta and contact forces of a run, step by step."""
    import numpy as np

    from pdipc import audit as audits
    from pdipc.output.results import open_run

    opened = open_run(folder)
    if forces is not None and forces.suffix != ".npz":
        raise typer.BadParameter(f'"{forces}"; it must end in .npz', param_hint="--forces")
    if out is not None and out.suffix not in (".png", ".svg", ".pdf"):
        raise typer.BadParameter(f'"{out}"; it must end in one of: .png, .svg, .pdf', param_hint="--output")
    taken = range(0, opened.frame_count, every)
    typer.echo(_AUDIT_HEAD)
    rows, resultants, at_vertices = [], [], []
    for frame, state in zip(taken, audits.replay(opened, taken), strict=True):
        row = audits.audit(*state)
        momenta = " ".join(f"{value:11.4g}" for value in (*row.linear_momentum, *row.angular_momentum))
        energies = " ".join(f"{value:11.4g}" for value in (row.kinetic, row.elastic, row.barrier, row.gravity, row.total))
        typer.echo(f"{opened.records[frame]['step']:6} {energies} {momenta}")
        rows.append(row)
        resultants.append(audits.body_forces(*state))
        if forces is not None:
            at_vertices.append((audits.contact_forces(*state), audits.contact_pressures(*state)))
    if forces is not None:
        force, pressure = (np.array(values, dtype=np.float32) for values in zip(*at_vertices, strict=True))
        np.savez_compressed(forces, time=opened.times[taken], force=force, pressure=pressure)
        typer.echo(str(forces))
    if out is not None:
        from pdipc.output.plot import plot_audits

        plot_audits(rows, resultants, out)
        typer.echo(str(out))


_AUDITED = ("kinetic", "elastic", "barrier", "gravity", "total", "px", "py", "pz", "Lx", "Ly", "Lz")
_AUDIT_HEAD = (
    "energies in J, momentum p in kg m/s, angular momentum L about the origin in kg m^2/s; without what is scripted\n"
    + " ".join(["  step", *(f"{name:>11}" for name in _AUDITED)])
)


# --- looking ---


@command()
def info(what: Annotated[str, typer.Argument(metavar="DIR|SCENE", help="A run folder or a scene.")]) -> None:
    """Describe a run or a scene."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from pdipc.output.results import open_run
    from pdipc.scene.assembly import assemble

    console = Console(soft_wrap=True, highlight=False)
    path = Path(what)
    opened = open_run(path) if path.is_dir() else None
    scene = load(what)
    assembly = assemble(scene)
    console.print(f"{scene.title or what}", style="bold")
    if scene.description:
        console.print(scene.description)
    table = Table(box=box.SIMPLE)
    for name in ("body", "kind", "vertices", "triangles", "tets"):
        table.add_column(name, justify="left" if name in ("body", "kind") else "right")
    for body in assembly.bodies:
        table.add_row(body.name, body.kind, str(body.last - body.first), str(len(body.triangles)), str(len(body.tets)))
    console.print(table)
    sim = scene.simulation
    console.print(f"{sim.steps} steps of {sim.time_step:g} s, linear solver {sim.linear_solver}, precision {sim.precision}")
    console.print(
        f"size {metres(assembly.scene_size)}, activation distance {metres(assembly.activation_distance)}, "
        f"minimum separation {metres(assembly.minimum_separation)}"
    )
    if opened is not None:
        made = ", ".join(f"{name} {value}" for name, value in opened.meta.items() if name != "format")
        console.print(f"{opened.frame_count} frames, {opened.times[-1] if opened.frame_count else 0:g} s; {made}")
        gaps = [record["smallest_gap"] for record in opened.stats if record.get("smallest_gap") is not None]
        spent = [sum(record["milliseconds"].values()) for record in opened.stats if record.get("milliseconds")]
        if spent:
            console.print(
                f"median {sorted(spent)[len(spent) // 2]:.1f} ms a step, smallest gap {metres(min(gaps, default=None))}"
            )


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

    from pdipc.audit import contact_pressures, replay
    from pdipc.output.render import Field

    found = dict(zip(frames, (contact_pressures(*state) for state in replay(opened, frames)), strict=True))
    loaded = np.concatenate([values[values > 0.0] for values in found.values()])
    return Field("contact pressure, Pa", found.__getitem__, float(np.quantile(loaded, 0.99)) if len(loaded) else 1.0)


@command()
def export(
    folder: RunArgument,
    to: Annotated[Format, typer.Option("--format", help="usd: one animated file; ply, obj: a file a frame; vtk: PVD and VTU.")],
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="PATH", help="Default: beside the run folder.")] = None,
) -> None:
    """Write the frames of a run for other programs."""
    from pdipc.output import export as exports
    from pdipc.output.results import open_run

    opened = open_run(folder)
    resolved = folder.resolve()
    default = resolved.with_name(f"{resolved.name}.usdc" if to is Format.usd else f"{resolved.name}_{to.value}")
    typer.echo(str(exports.export(opened, to.value, out or default)))


@command()
def scenes(plain: Annotated[bool, typer.Option("--plain", help="Names only, one a line.")] = False) -> None:
    """List the bundled scenes; they can be run by name."""
    from pdipc.scene.load import bundled_scenes

    names = bundled_scenes()
    width = max(map(len, names), default=0)
    for name, path in names.items():
        if plain:
            typer.echo(name)
        else:
            import tomllib

            typer.echo(f"{name:{width}}  {tomllib.loads(path.read_text(encoding='utf-8')).get('title', '')}")


@command()
def view(
    what: Annotated[str, typer.Argument(metavar="DIR|SCENE", help="A run folder to play, or a scene to simulate live.")],
    host: Annotated[str, typer.Option(help='Who may watch: "localhost", or "0.0.0.0" for other machines too.')] = "localhost",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page; if it is taken, the next free one.")] = 8080,
    device: Annotated[str | None, typer.Option(help='"cpu" or "cuda:0".')] = None,
) -> None:
    """Watch a run, or a scene while it is simulated, in the browser; there, bodies can be dragged with the mouse."""
    from pdipc import viewer
    from pdipc.output.results import open_run

    if Path(what).is_dir():
        viewer.play(open_run(what), host, port)
    else:
        viewer.simulate(load(what), host, port, device)


@command()
def reproduce(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A figure or table of the paper, such as fig7.")],
    small: Annotated[bool, typer.Option("--small", help="A few minutes' version.")] = False,
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="Default: reproduced/<name>.")] = None,
) -> None:
    """Make a figure or table of the paper again."""
    import importlib
    import pkgutil

    known: list[str] = []
    try:
        package = importlib.import_module("pdipc.reproduce")
        known = sorted(module.name for module in pkgutil.iter_modules(package.__path__) if not module.name.startswith("_"))
    except ModuleNotFoundError as error:
        if error.name != "pdipc.reproduce":
            raise
    if name not in known:
        raise typer.BadParameter(f'"{name}"; there are: {", ".join(known) or "none"}', param_hint="NAME")
    importlib.import_module(f"pdipc.reproduce.{name}").run(out or Path("reproduced") / name, small)


if __name__ == "__main__":
    sys.exit(app())
