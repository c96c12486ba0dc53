"""The result does not depend on the linear solver, the number of threads or the precision beyond their tolerances."""

import numpy as np
import pytest

import pdipc
from pdipc.model import build

from .scenes import floor, scene, solid, watched

CONTACT = {"activation_distance": 2e-3, "minimum_separation": 1e-4, "friction": 0.3}


def run(steps=12, threads=None, monkeypatch=None, model="auto", friction=0.3, **simulation):
    if threads is not None:
        monkeypatch.setenv("PDIPC_THREADS", str(threads))
    body = solid("block", (0.2, 0.2, 0.2), (3, 3, 3), at=(0, 0.125, 0), rotation=(5, 0, 8), velocity=(0, -1, 0))
    body["material"]["model"] = model
    made = watched(scene([body], [floor()], contact=CONTACT | {"friction": friction}, **simulation))
    for _ in range(steps):
        assert made.step().converged
    return made.positions


@pytest.mark.parametrize("solver", ["pcg", "jacobi", "chebyshev", "matrix-powers", "gauss-seidel", "sor", "direct"])
def test_solvers_agree(solver):
    """Without friction, whose normal forces local-global iterations take from the iterate, and Newton's method from where a step starts."""
    exact = {"tolerance": 1e-5, "max_outer": 500, "friction": 0.0}
    part = {"nonlinear_solver": "local-global", "linear_iterations": 100}
    np.testing.assert_allclose(run(linear_solver=solver, **part, **exact), run(model="arap", **exact), atol=2e-5)


def test_precisions_agree():
    np.testing.assert_allclose(run(precision="float32", tolerance=3e-4), run(precision="float64", tolerance=3e-4), atol=2e-4)


def test_threads_give_the_same_bits(monkeypatch):
    one = run(threads=1, monkeypatch=monkeypatch)
    for threads in (2, 3):
        np.testing.assert_array_equal(run(threads=threads, monkeypatch=monkeypatch), one)


def test_a_solver_that_cannot_take_coupled_contacts_is_refused():
    body = solid("block", (0.2, 0.2, 0.2), (1, 1, 1))
    with pytest.raises(
        pdipc.SceneError, match=r'linear_solver: "a-jacobi" cannot take the contacts of contact.method = "barrier"'
    ):
        build(scene([body], contact=CONTACT, linear_solver="a-jacobi"), "cpu")


@pytest.mark.parametrize("solver", ["pcg", "two-level", "direct"])
def test_solvers_agree_with_the_papers_contact(solver):
    """Scalars on the diagonal are all that it adds to the matrix; every solver takes them as a-jacobi does."""
    body = solid("block", (0.2, 0.2, 0.2), (3, 3, 3), at=(0, 0.125, 0), rotation=(5, 0, 8), velocity=(0, -1, 0))
    found = []
    for name in ("a-jacobi", solver):
        table = {"linear_solver": name, "linear_iterations": 300, "linear_tolerance": 1e-8}
        made = watched(scene([body], [floor()], contact=CONTACT | {"method": "paper", "friction": 0.0}, **table))
        barriers = [made.step().barriers for _ in range(10)]
        found.append(made.positions)
        assert max(barriers) > 5
    np.testing.assert_allclose(*found, atol=1e-9)
