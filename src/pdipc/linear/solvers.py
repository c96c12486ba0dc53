"""Solvers by name, and what they have in common."""

from collections.abc import Callable
from typing import Any, Protocol

import warp as wp

from pdipc.linear import kernels
from pdipc.linear.system import System


class Contact(Protocol):
    """What contact adds to the matrix: K = A (x) I3 + contact Hessian.

    diagonal: (n,) 3x3 blocks, kg/s^2, positive semidefinite, that dominate the contact Hessian; or None.
    scalar: (n,) scalar diagonal additions, kg/s^2 (the paper's form, Eq. (6)); or None.
    apply: `apply(p, y)` launches y_i += (contact Hessian p)_i; or None where `scalar` is the whole contribution.
    """

    diagonal: wp.array | None
    scalar: wp.array | None
    apply: Callable[[wp.array, wp.array], None] | None


class Solver:
    """Solves K x = b on the free vertices, only by launches, so that it can be recorded.

    iterations: (1,) int32 on the device, iterations done since the caller last set it to zero.
    residual: (1,) on the device, sqrt(r . D^-1 r) at the end of the last solve, relative to the one at its start.
    recordable: whether `solve` may be called inside `device.capture`.
    """

    recordable = True

    def __init__(self, system: System, tolerance: float, max_iterations: int):
        if not tolerance >= 0.0:
            raise ValueError(f"solver tolerance is {tolerance}; it must be zero or positive")
        if not max_iterations >= 1:
            raise ValueError(f"solver max_iterations is {max_iterations}; it must be at least 1")
        self.system, self.device, self.real = system, system.device, system.real
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.blocks = -(-system.count // kernels.BLOCK)
        scalar = self.real.scalar
        self.iterations = self.zeros(wp.int32, 1)
        self.residual = self.zeros(scalar, 1)
        self.total = self.zeros(scalar)
        self.inverse = self.zeros(scalar)
        self.inverse_block = self.zeros(self.real.mat33)
        self._shared = kernels.kernels(self.real)

    def zeros(self, dtype: Any, count: int | None = None) -> wp.array:
        """A zeroed array of `count` entries, by default one for each vertex."""
        return wp.zeros(max(1, self.system.count if count is None else count), dtype=dtype, device=self.device.warp)

    def clear(self, values: wp.array) -> None:
        """Launches values = 0 for an array over the vertices."""
        self.device.launch(self._shared.clear, self.system.count, [values])

    def invert_diagonal(self, contact: Contact | None) -> None:
        """Launches the computation of `total`, `inverse` and `inverse_block` from A and the contacts."""
        scalar = contact.scalar if contact is not None else None
        block = contact.diagonal if contact is not None else None
        self.device.launch(
            self._shared.invert_diagonal,
            self.system.count,
            [self.system.diagonal, scalar, block, self.total, self.inverse, self.inverse_block],
            grain=8,
        )

    def solve(self, x: wp.array, b: wp.array, contact: Contact | None = None) -> None:
        """Launches the solution of K x = b.

        x: (n,) vec3, m; the start on entry, the solution on return; entries that are not free stay as they are.
        b: (n,) vec3, N.
        """
        raise NotImplementedError


def make_solver(name: str, system: System, *, tolerance: float = 1e-4, max_iterations: int = 200, **options: Any) -> Solver:
    """The solver called `name` for `system`.

    tolerance: a solve ends when its residual has fallen to this part of the first. max_iterations: or after so many.
    Raises ValueError for an unknown name or option.
    """
    from pdipc.linear import jacobi, pcg

    known: dict[str, Callable[..., Solver]] = {
        "pcg": pcg.Pcg,
        "jacobi": jacobi.Jacobi,
        "chebyshev": jacobi.Chebyshev,
    }
    if name not in known:
        raise ValueError(f'solver is "{name}"; it must be one of: {", ".join(known)}')
    return known[name](system, tolerance=tolerance, max_iterations=max_iterations, **options)


SOLVERS = ("pcg", "jacobi", "chebyshev")
