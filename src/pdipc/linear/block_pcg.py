"""Conjugate gradients on the Newton matrix: assembled blocks and contacts, preconditioned by the block diagonal and rigid modes.

The form is that of `pcg` (Chronopoulos and Gear 1989). A solve ends when sqrt(r . M^-1 r), which is about the energy norm of the error, has
fallen to a part of the first one, or to what a tolerated motion of one vertex costs.
"""

import functools
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import warp as wp

from pdipc.device.language import Kernel, filled, func, kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear import pcg
from pdipc.linear.affine import AffineBodies
from pdipc.linear.blocks import BlockMatrix, rows_of
from pdipc.linear.contact_rows import ContactRows, nothing
from pdipc.linear.contact_rows import kernels as row_kernels
from pdipc.linear.rigid_modes import RigidModes

LOOSE = 10.0  # how much less exact a solve is that is far from the end


class Coupling(Protocol):
    """What is added to the matrix beside the blocks of elements: low-rank terms of pairs in contact, or of closed surfaces."""

    diagonal: wp.array | None  # (n,) 3x3 blocks of the diagonal, kg/s^2; None where the preconditioner does without

    rows: ContactRows | None  # where the Hessian is assembled; None where a product is made by `apply`

    capacity: int  # pairs that there is room for; 0 where there is no `operand`

    def assemble(self, count: int) -> Any:
        """Launches the blocks of `rows` of the first `count` vertices, beyond which none is free, as the Hessian is now; returns what a product works on."""
        ...

    def apply(self, p: wp.array, y: wp.array) -> None:
        """Launches y += (contact Hessian) p."""
        ...

    def couple(self, modes: RigidModes) -> None:
        """Launches what the Hessian adds to the matrix of the rigid modes."""
        ...

    def operand(self) -> Any:
        """What its `wide_pcg.Operator` works on; None where there is only `apply`."""
        ...


