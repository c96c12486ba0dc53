"""Every solver against SciPy's direct solution."""

import functools

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import warp as wp

from linear import systems
from linear.contacts import CoupledContact, ScalarContact
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.linear import SOLVERS, System, kernels, make_solver

MESHES = ("regular tets", "jittered Delaunay", "slivers", "soft cloth", "stiff cloth")
meshes = functools.cache(systems.meshes)


def case(mesh, contacts, share, device, precision):
    """System, start, right-hand side, contact object and SciPy's solution; vertices at the lowest x are prescribed."""
    x, matrix = meshes()[mesh]
    n = len(x)
    free = x[:, 0] > 0.02 * x[:, 0].max()
    stiffness = matrix.diagonal().mean()
    contact = None
    if contacts == "scalar" and share:
        vertices = np.random.default_rng(3).choice(n, max(1, int(share * n)), replace=False)
        contact = ScalarContact(device, precision, n, vertices, stiffness)
    elif contacts == "coupled" and share:
        contact = CoupledContact(device, precision, n, free, max(1, int(share * n)), stiffness)
    rng = np.random.default_rng(1)
    start, b = rng.standard_normal((n, 3)), rng.standard_normal((n, 3)) * stiffness
    k = sp.kron(matrix, sp.eye_array(3)).tocsr()
    if contact is not None:
        k = sp.csr_matrix(k + contact.hessian)
    inside = np.repeat(free, 3)
    expected = start.ravel().copy()
    right = b.ravel()[inside] - k[inside][:, ~inside] @ expected[~inside]
    expected[inside] = spla.splu(k[inside][:, inside].tocsc()).solve(right)
    return System(device, precision, matrix, free), start, b, contact, expected.reshape(n, 3)


def solve(solver, start, b, contact=None, captured=True):
    precision, device = solver.real, solver.device
    x = wp.array(start.astype(precision.numpy), dtype=precision.vec3, device=device.warp)
    right = wp.array(b.astype(precision.numpy), dtype=precision.vec3, device=device.warp)
    if captured and solver.recordable:
        graph = device.capture(lambda: solver.solve(x, right, contact))
        graph.launch()
    else:
        solver.solve(x, right, contact)
    return x.numpy()


def error(x, expected):
    return np.linalg.norm(x - expected) / np.linalg.norm(expected)


CONTACTS = [("none", 0.0), ("scalar", 0.01), ("scalar", 0.1), ("coupled", 0.01), ("coupled", 0.1)]


# A-products need a scalar diagonal.
@pytest.mark.parametrize(
    "name,contacts,share", [(n, *c) for n in SOLVERS for c in CONTACTS if (n, c[0]) != ("a-jacobi", "coupled")]
)
def test_against_direct_solution(name, contacts, share):
    """On each mesh the solution is SciPy's, prescribed vertices do not move, and the reported residual says so."""
    device, precision = Device("cpu", threads=1), real("float64")
    for mesh in MESHES:
        system, start, b, contact, expected = case(mesh, contacts, share, device, precision)
        solver = make_solver(name, system, tolerance=1e-9, max_iterations=100_000)
        x = solve(solver, start, b, contact)
        assert np.array_equal(x[~system.free], start[~system.free])
        assert solver.residual.numpy()[0] <= 1e-9
        assert error(x, expected) < 1e-6, mesh
        assert 0 < solver.iterations.numpy()[0] < 100_000


@pytest.mark.parametrize("name", SOLVERS)
def test_single_precision(name):
    """In float32 each solver gets near the solution of a well-conditioned system."""
    system, start, b, _, expected = case("soft cloth", "none", 0.0, Device("cpu", threads=1), real("float32"))
    solver = make_solver(name, system, tolerance=1e-5, max_iterations=2000)
    assert error(solve(solver, start, b), expected) < 1e-4


@pytest.mark.parametrize("name", [name for name in SOLVERS if name != "direct"])
def test_same_bits_for_any_number_of_threads(name):
    """Results do not depend on the number of threads, nor on whether the solve was recorded."""
    x, triangles = systems.cloth_grid(40)
    matrix, n = systems.cloth_matrix(x, triangles, young=1e5), len(x)
    free = np.ones(n, dtype=bool)
    free[:40] = False
    rng = np.random.default_rng(0)
    start, b = rng.standard_normal((n, 3)), rng.standard_normal((n, 3))
    for precision in (real("float64"), real("float32")):
        found = []
        for threads, captured in ((1, True), (1, False), (2, True), (3, True), (3, False)):
            device = Device("cpu", threads=threads)
            contact = None
            if name != "a-jacobi":
                contact = CoupledContact(device, precision, n, free, 30, matrix.diagonal().mean())
            solver = make_solver(name, System(device, precision, matrix, free), tolerance=1e-30, max_iterations=24)
            found.append(solve(solver, start, b, contact, captured))
        for other in found[1:]:
            assert np.array_equal(found[0], other)


