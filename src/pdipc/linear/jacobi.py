"""Weighted Jacobi, alone and accelerated by Chebyshev (Section 5.3).

    y = x_k + w D^-1 (b - K x_k),   x_{k+1} = x_{k-1} + omega_{k+1} (y - x_{k-1})

with w = 2/(lo + hi), rho = (hi - lo)/(hi + lo), omega = 1, 2/(2 - rho^2), 4/(4 - rho^2 omega_k), ... for Chebyshev and
omega = 1 without.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.linear import kernels as shared
from pdipc.linear.kernels import BLOCK
from pdipc.linear.solvers import Contact, Solver
from pdipc.linear.system import System
from pdipc.precision import Real

CHECK = 4  # sweeps between two looks at the residual; even, so that the result ends up in x


def chebyshev_factors(rho: float, count: int) -> np.ndarray:
    """omega_1 ... omega_count for the spectral radius rho."""
    factors = np.ones(count)
    for k in range(1, count):
        factors[k] = 2.0 / (2.0 - rho**2) if k == 1 else 4.0 / (4.0 - rho**2 * factors[k - 1])
    return factors


class Jacobi(Solver):
    """Weighted Jacobi iteration.

    weight: w; by default 2/(lo + hi) from the spectral interval. Plain Jacobi, w = 1, diverges where hi >= 2.
    """

    accelerated = False

    def __init__(self, system: System, tolerance: float, max_iterations: int, weight: float | None = None):
        super().__init__(system, tolerance, max_iterations)
        lo, hi = system.interval
        hi = max(hi, 1.0)
        self.weight = 2.0 / (lo + hi) if weight is None else weight
        self.rho = max(abs(1.0 - self.weight * lo), abs(1.0 - self.weight * hi))
        sweeps = -(-max_iterations // CHECK) * CHECK
        factors = chebyshev_factors(self.rho, sweeps) if self.accelerated else np.ones(sweeps)
        self._factors = wp.array(factors.astype(self.real.numpy), device=self.device.warp)
        vec3, scalar = self.real.vec3, self.real.scalar
        self._other, self._w = self.zeros(vec3), self.zeros(vec3)
        self._partial, self._partial_first = self.zeros(scalar, self.blocks), self.zeros(scalar, self.blocks)
        self._first = self.zeros(scalar, 1)
        self._done, self._condition = self.zeros(wp.int32, 1), self.zeros(wp.int32, 1)
        self._kernels = kernels(self.real)

    def solve(self, x: wp.array, b: wp.array, contact: Contact | None = None) -> None:
        apply = contact.apply if contact is not None else None
        k, system = self._kernels, self.system
        matrix = [system.offsets, system.columns, system.values, self.total, self.inverse, self.inverse_block]
        self.invert_diagonal(contact)
        self.device.copy(self._other, x)
        if apply:
            self.clear(self._w)
        self.device.launch_serial(k.begin, [self._done, self._condition])

        def iterate() -> None:
            source, target = x, self._other
            for step in range(CHECK):
                if apply:
                    apply(source, self._w)
                self.device.launch(
                    k.sweep,
                    self.blocks,
                    [*matrix, b, self.real.scalar(self.weight), self._factors, self._done, step, system.count]
                    + [int(apply is not None), self._w, source, target, self._partial if step else self._partial_first],
                    grain=BLOCK,
                )
                source, target = target, source
            status = [self.real.scalar(self.tolerance), self.max_iterations, self._first, self._done, self.iterations]
            self.device.launch_serial(
                k.check, [self._partial_first, self._partial, self.blocks, *status, self.residual, self._condition]
            )

        self.device.loop(self._condition, iterate)


class Chebyshev(Jacobi):
    """Weighted Jacobi iteration accelerated by Chebyshev."""

    accelerated = True


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The kernels of one sweep."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    f = shared.functions(real)
    block = wp.constant(BLOCK)
    check_every = wp.constant(CHECK)

    @wp.kernel(module=module)
    def begin(first: int, done_out: wp.array(dtype=wp.int32), condition_out: wp.array(dtype=wp.int32)):
        done_out[0] = 0
        condition_out[0] = 1

    @wp.kernel(module=module)
    def sweep(
        first: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        diagonal: wp.array(dtype=scalar),
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        b: wp.array(dtype=vec3),
        weight: scalar,
        factors: wp.array(dtype=scalar),
        done: wp.array(dtype=wp.int32),
        step: int,
        count: int,
        coupled: int,
        w: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """One sweep from x; `before` holds the iterate before x on entry and the one after it on return."""
        worker = first + wp.tid()
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        omega = factors[done[0] + step]
        total = scalar(0.0)
        for i in range(worker * block, wp.min((worker + 1) * block, count)):
            if inverse[i] != scalar(0.0):
                r = b[i] - diagonal[i] * x[i] - f.row_product(i, offsets, columns, values, x)
                if coupled != 0:
                    r -= w[i]
                u = f.precondition(i, inverse, inverse_block, r)
                total += wp.dot(r, u)
                before[i] = before[i] + omega * (x[i] + weight * u - before[i])
            if coupled != 0:
                w[i] = zero
        partial_out[worker] = total

    @wp.kernel(module=module)
    def check(
        first: int,
        partial_first: wp.array(dtype=scalar),
        partial: wp.array(dtype=scalar),
        workers: int,
        tolerance: scalar,
        max_iterations: int,
        first_gamma: wp.array(dtype=scalar),
        done: wp.array(dtype=wp.int32),
        iterations: wp.array(dtype=wp.int32),
        residual_out: wp.array(dtype=scalar),
        condition_out: wp.array(dtype=wp.int32),
    ):
        gamma = f.sum_partials(partial, workers)
        if done[0] == 0:
            first_gamma[0] = f.sum_partials(partial_first, workers)
        residual = scalar(0.0)
        if first_gamma[0] > scalar(0.0):
            residual = wp.sqrt(gamma / first_gamma[0])
        residual_out[0] = residual
        done[0] = done[0] + check_every
        iterations[0] = iterations[0] + check_every
        condition_out[0] = wp.where(residual > tolerance and done[0] < max_iterations, 1, 0)

    return SimpleNamespace(**locals())
