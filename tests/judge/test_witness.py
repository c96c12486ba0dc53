"""The witness against fractions, against ipctk, and on the cases where floating point is in doubt."""

import itertools
import tracemalloc
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdipc.judge.witness import Watch, find_intersections, segment_meets_triangle
from pdipc.scene import generators
from pdipc.scene.motion import rotation_matrix

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def meets(*other) -> bool:
    """Whether TRIANGLE meets another triangle that shares no vertex with it."""
    positions = np.concatenate([TRIANGLE, np.array(other, dtype=float)])
    return len(find_intersections(positions, np.array([[0, 1, 2], [3, 4, 5]]))) == 1


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ([[0.2, 0.2, -1], [0.2, 0.2, 1], [2, 2, 0]], True),  # pierces
        ([[0.2, 0.2, 1e-300], [0.3, 0.2, 1], [0.2, 0.3, 1]], False),  # just above
        ([[0.2, 0.2, 0], [0.3, 0.2, 1], [0.2, 0.3, 1]], True),  # a vertex on the face
        ([[0.5, 0.5, -1], [0.5, 0.5, 1], [2, 2, 0]], True),  # an edge through an edge
        ([[0.5, np.nextafter(0.5, 1), -1], [0.5, np.nextafter(0.5, 1), 1], [2, 2, 0]], False),  # past it by one ulp
        ([[0.0, 0, 0], [-1, 0, 1], [0, -1, 1]], True),  # vertex on vertex
        ([[0.1, 0.1, 0], [0.2, 0.1, 0], [0.1, 0.2, 0]], True),  # coplanar, inside
        ([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]], True),  # coplanar, around
        ([[0.5, -1, 0], [0.6, -1, 0], [0.5, 2, 0]], True),  # coplanar, across
        ([[1.0, 0, 0], [2, 0, 0], [1, 1, 0]], True),  # coplanar, corner on corner
        ([[1.0, 1, 0], [2, 1, 0], [1, 2, 0]], False),  # coplanar, apart while boxes touch
        ([[0.51, 0.51, 0], [1, 0.6, 0], [0.6, 1, 0]], False),  # coplanar, apart while boxes overlap
        ([[0.2, 0.2, 0], [0.2, 0.2, 0], [0.2, 0.2, 0]], True),  # a point on it
        ([[0.2, 0.2, -1], [0.2, 0.2, 1], [0.2, 0.2, 2]], True),  # a segment through it
        ([[2.0, 2, -1], [2, 2, 1], [2, 2, 2]], False),  # a segment beside it
    ],
)
def test_two_triangles(other, expected):
    assert meets(*other) == expected
    for turned in itertools.permutations(other):
        assert meets(*turned) == expected


def test_no_area_against_no_area():
    segment = np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [2, 0, 1], [0, 2, 1], [1, 1, 1]])
    both = np.array([[0, 1, 2], [3, 4, 5]])
    assert len(find_intersections(segment, both)) == 1
    segment[3:] += [0, 0, 1e-12]
    assert len(find_intersections(segment, both)) == 0


def test_shared_vertex_counts_only_away_from_it():
    fan = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1], [1, 1, -1], [-1, -1, 1], [-1, -1, -1]], dtype=float)
    assert find_intersections(fan, [[0, 1, 2], [0, 5, 6]]).tolist() == []
    assert find_intersections(fan, [[0, 1, 2], [0, 3, 4]]).tolist() == [[0, 1]]


def test_shared_edge_counts_only_when_folded_flat():
    def fold(degrees: float) -> int:
        tip = rotation_matrix((degrees, 0, 0)) @ [0.4, 1, 0]
        return len(find_intersections(np.vstack([TRIANGLE, tip]), [[0, 1, 2], [1, 0, 3]]))

    assert [fold(0), fold(1e-9), fold(90), fold(180)] == [1, 0, 0, 0]


def test_a_triangle_given_twice_is_reported():
    assert find_intersections(TRIANGLE, [[0, 1, 2], [0, 2, 1]]).tolist() == [[0, 1]]


@pytest.mark.parametrize("rotation", [(0, 0, 0), (45, 0, 0), (10, 20, 30)])
@pytest.mark.parametrize("shape", [generators.Grid(), generators.Box(), generators.Sphere(), generators.Torus()])
def test_clean_shapes_are_clean(shape, rotation):
    mesh = shape.mesh().surface()
    assert len(find_intersections(mesh.vertices @ rotation_matrix(rotation).T, mesh.triangles)) == 0


