"""Scenes from files: TOML written by people, JSON written by a run; and the scenes that come with the package."""

import difflib
import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pdipc.scene.errors import SceneError
from pdipc.scene.explain import clipped, explain, follow
from pdipc.scene.memory import free_memory, gib
from pdipc.scene.meshes import is_file
from pdipc.scene.schema import Scene
from pdipc.scene.vary import put

BUNDLED = Path(__file__).parent.parent / "scenes"
BYTES_PER_BYTE = 30  # of memory for a scene file: what its numbers take as Python's
LISTS = ("bodies", "obstacles", "attachments", "stitches", "forces")
HALF_A_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")
DOTTED = re.compile(
    r"""(?<![\w.'"-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){100}"""
)  # a key of a hundred names and more
NOBODY = "nobody, in place of bodies that are wrong"


def bundled_scenes() -> dict[str, Path]:
    """Names of the scenes that come with the package, and their files."""
    return {path.stem: path for path in sorted(BUNDLED.glob("*.toml"))}


def load_scene(path: str | Path, changes: dict[str, Any] | None = None) -> Scene:
    """Reads a scene from a .toml or .json file, or the bundled scene of that name.

    Mesh paths in the file are relative to it. changes: values in place of those of the file, by dotted keys, such as
    {"contact.friction": 0.3, "bodies.ball.material.young_modulus": 1e5}; see `pdipc.scene.vary`. Raises SceneError; its message names
    the file and, for every problem at once, the key, the value found, and what is allowed.
    """
    file, data = _tables(path)
    try:
        data = put(data, changes) if changes else data
    except SceneError as error:
        raise SceneError(f'"{file}": {error}') from None
    try:
        return Scene.model_validate(data, context={"folder": file.parent})
    except ValidationError as error:
        lines = explain(error, data, Scene)
        raise SceneError(f'"{file}": ' + (lines[0] if len(lines) == 1 else "\n  ".join(["", *lines]))) from error


@dataclass
class RightPart:
    """A scene file without what is wrong in it.

    scene: None where not one body is right. problems: a line for each thing wrong. left_out: names of the bodies and obstacles that
    are not in `scene`. numbers: for each list of the file, the places in it of what is in `scene`.
    """

    scene: Scene | None
    problems: list[str]
    left_out: set[str]
    numbers: dict[str, list[int]]


def load_right_part(path: str | Path) -> RightPart:
    """What can be judged of a scene file in spite of what is wrong in it.

    Raises SceneError where the file is missing or not in its format.
    """
    file, data = _tables(path)
    lists = {name: data[name] for name in LISTS if isinstance(data.get(name), list)}
    part = RightPart(None, [], set(), {name: list(range(len(tables))) for name, tables in lists.items()})
    for _ in range(100):  # each round leaves something out, and few rounds find something new
        try:
            part.scene = Scene.model_validate(data, context={"folder": file.parent})
            part.left_out -= {placed.name for placed in (*part.scene.bodies, *part.scene.obstacles)}
            part.scene = part.scene.model_copy(update={"bodies": [body for body in part.scene.bodies if body.name != NOBODY]})
            return part
        except ValidationError as error:
            part.problems += [line for line in explain(error, data, Scene) if line not in part.problems]
            data = _without_wrong(error, data, part)
            if not data.get("bodies"):  # a scene needs one, and obstacles can be judged without
                data["bodies"] = [{"name": NOBODY, "kind": "cloth", "mesh": {"shape": "grid"}}]
    return part


def _tables(path: str | Path) -> tuple[Path, dict[str, Any]]:
    """The file that a path or name means, and its tables. Raises SceneError."""
    file = bundled_scenes().get(str(path), Path(path))
    if not is_file(file):
        near = difflib.get_close_matches(str(path), bundled_scenes(), n=1)
        hint = f'did you mean "{near[0]}"? ' if near else ""
        raise SceneError(f'"{clipped(str(path))}": there is no such file; {hint}bundled scenes: {", ".join(bundled_scenes())}')
    kind = file.suffix[1:].upper()
    if file.suffix not in (".toml", ".json"):
        raise SceneError(f'"{file}": a scene file ends in .toml or .json')
    try:
        needed, free = BYTES_PER_BYTE * file.stat().st_size, free_memory()
        if needed > free:
            raise SceneError(
                f'"{file}": needs about {gib(needed)} of memory, and {gib(free)} are free; put meshes in .npz files'
            )
        text = file.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark
        if file.suffix == ".json":
            data = json.loads(text)
            if HALF_A_CHARACTER.search(text):
                json.dumps(
                    data, ensure_ascii=False
                ).encode()  # raises where one stands alone: that could not be printed or written
        else:
            if DOTTED.search(text):  # the time that these take grows with the square of their number
                raise RecursionError
            data = tomllib.loads(text)
    except RecursionError as error:
        raise SceneError(f'"{file}": is not valid {kind}: its tables or lists are nested too deep') from error
    except SceneError:
        raise
    except (ValueError, OSError, MemoryError) as error:
        said = "it needs more memory than there is" if isinstance(error, MemoryError) else str(error)
        raise SceneError(f'"{file}": is not valid {kind}: {said}') from error
    if not isinstance(data, dict):
        raise SceneError(f'"{file}": holds a {type(data).__name__}; a scene is a table: {{"bodies": [...]}}')
    return file, data


def _without_wrong(error: ValidationError, data: dict[str, Any], part: RightPart) -> dict[str, Any]:
    """The tables without what `error` finds wrong; notes in `part` what was left out."""
    data = {key: dict(value) if isinstance(value, dict) else value for key, value in data.items()}
    wrong: dict[str, set[int]] = {}
    for problem in error.errors(include_url=False):
        keys, _ = follow(problem["loc"], data, Scene)
        match keys:
            case [str(name), int(number), *_] if name in part.numbers:
                wrong.setdefault(name, set()).add(number)
            case [("simulation" | "contact") as name, str(key), *_] if isinstance(data.get(name), dict):
                data[name].pop(key, None)
            case [str(name), *_]:
                data.pop(name, None)
                part.numbers.pop(name, None)
            case _:  # names that are there more than once: the first of each stays
                seen: set[str] = set()
                for name in ("bodies", "obstacles"):
                    for number, table in enumerate(data.get(name) or []):
                        wrong.setdefault(name, set()).update([number] if table["name"] in seen else [])
                        seen.add(table["name"])
    for name, numbers in wrong.items():
        if name in ("bodies", "obstacles"):
            part.left_out |= {str(data[name][k].get("name")) for k in numbers if isinstance(data[name][k], dict)}
        data[name] = [table for number, table in enumerate(data[name]) if number not in numbers]
        part.numbers[name] = [place for number, place in enumerate(part.numbers[name]) if number not in numbers]
    return data
