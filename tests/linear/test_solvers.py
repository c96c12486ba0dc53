"""Every solver against SciPy's direct solution."""

import numpy as np
import pytest
import scipy.sparse.linalg as spla
import warp as wp

from linear import systems
from pdipc.linear import SOLVERS, System, make_solver
from pdipc.parallel import Device
from pdipc.precision import real


@pytest.mark.parametrize("name", SOLVERS)
def test_against_direct_solution(name):
    x, tets = systems.tet_grid(8)
    matrix = systems.tet_matrix(x, tets)
    n = len(x)
    free = np.ones(n, dtype=bool)
    free[x[:, 0] == 0.0] = False
    b = np.random.default_rng(1).standard_normal((n, 3))
    start = np.random.default_rng(2).standard_normal((n, 3))
    expected = start.copy()
    rhs = b[free] - matrix[free][:, ~free] @ start[~free]
    expected[free] = spla.splu(matrix[free][:, free].tocsc()).solve(rhs)
    device, precision = Device("cpu"), real("float64")
    solver = make_solver(name, System(device, precision, matrix, free), tolerance=1e-10, max_iterations=20000)
    unknowns = wp.array(start, dtype=precision.vec3, device="cpu")
    solver.solve(unknowns, wp.array(b, dtype=precision.vec3, device="cpu"))
    assert np.array_equal(unknowns.numpy()[~free], start[~free])
    assert np.max(abs(unknowns.numpy() - expected)) < 1e-7 * np.max(abs(expected))
