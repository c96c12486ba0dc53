"""Contacts as rows of 3x3 blocks: assembled anew for each solve, so that a product reads each block once, where pair by pair it would
read what every pair is made of, twice.

The block between two vertices is the sum of those of the pairs that have both, in the order of the pairs. As in `blocks`, only those off
the diagonal are kept and a product takes differences: the Hessian of a pair does not feel a motion of all its vertices together.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.device.language import Kernel, func, kernel, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real

PARTNERS = 3  # of a vertex in a pair


@func
def first_entry(v: int, ends: wp.array(dtype=wp.int32)) -> int:
    """Where the list of vertex v begins."""
    low = int(0)
    if v > 0:
        low = ends[v - 1]
    return low


class ContactRows:
    """The blocks of a list of at most `capacity` pairs on n vertices. `kernels(real).Rows` is what a product works on."""

    def __init__(self, device: Device, real: Real, n: int, capacity: int):
        places = PARTNERS * 4 * capacity
        self.device, self.real = device, real
        self.lengths = wp.zeros(n, dtype=wp.int32, device=device.warp)
        self.columns = wp.zeros(places, dtype=wp.int32, device=device.warp)
        self.values = wp.zeros(places, dtype=real.mat33, device=device.warp)

    def assemble(self, count: int, kernel: Kernel, operand: Any, free: wp.array, ends: wp.array, entries: wp.array) -> Any:
        """Launches the blocks of the first `count` vertices, and returns what a product works on. kernel: of `assembly`, for `operand`; free: (n,) scalar, zero
        where nothing is unknown; ends: (n,) int32, where the list of each vertex's pairs ends; entries: these lists, four times a pair plus a vertex's place in it.
        """
        self.device.launch(kernel, count, [operand, free, entries, self.lengths, self.columns, self.values], grain=16)
        rows = kernels(self.real).Rows()
        rows.used, rows.ends = 1, ends
        rows.lengths, rows.columns, rows.values = self.lengths, self.columns, self.values
        return rows


def nothing(real: Real) -> Any:
    """No rows at all."""
    rows = kernels(real).Rows()
    rows.used = 0
    return rows


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    vec3, mat33 = real.vec3, real.mat33

    Rows = struct_of(
        "Rows",
        __name__,
        used=int,
        ends=wp.array(dtype=wp.int32),
        lengths=wp.array(dtype=wp.int32),
        columns=wp.array(dtype=wp.int32),
        values=wp.array(dtype=mat33),
    )

    @func
    def product(i: int, rows: Rows, p: wp.array(dtype=vec3)) -> vec3:
        """Row i of (contact Hessian) p."""
        total = vec3()
        if rows.used != 0:
            own = p[i]
            low = PARTNERS * first_entry(i, rows.ends)
            for e in range(low, low + rows.lengths[i]):
                total += rows.values[e] * (p[rows.columns[e]] - own)
        return total

    return SimpleNamespace(Rows=Rows, product=product)


def assembly(real: Real, module: wp.Module, operand: Any, block_of: Any) -> Kernel:
    """The kernel that fills the rows. block_of(o, k, s, t): the block of pair k between its vertices s and t; operand: the type of o, which
    has `quads`, and `ends` as above.
    """
    scalar, mat33 = real.scalar, real.mat33

    @kernel(module)
    def assemble(
        first: int,
        o: operand,
        free: wp.array(dtype=scalar),
        entries: wp.array(dtype=wp.int32),
        lengths_out: wp.array(dtype=wp.int32),
        columns_out: wp.array(dtype=wp.int32),
        values_out: wp.array(dtype=mat33),
    ):
        v = first + wp.tid()
        low = first_entry(v, o.ends)
        at = PARTNERS * low
        length = int(0)
        if free[v] > scalar(0.0):
            for i in range(low, o.ends[v]):
                k = entries[i] // 4
                s = entries[i] % 4
                for t in range(4):
                    j = o.quads[k][t]
                    if j != v:
                        slot = int(length)
                        for e in range(length):
                            if columns_out[at + e] == j:
                                slot = int(e)
                        if slot == length:
                            columns_out[at + slot] = j
                            values_out[at + slot] = block_of(o, k, s, t)
                            length = length + 1
                        else:
                            values_out[at + slot] = values_out[at + slot] + block_of(o, k, s, t)
        lengths_out[v] = length

    return assemble
