"""Direct solution by a sparse factorization of A, computed once on the host.

Contacts change K from solve to solve. Then the factorization of A preconditions conjugate gradients on K, whose number of
iterations is the rank of what contacts add, at most, and in practice a few dozen.
"""

import importlib
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import warp as wp

from pdipc.linear.solver import Contact, Solver
from pdipc.linear.system import System


class Direct(Solver):
    """Sparse Cholesky (cholespy, where it is installed, else SciPy's SuperLU). Runs on the host and cannot be recorded."""

    recordable = False
    moves_bodies = True

    def __init__(self, system: System, tolerance: float, max_iterations: int):
        super().__init__(system, tolerance, max_iterations)
        self._free = np.flatnonzero(system.free)
        self._matrix = sp.csc_matrix(system.matrix[self._free][:, self._free])
        self._fixed = system.matrix[self._free][:, np.flatnonzero(~system.free)].tocsr()
        self._inverse = factorize(self._matrix) if self._free.size else np.copy
        self._p, self._y = self.zeros(self.real.vec3), self.zeros(self.real.vec3)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        free, n = self._free, self.system.count
        start = x.numpy().astype(np.float64)
        right = b.numpy()[free].astype(np.float64)
        if not prepared:
            self.prepare(contact)

        def hessian(p: np.ndarray) -> np.ndarray:
            """Contacts' part of K p at the free vertices."""
            if contact is None or free.size == 0:
                return np.zeros((free.size, 3))
            if contact.apply is None:
                assert contact.scalar is not None  # it is the whole contribution, then
                return contact.scalar.numpy()[free, None] * p[free]
            self._p.assign(np.concatenate([p, np.zeros((len(self._p) - n, 3))]).astype(self.real.numpy))
            self._y.zero_()
            contact.apply(self._p, self._y)
            return self._y.numpy()[free].astype(np.float64)

        def spread(values: np.ndarray) -> np.ndarray:
            whole = np.zeros((n, 3))
            whole[free] = values
            return whole

        blocks = self._blocks(contact)
        solution = start.copy()
        r = right - self._matrix @ start[free] - self._fixed @ start[~self.system.free] - hessian(start)
        first = np.sqrt(np.sum(r * np.einsum("nij,nj->ni", blocks, r)))
        limit = self.tolerance * first
        norm, done = first, 0
        z = self._inverse(r) if first > 0.0 else r
        p, gamma = z, np.sum(r * z)
        while norm > limit and done < self.max_iterations:
            kp = self._matrix @ p + hessian(spread(p))
            alpha = gamma / np.sum(p * kp)
            solution[free] += alpha * p
            r = r - alpha * kp
            norm, done = np.sqrt(np.sum(r * np.einsum("nij,nj->ni", blocks, r))), done + 1
            if contact is None:
                break
            z = self._inverse(r)
            gamma, before = np.sum(r * z), gamma
            p = z + gamma / before * p
        x.assign(solution.astype(self.real.numpy))
        self.first.fill_(first)
        self.residual.fill_(norm / first if first > 0.0 else 0.0)
        self.iterations.assign(self.iterations.numpy() + done)

    def _blocks(self, contact: Contact | None) -> np.ndarray:
        """Inverse diagonal blocks at the free vertices, for the norm of the residual."""
        inverse = self.inverse.numpy()[self._free].astype(np.float64)
        blocks = inverse[:, None, None] * np.eye(3)
        full = inverse < 0.0
        blocks[full] = self.inverse_block.numpy()[self._free][full]
        return blocks


def factorize(matrix: sp.csc_matrix):
    """A function that applies the inverse of a symmetric positive definite matrix to the columns of an array."""
    try:
        cholespy: Any = importlib.import_module("cholespy")
    except ImportError:
        options = {"SymmetricMode": True}
        return spla.splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve
    entries = matrix.tocoo()
    indices = entries.row.astype(np.int32), entries.col.astype(np.int32)
    solver = cholespy.CholeskySolverD(matrix.shape[0], *indices, entries.data, cholespy.MatrixType.COO)

    def solve(b: np.ndarray) -> np.ndarray:
        b = np.ascontiguousarray(b)
        x = np.zeros_like(b)
        solver.solve(b, x)
        return x

    return solve
