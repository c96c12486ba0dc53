"""A-Jacobi as matrix powers: several sweeps of Chebyshev's iteration in one kernel.

Aggregating coefficients (aggregated.py) needs a diagonal of scalars. Here a group of vertices takes `order` sweeps by itself:
it reads its own vertices and `order` rings of neighbours into fast memory, and each sweep updates one ring less, so that
its own vertices end up exactly where `order` separate sweeps would have brought them. That works with the 3x3 blocks of
contacts too, and reads the matrix from slow memory once for all sweeps, at the price of doing the rings twice.
"""

import functools
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device import language
from pdipc.device.language import kernel
from pdipc.device.launch import BLOCK
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear import partition
from pdipc.linear.paper import jacobi
from pdipc.linear.solver import Contact
from pdipc.linear.system import System

SHARED_BYTES = 40 * 1024  # fast memory of a block of threads on CUDA, with some left for sums
CPU_GROUP = 512  # vertices of a group on the CPU

_SWEEPS = """
#if defined(__CUDA_ARCH__)
#define SYNC __syncthreads()
    __shared__ SCALAR first_buffer[3 * CAPACITY + 1], second_buffer[3 * CAPACITY + 1];
#else
#define SYNC
    typedef SCALAR four __attribute__((vector_size(4 * sizeof(SCALAR)), aligned(sizeof(SCALAR))));  // as in rows.py
    SCALAR first_buffer[3 * CAPACITY + 1], second_buffer[3 * CAPACITY + 1];
#endif
    SCALAR* now = first_buffer;
    SCALAR* last = second_buffer;
    const int base = starts.data[group];
    const int count = starts.data[group + 1] - base;
    const int* vertex = vertices.data + base;
    const int* first_entry = offsets.data + row_starts.data[group];
    const int* column = columns.data;
    const SCALAR* value = values.data;
    for (int k = lane; k < count; k += lanes) {
        for (int c = 0; c < 3; ++c) {
            now[3 * k + c] = x.data[vertex[k]].c[c];
            last[3 * k + c] = before.data[vertex[k]].c[c];
        }
    }
    SYNC;
    const int own = updated.data[group * order + order - 1];
    SCALAR gamma = 0;
    for (int t = 0; t < order; ++t) {
        const int rows = updated.data[group * order + t];
        const SCALAR omega = factors.data[done + t];
        for (int k = lane; k < rows; k += lanes) {
            const int v = vertex[k];
            const SCALAR factor = inverse.data[v];
            if (factor == 0) { continue; }
            SCALAR r[3], u[3];
            const int low = first_entry[k], high = first_entry[k + 1];
#if defined(__CUDA_ARCH__)
            SCALAR sum[3] = {0, 0, 0};
            for (int e = low; e < high; ++e) {
                for (int c = 0; c < 3; ++c) { sum[c] += value[e] * now[3 * column[e] + c]; }
            }
#else
            four sum = {0, 0, 0, 0}, odd = {0, 0, 0, 0};
            int e = low;
            for (; e + 1 < high; e += 2) {
                sum += value[e] * *(const four*)(now + 3 * column[e]);
                odd += value[e + 1] * *(const four*)(now + 3 * column[e + 1]);
            }
            if (e < high) { sum += value[e] * *(const four*)(now + 3 * column[e]); }
            sum += odd;
#endif
            for (int c = 0; c < 3; ++c) { r[c] = b.data[v].c[c] - diagonal.data[v] * now[3 * k + c] - sum[c]; }
            for (int c = 0; c < 3; ++c) {
                u[c] = factor * r[c];
                if (factor < 0) {
                    const auto& m = inverse_block.data[v];
                    u[c] = m.data[c][0] * r[0] + m.data[c][1] * r[1] + m.data[c][2] * r[2];
                }
            }
            if (t == 0 && k < own) { gamma += r[0] * u[0] + r[1] * u[1] + r[2] * u[2]; }
            for (int c = 0; c < 3; ++c) {
                SCALAR& old = last[3 * k + c];
                old += omega * (now[3 * k + c] + weight * u[c] - old);
            }
        }
        SYNC;
        SCALAR* swap = now; now = last; last = swap;
    }
    for (int k = lane; k < own; k += lanes) {
        for (int c = 0; c < 3; ++c) {
            x_out.data[vertex[k]].c[c] = now[3 * k + c];
            before_out.data[vertex[k]].c[c] = last[3 * k + c];
        }
    }
    return gamma;
#undef SYNC
"""


