"""The global step: solving K x = b for all vertices, K = A (x) I3 + contact Hessian (Section 5).

The matrix A is constant, the same for the three coordinates, and known before the simulation; contacts only ever add to K.
`System` holds A on the device, `make_solver` builds any of the solvers by name.
"""

from pdipc.linear.solver import Contact, Solver
from pdipc.linear.solvers import SOLVERS, make_solver
from pdipc.linear.system import System
from pdipc.linear.translations import Translations

__all__ = ["SOLVERS", "Contact", "Solver", "System", "Translations", "make_solver"]
