"""A-Jacobi in both forms: aggregation changes the cost of a sweep, not its result."""

import numpy as np
import pytest
import scipy.sparse as sp

from linear import systems
from linear.contacts import CoupledContact
from linear.test_solvers import MESHES, case, error, solve
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.drive import Work, step
from pdipc.linear import System, make_solver
from pdipc.linear.paper.a_jacobi import AJacobi, aggregate
from pdipc.model import build
from pdipc.scene.errors import SceneError

DEVICE, PRECISION = Device("cpu", threads=1), real("float64")


def sweeps(system, start, b, contact, count, weight):
    """`count` sweeps of weighted Jacobi, by NumPy."""
    a = system.matrix
    diagonal = a.diagonal() + (contact.values if contact else 0.0)
    x = start.copy()
    for _ in range(count):
        r = b - a @ x - (contact.values[:, None] * x if contact else 0.0)
        x[system.free] += weight * (r / np.where(diagonal > 0, diagonal, 1.0)[:, None])[system.free]
    return x


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_order_l_is_l_sweeps(order, grouped):
    """Two iterations of order l are 2 l sweeps of Jacobi to rounding, with contacts on the diagonal (Eqs. 11 to 14)."""
    for mesh in ("regular tets", "jittered Delaunay", "stiff cloth"):
        system, start, b, contact, _ = case(mesh, "scalar", 0.1, DEVICE, PRECISION)
        for weight in (None, 1.0):
            solver = make_solver(
                "a-jacobi",
                system,
                order=order,
                accelerated=False,
                grouped=grouped,
                weight=weight,
                tolerance=0.0,
                max_iterations=2,
            )
            lo, hi = system.interval
            expected = sweeps(system, start, b, contact, 2 * order, weight or 2.0 / (lo + hi))
            assert error(solve(solver, start, b, contact), expected) < 1e-12


@pytest.mark.parametrize("order", [1, 2, 3])
def test_matrix_powers_are_sweeps_of_chebyshev(order):
    """Sweeps inside groups give what sweeps over everything give, with 3x3 blocks of contacts too."""
    for mesh in MESHES:
        system, start, b, _, _ = case(mesh, "none", 0.0, DEVICE, PRECISION)
        contact = CoupledContact(DEVICE, PRECISION, system.count, system.free, 20, system.matrix.diagonal().mean())
        contact.apply = None
        # Only the blocks: both solvers see K = A + blocks.
        powers = make_solver("matrix-powers", system, order=order, group=50, tolerance=0.0, max_iterations=4)
        plain = make_solver("chebyshev", system, tolerance=0.0, max_iterations=4 * order)
        assert error(solve(powers, start, b, contact), solve(plain, start, b, contact)) < 1e-12


def test_plain_jacobi_diverges_where_weighted_converges():
    """On a jittered Delaunay mesh the largest eigenvalue of D^-1 A is above 2."""
    x, tets = systems.tet_delaunay(343)
    system = System(DEVICE, PRECISION, systems.tet_matrix(x, tets), np.ones(len(x), dtype=bool))
    assert system.interval[1] > 2.2
    b = np.random.default_rng(0).standard_normal((len(x), 3))
    start = np.zeros_like(b)

    def residual(weight):
        solver = make_solver("jacobi", system, weight=weight, tolerance=0.0, max_iterations=200)
        x = solve(solver, start, b)
        return np.linalg.norm(b - system.matrix @ x) / np.linalg.norm(b)

    assert residual(1.0) > 1e6
    assert residual(None) < 0.5


def test_aggregated_chebyshev_needs_as_many_sweeps_as_chebyshev():
    """With T_l instead of R^l nothing is lost: 1/l of the iterations (and for l = 2 neither with R^2)."""
    system, start, b, _, expected = case("jittered Delaunay", "none", 0.0, DEVICE, PRECISION)

    def iterations(name, **options):
        for count in range(4, 2000, 4):
            solver = make_solver(name, system, tolerance=0.0, max_iterations=count, **options)
            if error(solve(solver, start, b), expected) < 1e-3:
                return count
        return 2000

    sweeps = iterations("chebyshev")
    assert iterations("a-jacobi", order=2) <= sweeps / 2 + 4
    assert iterations("a-jacobi", order=2, polynomial="chebyshev") <= sweeps / 2 + 4
    lossless = iterations("a-jacobi", order=3, polynomial="chebyshev")
    assert lossless <= sweeps / 3 + 4
    assert iterations("a-jacobi", order=3) >= 1.3 * lossless


@pytest.mark.parametrize("kind", ["power", "chebyshev"])
@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_polynomials(kind, order):
    """p(1) = 1, which keeps the solution fixed, and p stays within the interval it claims."""
    weight, rho = 0.8, 0.95
    coefficients, low, high = aggregate(kind, order, weight, rho)
    assert np.sum(coefficients) == pytest.approx(1.0, abs=1e-12)
    g = 1.0 - (1.0 - np.linspace(-rho, rho, 1001)) / weight
    p = np.polynomial.Polynomial(coefficients)(g)
    assert np.all((p >= low - 1e-12) & (p <= high + 1e-12))
    assert max(abs(low), abs(high)) <= rho + 1e-12


