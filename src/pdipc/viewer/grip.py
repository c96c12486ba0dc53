"""What the mouse holds of a body, and how it pulls."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import cg

from pdipc import constraints
from pdipc.bodies.elasticity import elasticity
from pdipc.simulation import Simulation

# What is dragged is on a damped spring, in units of its own compliance, so that it follows alike in cloth and in heavy blocks. The
# spring is explicit in time: PULL and DRAG are far below what is stable for the compliance that is computed, because a body that
# turns or folds gives way more easily than the constant matrix says.
PULL, DRAG = 0.1, 0.3
REACH = 0.1  # of the scene size: further away, the pull grows no more
GRIP, HELD = 0.2, 8  # radius of what is held, of the body's size, and least number of vertices: one alone would be torn out


@dataclass
class Grip:
    """What the mouse holds: a vertex, and the vertices (k,) around it with their shares (k,) of the force.

    compliance: how far their mean gives way within a step, per force, m/N: s . A^-1 s for the shares s of the free vertices.
    """

    vertex: int
    vertices: np.ndarray
    shares: np.ndarray
    compliance: float

    @staticmethod
    def at(simulation: Simulation, body: int, point: np.ndarray) -> "Grip | None":
        """The grip on `body` nearest to `point` (3,), m; None if no vertex of it is free."""
        model, x = simulation.model, simulation.positions
        own = model.assembly.bodies[body]
        free = np.flatnonzero(~model.assembly.scripted)
        choice = free[(free >= own.first) & (free < own.last)]
        if len(choice) == 0:
            return None
        away = np.linalg.norm(x[choice] - point, axis=1)
        vertex = choice[np.argmin(away)]
        away = np.linalg.norm(x[choice] - x[vertex], axis=1)
        radius = max(GRIP * np.linalg.norm(np.ptp(x[own.first : own.last], axis=0)), np.sort(away)[:HELD][-1])
        vertices = choice[away <= radius]
        mass, h = model.mass.numpy().astype(np.float64), model.settings.time_step
        for each in model.followers:  # whose mass is at four points: here it is spread
            mass[each.all] = mass[each.handles].sum() / len(each.all)
        shares = np.zeros(model.vertex_count)
        shares[vertices] = mass[vertices] / mass[vertices].sum()
        sets, _ = elasticity(model.assembly)  # the constant matrix of projective dynamics, whatever solves the step
        inertia = scipy.sparse.diags_array(mass * (1.0 / (h * h) + model.settings.damping / h))
        matrix = scipy.sparse.csr_array(constraints.stiffness_matrix(model.vertex_count, sets) + inertia)[free][:, free]
        preconditioner = scipy.sparse.diags_array(1.0 / matrix.diagonal())
        given_way, _ = cg(matrix, shares[free], rtol=1e-2, maxiter=200, M=preconditioner)  # a few per cent do no harm
        return Grip(int(vertex), vertices, shares[vertices], float(given_way @ shares[free]) * model.substeps**2)

    def forces(self, simulation: Simulation, point: np.ndarray) -> np.ndarray:
        """(k, 3) N that pull the vertex towards `point` (3,), m, within the next step."""
        model, state = simulation.model, simulation.state
        way = point - state.positions.numpy()[self.vertex]
        way = way * min(1.0, REACH * model.assembly.scene_size / max(np.linalg.norm(way), 1e-300))
        motion = model.scene.simulation.time_step * self.shares @ state.velocities.numpy()[self.vertices]
        return self.shares[:, None] * (PULL * way - DRAG * motion) / self.compliance
