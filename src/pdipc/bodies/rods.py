"""A rod's part of a model: the constraints of its segments and joints, and its masses."""

import numpy as np

from pdipc import constraints
from pdipc.constraints import edge_length, material, rod_bending, rod_frames, rod_ghost
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.schema import RodMaterial

GHOST_MASS = 0.01  # of a segment's, at most


def elasticity(assembly: Assembly, body: AssembledBody, newton: bool) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of a rod, and the masses (n,) kg of its vertices among all.

    A segment's mass is at its ends, but for what its ghost point needs to be as slow to twist as a round bar, m radius^2 / 2, up to GHOST_MASS.
    """
    x, m = assembly.rest_positions, body.material
    assert isinstance(m, RodMaterial)
    assert m.stretch_stiffness is not None and m.bending_stiffness is not None  # its validator has set them
    segments, joints, ghosts = body.segments, body.joints, body.ghosts
    lengths = np.linalg.norm(x[segments[:, 1]] - x[segments[:, 0]], axis=1)
    along = m.stretch_stiffness / lengths
    weight = m.density * np.pi * m.radius**2 * lengths
    sets = [edge_length.rest(x, segments, along)]
    chain = np.column_stack([segments[joints[:, 0]], segments[joints[:, 1], 1]])
    mass = np.zeros(len(x))
    if len(ghosts):
        assert m.bending_stiffness is not None and m.twist_stiffness is not None  # their validator has set them
        away = np.linalg.norm(x[ghosts] - x[segments].mean(axis=1), axis=1)
        part = np.minimum(0.5 * m.radius**2 / away**2, GHOST_MASS)
        mass[ghosts] = part * weight
        weight = (1.0 - part) * weight
        sets.append(rod_ghost.rest(x, np.column_stack([segments, ghosts]), along))
        corners = np.column_stack([chain, ghosts[joints]])
        sets.append(rod_frames.rest(x, corners, m.bending_stiffness, m.twist_stiffness))
    elif m.bending_stiffness:
        sets.append(rod_bending.rest(x, chain, m.bending_stiffness))
    return sets, mass + material.lumped_mass(len(x), segments, weight)


def speed_of_sound(m: RodMaterial) -> float:
    """m/s, along the rod."""
    assert m.stretch_stiffness is not None  # its validator has set it
    return float(np.sqrt(m.stretch_stiffness / (m.density * np.pi * m.radius**2)))
