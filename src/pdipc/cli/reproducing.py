"""`pdipc reproduce`: the figures and tables of the paper."""

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from pdipc.cli.app import command, outside_of_runs


def _known() -> dict[str, str]:
    """Names of figures and tables, and what each shows: the first line of its module, which is not run for that."""
    import pdipc.reproduce

    found = {}
    for module in pkgutil.iter_modules(pdipc.reproduce.__path__):
        if not module.name.startswith("_"):
            source = Path(pdipc.reproduce.__path__[0], f"{module.name}.py").read_text(encoding="utf-8")
            found[module.name] = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
    return dict(sorted(found.items(), key=lambda each: (each[0].rstrip("0123456789"), len(each[0]), each[0])))


def _complete(begun: str) -> Iterator[str]:
    return (name for name in _known() if name.startswith(begun))


def _list(wanted: bool) -> None:
    if wanted:
        known = _known()
        for name, told in known.items():
            typer.echo(f"{name:{max(map(len, known))}}  {told}")
        raise typer.Exit


@command()
def reproduce(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="A figure or table of the paper, such as fig7.", autocompletion=_complete)
    ],
    small: Annotated[bool, typer.Option("--small", help="A few minutes' version.")] = False,
    out: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="Default: reproduced/<name>.")] = None,
    rows: Annotated[
        str | None, typer.Option("--rows", metavar="ROW,ROW", help="Of a table: these rows only, such as dragon,skirt.")
    ] = None,
    mode: Annotated[
        str | None, typer.Option("--mode", metavar="MODE", help="Of a table: default, paper or both.", show_default=False)
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Of a table: steps of each row.")] = None,
    listed: Annotated[
        bool, typer.Option("--list", callback=_list, is_eager=True, help="Tell which there are, and what they show.")
    ] = False,
) -> None:
    """Make a figure or table of the paper again."""
    known = _known()
    if name not in known:
        raise typer.BadParameter(f'"{name}"; there are: {", ".join(known)}', param_hint="NAME")
    outside_of_runs(out)
    if mode not in (None, "default", "paper", "both"):
        raise typer.BadParameter(f'"{mode}"; it must be default, paper or both', param_hint="--mode")
    run = importlib.import_module(f"pdipc.reproduce.{name}").run
    named = None if rows is None else [row.strip() for row in rows.split(",")]
    given = {key: value for key, value in (("rows", named), ("mode", mode), ("steps", steps)) if value is not None}
    if useless := sorted(given.keys() - inspect.signature(run).parameters.keys()):
        raise typer.BadParameter(f"{name} has none; it is for tables, such as table1", param_hint=f"--{useless[0]}")
    run(out or Path("reproduced") / name, small, **given)
