"""Elasticity and masses of all bodies together, with what holds and joins them."""

import numpy as np

from pdipc import constraints
from pdipc.bodies import cloth, rigid, rods, solid
from pdipc.constraints import axis_attachment, edge_length, point_attachment, surface_attachment
from pdipc.scene.assembly import AssembledBody, Assembly

# Each kind of body has a module with
#     elasticity(assembly, body, newton)    its constraints, and the masses (n,) kg of its vertices among all
#     speed_of_sound(material)              m/s, along the body
# newton: whether for that solver, see `SolidMaterial.model`.
KINDS = {"solid": solid, "cloth": cloth, "rod": rods, "rigid": rigid}


def elasticity(assembly: Assembly, newton: bool = False) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of all bodies (Section 3) and the lumped masses (n,) kg. newton: see `KINDS`."""
    x, n = assembly.rest_positions, len(assembly.positions)
    sets, mass = [], np.zeros(n)
    for body in assembly.bodies:
        if body.material is not None:
            own, its_mass = KINDS[body.kind].elasticity(assembly, body, newton)
            sets += own
            mass += its_mass
    for pin in assembly.pins:
        if pin.anchored and pin.axes.all():
            sets.append(point_attachment.rest(pin.points, pin.vertices, pin.stiffness))
        elif pin.anchored:
            axes = np.tile(pin.axes, (len(pin.vertices), 1))
            sets.append(axis_attachment.rest(pin.points, pin.vertices, axes, pin.stiffness))
        elif pin.active and pin.follow >= 0 and len(pin.elements):
            sets.append(surface_attachment.rest(assembly.positions, pin.elements, pin.weights, pin.stiffness))
    for a in assembly.attachments:
        pairs = np.stack([a.vertices_a, a.vertices_b], axis=1)
        sets.append(edge_length.rest(x, pairs, a.stiffness, a.rest_lengths))
    return sets + cloth.seams(assembly), mass


def speed_of_sound(body: AssembledBody) -> float:
    """m/s, along the body."""
    return KINDS[body.kind].speed_of_sound(body.material)
