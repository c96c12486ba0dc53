"""Forces of contact in a step: on every vertex, on every body, and of each body on each other.

They are those that the step was solved with: the gradients of the barrier at its end and of the friction over its way, and what restitution
adds. So the momentum that a body gains in a step is the sum of its contact forces, gravity, loads and springs, as exactly as the step was
solved. Of several sub-steps they are means over the step. In the paper's mode they follow from the balance itself, see
`paper_mode.printed.Printed.exerted`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pdipc.output.forces import ContactForces, vertex_areas

if TYPE_CHECKING:
    from pdipc.barrier.pairs import Exerted
    from pdipc.model import Model


def collect(model: "Model", positions: np.ndarray, exerted: "tuple[Exerted, Exerted]") -> ContactForces:
    """Adds up the forces of pairs along the normals and across them. positions: (n, 3) m at the end of the step."""
    bodies = model.assembly.bodies
    centers = _centers(model, positions)
    n, b, owner = len(positions), len(bodies), model.assembly.body_of_vertex
    at_vertices, tables, keys = [], [], []
    for quads, forces in ((each.quads, each.forces) for each in exerted):
        flat = quads.ravel()
        at_vertices.append(_added(flat, forces.reshape(-1, 3), n))
        body = owner[quads]
        other = np.where(body == body[:, :1], body[:, 3:], body[:, :1])
        apart = (body[:, 0] != body[:, 3])[:, None] & np.ones(4, dtype=bool)
        body, own = body[apart], forces[apart]
        arms = positions[quads[apart]] - centers[body]
        keys.append(body.astype(np.int64) * b + other[apart])
        tables.append((own, np.cross(arms, own)))
    present, rows = np.unique(np.concatenate(keys), return_inverse=True)
    parts = np.split(rows, [len(keys[0])])
    (normal, turned), (friction, twisted) = (
        tuple(_added(part, values, len(present)) for values in table) for part, table in zip(parts, tables, strict=True)
    )
    pairs = np.column_stack(np.divmod(present, b)).astype(np.int32)
    names = tuple(body.name for body in bodies)
    return ContactForces(names, pairs, normal, friction, turned + twisted, centers, *at_vertices)


def mean(forces: Sequence[ContactForces]) -> ContactForces:
    """Of the sub-steps of a step; centres are those of the last."""
    if len(forces) == 1:
        return forces[0]
    b, last, share = len(forces[0].names), forces[-1], 1.0 / len(forces)
    keys = np.concatenate([each.pairs[:, 0].astype(np.int64) * b + each.pairs[:, 1] for each in forces])
    present, rows = np.unique(keys, return_inverse=True)

    def summed(name: str) -> np.ndarray:
        return share * _added(rows, np.concatenate([getattr(each, name) for each in forces]), len(present))

    def at_vertices(name: str) -> np.ndarray | None:
        return None if getattr(last, name) is None else np.mean([getattr(each, name) for each in forces], axis=0)

    return ContactForces(
        names=last.names,
        pairs=np.column_stack(np.divmod(present, b)).astype(np.int32),
        normal=summed("normal"),
        friction=summed("friction"),
        torque=summed("torque"),
        centers=last.centers,
        vertex_normal=at_vertices("vertex_normal"),
        vertex_friction=at_vertices("vertex_friction"),
    )


def _added(rows: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count, 3): the sums of values (k, 3) by their rows (k,), always in the same order."""
    return np.column_stack([np.bincount(rows, values[:, axis], minlength=count) for axis in range(3)])


def _centers(model: "Model", positions: np.ndarray) -> np.ndarray:
    """(b, 3) m: centres of mass, of obstacles the centroids of their surfaces."""
    assembly = model.assembly
    weight = model.external.mass.copy()
    for body in assembly.bodies:
        if body.kinematic:
            weight[body.first : body.last] = vertex_areas(positions[body.first : body.last], body.triangles - body.first)
    owner, b = assembly.body_of_vertex, len(assembly.bodies)
    total = np.bincount(owner, weight, minlength=b)
    weight = np.where(total[owner] > 0.0, weight, 1.0)  # of what is held as a whole, the mean
    return _added(owner, weight[:, None] * positions, b) / np.bincount(owner, weight, minlength=b)[:, None]
