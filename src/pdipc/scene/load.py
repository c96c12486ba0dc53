"""Scenes from files: TOML written by people, JSON written by a run; and the scenes that come with the package."""

import difflib
import json
import tomllib
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from pdipc.scene.errors import SceneError
from pdipc.scene.schema import Scene

BUNDLED = Path(__file__).parent.parent / "scenes"


def bundled_scenes() -> dict[str, Path]:
    """Names of the scenes that come with the package, and their files."""
    return {path.stem: path for path in sorted(BUNDLED.glob("*.toml"))}


def load_scene(path: str | Path) -> Scene:
    """Reads a scene from a .toml or .json file, or the bundled scene of that name.

    Mesh paths in the file are relative to it. Raises SceneError; its message names the file and, for every problem at once, the
    key, the value found, and what is allowed.
    """
    file = bundled_scenes().get(str(path), Path(path))
    if not file.is_file():
        near = difflib.get_close_matches(str(path), bundled_scenes(), n=1)
        hint = f'did you mean "{near[0]}"? ' if near else ""
        raise SceneError(f'"{path}": there is no such file; {hint}bundled scenes: {", ".join(bundled_scenes())}')
    try:
        if file.suffix == ".json":
            data = json.loads(file.read_text(encoding="utf-8-sig"))  # some editors begin a file with a mark
        elif file.suffix == ".toml":
            data = tomllib.loads(file.read_text(encoding="utf-8-sig"))
        else:
            raise SceneError(f'"{file}": a scene file ends in .toml or .json')
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f'"{file}": is not valid {file.suffix[1:].upper()}: {error}') from error
    try:
        return Scene.model_validate(data, context={"folder": file.parent})
    except ValidationError as error:
        lines = explain(error, data)
        raise SceneError(f'"{file}": ' + (lines[0] if len(lines) == 1 else "\n  ".join(["", *lines]))) from error


def explain(error: ValidationError, data: Any) -> list[str]:
    """One line for each thing wrong in `data`: key, value found, what is allowed."""
    lines: dict[tuple[str, str], str] = {}
    for problem in error.errors():
        where, said, about = _line(problem, data)
        # a key that may be of two kinds is reported by pydantic for each of them
        lines[where, about] = f"{lines[where, about]}, or: {said}" if (where, about) in lines else said
    return [f"{where}: {said}{about}" for (where, about), said in lines.items()]


def _line(problem: Any, data: Any) -> tuple[str, str, str]:
    """Key and value found, what is wrong with it, what the key means."""
    keys, models = _follow(problem["loc"], data)
    where = _path(keys, data)
    kind, found = problem["type"], _short(problem["input"])
    if kind == "extra_forbidden":
        allowed = sorted({name for model in models for name in model.model_fields})
        near = difflib.get_close_matches(str(keys[-1]), allowed, n=1)
        hint = f'; did you mean "{near[0]}"?' if near else ""
        return f"{where} = {found}", f"unknown key{hint} (allowed: {', '.join(allowed)})", ""
    if kind == "missing":
        return where, "is missing", _about(keys, models)
    if kind == "union_tag_not_found":
        return where, f"needs kind = {_kinds(keys)}", ""
    if kind == "union_tag_invalid":
        return f'{where}.kind = "{problem["ctx"]["tag"]}"', f"must be {_kinds(keys)}", ""
    said = problem["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("should", "must")
    said = said.replace("valid tuple", "list").replace("valid list", "list").replace("valid dictionary", "table")
    value = "" if isinstance(problem["input"], BaseModel) or not keys else f" = {found}"
    return where + value, said, _about(keys, models)


def _kinds(keys: list[str | int]) -> str:
    return '"solid" or "cloth"' if keys[0] == "bodies" else '"wind" or "vertices"'


def _about(keys: list[str | int], models: list[type[BaseModel]]) -> str:
    for model in models:
        field = model.model_fields.get(str(keys[-1])) if keys else None
        if field is not None and field.description:
            return f" ({field.description})"
    return ""


def _follow(loc: tuple[str | int, ...], data: Any) -> tuple[list[str | int], list[type[BaseModel]]]:
    """The keys of `loc` without the tags that pydantic puts in for unions, and the models that may hold the last key."""
    keys: list[str | int] = []
    models: list[type[BaseModel]] = [Scene]
    holders = models
    for part in loc:
        known = any(part in model.model_fields for model in models)
        if not (known or isinstance(part, int) or (isinstance(data, dict) and part in data)):
            models = [model for model in models if part in _tags(model)] or models
            continue
        keys.append(part)
        if isinstance(part, str):
            holders = models
            models = [
                found
                for model in models
                if part in model.model_fields
                for found in _models(model.model_fields[part].annotation)
            ]
        data = _get(data, part)
    return keys, holders


def _get(data: Any, key: str | int) -> Any:
    try:
        return data[key]
    except (KeyError, IndexError, TypeError):
        return None


def _tags(model: type[BaseModel]) -> set[Any]:
    return {model.__name__.lower()} | {
        model.model_fields[name].default for name in ("kind", "shape") if name in model.model_fields
    }


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in typing.get_args(annotation) for model in _models(part)]


def _path(keys: list[str | int], data: Any) -> str:
    text = ""
    for key in keys:
        data = _get(data, key)
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
        if isinstance(key, int) and isinstance(data, dict) and isinstance(data.get("name"), str):
            text += f' ("{data["name"]}")'
    return text or "the scene"


def _short(value: Any) -> str:
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 80 else text[:77] + "..."
