"""The lemmas of collision/ccd.py, each with queries made to break it."""

import numpy as np
import pytest
import warp as wp

from collision import exact, hard_queries
from pdipc.collision import ccd
from pdipc.device.precision import real as real_of

PRECISIONS = ("float64", "float32")
KINDS = ("vertex_triangle", "edge_edge")
STAGES = {
    "additive": {"rejects": False, "cubic": "off", "steps": "additive"},
    "cubic filter": {"cubic": "filter", "steps": "additive"},
    "no cubic": {"cubic": "off"},
    "default": {},
}


def times_of(points, kind, precision="float64", xi=0.0, backoff=0.2, reach=np.inf, **stages):
    real = real_of(precision)
    scalar = real.scalar
    time_of = getattr(ccd.variant(real, **stages), kind)

    @wp.kernel(module=real.module(f"{__name__}.{kind}.{sorted(stages.items())}"))
    def kernel(x: wp.array(dtype=real.vec3, ndim=2), xi: scalar, backoff: scalar, reach: scalar, out: wp.array(dtype=scalar)):
        i = wp.tid()
        out[i] = time_of(
            x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], xi, backoff, reach
        )  # fmt: skip

    x = wp.array(points, dtype=real.vec3, ndim=2, device="cpu")
    out = wp.zeros(len(points), dtype=scalar, device="cpu")
    wp.launch(kernel, len(points), [x, scalar(xi), scalar(backoff), scalar(reach), out], device="cpu")
    return out.numpy().astype(float)


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_stage_alone_is_conservative(kind, precision, stage):
    for k, family in enumerate(hard_queries.FAMILIES):
        points = family(np.random.default_rng(100 + k), 60).astype(precision).astype(float)
        for xi in (0.0, 2.0**-10):
            t = times_of(points, kind, precision, xi, **STAGES[stage])
            moved = t > 0
            assert exact.stays_apart(points[moved], kind, np.minimum(t[moved], 1), xi).all(), family.__name__


def start_gaps(points, kind):
    return np.array([float(exact.distance_squared(x, kind, 0.0)) ** 0.5 for x in points])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("xi", "backoff", "reach"), [(0.0, 0.2, np.inf), (0.01, 0.1, np.inf), (0.01, 0.2, 0.05)])
def test_the_target_gap_is_kept_and_used(kind, xi, backoff, reach):
    """The gap never falls below xi + s min(d0 - xi, reach); pairs are stopped where it is below 1.5 s of that."""
    rng = np.random.default_rng(3)
    points = np.concatenate([hard_queries.random(rng, 300), hard_queries.hits(rng, 100)])
    room = np.minimum(start_gaps(points, kind) - xi, reach)
    points, room = points[room > 1e-6], room[room > 1e-6]
    t = times_of(points, kind, xi=xi, backoff=backoff, reach=reach)
    # boxes measure the gap along an axis, which is shorter; so the free pairs only keep xi
    stopped = t <= 1
    keep = xi + backoff * room * (1 - 1e-9)
    assert exact.stays_apart(points[stopped], kind, t[stopped], keep[stopped]).all()
    assert exact.stays_apart(points[~stopped], kind, np.ones((~stopped).sum()), xi).all()
    gaps = np.array(
        [float(exact.distance_squared(x, kind, s)) ** 0.5 for x, s in zip(points[stopped], t[stopped], strict=True)]
    )
    assert stopped.sum() > 30
    assert (gaps <= xi + 1.5001 * backoff * room[stopped] + 1e-12).mean() > 0.98


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_rounding_is_taken_off(kind, precision):
    """Lemmas 2 and 3: pairs within a few roundings of xi along a slanted plane. Without either slack some answers are wrong."""
    rng = np.random.default_rng(5)
    n, xi = 12_000, 2.0**-7
    first = 1 if kind == "vertex_triangle" else 2
    points = rng.uniform(-1, 1, (n, 8, 3)) * [1, 1, 0]
    points[: 2 * n // 3, 4:] = points[: 2 * n // 3, :4]
    wobble = real_of(precision).unit_roundoff * 10.0 ** rng.uniform(-2, 2, (n, 1)) * rng.choice([-1, 1], (n, 1))
    points[:, :first, 2] = xi + np.where(rng.random((n, 1)) < 0.5, np.abs(wobble), 0.1)
    points[:, 4 : 4 + first, 2] = xi + wobble
    points = np.einsum("nij,nkj->nki", np.linalg.qr(rng.normal(size=(n, 3, 3)))[0], points).astype(precision).astype(float)
    t = times_of(points, kind, precision, xi, backoff=0.0)
    moved = t > 0
    assert (t > 1).any() and (t <= 1).any()
    assert exact.stays_apart(points[moved], kind, np.minimum(t[moved], 1), xi).all()


def test_rotation():
    """An edge turns over others across it: its height over the one at x is 0.3 + 0.6 x t."""
    x = np.linspace(-0.9, 0.9, 40)
    points = np.zeros((40, 8, 3))
    points[:, :2] = [[-1, 0, 0.3], [1, 0, 0.3]]
    points[:, 4:6] = [[-1, 0, -0.3], [1, 0, 0.9]]
    points[:, [2, 3, 6, 7], 0] = x[:, None]
    points[:, [2, 3, 6, 7], 1] = [-1, 1, -1, 1]
    truth = np.where(x < -0.5, -0.5 / x, np.inf)
    t = times_of(points, "edge_edge", backoff=0.01)
    assert (t[x > -0.49] > 1).all()
    assert (t[x < -0.5] < truth[x < -0.5]).all() and (t[x < -0.5] > 0.95 * truth[x < -0.5]).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_same_answer_wherever_the_pair_is(precision):
    """Coordinates are taken relative to each other: a shift that rounds nothing changes nothing."""
    rng = np.random.default_rng(7)
    points = np.round(hard_queries.random(rng, 200) * 256) / 256
    for kind in KINDS:
        assert np.array_equal(
            times_of(points, kind, precision), times_of(points + np.array([1024, -512, 2048]), kind, precision)
        )


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e12])
def test_small_and_large_scenes(precision, scale):
    """Squares of these sizes under- and overflow in float32: still conservative, and no pair is lost."""
    points = (hard_queries.hits(np.random.default_rng(9), 200) * scale).astype(precision).astype(float)
    for kind in KINDS:
        t = times_of(points, kind, precision)
        assert exact.stays_apart(points[t > 0], kind, np.minimum(t[t > 0], 1)).all()
        reference = times_of(points / scale, kind, "float64")
        assert np.mean(np.abs(t - reference) < 1e-3) > 0.97
