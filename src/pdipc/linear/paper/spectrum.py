"""The spectral interval of D^-1 A, which weighted Jacobi and Chebyshev need (Section 5.3).

Conjugate gradients find it on the way: their alpha and beta are the entries of the tridiagonal matrix of Lanczos' method for
D^-1/2 A D^-1/2, whose extreme eigenvalues approach the matrix's own from inside. The three coordinates of a random start
make one long vector for A (x) I3, which has the same eigenvalues.

Contacts do not widen the interval beyond max(hi, 1): the blocks Omega that they add to the diagonal dominate the Hessian C that
they add to the matrix, and A <= hi D with C <= Omega gives A + C <= max(hi, 1) (D + Omega). The lower end may sink, where
Omega is coarser than C; Chebyshev's iteration then takes longer, but does not diverge.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import warp as wp

if TYPE_CHECKING:
    from pdipc.linear.system import System

STEPS = 400  # of Lanczos, at most
CONVERGED = 1e-6  # relative residual at which conjugate gradients have seen the whole spectrum
MARGIN = 0.03  # added at both ends; an interval 10 % too short makes Chebyshev diverge


def interval(system: "System") -> tuple[float, float]:
    """[lo, hi] around all eigenvalues of D^-1 A on the free vertices; (1, 1) where no vertex is free."""
    from pdipc.linear.pcg import Pcg

    if not system.free.any():
        return 1.0, 1.0
    solver = Pcg(system, tolerance=CONVERGED, max_iterations=STEPS)
    start = np.random.default_rng(0).standard_normal((system.count, 3)) * np.sqrt(np.abs(system.matrix.diagonal()))[:, None]
    b = wp.array(start.astype(system.real.numpy), dtype=system.real.vec3, device=system.device.warp)
    x = wp.zeros(system.count, dtype=system.real.vec3, device=system.device.warp)
    if system.device.records_loops:
        system.device.capture(lambda: solver.solve(x, b), solver).launch()
    else:
        solver.solve(x, b)
    count = int(solver.iterations.numpy()[0])
    alpha, beta = solver.steps.numpy()[:count].astype(np.float64).T
    count = int(np.argmin(np.append(alpha > 0.0, False)))  # in float32 a stiff matrix may end with a step that is rounding
    alpha, beta = alpha[:count], beta[:count]
    diagonal = 1.0 / alpha
    diagonal[1:] += beta[:-1] / alpha[:-1]
    beside = np.sqrt(beta[:-1]) / alpha[:-1]
    ritz = scipy.linalg.eigvalsh_tridiagonal(diagonal, beside)
    return float(ritz[0] * (1.0 - MARGIN)), float(ritz[-1] * (1.0 + MARGIN))