def test_iterations_are_capped_and_residual_is_honest():
    """At the cap the residual reported is the one the iterate has."""
    system, start, b, _, _ = case("stiff cloth", "none", 0.0, Device("cpu", threads=1), real("float64"))
    free = system.free
    for name in ("pcg", "two-level"):
        solver = make_solver(name, system, tolerance=1e-12, max_iterations=7)
        x = solve(solver, start, b)
        assert solver.iterations.numpy()[0] == 7

        def squares(y):
            r = (b - system.matrix @ y)[free]
            z = r / system.matrix.diagonal()[free, None]
            return np.sum(r * z)

        if name == "pcg":
            assert solver.residual.numpy()[0] == pytest.approx(np.sqrt(squares(x) / squares(start)), rel=1e-9)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", [name for name in SOLVERS if name != "direct"])
@pytest.mark.parametrize("part", [np.nan, 0.75])
def test_what_is_no_number_is_not_swallowed(name, precision, part):
    """A force that is not a number must reach the solution, where the step notices it, and so must one whose square is none: a
    zero increment would pass for rest.
    """
    system, start, b, _, _ = case("soft cloth", None, 0, Device("cpu"), real(precision))
    force = float(np.finfo(precision).max) ** part
    b[np.argmax(meshes()["soft cloth"][0][:, 0]), 1] = force
    x = solve(make_solver(name, system, tolerance=0.1, max_iterations=3), start, b)
    assert np.isnan(x).any() if np.isnan(part) else not np.abs(x).max() < 1e-6 * force


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("stiffness", [1.0, 1e6, 1e15, 1e20])
def test_blocks_of_stiff_contacts_have_a_positive_inverse(precision, stiffness):
    """Blocks 1 + stiffness n n^T, whose determinant is beyond float32, and in which rounding hides the 1."""
    number = real(precision)
    invert = kernels.functions(number).invert
    for normal in np.random.default_rng(0).standard_normal((50, 3)):
        normal /= np.linalg.norm(normal)
        block = np.eye(3) + stiffness * np.outer(normal, normal)
        inverse = np.array(invert(number.mat33(*block.astype(precision).ravel().tolist())), dtype=np.float64).reshape(3, 3)
        assert np.array_equal(inverse, inverse.T)
        assert np.linalg.eigvalsh(inverse).min() > 0.0
        assert normal @ inverse @ normal == pytest.approx(1.0 / (1.0 + stiffness), rel=0.5)
        if stiffness * np.finfo(precision).eps < 1e-6:
            assert inverse == pytest.approx(np.linalg.inv(block), abs=1e-3)


def test_nothing_to_solve():
    """All vertices prescribed, or a right-hand side that is met already."""
    x, triangles = systems.cloth_grid(5)
    matrix = systems.cloth_matrix(x, triangles)
    device, precision = Device("cpu", threads=1), real("float64")
    for name in SOLVERS:
        solver = make_solver(name, System(device, precision, matrix, np.zeros(25, dtype=bool)))
        assert np.array_equal(solve(solver, x, 0.0 * x), x)
        solver = make_solver(name, System(device, precision, matrix, np.ones(25, dtype=bool)))
        zero = np.zeros_like(x)
        assert np.array_equal(solve(solver, zero, zero), zero)


def test_obstacles_may_have_empty_rows():
    """Vertices without entries in the matrix stay where they are."""
    x, triangles = systems.cloth_grid(6)
    matrix = sp.block_diag([systems.cloth_matrix(x, triangles), sp.csr_matrix((7, 7))]).tocsr()
    free = np.arange(43) < 36
    start, b = np.random.default_rng(0).standard_normal((2, 43, 3))
    b *= matrix.diagonal().max()
    device, precision = Device("cpu", threads=1), real("float64")
    for name in SOLVERS:
        result = solve(
            make_solver(name, System(device, precision, matrix, free), tolerance=1e-10, max_iterations=50000), start, b
        )
        assert np.array_equal(result[36:], start[36:])
        assert error(result[:36], spla.spsolve(matrix[:36, :36].tocsc(), b[:36])) < 1e-7


def test_bad_input_is_refused():
    device, precision = Device("cpu", threads=1), real("float64")
    good = sp.csr_matrix(np.array([[2.0, -1.0], [-1.0, 2.0]]))
    both = np.ones(2, dtype=bool)
    with pytest.raises(ValueError, match=r"not symmetric: entries \(0, 1\) and \(1, 0\)"):
        System(device, precision, sp.csr_matrix(np.array([[2.0, -1.0], [0.0, 2.0]])), both)
    with pytest.raises(ValueError, match=r"free vertex 1 has the diagonal entry 0\.0"):
        System(device, precision, sp.csr_matrix(np.diag([1.0, 0.0])), both)
    with pytest.raises(ValueError, match="must be one of: pcg"):
        make_solver("magic", System(device, precision, good, both))
    with pytest.raises(ValueError, match=r"tolerance is 2\.0"):
        make_solver("pcg", System(device, precision, good, both), tolerance=2.0)
    with pytest.raises(ValueError, match="order"):
        make_solver("pcg", System(device, precision, good, both), order=2)
