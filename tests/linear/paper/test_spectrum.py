"""The spectral interval against SciPy's eigenvalues."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from linear import systems
from linear.contacts import CoupledContact
from linear.test_solvers import MESHES, meshes, solve
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.linear import System, make_solver
from pdipc.linear.paper import spectrum
from pdipc.linear.paper.spectrum import MARGIN

DEVICE = Device("cpu", threads=1)


def ends(matrix, free):
    """Smallest and largest eigenvalue of D^-1 A on the free vertices."""
    inside = matrix[free][:, free]
    scale = sp.diags_array(1.0 / np.sqrt(inside.diagonal()))
    scaled = sp.csc_matrix(scale @ inside @ scale)
    largest = spla.eigsh(scaled, 1, which="LA", return_eigenvectors=False)[0]
    return spla.eigsh(scaled, 1, sigma=0, return_eigenvectors=False)[0], largest


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("mesh", MESHES)
def test_interval_holds_the_spectrum(mesh, precision):
    """[lo, hi] holds all eigenvalues and is not wider than the margin says (as much again for an end not yet reached)."""
    x, matrix = meshes()[mesh]
    for free in (np.ones(len(x), dtype=bool), x[:, 0] > 0.02 * x[:, 0].max()):
        lo, hi = System(DEVICE, real(precision), matrix, free).interval
        smallest, largest = ends(matrix, free)
        assert lo <= smallest and hi >= largest
        assert lo >= (1.0 - 2.0 * MARGIN) * smallest and hi <= (1.0 + 2.0 * MARGIN) * largest
        assert largest <= 4.0


def test_larger_systems():
    """The start that Lanczos' method needs to see the ends does not depend on the size of the mesh."""
    x, triangles = systems.cloth_grid(60)
    for young in (1e4, 1e7):
        matrix = systems.cloth_matrix(x, triangles, young=young)
        free = np.ones(len(x), dtype=bool)
        lo, hi = System(DEVICE, real("float64"), matrix, free).interval
        smallest, largest = ends(matrix, free)
        assert lo <= smallest and hi >= largest


def test_contacts_do_not_leave_the_interval():
    """D^-1 K with coupled contacts and their blocks on the diagonal stays below max(hi, 1) and above zero."""
    x, triangles = systems.cloth_grid(7)
    matrix, n = systems.cloth_matrix(x, triangles, young=1e5), len(x)
    free = np.ones(n, dtype=bool)
    system = System(DEVICE, real("float64"), matrix, free)
    for pairs in (1, 10, 100):
        for stiffness in (1e-2, 1.0, 1e4):
            contact = CoupledContact(DEVICE, real("float64"), n, free, pairs, stiffness * matrix.diagonal().mean())
            k = sp.kron(matrix, sp.eye_array(3)).toarray() + contact.hessian.toarray()
            d = np.kron(np.diag(matrix.diagonal()), np.eye(3)) + scipy.linalg.block_diag(*contact.blocks)
            eigenvalues = scipy.linalg.eigh(k, d, eigvals_only=True)
            assert eigenvalues[-1] <= max(system.interval[1], 1.0)
            assert eigenvalues[0] > 0.0


def test_nothing_free():
    x, matrix = meshes()["soft cloth"]
    assert System(DEVICE, real("float64"), matrix, np.zeros(len(x), dtype=bool)).interval == (1.0, 1.0)


def test_computed_once_for_a_mesh(monkeypatch):
    """All solvers of a system share the interval, and contacts do not make it anew."""
    x, matrix = meshes()["soft cloth"]
    free = np.ones(len(x), dtype=bool)
    system, measured = System(DEVICE, real("float64"), matrix, free), []
    measure = spectrum.interval
    monkeypatch.setattr(spectrum, "interval", lambda of: measured.append(of) or measure(of))
    b = np.random.default_rng(0).standard_normal((len(x), 3))
    for name in ("chebyshev", "jacobi", "sor", "matrix-powers"):
        solver = make_solver(name, system, max_iterations=8)
        for stiffness in (1.0, 1e4):
            contact = CoupledContact(DEVICE, real("float64"), len(x), free, 5, stiffness * matrix.diagonal().mean())
            solve(solver, 0.0 * b, b, contact)
    assert measured == [system]
    System(DEVICE, real("float64"), 2.0 * matrix, free).interval  # noqa: B018
    assert len(measured) == 2
