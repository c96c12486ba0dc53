"""The factors of Chebyshev's iteration, and the interval that weighted Jacobi takes them for."""

import numpy as np
import pytest
from numpy.polynomial import Chebyshev

from pdipc.linear.paper.jacobi import chebyshev_factors


@pytest.mark.parametrize("rho", [0.3, 0.9, 0.999])
def test_errors_fall_as_chebyshevs_polynomials_do(rho):
    """For an eigenvalue r of I - w D^-1 K the error after k sweeps is T_k(r / rho) / T_k(1 / rho) of the first: the least there can be on [-rho, rho]."""
    r = np.linspace(-rho, rho, 41)
    before, error = np.ones_like(r), np.ones_like(r)
    for k, omega in enumerate(chebyshev_factors(rho, 12), start=1):
        before, error = error, before + omega * (r * error - before)
        polynomial = Chebyshev.basis(k)
        assert error == pytest.approx(polynomial(r / rho) / polynomial(1.0 / rho), abs=1e-12)
