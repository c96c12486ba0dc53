"""Candidates hold every pair that can act or meet, for as long as `check` says so, and little else."""

import numpy as np
import pytest
import warp as wp

from collision.test_broad_phase import METHODS, sheet
from pdipc.collision import broad_phase, distance, surface
from pdipc.collision.candidates import Candidates
from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.scene import generators

D_HAT, MARGIN, HALF = 0.01, 0.004, 0.001  # m


class Problem:
    """Two sheets, the upper folded, and a ball, all free; `list` gives the candidates of a motion as vertex quadruples."""

    def __init__(self, precision="float64", method="patches", origin=(0.0, 0.0, 0.0)):
        parts = [sheet(9, 0.0), sheet(7, 0.03, 0.04)]
        ball = generators.Sphere(radius=0.2, cells=4).mesh()
        parts.append((ball.vertices + np.array([0.1, 0.24, 0.0]), ball.triangles))
        first = np.cumsum([0] + [len(x) for x, _ in parts])
        self.real, self.device = real(precision), Device("cpu")
        self.x = (np.concatenate([x for x, _ in parts]) + origin).astype(precision).astype(float)
        triangles = np.concatenate([t + begin for (_, t), begin in zip(parts, first, strict=False)])
        self.body = np.repeat(np.arange(3), np.diff(first))
        n = len(self.x)
        self.skin = surface.build(self.device, triangles, self.x, self.body, np.zeros(n, dtype=bool))
        search = broad_phase.BroadPhase(self.device, self.real, self.skin, method)
        half = wp.array(np.full(n, HALF), dtype=self.real.scalar, device="cpu")
        self.candidates = Candidates(self.device, self.real, self.skin, search, self.x, half, D_HAT, MARGIN)
        search.restructure(self.upload(self.x), half)

    def upload(self, x):
        return wp.array(x, dtype=self.real.vec3, device="cpu")

    def list(self, x0, x1):
        while True:
            self.candidates.cover(self.upload(x0), self.upload(x1))
            if not self.candidates.grow():
                break
        return [set(map(tuple, each.quads.numpy()[: each.count.numpy()[0]].tolist())) for each in self.candidates.lists]

    def holds(self, x0, x1):
        self.candidates.check(self.upload(x0), self.upload(x1))
        return self.candidates.needed.numpy()[0] == 0

    def near(self, x, reach):
        """Quadruples whose distance at x is at most `reach`, by brute force over all pairs without a common vertex."""
        vertices, edges, faces = self.skin.members
        first, second = np.triu_indices(len(edges), 1)
        everything = [
            np.hstack([np.repeat(vertices, len(faces), axis=0), np.tile(faces, (len(vertices), 1))]),
            np.hstack([edges[first], edges[second]]),
        ]
        found = []
        for quads, kind, split in zip(everything, ("vertex_triangle", "edge_edge"), (1, 2), strict=True):
            quads = quads[~(quads[:, :split, None] == quads[:, None, split:]).any(axis=(1, 2))]
            gaps = wp.zeros(len(quads), dtype=wp.float64, device="cpu")
            positions, corners = wp.array(x, dtype=wp.vec3d, device="cpu"), wp.array(quads, dtype=wp.vec4i, device="cpu")
            wp.launch(MEASURE[kind], len(quads), inputs=[positions, corners, gaps], device="cpu")
            found.append(set(map(tuple, quads[gaps.numpy() <= reach].tolist())))
        return found


def measure(name):
    of = getattr(distance, f"{name}_distance")

    def distances(x: wp.array(dtype=wp.vec3d), quads: wp.array(dtype=wp.vec4i), out: wp.array(dtype=wp.float64)):
        q = quads[wp.tid()]
        out[wp.tid()] = of(x[q[0]], x[q[1]], x[q[2]], x[q[3]])

    return kernel(real("float64").module(__name__), f"{name}_distances")(distances)


MEASURE = {kind: measure(kind) for kind in ("vertex_triangle", "edge_edge")}


