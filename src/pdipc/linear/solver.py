"""What all solvers have in common."""

from collections.abc import Callable
from typing import Any, Protocol

import warp as wp

from pdipc.device.language import filled
from pdipc.linear import kernels
from pdipc.linear.system import System


class Contact(Protocol):
    """What contact adds to the matrix: K = A (x) I3 + contact Hessian.

    diagonal: (n,) 3x3 blocks, kg/s^2, positive semidefinite, that dominate the contact Hessian; or None.
    scalar: (n,) scalar diagonal additions, kg/s^2 (the paper's form, Eq. (6)); or None.
    apply: `apply(p, y)` launches y_i += (contact Hessian p)_i; or None where `scalar` is the whole contribution.
    """

    @property
    def diagonal(self) -> wp.array | None: ...

    @property
    def scalar(self) -> wp.array | None: ...

    @property
    def apply(self) -> Callable[[wp.array, wp.array], None] | None: ...


class Solver:
    """Solves K x = b on the free vertices, only by launches, so that it can be recorded.

    tolerance: a solve ends when its residual norm sqrt(r . D^-1 r) has fallen to this part of the first one.
    max_iterations: or after so many iterations.
    iterations: (1,) int32 on the device, iterations done since the caller last set it to zero.
    residual: (1,) on the device, the last solve's residual norm relative to `first`.
    first: (1,) on the device, the residual norm at the start of the last solve, N/sqrt(kg/s^2).
    moves_bodies: whether a few iterations find the common motion of a stiff body; else see translations.py.
    recordable: whether `solve` may be called inside `device.capture`.
    dropped: largest part of a row of the iteration matrix that was left out; 0 for all but A-Jacobi with `drop` or `split`.
    """

    moves_bodies = False
    recordable = True
    dropped = 0.0

    def __init__(self, system: System, tolerance: float, max_iterations: int):
        if not 0.0 <= tolerance < 1.0:
            raise ValueError(f"solver tolerance is {tolerance}; it must be at least 0 and less than 1")
        if not max_iterations >= 1:
            raise ValueError(f"solver max_iterations is {max_iterations}; it must be at least 1")
        self.system, self.device, self.real = system, system.device, system.real
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.sums = kernels.Sums(self.device, system.count)
        scalar = self.real.scalar
        self.iterations, self.residual, self.first = self.zeros(wp.int32, 1), self.zeros(scalar, 1), self.zeros(scalar, 1)
        self.left, self.condition = self.zeros(wp.int32, 1), self.zeros(wp.int32, 1)
        self.partial = self.zeros(scalar, self.sums.slots)
        self.total, self.held = self.zeros(scalar), self.zeros(scalar)
        self.inverse, self.inverse_block = self.zeros(scalar), self.zeros(self.real.mat33)
        self._shared = kernels.kernels(self.real)

    @property
    def status(self) -> Any:
        """When a solve ends, and how far it has come, as kernels take it."""
        return filled(kernels.status(self.real), self)

    def equation(self, b: wp.array) -> Any:
        """K x = b without coupled contacts, as kernels take it."""
        made = kernels.equation(self.real)()
        made.rows, made.total, made.held, made.b = self.system.rows.operand, self.total, self.held, b
        made.inverse, made.inverse_block = self.inverse, self.inverse_block
        return made

    def prepare(self, contact: Contact | None) -> None:
        """Launches what depends on A and the contacts alone, not on x and b."""
        scalar = contact.scalar if contact is not None else None
        block = contact.diagonal if contact is not None else None
        system = self.system
        inputs = [system.diagonal, system.row_sum, scalar, block, self.total, self.held, self.inverse, self.inverse_block]
        self.device.launch(self._shared.invert_diagonal, self.system.count, inputs, grain=8)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        """Launches the solution of K x = b.

        x: (n,) vec3, m; the start on entry, the solution on return; entries that are not free stay as they are.
        b: (n,) vec3, N.
        prepared: whether `prepare` was called since the contacts last changed; otherwise solve does that itself.
        """
        raise NotImplementedError

    def zeros(self, dtype: Any, count: int | None = None) -> wp.array:
        """A zeroed array of `count` entries; by default one for each vertex and a spare one (see rows.py)."""
        return wp.zeros(self.system.count + 1 if count is None else count, dtype=dtype, device=self.device.warp)

    def clear(self, values: wp.array) -> None:
        """Launches values = 0 over the vertices."""
        self.device.launch(self._shared.clear, self.system.count, [values])

    def copy(self, destination: wp.array, source: wp.array) -> None:
        """Launches destination = source over the vertices."""
        self.device.launch(self._shared.copy, self.system.count, [source, destination])
