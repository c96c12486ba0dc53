"""Forces of contact in a step: on every vertex, on every body, and of each body on each other.

They are those that the step was solved with: the gradients of the barrier at its end and of the friction over its way, and what restitution
adds. So the momentum that a body gains in a step is the sum of its contact forces, gravity, loads and springs, as exactly as the step was
solved. Of several sub-steps they are means over the step. In the paper's mode they follow from the balance itself, see
`paper_mode.printed.Printed.exerted`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # results are read without Warp
    from pdipc.barrier.pairs import Exerted
    from pdipc.model import Model


@dataclass(frozen=True)
class Force:
    """Along the normals of contact and across them, (3,) N; torque of both about the body's centre, (3,) N m."""

    normal: np.ndarray
    friction: np.ndarray
    torque: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """(3,) N: normal force and friction."""
        return self.normal + self.friction


@dataclass(frozen=True)
class ContactForces:
    """Forces of contact, means over a step.

    names: of all bodies and obstacles. pairs: (p, 2) int32, ascending, a body and the one that it is pushed by; where two touch there are
    two rows, one for each side. normal, friction: (p, 3) N; torque: (p, 3) N m, about the centre of the body that is pushed. centers: (b, 3) m, of
    all bodies: centres of mass; of obstacles the centroids of their surfaces.
    vertex_normal, vertex_friction: (n, 3) N, also what parts of one body do to each other; None where they were not kept.
    """

    names: tuple[str, ...]
    pairs: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    torque: np.ndarray
    centers: np.ndarray
    vertex_normal: np.ndarray | None = None
    vertex_friction: np.ndarray | None = None

    def on(self, body: str, by: str | None = None) -> Force:
        """The force on a body or obstacle, of all others or of the one named `by`; zero where they do not touch.

        Raises KeyError for a name that does not exist.
        """
        rows = self.pairs[:, 0] == self._number(body)
        if by is not None:
            rows &= self.pairs[:, 1] == self._number(by)
        return Force(*(values[rows].sum(axis=0) for values in (self.normal, self.friction, self.torque)))

    def touching(self) -> list[tuple[str, str]]:
        """A body and the one that it is pushed by, by name, for each row of `pairs`."""
        return [(self.names[a], self.names[b]) for a, b in self.pairs.tolist()]

    def pressures(self, positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """(n,) Pa: the normal force over the area around each surface vertex. positions: (n, 3) m; triangles: (m, 3), all surfaces.

        Raises ValueError where the forces on vertices were not kept.
        """
        if self.vertex_normal is None:
            raise ValueError("the forces on vertices were not kept; run with --forces, or step with forces = True")
        return pressures(self.vertex_normal, positions, triangles)

    def arrays(self, vertices: bool = False) -> dict[str, np.ndarray]:
        """What a run folder keeps of a step; vertices: also the forces on those that feel any."""
        kept = {name: getattr(self, name) for name in ("pairs", "normal", "friction", "torque", "centers")}
        if vertices and self.vertex_normal is not None and self.vertex_friction is not None:
            loaded = np.flatnonzero(np.any((self.vertex_normal != 0.0) | (self.vertex_friction != 0.0), axis=1))
            kept |= {
                "vertices": loaded,
                "vertex_normal": self.vertex_normal[loaded],
                "vertex_friction": self.vertex_friction[loaded],
            }
        return kept

    @classmethod
    def from_arrays(cls, names: Sequence[str], vertex_count: int, arrays: dict[str, np.ndarray]) -> "ContactForces":
        """What `arrays` gave."""
        arrays = dict(arrays)
        loaded = arrays.pop("vertices", None)
        for name in ("vertex_normal", "vertex_friction") if loaded is not None else ():
            whole = np.zeros((vertex_count, 3))
            whole[loaded] = arrays[name]
            arrays[name] = whole
        return cls(tuple(names), **arrays)

    def _number(self, name: str) -> int:
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f'there is no body "{name}"; there are: {", ".join(self.names)}') from None


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
    sums = (
        share * _added(rows, np.concatenate([getattr(each, name) for each in forces]), len(present))
        for name in ("normal", "friction", "torque")
    )
    vertices = (
        None if getattr(last, name) is None else np.mean([getattr(each, name) for each in forces], axis=0)
        for name in ("vertex_normal", "vertex_friction")
    )
    pairs = np.column_stack(np.divmod(present, b)).astype(np.int32)
    return ContactForces(last.names, pairs, *sums, last.centers, *vertices)


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


def pressures(force: np.ndarray, positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) Pa: the magnitude of force (n, 3), N, over the area around each vertex of the surface; 0 inside."""
    area = vertex_areas(positions, triangles)
    return np.where(area > 0.0, np.linalg.norm(force, axis=1) / np.where(area > 0.0, area, 1.0), 0.0)


def vertex_areas(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) m^2: a third of the triangles around each surface vertex, 0 inside."""
    corners = positions[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), minlength=len(positions))
