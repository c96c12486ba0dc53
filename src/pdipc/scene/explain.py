"""What is wrong with tables that a model refuses, said for people."""

import difflib
import typing
from typing import Any

from pydantic import BaseModel, ValidationError


def explain(error: ValidationError, data: Any, model: type[BaseModel]) -> list[str]:
    """One line for each thing wrong in `data`, the tables of `model`: key, value found, what is allowed."""
    lines: dict[tuple[str, str], str] = {}
    for problem in error.errors():
        where, said, about = _line(problem, data, model)
        # a key that may be of two kinds is reported by pydantic for each of them
        lines[where, about] = f"{lines[where, about]}, or: {said}" if (where, about) in lines else said
    return [f"{where}: {said}{about}" for (where, about), said in lines.items()]


def _line(problem: Any, data: Any, model: type[BaseModel]) -> tuple[str, str, str]:
    """Key and value found, what is wrong with it, what the key means."""
    keys, models = follow(problem["loc"], data, model)
    where = _path(keys, data)
    kind, found = problem["type"], short(problem["input"])
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
        return f"{where}.kind = {short(problem['ctx']['tag'])}", f"must be {_kinds(keys)}", ""
    said = problem["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("should", "must")
    said = said.replace("valid tuple", "list").replace("valid list", "list").replace("valid dictionary", "table")
    value = "" if isinstance(problem["input"], BaseModel) or not keys else f" = {found}"
    return where + value, said, _about(keys, models)


def _kinds(keys: list[str | int]) -> str:
    return '"solid", "cloth", "rod" or "rigid"' if "bodies" in keys[:1] else '"wind" or "vertices"'


def _about(keys: list[str | int], models: list[type[BaseModel]]) -> str:
    for model in models:
        field = model.model_fields.get(str(keys[-1])) if keys else None
        if field is not None and field.description:
            return f" ({field.description})"
    return ""


def follow(loc: tuple[str | int, ...], data: Any, model: type[BaseModel]) -> tuple[list[str | int], list[type[BaseModel]]]:
    """The keys of `loc` without the tags that pydantic puts in for unions, and the models that may hold the last key."""
    keys: list[str | int] = []
    models: list[type[BaseModel]] = [model]
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
        text += f"[{key}]" if isinstance(key, int) else f".{clipped(key)}" if text else clipped(key)
        if isinstance(key, int) and isinstance(data, dict) and isinstance(data.get("name"), str):
            text += f' ("{clipped(data["name"])}")'
    return text or "the scene"


def short(value: Any) -> str:
    """A value in at most 80 characters, whatever it is: nested without end, a number of thousands of digits."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 10**70:
        return f"a whole number of {value.bit_length()} bits"
    try:
        return clipped(f'"{value}"' if isinstance(value, str) else str(value))
    except (ValueError, RecursionError):
        return f"a {type(value).__name__}"


def clipped(text: str) -> str:
    """The text, or its first 77 characters."""
    return text if len(text) <= 80 else text[:77] + "..."
