"""The mathematics of single pairs: barrier, mollifier, friction, restitution. From Python, but for what has matrices of 4x3."""

import numpy as np
import pytest
import warp as wp

from pdipc.barrier import exact, friction, pairs, potential, restitution
from pdipc.collision import distance

D_HAT, STEP = 0.01, 1e-6


def wide(f):
    """Called with, and returning, Python's numbers, in double precision."""

    def called(*numbers):
        found = f(*(wp.float64(number) if isinstance(number, float) else number for number in numbers))
        return tuple(map(float, found)) if isinstance(found, tuple) else float(found)

    return called


barrier, gradient, hessian = (wide(f) for f in (potential.barrier, potential.barrier_gradient, potential.barrier_hessian))
extended, coulomb = wide(potential.extended_gradient), wide(potential.smoothed_coulomb)
slopes, dissipation, parting = wide(exact.slopes), wide(friction.dissipation), wide(restitution.parting)


MAT43 = wp.types.matrix((4, 3), wp.float64)
module = wp.get_module(__name__)
module.options["enable_backward"] = False


@wp.kernel(module=module)
def bend(
    a: wp.vec4d,
    n: wp.vec3d,
    edges: bool,
    x: wp.array(dtype=wp.vec3d),
    size_out: wp.array(dtype=wp.float64),
    q_out: wp.array(dtype=MAT43),
    apart_out: wp.array(dtype=wp.int32),
):
    size, first, second, apart = exact.bending(a, edges, x[1] - x[0], x[2] - x[0], x[3] - x[0], exact.outer(a, n))
    size_out[0] = size
    q_out[0] = first
    q_out[1] = second
    apart_out[0] = int(apart)


@wp.kernel(module=module)
def mollify(
    numbers: wp.vec3d,
    g1: wp.vec3d,
    g2: wp.vec3d,
    along: MAT43,
    numbers_out: wp.array(dtype=wp.float64),
    matrices_out: wp.array(dtype=MAT43),
):
    fading, turn, lever, hessian = exact.mollified(numbers[0], numbers[1], numbers[2], g1, g2, along)
    numbers_out[0] = fading
    numbers_out[1] = hessian
    matrices_out[0] = turn
    matrices_out[1] = lever


def launched(kernel, inputs, *dtypes):
    """What one thread writes: an array of two for each type."""
    out = [wp.zeros(2, dtype=dtype, device="cpu") for dtype in dtypes]
    wp.launch(kernel, 1, [*inputs, *out], device="cpu")
    return [array.numpy() for array in out]


def slope(f, at, step=STEP):
    return (f(at + step) - f(at - step)) / (2 * step)


@pytest.mark.parametrize("d", [0.05, 0.3, 0.7, 0.99])
def test_the_barriers_derivatives(d):
    d, step = d * D_HAT, 1e-7
    assert gradient(d, D_HAT) == pytest.approx(slope(lambda d: barrier(d, D_HAT), d, step), rel=1e-4)
    expected = slope(lambda d: gradient(d, D_HAT), d, step)
    assert hessian(d, D_HAT) == pytest.approx(expected, rel=1e-5)
    assert extended(d, 0.5 * d, D_HAT) == gradient(d, D_HAT)
    below = [extended(part * d, d, D_HAT) for part in (1.0, 0.5, 0.0, -0.5)]
    np.testing.assert_allclose(np.diff(below, 2), 0.0, atol=1e-9 * abs(below[0]))  # a straight line, also past contact


def test_slopes_of_what_is_foreseen_are_those_of_a_tangent():
    assert slopes(0.2 * D_HAT, D_HAT) == (
        gradient(0.2 * D_HAT, D_HAT),
        hessian(0.2 * D_HAT, D_HAT),
    )
    at = potential.FORESEEN * D_HAT
    for gap in (0.6 * D_HAT, 3.0 * D_HAT):
        first, second = slopes(-gap, D_HAT)
        assert second == hessian(at, D_HAT)
        assert first + second * (at - gap) == pytest.approx(gradient(at, D_HAT), rel=1e-12)


