"""The public query: ground truth, hard queries with an exact judge, known answers, bad input."""

import dataclasses

import data
import numpy as np
import pytest
import warp as wp

from collision import exact, hard_queries
from pdipc.collision import queries
from pdipc.collision.queries import time_of_impact
from pdipc.device.launch import Device
from pdipc.device.precision import Real, real

PRECISIONS = ("float64", "float32")
KINDS = ("vertex_triangle", "edge_edge")
DATA_SETS = [
    f"{name}_{ending}"
    for name, endings in {
        "erleben-cube-cliff-edges": ("ee", "vf"),
        "erleben-sliding-spike": ("ee", "vf"),
        "erleben-spike-crack": ("ee", "vf"),
        "erleben-spike-wedge": ("ee", "vf"),
        "erleben-wedge-crack": ("ee", "vf"),
        "fast-root-counterexample": ("ee", "vf"),
        "n-body-simulation": ("vf",),
        "rod-twist": ("ee", "vf"),
        "toolkit-cases": ("ee", "vf"),
        "unit-tests": ("ee", "vf"),
    }.items()
    for ending in endings
]


def unproven(points, kind, times, separation=0.0):
    """Answers that the judge does not confirm; a time of 0 claims nothing."""
    moved = np.flatnonzero(times > 0)
    return moved[~exact.stays_apart(points[moved], kind, np.minimum(times[moved], 1.0), separation)]


@pytest.mark.parametrize("name", DATA_SETS)
def test_ground_truth(name):
    """No answer is late, in both precisions; in float32 for the coordinates as they are after rounding."""
    file = np.load(data.path(f"ccd/{name}.npz"))
    kind = "edge_edge" if name.endswith("ee") else "vertex_triangle"
    points, hit, truth = file["x"], file["hit"], file["toi"]
    times = time_of_impact(points, kind, device="cpu")
    known = hit & np.isfinite(truth)
    assert (times[known] <= truth[known]).all()
    assert (times[known & (truth > 0)] > 0).all()
    assert len(unproven(points, kind, times)) == 0
    rounded = points.astype(np.float32).astype(float)
    assert len(unproven(rounded, kind, time_of_impact(points, kind, precision="float32", device="cpu"))) == 0
    if name != "fast-root-counterexample_ee":
        assert np.isfinite(times[hit]).all()


def test_published_edge_edge_counterexample_is_a_miss():
    """Its edges pass each other 5e-7 apart: inside the tolerance of the judge it was published with, but no hit."""
    points = np.load(data.path("ccd/fast-root-counterexample_ee.npz"))["x"]
    assert exact.stays_apart_exactly(points[0], "edge_edge", 1.0, 4.9e-7)
    assert time_of_impact(points, "edge_edge", device="cpu")[0] == np.inf
    assert time_of_impact(points, "edge_edge", minimum_separation=1e-6, device="cpu")[0] < 0.22


@pytest.mark.parametrize("family", hard_queries.FAMILIES, ids=lambda family: family.__name__)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_hard_queries(family, precision):
    """Every answer is proven; a time of 0 is given only to pairs that start within rounding of the separation."""
    points = family(np.random.default_rng(11), 150).astype(precision).astype(float)
    size = np.abs(points[:, 1:4] - points[:, :1]).max(axis=(1, 2))
    for kind in KINDS:
        for xi in (0.0, 2.0**-10):
            times = time_of_impact(points, kind, minimum_separation=xi, precision=precision, device="cpu")
            assert len(unproven(points, kind, times, xi)) == 0
            for i in np.flatnonzero(times == 0):
                assert float(exact.distance_squared(points[i], kind, 0.0)) ** 0.5 <= xi + 1e-9 * size[i]


@dataclasses.dataclass(frozen=True)
class Fused(Real):
    """A precision whose multiplications and additions are fused, as CUDA does it, where the processor can."""

    def module(self, name: str) -> wp.Module:
        module = wp.get_module(f"{name}.{self.name}.fused")
        module.options |= {"enable_backward": False, "cpu_compiler_flags": "-march=native -ffp-contract=fast"}
        return module


