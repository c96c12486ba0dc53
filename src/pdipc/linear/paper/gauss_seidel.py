"""Gauss-Seidel and successive over-relaxation, in parallel over the vertices of one colour at a time.

    x_i <- x_i + omega D_i^-1 (b - K x)_i        with the newest x

Neighbours in A have different colours. Coupled contacts are applied once a sweep, with the x before it: since the block
diagonal dominates them, M + M^T - K stays positive for the splitting K = M - N, and the iteration converges for omega < 2.
"""

import functools
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device.language import kernel
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear.paper import jacobi
from pdipc.linear.solver import Contact, Solver
from pdipc.linear.system import System


def colours(matrix: sp.csr_matrix, free: np.ndarray) -> np.ndarray:
    """Greedy colouring: neighbours among the free vertices get different numbers; -1 where not free."""
    colour = np.full(matrix.shape[0], -1)
    for v in np.flatnonzero(free):
        taken = set(colour[matrix.indices[matrix.indptr[v] : matrix.indptr[v + 1]]].tolist())
        c = 0
        while c in taken:
            c += 1
        colour[v] = c
    return colour


class Sor(Solver):
    """Successive over-relaxation.

    omega: relaxation, by default 2/(1 + sqrt(1 - rho^2)), the best for consistently ordered matrices, with the spectral
    radius rho of weighted Jacobi. The residual is summed over the vertices as the sweep meets them.
    """

    def __init__(self, system: System, tolerance: float, max_iterations: int, omega: float | None = None):
        super().__init__(system, tolerance, max_iterations)
        if omega is None:
            omega = float(2.0 / (1.0 + np.sqrt(1.0 - jacobi.weight_and_radius(system)[1] ** 2)))
        if not 0.0 < omega < 2.0:
            raise ValueError(f"omega is {omega}; it must lie between 0 and 2")
        self.omega = omega
        colour = colours(system.matrix, system.free)
        order = np.argsort(colour, kind="stable")
        self._groups, slot = [], 0
        for c in range(int(colour.max(initial=-1)) + 1):
            vertices = wp.array(order[colour[order] == c].astype(np.int32), device=self.device.warp)
            sums = shared.Sums(self.device, vertices.size)
            self._groups.append((sums, vertices, slot))
            slot += sums.slots
        self._slots = slot
        self._sweep_partial = self.zeros(self.real.scalar, max(1, slot))
        self._x, self._w = self.zeros(self.real.vec3), self.zeros(self.real.vec3)
        self._kernels = kernels(self.real)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        apply = contact.apply if contact is not None else None
        status_kernels = jacobi.kernels(self.real)
        equation, status = self.equation(b), self.status
        if not prepared:
            self.prepare(contact)
        self.copy(self._x, x)

        def couple() -> None:
            if apply:
                self.clear(self._w)
                apply(self._x, self._w)

        couple()
        self.sums.launch(self._kernels.residual, [equation, self._w, self._x, self.partial])
        self.sums.conclude(status_kernels.begin, [self.partial, self.sums.slots, status])

        def iterate() -> None:
            couple()
            for sums, vertices, slot in self._groups:
                inputs = [equation, self.real.scalar(self.omega), self._w, self._x, vertices, slot, self._sweep_partial]
                sums.launch(self._kernels.sweep, inputs)
            self.sums.conclude(status_kernels.check, [self._sweep_partial, self._slots, 1, 1, status])

        self.device.loop(self.condition, iterate)
        self.copy(x, self._x)


class GaussSeidel(Sor):
    """Gauss-Seidel: no over-relaxation."""

    def __init__(self, system: System, tolerance: float, max_iterations: int):
        super().__init__(system, tolerance, max_iterations, omega=1.0)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The residual, and the sweep over one colour."""
    scalar, vec3, Equation = real.scalar, real.vec3, shared.equation(real)
    module = real.module(__name__)
    f = shared.functions(real)

    @kernel(module)
    def residual(
        first: int,
        share: int,
        count: int,
        k: Equation,
        w: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        worker = first + wp.tid()
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            if k.inverse[i] != scalar(0.0):
                r = k.b[i] - w[i] - k.held[i] * x[i] - f.row_difference(i, k.rows, x)
                gamma += wp.dot(r, f.precondition(i, k, r))
        f.store_sum(gamma, worker, partial_out)

    @kernel(module)
    def sweep(
        first: int,
        share: int,
        count: int,
        k: Equation,
        omega: scalar,
        w: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        vertices: wp.array(dtype=wp.int32),
        slot: int,
        partial_out: wp.array(dtype=scalar),
    ):
        worker = first + wp.tid()
        gamma = scalar(0.0)
        for n in range(worker * share, wp.min((worker + 1) * share, count)):
            i = vertices[n]
            own = x[i]
            r = k.b[i] - w[i] - k.held[i] * own - f.row_difference(i, k.rows, x)
            u = f.precondition(i, k, r)
            gamma += wp.dot(r, u)
            x[i] = own + omega * u
        f.store_sum(gamma, worker + slot * wp.block_dim(), partial_out)

    return SimpleNamespace(residual=residual, sweep=sweep)
