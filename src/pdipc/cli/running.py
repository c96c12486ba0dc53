"""`pdipc run`, and `pdipc info`, which tells what came of it."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pdipc.cli.app import SceneArgument, command, load, metres

if TYPE_CHECKING:
    from pdipc.scene.assembly import Assembly
    from pdipc.scene.schema import Scene
    from pdipc.simulation import StepInfo


class Precision(StrEnum):
    """Working precisions."""

    auto = "auto"
    float32 = "float32"
    float64 = "float64"


def _runner(several: bool) -> Callable[..., Any]:
    """What runs a scene, or its worlds; imported late, since `--help` is to be quick."""
    if several:
        from pdipc.sweeps.worlds import run_worlds as run
    else:
        from pdipc.simulation import run_scene as run
    return run


# Arguments: the options of the command.
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
    forces: Annotated[
        bool, typer.Option("--forces", help="Record contact forces on every vertex, not only on bodies and between them.")
    ] = False,
    solver: Annotated[str | None, typer.Option(help="Linear solver of the global step.")] = None,
    precision: Annotated[Precision | None, typer.Option(help="Working precision.")] = None,
    audited: Annotated[
        bool, typer.Option("--audit", help="Print energies and momenta at the end, as `pdipc audit` does.")
    ] = False,
) -> None:
    """Simulate a scene into a folder. Ctrl-C ends it after a step; --resume goes on as if it had never been stopped."""
    from rich.console import Console

    from pdipc.output.progress import bar_of_steps
    from pdipc.output.results import open_run

    if resume and overwrite:
        raise typer.BadParameter("--resume and --overwrite exclude each other")
    loaded = load(scene)
    overrides = {"linear_solver": solver, "precision": precision and precision.value, "budget_ms": budget_ms}
    for name, value in overrides.items():
        if value is not None:
            _override(loaded, name, value)
    folder = out or Path("runs") / Path(scene).stem
    several = loaded.worlds is not None
    if several and audited:
        raise typer.BadParameter("of several worlds each is audited by itself: pdipc audit DIR/0000", param_hint="--audit")
    begun = open_run(folder).frame_count - 1 if resume and not several else 0
    total = loaded.simulation.steps if steps is None else steps
    began = time.monotonic()
    stop = Stop()
    try:
        with stop.after_steps(), bar_of_steps(total, Console(stderr=True)) as bar:

            def advance(info: "StepInfo") -> None:
                nonlocal total
                total = info.steps  # of all worlds
                bar(info)
                stop.step_done(info.step)

            options = {"resume": resume, "overwrite": overwrite, "certify": certify, "forces": forces}
            _runner(several)(loaded, folder, steps=steps, device=device, progress=advance, **options)
    except KeyboardInterrupt:
        if stop.done is None:
            typer.echo("pdipc: interrupted before a step was taken", err=True)
        else:
            given = {
                "--steps": steps,
                "--solver": solver,
                "--precision": precision and precision.value,
                "--budget-ms": budget_ms,
            }
            said = "".join(f" {name} {value}" for name, value in given.items() if value is not None)
            typer.echo(
                f"pdipc: stopped after step {stop.done} of {total}, everything is saved in {folder}; go on with:\n"
                f"  pdipc run {scene} -o {folder}{said}{' --certify' if certify else ''}{' --forces' if forces else ''} --resume",
                err=True,
            )
        raise typer.Exit(128 + stop.signal) from None  # what shells expect
    if several:
        _summary_of_worlds(folder, time.monotonic() - began)
        return
    if resume and begun >= total:
        typer.echo(f"{folder} has {begun} steps already; nothing was added to it")
    _summary(folder, time.monotonic() - began)
    if audited:
        from pdipc.cli.judging import audit

        audit(folder)


def _override(scene: "Scene", name: str, value: Any) -> None:
    from pdipc.scene.errors import SceneError

    try:
        setattr(scene.simulation, name, value)
    except SceneError as error:
        option = "solver" if name == "linear_solver" else name.replace("_", "-")
        said = str(error).partition(": ")[2]
        raise typer.BadParameter(f'"{value}": {said}', param_hint=f"--{option}") from None


class Stop:
    """Ctrl-C and SIGTERM: they raise KeyboardInterrupt between two steps; before the first step, or given twice, at once.

    done: the last step that was told, None before the first. signal: the one that came.
    """

    def __init__(self) -> None:
        self.done: int | None = None
        self.signal = signal.SIGINT
        self._wanted = False

    @contextmanager
    def after_steps(self) -> Iterator[None]:
        """Takes the signals over."""
        taken = [signal.SIGINT, signal.SIGTERM]
        previous = [signal.signal(each, self._heard) for each in taken]
        try:
            yield
        except Exception:
            if (
                self._wanted
            ):  # some libraries turn an interrupt into an error of their own, or lose it: `step_done` raises it then
                raise KeyboardInterrupt from None
            raise
        finally:
            for each, handler in zip(taken, previous, strict=True):
                signal.signal(each, handler)

    def _heard(self, number: int, _: object) -> None:
        at_once = self._wanted or self.done is None
        self._wanted, self.signal = True, signal.Signals(number)
        if at_once:
            raise KeyboardInterrupt

    def step_done(self, step: int) -> None:
        """To be called between two steps."""
        self.done = step
        if self._wanted:
            raise KeyboardInterrupt


def _summary(folder: Path, seconds: float) -> None:
    from pdipc.output.results import open_run
    from pdipc.output.summary import smallest_gap

    done = open_run(folder)
    typer.echo(f"{folder}: {done.frame_count - 1} steps, {done.times[-1]:g} s simulated, {seconds:.1f} s in all")
    typer.echo(f"smallest gap {metres(smallest_gap(done))}")
    stopped = sum(not record.get("converged", True) for record in done.stats)
    if stopped:
        typer.echo(f"{stopped} steps ended at the limit of outer iterations before convergence; they are free of intersections")


def _summary_of_worlds(folder: Path, seconds: float) -> None:
    from pdipc.output.results import open_run
    from pdipc.output.summary import smallest_gap

    runs = [open_run(own.parent) for own in sorted(folder.glob("*/run.json"))]
    steps = sum(len(run.stats) for run in runs)
    typer.echo(f"{folder}: {len(runs)} worlds in folders 0000 to {len(runs) - 1:04d}, {steps} steps, {seconds:.1f} s of work")
    gaps = [gap for run in runs if (gap := smallest_gap(run)) is not None]
    typer.echo(f"smallest gap {metres(min(gaps, default=None))}")
    stopped = sum(not record.get("converged", True) for run in runs for record in run.stats)
    if stopped:
        typer.echo(f"{stopped} steps ended at the limit of outer iterations before convergence; they are free of intersections")
    typer.echo(str(folder / "table.csv"))


@command()
def info(what: Annotated[str, typer.Argument(metavar="DIR|SCENE", help="A run folder or a scene.")]) -> None:
    """Describe a run or a scene."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from pdipc.output.results import open_run
    from pdipc.output.summary import told_of
    from pdipc.scene.assembly import assemble

    console = Console(soft_wrap=True, highlight=False)
    path = Path(what)
    opened = open_run(path) if path.is_dir() else None
    scene = load(what)
    assembly = assemble(scene)
    console.print(f"{scene.title or what}", style="bold", markup=False)
    if scene.description:
        console.print(scene.description, markup=False)
    if scene.worlds is not None:
        console.print(
            f"{scene.worlds if isinstance(scene.worlds, int) else len(scene.worlds)} worlds; of each, before what is other in it:"
        )
    table = Table(box=box.SIMPLE)
    for name in ("body", "kind", "vertices", "triangles", "tets"):
        table.add_column(name, justify="left" if name in ("body", "kind") else "right")
    for body in assembly.bodies:
        table.add_row(body.name, body.kind, str(body.last - body.first), str(len(body.triangles)), str(len(body.tets)))
    console.print(table)
    for line in _pins(assembly):
        console.print(line, markup=False)
    sim = scene.simulation
    console.print(f"{sim.steps} steps of {sim.time_step:g} s, linear solver {sim.linear_solver}, precision {sim.precision}")
    console.print(
        f"size {metres(assembly.scene_size)}, activation distance {metres(assembly.activation_distance)}, "
        f"minimum separation {metres(assembly.minimum_separation)}"
    )
    if opened is not None:
        for line in told_of(opened, sim.steps):
            console.print(line, markup=False)


def _pins(assembly: "Assembly") -> Iterator[str]:
    """A line for each pin: what it holds, how, and when."""
    for pin in assembly.pins:
        axes = "".join(axis for axis, held in zip("xyz", pin.axes, strict=True) if held)
        how = "exactly" if pin.stiffness is None else f"by {pin.stiffness:g} N/m" + (f" along {axes}" if axes != "xyz" else "")
        with_what = f", moving with {assembly.bodies[pin.follow].name}" if pin.follow >= 0 else ""
        since = f", from {pin.start:g} s on" if pin.start > 0.0 else ""
        until = f", until {pin.end:g} s" if pin.end < float("inf") else ""
        yield f"pin of {pin.body}: {len(pin.vertices)} vertices, held {how}{with_what}{since}{until}"
