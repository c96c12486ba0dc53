"""The rigid modes of `rigid_modes`, with the work cut for a GPU: blocks of threads, and none whose work grows with the mesh.

C is kept whole and dense. A block of threads adds up each of its 6x6 blocks: elastic ones from a list of the matrix' entries that was made
once, those of contacts from the pairs of the vertices of a group, where the pair of groups has any. C^-1 replaces C by block Gauss-Jordan
elimination, one launch a group and one thread a row of six numbers,

    D = C_kk^-1,   C_kk <- D,   C_kh <- D C_kh,   C_gk <- -C_gk D,   C_gh <- C_gh - C_gk D C_kh,

each from one copy of C into the other: nothing depends on the order of threads, and nobody waits. What is solved with C is then a product.
"""

import functools
import itertools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device import blocks
from pdipc.device.language import Kernel, filled, func, kernel, struct_of
from pdipc.device.launch import BLOCK, WIDE_BLOCKS, Device, Span
from pdipc.device.precision import Real
from pdipc.linear import rigid_modes
from pdipc.linear.blocks import BlockMatrix, rows_of
from pdipc.linear.contact_rows import first_entry
from pdipc.linear.rigid_modes import LOST, MODES, RigidModes, layout_of

SHARES = 32  # threads that share a row of C in an elimination: each solves with the pivot, which takes longer than its part of the row


@functools.cache
def cut_of(real: Real) -> Any:
    """A struct: the groups' vertices, cut into chunks, as kernels read them; see `WideModes`."""
    return struct_of(
        "Cut",
        __name__,
        groups=int,
        chunks=int,
        chunk_starts=wp.array(dtype=wp.int32),
        chunk_group=wp.array(dtype=wp.int32),
        members=wp.array(dtype=wp.int32),
        arms=wp.array(dtype=real.vec3),
        solved=wp.array(dtype=wp.float64),
        sums=wp.array(dtype=wp.types.vector(MODES, wp.float64)),
    )


