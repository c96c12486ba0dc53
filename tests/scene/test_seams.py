"""Seams that coincide: welded into one surface, or drawn apart; the rest shape stays."""

import numpy as np
import pytest
from physics.scenes import scene

import pdipc
from pdipc.judge.witness import find_intersections
from pdipc.scene import meshes, seams, sewing
from pdipc.scene.assembly import assemble


def tube(columns=12, rows=5, jitter=0.0):
    """Two half tubes around y whose long edges coincide, to within `jitter` m."""
    vertices, triangles = [], []
    for half in (0, 1):
        angle, height = np.meshgrid(np.pi * (half + np.linspace(0, 1, columns)), np.linspace(0, 0.4, rows))
        at = half * columns * rows
        vertices.append(np.stack([0.1 * np.cos(angle), height, 0.1 * np.sin(angle)], axis=-1).reshape(-1, 3))
        for i in range(rows - 1):
            for j in range(columns - 1):
                a = at + i * columns + j
                triangles += [[a, a + columns, a + 1], [a + 1, a + columns, a + columns + 1]]
    points = np.concatenate(vertices)
    return points + jitter * np.random.default_rng(0).uniform(-1, 1, points.shape), np.array(triangles)


def garment(jitter=1e-4, **more):
    points, triangles = tube(jitter=jitter)
    return scene([{"name": "tube", "kind": "cloth", "mesh": {"vertices": points, "triangles": triangles}, **more}])


def test_welding_closes_the_tube_and_keeps_the_rest_shape():
    points, triangles = tube(jitter=1e-4)
    with pytest.warns(match='body "tube": 10 vertices on open edges were welded to others'):
        body = assemble(garment(weld=1e-3)).bodies[0]
    assert body.last == len(points) - 10
    edges, _ = sewing.rim_edges(body.triangles)
    assert len(edges) == 2 * 22  # both ends
    assert pdipc.check_scene(garment(weld=1e-3)) == []
    np.testing.assert_allclose(body.pattern, points[triangles])


def test_seams_are_opened_by_the_gap_and_sewn_again():
    with pytest.warns(match="were drawn back"):
        assembly = assemble(garment(jitter=0.0, open_seams=2e-3))
    x, triangles = assembly.positions, assembly.triangles
    assert len(find_intersections(x, triangles)) == 0
    seam = np.flatnonzero(np.abs(x[:, 2]) < 5e-3)
    left, right = seam[seam < 60], seam[seam >= 60]
    gaps = np.linalg.norm(x[left][:, None] - x[right], axis=2).min(axis=1)
    assert gaps.min() > 0.98 * 2e-3 and gaps.max() < 6e-3
    sewn = garment(jitter=0.0, open_seams=2e-3)
    sewn.stitches = [{"bodies": ["tube", "tube"], "within": 6e-3, "duration": 0.05}]
    sewn.contact.activation_distance = 5e-4
    sewn.simulation.gravity = (0, 0, 0)
    with pytest.warns():
        simulation = pdipc.Simulation(sewn, device="cpu")
    for _ in range(8):
        assert simulation.step().converged
    (stitch,) = simulation.model.assembly.stitches
    corners = simulation.positions[stitch.elements]
    length = np.linalg.norm(np.einsum("ek,ekd->ed", stitch.weights, corners[:, 1:]) - corners[:, 0], axis=1)
    assert len(length) >= 10 and length.max() < 8e-4  # the bent panels pull


def test_seams_that_lie_on_each_other_are_left_before_triangles_fold():
    """Two panels on each other, drawn back the same way: they never part, and no triangle loses more than a good half of its height."""
    grid = np.stack([*np.meshgrid(np.linspace(0, 0.1, 6), np.linspace(0, 0.1, 6), indexing="ij"), np.zeros((6, 6))], axis=-1)
    points = np.concatenate([grid.reshape(-1, 3)] * 2)
    c = (np.arange(6)[:-1, None] * 6 + np.arange(5)).ravel()
    triangles = np.concatenate([np.stack([c, c + 6, c + 7], 1), np.stack([c, c + 7, c + 1], 1)])
    triangles = np.concatenate([triangles, triangles + 36])
    moved = seams.opened(points, triangles, 2e-3)
    assert np.linalg.norm(moved - points, axis=1).max() < 0.01

    def areas(x):
        return np.linalg.norm(
            np.cross(x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]), axis=1
        )

    assert (areas(moved) / areas(points)).min() > 0.4


def test_what_would_fold_up_is_refused():
    with pytest.raises(pdipc.SceneError, match=r'body "tube", weld: 0.09 m would fold \d+ triangles up'):
        assemble(garment(weld=0.09))
    found = [str(f) for f in pdipc.check_scene(garment(weld=1e-3, open_seams=1e-3))]
    assert 'body "tube": open_seams: is given beside weld; leave one of them out' in found


def test_welding_orders_and_keeps_what_is_far():
    points, triangles = tube()
    number, welded = seams.weld(points, triangles, 1e-6, "here")
    assert number.max() + 1 == len(points) - 10 and (np.diff(np.unique(number, return_index=True)[1]) > 0).all()
    assert not meshes.flat_triangles(points[np.unique(number, return_index=True)[1]], welded).any()
    same, unchanged = seams.weld(points + np.linspace(0, 1e-3, len(points))[:, None], triangles, 1e-9, "here")
    assert (same == np.arange(len(points))).all() and (unchanged == triangles).all()
