"""Where threads go: rims, nearest points, named points, and what is refused."""

import numpy as np
import pytest
from physics.scenes import cloth, rod, scene

import pdipc
from pdipc.scene import sewing
from pdipc.scene.assembly import assemble


def two_sheets(**stitch):
    """A coarse sheet 0.3 m below a fine one, both of 1 m."""
    fine, coarse = cloth("fine", (1.0, 1.0), (6, 6), at=(0, 0.3, 0)), cloth("coarse", (1.0, 1.0), (2, 2), at=(0.02, 0, 0))
    made = scene([fine, coarse])
    made.stitches = [{"bodies": ["fine", "coarse"], **stitch}]
    return made


def sewn(**stitch):
    assembly = assemble(two_sheets(**stitch))
    (found,) = assembly.stitches
    return assembly.positions, found, assembly.bodies


def test_rim_of_a_sheet():
    triangles = assemble(two_sheets(within=1.0)).bodies[0].triangles
    edges, across = sewing.rim_edges(triangles)
    assert len(edges) == 24 and len(sewing.rim_vertices(triangles)) == 24
    whole = {tuple(sorted(t)) for t in triangles.tolist()}
    assert all(tuple(sorted((*edge, third))) in whole for edge, third in zip(edges.tolist(), across.tolist(), strict=True))


@pytest.mark.parametrize("onto", ["rim", "surface"])
def test_nearest_points_against_brute_force(onto):
    """No point among a dense sample of the target is nearer; the weights make a point of the triangle."""
    x, stitch, (_, coarse) = sewn(within=0.4, onto=onto, select={"all": True})
    assert (stitch.weights >= 0).all() and np.allclose(stitch.weights.sum(axis=1), 1.0)
    targets = coarse.triangles if onto == "surface" else sewing.rim_edges(coarse.triangles)[0]
    steps = np.linspace(0, 1, 60)
    mixes = (
        [(a, b, 1 - a - b) for a in steps for b in steps if a + b <= 1] if onto == "surface" else [(a, 1 - a) for a in steps]
    )
    dense = np.einsum("sk,tkd->std", np.array(mixes), x[targets]).reshape(-1, 3)
    for element, weights, distance in zip(stitch.elements, stitch.weights, stitch.distances, strict=True):
        best = np.linalg.norm(dense - x[element[0]], axis=1).min()
        assert distance == pytest.approx(np.linalg.norm(weights @ x[element[1:]] - x[element[0]]))
        assert distance <= best + 1e-9 and distance <= 0.4
    if onto == "surface":
        assert len(stitch.elements) == 49  # all are within, those beyond the edge too


def test_named_points_lie_where_they_say():
    points = [[0, [0], [1.0]], [7, [3, 4], [0.25, 0.75]], [8, [0, 1, 4], [0.2, 0.3, 0.5]]]
    points[2][1] = (assemble(two_sheets(within=1.0)).bodies[1].triangles[0] - 49).tolist()
    x, stitch, (_, coarse) = sewn(points=points)
    for (vertex, corners, weights), element, part in zip(points, stitch.elements, stitch.weights, strict=True):
        assert element[0] == vertex
        expected = np.array(weights) @ x[np.array(corners) + coarse.first]
        np.testing.assert_allclose(part @ x[element[1:]], expected, atol=1e-15)


def test_lengths_shrink_in_their_time():
    _, stitch, _ = sewn(pairs=[(0, 0)], start=1.0, duration=2.0, length=0.1)
    first = stitch.distances[0]
    for time, expected in ((0.5, np.inf), (1.0, first), (2.0, 0.5 * (first + 0.1)), (3.0, 0.1), (9.0, 0.1)):
        assert stitch.lengths(time)[0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("stitch", "message"),
    [
        ({"points": [[0, [0, 8], [0.5, 0.5]]]}, r"stitches\[0\]: the vertices \[0, 8\] of \"coarse\" are no corners"),
        ({"points": [[0, [0], [0.7]]]}, "the weights \\[0.7\\] add up to 0.7; they must add up to 1"),
        ({"points": [[0, [0, 1], [1.0]]]}, "one to three corners and as many weights"),
        ({"pairs": [(0, 9)]}, r'stitches\[0\]: vertex 9 is out of range; body "coarse" has the vertices 0 to 8'),
        ({"pairs": [(0, 1)], "onto": "surface"}, "select and onto have no effect without within"),
        ({}, "exactly one of pairs, points, within"),
    ],
)
def test_what_cannot_be_sewn_is_refused(stitch, message):
    with pytest.raises(pdipc.SceneError, match=message):
        assemble(two_sheets(**stitch))


def test_threads_that_reach_nothing_are_found():
    (found,) = pdipc.check_scene(two_sheets(within=1e-3))
    assert str(found) == 'stitches[0]: sews no vertex; raise "within", or give pairs'


def test_one_body_of_two_panels_is_sewn_to_itself():
    """Each rim vertex goes to the other panel, never to its own."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [0.0, 0.1, 0], [1, 0.1, 0], [0, 0.1, 1]])
    body = {"name": "b", "kind": "cloth", "mesh": {"vertices": points, "triangles": np.array([[0, 1, 2], [3, 4, 5]])}}
    made = scene([body])
    made.stitches = [{"bodies": ["b", "b"], "within": 0.2}]
    (stitch,) = assemble(made).stitches
    assert len(stitch.elements) == 6
    assert all((element[0] < 3) == (element[1:] >= 3).all() for element in stitch.elements)
    np.testing.assert_allclose(stitch.distances, 0.1)


def test_a_rod_is_sewn_to_a_cloth_and_not_the_other_way():
    made = scene([cloth("sheet", (1.0, 1.0), (4, 4)), rod("rope", 0.5, 5, at=(0, 0.02, 0))])
    made.stitches = [{"bodies": ["rope", "sheet"], "within": 0.03, "onto": "surface"}]
    (stitch,) = assemble(made).stitches
    assert len(stitch.elements) == 6
    np.testing.assert_allclose(stitch.distances, 0.02, atol=1e-12)
    made.stitches = [{"bodies": ["sheet", "rope"], "within": 0.03}]
    with pytest.raises(pdipc.SceneError, match='body "rope" has no triangles to sew to'):
        assemble(made)
