"""A-Jacobi as matrix powers: several sweeps of Chebyshev's iteration in one kernel.

Aggregating coefficients (aggregated.py) needs a diagonal of scalars. Here a group of vertices takes `order` sweeps by itself:
it reads its own vertices and `order` rings of neighbours into fast memory, and each sweep updates one ring less, so that
its own vertices end up exactly where `order` separate sweeps would have brought them. That works with the 3x3 blocks of
contacts too, and reads the matrix from slow memory once for all sweeps, at the price of doing the rings twice.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device import language
from pdipc.device.language import kernel, struct_of
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
    const int group = worker / lanes, lane = worker % lanes, order = rings.order;
    const int base = rings.starts.data[group];
    const int count = rings.starts.data[group + 1] - base;
    const int* vertex = rings.vertices.data + base;
    const int* first_entry = rings.offsets.data + rings.row_starts.data[group];
    const int* column = rings.columns.data;
    const SCALAR* value = rings.values.data;
    for (int k = lane; k < count; k += lanes) {
        for (int c = 0; c < 3; ++c) {
            now[3 * k + c] = x.data[vertex[k]].c[c];
            last[3 * k + c] = before.data[vertex[k]].c[c];
        }
    }
    SYNC;
    const int own = rings.updated.data[group * order + order - 1];
    SCALAR gamma = 0;
    for (int t = 0; t < order; ++t) {
        const int rows = rings.updated.data[group * order + t];
        const SCALAR omega = course.factors.data[done + t];
        for (int k = lane; k < rows; k += lanes) {
            const int v = vertex[k];
            const SCALAR factor = equation.inverse.data[v];
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
            for (int c = 0; c < 3; ++c) { r[c] = equation.b.data[v].c[c] - equation.total.data[v] * now[3 * k + c] - sum[c]; }
            for (int c = 0; c < 3; ++c) {
                u[c] = factor * r[c];
                if (factor < 0) {
                    const auto& m = equation.inverse_block.data[v];
                    u[c] = m.data[c][0] * r[0] + m.data[c][1] * r[1] + m.data[c][2] * r[2];
                }
            }
            if (t == 0 && k < own) { gamma += r[0] * u[0] + r[1] * u[1] + r[2] * u[2]; }
            for (int c = 0; c < 3; ++c) {
                SCALAR& old = last[3 * k + c];
                old += omega * (now[3 * k + c] + course.weight * u[c] - old);
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
        return sum(getattr(self._rings, name).capacity for name in RINGS)

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

        arrays = (starts, vertices, updated.ravel(), row_starts, offsets, columns, matrix.data[entries])
        self._rings = rings(self.real)()
        self._rings.order = order
        for name, values in zip(RINGS, arrays, strict=True):
            values = np.resize(values, max(1, values.size)).astype(self.real.numpy if name == "values" else np.int32)
            setattr(self._rings, name, wp.array(values, device=self.device.warp))
        self._group_partial = self.zeros(self.real.scalar, max(1, self.groups))

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        if contact is not None and contact.apply is not None:
            super().solve(x, b, contact, prepared)
            return
        if not prepared:
            self.prepare(contact)
        for buffer in (self._x, self._before, self._x2, self._before2):
            self.copy(buffer, x)
        equation, status = self.equation(b), self.status
        self.sweep(equation, self._x, self._before, -1)
        self.sums.conclude(self._kernels.begin, [self.partial, self.sums.slots, status])

        def run(step: int, source: tuple[wp.array, wp.array], target: tuple[wp.array, wp.array]) -> None:
            inputs = [self._rings, equation, self.course, step, *source, *target, self._group_partial]
            self.sums.launch_groups(self._grouped.sweeps, self.groups, inputs)

        def iterate() -> None:
            run(0, (self._x, self._before), (self._x2, self._before2))
            run(self.order, (self._x2, self._before2), (self._x, self._before))
            self.sums.conclude(self._kernels.check, [self._group_partial, self.groups, self.chunk, 2, status])

        self.device.loop(self.condition, iterate)
        self.copy(x, self._x)


def capacity_on_cuda(real: Real) -> int:
    """Vertices whose last two positions fit into a block's fast memory."""
    return SHARED_BYTES // (6 * real.numpy.itemsize) - 1


RINGS = ("starts", "vertices", "updated", "row_starts", "offsets", "columns", "values")


@functools.cache
def rings(real: Real) -> Any:
    """A struct: groups of vertices with their rings and their rows, as `MatrixPowers._plan` lays them out."""
    arrays = {name: wp.array(dtype=real.scalar if name == "values" else wp.int32) for name in RINGS}
    return struct_of("Rings", __name__, order=int, **arrays)


@functools.cache
def group_kernels(real: Real, capacity: int) -> SimpleNamespace:
    """The kernel for groups that need memory for up to `capacity` vertices."""
    scalar, vec3 = real.scalar, real.vec3
    Rings, Equation, Course = rings(real), shared.equation(real), jacobi.course(real)
    module = real.module(f"{__name__}.{capacity}")
    f = shared.functions(real)

    @language.func_native(_SWEEPS.replace("SCALAR", f"wp::{real.name}").replace("CAPACITY", str(capacity)))
    def group_sweeps(
        worker: int,
        lanes: int,
        rings: Rings,
        equation: Equation,
        course: Course,
        done: int,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        x_out: wp.array(dtype=vec3),
        before_out: wp.array(dtype=vec3),
    ) -> scalar: ...

    @kernel(module)
    def sweeps(
        first: int,
        rings: Rings,
        equation: Equation,
        course: Course,
        step: int,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        x_out: wp.array(dtype=vec3),
        before_out: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """`order` sweeps for the vertices of each group, and the residual before the first of them."""
        worker = first + wp.tid()
        done = course.max_iterations - course.left[0] + step
        gamma = group_sweeps(worker, wp.block_dim(), rings, equation, course, done, x, before, x_out, before_out)
        f.store_sum(gamma, worker, partial_out)

    return SimpleNamespace(sweeps=sweeps)
