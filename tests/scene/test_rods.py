"""Rods in scenes: where their lines come from, what is refused, ghost points."""

import numpy as np
import pytest

import pdipc
from pdipc.scene import rods
from pdipc.scene.assembly import assemble
from pdipc.scene.errors import SceneError, SceneWarning
from pdipc.scene.generators import LINES


def made(mesh, **body):
    return pdipc.Scene(bodies=[{"name": "r", "kind": "rod", "mesh": mesh, **body}])


def test_lines_of_an_obj_file_in_any_order_and_direction(tmp_path):
    (tmp_path / "r.obj").write_text("v 9 9 9\nv 0 0 0\nv 1 0 0\nv 2 0 0\nv 3 1 0\nv 4 1 0\nl 4 3\nl 2 3\nl -1 -2\nf 2 3 4\n")
    with pytest.warns(SceneWarning, match="faces and cells were left out"):
        assembly = assemble(made(str(tmp_path / "r.obj"), material={"twist_stiffness": 0.0}))
    (body,) = assembly.bodies
    assert body.count == 5  # the first vertex has no line
    chains = assembly.rest_positions[body.segments][:, :, 0].tolist()
    assert chains == [[2, 1], [1, 0], [4, 3]] or chains == [[0, 1], [1, 2], [4, 3]] or chains == [[2, 1], [1, 0], [3, 4]]
    assert body.joints.tolist() == [[0, 1]]


@pytest.mark.parametrize("shape", [shape.model_fields["shape"].default for shape in LINES])
def test_every_shape_of_lines_starts_at_rest(shape):
    scene = made({"shape": shape, "segments": 30}, material={"radius": 1e-3})
    assert pdipc.check_scene(scene) == []
    (body,) = assemble(scene).bodies
    ring = shape == "ring"
    assert len(body.segments) == len(body.ghosts) == 30
    assert len(body.joints) == 30 if ring else 29


@pytest.mark.parametrize(
    ("mesh", "said"),
    [
        ({"vertices": np.eye(3), "lines": [[0, 1], [1, 0]]}, r"line \[0, 1\] is there 2 times"),
        ({"vertices": np.eye(3), "lines": [[0, 0]]}, "line 0 leads from vertex 0 to itself"),
        ({"vertices": np.eye(3), "lines": [[0, 3]]}, r"lines\[0\] = \[0, 3\] is out of range"),
        ({"vertices": np.eye(3), "lines": [[0, 1]]}, "1 vertices belong to no line, first vertex 2"),
        ({"vertices": np.zeros((2, 3)), "lines": [[0, 1]]}, r"line \[0, 1\] has no length"),
        ({"vertices": np.eye(4)[:, :3], "lines": [[0, 1], [0, 2], [0, 3]]}, "vertex 0 joins 3 lines; a rod does not branch"),
        ({"vertices": np.eye(3), "triangles": [[0, 1, 2]]}, "holds no lines; a rod needs at least one"),
        ({"shape": "box"}, 'shape "box" does not fit; shapes of lines are for rods: "rope", "ring", "coil", "knot"'),
        ({"vertices": [[0, 0, 0], [np.nan, 0, 0]], "lines": [[0, 1]]}, "are not finite"),
    ],
)
def test_what_is_no_rod_is_refused(mesh, said):
    with pytest.raises(SceneError, match=said):
        pdipc.build(made(mesh), "cpu")


def test_lines_are_for_rods_alone():
    for kind in ("solid", "cloth"):
        body = {"name": "b", "kind": kind, "mesh": {"shape": "ring"}}
        with pytest.raises(SceneError, match='"ring" does not fit'):
            pdipc.build(pdipc.Scene(bodies=[body]), "cpu")


