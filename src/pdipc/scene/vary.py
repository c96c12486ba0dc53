"""Other values in place of a scene's own, by their keys: what `pdipc sweep --set bodies.ball.material.density=500,1000` says."""

import copy
import json
import re
import tomllib
from collections.abc import Iterator
from typing import Any

from pdipc.scene.errors import SceneError
from pdipc.scene.explain import short

LISTED = 12  # names that a message lists
COMMAS = re.compile(r""",(?=(?:[^"']|"[^"]*"|'[^']*')*$)""")  # those that no quotes hold


def parse_setting(text: str) -> tuple[str, list[Any]]:
    """The key and the values of text such as "contact.friction=0.1,0.3", each as TOML has it; what is no TOML is text.

    Raises SceneError where there is no key, no value, or a value twice.
    """
    key, equals, listed = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise SceneError(f'"{text}": a setting is KEY=VALUE or KEY=VALUE,VALUE, such as contact.friction=0.1,0.3')
    split_key(key)
    values = _values(listed)
    if not values:
        raise SceneError(f'"{text}": there is no value behind the =')
    for number, value in enumerate(values):
        if value in values[:number]:
            raise SceneError(f'"{text}": {short(value)} is there twice')
    return key, values


def split_key(key: str) -> list[str]:
    """The parts of a dotted key as TOML splits it, so that quotes keep a name with dots together. Raises SceneError."""
    try:
        table, parts = tomllib.loads(f"{key} = 0"), []
        while isinstance(table, dict) and len(table) == 1:
            ((part, table),) = table.items()
            parts.append(part)
        if table == 0 and isinstance(table, int):
            return parts
    except ValueError:
        pass
    raise SceneError(f'"{key}": is no key; keys are like contact.friction, bodies.ball.material.density, bodies."a b".friction')


def flat(changes: dict[str, Any]) -> dict[str, Any]:
    """Tables within tables as dotted keys: {"bodies": {"a b": {"friction": 1}}} is {'bodies."a b".friction': 1}. Arrays become lists."""
    return {key: value for outer, inner in changes.items() for key, value in _below(outer, inner)}


def _below(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _below(f"{key}.{name if re.fullmatch('[A-Za-z0-9_-]+', name) else json.dumps(name)}", inner)
    else:
        yield key, value.tolist() if hasattr(value, "tolist") else value


def put(tables: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The tables of a scene file with `values` in them, each at its dotted key; entries of lists are found by name, or by number.

    Tables on the way that are not there are made. Raises SceneError where a key leads nowhere.
    """
    tables = copy.deepcopy(tables)
    for key, value in values.items():
        *way, last = split_key(key)
        place: Any = tables
        for depth, part in enumerate(way):
            place = place.setdefault(part, {}) if isinstance(place, dict) else place[_index(place, part, key, way[:depth])]
        if isinstance(place, dict):
            place[last] = value
        else:
            place[_index(place, last, key, way)] = value
    return tables


def _index(place: Any, part: str, key: str, above: list[str]) -> int:
    """Where an entry called `part` is in a list."""
    where = ".".join(above)
    if not isinstance(place, list):
        raise SceneError(f'"{key}": {where} is {short(place)}, which has no "{part}"')
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in place]
    if part in names:
        return names.index(part)
    if part.isascii() and part.isdigit() and int(part) < len(place):
        return int(part)
    there = [str(name) for name in names if name is not None] or [str(number) for number in range(len(place))]
    listed = ", ".join(there[:LISTED]) + (", ..." if len(there) > LISTED else "")
    raise SceneError(f'"{key}": {where} has no "{part}"; there are: {listed or "none"}')


def _values(text: str) -> list[Any]:
    try:
        return _toml(text)
    except ValueError:
        return [_value(part) for part in COMMAS.split(text)]


def _value(text: str) -> Any:
    try:
        return _toml(text)[0]
    except (ValueError, IndexError):
        return text.strip()  # a word, such as per_vertex, or what the scene's own check refuses


def _toml(text: str) -> list[Any]:
    if "\n" in text:
        raise ValueError("more than one line")
    return tomllib.loads(f"values = [{text}]")["values"]