class WideModes(RigidModes):
    """The groups' vertices are cut into chunks, a block of threads each. chunk_starts: (chunks + 1,) into `members`; chunk_group:
    (chunks,); sums: (chunks,) the part of each in Z^T r. solved: (size * size,) C^-1 after `prepare`. near: (groups^2,) whether a pair of
    contact connects two groups. cut: all this as kernels take it, of the type `cut_of`.
    """

    wide = True

    def __init__(self, device: Device, real: Real, matrix: BlockMatrix, free: np.ndarray, group: int | None = None):
        super().__init__(device, real, matrix, free, group)
        starts, label = self.starts.numpy()[: self.groups + 1], self.label.numpy()[: matrix.count]
        total = int(starts[-1]) if self.groups else 0
        share = BLOCK * max(1, -(-total // (BLOCK * WIDE_BLOCKS)))
        cuts = [np.arange(low, high, share) for low, high in itertools.pairwise(starts)]
        begin = np.concatenate([*cuts, starts[-1:]])
        owner = np.repeat(np.arange(self.groups), [len(cut) for cut in cuts])
        self.chunks = len(owner)

        # entries of the matrix between two groups, by pair of groups
        pattern = sp.coo_matrix(matrix.pattern)
        row, column = np.asarray(pattern.row), np.asarray(pattern.col)
        g, h = label[row], label[column]
        across = np.flatnonzero((g > h) & (h >= 0))
        key = g[across].astype(np.int64) * self.groups + h[across]
        order = np.argsort(key, kind="stable")
        # blocks of the pattern are numbered row by row, as those of the matrix
        entries = across[order]
        bounds = np.searchsorted(key[order], np.arange(self.groups**2 + 1))

        def upload(values: np.ndarray) -> wp.array:
            return wp.array(np.append(values, 0).astype(np.int32), dtype=wp.int32, device=device.warp)

        def zeros(dtype, count: int) -> wp.array:
            return wp.zeros(max(1, count), dtype=dtype, device=device.warp)

        size = MODES * self.groups
        self.chunk_starts, self.chunk_group = upload(begin), upload(owner)
        self.sums = zeros(wp.types.vector(MODES, wp.float64), self.chunks)
        self._bounds, self._rows, self._entries = upload(bounds), upload(row[entries]), upload(entries)
        self._other, self._lead = zeros(wp.float64, size * size), zeros(wp.float64, size)
        self.near = zeros(wp.int32, self.groups**2)
        self.solved = self._other if self.groups % 2 else self.c
        self.cut = filled(cut_of(real), self)
        self._wide = kernels(real)

    def prepare(self, x: wp.array, contacts: list) -> None:
        k, device, m, groups = self._wide, self.device, self.matrix, self.groups
        device.launch_blocks(k.center, groups, [self.starts, self.members, x, self.arms])
        between = [self._bounds, self._rows, self._entries]
        device.launch_blocks(k.gather, groups**2, [self.layout, *between, m.rows, self.c, self.near])
        for contact in contacts:
            contact.couple(self)
        device.launch(k.lead, MODES * groups, [MODES * groups, self.c, self._lead])
        here, there = self.c, self._other
        for pivot in range(groups):
            device.launch(k.eliminate, MODES * groups * SHARES, [groups, SHARES, pivot, self._lead, here, there])
            here, there = there, here

    def couple(self, kernel: Kernel, operand: Any, capacity: int) -> None:
        """Launches a kernel of `coupling` over all pairs of groups that pairs in contact connect: those of the operand, at most `capacity`."""
        self.device.launch_list(self._wide.mark, capacity, [operand.count, operand.quads, self.label, self.groups, self.near])
        self.device.launch_blocks(kernel, self.groups**2, [self.layout, self.near, operand, self.c])

    def restrict(self, r: wp.array) -> None:
        """Launches the sums Z^T r, chunk by chunk."""
        inputs = [self.chunk_starts, self.members, self.arms, r, self.sums]
        self.device.launch_blocks(self._wide.restrict, self.chunks, inputs)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    wide, wide33 = wp.float64, wp.mat33d
    shared = rigid_modes.functions(real)
    vec6 = wp.types.vector(MODES, wide)
    of_block, block_sum = blocks.total(wide33), blocks.total(vec6)

    @func
    def part(i: int, j: int, tt: wide33, tr: wide33, rt: wide33, rr: wide33) -> wide:
        """An entry of the 6x6 block."""
        if i < 3:
            if j < 3:
                return tt[i, j]
            return tr[i, j - 3]
        if j < 3:
            return rt[i - 3, j]
        return rr[i - 3, j - 3]

    @func
    def add(
        lane: int,
        groups: int,
        g: int,
        h: int,
        tt: wide33,
        tr: wide33,
        rt: wide33,
        rr: wide33,
        c: wp.array(dtype=wide),
    ):
        """C_gh += the block, and C_hg its transpose, by the first threads of the block that has them alone."""
        size = MODES * groups
        for n in range(lane, MODES * MODES, wp.block_dim()):
            i = n // MODES
            j = n % MODES
            at = (MODES * g + i) * size + MODES * h + j
            value = c[at] + part(i, j, tt, tr, rt, rr)
            c[at] = value
            if g != h:
                c[(MODES * h + j) * size + MODES * g + i] = value

    return SimpleNamespace(
        widened=shared.widened, skew=shared.skew, of_block=of_block, block_sum=block_sum, part=part, add=add, vec6=vec6
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Layout, BlockRows = real.scalar, real.vec3, layout_of(real), rows_of(real)
    wide, wide33 = wp.float64, wp.mat33d
    module = real.module(__name__)
    f = functions(real)
    vec6 = f.vec6
    mat66 = wp.types.matrix((MODES, MODES), wide)
    lost = wp.constant(wide(LOST))
    total_of, total_number = blocks.total(vec3), blocks.total(scalar)
    mode = rigid_modes.functions(real).mode

    @kernel(module)
    def center(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        arms_out: wp.array(dtype=vec3),
    ):
        worker = first + wp.tid()
        g = worker // wp.block_dim()
        begin = starts[g] + worker % wp.block_dim()
        end = starts[g + 1]
        number = scalar(end - starts[g])
        origin = x[members[starts[g]]]
        middle = vec3()
        for k in range(begin, end, wp.block_dim()):
            middle += x[members[k]] - origin
        middle = total_of(middle) / number
        square = scalar(0.0)
        for k in range(begin, end, wp.block_dim()):
            square += wp.length_sq((x[members[k]] - origin) - middle)
        square = total_number(square)
        scale = scalar(1.0)
        if square > scalar(0.0):
            scale = scalar(1.0) / wp.sqrt(square / number)
        for k in range(begin, end, wp.block_dim()):
            arms_out[members[k]] = scale * ((x[members[k]] - origin) - middle)

    @kernel(module)
    def gather(
        first: int,
        o: Layout,
        bounds: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        matrix: BlockRows,
        c: wp.array(dtype=wide),
        near_out: wp.array(dtype=wp.int32),
    ):
        """C_gh = sum over the vertices i of g of Z_i^T (held_i Z_i + sum_j K_ij (Z_j - Z_i)), elastic; see `rigid_modes`."""
        worker = first + wp.tid()
        lane = worker % wp.block_dim()
        g = (worker // wp.block_dim()) // o.groups
        h = (worker // wp.block_dim()) % o.groups
        if h > g:
            return
        tt = wide33()
        tr = wide33()
        rt = wide33()
        rr = wide33()
        if h == g:
            identity = wide33(wp.identity(n=3, dtype=wide))
            for m in range(o.starts[g] + lane, o.starts[g + 1], wp.block_dim()):
                i = o.members[m]
                own = f.skew(o.arms[i])
                mass = wide(matrix.held[i])
                tt += mass * identity
                tr -= mass * own
                rt += mass * own
                rr -= mass * (own * own)
                for e in range(matrix.offsets[i], matrix.offsets[i + 1]):
                    j = matrix.columns[e]
                    k = f.widened(matrix.values[e])
                    if o.label[j] == g:
                        # translations cancel, rotations leave the difference of the arms
                        turned = k * (own - f.skew(o.arms[j]))
                        tr += turned
                        rr += own * turned
                    else:
                        turned = k * own
                        tt -= k
                        tr += turned
                        rt -= own * k
                        rr += own * turned
        else:
            pair = g * o.groups + h
            for n in range(bounds[pair] + lane, bounds[pair + 1], wp.block_dim()):
                i = rows[n]
                j = matrix.columns[entries[n]]
                k = f.widened(matrix.values[entries[n]])
                own = f.skew(o.arms[i])
                far = f.skew(o.arms[j])
                tt += k
                tr -= k * far
                rt += own * k
                rr -= own * (k * far)
        if h == g or bounds[g * o.groups + h + 1] > bounds[g * o.groups + h]:
            tt = f.of_block(tt)
            tr = f.of_block(tr)
            rt = f.of_block(rt)
            rr = f.of_block(rr)
        size = MODES * o.groups
        for n in range(lane, MODES * MODES, wp.block_dim()):
            i = n // MODES
            j = n % MODES
            value = f.part(i, j, tt, tr, rt, rr)
            c[(MODES * g + i) * size + MODES * h + j] = value
            if g != h:
                c[(MODES * h + j) * size + MODES * g + i] = value
        if lane == 0:
            near_out[g * o.groups + h] = 0

    @kernel(module)
    def mark(
        span: Span,
        count: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.vec4i),
        label: wp.array(dtype=wp.int32),
        groups: int,
        near_out: wp.array(dtype=wp.int32),
    ):
        """near = 1 for the groups of every pair; whoever writes, writes the same."""
        worker = span.first + wp.tid()
        for begin in range(worker * span.block, count[0], span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, count[0])):
                for s in range(4):
                    g = label[quads[k][s]]
                    for t in range(4):
                        h = label[quads[k][t]]
                        if h >= 0 and g >= h:
                            near_out[g * groups + h] = 1

    @kernel(module)
    def lead(first: int, size: int, c: wp.array(dtype=wide), lead_out: wp.array(dtype=wide)):
        """The diagonal, to tell what a pivot was before rounding took it."""
        i = first + wp.tid()
        lead_out[i] = c[i * size + i]

    @func
    def solve_pivot(pivot: int, size: int, leading: wp.array(dtype=wide), c: wp.array(dtype=wide), a: vec6) -> vec6:
        """C_kk^-1 a by L D L^T; a pivot that rounding has lost is infinite."""
        lower = mat66()
        d = vec6()
        inverse = vec6()
        at = MODES * pivot
        for j in range(MODES):
            own = c[(at + j) * size + at + j]
            for m in range(j):
                own -= lower[j, m] * lower[j, m] * d[m]
            if own > lost * leading[at + j]:
                d[j] = own
                inverse[j] = wide(1.0) / own
            for i in range(j + 1, MODES):
                below = c[(at + i) * size + at + j]
                for m in range(j):
                    below -= lower[i, m] * lower[j, m] * d[m]
                lower[i, j] = below * inverse[j]
        w = vec6()
        for i in range(MODES):
            own = a[i]
            for m in range(i):
                own -= lower[i, m] * w[m]
            w[i] = own
        w = wp.cw_mul(w, inverse)
        for back in range(MODES):
            i = MODES - 1 - back
            own = w[i]
            for m in range(i + 1, MODES):
                own -= lower[m, i] * w[m]
            w[i] = own
        return w

    @kernel(module)
    def eliminate(
        first: int,
        groups: int,
        shares: int,
        pivot: int,
        leading: wp.array(dtype=wide),
        c: wp.array(dtype=wide),
        c_out: wp.array(dtype=wide),
    ):
        """One step of block Gauss-Jordan: row i of every so many-th block of columns, from the thread's on."""
        worker = first + wp.tid()
        i = worker // shares
        size = MODES * groups
        inside = i // MODES == pivot
        a = vec6()
        for k in range(MODES):
            if inside:
                a[k] = wp.where(i % MODES == k, wide(1.0), wide(0.0))
            else:
                a[k] = c[i * size + MODES * pivot + k]
        w = solve_pivot(pivot, size, leading, c, a)
        for h in range(worker % shares, groups, shares):
            for j in range(MODES):
                at = i * size + MODES * h + j
                if h == pivot:
                    c_out[at] = wp.where(inside, w[j], -w[j])
                else:
                    total = wide(0.0)
                    for k in range(MODES):
                        total += w[k] * c[(MODES * pivot + k) * size + MODES * h + j]
                    c_out[at] = wp.where(inside, total, c[at] - total)

    @kernel(module)
    def restrict(
        first: int,
        chunk_starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        arms: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        sums_out: wp.array(dtype=vec6),
    ):
        worker = first + wp.tid()
        chunk = worker // wp.block_dim()
        total = vec6()
        for k in range(chunk_starts[chunk] + worker % wp.block_dim(), chunk_starts[chunk + 1], wp.block_dim()):
            total += mode(arms[members[k]], r[members[k]])
        total = f.block_sum(total)
        if worker % wp.block_dim() == 0:
            sums_out[chunk] = total

    return SimpleNamespace(center=center, gather=gather, mark=mark, lead=lead, eliminate=eliminate, restrict=restrict)


def coupling(real: Real, module: wp.Module, operand: Any, block_of: Callable) -> Kernel:
    """A kernel that adds the Hessians of pairs to C, a block of threads a pair of groups.

    block_of(o, k, s, t): a Warp function, the 3x3 block of pair k between its vertices s and t, in double precision; operand: the type of o,
    which has `quads`, `ends` and `entries` as for `contact_rows.assembly`.
    """
    f, Layout = functions(real), layout_of(real)
    wide, wide33 = wp.float64, wp.mat33d

    @kernel(module)
    def couple_groups(first: int, of: Layout, near: wp.array(dtype=wp.int32), o: operand, c: wp.array(dtype=wide)):
        worker = first + wp.tid()
        lane = worker % wp.block_dim()
        g = (worker // wp.block_dim()) // of.groups
        h = (worker // wp.block_dim()) % of.groups
        if h > g or near[g * of.groups + h] == 0:
            return
        tt = wide33()
        tr = wide33()
        rt = wide33()
        rr = wide33()
        for m in range(of.starts[g] + lane, of.starts[g + 1], wp.block_dim()):
            v = of.members[m]
            for e in range(first_entry(v, o.ends), o.ends[v]):
                k = o.entries[e] // 4
                s = o.entries[e] % 4
                for t in range(4):
                    i = o.quads[k][t]
                    if of.label[i] == h:
                        block = block_of(o, k, s, t)
                        own = f.skew(of.arms[v])
                        turned = block * f.skew(of.arms[i])
                        tt += block
                        tr -= turned
                        rt += own * block
                        rr -= own * turned
        tt = f.of_block(tt)
        tr = f.of_block(tr)
        rt = f.of_block(rt)
        rr = f.of_block(rr)
        f.add(lane, of.groups, g, h, tt, tr, rt, rr, c)

    return couple_groups
