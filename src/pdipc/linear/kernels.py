"""Kernels shared by the solvers: the matrix product, the preconditioner, sums.

A worker handles BLOCK consecutive vertices, and its share of a sum goes to one slot: sums do not depend on how many threads
there are.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.precision import Real

BLOCK = 256  # vertices that one worker handles


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """Warp functions on one vertex."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33

    @wp.func
    def row_product(
        i: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
    ):
        """Off-diagonal part of (A x)_i."""
        total = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        for e in range(offsets[i], offsets[i + 1]):
            total += values[e] * x[columns[e]]
        return total

    @wp.func
    def precondition(i: int, inverse: wp.array(dtype=scalar), inverse_block: wp.array(dtype=mat33), r: vec3):
        """D_i^-1 r; a negative `inverse` says that D_i is a full 3x3 block."""
        factor = inverse[i]
        if factor < scalar(0.0):
            return inverse_block[i] * r
        return factor * r

    @wp.func
    def sum_partials(partial: wp.array(dtype=scalar), count: int):
        """Sum of `count` numbers, in four interleaved parts because an addition has to wait for the one before."""
        a, b, c, d = scalar(0.0), scalar(0.0), scalar(0.0), scalar(0.0)
        quarter = count // 4
        for k in range(quarter):
            a += partial[4 * k]
            b += partial[4 * k + 1]
            c += partial[4 * k + 2]
            d += partial[4 * k + 3]
        for k in range(4 * quarter, count):
            a += partial[k]
        return (a + b) + (c + d)

    return SimpleNamespace(**locals())


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The preconditioner's kernels."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)

    @wp.kernel(module=module)
    def clear(first: int, values_out: wp.array(dtype=vec3)):
        values_out[first + wp.tid()] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    @wp.kernel(module=module)
    def invert_diagonal(
        first: int,
        diagonal: wp.array(dtype=scalar),
        contact_scalar: wp.array(dtype=scalar),
        contact_block: wp.array(dtype=mat33),
        total_out: wp.array(dtype=scalar),
        inverse_out: wp.array(dtype=scalar),
        inverse_block_out: wp.array(dtype=mat33),
    ):
        """total = A_ii + scalar contact part, inverse = its inverse, or -1 and the inverse of the 3x3 block. 0 where not free."""
        i = first + wp.tid()
        d = diagonal[i]
        total = d
        inverse = scalar(0.0)
        if d > scalar(0.0):
            if contact_scalar:
                total = d + contact_scalar[i]
            inverse = scalar(1.0) / total
            if contact_block:
                block = contact_block[i]
                if wp.trace(block) > scalar(0.0):
                    inverse = scalar(-1.0)
                    for k in range(3):
                        block[k, k] += total
                    inverse_block_out[i] = wp.inverse(block)
        total_out[i] = total
        inverse_out[i] = inverse

    return SimpleNamespace(**locals())
