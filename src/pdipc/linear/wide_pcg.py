"""Conjugate gradients of `block_pcg` in three launches an iteration, for a GPU.

The numbers of an iteration are sums over all vertices, and a launch is where threads wait for each other. So there are as many as there
are dependences,

    multiply    w = K u without contacts (other couplings have launches of their own before, and have put their parts into w), what each pair of contacts feels under u, delta = u . K u
    advance     gamma, delta -> beta, alpha; contacts' part of w; p, s, x, r one step on; Z^T r by chunks of vertices
    correct     u = D^-1 r + Z C^-1 Z^T r, gamma = r . u

and sums are finished where they are needed, by every block anew. What decides about an iteration is kept twice, and read from the one
copy while it is written to the other. That an iteration was the last shows in the next `advance`: one `multiply` is in vain.
"""

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from pdipc.device import blocks
from pdipc.device.language import kernel
from pdipc.device.launch import BLOCK, WIDE_BLOCKS, Device
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear import rigid_modes
from pdipc.linear.block_pcg import BlockPcg, Coupling
from pdipc.linear.blocks import BlockMatrix
from pdipc.linear.contact_rows import nothing
from pdipc.linear.wide_modes import WideModes
from pdipc.linear.wide_modes import functions as mode_functions

PAIR_BLOCKS = 264  # blocks of threads that share the pairs of contacts, at most: two on each multiprocessor of an H100
TURN = 4  # iterations in a turn of the loop, which costs as much as some launches; even
ALPHA, GAMMA = 0, 1  # of the iteration before, in `numbers`
GOING, LEFT, STARTED, FLAGS = 0, 1, 2, 3  # whether to go on, iterations that are left, whether one was made


class Operator(NamedTuple):
    """The Hessian of a kind of contact as Warp functions, for kernels that do more than its product.

    Operand: the struct of arrays that they work on; a `Coupling` makes one by `operand()`, which has `count`, (1,) int32, at most the
    `capacity` of the coupling.
    feel(o, k, p): what pair k feels under the motion p, kept in the operand; returns p . (Hessian) p, J.
    exert(o, v): the force that vertex v then gets, N.
    """

    Operand: Any
    feel: Any
    exert: Any


