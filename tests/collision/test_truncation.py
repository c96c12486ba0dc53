"""Truncation: what is committed is proven free of contact, nobody is shortened for another's collision, and nobody needlessly."""

import numpy as np
import pytest
import warp as wp
from physics.scenes import cloth, floor, scene, solid

import pdipc
from pdipc.drive import Work
from tests.collision import exact


def falling(truncation="per_vertex", precision="float64"):
    """Two blocks and a sheet: the lower block and the sheet are about to meet the floor or each other, one block flies far away."""
    bodies = [
        solid("low", [0.1, 0.1, 0.1], [2, 2, 2], at=(0, 0.06, 0)),
        solid("far", [0.1, 0.1, 0.1], [2, 2, 2], at=(0, 2.0, 0)),
        cloth("sheet", [0.3, 0.3], [6, 6], at=(0.02, 0.13, 0.01)),
    ]
    return scene(bodies, [floor(2.0)], contact={"truncation": truncation, "minimum_separation": 3e-5}, precision=precision)


def truncated(motion, *, truncation="per_vertex", precision="float64", moving_floor=False):
    """Truncates x + motion(x, model): model, x, x~, x_end (n, 3) and the kept fractions."""
    model = pdipc.build(falling(truncation, precision), "cpu")
    if moving_floor:
        (moving,) = (b for b in model.assembly.bodies if b.kinematic)
    work, x = Work(model), model.initial_state().positions
    if moving_floor:
        work.truncation.keep_rigid([np.arange(moving.first, moving.last)])
    start = x.numpy()
    wanted = wp.array(motion(start, model), dtype=model.real.vec3, device="cpu")
    x_tilde = wp.array(start + wanted.numpy(), dtype=model.real.vec3, device="cpu")
    while True:
        work.candidates.cover(x, x_tilde)
        work.truncation.truncate(work.candidates, x, wp.zeros_like(x), wanted, x)
        if not work.grow():
            break
    return model, start, x_tilde.numpy(), work.truncation.x_end.numpy(), work.truncation.fraction.numpy()


def of(model, name):
    body = next(b for b in model.assembly.bodies if b.name == name)
    return slice(body.first, body.last)


def drop(distance):
    """Simulated vertices move down, the floor not."""
    return lambda x, model: np.where(model.free.numpy()[:, None] > 0, [0.0, -distance, 0.0], 0.0)


def crumple(seed):
    """Every simulated vertex goes its own way, far enough to pass through others."""

    def motion(x, model):
        return 0.2 * np.random.default_rng(seed).standard_normal(x.shape) * (model.free.numpy()[:, None] > 0)

    return motion


def proven(model, x, x_end):
    """Whether an exact judge proves every pair of primitives apart all along x -> x_end."""
    skin = model.surface
    triangles, edges = skin.triangles.numpy(), skin.edges.numpy()
    body, vertices = skin.body_of_vertex.numpy(), skin.members[0].ravel()
    scripted = np.array([model.assembly.bodies[b].kinematic for b in range(len(model.assembly.bodies))])
    for kind, first, second in (("vertex_triangle", vertices[:, None], triangles), ("edge_edge", edges, edges)):
        i, j = (index.ravel() for index in np.indices((len(first), len(second))))
        if kind == "edge_edge":
            i, j = i[i < j], j[i < j]
        quads = np.concatenate([first[i], second[j]], axis=1)
        own = first.shape[1]
        apart = ~(quads[:, :own, None] == quads[:, None, own:]).any(axis=(1, 2))
        quads = quads[apart & ~(scripted[body[quads[:, 0]]] & scripted[body[quads[:, 3]]])]
        swept = np.stack([x, x_end])[:, quads]  # (2, pairs, 4, 3)
        low = [swept[:, :, part].min(axis=(0, 2)) for part in (slice(0, own), slice(own, 4))]
        high = [swept[:, :, part].max(axis=(0, 2)) for part in (slice(0, own), slice(own, 4))]
        near = ((low[0] <= high[1]) & (low[1] <= high[0])).all(axis=1)
        points = np.concatenate([x[quads[near]], x_end[quads[near]]], axis=1)
        if not exact.stays_apart(points, kind, np.ones(len(points))).all():
            return False
    return True


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("truncation", ["per_vertex", "global"])
@pytest.mark.parametrize("motion", [drop(0.5), crumple(1), crumple(2), crumple(3)], ids=["drop", "1", "2", "3"])
def test_what_is_committed_is_proven(motion, truncation, precision):
    model, x, x_tilde, x_end, fraction = truncated(motion, truncation=truncation, precision=precision)
    assert not proven(model, x.astype(float), x_tilde.astype(float))  # the judge sees that the whole motion is not free
    assert proven(model, x.astype(float), x_end.astype(float))
    assert fraction.min() >= 0.0
    assert fraction.max() <= 1.0
    assert np.abs(x_end - (x + fraction[:, None] * (x_tilde - x))).max() < 1e-6
    assert np.abs(x_end - x).max() > 1e-3  # and something moves


def test_a_collision_stops_those_that_collide_only():
    """Section 4.3's one smallest time of impact drags every body; per vertex, who meets nobody goes all the way."""
    model, *_, fraction = truncated(drop(0.2))
    assert np.all(fraction[of(model, "far")] == 1.0)
    assert fraction[of(model, "low")].min() < 0.1
    model, *_, fraction = truncated(drop(0.2), truncation="global")
    assert np.ptp(fraction) == 0.0
    assert 0.0 < fraction[0] < 0.1


def test_the_kept_part_is_that_of_the_time_of_impact():
    """The block's lowest vertices, 10 mm above the floor, want 20 mm: they keep a half, less the back-off of a fifth of the gap."""
    model, x, _, x_end, fraction = truncated(drop(0.02))
    lowest = np.flatnonzero((x[:, 1] < 0.011) & (model.free.numpy() > 0))
    gap = x[lowest, 1]
    kept = fraction[lowest] * 0.02 / gap
    assert np.all(kept < 1.0)
    assert np.all(kept > 0.6)
    assert np.all(x_end[lowest, 1] > 0.0)


def test_a_rigid_obstacle_stays_rigid():
    """A moving plate is shortened as a whole when one of its vertices meets something."""

    def rise(x, model):
        floor_vertices = np.zeros(len(x), dtype=bool)
        floor_vertices[of(model, "floor")] = True
        return np.where(floor_vertices[:, None], [0.0, 0.3, 0.0], 0.0)

    model, x, _, x_end, fraction = truncated(rise, moving_floor=True)
    own = of(model, "floor")
    assert np.ptp(fraction[own]) == 0.0
    assert 0.0 < fraction[own][0] < 0.1
    assert np.ptp((x_end - x)[own, 1]) == 0.0


def test_a_free_motion_is_left_whole():
    *_, x_tilde, x_end, fraction = truncated(drop(0.001))
    assert np.array_equal(x_end, x_tilde)
    assert np.all(fraction == 1.0)
