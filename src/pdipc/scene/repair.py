"""A scene whose start was separated, as a scene of its own."""

from pdipc.scene.assembly import AssembledBody, Assembly, assemble
from pdipc.scene.check import check, prepare
from pdipc.scene.finding import Finding
from pdipc.scene.schema import Arrays, Cloth, Rigid, Rod, Scene, Solid
from pdipc.scene.worlds import refuse_worlds


def repaired(scene: Scene, precision: str = "float64") -> tuple[Scene, list[str], list[Finding]]:
    """`scene` with its start separated (`contact.start = "separate"`) and the bodies that were moved given by their vertices; a line for each of
    these; and what still keeps it from being simulated.

    Raises SceneError where it cannot be put together.
    """
    refuse_worlds(scene, "what is repaired")
    wanted = scene.model_copy(deep=True)
    wanted.contact.start = "separate"
    assembly = assemble(wanted)
    known = len(assembly.notes)
    prepare(wanted, assembly, precision)
    moved = assembly.separated or {}
    made = scene.model_copy(deep=True)
    made.contact.start_limit, made.contact.start = None, "as_given"
    by_name = {body.name: body for body in assembly.bodies}
    bodies: list[Solid | Cloth | Rod | Rigid] = []
    for placed in made.bodies:
        copies = [by_name[name] for name in _names(placed, by_name)]
        if any(copy.name in moved for copy in copies):
            bodies += [_as_arrays(placed, copy, assembly) for copy in copies]
        else:
            bodies.append(placed)
    made.bodies = bodies
    return made, assembly.notes[known:], check(assembly, precision)


def _names(placed: Solid | Cloth | Rod | Rigid, by_name: dict[str, AssembledBody]) -> list[str]:
    if placed.copies is None:
        return [placed.name]
    return [name for name in by_name if name.startswith(f"{placed.name}[") and name[len(placed.name) + 1 : -1].isdigit()]


def _as_arrays(placed: Solid | Cloth | Rod | Rigid, body: AssembledBody, assembly: Assembly) -> Solid | Cloth | Rod | Rigid:
    own = slice(body.first, body.first + body.count)
    kind = {"solid": "tets", "cloth": "triangles", "rigid": "triangles", "rod": "lines"}[body.kind]
    elements = {"tets": body.tets, "triangles": body.triangles, "lines": body.segments}[kind] - body.first
    if isinstance(placed, Rigid):  # moved as a whole: this is its shape
        places = {"vertices": assembly.positions[own].copy()}
    else:
        places = {"vertices": assembly.rest_positions[own].copy(), "start": assembly.positions[own].copy()}
    at = {"name": body.name, "copies": None, "scale": 1.0, "rotation": (0.0, 0.0, 0.0), "translation": (0.0, 0.0, 0.0)}
    if isinstance(placed, Solid):
        at["tetrahedralize"] = False
    return placed.model_copy(update={**at, "mesh": Arrays(**places, **{kind: elements})})
