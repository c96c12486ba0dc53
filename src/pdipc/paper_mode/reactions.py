"""Forces of contact in the paper's mode, from the balance of each body.

The targets of Eq. (6) do not tell them: truncation stops what the targets let through, and a resting body is held by that for the most part. But
what is missing in the balance of a body is what contact did to its momentum, by Newton's second law. The forces of bodies on each other
are those that add up to it, each with its reaction: where contacts form a tree they are unique, in a loop the least are taken.
Where no obstacle takes part and the mode loses momentum, the loss is shared out. The one t_I stops bodies that touch nothing, too:
that is no force of any pair, and is left out.
"""

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import lsqr


def reactions(missing: np.ndarray, quads: np.ndarray, parts: np.ndarray, owner: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(k, 4, 3) N: forces of pairs that explain what is missing in the balance of vertices, missing (n, 3) N = m (x - z) / h^2 + grad Psi.

    quads, parts: (k, 4) vertices of pairs, and by what part each feels its pair. owner: (n,) bodies. free: (n,) bool.
    """
    if not len(quads):
        return np.zeros((0, 4, 3))
    bodies, n = int(owner.max()) + 1, len(owner)
    body = owner[quads]
    other = np.where(body == body[:, :1], body[:, 3:], body[:, :1])
    share = np.where(free[quads], parts, 0.0)
    simulated = np.bincount(owner, free, minlength=bodies) > 0.0
    total = np.column_stack([np.bincount(owner, missing[:, axis], minlength=bodies) for axis in range(3)])
    ends = np.unique(np.sort(np.column_stack([body[:, 0], body[:, 3]])[body[:, 0] != body[:, 3]], axis=1), axis=0)
    count = np.arange(len(ends))
    incidence = scipy.sparse.coo_matrix(
        (np.repeat([1.0, -1.0], len(ends)), (ends.T.ravel(), np.tile(count, 2))), shape=(bodies, len(ends))
    ).tocsr()[simulated]
    between = np.column_stack([lsqr(incidence, total[simulated, axis], atol=1e-14, btol=1e-14)[0] for axis in range(3)])
    sides, side = np.unique((body.astype(np.int64) * bodies + other).ravel(), return_inverse=True)
    wanted = np.zeros((len(sides), 3))  # parts of one body exert nothing on it
    for sign, (one, another) in ((1.0, ends.T), (-1.0, ends.T[::-1])):
        wanted[np.searchsorted(sides, one.astype(np.int64) * bodies + another)] = sign * between
    at_vertex = np.bincount(quads.ravel(), share.ravel(), minlength=n)
    density = missing / np.where(at_vertex > 0.0, at_vertex, 1.0)[:, None]
    forces = share[:, :, None] * density[quads]
    weight = np.bincount(side, share.ravel(), minlength=len(sides))
    for axis in range(3):
        lacking = wanted[:, axis] - np.bincount(side, forces[:, :, axis].ravel(), minlength=len(sides))
        forces[:, :, axis] += share * (lacking / np.where(weight > 0.0, weight, 1.0))[side].reshape(share.shape)
    held = np.where(free[quads], 0.0, parts)
    return forces - held[:, :, None] * (forces.sum(axis=1) / np.maximum(held.sum(axis=1), 1e-300)[:, None])[:, None]
