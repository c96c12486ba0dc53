"""What all kinds of constraints share: the rest data of many elements, and the constant matrix that they make."""

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse


@dataclass(frozen=True)
class ConstraintSet:
    """Elements of one kind. Element e has the energy w_e/2 |G_e x - p_e|_F^2, p_e the local projection of G_e x, Eq. (2).

    kind: name of the kind. vertices: (e, c) int32, the vertices of each element. gradient: (e, r, c), G; its r rows times the
    c positions are r 3-vectors. weight: (e,), w. data: further rest data by name, each (e, ...).
    """

    kind: str
    vertices: np.ndarray
    gradient: np.ndarray
    weight: np.ndarray
    data: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.vertices)


def make_set(kind: str, vertices, gradient, weight, **data: np.ndarray) -> ConstraintSet:
    """A `ConstraintSet` from arrays; a single weight holds for all elements.

    Raises ValueError for an element whose weight is negative or not finite, or whose rest shape gave no finite gradient.
    """
    vertices = np.asarray(vertices, dtype=np.int32)
    gradient = np.asarray(gradient, dtype=np.float64)
    weight = np.broadcast_to(np.asarray(weight, dtype=np.float64), (len(vertices),)).copy()
    bad = np.flatnonzero(~(np.isfinite(weight) & (weight >= 0.0)))
    if len(bad):
        raise ValueError(f"{kind} element {bad[0]}: the weight is {weight[bad[0]]}; it must be finite and not negative")
    bad = np.flatnonzero(~np.isfinite(gradient).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(
            f"{kind} element {bad[0]} (vertices {vertices[bad[0]].tolist()}): the rest shape is degenerate; it must have a "
            "positive length, area or volume"
        )
    return ConstraintSet(kind, vertices, gradient, weight, {name: np.asarray(value) for name, value in data.items()})


def merge(sets: list[ConstraintSet]) -> list[ConstraintSet]:
    """One set a kind, in the order in which the kinds first appear; elements keep their order."""
    kinds: dict[str, list[ConstraintSet]] = {}
    for s in sets:
        kinds.setdefault(s.kind, []).append(s)

    def together(parts: list[np.ndarray]) -> np.ndarray:
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return [
        ConstraintSet(
            kind,
            together([s.vertices for s in same]),
            together([s.gradient for s in same]),
            together([s.weight for s in same]),
            {name: together([s.data[name] for s in same]) for name in same[0].data},
        )
        for kind, same in kinds.items()
    ]


def stiffness_matrix(count: int, sets: list[ConstraintSet]) -> scipy.sparse.csr_matrix:
    """(count, count): sum of w G^T G, the constant part of Eq. (3) without the mass; the same for the three coordinates."""
    matrix = scipy.sparse.csr_matrix((count, count))
    for s in sets:  # one kind at a time: triplets of all together would need more memory than anything else in a model
        corners = s.vertices.shape[1]
        rows, columns = np.repeat(s.vertices, corners, axis=1).ravel(), np.tile(s.vertices, (1, corners)).ravel()
        values = np.einsum("e,eri,erj->eij", s.weight, s.gradient, s.gradient).ravel()
        matrix = matrix + scipy.sparse.csr_matrix((values, (rows, columns)), shape=(count, count))
    return matrix
