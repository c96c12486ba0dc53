"""The reference of the scene format, made from the models: `python -m pdipc.scene.reference > docs/scene_format.md`."""

import inspect
import types
import typing
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Tag
from pydantic.fields import FieldInfo

from pdipc.scene import garments, generators, looks, schema
from pdipc.scene.load import bundled_scenes, load_scene
from pdipc.scene.meshes import TET_SUFFIXES, TRIANGLE_SUFFIXES

SECTIONS = {
    "The scene": (schema.Scene,),
    "Simulation and contact": (schema.Simulation, schema.Contact),
    "Bodies": (
        schema.Solid,
        schema.SolidMaterial,
        schema.Cloth,
        schema.ClothMaterial,
        schema.Pattern,
        garments.Inside,
        schema.Rod,
        schema.RodMaterial,
        schema.Rigid,
        schema.RigidMaterial,
        schema.Copies,
    ),
    "Pins, selections, attachments, stitches": (schema.Pin, schema.Selection, schema.Attachment, schema.Stitch),
    "Obstacles and motions": (schema.Obstacle, schema.Motion, schema.Keyframe, schema.Deformation, schema.FrameArrays),
    "Forces": (schema.Wind, schema.VertexForce),
    "Pictures": (looks.Picture, looks.Look),
    "Shapes and arrays": (*generators.SHAPES, schema.Arrays),
}
HEAD = f"""# Scene format

*Made from the models by `python -m pdipc.scene.reference > docs/scene_format.md`; do not edit.*

A scene is a TOML file, or the same names in Python: `pdipc.Scene(bodies=[...], obstacles=[...])`. All quantities are in SI
units: m, kg, s, N, Pa. Orientations are in degrees, rates of rotation in rad/s. Gravity points along -y. A key that is not
listed here is refused. `pdipc check-scene FILE` lists everything that keeps a scene from being simulated.

```toml
title = "A cloth falls on a ball"

[[bodies]]
name = "cloth"
kind = "cloth"
mesh = {{ shape = "grid", size = [1.0, 1.0], cells = [40, 40] }}
translation = [0.0, 0.6, 0.0]

[[obstacles]]
name = "ball"
mesh = {{ shape = "sphere", radius = 0.3, cells = 12 }}
```

A mesh is one of

- a file, relative to the scene file: tets from {" ".join(TET_SUFFIXES)}, triangles from {" ".join(TRIANGLE_SUFFIXES)},
  lines from .obj, `.npz` with V and T, F or L, USD (with the extra "usd"), whole or below a prim: `shot.usda</World/Flag>`, and Alembic
  (.abc, with the extra "alembic"), whole or below an object: `shot.abc</Flag>`; `warp:bear.usd` is the file of that name among Warp's own assets;
- a shape, such as `{{ shape = "box", size = [1, 1, 1], cells = [4, 4, 4] }}`;
- arrays, `{{ vertices = [...], tets = [...] }}`: in Python, NumPy arrays.

A rod takes the lines between vertices: `l` of an OBJ file, L of `.npz`, `lines` of arrays, and the shapes `rope`, `ring`, `coil` and `knot`.
A solid takes a mesh's tets; cloth and obstacles take its triangles, which for a mesh of tets are its surface. A closed obstacle
whose triangles face outward is solid, so nothing may start inside it; one that faces inward (`inward = true` turns it) is a container. Bodies must be
manifolds; obstacles need not be, and lose triangles without area or that repeat others.

Quads and polygons, concave ones too, are cut into triangles, and hexahedra, wedges and pyramids into tets, alike on both sides of
a face. Cells of higher order are reduced to their corners. All meshes of a USD stage are read, where they stand, in its unit and
with its upward axis turned to y, and all of an Alembic archive, where they stand; other formats than USD know no unit: their numbers are metres. What is left out of a file or converted
is said by `pdipc run` and `pdipc check-scene`, and in Python by a SceneWarning.

An obstacle may deform: `motion = {{ cache = "dance.npz", frame_rate = 25 }}`, see [Deformation](#deformation).

A vertex of the mesh starts at translation + R (scale * vertex). Distances that a scene leaves open follow from the size of
its largest body, the diagonal of that body's bounding box at the start: the activation distance is 1e-3 of it, the minimum separation 0.02
of that.

Bundled scenes, which can be run by name:

"""


def markdown() -> str:
    """The whole document."""
    scenes = [f"- `{name}`: {load_scene(path).title}" for name, path in bundled_scenes().items()]
    parts = [HEAD + "\n".join(scenes) + "\n"]
    for section, models in SECTIONS.items():
        parts.append(f"## {section}\n")
        parts += [_table(model) for model in models]
    return "\n".join(parts)


def _table(model: type[BaseModel]) -> str:
    lines = [f"### {model.__name__}", "", inspect.cleandoc(model.__doc__ or ""), ""]
    lines += ["| key | value | default | meaning |", "| --- | --- | --- | --- |"]
    for name, field in model.model_fields.items():
        value = _type(field.annotation) + _range(field.metadata)
        lines.append(f"| `{name}` | {_cell(value)} | {_cell(_default(field))} | {_cell(field.description or _tag(field))} |")
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _tag(field: FieldInfo) -> str:
    return f"Which of them it is; a file must say {_default(field)}."


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "**required**"
    if field.default_factory is not None:
        return "all defaults"
    if field.default is None:
        return "absent"
    return f"`{_toml(field.default)}`"


def _toml(value: Any) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else f"{value:g}"


def _range(metadata: list[Any]) -> str:
    signs = {"gt": "> ", "ge": ">= ", "lt": "< ", "le": "<= "}
    limits: dict[str, float] = {}
    for part in metadata:
        for piece in getattr(part, "metadata", [part]):
            limits.update({sign: getattr(piece, sign) for sign in signs if getattr(piece, sign, None) is not None})
    told = [f"{signs[sign]}{limits[sign]:g}" for sign in signs if sign in limits]
    return f" {' and '.join(told)}" if told else ""


def _type(annotation: Any) -> str:
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        if any(isinstance(part, Tag) for part in inner) and inner[0] is str:
            return "file"
        return _type(inner[0]) + _range(list(inner[1:]))
    if annotation is schema.MeshSource or _is_mesh(annotation):
        return "file, [shape](#shapes-and-arrays) or [arrays](#arrays)"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_type(part) for part in inner if part is not type(None)))
    if origin is Literal:
        return " or ".join(f'`"{value}"`' for value in inner)
    if origin is tuple:
        kinds = list(dict.fromkeys(_type(part) for part in inner))
        return f"{len(inner)} x {kinds[0]}" if len(kinds) == 1 else f"[{', '.join(kinds)}]"
    if origin is list:
        return f"list of {_type(inner[0])}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    if origin is dict:
        return "table"
    return {float: "number", int: "integer", str: "text", bool: "true or false", np.ndarray: "array"}[annotation]


def _is_mesh(annotation: Any) -> bool:
    parts = [typing.get_args(part)[0] for part in typing.get_args(annotation) if typing.get_origin(part) is typing.Annotated]
    return generators.Box in parts


if __name__ == "__main__":
    print(markdown(), end="")
