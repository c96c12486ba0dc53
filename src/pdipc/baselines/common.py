"""What both baselines use: sparse symmetric systems in 3 x 3 blocks, their factorisation, and small meshes."""

import importlib
import importlib.util
from typing import Any

import numpy as np
import scipy.sparse as sp


def _solver_name() -> str:
    return "CHOLMOD (cholespy)" if importlib.util.find_spec("pypardiso") is None else "MKL PARDISO (pypardiso)"


class Cholesky:
    """Solves with a symmetric positive definite matrix, given by its upper triangle (diagonal included) in CSR.

    MKL's PARDISO where pypardiso is installed, as the paper's IPC has it; else CHOLMOD.
    """

    name = _solver_name()
    _solver: Any  # neither library says its types

    def __init__(self):
        if self.name.startswith("MKL"):
            self._solver = importlib.import_module("pypardiso").PyPardisoSolver(mtype=2)

    def factorize(self, upper: sp.csr_matrix) -> "Cholesky":
        """Factorises anew."""
        if self.name.startswith("MKL"):
            upper.sort_indices()
            self._matrix = upper
            self._solver.set_phase(12)
            self._solver._call_pardiso(upper, np.zeros((upper.shape[0], 1)))
            self._solver.set_phase(33)
        else:
            cholespy: Any = importlib.import_module("cholespy")
            full = sp.csc_matrix(upper + sp.triu(upper, 1).T)
            kind = cholespy.MatrixType.CSC
            self._solver = cholespy.CholeskySolverD(full.shape[0], full.indptr, full.indices, full.data, kind)
        return self

    def solve(self, b: np.ndarray) -> np.ndarray:
        """A^-1 b for b (n,) or (n, m)."""
        b = np.ascontiguousarray(b, dtype=float)
        if self.name.startswith("MKL"):
            columns = np.asfortranarray(b.reshape(len(b), -1))
            return np.ascontiguousarray(self._solver._call_pardiso(self._matrix, columns)).reshape(b.shape)
        x = np.zeros_like(b)
        self._solver.solve(b, x)
        return x

    def __del__(self):
        if self.name.startswith("MKL") and hasattr(self, "_solver"):
            self._solver.free_memory(everything=True)


class BlockPattern:
    """Where the element Hessians of given stencils go in the upper triangle of a matrix of 3 x 3 blocks.

    stencils: list of (k, s) vertex indices. number: (n,) the row of each vertex among the free ones, -1 for kinematic vertices.
    """

    def __init__(self, stencils: list[np.ndarray], number: np.ndarray):
        size = int(number.max()) + 1
        self.size, self._picks, keys = size, [], []
        for stencil in stencils:
            s = stencil.shape[1]
            row, column = number[np.repeat(stencil, s, axis=1)].ravel(), number[np.tile(stencil, (1, s))].ravel()
            pick = np.flatnonzero((row >= 0) & (column >= row))
            self._picks.append(pick)
            keys.append(row[pick].astype(np.int64) * size + column[pick])
        unique, slot = np.unique(np.concatenate(keys), return_inverse=True)
        self.indices = (unique % size).astype(np.int32)
        self.indptr = np.searchsorted(unique // size, np.arange(size + 1)).astype(np.int32)
        self._sum = sp.csr_matrix((np.ones(len(slot)), (slot, np.arange(len(slot)))), shape=(len(unique), len(slot)))

    def assemble(self, hessians: list[np.ndarray]) -> sp.csr_matrix:
        """The upper triangle of the sum of element Hessians (k, s, 3, s, 3), one array for each stencil list."""
        parts = []
        for hessian, pick in zip(hessians, self._picks, strict=True):
            blocks = hessian.transpose(0, 1, 3, 2, 4).reshape(-1, 9)
            parts.append(blocks[pick])
        data = (self._sum @ np.concatenate(parts)).reshape(-1, 3, 3)
        matrix = sp.bsr_matrix((data, self.indices, self.indptr), shape=(3 * self.size, 3 * self.size))
        return sp.csr_matrix(sp.triu(matrix.tocsr(), format="csr"))


def scatter(stencil: np.ndarray, values: np.ndarray, vertex_count: int) -> np.ndarray:
    """Sums values (k, s, 3) at the vertices of stencil (k, s): (n, 3)."""
    index = stencil.ravel()
    flat = values.reshape(-1, 3)
    return np.stack([np.bincount(index, flat[:, i], vertex_count) for i in range(3)], axis=1)


def boundary(tets: np.ndarray) -> np.ndarray:
    """The triangles (m, 3) that bound positively oriented tets, outward."""
    faces = tets[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def box(size, cells, centre=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """A box of cells (a, b, c) of six tets each: positions (n, 3), tets (t, 4)."""
    counts = np.asarray(cells)
    grid = np.stack(np.meshgrid(*(np.arange(c + 1) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    positions = (grid / counts - 0.5) * np.asarray(size, dtype=float) + centre
    stride = np.array([(counts[1] + 1) * (counts[2] + 1), counts[2] + 1, 1])
    corner = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3) @ stride
    tets = []
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2), (2, 1, 0)):
        way = np.cumsum([0, *stride[list(order)]])
        odd = order in ((0, 2, 1), (1, 0, 2), (2, 1, 0))
        tets.append(corner[:, None] + way[[0, 2, 1, 3] if odd else [0, 1, 2, 3]])
    return positions, np.concatenate(tets)


def sheet(size, cells, centre=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """A flat rectangle in the plane y = const that faces up: positions (n, 3), triangles (m, 3)."""
    a, b = cells
    i, j = np.meshgrid(np.arange(a + 1), np.arange(b + 1), indexing="ij")
    positions = np.stack([(i / a - 0.5) * size[0], 0.0 * i, (j / b - 0.5) * size[1]], axis=-1).reshape(-1, 3) + centre
    v = (np.arange(a)[:, None] * (b + 1) + np.arange(b)).ravel()
    right, up = b + 1, 1
    triangles = np.concatenate(
        [np.stack([v, v + up, v + right], axis=1), np.stack([v + right, v + up, v + right + up], axis=1)]
    )
    return positions, triangles


def sphere(radius, level=3, centre=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """An octahedron divided `level` times and blown up: positions (n, 3), triangles (m, 3), outward."""
    x = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    t = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(level):
        edges = np.sort(t[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        m = len(x) + index.reshape(-1, 3)
        x = np.concatenate([x, x[unique].mean(axis=1)])
        x /= np.linalg.norm(x, axis=1)[:, None]
        a, b, c = t.T
        t = np.concatenate(
            [np.stack(q, axis=1) for q in ((a, m[:, 0], m[:, 2]), (m[:, 0], b, m[:, 1]), (m[:, 2], m[:, 1], c), tuple(m.T))]
        )
    return radius * x + centre, t


def lumped_tet_masses(vertex_count: int, tets: np.ndarray, volumes: np.ndarray, density: float) -> np.ndarray:
    """(n,) kg: a quarter of each tet's mass to each of its vertices."""
    return np.bincount(tets.ravel(), np.repeat(volumes * density / 4, 4), vertex_count)
