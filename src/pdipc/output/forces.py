"""Forces of contact in a step, as results hold them: on every vertex, on every body, and of each body on each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


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


def pressures(force: np.ndarray, positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) Pa: the magnitude of force (n, 3), N, over the area around each vertex of the surface; 0 inside."""
    area = vertex_areas(positions, triangles)
    return np.where(area > 0.0, np.linalg.norm(force, axis=1) / np.where(area > 0.0, area, 1.0), 0.0)


def vertex_areas(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) m^2: a third of the triangles around each surface vertex, 0 inside."""
    corners = positions[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), minlength=len(positions))