def test_cloth_through_itself_counts_every_pair():
    sheet = generators.Grid(cells=(5, 5)).mesh()
    upright = sheet.vertices @ rotation_matrix((90, 0, 0)).T + [0.01, 0.013, 0.017]
    triangles = np.concatenate([sheet.triangles, sheet.triangles + len(upright)])
    positions = np.concatenate([sheet.vertices, upright])
    pairs = find_intersections(positions, triangles)
    expected = [
        (i, j)
        for i in range(len(sheet.triangles))
        for j in range(len(sheet.triangles), len(triangles))
        if brute_force(positions[triangles[i]], positions[triangles[j]])
    ]
    assert pairs.tolist() == [list(pair) for pair in expected]
    assert len(pairs) > 10


def brute_force(a: np.ndarray, b: np.ndarray) -> bool:
    return any(segment_meets_triangle(one[k], one[k - 1], *other) for one, other in ((a, b), (b, a)) for k in range(3))


def rational_meet(p, q, a, b, c) -> bool | None:
    """Closed segment against closed triangle, solved for the parameters in fractions; None where they are parallel."""
    p, q, a, b, c = ([Fraction(float(x)) for x in point] for point in (p, q, a, b, c))
    u, v, w, r = ([y - x for x, y in zip(s, t, strict=True)] for s, t in ((a, b), (a, c), (q, p), (a, p)))

    def det(x, y, z):
        return x[0] * (y[1] * z[2] - y[2] * z[1]) - x[1] * (y[0] * z[2] - y[2] * z[0]) + x[2] * (y[0] * z[1] - y[1] * z[0])

    d = det(u, v, w)
    if d == 0:
        return None
    s, t, k = det(r, v, w) / d, det(u, r, w) / d, det(u, v, r) / d
    return s >= 0 and t >= 0 and s + t <= 1 and 0 <= k <= 1


nearly_a_quarter = st.sampled_from([1e-9, 0.25 - 2**-54, 0.25 + 2**-54])
coordinate = st.integers(-3, 3).map(lambda x: x / 4) | st.floats(-1, 1, width=32) | nearly_a_quarter


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=5, max_size=5))
def test_segment_and_triangle_by_rational_arithmetic(points):
    expected = rational_meet(*points)
    assert expected is None or segment_meets_triangle(*points) == expected


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.0, 3.0]))
def test_agrees_with_ipctk(seed, spread):
    ipctk = pytest.importorskip("ipctk", reason="the independent library is not installed")
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(18, 3)) * 0.5 + np.repeat(rng.normal(size=(6, 3)) * spread, 3, axis=0)
    triangles = np.arange(18).reshape(-1, 3)
    mesh = ipctk.CollisionMesh(positions, ipctk.edges(triangles), triangles)
    assert (len(find_intersections(positions, triangles)) > 0) == ipctk.has_intersections(mesh, positions)


def test_a_watch_finds_what_the_witness_finds():
    """Two sheets, the upper of an obstacle, that approach in steps smaller and larger than the margin, cross and part; ripples make each fold."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), indexing="ij"), axis=-1).reshape(-1, 2)
    a = (np.arange(11)[:, None] * 12 + np.arange(11)).ravel()
    sheet = np.concatenate([np.stack([a, a + 12, a + 13], 1), np.stack([a, a + 13, a + 1], 1)])
    triangles = np.concatenate([sheet, sheet + 144, sheet + 288])
    obstacle = np.arange(432) >= 144  # the two upper ones are, and meet each other
    watch, found = Watch(triangles, obstacle, margin=0.05), []
    for gap in (1.0, 0.98, 0.97, 0.5, 0.48, 0.3, 0.28, 0.1, 0.12, 0.9):
        x = np.concatenate([np.column_stack([grid, np.full(144, z)]) for z in (0.0, gap, gap + 0.01)])
        x += rng.uniform(-0.2, 0.2, x.shape) * [0.02, 0.02, 1.0] if gap < 0.6 else 0.0
        expected = find_intersections(x, triangles, obstacle)
        np.testing.assert_array_equal(watch(x), expected)
        found.append(len(expected))
    assert found[:3] == [0, 0, 0] and max(found) > 100 and found[-1] == 0


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match=r"positions\[1\].*not finite"):
        find_intersections(TRIANGLE * [[1], [np.nan], [1]], [[0, 1, 2]])
    with pytest.raises(ValueError, match="vertices 0 to 3; there are 0 to 2"):
        find_intersections(TRIANGLE, [[0, 1, 3]])
    assert find_intersections(TRIANGLE, np.zeros((0, 3), int)).shape == (0, 2)


def test_memory_does_not_grow_with_the_pairs_that_come_near():
    """A stack of sheets, tilted, so that all boxes overlap: a million pairs, of which none meet."""
    sheets = 300
    corners = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 2], [0, 1, 1]], dtype=np.float64)
    positions = np.concatenate([corners + np.array([0, 0, 1e-3 * k]) for k in range(sheets)])
    triangles = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(sheets)])
    tracemalloc.start()
    try:
        assert len(find_intersections(positions, triangles)) == 0
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 60e6
