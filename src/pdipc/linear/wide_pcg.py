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
from pdipc.device.language import kernel, struct_of
from pdipc.device.launch import BLOCK, WIDE_BLOCKS, Device
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear import pcg, rigid_modes
from pdipc.linear.block_pcg import BlockPcg, Coupling
from pdipc.linear.blocks import BlockMatrix, rows_of
from pdipc.linear.contact_rows import nothing
from pdipc.linear.wide_modes import WideModes, cut_of
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
        k, wide, device, modes, status = self._kernels, self._wide, self.device, self.modes, self.status(tolerance)
        if not modes.chunks:
            return
        correction = [modes.cut, self._inverse, self.vectors, self._gamma]
        numbers = [self._gamma, modes.chunks, self._numbers, self.real.scalar(tolerated)]

        def begin(again: int) -> None:
            self._find_residual(p, b, couplings, [nothing(self.real)] * 2)
            modes.restrict(self.r)
            device.launch_blocks(wide.correct, modes.chunks, [self._flags, -1, *correction])
            device.launch_blocks(k.begin, 1, [*numbers, again, loose, status, self.indefinite])

        def begin_again() -> None:
            self._move_rigidly(p)
            begin(again=1)

        begin(again=0)
        device.when(loose, begin_again)
        device.launch(wide.begin, 1, [self.condition, self.left, self._flags])

        coupled = wide.Contacts()
        operands = [o for c in couplings if (o := c.operand()) is not None]
        others = [c for c in couplings if c.operand() is None]
        coupled.kinds, coupled.beside = len(operands), int(len(others) > 0)
        coupled.a, coupled.b = [*operands, *(o.Operand() for o in self._operators[len(operands) :])]
        room = max((c.capacity for c in couplings if c.operand() is not None), default=0)
        share = wide.Share()
        share.members, share.vertices = modes.members, self._vertices
        share.row_blocks, share.pair_blocks = self._row_blocks, min(PAIR_BLOCKS, -(-room // BLOCK))
        slots = share.row_blocks + share.pair_blocks
        state = wide.State()
        state.flags, state.numbers, state.indefinite = self._flags, self._pair, self.indefinite
        state.gamma, state.delta, state.slots = self._gamma, self._delta, slots

        def iterate() -> None:
            for turn in range(TURN):
                old, new = turn % 2, 1 - turn % 2
                for c in others:
                    c.apply(self.u, self.w)
                product = [self._flags, old, share, self.matrix.rows, coupled, self.vectors, self._delta]
                device.launch_blocks(wide.multiply, slots, product)
                inputs = [old, state, status, modes.cut, coupled, self.vectors, p]
                device.launch_blocks(wide.advance, modes.chunks, inputs)
                device.launch_blocks(wide.correct, modes.chunks, [self._flags, new, *correction])

        device.loop(self.condition, iterate)


@functools.cache
def kernels(real: Real, first_kind: Operator, second_kind: Operator) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    BlockRows, Vectors, Status, Cut = rows_of(real), pcg.vectors(real), shared.status(real), cut_of(real)
    f, of_modes = shared.functions(real), mode_functions(real)
    mode, vec6, block_sum = rigid_modes.functions(real).mode, of_modes.vec6, of_modes.block_sum
    modes, block_total = rigid_modes.MODES, blocks.total(scalar)
    First, Second = first_kind.Operand, second_kind.Operand
    feel_first, feel_second = first_kind.feel, second_kind.feel
    exert_first, exert_second = first_kind.exert, second_kind.exert
    from pdipc.linear import block_pcg

    row_product = block_pcg.kernels(real).product

    Contacts = struct_of(
        "Contacts",
        __name__,
        kinds=int,  # of contacts that there are
        beside=int,  # whether other couplings have put their parts into w
        a=First,
        b=Second,
    )
    Share = struct_of(
        "Share",
        __name__,
        members=wp.array(dtype=wp.int32),
        vertices=int,
        row_blocks=int,  # blocks of threads that have rows of the matrix,
        pair_blocks=int,  # and pairs
    )
    State = struct_of(
        "State",
        __name__,
        flags=wp.array(dtype=wp.int32),  # both kept twice
        numbers=wp.array(dtype=scalar),
        gamma=wp.array(dtype=scalar),  # partial sums, of chunks
        delta=wp.array(dtype=scalar),  # and of `slots` blocks
        slots=int,
        indefinite=wp.array(dtype=wp.int32),
    )

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
        share: Share,
        matrix: BlockRows,
        contacts: Contacts,
        v: Vectors,
        delta_out: wp.array(dtype=scalar),
    ):
        """Some blocks of threads have rows of the matrix, the others have pairs."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        if flags[FLAGS * turn + GOING] == 0:
            return
        delta = scalar(0.0)
        if block < share.row_blocks:
            for m in range(worker, share.vertices, share.row_blocks * wp.block_dim()):
                i = share.members[m]
                product = row_product(i, matrix, v.u)
                if contacts.beside != 0:
                    product += v.w[i]
                v.w[i] = product
                delta += wp.dot(v.u[i], product)
        else:
            begin = worker - share.row_blocks * wp.block_dim()
            step = share.pair_blocks * wp.block_dim()
            if contacts.kinds > 0:
                for k in range(begin, contacts.a.count[0], step):
                    delta += feel_first(contacts.a, k, v.u)
            if contacts.kinds > 1:
                for k in range(begin, contacts.b.count[0], step):
                    delta += feel_second(contacts.b, k, v.u)
        delta = block_total(delta)
        if worker % wp.block_dim() == 0:
            delta_out[block] = delta

    # Long: all vectors in one launch an iteration, which is what this solver is for.
    @kernel(module)
    def advance(
        first: int,
        now: int,
        state: State,
        status: Status,
        cut: Cut,
        contacts: Contacts,
        v: Vectors,
        x: wp.array(dtype=vec3),
    ):
        """now: which copy of the flags and numbers is read; the other is written."""
        worker = first + wp.tid()
        lane = worker % wp.block_dim()
        chunk = worker // wp.block_dim()
        later = 1 - now
        tells = worker == 0
        going = state.flags[FLAGS * now + GOING]
        left = state.flags[FLAGS * now + LEFT]
        started = state.flags[FLAGS * now + STARTED]
        if going == 0:
            if tells:
                state.flags[FLAGS * later + GOING] = 0
            return
        gamma = f.sum_partials(state.gamma, cut.chunks, lane)
        delta = f.sum_partials(state.delta, state.slots, lane)
        beta = scalar(0.0)
        curvature = delta
        if started != 0:
            # gamma is what the iteration before has left
            beta = gamma / state.numbers[2 * now + GAMMA]
            curvature = delta - beta * gamma / state.numbers[2 * now + ALPHA]
            left -= 1
            residual = wp.sqrt(gamma) / status.first[0]
            if tells:
                status.residual[0] = residual
                status.iterations[0] = status.iterations[0] + 1
            if not (residual > status.tolerance) or left <= 0:
                going = 0
        alpha = gamma / curvature
        if gamma < scalar(0.0):
            # nor with a preconditioner that has one
            going = 0
            if tells:
                state.indefinite[0] = 1
        bent = int(0)
        if going != 0 and not (curvature > scalar(0.0) or wp.isnan(curvature)):
            # no step along a direction of negative curvature; but it is told
            going = 0
            bent = 1
            if tells:
                state.indefinite[0] = 1
                status.iterations[0] = status.iterations[0] + 1
        if tells:
            state.flags[FLAGS * later + GOING] = going
            state.flags[FLAGS * later + LEFT] = left
            state.flags[FLAGS * later + STARTED] = 1
            state.numbers[2 * later + ALPHA] = alpha
            state.numbers[2 * later + GAMMA] = gamma
            status.condition[0] = going
        if bent != 0:
            for m in range(cut.chunk_starts[chunk] + lane, cut.chunk_starts[chunk + 1], wp.block_dim()):
                i = cut.members[m]
                v.p[i] = v.u[i] + beta * v.p[i]
        if going == 0:
            return
        total = vec6()
        for m in range(cut.chunk_starts[chunk] + lane, cut.chunk_starts[chunk + 1], wp.block_dim()):
            i = cut.members[m]
            whole = v.w[i]
            if contacts.beside != 0:
                v.w[i] = vec3()
            if contacts.kinds > 0:
                whole += exert_first(contacts.a, i)
            if contacts.kinds > 1:
                whole += exert_second(contacts.b, i)
            direction = v.u[i] + beta * v.p[i]
            image = whole + beta * v.s[i]
            v.p[i] = direction
            v.s[i] = image
            x[i] = x[i] + alpha * direction
            residual_of = v.r[i] - alpha * image
            v.r[i] = residual_of
            total += mode(cut.arms[i], residual_of)
        total = block_sum(total)
        if lane == 0:
            cut.sums[chunk] = total

    @kernel(module)
    def correct(
        first: int,
        flags: wp.array(dtype=wp.int32),
        turn: int,
        cut: Cut,
        inverse: wp.array(dtype=mat33),
        v: Vectors,
        gamma_out: wp.array(dtype=scalar),
    ):
        """turn: which flags say whether to; -1 for always."""
        worker = first + wp.tid()
        lane = worker % wp.block_dim()
        chunk = worker // wp.block_dim()
        if turn >= 0 and flags[FLAGS * wp.max(turn, 0) + GOING] == 0:
            return
        g = cut.chunk_group[chunk]
        size = modes * cut.groups
        z = vec6()
        for n in range(lane, modes * cut.chunks, wp.block_dim()):
            part = cut.sums[n // modes][n % modes]
            column = modes * cut.chunk_group[n // modes] + n % modes
            for i in range(modes):
                z[i] = z[i] + cut.solved[(modes * g + i) * size + column] * part
        z = block_sum(z)
        shift = vec3(scalar(z[0]), scalar(z[1]), scalar(z[2]))
        turned = vec3(scalar(z[3]), scalar(z[4]), scalar(z[5]))
        gamma = scalar(0.0)
        for m in range(cut.chunk_starts[chunk] + lane, cut.chunk_starts[chunk + 1], wp.block_dim()):
            i = cut.members[m]
            residual = v.r[i]
            corrected = inverse[i] * residual + shift + wp.cross(turned, cut.arms[i])
            v.u[i] = corrected
            gamma += wp.dot(residual, corrected)
        gamma = block_total(gamma)
        if lane == 0:
            gamma_out[chunk] = gamma

    return SimpleNamespace(
        begin=begin, multiply=multiply, advance=advance, correct=correct, Contacts=Contacts, Share=Share, State=State
    )