@pytest.mark.parametrize(
    ("points", "edges", "free"),
    [
        ([[0.2, 0.3, 0.1], [0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.1, 0.9, 0.05]], False, 2),  # over a triangle
        ([[0.4, -0.3, 0.1], [0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.1, 0.9, 0.05]], False, 1),  # beside an edge of it
        ([[-0.4, -0.3, 0.1], [0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.1, 0.9, 0.05]], False, 0),  # beside a corner
        ([[-0.5, 0.0, 0.0], [0.5, 0.1, 0.02], [0.05, 0.1, -0.4], [-0.1, 0.15, 0.6]], True, 2),  # across each other
        ([[-0.5, 0.0, 0.0], [0.5, 0.1, 0.02], [0.05, 0.1, 0.4], [-0.1, 0.15, 0.9]], True, 1),  # an end beside an edge
    ],
)
def test_what_turns_the_normal_and_moves_the_witness_points(points, edges, free):
    """|r| hess d = a a^T (I - n n^T) - sum q q^T, against differences of the distance."""
    x = np.array(points)
    of = distance.edge_edge_weights if edges else distance.vertex_triangle_weights
    a = np.array(of(*(wp.vec3d(*p) for p in x)))
    directions = np.stack(exact.free_directions(wp.vec4d(*a), edges))
    directions = directions[directions.any(axis=1)]
    assert len(directions) == free

    def distance_of(x):
        """With witness points that move along the same edges and triangles."""
        r, tangents = a @ x, directions @ x
        return np.linalg.norm(r - (tangents.T @ np.linalg.lstsq(tangents.T, r, rcond=None)[0] if free else 0.0))

    r = a @ x
    r -= (directions @ x).T @ np.linalg.lstsq((directions @ x).T, r, rcond=None)[0] if free else 0.0
    n = r / np.linalg.norm(r)
    inputs = [wp.vec4d(*a), wp.vec3d(*n), edges, wp.array(x, dtype=wp.vec3d, device="cpu")]
    size, q, apart = launched(bend, inputs, wp.float64, MAT43, wp.int32)
    size, q = size[0], q.reshape(2, 12)
    assert apart[0] and size == pytest.approx(distance_of(x)) and sum(bool(each.any()) for each in q) == free
    found = np.einsum("s,t,ij->sitj", a, a, np.eye(3) - np.outer(n, n)).reshape(12, 12) - sum(
        np.outer(each, each) for each in q
    )
    step, expected = 1e-4, np.zeros((12, 12))
    moves = step * np.eye(12).reshape(12, 4, 3)
    for i in range(12):
        for j in range(12):
            signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
            expected[i, j] = sum(b * c * distance_of(x + b * moves[i] + c * moves[j]) for b, c in signs) / (4 * step**2)
    np.testing.assert_allclose(found / size, expected, atol=1e-5 * np.abs(expected).max())


def test_the_mollified_barriers_hessian_keeps_what_is_positive():
    """As a function of the distance and c it has one positive eigenvalue; the direction is in the span of the two gradients."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        gap, c = rng.uniform(0.05, 0.95) * D_HAT, rng.uniform(0.02, 0.98)
        along, g1, g2 = rng.standard_normal((4, 3)), rng.standard_normal(3), rng.standard_normal(3)
        inputs = [wp.vec3d(gap, D_HAT, c), wp.vec3d(*g1), wp.vec3d(*g2), MAT43(*along.ravel())]
        (fading, curvature), (turn, lever) = launched(mollify, inputs, wp.float64, MAT43)
        np.testing.assert_array_equal(turn, [-g1, g1, -g2, g2])
        value = lambda d, c: c * (2 - c) * barrier(d, D_HAT)  # noqa: E731
        assert fading == pytest.approx(slope(lambda c: value(gap, c), c), rel=1e-6)
        b0, b1, b2 = (f(gap, D_HAT) for f in (barrier, gradient, hessian))
        second = np.array([[c * (2 - c) * b2, (2 - 2 * c) * b1], [(2 - 2 * c) * b1, -2 * b0]])
        jacobian = np.stack([along.ravel(), turn.ravel()])
        values, vectors = np.linalg.eigh(jacobian.T @ second @ jacobian)
        j = lever.ravel()
        positive = vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T
        np.testing.assert_allclose(curvature * np.outer(j, j), positive, atol=1e-8 * np.abs(positive).max())


@pytest.mark.parametrize("slip", [0.1, 0.6, 1.0, 3.0])
def test_friction_is_the_slope_of_what_is_dissipated(slip):
    threshold = 2.0
    slip *= threshold
    length, rising = dissipation(slip, threshold)
    assert slope(lambda s: dissipation(s, threshold)[0], slip) == pytest.approx(slip * coulomb(slip, threshold), rel=1e-5)
    assert rising / threshold == pytest.approx(slope(lambda s: s * coulomb(s, threshold), slip), rel=1e-5, abs=1e-6)
    assert length == pytest.approx(slip) or slip < threshold


@pytest.mark.parametrize(("a", "b", "expected"), [(2.0, 4.0, 3.0), (2.0, 0.0, 2.0), (0.0, 4.0, 4.0), (0.0, 0.0, 0.0)])
def test_a_pair_is_as_stiff_as_its_sides_but_for_what_is_kinematic(a, b, expected):
    assert pairs.pair_stiffness(a, b, 1.0) == expected
    assert pairs.pair_stiffness(a, b, 0.25) == 0.25 * expected
    assert restitution.lighter(a, b) == (min(a, b) or max(a, b))


def test_what_restitution_aims_at():
    soft, rigid = 0.0, 1.0
    for eps in (0.0, 0.5, 1.0):
        # approached: a rigid pair leaves as fast as it came, times eps; of a soft one the motion that contact made of it, times eps
        assert parting(-1.0, 0.2, rigid, eps) == (eps, True)
        assert parting(-1.0, 0.2, soft, eps) == (eps * 0.2, True)
        # parted before: what contact added is kept in part where bodies are soft, not where they are rigid
        assert parting(0.1, 0.3, rigid, eps) == (0.1, True)
        assert parting(0.1, 0.3, soft, eps) == (pytest.approx(0.1 + eps * 0.2), True)
    assert not parting(0.3, 0.1, rigid, 1.0)[1]  # slower than it came: nothing to correct
