"""Sizes of the package: `python docs/measure_house.py [FOLDER]` prints a table and lists what is long or takes many arguments.

A function's lines are its own, without those of functions inside it. What is long or takes many arguments says why in a comment above it
that begins with `# Long:` or `# Arguments:`; `tests/test_house.py` asks for it, of kernels, too.
"""

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "src" / "pdipc"
LONG, MANY = 80, 10


@dataclass(frozen=True)
class Function:
    """One function: where it is, its own lines, how many arguments it takes beside self, what Warp makes of it, and why it may be long or take many."""

    name: str
    lines: int
    arguments: int
    is_kernel: bool
    is_called_by_kernels: bool
    reasons: str

    @property
    def is_long(self) -> bool:
        return self.lines > LONG

    @property
    def takes_many(self) -> bool:
        return self.arguments > MANY


def functions(folder: Path = PACKAGE) -> Iterator[Function]:
    """Every function below a folder, inner ones too."""
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        yield from _inside(ast.parse(text), str(path.relative_to(folder)), text.splitlines())


def _inside(node: ast.AST, name: str, text: list[str]) -> Iterator[Function]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            inner = [each for each in ast.walk(child) if isinstance(each, ast.FunctionDef) and each is not child]
            outermost = [each for each in inner if not any(each in ast.walk(other) for other in inner if other is not each)]
            begins = min([child.lineno, *(each.lineno for each in child.decorator_list)])
            taken = [argument.arg for argument in (*child.args.posonlyargs, *child.args.args, *child.args.kwonlyargs)]
            decorators = [ast.unparse(each) for each in child.decorator_list]
            above = begins - 2
            while above >= 0 and text[above].lstrip().startswith("#"):
                above -= 1
            yield Function(
                f"{name}:{child.name}",
                _lines(child) - sum(map(_lines, outermost)),
                len(taken) - (taken[:1] == ["self"]),
                # decorators that make kernels, and functions whose code is generated
                any(each.startswith(("wp.kernel", "kernel(", "language.func_native", "wp.func_native")) for each in decorators),
                any(each in ("func", "wp.func") for each in decorators),
                "\n".join(text[above + 1 : begins - 1]),
            )
            yield from _inside(child, f"{name}:{child.name}", text)
        else:
            yield from _inside(child, f"{name}:{child.name}" if isinstance(child, ast.ClassDef) else name, text)


def _lines(node: ast.FunctionDef) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - min([node.lineno, *(each.lineno for each in node.decorator_list)]) + 1


def main(folder: Path) -> None:
    found = list(functions(folder))
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py")}
    kernels = [each for each in found if each.is_kernel]
    others = [each for each in found if not each.is_kernel]
    rows = {
        "modules": len(lines),
        "modules at the root": sum(path.parent == folder for path in lines),
        "lines": sum(lines.values()),
        "largest module": max(lines.values()),
        "functions": len(found),
        f"functions above {LONG} lines of their own": sum(each.is_long for each in found),
        f"functions with more than {MANY} arguments, kernels apart": sum(each.takes_many for each in others),
        "kernels": len(kernels),
        f"kernels with more than {MANY} arguments": sum(each.arguments > MANY for each in kernels),
        "most arguments of a kernel": max(each.arguments for each in kernels),
        "functions of modules that kernels call": sum(
            each.is_called_by_kernels and each.name.count(":") == 1 for each in found
        ),
        "functions in factories that kernels call": sum(
            each.is_called_by_kernels and each.name.count(":") > 1 for each in found
        ),
    }
    for name, value in rows.items():
        print(f"| {name} | {value} |")
    for each in found:
        if each.is_long or each.takes_many:
            print(f"{each.name}: {each.lines} lines, {each.arguments} arguments  {each.reasons.strip()}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PACKAGE)
