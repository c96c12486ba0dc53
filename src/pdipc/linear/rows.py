"""Sparse matrices laid out for products with vectors of 3-vectors.

On the CPU compressed rows. On CUDA slices of 32 rows, one for each thread of a warp, padded to the longest row of the slice and
stored entry by entry, so that neighbouring threads read neighbouring memory.
"""

import functools
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device import language
from pdipc.device.language import filled, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real

SLICE = 32  # rows of a slice on CUDA


@functools.cache
def entries(real: Real) -> Any:
    """A struct: the entries of a sparse matrix as kernels read them."""
    return struct_of(
        "Entries",
        __name__,
        offsets=wp.array(dtype=wp.int32),
        columns=wp.array(dtype=wp.int32),
        values=wp.array(dtype=real.scalar),
    )


class Rows:
    """A sparse matrix of scalars on the device.

    offsets: first entry of each row (CPU) or slice (CUDA). columns, values: (entries,), padded by zeros in the row's column.
    positions: (nnz,) host array, where the entries of the SciPy matrix went.
    operand: what kernels take, of the type `entries`.
    """

    def __init__(self, device: Device, real: Real, matrix: sp.csr_matrix):
        if device.is_cuda:
            offsets, columns, self.positions = _sliced(matrix)
        else:
            offsets, columns, self.positions = matrix.indptr, matrix.indices, np.arange(matrix.nnz)
        values = np.zeros(max(1, len(columns)), dtype=real.numpy)
        values[self.positions] = matrix.data
        self.real, self.count = real, len(columns)
        self.offsets = wp.array(offsets.astype(np.int32), device=device.warp)
        self.columns = wp.array(np.resize(columns, len(values)).astype(np.int32), device=device.warp)
        self.values = wp.array(values, device=device.warp)
        self.operand = filled(entries(real), self)

    @property
    def bytes(self) -> int:
        """Memory of entries and offsets."""
        return self.count * (4 + self.real.numpy.itemsize) + 4 * self.offsets.size


def _sliced(matrix: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets of slices, padded columns, and the position of each entry."""
    count = matrix.shape[0]
    slices = -(-count // SLICE)
    lengths = np.zeros(slices * SLICE, dtype=np.int64)
    lengths[:count] = np.diff(matrix.indptr)
    width = lengths.reshape(slices, SLICE).max(axis=1, initial=0)
    offsets = np.concatenate([[0], np.cumsum(width * SLICE)])
    entry = np.arange(offsets[-1])
    row = np.repeat(np.arange(slices) * SLICE, width * SLICE) + entry % SLICE
    columns = np.minimum(row, count - 1)
    rows = np.repeat(np.arange(count), np.diff(matrix.indptr))
    within = np.arange(matrix.nnz) - matrix.indptr[rows]
    positions = offsets[rows // SLICE] + within * SLICE + rows % SLICE
    columns[positions] = matrix.indices
    return offsets, columns, positions


# Two sums side by side, because an addition has to wait for the one before. On the CPU all three components are read and
# multiplied as one register of four, whose last lane is the next vertex's and is dropped: vectors need one spare entry.
# OWN(k) is what is taken off every vertex: zero, or the row's own vertex.
_ROW_PRODUCT = """
    const SCALAR own0 = OWN(0), own1 = OWN(1), own2 = OWN(2);
#if defined(__CUDA_ARCH__)
    const int slice = i / SLICE;
    const int high = rows.offsets.data[slice + 1];
    SCALAR a = 0, b = 0, c = 0;
    for (int e = rows.offsets.data[slice] + i % SLICE; e < high; e += SLICE) {
        const SCALAR v = rows.values.data[e];
        const auto& p = x.data[rows.columns.data[e]];
        a += v * (p.c[0] - own0); b += v * (p.c[1] - own1); c += v * (p.c[2] - own2);
    }
    return {a, b, c};
#else
    typedef SCALAR four __attribute__((vector_size(4 * sizeof(SCALAR)), aligned(sizeof(SCALAR))));
    const int* column = rows.columns.data;
    const SCALAR* value = rows.values.data;
    const SCALAR* vertex = (const SCALAR*)x.data;
    const int high = rows.offsets.data[i + 1];
    const four own = {own0, own1, own2, 0};
    four a = {0, 0, 0, 0}, b = {0, 0, 0, 0};
    int e = rows.offsets.data[i];
    for (; e + 1 < high; e += 2) {
        a += value[e] * (*(const four*)(vertex + 3 * (long long)column[e]) - own);
        b += value[e + 1] * (*(const four*)(vertex + 3 * (long long)column[e + 1]) - own);
    }
    if (e < high) { a += value[e] * (*(const four*)(vertex + 3 * (long long)column[e]) - own); }
    a += b;
    return {a[0], a[1], a[2]};
#endif
"""


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """The product of one row with a vector of 3-vectors: sum_j a_ij x_j, and sum_j a_ij (x_j - x_i).

    The second, where it can be had, leaves nothing of a common motion of all vertices, whatever float32 made of a_ij.
    """
    vec3, Entries = real.vec3, entries(real)
    product = _ROW_PRODUCT.replace("SCALAR", f"wp::{real.name}").replace("SLICE", str(SLICE))

    @language.func_native(re.sub(r"OWN\(\d\)", "0", product))
    def row_product(i: int, rows: Entries, x: wp.array(dtype=vec3)) -> vec3: ...

    @language.func_native(re.sub(r"OWN\((\d)\)", r"x.data[i].c[\1]", product))
    def row_difference(i: int, rows: Entries, x: wp.array(dtype=vec3)) -> vec3: ...

    return SimpleNamespace(row_product=row_product, row_difference=row_difference)
