"""Exact arithmetic on single motions: it tells apart what is by less than rounding farther, and nearer, than a separation."""

import numpy as np
import pytest

from pdipc.judge.exact import stays_apart_exactly

GAP = 1e-6  # m
STILL = {
    "vertex_triangle": [[0.2, GAP, 0.2], [0, 0, 0], [0, 0, 1], [1, 0, 0]],
    "edge_edge": [[-1, GAP, 0], [1, GAP, 0], [0, 0, -1], [0, 0, 1]],
}


@pytest.mark.parametrize("kind", STILL)
@pytest.mark.parametrize(
    ("separation", "apart"), [(0.0, True), (GAP * (1 - 1e-15), True), (GAP, False), (GAP * (1 + 1e-15), False)]
)
def test_what_rests(kind, separation, apart):
    points = np.array(STILL[kind] * 2, dtype=np.float64)
    assert stays_apart_exactly(points, kind, 1.0, separation) is apart


@pytest.mark.parametrize("kind", STILL)
@pytest.mark.parametrize(("time", "apart"), [(0.5 - 1e-12, True), (0.5, False)])
def test_what_comes_nearer(kind, time, apart):
    """The first primitive falls through the other in the middle of the motion, where it keeps a separation of nothing until then."""
    start, end = np.array(STILL[kind], dtype=np.float64), np.array(STILL[kind], dtype=np.float64)
    first = [0] if kind == "vertex_triangle" else [0, 1]
    end[first, 1] -= 2 * GAP
    assert stays_apart_exactly(np.concatenate([start, end]), kind, time) is apart
    assert stays_apart_exactly(np.concatenate([start, end]), kind, 0.5 + 1e-12) is not True  # it may be undecided


@pytest.mark.parametrize(("separation", "apart"), [(0.5e-3, True), (2e-3, False)])
def test_what_passes_over_between_the_moments_that_are_looked_at_first(separation, apart):
    """A vertex flies over a small triangle, 1 mm above it at three tenths of the way."""
    triangle = [[0, 0, -0.01], [0.01, 0, 0.01], [-0.01, 0, 0.01]]
    points = np.array([[-0.3, 1e-3, 0], *triangle, [0.7, 1e-3, 0], *triangle])
    assert stays_apart_exactly(points, "vertex_triangle", 1.0, separation) is apart
