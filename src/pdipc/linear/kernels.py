"""What the solvers' kernels share: preconditioner, sums, copies.

A kernel that also adds something up starts with

    worker = first + wp.tid()
    for i in range(worker * share, wp.min((worker + 1) * share, count)):

and ends with `store_sum`. On the CPU a worker has a share of BLOCK vertices and one slot of `partial`; on CUDA each thread
has one vertex and each block of BLOCK threads one slot. So sums do not depend on the number of threads.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.device import blocks, language
from pdipc.device.language import Kernel, func, kernel, struct_of
from pdipc.device.launch import BLOCK, Device
from pdipc.device.precision import Real
from pdipc.linear import rows

HIDDEN = 16.0  # unit roundoffs of the trace of a 3x3 block: what its rounding errors may hide, and more

# Four sums side by side, because an addition has to wait for the one before.
_SUM_SLOTS = """
    SCALAR a = 0, b = 0, c = 0, d = 0;
    int k = lane;
    for (; k + 3 * step < count; k += 4 * step) {
        a += partial.data[k]; b += partial.data[k + step]; c += partial.data[k + 2 * step]; d += partial.data[k + 3 * step];
    }
    for (; k < count; k += step) { a += partial.data[k]; }
    return (a + b) + (c + d);
"""


class Sums:
    """Launches kernels that add up over the vertices, and the single-block kernels that use the sums.

    slots: number of partial sums.
    """

    def __init__(self, device: Device, count: int):
        self.device, self.count = device, count
        self.slots = max(1, -(-count // BLOCK))

    def launch(self, kernel: Kernel, inputs: list[Any]) -> None:
        """Runs `kernel(first, share, count, *inputs)` over all vertices."""
        self.device.launch_blocks(kernel, self.slots, [1 if self.device.wide else BLOCK, self.count, *inputs])

    def launch_groups(self, kernel: Kernel, groups: int, inputs: list[Any], grain: int = BLOCK) -> None:
        """Runs `kernel(first, *inputs)` with one thread for each group of vertices on the CPU, one block of threads on CUDA."""
        self.device.launch_blocks(kernel, groups, inputs, grain)

    def conclude(self, kernel: Kernel, inputs: list[Any]) -> None:
        """Runs `kernel(first, *inputs)` in one thread on the CPU and in one block of threads on CUDA."""
        if self.device.wide:
            self.device.launch_blocks(kernel, 1, inputs)
        else:
            self.device.launch_serial(kernel, inputs)


@functools.cache
def equation(real: Real) -> Any:
    """A struct: K x = b, without the part of K that couples the vertices of contacts.

    (K x)_i = held_i x_i + sum_j A_ij (x_j - x_i). A negative `inverse` says that `inverse_block` has it, 0 that the vertex is not free.
    """
    return struct_of(
        "Equation",
        __name__,
        rows=rows.entries(real),  # of A, off the diagonal, kg/s^2
        total=wp.array(dtype=real.scalar),  # A_ii with contacts that are scalars, kg/s^2
        held=wp.array(dtype=real.scalar),  # sum_j A_ij with them
        inverse=wp.array(dtype=real.scalar),  # of the diagonal, s^2/kg
        inverse_block=wp.array(dtype=real.mat33),
        b=wp.array(dtype=real.vec3),  # N
    )


@functools.cache
def status(real: Real) -> Any:
    """A struct: when a solve ends, and how far it has come; see `solver.Solver`."""
    return struct_of(
        "Status",
        __name__,
        tolerance=real.scalar,
        max_iterations=int,
        first=wp.array(dtype=real.scalar),  # (1,) the residual norm that the tolerance refers to
        left=wp.array(dtype=wp.int32),  # (1,) iterations that are left
        iterations=wp.array(dtype=wp.int32),  # (1,) done
        residual=wp.array(dtype=real.scalar),  # (1,) in parts of the first
        condition=wp.array(dtype=wp.int32),  # (1,) whether to go on
    )


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """Warp functions on one vertex, and the two halves of a sum."""
    scalar, vec3, mat33, Equation, Status = real.scalar, real.vec3, real.mat33, equation(real), status(real)
    row_product, row_difference = rows.functions(real).row_product, rows.functions(real).row_difference
    hidden_part = HIDDEN * real.unit_roundoff
    block_total = blocks.total(scalar)

    @func
    def precondition(i: int, k: Equation, r: vec3):
        """D_i^-1 r."""
        factor = k.inverse[i]
        if factor < scalar(0.0):
            return k.inverse_block[i] * r
        return factor * r

    @func
    def invert(a: mat33):
        """a^-1 of a symmetric, positive semidefinite block, by its L D L^T.

        A barrier at a tiny gap is so stiff across it that rounding hides what a is along it, and that the determinant of a
        overflows in float32. What may be hidden is added, so that the inverse is positive definite whatever a is.
        """
        hidden = scalar(hidden_part) * wp.trace(a)
        d0 = a[0, 0] + hidden
        l10 = a[1, 0] / d0
        l20 = a[2, 0] / d0
        d1 = a[1, 1] + hidden - l10 * a[1, 0]
        l21 = (a[2, 1] - l20 * a[1, 0]) / d1
        d2 = a[2, 2] + hidden - l20 * a[2, 0] - l21 * l21 * d1
        # L^-T D^-1 L^-1, whose rows are those of L^-1
        r0 = vec3(scalar(1.0), scalar(0.0), scalar(0.0))
        r1 = vec3(-l10, scalar(1.0), scalar(0.0))
        r2 = vec3(l10 * l21 - l20, -l21, scalar(1.0))
        return wp.outer(r0, r0) / d0 + wp.outer(r1, r1) / d1 + wp.outer(r2, r2) / d2

    @func
    def store_sum(total: scalar, worker: int, partial_out: wp.array(dtype=scalar)):
        """Adds `total` up over the block of threads and stores it in the block's slot."""
        all_of_block = block_total(total)
        if worker % wp.block_dim() == 0:
            partial_out[worker // wp.block_dim()] = all_of_block

    @language.func_native(_SUM_SLOTS.replace("SCALAR", f"wp::{real.name}"))
    def sum_slots(partial: wp.array(dtype=scalar), count: int, lane: int, step: int) -> scalar: ...

    @func
    def sum_partials(partial: wp.array(dtype=scalar), count: int, lane: int):
        """Sum of `count` numbers, by one thread or one block of threads; every thread gets it."""
        return block_total(sum_slots(partial, count, lane, wp.block_dim()))

    @func
    def begin_status(gamma: scalar, status: Status):
        """What a solve notes before its first iteration, gamma = r . D^-1 r."""
        norm = wp.sqrt(gamma)
        status.first[0] = norm
        status.left[0] = status.max_iterations
        residual = scalar(0.0)
        if norm > scalar(0.0):
            residual = scalar(1.0)
        status.condition[0] = wp.where(residual > status.tolerance, 1, 0)
        if not wp.isfinite(gamma):  # one iteration carries it into x, where the step sees it
            residual = gamma
            status.condition[0] = 1
        status.residual[0] = residual

    @func
    def update_status(gamma: scalar, done: int, counted: int, status: Status):
        """What a solve notes after `done` more steps towards its limit, which count as `counted` iterations."""
        residual = wp.sqrt(gamma) / status.first[0]
        status.residual[0] = residual
        status.iterations[0] = status.iterations[0] + counted
        status.left[0] = status.left[0] - done
        status.condition[0] = wp.where(residual > status.tolerance and status.left[0] > 0, 1, 0)

    return SimpleNamespace(
        row_product=row_product,
        row_difference=row_difference,
        precondition=precondition,
        invert=invert,
        store_sum=store_sum,
        sum_partials=sum_partials,
        begin_status=begin_status,
        update_status=update_status,
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """Kernels on single vertices."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    invert = functions(real).invert

    @kernel(module)
    def clear(first: int, values_out: wp.array(dtype=vec3)):
        values_out[first + wp.tid()] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    @kernel(module)
    def copy(first: int, values: wp.array(dtype=vec3), values_out: wp.array(dtype=vec3)):
        i = first + wp.tid()
        values_out[i] = values[i]

    @kernel(module)
    def invert_diagonal(
        first: int,
        diagonal: wp.array(dtype=scalar),
        row_sum: wp.array(dtype=scalar),
        contact_scalar: wp.array(dtype=scalar),
        contact_block: wp.array(dtype=mat33),
        total_out: wp.array(dtype=scalar),
        held_out: wp.array(dtype=scalar),
        inverse_out: wp.array(dtype=scalar),
        inverse_block_out: wp.array(dtype=mat33),
    ):
        """total = A_ii + contact scalar; inverse = 1/total, or -1 with the inverse of the 3x3 block; 0 where not free.

        held = sum_j A_ij + contact scalar: (A x)_i = held x_i + sum_j A_ij (x_j - x_i).
        """
        i = first + wp.tid()
        total = diagonal[i]
        held = row_sum[i]
        inverse = scalar(0.0)
        if total > scalar(0.0):
            if contact_scalar:
                total += contact_scalar[i]
                held += contact_scalar[i]
            inverse = scalar(1.0) / total
            if contact_block:
                block = contact_block[i]
                if wp.trace(block) > scalar(0.0):
                    inverse = scalar(-1.0)
                    for k in range(3):
                        block[k, k] += total
                    inverse_block_out[i] = invert(block)
        total_out[i] = total
        held_out[i] = held
        inverse_out[i] = inverse

    return SimpleNamespace(clear=clear, copy=copy, invert_diagonal=invert_diagonal)
