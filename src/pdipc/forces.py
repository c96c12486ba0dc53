"""External forces f_ext of Eq. (1), as accelerations: gravity, wind on surfaces, forces on vertices."""

import numpy as np

from pdipc.scene.assembly import AssembledForce, AssembledWind, Assembly


def wind_force(wind: AssembledWind, positions: np.ndarray, velocities: np.ndarray, time: float) -> np.ndarray:
    """(n, 3) N: drag on each triangle, air_density / 2 drag |u.n| (u.n) area n with u the air's velocity past it, a third to
    each of its vertices.
    """
    total = np.zeros_like(positions)
    if not wind.start <= time < wind.end:
        return total
    corners = positions[wind.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(double_area, 1e-300)[:, None]
    past = wind.velocity - velocities[wind.triangles].mean(axis=1)
    across = np.einsum("ij,ij->i", past, normal)
    force = (0.25 * wind.air_density * wind.drag * np.abs(across) * across * double_area)[:, None] * normal
    for corner in range(3):
        np.add.at(total, wind.triangles[:, corner], force / 3.0)
    return total


def vertex_force(force: AssembledForce, count: int, time: float) -> np.ndarray:
    """(n, 3) N: the same force on each chosen vertex within its window of time."""
    total = np.zeros((count, 3))
    if force.start <= time < force.end:
        total[force.vertices] += force.force
    return total


class ExternalForces:
    """All external forces of an assembly. gravity: (3,) m/s^2; mass: (n,) kg, 0 for kinematic vertices.

    pulled: vertices (k,) and forces (k, 3) N that a user applies by hand; replace it between steps.
    """

    def __init__(self, assembly: Assembly, gravity: np.ndarray, mass: np.ndarray):
        self.assembly, self.mass = assembly, mass
        self.gravity = np.tile(np.asarray(gravity, dtype=np.float64), (len(mass), 1))
        self.pulled: tuple[np.ndarray, np.ndarray] = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))

    @property
    def constant(self) -> bool:
        """Whether only gravity acts, now and later."""
        return not (self.assembly.winds or self.assembly.forces or len(self.pulled[0]))

    def accelerations(self, time: float, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """(n, 3) m/s^2 at the given state, time in s."""
        force = np.zeros_like(self.gravity)
        for wind in self.assembly.winds:
            force += wind_force(wind, positions, velocities, time)
        for each in self.assembly.forces:
            force += vertex_force(each, len(force), time)
        vertices, pull = self.pulled
        np.add.at(force, vertices, pull)
        mass = np.where(self.mass > 0.0, self.mass, np.inf)
        return self.gravity + force / mass[:, None]