class BlockPcg:
    """Solves K p = b on the free vertices by launches alone.

    tolerance: relative, of sqrt(r . M^-1 r). most: iterations of a solve. iterations: (1,) int32 on the device, done since it was last set to
    zero. indefinite: (1,) int32, whether the last solve met a direction of negative curvature, in matrix or preconditioner, and ended there. affine: bodies whose vertices follow
    four of them, which alone are then unknowns.
    """

    def __init__(
        self,
        device: Device,
        real: Real,
        matrix: BlockMatrix,
        free: np.ndarray,
        tolerance: float,
        most: int,
        affine: AffineBodies | None = None,
    ):
        n, scalar = matrix.count, real.scalar
        self.device, self.real, self.matrix, self.affine = device, real, matrix, affine
        followers = [] if affine is None else affine.bodies
        self.modes = self.make_modes(free)
        self.tolerance, self.max_iterations = tolerance, most
        self.sums = shared.Sums(device, matrix.free_end)

        def zeros(dtype, count: int = n + 1) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=device.warp)

        self.r, self.u, self.w, self.p, self.s = (zeros(real.vec3) for _ in range(5))
        self.vectors = filled(pcg.vectors(real), self)
        self._inverse = zeros(real.mat33)
        self._free = wp.array(free.astype(np.int32), device=device.warp)
        unknown = free.copy()
        for body in followers:
            unknown[body.vertices] = False
        self._unknown = wp.array(unknown.astype(np.int32), device=device.warp)
        self._numbers, self._partial = zeros(scalar, 3), zeros(scalar, self.sums.slots)
        self.first, self.residual = zeros(scalar, 1), zeros(scalar, 1)
        self.iterations, self.left, self.condition = zeros(wp.int32, 1), zeros(wp.int32, 1), zeros(wp.int32, 1)
        self.indefinite = zeros(wp.int32, 1)
        self._steps = wp.zeros((most, 2), dtype=scalar, device=device.warp)
        self._kernels, self._pcg = kernels(real), pcg.kernels(real)
        self._advance = _advance_kernel(real)

    def status(self, tolerance: float | None) -> Any:
        """When a solve ends, and how far it has come, as kernels take it."""
        made = filled(shared.status(self.real), self)
        made.tolerance = tolerance or self.tolerance
        return made

    @property
    def direction(self) -> wp.array:
        """(n + 1,) vec3: the last direction; where the solve ended as `indefinite`, that of negative curvature."""
        return self.p

    def make_modes(self, free: np.ndarray) -> RigidModes:
        bodies = [] if self.affine is None else self.affine.bodies
        return RigidModes(self.device, self.real, self.matrix, free, bodies=bodies)

    def prepare(self, x: wp.array, couplings: list[Coupling]) -> None:
        """Launches the preconditioner for the matrix and couplings as they are now, at the positions x."""
        k = self._kernels
        diagonals = [c.diagonal for c in couplings if c.diagonal is not None]
        if self.affine is not None:
            self.affine.fold_diagonal([self.matrix.diagonal, *diagonals])
            diagonals.append(self.affine.diagonal)
        diagonals += [None] * (3 - len(diagonals))
        inputs = [self._unknown, self.matrix.diagonal, *diagonals, self._inverse]
        self.device.launch(k.invert_diagonal, self.matrix.free_end, inputs, grain=32)
        if self.modes.groups:
            self.modes.prepare(x, couplings)

    def solve(
        self,
        p: wp.array,
        b: wp.array,
        couplings: list[Coupling],
        tolerated: float,
        loose: wp.array,
        tolerance: float | None = None,
    ) -> None:
        """Launches the solution of K p = b. p: (n,) vec3, m; the start on entry, the solution on return; entries that are not free stay.

        tolerated: N^(1/2) m^(1/2), the norm below which a residual is as good as none. loose: (1,) int32 on the device, whether LOOSE times the
        tolerance will do. tolerance: where another one than the solver's own is wanted.
        """
        k, sums, status = self._kernels, self.sums, self.status(tolerance)
        assembled = [c.assemble(self.matrix.free_end) for c in couplings if c.rows is not None]
        couplings = [c for c in couplings if c.rows is None]
        assembled += [nothing(self.real)] * (2 - len(assembled))

        def begin(again: int) -> None:
            self._find_residual(p, b, couplings, assembled)
            if self.affine is not None:
                self.affine.fold(self.r)
            self._precondition()
            numbers = [self._partial, sums.slots, self._numbers, self.real.scalar(tolerated), again]
            sums.conclude(k.begin, [*numbers, loose, status, self.indefinite])

        def begin_again() -> None:
            self._move_rigidly(p)
            begin(again=1)

        begin(again=0)
        self.device.when(loose, begin_again)

        def iterate() -> None:
            if self.affine is not None:
                self.affine.expand(self.u)
            for c in couplings:
                c.apply(self.u, self.w)
            sums.launch(k.multiply, [self.matrix.rows, *assembled, self._free, self.vectors, self._partial])
            if self.affine is not None:
                self.affine.fold(self.w)
            sums.conclude(k.find_alpha, [self._partial, sums.slots, self._numbers, self.left, self.indefinite])
            sums.launch(self._advance, [self._numbers, 1, self.vectors, p])
            self._precondition()
            sums.conclude(self._pcg.find_beta, [self._partial, sums.slots, self._numbers, self._steps, status])

        self.device.loop(self.condition, iterate)
        self.device.launch_serial(k.judge_preconditioner, [self._numbers, self.indefinite])
        if self.affine is not None:
            self.affine.expand(p)

    def _find_residual(self, p: wp.array, b: wp.array, couplings: list[Coupling], assembled: list) -> None:
        """r = b - K p. couplings: those without rows; assembled: the rows of two others."""
        k, m = self._kernels, self.matrix
        self.device.launch(k.clear, m.free_end, [self.w])
        if self.affine is not None:
            self.affine.expand(p)
        for c in couplings:
            c.apply(p, self.w)
        self.device.launch(k.start, m.free_end, [m.rows, *assembled, self._free, b, p, self.vectors], grain=32)

    def _move_rigidly(self, p: wp.array) -> None:
        """The coarse part of the preconditioned residual alone: what flies freely is solved by that exactly, whatever the tolerance."""
        inputs = [self._unknown, self._inverse, self.r, self.u, p]
        self.device.launch(self._kernels.move_rigidly, self.matrix.free_end, inputs)

    def clear(self, values: wp.array) -> None:
        """Launches values = 0 over the vertices."""
        self.device.launch(self._kernels.clear, self.matrix.count, [values])

    def _precondition(self) -> None:
        modes = self.modes
        if modes.groups:
            modes.restrict(self.r)
        inputs = [self._inverse, modes.label, modes.arms, modes.z, self.vectors, self._partial]
        self.sums.launch(self._kernels.correct, inputs)


