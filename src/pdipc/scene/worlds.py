"""The worlds of a scene: what is other in each of several simulations that go side by side."""

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from pdipc.scene.errors import SceneError
from pdipc.scene.explain import explain
from pdipc.scene.save import tables_of
from pdipc.scene.schema import Scene
from pdipc.scene.vary import put


def scenes_of(scene: Scene, worlds: int | Sequence[dict[str, Any]] | None = None) -> list[Scene]:
    """A scene for each world, without `worlds` in it; copies are one and the same object.

    worlds: in place of the scene's own, see `Scene.worlds`; both absent, one. Raises SceneError, with the number of the world, where a
    key leads nowhere or a value is wrong.
    """
    worlds = scene.worlds if worlds is None else Scene(bodies=scene.bodies[:1], worlds=worlds).worlds
    tables = tables_of(scene)
    tables.pop("worlds", None)
    if worlds is None or isinstance(worlds, int):
        return [_scene(tables, {})] * (worlds or 1)
    made = []
    for number, changes in enumerate(worlds):
        try:
            made.append(_scene(tables, changes))
        except SceneError as error:
            raise SceneError(f"worlds[{number}]: {error}") from None
    return made


def refuse_worlds(scene: Scene, what: str) -> None:
    """Raises SceneError for a scene of several worlds. what: takes one."""
    if scene.worlds is not None:
        raise SceneError(f"worlds: {what} is of one world; several run with `pdipc run`, or in Python with pdipc.Worlds")


def _scene(tables: dict[str, Any], changes: dict[str, Any]) -> Scene:
    tables = put(tables, changes) if changes else tables
    if "worlds" in tables:
        raise SceneError("a world has no worlds in it")
    try:
        return Scene.model_validate(tables)
    except ValidationError as error:
        raise SceneError("\n  ".join(explain(error, tables, Scene))) from None