@pytest.mark.parametrize("precision", PRECISIONS)
def test_proofs_hold_where_multiplications_and_additions_are_fused(precision):
    """What is early by the usual arithmetic is so by that of CUDA, though not to the bit."""
    fused = Fused(**vars(real(precision)))
    rng = np.random.default_rng(12)
    points = np.concatenate([family(rng, 60) for family in hard_queries.FAMILIES]).astype(precision)
    for kind in KINDS:
        times = wp.zeros(len(points), dtype=fused.scalar, device="cpu")
        given = wp.array(points, dtype=fused.vec3, ndim=2, device="cpu")
        inputs = [given, fused.scalar(0.0), fused.scalar(queries.BACKOFF), fused.scalar(np.inf), times]
        Device("cpu", threads=1).launch(getattr(queries.kernels(fused), kind), len(points), inputs)
        found = times.numpy().astype(float)
        assert len(unproven(points.astype(float), kind, found)) == 0
        same = time_of_impact(points, kind, precision=precision, device="cpu")
        both = (found <= 1.0) & np.isfinite(same)
        assert np.abs(found[both] - same[both]).max() < 1e-3
        assert np.mean((found <= 1.0) != np.isfinite(same)) < 0.01


def test_the_judge_finds_late_answers():
    """The true time of a hit, and any time after it, is not proven; a little before it is."""
    file = np.load(data.path("ccd/unit-tests_vf.npz"))
    pick = np.flatnonzero(file["hit"] & (file["toi"] > 0.01) & (file["toi"] < 0.99))[:40]
    points, truth = file["x"][pick], file["toi"][pick]
    assert exact.stays_apart(points, "vertex_triangle", truth - 1e-6).all()
    assert not exact.stays_apart(points, "vertex_triangle", truth + 1e-12).any()


def answer(points, kind, **options):
    return time_of_impact(np.array([points], dtype=float), kind, device="cpu", **options)[0]


TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_falling_vertex(precision):
    """From height 1 down to -1: meets at 1/2, comes within 0.1 at 0.45."""
    motion = [[0.25, 0.25, 1], *TRIANGLE, [0.25, 0.25, -1], *TRIANGLE]
    assert 0.49 <= answer(motion, "vertex_triangle", precision=precision) < 0.5
    assert 0.44 <= answer(motion, "vertex_triangle", precision=precision, minimum_separation=0.1) < 0.45
    beside = [[0.75, 0.75, 1], *TRIANGLE, [0.75, 0.75, -1], *TRIANGLE]
    assert answer(beside, "vertex_triangle", precision=precision) == np.inf


@pytest.mark.parametrize("precision", PRECISIONS)
def test_crossing_and_parallel_edges(precision):
    crossing = [[-1, 0, 1], [1, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, -3], [1, 0, -3], [0, -1, 0], [0, 1, 0]]
    assert 0.247 <= answer(crossing, "edge_edge", precision=precision) < 0.25
    down = [[-1, 0, 1], [1, 0, 1], [-1, 0, 0], [1, 0, 0], [-1, 0, -1], [1, 0, -1], [-1, 0, 0], [1, 0, 0]]
    assert 0.49 <= answer(down, "edge_edge", precision=precision) < 0.5
    slide = [[-1, 0, 1e-3], [1, 0, 1e-3], [-1, 0, 0], [1, 0, 0], [9, 0, 1e-3], [11, 0, 1e-3], [-1, 0, 0], [1, 0, 0]]
    assert answer(slide, "edge_edge", precision=precision) == np.inf
    in_line = [[0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0], [4, 0, 0], [5, 0, 0], [3, 0, 0], [4, 0, 0]]
    assert 0.49 <= answer(in_line, "edge_edge", precision=precision) < 0.5


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_flat_cloth(precision):
    """Coplanar at all times: a vertex moves in the plane of a triangle into its side, or away from it."""
    into = [[2, 2, 0], *TRIANGLE, [0, 0, 0], *TRIANGLE]
    assert 0.74 <= answer(into, "vertex_triangle", precision=precision) < 0.75
    away = [[2, 2, 0], *TRIANGLE, [4, 4, 0], *TRIANGLE]
    assert answer(away, "vertex_triangle", precision=precision) == np.inf


