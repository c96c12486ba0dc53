"""Weighted Jacobi, alone and accelerated by Chebyshev (Section 5.3).

    y = x_k + w D^-1 (b - K x_k),   x_{k+1} = x_{k-1} + omega_{k+1} (y - x_{k-1})

with w = 2/(lo + hi), rho = (hi - lo)/(hi + lo), omega = 1, 2/(2 - rho^2), 4/(4 - rho^2 omega_k), ... for Chebyshev and
omega = 1 without.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.device.language import Function, func, kernel, struct_of
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear.solver import Contact, Solver
from pdipc.linear.system import System


def chebyshev_factors(rho: float, count: int) -> np.ndarray:
    """omega_1 ... omega_count for the spectral radius rho."""
    factors = np.ones(count)
    for k in range(1, count):
        factors[k] = 2.0 / (2.0 - rho**2) if k == 1 else 4.0 / (4.0 - rho**2 * factors[k - 1])
    return factors


def weight_and_radius(system: System, weight: float | None = None) -> tuple[float, float]:
    """w, by default 2/(lo + hi), and the spectral radius of I - w D^-1 A, which is (hi - lo)/(hi + lo) for the default."""
    lo, hi = system.interval
    hi = max(hi, 1.0)  # contacts may move eigenvalues up to 1
    weight = 2.0 / (lo + hi) if weight is None else weight
    return weight, max(abs(1.0 - weight * lo), abs(1.0 - weight * hi))


class Jacobi(Solver):
    """Weighted Jacobi iteration.

    weight: w; by default 2/(lo + hi) from the spectral interval. Plain Jacobi, w = 1, diverges where hi >= 2.
    The residual is looked at every `chunk` sweeps, and is the one before the last sweep.
    """

    accelerated = False
    order = 1  # sweeps that count as one iteration
    chunk = 4  # sweeps between two looks at the residual; even, so that the result is where the start was

    def __init__(self, system: System, tolerance: float, max_iterations: int, weight: float | None = None):
        super().__init__(system, tolerance, max_iterations)
        self.weight, self.rho = weight_and_radius(system, weight)
        if self.accelerated and self.rho >= 1.0:
            raise ValueError(f"weight {self.weight:g} makes Jacobi's iteration diverge (spectral radius {self.rho:.3f})")
        sweeps = max_iterations + self.chunk
        factors = chebyshev_factors(self.rho, sweeps) if self.accelerated else np.ones(sweeps)
        self._factors = wp.array(factors.astype(self.real.numpy), device=self.device.warp)
        self._x, self._before, self._w = (self.zeros(self.real.vec3) for _ in range(3))
        self._kernels = kernels(self.real)

    @property
    def course(self) -> Any:
        """The struct of the weights of all sweeps."""
        return course_of(self, self._factors, self.weight)

    def sweep(self, equation: Any, source: wp.array, target: wp.array, step: int, coupled: bool = False) -> None:
        """Launches the sweep number `step` of the current group of sweeps, or with -1 only the residual of `source`."""
        inputs = [equation, self.course, step, self._w if coupled else None, source, target, self.partial]
        self.sums.launch(self._kernels.sweep, inputs)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        apply = contact.apply if contact is not None else None
        if not prepared:
            self.prepare(contact)
        self.copy(self._x, x)
        self.copy(self._before, x)
        if apply:
            self.clear(self._w)

        equation, status = self.equation(b), self.status

        def sweep(source: wp.array, target: wp.array, step: int) -> None:
            if apply:
                apply(source, self._w)
            self.sweep(equation, source, target, step, apply is not None)

        sweep(self._x, self._before, -1)
        self.sums.conclude(self._kernels.begin, [self.partial, self.sums.slots, status])

        def iterate() -> None:
            for step in range(0, self.chunk, 2):
                sweep(self._x, self._before, step)
                sweep(self._before, self._x, step + 1)
            self.sums.conclude(
                self._kernels.check, [self.partial, self.sums.slots, self.chunk, self.chunk // self.order, status]
            )

        self.device.loop(self.condition, iterate)
        self.copy(x, self._x)


class Chebyshev(Jacobi):
    """Weighted Jacobi iteration accelerated by Chebyshev."""

    accelerated = True


@functools.cache
def course(real: Real) -> Any:
    """A struct: the weights of the sweeps of a solve, and what tells which sweep it is."""
    return struct_of(
        "Course",
        __name__,
        weight=real.scalar,  # w
        factors=wp.array(dtype=real.scalar),  # omega of each sweep
        left=wp.array(dtype=wp.int32),  # (1,) sweeps that are left of
        max_iterations=int,
    )


@functools.cache
def omega_of(real: Real) -> Function:
    """The factor of sweep number `step` of the current group of sweeps; 0 for step -1."""
    scalar, Course = real.scalar, course(real)

    @func
    def omega(course: Course, step: int) -> scalar:
        factor = scalar(0.0)
        if step >= 0:
            factor = course.factors[course.max_iterations - course.left[0] + step]
        return factor

    return omega


def course_of(solver: Solver, factors: wp.array, weight: float = 1.0) -> Any:
    """The struct for a solver."""
    made = course(solver.real)()
    made.weight, made.factors, made.left, made.max_iterations = weight, factors, solver.left, solver.max_iterations
    return made


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The kernels of one sweep."""
    scalar, vec3 = real.scalar, real.vec3
    Equation, Status, Course = shared.equation(real), shared.status(real), course(real)
    module = real.module(__name__)
    f, omega_of_step = shared.functions(real), omega_of(real)

    @kernel(module)
    def sweep(
        first: int,
        share: int,
        count: int,
        k: Equation,
        course: Course,
        step: int,
        w: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """One sweep from x: `before` holds the iterate before x, and on return the one after it. Step -1: only the residual.

        w: the contacts' part of K x, which is left zero; absent where they have none.
        """
        worker = first + wp.tid()
        omega = omega_of_step(course, step)
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            if k.inverse[i] != scalar(0.0):
                own = x[i]
                r = k.b[i] - k.held[i] * own - f.row_difference(i, k.rows, x)
                if w:
                    r -= w[i]
                u = f.precondition(i, k, r)
                gamma += wp.dot(r, u)
                last = before[i]
                before[i] = last + omega * (own + course.weight * u - last)
            if w:
                w[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        f.store_sum(gamma, worker, partial_out)

    @kernel(module)
    def begin(first: int, partial: wp.array(dtype=scalar), slots: int, status: Status):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            f.begin_status(gamma, status)

    @kernel(module)
    def check(first: int, partial: wp.array(dtype=scalar), slots: int, sweeps: int, counted: int, status: Status):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            f.update_status(gamma, sweeps, counted, status)

    return SimpleNamespace(sweep=sweep, begin=begin, check=check)