def test_settings_that_do_not_go_together():
    rope = {"shape": "rope", "segments": 4}
    for simulation, contact, said in (
        ({"nonlinear_solver": "local-global"}, {}, "no local projection belongs to twist"),
        ({}, {"method": "paper"}, "the paper's contact does not know"),
    ):
        scene = pdipc.Scene(bodies=[{"name": "r", "kind": "rod", "mesh": rope}], simulation=simulation, contact=contact)
        with pytest.raises(SceneError, match=said):
            pdipc.build(scene, "cpu")
    with pytest.raises(ValueError, match="without bending_stiffness"):
        made(rope, material={"bending_stiffness": 0.0, "twist_stiffness": 1.0})
    twists_freely = made(rope, material={"bending_stiffness": 0.0})
    assert len(assemble(twists_freely).bodies[0].ghosts) == 0


def test_parts_that_start_nearer_than_the_thickness_are_found():
    rope = {"shape": "rope", "segments": 10, "length": 1.0}
    two = [
        {
            "name": name,
            "kind": "rod",
            "mesh": rope,
            "translation": (0, y, 0),
            "rotation": (0, turn, 0),
            "material": {"radius": 0.01},
        }
        for name, y, turn in (("a", 0.0, 0.0), ("b", 0.019, 80.0))
    ]
    (finding,) = pdipc.check_scene(pdipc.Scene(bodies=two))
    assert finding.where == 'body "a" and body "b"' and "minimum separation of 0.02 m" in finding.right
    crossed = [two[0], {**two[1], "translation": (0, 0, 0)}]
    (finding,) = pdipc.check_scene(pdipc.Scene(bodies=crossed))
    assert "pairs of segments and triangles intersect" in finding.found


def test_who_holds_a_segment_holds_its_twist():
    rope = {"shape": "rope", "segments": 4}
    pins = [{"select": {"vertices": [0, 1, 3]}}, {"select": {"vertices": [4]}}]
    assembly = assemble(made(rope, pins=pins))
    assert [pin.vertices.tolist() for pin in assembly.pins] == [[0, 1, 3, 5], [4]]
    with pytest.raises(SceneError, match="has the vertices 0 to 4"):  # ghost points have no name
        assemble(made(rope, pins=[{"select": {"vertices": [5]}}]))


def test_ghost_points_follow_bending_without_twist():
    """A straight rod that starts as a helix, and a ring that starts warped: twist is what it was, as far as a ring can."""
    n = 40
    s = np.linspace(0, 1, n + 1)
    rest = np.column_stack([s, 0 * s, 0 * s])
    angle = 6 * s
    start = np.column_stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.2 * s])
    segments, joints = rods.in_order(np.column_stack([np.arange(n), np.arange(1, n + 1)]), "here")
    ghosts, moved = rods.ghost_points(rest, start, segments, joints, 0.01)
    for points, marks in ((rest, ghosts), (start, moved)):
        ends = points[segments]
        arm = marks - ends.mean(axis=1)
        assert np.linalg.norm(arm, axis=1) == pytest.approx(0.5 / n, rel=1e-12)
        assert np.abs(np.einsum("ij,ij->i", arm, ends[:, 1] - ends[:, 0])).max() < 1e-15
    tangents = np.diff(start, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    arm = (moved - start[segments].mean(axis=1)) * (1 - 2 * (np.arange(n) % 2))[:, None] * 2 * n
    for a in range(n - 1):
        cross = np.cross(tangents[a], tangents[a + 1])
        carried = (
            arm[a] + np.cross(cross, arm[a]) + np.cross(cross, np.cross(cross, arm[a])) / (1 + tangents[a] @ tangents[a + 1])
        )
        assert np.abs(carried - arm[a + 1]).max() < 1e-12


def test_a_rod_survives_saving(tmp_path):
    scene = made({"shape": "coil", "turns": 2.0}, material={"radius": 2e-3, "young_modulus": 1e8})
    scene.save(tmp_path / "s.toml")
    again = pdipc.load_scene(tmp_path / "s.toml")
    assert again.bodies[0].material.bending_stiffness == scene.bodies[0].material.bending_stiffness
    assert again == scene
    whole = pdipc.Scene.model_validate_json(scene.model_dump_json())
    assert whole.bodies[0].material.twist_stiffness == scene.bodies[0].material.twist_stiffness
