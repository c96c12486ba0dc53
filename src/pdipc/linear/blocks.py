"""The Newton matrix, assembled from 3x3 blocks: K = held I + elastic Hessians, without contacts.

Rows of an elastic Hessian add up to zero, for a motion of all vertices together costs no elastic energy. So only blocks off the diagonal are
stored, and a product takes differences,

    (K p)_i = held_i p_i + sum_j K_ij (p_j - p_i),

which keeps the common motion of a stiff body exact in any precision. held: mass over h^2, damping, and attachments to points.

The pattern is made once; the values are gathered by block, each from the elements that have both vertices, and written to both places
that they have in a symmetric matrix.
"""

import functools
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device.language import filled, kernel, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real


@functools.cache
def rows_of(real: Real) -> Any:
    """A struct: the matrix as kernels that multiply with it read it."""
    return struct_of(
        "BlockRows",
        __name__,
        offsets=wp.array(dtype=wp.int32),
        columns=wp.array(dtype=wp.int32),
        values=wp.array(dtype=real.mat33),
        held=wp.array(dtype=real.scalar),
    )


class Hessians(Protocol):
    """What the matrix is made of: elements of several kinds. See `constraints.Projector`."""

    sets: list
    bending: list
    blocks: wp.array

    def differentiate(self, base: wp.array, u: wp.array, project: wp.array) -> None: ...