class WidePcg(BlockPcg):
    """As `BlockPcg`. operators: of the two kinds of contacts that there may be, in the order of `contacts` in a solve."""

    modes: WideModes

    def __init__(
        self,
        device: Device,
        real: Real,
        matrix: BlockMatrix,
        free: np.ndarray,
        tolerance: float,
        most: int,
        operators: tuple[Operator, Operator],
    ):
        super().__init__(device, real, matrix, free, tolerance, most)
        self._operators, self._wide = operators, kernels(real, *operators)
        vertices = int(free.sum())
        self._row_blocks = min(WIDE_BLOCKS, max(1, -(-vertices // BLOCK)))
        self._vertices = vertices

        def zeros(dtype, count: int) -> wp.array:
            return wp.zeros(max(1, count), dtype=dtype, device=device.warp)

        modes = self.modes
        self._gamma, self._delta = zeros(real.scalar, modes.chunks), zeros(real.scalar, self._row_blocks + PAIR_BLOCKS)
        self._pair, self._flags = zeros(real.scalar, 4), zeros(wp.int32, 2 * FLAGS)

    def make_modes(self, free: np.ndarray) -> WideModes:
        return WideModes(self.device, self.real, self.matrix, free)

    def solve(
        self,
        p: wp.array,
        b: wp.array,
        couplings: list[Coupling],
        tolerated: float,
        loose: wp.array,
        tolerance: float | None = None,
    ) -> None:
        k, wide, device, m, modes = self._kernels, self._wide, self.device, self.matrix, self.modes
        rows = [m.offsets, m.columns, m.values, m.held]
        tolerance = self.real.scalar(tolerance or self.tolerance)
        if not modes.chunks:
            return
        solved = [modes.groups, modes.chunks, modes.chunk_starts, modes.chunk_group, modes.members, modes.arms, modes.solved]
        correction = [*solved, modes.sums, self._inverse, self._r, self._u, self._gamma]
        status = [self._first, self._left, self.iterations, self._residual, self._going]
        limits = [loose, tolerance, self.most]
        numbers = [self._gamma, modes.chunks, self._numbers, self.real.scalar(tolerated)]

        def begin(again: int) -> None:
            self._find_residual(p, b, couplings, [nothing(self.real)] * 2)
            modes.restrict(self._r)
            device.launch_blocks(wide.correct, modes.chunks, [self._flags, -1, *correction])
            device.launch_blocks(k.begin, 1, [*numbers, again, *limits, *status, self.indefinite])

        def begin_again() -> None:
            self._move_rigidly(p)
            begin(again=1)

        begin(again=0)
        device.when(loose, begin_again)
        device.launch(wide.begin, 1, [self._going, self._left, self._flags])

        operands = [o for c in couplings if (o := c.operand()) is not None]
        others = [c for c in couplings if c.operand() is None]
        kinds, beside = len(operands), int(len(others) > 0)
        operands += [o.Operand() for o in self._operators[kinds:]]
        room = max((c.capacity for c in couplings if c.operand() is not None), default=0)
        pair_blocks = min(PAIR_BLOCKS, -(-room // BLOCK))
        slots = self._row_blocks + pair_blocks
        product = [modes.members, self._vertices, self._row_blocks, pair_blocks, *rows, self._u, kinds, *operands, beside]
        vectors = [self._w, self._u, self._p, self._s, p, self._r]
        chunks = [modes.chunk_starts, modes.members, modes.arms]
        sums = [self._gamma, modes.chunks, self._delta, slots]
        told = [tolerance, self._first, self.iterations, self._residual, self.indefinite, self._going]

        def iterate() -> None:
            for turn in range(TURN):
                old, new = turn % 2, 1 - turn % 2
                for c in others:
                    c.apply(self._u, self._w)
                device.launch_blocks(wide.multiply, slots, [self._flags, old, *product, self._w, self._delta])
                state = [self._flags, self._pair, old, new]
                both = [kinds, *operands, beside]
                device.launch_blocks(wide.advance, modes.chunks, [*state, *sums, *told, *chunks, *both, *vectors, modes.sums])
                device.launch_blocks(wide.correct, modes.chunks, [self._flags, new, *correction])

        device.loop(self._going, iterate)


@functools.cache
def kernels(real: Real, first_kind: Operator, second_kind: Operator) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    wide = wp.float64
    module = real.module(__name__)
    f, of_modes = shared.functions(real), mode_functions(real)
    mode, vec6, block_sum = rigid_modes.functions(real).mode, of_modes.vec6, of_modes.block_sum
    modes, block_total = rigid_modes.MODES, blocks.total(scalar)
    First, Second = first_kind.Operand, second_kind.Operand
    feel_first, feel_second = first_kind.feel, second_kind.feel
    exert_first, exert_second = first_kind.exert, second_kind.exert
    from pdipc.linear import block_pcg

    row_product = block_pcg.kernels(real).product

    @kernel(module)
    def begin(first: int, going: wp.array(dtype=wp.int32), left: wp.array(dtype=wp.int32), flags_out: wp.array(dtype=wp.int32)):
        flags_out[GOING] = going[0]
        flags_out[LEFT] = left[0]
        flags_out[STARTED] = 0

    @kernel(module)
    def multiply(
        first: int,
        flags: wp.array(dtype=wp.int32),
        turn: int,
        members: wp.array(dtype=wp.int32),
        vertices: int,
        row_blocks: int,
        pair_blocks: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=mat33),
        held: wp.array(dtype=scalar),
        u: wp.array(dtype=vec3),
        kinds: int,
        a: First,
        b: Second,
        beside: int,
        w: wp.array(dtype=vec3),
        delta_out: wp.array(dtype=scalar),
    ):
        """Some blocks of threads have rows of the matrix, the others have pairs."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        if flags[FLAGS * turn + GOING] == 0:
            return
        delta = scalar(0.0)
        if block < row_blocks:
            for m in range(worker, vertices, row_blocks * wp.block_dim()):
                i = members[m]
                product = row_product(i, offsets, columns, values, held, u)
                if beside != 0:
                    product += w[i]
                w[i] = product
                delta += wp.dot(u[i], product)
        else:
            begin = worker - row_blocks * wp.block_dim()
            step = pair_blocks * wp.block_dim()
            if kinds > 0:
                for k in range(begin, a.count[0], step):
                    delta += feel_first(a, k, u)
            if kinds > 1:
                for k in range(begin, b.count[0], step):
                    delta += feel_second(b, k, u)
        delta = block_total(delta)
        if worker % wp.block_dim() == 0:
            delta_out[block] = delta

    # Long: all vectors in one launch an iteration, which is what this solver is for.
    @kernel(module)
    def advance(
        first: int,
        flags: wp.array(dtype=wp.int32),
        numbers: wp.array(dtype=scalar),
        now: int,
        later: int,
        partial_gamma: wp.array(dtype=scalar),
        chunks: int,
        partial_delta: wp.array(dtype=scalar),
        slots: int,
        tolerance: scalar,
        first_norm: wp.array(dtype=scalar),
        iterations: wp.array(dtype=wp.int32),
        residual_out: wp.array(dtype=scalar),
        indefinite_out: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
        chunk_starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        arms: wp.array(dtype=vec3),
        kinds: int,
        a: First,
        b: Second,
        beside: int,
        w: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        s: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        sums_out: wp.array(dtype=vec6),
    ):
        worker = first + wp.tid()
        lane = worker % wp.block_dim()
        chunk = worker // wp.block_dim()
        tells = worker == 0
        going = flags[FLAGS * now + GOING]
        left = flags[FLAGS * now + LEFT]
        started = flags[FLAGS * now + STARTED]
        if going == 0:
            if tells:
                flags[FLAGS * later + GOING] = 0
            return
        gamma = f.sum_partials(partial_gamma, chunks, lane)
        delta = f.sum_partials(partial_delta, slots, lane)
        beta = scalar(0.0)
        curvature = delta
        if started != 0:
            # gamma is what the iteration before has left
            beta = gamma / numbers[2 * now + GAMMA]
            curvature = delta - beta * gamma / numbers[2 * now + ALPHA]
            left -= 1
            residual = wp.sqrt(gamma) / first_norm[0]
            if tells:
                residual_out[0] = residual
                iterations[0] = iterations[0] + 1
            if not (residual > tolerance) or left <= 0:
                going = 0
        alpha = gamma / curvature
        if gamma < scalar(0.0):
            # nor with a preconditioner that has one
            going = 0
            if tells:
                indefinite_out[0] = 1
        bent = int(0)
        if going != 0 and not (curvature > scalar(0.0) or wp.isnan(curvature)):
            # no step along a direction of negative curvature; but it is told
            going = 0
            bent = 1
            if tells:
                indefinite_out[0] = 1
                iterations[0] = iterations[0] + 1
        if tells:
            flags[FLAGS * later + GOING] = going
            flags[FLAGS * later + LEFT] = left
            flags[FLAGS * later + STARTED] = 1
            numbers[2 * later + ALPHA] = alpha
            numbers[2 * later + GAMMA] = gamma
            going_out[0] = going
        if bent != 0:
            for m in range(chunk_starts[chunk] + lane, chunk_starts[chunk + 1], wp.block_dim()):
                i = members[m]
                p[i] = u[i] + beta * p[i]
        if going == 0:
            return
        total = vec6()
        for m in range(chunk_starts[chunk] + lane, chunk_starts[chunk + 1], wp.block_dim()):
            i = members[m]
            whole = w[i]
            if beside != 0:
                w[i] = vec3()
            if kinds > 0:
                whole += exert_first(a, i)
            if kinds > 1:
                whole += exert_second(b, i)
            direction = u[i] + beta * p[i]
            image = whole + beta * s[i]
            p[i] = direction
            s[i] = image
            x[i] = x[i] + alpha * direction
            residual_of = r[i] - alpha * image
            r[i] = residual_of
            total += mode(arms[i], residual_of)
        total = block_sum(total)
        if lane == 0:
            sums_out[chunk] = total

    @kernel(module)
    def correct(
        first: int,
        flags: wp.array(dtype=wp.int32),
        turn: int,
        groups: int,
        chunks: int,
        chunk_starts: wp.array(dtype=wp.int32),
        chunk_group: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        arms: wp.array(dtype=vec3),
        solved: wp.array(dtype=wide),
        sums: wp.array(dtype=vec6),
        inverse: wp.array(dtype=mat33),
        r: wp.array(dtype=vec3),
        u_out: wp.array(dtype=vec3),
        gamma_out: wp.array(dtype=scalar),
    ):
        """turn: which flags say whether to; -1 for always."""
        worker = first + wp.tid()
        lane = worker % wp.block_dim()
        chunk = worker // wp.block_dim()
        if turn >= 0 and flags[FLAGS * wp.max(turn, 0) + GOING] == 0:
            return
        g = chunk_group[chunk]
        size = modes * groups
        z = vec6()
        for n in range(lane, modes * chunks, wp.block_dim()):
            part = sums[n // modes][n % modes]
            column = modes * chunk_group[n // modes] + n % modes
            for i in range(modes):
                z[i] = z[i] + solved[(modes * g + i) * size + column] * part
        z = block_sum(z)
        shift = vec3(scalar(z[0]), scalar(z[1]), scalar(z[2]))
        turned = vec3(scalar(z[3]), scalar(z[4]), scalar(z[5]))
        gamma = scalar(0.0)
        for m in range(chunk_starts[chunk] + lane, chunk_starts[chunk + 1], wp.block_dim()):
            i = members[m]
            residual = r[i]
            corrected = inverse[i] * residual + shift + wp.cross(turned, arms[i])
            u_out[i] = corrected
            gamma += wp.dot(residual, corrected)
        gamma = block_total(gamma)
        if lane == 0:
            gamma_out[chunk] = gamma

    return SimpleNamespace(begin=begin, multiply=multiply, advance=advance, correct=correct)