def _advance_kernel(real: Real) -> Kernel:
    from pdipc.linear import coarse

    return coarse.kernels(real).advance


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    f = shared.functions(real)
    vec6 = wp.types.vector(6, wp.float64)
    Rows, contact = row_kernels(real).Rows, row_kernels(real).product
    BlockRows, Status, Vectors = rows_of(real), shared.status(real), pcg.vectors(real)

    @func
    def product(i: int, k: BlockRows, p: wp.array(dtype=vec3)) -> vec3:
        """Row i of K p, without contacts."""
        own = p[i]
        total = k.held[i] * own
        for e in range(k.offsets[i], k.offsets[i + 1]):
            total += k.values[e] * (p[k.columns[e]] - own)
        return total

    @kernel(module)
    def clear(first: int, values_out: wp.array(dtype=vec3)):
        values_out[first + wp.tid()] = vec3()

    @kernel(module)
    def invert_diagonal(
        first: int,
        free: wp.array(dtype=wp.int32),
        elastic: wp.array(dtype=mat33),
        contact_a: wp.array(dtype=mat33),
        contact_b: wp.array(dtype=mat33),
        contact_c: wp.array(dtype=mat33),
        inverse_out: wp.array(dtype=mat33),
    ):
        i = first + wp.tid()
        if free[i] == 1:
            total = elastic[i]
            if contact_a:
                total += contact_a[i]
            if contact_b:
                total += contact_b[i]
            if contact_c:
                total += contact_c[i]
            inverse_out[i] = f.invert(total)

    @kernel(module)
    def start(
        first: int,
        k: BlockRows,
        rows_a: Rows,
        rows_b: Rows,
        free: wp.array(dtype=wp.int32),
        b: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        v: Vectors,
    ):
        """r = b - K x; w holds what couplings without rows have of K x, and is left zero."""
        i = first + wp.tid()
        v.r[i] = vec3()
        if free[i] == 1:
            v.r[i] = b[i] - product(i, k, x) - contact(i, rows_a, x) - contact(i, rows_b, x) - v.w[i]
        v.w[i] = vec3()
        v.s[i] = vec3()
        v.p[i] = vec3()

    @kernel(module)
    def move_rigidly(
        first: int,
        unknown: wp.array(dtype=wp.int32),
        inverse: wp.array(dtype=mat33),
        r: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        if unknown[i] == 1:
            p[i] = p[i] + (u[i] - inverse[i] * r[i])

    @kernel(module)
    def begin(
        first: int,
        partial: wp.array(dtype=scalar),
        slots: int,
        numbers: wp.array(dtype=scalar),
        tolerated: scalar,
        again: int,
        loose: wp.array(dtype=wp.int32),
        status: Status,
        indefinite_out: wp.array(dtype=wp.int32),
    ):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            numbers[pcg.ALPHA] = scalar(1.0)
            numbers[pcg.BETA] = scalar(0.0)
            numbers[pcg.GAMMA] = gamma
            norm = wp.sqrt(gamma)
            reference = norm
            if loose[0] != 0:
                reference = scalar(LOOSE) * norm
            reference = wp.max(reference, tolerated / status.tolerance)
            if again != 0:
                reference = status.first[0]
            status.first[0] = reference
            status.left[0] = status.max_iterations
            status.residual[0] = norm / reference
            indefinite_out[0] = 0
            status.condition[0] = 0
            if norm > status.tolerance * reference or not wp.isfinite(gamma):
                status.condition[0] = 1
            if gamma < scalar(0.0):
                indefinite_out[0] = 1

    @kernel(module)
    def find_alpha(
        first: int,
        partial: wp.array(dtype=scalar),
        slots: int,
        numbers: wp.array(dtype=scalar),
        left: wp.array(dtype=wp.int32),
        indefinite_out: wp.array(dtype=wp.int32),
    ):
        """alpha; where the curvature along the direction is negative, no step, the end, and a note of it."""
        lane = first + wp.tid()
        delta = f.sum_partials(partial, slots, lane)
        if lane == 0:
            gamma = numbers[pcg.GAMMA]
            curvature = delta - numbers[pcg.BETA] * gamma / numbers[pcg.ALPHA]
            if curvature > scalar(0.0) or wp.isnan(curvature):
                numbers[pcg.ALPHA] = gamma / curvature
            else:
                numbers[pcg.ALPHA] = scalar(0.0)
                left[0] = 1
                indefinite_out[0] = 1

    @kernel(module)
    def judge_preconditioner(first: int, numbers: wp.array(dtype=scalar), indefinite_out: wp.array(dtype=wp.int32)):
        """A negative r . M^-1 r, which also ends the solve, tells of a preconditioner that is indefinite, as the matrix then is."""
        if numbers[pcg.GAMMA] < scalar(0.0):
            indefinite_out[0] = 1

    @kernel(module)
    def multiply(
        first: int,
        share: int,
        count: int,
        k: BlockRows,
        rows_a: Rows,
        rows_b: Rows,
        free: wp.array(dtype=wp.int32),
        v: Vectors,
        partial_out: wp.array(dtype=scalar),
    ):
        """w = K u, where w holds the part of couplings without rows already, and delta = u . w."""
        worker = first + wp.tid()
        delta = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            total = vec3()
            if free[i] == 1:
                total = product(i, k, v.u) + contact(i, rows_a, v.u) + contact(i, rows_b, v.u) + v.w[i]
            v.w[i] = total
            delta += wp.dot(v.u[i], total)
        f.store_sum(delta, worker, partial_out)

    @kernel(module)
    def correct(
        first: int,
        share: int,
        count: int,
        inverse: wp.array(dtype=mat33),
        label: wp.array(dtype=wp.int32),
        arms: wp.array(dtype=vec3),
        z: wp.array(dtype=vec6),
        v: Vectors,
        partial_out: wp.array(dtype=scalar),
    ):
        """u = D^-1 r + Z z, gamma = r . u."""
        worker = first + wp.tid()
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            g = label[i]
            if g >= 0:
                m = z[g]
                residual = v.r[i]
                turn = vec3(scalar(m[3]), scalar(m[4]), scalar(m[5]))
                u = inverse[i] * residual + vec3(scalar(m[0]), scalar(m[1]), scalar(m[2])) + wp.cross(turn, arms[i])
                v.u[i] = u
                gamma += wp.dot(residual, u)
        f.store_sum(gamma, worker, partial_out)

    return SimpleNamespace(
        clear=clear,
        invert_diagonal=invert_diagonal,
        start=start,
        move_rigidly=move_rigidly,
        begin=begin,
        find_alpha=find_alpha,
        judge_preconditioner=judge_preconditioner,
        multiply=multiply,
        correct=correct,
        product=product,
    )
