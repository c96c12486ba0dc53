"""Conjugate gradients with the 3x3 block diagonal as preconditioner.

In the form of Chronopoulos and Gear (1989), which keeps s = K p by a recurrence, so that all vector updates of an iteration
are one pass over the vertices and the matrix product is the other:

    w = K u,  delta = u . w                                   multiply
    alpha = gamma / (delta - beta gamma / alpha_before)       find_alpha
    p = u + beta p, s = w + beta s, x += alpha p, r -= alpha s, u = D^-1 r, gamma = r . u      update
    beta = gamma / gamma_before                               find_beta
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.linear import kernels as shared
from pdipc.linear.kernels import BLOCK
from pdipc.linear.solvers import Contact, Solver
from pdipc.linear.system import System
from pdipc.precision import Real

# Slots of the array of numbers that one solve carries along.
ALPHA, BETA, GAMMA, GAMMA_FIRST = (wp.constant(k) for k in range(4))


class Pcg(Solver):
    """Preconditioned conjugate gradients."""

    def __init__(self, system: System, tolerance: float, max_iterations: int):
        super().__init__(system, tolerance, max_iterations)
        vec3, scalar = self.real.vec3, self.real.scalar
        self._r, self._u, self._w, self._p, self._s = (self.zeros(vec3) for _ in range(5))
        self._partial = self.zeros(scalar, self.blocks)
        self._numbers = self.zeros(scalar, 4)
        self._condition = self.zeros(wp.int32, 1)
        self._left = self.zeros(wp.int32, 1)
        self._kernels = kernels(self.real)

    def solve(self, x: wp.array, b: wp.array, contact: Contact | None = None) -> None:
        apply = contact.apply if contact is not None else None
        k, system, launch = self._kernels, self.system, self.device.launch
        matrix = [system.offsets, system.columns, system.values, self.total]
        preconditioner = [self.inverse, self.inverse_block]
        self.invert_diagonal(contact)
        if apply:
            self.clear(self._w)
            apply(x, self._w)
        launch(
            k.start,
            self.blocks,
            [*matrix, *preconditioner, b, x, system.count, int(apply is not None), self._w, self._r, self._u, self._p, self._s]
            + [self._partial],
            grain=BLOCK,
        )
        numbers = [self._partial, self.blocks, self._numbers]
        status = [self.real.scalar(self.tolerance), self.iterations, self.residual, self._left, self._condition]
        self.device.launch_serial(k.begin, [*numbers, self.max_iterations, *status])

        def iterate() -> None:
            if apply:
                apply(self._u, self._w)
            launch(
                k.multiply,
                self.blocks,
                [*matrix, self._u, system.count, int(apply is not None), self._w, self._partial],
                grain=BLOCK,
            )
            self.device.launch_serial(k.find_alpha, numbers)
            launch(
                k.update,
                self.blocks,
                [*preconditioner, self._numbers, system.count, int(apply is not None), self._w, self._p, self._s, x, self._r]
                + [self._u, self._partial],
                grain=BLOCK,
            )
            self.device.launch_serial(k.find_beta, [*numbers, *status])

        self.device.loop(self._condition, iterate)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The kernels of one iteration."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    f = shared.functions(real)
    block = wp.constant(BLOCK)

    @wp.kernel(module=module)
    def start(
        first: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        diagonal: wp.array(dtype=scalar),
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        b: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        count: int,
        coupled: int,
        w: wp.array(dtype=vec3),
        r_out: wp.array(dtype=vec3),
        u_out: wp.array(dtype=vec3),
        p_out: wp.array(dtype=vec3),
        s_out: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """r = b - K x, u = D^-1 r, gamma = r . u; w holds the contacts' part of K x and is left zero."""
        worker = first + wp.tid()
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        gamma = scalar(0.0)
        for i in range(worker * block, wp.min((worker + 1) * block, count)):
            r = zero
            u = zero
            if inverse[i] != scalar(0.0):
                r = b[i] - diagonal[i] * x[i] - f.row_product(i, offsets, columns, values, x)
                if coupled != 0:
                    r -= w[i]
                u = f.precondition(i, inverse, inverse_block, r)
                gamma += wp.dot(r, u)
            r_out[i] = r
            u_out[i] = u
            p_out[i] = zero
            s_out[i] = zero
            if coupled != 0:
                w[i] = zero
        partial_out[worker] = gamma

    @wp.kernel(module=module)
    def multiply(
        first: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        diagonal: wp.array(dtype=scalar),
        u: wp.array(dtype=vec3),
        count: int,
        coupled: int,
        w: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """w = K u, where w holds the contacts' part already, and delta = u . w."""
        worker = first + wp.tid()
        delta = scalar(0.0)
        for i in range(worker * block, wp.min((worker + 1) * block, count)):
            product = diagonal[i] * u[i] + f.row_product(i, offsets, columns, values, u)
            if coupled != 0:
                product += w[i]
            w[i] = product
            delta += wp.dot(u[i], product)
        partial_out[worker] = delta

    @wp.kernel(module=module)
    def update(
        first: int,
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        numbers: wp.array(dtype=scalar),
        count: int,
        coupled: int,
        w: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        s: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """All vectors one step on, and gamma = r . u; w is left zero where contacts will add to it."""
        worker = first + wp.tid()
        alpha = numbers[ALPHA]
        beta = numbers[BETA]
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        gamma = scalar(0.0)
        for i in range(worker * block, wp.min((worker + 1) * block, count)):
            direction = u[i] + beta * p[i]
            image = w[i] + beta * s[i]
            residual = r[i] - alpha * image
            p[i] = direction
            s[i] = image
            x[i] = x[i] + alpha * direction
            r[i] = residual
            corrected = f.precondition(i, inverse, inverse_block, residual)
            u[i] = corrected
            gamma += wp.dot(residual, corrected)
            if coupled != 0:
                w[i] = zero
        partial_out[worker] = gamma

    @wp.kernel(module=module)
    def begin(
        first: int,
        partial: wp.array(dtype=scalar),
        workers: int,
        numbers: wp.array(dtype=scalar),
        max_iterations: int,
        tolerance: scalar,
        iterations: wp.array(dtype=wp.int32),
        residual_out: wp.array(dtype=scalar),
        left_out: wp.array(dtype=wp.int32),
        condition_out: wp.array(dtype=wp.int32),
    ):
        gamma = f.sum_partials(partial, workers)
        numbers[ALPHA] = scalar(1.0)
        numbers[BETA] = scalar(0.0)
        numbers[GAMMA] = gamma
        numbers[GAMMA_FIRST] = gamma
        left_out[0] = max_iterations
        going = gamma > scalar(0.0) and tolerance < scalar(1.0)
        residual_out[0] = wp.where(gamma > scalar(0.0), scalar(1.0), scalar(0.0))
        condition_out[0] = wp.where(going, 1, 0)

    @wp.kernel(module=module)
    def find_alpha(first: int, partial: wp.array(dtype=scalar), workers: int, numbers: wp.array(dtype=scalar)):
        delta = f.sum_partials(partial, workers)
        gamma = numbers[GAMMA]
        numbers[ALPHA] = gamma / (delta - numbers[BETA] * gamma / numbers[ALPHA])

    @wp.kernel(module=module)
    def find_beta(
        first: int,
        partial: wp.array(dtype=scalar),
        workers: int,
        numbers: wp.array(dtype=scalar),
        tolerance: scalar,
        iterations: wp.array(dtype=wp.int32),
        residual_out: wp.array(dtype=scalar),
        left: wp.array(dtype=wp.int32),
        condition_out: wp.array(dtype=wp.int32),
    ):
        gamma = f.sum_partials(partial, workers)
        numbers[BETA] = gamma / numbers[GAMMA]
        numbers[GAMMA] = gamma
        residual = wp.sqrt(gamma / numbers[GAMMA_FIRST])
        residual_out[0] = residual
        iterations[0] = iterations[0] + 1
        left[0] = left[0] - 1
        condition_out[0] = wp.where(residual > tolerance and left[0] > 0, 1, 0)

    return SimpleNamespace(**locals())