def motions(x, rng):
    """Ends of motions of all x: none, together, turning, each vertex its own way, and one sheet past the other."""
    angle = 0.6
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    slide = np.where(np.arange(len(x))[:, None] < 100, [0.3, 0.0, 0.05], [-0.1, -0.02, 0.0])
    center = x.mean(axis=0)
    return [
        x,
        x + np.array([0.9, -0.4, 0.2]),
        (x - center) @ turn.T + center,
        x + 0.03 * rng.standard_normal(x.shape),
        x + slide,
    ]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("precision", "origin"), [("float64", (0, 0, 0)), ("float32", (0, 0, 0)), ("float32", (0, 300.0, 0))])
def test_no_pair_is_missed_on_the_way(method, precision, origin):
    """At every common fraction of the way, every vertex as far off it as the margin allows."""
    rng = np.random.default_rng(0)
    problem = Problem(precision, method, origin)
    x0 = problem.x
    for x1 in motions(x0, rng):
        x1 = x1.astype(precision).astype(float)
        listed = problem.list(x0, x1)
        seen = 0
        for fraction in (0.0, 0.3, 0.5, 0.77, 1.0):
            off = rng.standard_normal(x0.shape)
            off *= 0.999 * MARGIN / np.linalg.norm(off, axis=1, keepdims=True)
            x = (1 - fraction) * x0 + fraction * x1 + off
            for have, want in zip(listed, problem.near(x, D_HAT + 2 * HALF), strict=True):
                assert want <= have
                seen += len(want)
        assert seen > 300


def test_what_moves_together_adds_no_pairs():
    """The list of a motion by many edge lengths is that of rest."""
    problem = Problem()
    still = problem.list(problem.x, problem.x)
    together = problem.list(problem.x, problem.x + np.array([0.9, -0.4, 0.2]))
    assert together == still
    reach = D_HAT + 2 * HALF + 2 * MARGIN
    for have, close, more in zip(still, problem.near(problem.x, reach), problem.near(problem.x, 1.002 * reach), strict=True):
        assert close <= have <= more  # nothing is listed that is farther apart
        assert len(close) > 50


def test_both_ways_of_culling_list_the_same():
    rng = np.random.default_rng(1)
    patches, trees = Problem(method="patches"), Problem(method="bvh")
    for x1 in motions(patches.x, rng):
        x0 = patches.x
        patches.list(x0, x1)
        trees.list(x0, x1)
        for a, b in zip(patches.candidates.lists, trees.candidates.lists, strict=True):
            count = a.count.numpy()[0]
            assert count == b.count.numpy()[0]
            assert np.array_equal(a.quads.numpy()[:count], b.quads.numpy()[:count])
            assert np.array_equal(a.limits.numpy()[:count], b.limits.numpy()[:count])


def test_a_list_holds_near_the_ends_of_its_motion():
    problem = Problem()
    x0, x1 = problem.x, problem.x + np.array([0.5, 0.0, 0.0])
    inside, outside = np.array([0.99 * MARGIN, 0, 0]), np.array([0, 1.01 * MARGIN, 0])
    assert not problem.holds(x0, x1)  # there is none yet
    problem.list(x0, x1)
    assert problem.holds(x0, x1)
    assert problem.holds(x0 + inside, x1 - inside)
    assert problem.holds(x1, x1 + inside)  # the next outer iteration
    assert problem.holds(x0, x0 + inside)
    assert not problem.holds(x0, x1 + outside)
    assert not problem.holds(x0 + outside, x1)
    assert not problem.holds(x0, 0.5 * (x0 + x1))
    for one in (0, len(x0) - 1):  # a single vertex that was shortened: its neighbours move past it
        shortened = x1.copy()
        shortened[one] = 0.5 * (x0 + x1)[one]
        assert not problem.holds(x0, shortened)
        assert not problem.holds(shortened, x1)
        shortened[one] = np.nan
        assert not problem.holds(x0, shortened)
    mixed = np.where(np.arange(len(x0))[:, None] % 2 == 0, x0, x1)
    assert not problem.holds(x0, mixed)
    problem.candidates.invalidate()
    assert not problem.holds(x0, x1)
