"""Whatever says "cannot meet" is right about it: judged in exact arithmetic, on pairs at the edge of what may be left out.

`benchmarks/rejections.py` asks about ten million more, each.
"""

import numpy as np
import pytest

from collision import hard_queries, rejections
from pdipc.collision import candidates, sieve
from pdipc.judge import witness

FAMILIES = hard_queries.FAMILIES + hard_queries.CULLING


def left_out(ask, families, kind, precision, n):
    """(pairs left out, those that are wrong) by family name."""
    found = {}
    for k, family in enumerate(families):
        points, reach = rejections.pairs(family, kind, precision, n, np.random.default_rng(k))
        rejected = ask(points, kind, precision, reach)
        found[family.__name__] = (int(rejected.sum()), len(rejections.wrong(points, kind, reach, rejected)))
    return found


@pytest.mark.parametrize("precision", rejections.PRECISIONS)
@pytest.mark.parametrize("kind", rejections.KINDS)
@pytest.mark.parametrize("name", rejections.REJECTIONS)
def test_what_is_left_out_stays_apart(name, kind, precision):
    found = left_out(rejections.REJECTIONS[name], FAMILIES, kind, precision, 60)
    assert {family: bad for family, (_, bad) in found.items() if bad} == {}
    assert sum(count for count, _ in found.values()) > 100  # of 1260


@pytest.mark.parametrize("kind", rejections.KINDS)
def test_the_sieve_needs_its_slack(kind, monkeypatch):
    """Pairs come as near as its bound of rounding: were rounding as large, it would leave out some that are too near."""
    close = (hard_queries.at_rest, hard_queries.needles, hard_queries.stacked_sheets, hard_queries.touching)
    assert sum(bad for _, bad in left_out(rejections.by_sieve, close, kind, "float64", 4000).values()) == 0
    monkeypatch.setattr(sieve, "SLACK", -sieve.SLACK)
    monkeypatch.setattr(sieve, "ENOUGH", 1.0 + sieve.SLACK)
    with fresh():
        assert sum(bad for _, bad in left_out(rejections.by_sieve, close, kind, "float64", 4000).values()) > 0


class fresh:
    """Kernels with the constants of now, and after it those of before."""

    def __enter__(self):
        self.clear()

    def __exit__(self, *_):
        self.clear()

    def clear(self):
        for made in (sieve.functions, rejections.kernels):
            made.cache_clear()


@pytest.mark.parametrize("method", ("patches", "bvh"))
@pytest.mark.parametrize("precision", rejections.PRECISIONS)
def test_whole_lists(method, precision):
    """Trees, patches, boxes and sieve together."""
    count = 0
    for k, family in enumerate(FAMILIES):
        *mesh, reach = rejections.soup(family, precision, np.random.default_rng(k), 5)
        for kind, (points, _) in zip(rejections.KINDS, rejections.unlisted(*mesh, reach, precision, method), strict=True):
            everyone = np.ones(len(points), dtype=bool)
            assert not len(rejections.wrong(points, kind, np.full(len(points), reach), everyone)), family.__name__
            count += len(points)
    assert count > 3000


@pytest.mark.parametrize("precision", rejections.PRECISIONS)
def test_far_beyond_what_boxes_can_tell_apart(precision):
    """At 1e19 m and at the largest numbers there are: whatever touches is listed, and nothing breaks."""
    most = float(np.finfo(precision).max)
    for scale in (1e19, 0.4 * most):
        x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [0.7, 0.9, 1]]) * scale
        for method in ("patches", "bvh"):
            _, vertex_triangle, edge_edge = rejections.lists(x, -x, np.array([[0, 1, 2], [3, 4, 5]]), 0.0, precision, method)
            assert len(vertex_triangle) + len(edge_edge) > 0
            (points, _), (others, _) = rejections.unlisted(x, -x, np.array([[0, 1, 2], [3, 4, 5]]), 0.0, precision, method)
            for kind, left in zip(rejections.KINDS, (points, others), strict=True):
                assert not len(rejections.wrong(left, kind, np.zeros(len(left)), np.ones(len(left), dtype=bool)))


@pytest.mark.parametrize("precision", rejections.PRECISIONS)
def test_what_counts_as_near_is_near(precision):
    """A list that is used again was made for vertices within the margin, but for the rounding that its reach has room for."""
    x, y, margin = rejections.strays(precision, 20_000, np.random.default_rng(0))
    near = rejections.is_near(x, y, margin, precision)
    assert 0.2 < near.mean() < 0.9
    assert not len(rejections.not_near(x, y, margin, near))
    assert len(rejections.not_near(x, y, margin, np.ones(len(x), dtype=bool))) > 100  # the judge has eyes
    assert not near[margin <= candidates.LEAST_MARGIN].any()


@pytest.mark.parametrize("precision", rejections.PRECISIONS)
def test_the_witness_is_right_about_segments_and_triangles(precision, monkeypatch):
    """What it decides in floating point as well: its judge sees where it errs."""
    points = np.concatenate(
        [rejections.segments(family, precision, np.random.default_rng(k), 60) for k, family in enumerate(FAMILIES)]
    )
    said = rejections.crossing(points)
    assert 0.1 < said.mean() < 0.9
    assert not len(rejections.wrongly_crossing(points, said))
    exactly = np.array([witness.segment_meets_triangle(*five) for five in points])
    np.testing.assert_array_equal(
        rejections.wrongly_crossing(points, np.zeros(len(points), dtype=bool)), np.flatnonzero(exactly)
    )
    np.testing.assert_array_equal(
        rejections.wrongly_crossing(points, np.ones(len(points), dtype=bool)), np.flatnonzero(~exactly)
    )
    monkeypatch.setattr(witness, "ORIENT3D_ERROR", 0.0)
    assert len(rejections.wrongly_crossing(points, rejections.crossing(points)))
