"""Solvers by name."""

from typing import Any

from pdipc.linear.coarse import TwoLevel
from pdipc.linear.direct import Direct
from pdipc.linear.paper.a_jacobi import AJacobi
from pdipc.linear.paper.gauss_seidel import GaussSeidel, Sor
from pdipc.linear.paper.jacobi import Chebyshev, Jacobi
from pdipc.linear.paper.powers import MatrixPowers
from pdipc.linear.pcg import Pcg
from pdipc.linear.solver import Solver
from pdipc.linear.system import System

SOLVERS: dict[str, type[Solver]] = {
    "pcg": Pcg,
    "two-level": TwoLevel,
    "jacobi": Jacobi,
    "chebyshev": Chebyshev,
    "a-jacobi": AJacobi,
    "matrix-powers": MatrixPowers,
    "gauss-seidel": GaussSeidel,
    "sor": Sor,
    "direct": Direct,
}


def make_solver(name: str, system: System, *, tolerance: float = 1e-4, max_iterations: int = 200, **options: Any) -> Solver:
    """The solver called `name` for `system`; `options` are those of its class.

    Raises ValueError for an unknown name or an option that the solver does not have.
    """
    if name not in SOLVERS:
        raise ValueError(f'solver is "{name}"; it must be one of: {", ".join(SOLVERS)}')
    try:
        return SOLVERS[name](system, tolerance=tolerance, max_iterations=max_iterations, **options)
    except TypeError as error:
        raise ValueError(f'solver "{name}": {error}') from error