def test_nothing_moves_and_touching():
    still = [[0.25, 0.25, 1e-9], *TRIANGLE] * 2
    assert answer(still, "vertex_triangle") == np.inf
    assert answer(still, "vertex_triangle", minimum_separation=1e-9) == 0.0
    touching = [[0.25, 0.25, 0], *TRIANGLE, [0.25, 0.25, 1], *TRIANGLE]
    assert answer(touching, "vertex_triangle") == 0.0
    point = [[1, 2, 3]] * 8
    assert answer(point, "edge_edge") == 0.0
    assert len(time_of_impact(np.zeros((0, 8, 3)), "edge_edge", device="cpu")) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "triangle"}, 'kind is "triangle"; it must be'),
        ({"points": np.zeros((2, 4, 3))}, r"points has shape \(2, 4, 3\); it must be \(n, 8, 3\)"),
        ({"points": np.full((2, 8, 3), np.nan)}, r"points\[0\] is not finite in float64 \(one of 2"),
        ({"points": np.full((1, 8, 3), 1e300), "precision": "float32"}, r"points\[0\] is not finite in float32"),
        ({"points": np.zeros((8, 3))}, r"points has shape \(8, 3\); it must be \(n, 8, 3\)"),
        ({"points": np.zeros((1, 8, 3), dtype=complex)}, "points holds complex128; it must hold real numbers"),
        ({"points": np.full((1, 8, 3), "1")}, "points holds <U1; it must hold real numbers"),
        ({"points": np.full((1, 8, 3), np.inf)}, r"points\[0\] is not finite in float64"),
        ({"minimum_separation": -1.0}, "minimum_separation is -1.0; it must be one number, finite and not negative"),
        ({"minimum_separation": "wide"}, "minimum_separation is 'wide'; it must be one number"),
        ({"minimum_separation": np.zeros(2)}, r"minimum_separation is array\(\[0., 0.\]\); it must be one number"),
        ({"minimum_separation": np.nan}, "minimum_separation is nan"),
        ({"precision": "float16"}, 'precision is "float16"; it must be "float32" or "float64"'),
        ({"device": "cuda:99"}, 'device "cuda:99" is not available'),
    ],
)
def test_bad_input_is_refused(change, message):
    arguments = {"points": np.zeros((1, 8, 3)), "kind": "edge_edge", "device": "cpu"} | change
    points, kind = arguments.pop("points"), arguments.pop("kind")
    with pytest.raises(ValueError, match=message):
        time_of_impact(points, kind, **arguments)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("separation", [0.0, 0.05])
def test_segments_of_rods_are_triangles_without_area(precision, separation):
    """A vertex that passes a segment (a, b, b): no answer is late, and few are early."""
    rng = np.random.default_rng(4)
    points = rng.standard_normal((400, 8, 3)).astype(precision).astype(float)
    points[:, 3], points[:, 7] = points[:, 2], points[:, 6]
    # so that at half of the way the vertex is near the segment, as near as 1e-8
    middle, part = 0.5 * (points[:, :4] + points[:, 4:]), rng.random((400, 1))
    aim = (1 - part) * middle[:, 1] + part * middle[:, 2] + 10.0 ** rng.uniform(-8, 0, (400, 1)) * rng.standard_normal((400, 3))
    points[:, 4] = (2 * aim - points[:, 0]).astype(precision)
    times = time_of_impact(points, "vertex_triangle", minimum_separation=separation, precision=precision, device="cpu")
    assert len(unproven(points, "vertex_triangle", times, separation)) == 0
    s = np.linspace(0, 1, 1001)[:, None, None]
    p, a, b = ((1 - s) * points[:, k] + s * points[:, 4 + k] for k in range(3))
    along = np.clip(np.einsum("tij,tij->ti", p - a, b - a) / np.einsum("tij,tij->ti", b - a, b - a), 0, 1)
    distance = np.linalg.norm(p - a - along[..., None] * (b - a), axis=2)
    meets = (distance <= separation).any(axis=0)
    first = np.where(meets, np.argmax(distance <= separation, axis=0) / 1000, np.inf)
    assert (times <= first).all()
    if separation:
        assert np.isinf(times[~meets]).mean() > 0.4  # the others come nearer than the backoff, or turn
        assert np.mean(first[meets] - times[meets]) < 0.02
