"""Elasticity and masses of all bodies together, with what holds and joins them."""

import numpy as np

from pdipc import constraints
from pdipc.bodies import cloth, rigid, rods
from pdipc.constraints import (
    axis_attachment,
    corotated,
    edge_length,
    material,
    neo_hookean,
    point_attachment,
    surface_attachment,
    tet_strain,
    tet_volume,
    tets,
)
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.schema import ClothMaterial, RigidMaterial, RodMaterial, SolidMaterial


def elasticity(assembly: Assembly, newton: bool = False) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of all bodies (Section 3) and the lumped masses (n,) kg. newton: for that solver, see `SolidMaterial.model`."""
    x, n = assembly.rest_positions, len(assembly.positions)
    sets, mass = [], np.zeros(n)
    for body in assembly.bodies:
        m = body.material
        if isinstance(m, SolidMaterial):
            own, its_mass = solid(x, body, m, newton)
        elif isinstance(m, ClothMaterial):
            own, its_mass = cloth.elasticity(assembly, body)
        elif isinstance(m, RigidMaterial):
            own, its_mass = rigid.elasticity(x, body, m)
        elif isinstance(m, RodMaterial):
            own, its_mass = rods.elasticity(x, body, m)
        else:
            continue
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


def solid(
    x: np.ndarray, body: AssembledBody, m: SolidMaterial, newton: bool
) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of a solid at the rest positions x (n, 3), and its masses (n,) kg."""
    strain, volume = material.solid(m.young_modulus, m.poisson_ratio)
    model = m.model
    if model == "auto":
        model = "neo_hookean" if newton else "arap"
    if model == "arap":
        sets = [tet_strain.rest(x, body.tets, strain)]
        if volume > 0.0:
            sets.append(tet_volume.rest(x, body.tets, volume))
    else:
        kind = corotated if model == "corotated" else neo_hookean
        sets = [kind.rest(x, body.tets, 0.5 * strain, volume / 3.0)]
    return sets, material.lumped_mass(len(x), body.tets, m.density * tets.rest_shape(x, body.tets)[1])


def speed_of_sound(of: SolidMaterial | ClothMaterial | RodMaterial | RigidMaterial) -> float:
    """m/s, along the body."""
    if isinstance(of, SolidMaterial):
        return float(np.sqrt(of.young_modulus / of.density))
    if isinstance(of, RigidMaterial):
        return float(np.sqrt(of.shape_stiffness / of.density))
    if isinstance(of, RodMaterial):
        assert of.stretch_stiffness is not None  # its validator has set it
        return float(np.sqrt(of.stretch_stiffness / (of.density * np.pi * of.radius**2)))
    assert of.membrane_stiffness is not None
    return float(np.sqrt(of.membrane_stiffness / of.areal_density))
