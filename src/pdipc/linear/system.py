"""The constant matrix A of Eq. (3) on the device."""

import functools
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.linear.rows import Rows


class System:
    """A = M/h^2 + sum of w G^T G: symmetric, positive definite on the free vertices, one scalar for each pair of vertices.

    device, real: where and in which precision the solvers compute.
    matrix: (n, n) scipy sparse matrix, kg/s^2. Rows may be empty (vertices of obstacles).
    free: (n,) bool; False for vertices whose position is prescribed: solvers read it and leave it as it is.

    rows: the off-diagonal entries of the free rows on the device.
    diagonal: (n,) A_ii where free, 0 elsewhere, on the device, kg/s^2. row_sum: (n,) sum_j A_ij likewise: what moving everything
        together costs, mass/h^2 and pins, added up in double precision.
    Raises ValueError where the matrix is not square, not symmetric, or a free vertex has a diagonal entry that is not positive.
    """

    def __init__(self, device: Device, real: Real, matrix: Any, free: np.ndarray):
        matrix = sp.csr_matrix(matrix, dtype=np.float64)
        matrix.sum_duplicates()
        free = np.asarray(free, dtype=bool)
        _check(matrix, free)
        self.device, self.real, self.matrix, self.free = device, real, matrix, free
        self.count = matrix.shape[0]
        rows = sp.diags_array(free.astype(np.float64)) @ (matrix - sp.diags_array(matrix.diagonal()))
        rows = sp.csr_matrix(rows)
        rows.eliminate_zeros()
        rows.sort_indices()
        self.rows = Rows(device, real, rows)
        self.diagonal = wp.array(np.where(free, matrix.diagonal(), 0.0).astype(real.numpy), device=device.warp)
        row_sum = np.where(free, np.asarray(matrix.sum(axis=1)).ravel(), 0.0)
        self.row_sum = wp.array(row_sum.astype(real.numpy), device=device.warp)

    @functools.cached_property
    def interval(self) -> tuple[float, float]:
        """[lo, hi], which holds all eigenvalues of D^-1 A on the free vertices (see spectrum.py)."""
        from pdipc.linear.paper import spectrum

        return spectrum.interval(self)


def _check(matrix: sp.csr_matrix, free: np.ndarray) -> None:
    n, columns = matrix.shape
    if n != columns or free.shape != (n,):
        raise ValueError(f"the matrix is {n} x {columns} and free has shape {free.shape}; needed: (n, n) and (n,)")
    asymmetry = abs(matrix - matrix.T)
    largest = abs(matrix).max() if matrix.nnz else 0.0
    if asymmetry.nnz and not asymmetry.max() <= 1e-12 * largest:
        i, j = np.unravel_index(asymmetry.argmax(), asymmetry.shape)
        raise ValueError(
            f"the matrix is not symmetric: entries ({i}, {j}) and ({j}, {i}) are {matrix[i, j]} and {matrix[j, i]}"
        )
    diagonal = matrix.diagonal()
    bad = np.flatnonzero(free & ~(diagonal > 0.0))
    if bad.size:
        raise ValueError(f"free vertex {bad[0]} has the diagonal entry {diagonal[bad[0]]}; it must be positive (has it mass?)")
