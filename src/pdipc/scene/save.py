"""Scenes written as TOML: what was given, and nothing that follows from it or is the default."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

TAGS = ("kind", "shape")  # which of several tables it is: a file must say so
FILES = ("mesh", "cache")  # where text is the name of a file
WIDTH = 110  # characters of a line, if a list can be broken before


def to_toml(scene: BaseModel, folder: Path) -> str:
    """TOML that loads to the same scene from a file in `folder`: files below it are named from there, others in full."""
    tables = _plain(scene, folder)
    lines = [f"{name} = {_value(value)}" for name, value in tables.items() if not _is_section(value)]
    for name, value in tables.items():
        if _is_section(value):
            for table in value if isinstance(value, list) else [value]:
                lines += ["", f"[[{name}]]" if isinstance(value, list) else f"[{name}]"]
                lines += [f"{key} = {_value(entry)}" for key, entry in table.items()]
    return "\n".join(lines).strip("\n") + "\n"


def tables_of(scene: BaseModel) -> dict[str, Any]:
    """What was given of a scene, as tables that make the same scene; files are named in full."""
    return _plain(scene, None)


def _is_section(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and value != [] and all(isinstance(v, dict) for v in value))


def _plain(value: Any, folder: Path | None, key: str = "") -> Any:
    """TOML's kinds of value, without what was not given; with no folder arrays stay arrays, and files are named in full."""
    if isinstance(value, BaseModel):
        fields = {name: (entry, _plain(entry, folder, name)) for name, entry in value if entry is not None}
        given = value.model_fields_set.union(TAGS)
        # tables and lists that were not given may have been filled since
        return {name: plain for name, (entry, plain) in fields.items() if name in given or (_is_container(entry) and plain)}
    if isinstance(value, np.ndarray):
        return value if folder is None else value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(entry, folder) for entry in value]
    if isinstance(value, str) and key in FILES and not value.startswith("warp:"):
        file = Path(value).resolve()
        return (file.relative_to(folder) if folder and file.is_relative_to(folder) else file).as_posix()
    return value


def _is_container(value: Any) -> bool:
    return isinstance(value, BaseModel | list)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(entry)}" for key, entry in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        entries = [_value(entry) for entry in value]
        nested = value and isinstance(value[0], list)
        broken = sum(map(len, entries)) > WIDTH
        return "[\n  " + ",\n  ".join(entries) + ",\n]" if nested and broken else f"[{', '.join(entries)}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML escapes as JSON does, and DEL too
    return repr(value)  # digits that give the same number back