class MatrixPowers(jacobi.Chebyshev):
    """Chebyshev's iteration with `order` sweeps in one kernel; an iteration counts `order` sweeps.

    order: sweeps of one kernel, 1 or more. group: vertices of a group, by default what fits into fast memory.
    Contacts with coupling have to be applied between any two sweeps: with them it is Chebyshev's iteration sweep by sweep.
    """

    def __init__(self, system: System, tolerance: float, max_iterations: int, order: int = 2, group: int | None = None):
        if order < 1:
            raise ValueError(f"order is {order}; it must be at least 1")
        self.order, self.chunk = order, 2 * order
        super().__init__(system, tolerance, max_iterations * order)
        self._plan(group)
        self._x2, self._before2 = self.zeros(self.real.vec3), self.zeros(self.real.vec3)
        self._grouped = group_kernels(self.real, self.capacity)

    @property
    def bytes(self) -> int:
        """Memory of the groups' rows and indices on the device."""
        return sum(array.capacity for array in self._group_arrays)

    def _plan(self, group: int | None) -> None:
        """Groups, their rings and their rows; smaller groups until they fit into fast memory."""
        system, order = self.system, self.order
        matrix = sp.csr_matrix(sp.diags_array(system.free.astype(float)) @ system.matrix)
        matrix.setdiag(0.0)
        matrix.eliminate_zeros()
        fits = capacity_on_cuda(self.real) if self.device.is_cuda else None
        size = group or (BLOCK if self.device.is_cuda else CPU_GROUP)
        while True:
            label = partition.groups(system.matrix, system.free, size)
            starts, vertices, ring = partition.neighbourhoods(matrix, label, order)
            largest = int(np.diff(starts).max(initial=1))
            if fits is None or largest <= fits or size == 1:
                break
            size = max(1, size // 2)
        self.capacity = fits if fits is not None else max(1024, 1 << (largest - 1).bit_length())
        self.groups = len(starts) - 1
        owner = np.repeat(np.arange(self.groups), np.diff(starts))
        updated = np.zeros((self.groups, order), dtype=np.int32)
        for t in range(order):
            updated[:, t] = np.bincount(owner[ring <= order - 1 - t], minlength=self.groups)
        row = ring < order  # the rows each group needs, with columns numbered within the group
        lengths = np.diff(matrix.indptr)[vertices[row]]
        shift = np.repeat(matrix.indptr[vertices[row]] - (np.cumsum(lengths) - lengths), lengths)
        entries = shift + np.arange(lengths.sum())
        key = owner.astype(np.int64) * system.count + vertices
        sorted_key = np.argsort(key)
        wanted = np.repeat(owner[row], lengths).astype(np.int64) * system.count + matrix.indices[entries]
        position = sorted_key[np.searchsorted(key[sorted_key], wanted)]
        columns = position - starts[np.repeat(owner[row], lengths)]
        row_starts = np.concatenate([[0], np.cumsum(np.bincount(owner[row], minlength=self.groups))])
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        self.extra_work = float(row.sum() / max(1, (ring == 0).sum()))

        def integers(values: np.ndarray) -> wp.array:
            return wp.array(np.resize(values, max(1, values.size)).astype(np.int32), device=self.device.warp)

        data = np.resize(matrix.data[entries], max(1, len(entries))).astype(self.real.numpy)
        self._group_arrays = [integers(starts), integers(vertices), integers(updated.ravel()), integers(row_starts)]
        self._group_arrays += [integers(offsets), integers(columns), wp.array(data, device=self.device.warp)]
        self._group_partial = self.zeros(self.real.scalar, max(1, self.groups))

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        reference: wp.array | None = None,
        prepared: bool = False,
    ) -> None:
        if contact is not None and contact.apply is not None:
            super().solve(x, b, contact, reference, prepared)
            return
        if not prepared:
            self.prepare(contact)
        for buffer in (self._x, self._before, self._x2, self._before2):
            self.copy(buffer, x)
        status = [self.first, self.left, self.iterations, self.residual, self.condition]
        self.sweep(self._x, self._before, -1, b)
        self.sums.conclude(self._kernels.begin, [self.partial, self.sums.slots, reference, *self.limits, *status])
        diagonal = [self.total, self.inverse, self.inverse_block]

        def run(step: int, source: tuple[wp.array, wp.array], target: tuple[wp.array, wp.array]) -> None:
            inputs = [*self._group_arrays, *diagonal, b, *self.weights, step, self.order]
            inputs += [*source, *target, self._group_partial]
            self.sums.launch_groups(self._grouped.sweeps, self.groups, inputs)

        def iterate() -> None:
            run(0, (self._x, self._before), (self._x2, self._before2))
            run(self.order, (self._x2, self._before2), (self._x, self._before))
            self.sums.conclude(self._kernels.check, [self._group_partial, self.groups, self.chunk, 2, *self.limits, *status])

        self.device.loop(self.condition, iterate)
        self.copy(x, self._x)


