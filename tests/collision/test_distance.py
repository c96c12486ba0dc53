"""Closest points and distances against exact arithmetic."""

import math

import numpy as np
import pytest
import warp as wp

from collision import exact, hard_queries
from pdipc.collision import distance
from pdipc.device.precision import real as real_of

PRECISIONS = ("float64", "float32")
KINDS = ("vertex_triangle", "edge_edge")


def measure(points: np.ndarray, kind: str, precision: str):
    """(distances (n,), weights (n, 4)) of points (n, 4, 3)."""
    real = real_of(precision)
    distance_of, weights_of = getattr(distance, f"{kind}_distance"), getattr(distance, f"{kind}_weights")

    @wp.kernel(module=real.module(f"{__name__}.{kind}"))
    def kernel(
        x: wp.array(dtype=real.vec3, ndim=2), distance_out: wp.array(dtype=real.scalar), weights_out: wp.array(dtype=real.vec4)
    ):
        i = wp.tid()
        distance_out[i] = real.scalar(distance_of(x[i, 0], x[i, 1], x[i, 2], x[i, 3]))
        weights_out[i] = real.vec4(weights_of(x[i, 0], x[i, 1], x[i, 2], x[i, 3]))

    x = wp.array(points, dtype=real.vec3, ndim=2, device="cpu")
    distances = wp.zeros(len(points), dtype=real.scalar, device="cpu")
    weights = wp.zeros(len(points), dtype=real.vec4, device="cpu")
    wp.launch(kernel, len(points), [x, distances, weights], device="cpu")
    return distances.numpy().astype(float), weights.numpy().astype(float)


FAMILIES = hard_queries.FAMILIES + hard_queries.CULLING[:-1]  # the last has squares that overflow
TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("vertex", "weights", "squared"),
    [
        ([0.25, 0.25, 2], [0.5, 0.25, 0.25], 4),  # inside
        ([-1, -1, 1], [1, 0, 0], 3),  # the three corners
        ([3, -1, 0], [0, 1, 0], 5),
        ([0, 3, 1], [0, 0, 1], 5),
        ([0.25, -2, 0], [0.75, 0.25, 0], 4),  # the three sides
        ([-1, 0.5, 1], [0.5, 0, 0.5], 2),
        ([1, 1, 0], [0, 0.5, 0.5], 0.5),
    ],
)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_regions_of_a_triangle(vertex, weights, squared, precision):
    d, w = measure(np.array([[vertex, *TRIANGLE]], dtype=float), "vertex_triangle", precision)
    assert d[0] == pytest.approx(math.sqrt(squared), rel=1e-6)
    assert w[0] == pytest.approx([1, *(-np.array(weights))], abs=1e-6)


@pytest.mark.parametrize(
    ("other", "weights", "squared"),
    [
        ([[0.5, -1, 1], [0.5, 1, 1]], [0.5, 0.5, -0.5, -0.5], 1),  # both inside
        ([[0.5, 1, 0], [0.5, 2, 0]], [0.5, 0.5, -1, 0], 1),  # an end of b
        ([[0.5, 2, 0], [0.5, 1, 0]], [0.5, 0.5, 0, -1], 1),
        ([[-1, 1, 1], [-1, -1, 1]], [1, 0, -0.5, -0.5], 2),  # an end of a
        ([[2, -1, 0], [2, 3, 0]], [0, 1, -0.75, -0.25], 1),
        ([[-1, 1, 0], [-1, 2, 0]], [1, 0, -1, 0], 2),  # two ends
        ([[3, 0, 0], [2, 0, 0]], [0, 1, 0, -1], 1),
        ([[-2, 0, 0], [-3, 0, 0]], [1, 0, -1, 0], 4),
    ],
)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_regions_of_two_edges(other, weights, squared, precision):
    d, w = measure(np.array([[[0, 0, 0], [1, 0, 0], *other]], dtype=float), "edge_edge", precision)
    assert d[0] == pytest.approx(math.sqrt(squared), rel=1e-6)
    assert w[0] == pytest.approx(weights, abs=1e-6)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_distance_is_never_too_large(kind, precision):
    """The bound of the docstring, on hard pairs: near-parallel, slivers, degenerate, coplanar, far from the origin."""
    rounding = 8 * real_of(precision).unit_roundoff
    for k, family in enumerate(FAMILIES):
        points = family(np.random.default_rng(k), 40).astype(precision).astype(float)
        d, w = measure(points[:, :4], kind, precision)
        true = np.array([math.sqrt(exact.distance_squared(x, kind, 0.0)) for x in points])
        size = np.abs(points[:, 1:4] - points[:, :1]).max(axis=(1, 2))
        bound = np.maximum(rounding, distance.OVERESTIMATE) * size
        assert (d <= true + bound).all(), family.__name__
        assert (d >= true - rounding * size).all(), family.__name__
        # the weights are of points on the primitives, and of the same pair of points
        first = 1 if kind == "vertex_triangle" else 2
        assert w[:, :first].sum(axis=1) == pytest.approx(1, abs=rounding) and w[:, first:].sum(axis=1) == pytest.approx(
            -1, abs=rounding
        )
        assert (w[:, :first] >= 0).all() and (w[:, first:] <= 0).all()
        r = np.einsum("ni,nij->nj", w[:, 1:], points[:, 1:4] - points[:, :1])
        assert (np.abs(np.linalg.norm(r, axis=1) - d) <= 4 * rounding * size).all(), family.__name__


@pytest.mark.parametrize("precision", PRECISIONS)
def test_near_parallel_edges(precision):
    """Edges that cross at angles of 1e-1 to 1e-16, a micrometre apart."""
    rng = np.random.default_rng(0)
    n = 300
    angle, middle = 10.0 ** rng.uniform(-16, -1, n), rng.uniform(-0.5, 0.5, n)
    points = np.zeros((n, 4, 3))
    points[:, :2, 0] = points[:, 2:, 0] = [-1, 1]
    points[:, 2:, 1] = (np.array([-1, 1]) - middle[:, None]) * angle[:, None]
    points[:, 2:, 2] = 1e-6
    points = (points @ np.linalg.qr(rng.normal(size=(3, 3)))[0]).astype(precision).astype(float)
    d, _ = measure(points, "edge_edge", precision)
    true = np.array([math.sqrt(exact.distance_squared(np.tile(x, (2, 1)), "edge_edge", 0.0)) for x in points])
    assert (d <= true * (1 + 8 * real_of(precision).unit_roundoff) + 2 * distance.OVERESTIMATE).all()
    assert (d >= true * (1 - 8 * real_of(precision).unit_roundoff) - 4e-16).all()
