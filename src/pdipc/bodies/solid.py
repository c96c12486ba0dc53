"""A solid's part of a model: the constraints of its tetrahedra, and its masses."""

import numpy as np

from pdipc import constraints
from pdipc.constraints import corotated, material, neo_hookean, tet_strain, tet_volume, tets
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.schema import SolidMaterial


def elasticity(assembly: Assembly, body: AssembledBody, newton: bool) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of a solid, and the masses (n,) kg of its vertices among all."""
    x, m = assembly.rest_positions, body.material
    assert isinstance(m, SolidMaterial)
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


def speed_of_sound(m: SolidMaterial) -> float:
    """m/s."""
    return float(np.sqrt(m.young_modulus / m.density))
