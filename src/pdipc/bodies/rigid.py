"""A rigid body's part of a model: its mass at four points, and the energy that keeps its shape."""

import numpy as np

from pdipc import constraints
from pdipc.constraints import corotated
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.meshes import tet_volumes
from pdipc.scene.schema import RigidMaterial

LOOSEST = 1e-4  # of its size: how far a vertex of a rigid body may be from where its four points have it


def torn(assembly: Assembly, positions: np.ndarray) -> str:
    """What is wrong with positions (n, 3) m of rigid bodies whose vertices are not where their four points have them; empty where nothing is."""
    for body in assembly.bodies:
        if len(body.handles):
            own = positions[body.first : body.first + body.count]
            away = np.linalg.norm(body.weights @ positions[body.handles] - own, axis=1)
            worst = int(np.argmax(away))
            if not away[worst] <= LOOSEST * np.linalg.norm(np.ptp(own, axis=0)) + 100 * np.spacing(
                np.float32(np.abs(own).max())
            ):
                found = (
                    f'vertex {worst} of the rigid body "{body.name}" is {away[worst]:.3g} m from where its four points have it'
                )
                return f"{found}; all its vertices, these last four too, must move alike"
    return ""


def elasticity(assembly: Assembly, body: AssembledBody, newton: bool) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of a rigid body, and its masses (n,) kg among all, a quarter at each of its four points.

    The energy is that of an elastic body of `shape_stiffness` E and no Poisson's ratio, whose inside deforms alike everywhere.
    """
    x, m = assembly.rest_positions, body.material
    assert isinstance(m, RigidMaterial)
    tet = body.handles[None, :]
    part = body.volume / tet_volumes(x, tet)[0]
    mass = np.zeros(len(x))
    mass[body.handles] = 0.25 * m.density * body.volume
    return [corotated.rest(x, tet, 0.5 * part * m.shape_stiffness, 0.0 * part)], mass


def speed_of_sound(m: RigidMaterial) -> float:
    """m/s, of that elastic body."""
    return float(np.sqrt(m.shape_stiffness / m.density))