def test_sparsity_suppression():
    """Leaving out products of bending with bending (Eq. 16) costs paths and changes the solution by a little."""
    x, triangles = systems.cloth_grid(18)
    stretch, bend = systems.cloth_parts(x, triangles, young=1e6)
    system = System(DEVICE, PRECISION, stretch + bend, np.ones(len(x), dtype=bool))
    b = np.random.default_rng(0).standard_normal((len(x), 3))
    start = np.zeros_like(b)
    expected = solve(make_solver("direct", system), start, b)
    options = {"order": 2, "tolerance": 1e-10, "max_iterations": 20000}
    exact = make_solver("a-jacobi", system, **options)
    split = make_solver("a-jacobi", system, split=(stretch, bend), **options)
    assert exact.dropped == 0.0
    assert error(solve(exact, start, b), expected) < 1e-7
    assert len(split.products.rows) < len(exact.products.rows)
    assert 0.0 < split.dropped < 1e-4
    assert 1e-12 < error(solve(split, start, b), expected) < 0.05
    sizes, errors = [], []
    for drop in (1e-4, 1e-3, 1e-2):
        solver = make_solver("a-jacobi", system, drop=drop, **options)
        sizes.append(solver.products.paths)
        errors.append(solver.dropped)
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < exact.products.paths
    assert errors == sorted(errors) and errors[-1] > 0.0


def test_a_products_are_paths():
    """The number of A-products of order l is the number of paths of up to l edges, and their sums are powers of B."""
    x, tets = systems.tet_grid(4)
    system = System(DEVICE, PRECISION, systems.tet_matrix(x, tets), np.ones(len(x), dtype=bool))
    solver = make_solver("a-jacobi", system, order=3, weight=1.0, accelerated=False)
    b = sp.csr_matrix(sp.diags_array(system.matrix.diagonal()) - system.matrix)
    b.eliminate_zeros()
    edges = (b != 0).astype(int)
    # w = 1: R = G, and of R^3 only the paths of three edges have coefficients that are not zero.
    assert solver.products.paths == (edges @ edges @ edges).sum()
    inverse = np.append(1.0 / system.matrix.diagonal(), 1.0)
    p = solver.products
    scaled = p.products * np.prod(inverse[p.between], axis=1)
    entry = np.repeat(np.arange(len(p.rows)), np.diff(p.starts))
    summed = sp.csr_matrix((np.bincount(entry, scaled) * inverse[p.rows], (p.rows, p.columns)), shape=b.shape)
    g = sp.diags_array(inverse[:-1]) @ b
    assert abs(summed - g @ g @ g).max() < 1e-14


def test_refusals():
    system, start, b, contact, _ = case("regular tets", "coupled", 0.1, DEVICE, PRECISION)
    with pytest.raises(ValueError, match="scalar contacts only"):
        solve(make_solver("a-jacobi", system), start, b, contact)
    with pytest.raises(ValueError, match="A-products of order 3 need"):
        make_solver("a-jacobi", system, order=3, memory_limit=1e6)
    with pytest.raises(ValueError, match='polynomial is "taylor"'):
        make_solver("a-jacobi", system, polynomial="taylor")
    with pytest.raises(ValueError, match="order is 0"):
        make_solver("matrix-powers", system, order=0)
    with pytest.raises(ValueError, match="diverge"):
        make_solver("chebyshev", case("jittered Delaunay", "none", 0.0, DEVICE, PRECISION)[0], weight=1.0)


def test_drop_in_a_scene():
    """The option reaches the solver, what it left out is reported, and other solvers refuse it."""
    from physics.scenes import cloth, scene

    def built(**simulation):
        return build(scene([cloth("sheet", [0.4, 0.4], [7, 7])], contact={"method": "paper"}, **simulation), "cpu").solver

    whole, thinned = built(), built(solver_drop=1e-2)
    assert whole.dropped == 0.0
    assert 0.0 < thinned.dropped < 0.2
    assert thinned.products.paths < whole.products.paths
    with pytest.raises(SceneError, match=r'only a-jacobi has A-products; the solver is "pcg"'):
        built(solver_drop=1e-2, linear_solver="pcg")


def test_coefficients_are_made_once_in_an_outer_iteration(monkeypatch):
    """The diagonal changes with the barriers only: all local-global iterations between share the A-coefficients (Appendix A)."""
    from physics.scenes import floor, scene, solid

    body = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 0.125, 0), rotation=(5, 0, 8), velocity=(0, -2, 0))
    contact = {"method": "paper", "activation_distance": 2e-3, "minimum_separation": 1e-4}
    model = build(scene([body], [floor()], contact=contact), "cpu")
    prepared, prepare = [], AJacobi.prepare
    monkeypatch.setattr(AJacobi, "prepare", lambda self, of: prepared.append(of) or prepare(self, of))
    work, state, outer, inner, barriers = Work(model, recorded=False), model.initial_state(), 0, 0, 0
    for _ in range(8):
        result = step(model, state, work)
        state, outer, inner = result.state, outer + result.outer, inner + result.local_global
        barriers = max(barriers, result.barriers)
    assert barriers > 0
    assert len(prepared) == outer < inner