def capacity_on_cuda(real: Real) -> int:
    """Vertices whose last two positions fit into a block's fast memory."""
    return SHARED_BYTES // (6 * real.numpy.itemsize) - 1


@functools.cache
def group_kernels(real: Real, capacity: int) -> SimpleNamespace:
    """The kernel for groups that need memory for up to `capacity` vertices."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(f"{__name__}.{capacity}")
    f = shared.functions(real)

    @language.func_native(_SWEEPS.replace("SCALAR", f"wp::{real.name}").replace("CAPACITY", str(capacity)))
    def group_sweeps(
        group: int,
        lane: int,
        lanes: int,
        starts: wp.array(dtype=wp.int32),
        vertices: wp.array(dtype=wp.int32),
        updated: wp.array(dtype=wp.int32),
        row_starts: wp.array(dtype=wp.int32),
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        diagonal: wp.array(dtype=scalar),
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        b: wp.array(dtype=vec3),
        weight: scalar,
        factors: wp.array(dtype=scalar),
        done: int,
        order: int,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        x_out: wp.array(dtype=vec3),
        before_out: wp.array(dtype=vec3),
    ) -> scalar: ...

    @kernel(module)
    def sweeps(
        first: int,
        starts: wp.array(dtype=wp.int32),
        vertices: wp.array(dtype=wp.int32),
        updated: wp.array(dtype=wp.int32),
        row_starts: wp.array(dtype=wp.int32),
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        diagonal: wp.array(dtype=scalar),
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        b: wp.array(dtype=vec3),
        weight: scalar,
        factors: wp.array(dtype=scalar),
        left: wp.array(dtype=wp.int32),
        max_iterations: int,
        step: int,
        order: int,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        x_out: wp.array(dtype=vec3),
        before_out: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """`order` sweeps for the vertices of each group, and the residual before the first of them."""
        worker = first + wp.tid()
        group = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        gamma = group_sweeps(
            group,
            lane,
            wp.block_dim(),
            starts,
            vertices,
            updated,
            row_starts,
            offsets,
            columns,
            values,
            diagonal,
            inverse,
            inverse_block,
            b,
            weight,
            factors,
            max_iterations - left[0] + step,
            order,
            x,
            before,
            x_out,
            before_out,
        )
        f.store_sum(gamma, worker, partial_out)

    return SimpleNamespace(**locals())