class BlockMatrix:
    """offsets (n + 1,), columns (nnz,), values (nnz,) 3x3 on the device: the blocks off the diagonal, rows of free vertices only.

    free_end: how many vertices there are up to the last free one; obstacles, which come last, have no rows.
    held: (n,) kg/s^2, 0 where not free. diagonal: (n,) 3x3 blocks, the elastic ones with held; filled by `assemble`.
    pattern: the same pattern as a SciPy matrix, for what groups vertices. rows: what kernels take, of the type `rows_of`.
    """

    def __init__(self, device: Device, real: Real, projector: Hessians, held: np.ndarray, free: np.ndarray):
        n = len(free)
        self.device, self.real, self.count, self.projector = device, real, n, projector
        self.free_end = int(np.flatnonzero(free).max(initial=-1)) + 1
        rows, columns, slots = [], [], []
        block = 0
        bending = {id(s) for s in projector.bending}
        constant = sp.csr_matrix((n, n))
        for s in projector.sets:
            c = s.vertices.shape[1]
            if id(s) not in bending:
                if c > 1:
                    constant = constant + _scalars(s, n)
                continue
            index = {pair: k for k, pair in enumerate((a, b) for a in range(c) for b in range(a, c))}
            per = len(index)
            own = block + per * np.arange(len(s))
            for a in range(c):
                for b in range(c):
                    if a != b:
                        rows.append(s.vertices[:, a])
                        columns.append(s.vertices[:, b])
                        slots.append(2 * (own + index[min(a, b), max(a, b)]) + (a > b))
            block += per * len(s)
        constant = constant.tocoo()
        apart = constant.row != constant.col
        fixed_rows, fixed_columns, fixed = constant.row[apart], constant.col[apart], constant.data[apart]
        row = np.concatenate([*rows, np.zeros(0, dtype=np.int64)]).astype(np.int64)
        column = np.concatenate([*columns, np.zeros(0, dtype=np.int64)]).astype(np.int64)
        slot = np.concatenate([*slots, np.zeros(0, dtype=np.int64)])
        inside = free[row]
        row, column, slot = row[inside], column[inside], slot[inside]
        inside = free[fixed_rows]
        fixed_key = fixed_rows[inside].astype(np.int64) * n + fixed_columns[inside]
        key = row * n + column
        keys = np.union1d(key, fixed_key)
        self.nnz = len(keys)
        # the blocks that are gathered: of two that are each other's transpose, the one above the diagonal
        at, turned = keys // n, keys % n * n + keys // n
        mirror = np.searchsorted(keys, turned)
        mirrored = keys[np.minimum(mirror, self.nnz - 1)] == turned if self.nnz else np.zeros(0, dtype=bool)
        gathered = np.flatnonzero(~mirrored | (at < keys % n))
        order = np.lexsort((slot % 2, key))  # those to be transposed come last
        first, end = (np.searchsorted(key[order], keys[gathered], side=side) for side in ("left", "right"))
        turns = np.concatenate([[0], np.cumsum(slot[order] % 2)])
        middle = end - (turns[end] - turns[first])
        scalars = np.zeros(self.nnz)
        scalars[np.searchsorted(keys, fixed_key)] = fixed[inside]
        offsets = np.searchsorted(keys, np.arange(n + 1) * n)
        self._gathered = len(gathered)
        self.pattern = sp.csr_matrix((np.ones(self.nnz), keys % n, offsets), shape=(n, n))

        def upload(values: np.ndarray, dtype) -> wp.array:
            return wp.array(np.append(values, 0), dtype=dtype, device=device.warp)  # never empty

        self.offsets = wp.array(offsets.astype(np.int32), device=device.warp)
        self.columns = upload(keys % n, wp.int32)
        self.values = wp.zeros(self.nnz + 1, dtype=real.mat33, device=device.warp)
        self.diagonal = wp.zeros(n, dtype=real.mat33, device=device.warp)
        self.held = wp.array(np.where(free, held, 0.0), dtype=real.scalar, device=device.warp)
        self.rows = filled(rows_of(real), self)
        self._unrestrained = wp.clone(self.held)
        self._first, self._middle, self._end, self._places = (upload(each, wp.int32) for each in (first, middle, end, gathered))
        self._mirrors = upload(np.where(mirrored, mirror, -1)[gathered], wp.int32)
        self._slots = upload(slot[order] // 2, wp.int32)
        self._scalars = upload(scalars, real.scalar)
        self._blocks = projector.blocks  # made now: recording must not allocate
        self._kernels = kernels(real)

    def restrain(self, body: wp.array, restraint: wp.array) -> None:
        """Launches `held` as 1 + restraint times what it is by itself, body by body. body: (n,) int32, -1 for none."""
        inputs = [body, restraint, self._unrestrained, self.held]
        self.device.launch(self._kernels.restrain, self.free_end, inputs)

    def assemble(self, base: wp.array, u: wp.array, project: wp.array) -> None:
        """Launches the values at x = base + u; project: see `Hessians`."""
        k, device = self._kernels, self.device
        self.projector.differentiate(base, u, project)
        inputs = [
            self._first,
            self._middle,
            self._end,
            self._slots,
            self._places,
            self._mirrors,
            self._scalars,
            self._blocks,
            self.values,
        ]
        device.launch(k.gather, self._gathered, inputs, grain=16)
        device.launch(k.gather_diagonal, self.free_end, [self.offsets, self.held, self.values, self.diagonal], grain=32)


def _scalars(s, n: int) -> sp.csr_matrix:
    """w G^T G of a set, one scalar a pair of vertices."""
    corners = s.vertices.shape[1]
    row, column = np.repeat(s.vertices, corners, axis=1).ravel(), np.tile(s.vertices, (1, corners)).ravel()
    values = np.einsum("e,eri,erj->eij", s.weight, s.gradient, s.gradient).ravel()
    return sp.csr_matrix((values, (row, column)), shape=(n, n))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, mat33 = real.scalar, real.mat33
    module = real.module(__name__)

    @kernel(module)
    def gather(
        first: int,
        begins: wp.array(dtype=wp.int32),
        middles: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        places: wp.array(dtype=wp.int32),
        mirrors: wp.array(dtype=wp.int32),
        scalars: wp.array(dtype=scalar),
        blocks: wp.array(dtype=mat33),
        values_out: wp.array(dtype=mat33),
    ):
        """The sum of the elements' blocks; from `middles` on they are to be transposed."""
        e = first + wp.tid()
        total = mat33()
        turned = mat33()
        for k in range(begins[e], middles[e]):
            total += blocks[slots[k]]
        for k in range(middles[e], ends[e]):
            turned += blocks[slots[k]]
        total += wp.transpose(turned)
        c = scalars[places[e]]
        total[0, 0] = total[0, 0] + c
        total[1, 1] = total[1, 1] + c
        total[2, 2] = total[2, 2] + c
        values_out[places[e]] = total
        if mirrors[e] >= 0:
            values_out[mirrors[e]] = wp.transpose(total)

    @kernel(module)
    def gather_diagonal(
        first: int,
        offsets: wp.array(dtype=wp.int32),
        held: wp.array(dtype=scalar),
        values: wp.array(dtype=mat33),
        diagonal_out: wp.array(dtype=mat33),
    ):
        i = first + wp.tid()
        total = mat33()
        for k in range(offsets[i], offsets[i + 1]):
            total -= values[k]
        total[0, 0] = total[0, 0] + held[i]
        total[1, 1] = total[1, 1] + held[i]
        total[2, 2] = total[2, 2] + held[i]
        diagonal_out[i] = total

    @kernel(module)
    def restrain(
        first: int,
        body: wp.array(dtype=wp.int32),
        restraint: wp.array(dtype=scalar),
        held: wp.array(dtype=scalar),
        held_out: wp.array(dtype=scalar),
    ):
        i = first + wp.tid()
        total = held[i]
        if body[i] >= 0:
            total += restraint[body[i]] * held[i]
        held_out[i] = total

    return SimpleNamespace(gather=gather, gather_diagonal=gather_diagonal, restrain=restrain)
