"""What all commands share: the application, how errors are told, and the arguments that scenes and runs are named by."""

import functools
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from pdipc.output.summary import metres as metres

if TYPE_CHECKING:
    from pdipc.scene.schema import Scene

INTERRUPTED = 130  # what shells expect after Ctrl-C

ORDER = (
    *("scenes", "run", "info", "check", "render", "view", "audit", "certify", "export"),
    *("new", "check-scene", "schema", "sweep", "reproduce"),
)
LONGEST = 160  # letters of a command's line in the help


class Commands(TyperGroup):
    """The list of commands, told without Rich: that takes half of the time that its imports would."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Without arguments, that help."""
        return super().parse_args(ctx, args or ["--help"])

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """The help of the whole program, as Click writes it."""
        self.rich_markup_mode = None
        super().format_help(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Lists the commands in the order that a newcomer needs them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, self.commands[name].get_short_help_str(LONGEST)) for name in self.list_commands(ctx)])

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in that order."""
        return sorted(self.commands, key=ORDER.index)


app = typer.Typer(
    cls=Commands,
    help="Soft bodies and cloth in contact that never pass through each other.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

EXTRAS = {
    "pictures": ("pyvista", "vtkmodules", "imageio", "matplotlib"),
    "usd": ("pxr",),
    "alembic": ("alembic3d",),
    "viewer": ("viser", "websockets"),
    "witness": ("ipctk",),
    "tetrahedralize": ("pytetwild",),
    "benchmarks": ("cholespy",),
    "sweep": ("distributed", "dask"),
    "newton": ("newton",),
}


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

            for stream in (sys.stdout, sys.stderr):
                if isinstance(stream, io.TextIOWrapper):
                    stream.reconfigure(errors="backslashreplace")  # any name can be printed in any terminal
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

        return function

    return register


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


# --- arguments ---


def _complete(begun: str) -> Iterator[str]:
    """Bundled scenes, for the shell; files it completes itself."""
    from pdipc.scene.load import bundled_scenes

    return (name for name in bundled_scenes() if name.startswith(begun))


SceneArgument = Annotated[
    str,
    typer.Argument(metavar="SCENE", help="A .toml or .json file, or the name of a bundled scene.", autocompletion=_complete),
]
RunArgument = Annotated[Path, typer.Argument(metavar="DIR", help="A run folder, as `pdipc run` writes it.")]


def load(scene: str) -> "Scene":
    """The scene of a file or bundled name, or that of a run folder."""
    from pdipc.scene.load import load_scene

    return load_scene(scene_file(scene))


def scene_file(scene: str) -> str | Path:
    """The scene file of a run folder; anything else as it is."""
    from pdipc.scene.meshes import is_file

    folder = Path(scene)
    return folder / "scene.json" if is_file(folder / "run.json") else scene


def outside_of_runs(path: Path | None, option: str = "--output") -> None:
    """Refuses to write below a run folder, which holds nothing but its run, so that it can be told from other folders."""
    if path is None:
        return
    for folder in path.resolve().parents:
        if (folder / "run.json").is_file() and (folder / "stats.jsonl").is_file():
            raise typer.BadParameter(
                f'"{path}" is in the run folder {folder}, which holds nothing but its run; write beside it', param_hint=option
            )


# --- telling ---


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[int, str], None]]:
    """A bar on stderr, gone when it is done. Yields a function to call with how many of `total` are done, and words beside it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn(what), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.fields[told]}")]
    console = Console(stderr=True)
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total, told="")
        yield lambda done, told="": bar.update(task, completed=done, told=told)
