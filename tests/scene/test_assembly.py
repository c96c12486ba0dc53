"""Assembly: one numbering, everything where the scene says."""

import numpy as np
import pytest

from pdipc.scene import generators
from pdipc.scene.assembly import assemble
from pdipc.scene.errors import SceneError
from pdipc.scene.meshes import tet_volumes
from pdipc.scene.schema import (
    Arrays,
    Attachment,
    Cloth,
    Copies,
    Motion,
    Obstacle,
    Pin,
    Scene,
    Selection,
    Solid,
    VertexForce,
    Wind,
)

BOX = generators.Box(size=(1, 1, 1), cells=(2, 2, 2))
GRID = generators.Grid(size=(1, 1), cells=(4, 4))


def test_numbering_is_one_for_all():
    scene = Scene(
        bodies=[Solid(name="a", mesh=BOX), Cloth(name="b", mesh=GRID, copies=Copies(counts=(2, 1, 1)))],
        obstacles=[Obstacle(name="c", mesh=BOX)],
    )
    whole = assemble(scene)
    assert [(body.name, body.first, body.last) for body in whole.bodies] == [
        ("a", 0, 27),
        ("b[0]", 27, 52),
        ("b[1]", 52, 77),
        ("c", 77, 77 + 26),  # an obstacle is its surface: the box's middle vertex is gone
    ]
    for number, body in enumerate(whole.bodies):
        assert set(np.unique(body.triangles)) <= set(range(body.first, body.last))
        assert np.all(whole.body_of_vertex[body.first : body.last] == number)
    assert whole.triangles.shape == (48 + 32 + 32 + 48, 3)
    assert whole.tets.shape == (48, 4)
    assert whole.kinematic_vertices.tolist() == list(range(77, 103))


def test_placement_is_scale_then_rotation_then_translation():
    arrays = Arrays(vertices=[[1, 0, 0], [0, 1, 0], [0, 0, 1]], triangles=[[0, 1, 2]])
    cloth = Cloth(name="c", mesh=arrays, scale=(2, 3, 4), rotation=(90, 0, 90), translation=(10, 0, 0))
    # about x: y -> z, z -> -y; then about z: x -> y, y -> -x
    assert assemble(Scene(bodies=[cloth])).positions == pytest.approx(np.array([[10, 2, 0], [10, 0, 3], [14, 0, 0]]))


def test_copies_stand_in_a_grid():
    solid = Solid(name="s", mesh=BOX, copies=Copies(counts=(2, 3, 1), spacing=(2, 5, 9)))
    whole = assemble(Scene(bodies=[solid]))
    centers = [whole.positions[body.first : body.last].mean(axis=0) for body in whole.bodies]
    assert centers == pytest.approx(np.array([[x, y, 0] for y in (0, 5, 10) for x in (0, 2)]))


def test_a_start_pose_differs_from_rest():
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    solid = Solid(name="s", mesh=Arrays(vertices=rest, tets=[[0, 1, 2, 3]], start=rest * [2, 1, 1]), translation=(0, 5, 0))
    whole = assemble(Scene(bodies=[solid]))
    assert tet_volumes(whole.rest_positions, whole.tets) == pytest.approx(1 / 6)
    assert tet_volumes(whole.positions, whole.tets) == pytest.approx(1 / 3)
    assert whole.positions[0] == pytest.approx([0, 5, 0])


def test_initial_spin_is_about_the_centre_of_mass():
    cone = generators.Cylinder(radius=0.2, length=1, cells=(4, 4)).mesh()
    cone.vertices[:, [0, 2]] *= 1 - 0.5 * cone.vertices[:, 1:2]
    solid = Solid(
        name="s",
        mesh=Arrays(vertices=cone.vertices, tets=cone.tets),
        rotation=(10, 20, 30),
        velocity=(1, 2, 3),
        angular_velocity=(5, 0, 0),
    )
    whole = assemble(Scene(bodies=[solid]))
    volumes = tet_volumes(whole.positions, whole.tets)
    momentum = volumes @ whole.velocities[whole.tets].mean(axis=1)
    assert momentum / volumes.sum() == pytest.approx([1, 2, 3])
    away = whole.positions - whole.positions[0]
    assert whole.velocities - whole.velocities[0] == pytest.approx(np.cross([5, 0, 0], away))


def test_distances_follow_from_the_scene_size():
    floor = Obstacle(name="floor", mesh=generators.Plane(size=100), minimum_separation=0.1)
    whole = assemble(Scene(bodies=[Solid(name="s", mesh=BOX)], obstacles=[floor]))
    assert whole.scene_size == pytest.approx(3**0.5), "obstacles do not count"
    assert whole.activation_distance == pytest.approx(1e-3 * 3**0.5)
    assert whole.minimum_separation == pytest.approx(2e-5 * 3**0.5)
    assert [body.half_separation for body in whole.bodies] == pytest.approx([1e-5 * 3**0.5, 0.05])


@pytest.mark.parametrize(
    ("select", "expected"),
    [
        (Selection(vertices=[3, 1, 3]), [1, 3]),
        (Selection(box=((-1, 0, -0.51), (-0.45, 0, 1))), [0, 1, 2, 3, 4]),
        (Selection(sphere=((0.5, 0, 0.5), 0.3)), [19, 23, 24]),
        (Selection(nearest=(0.1, 0, 0)), [12]),
        (Selection(all=True), list(range(25))),
        (Selection(box=((5, 5, 5), (6, 6, 6))), []),
    ],
)
def test_selections(select, expected):
    cloth = Cloth(name="c", mesh=GRID, pins=[Pin(select=select, stiffness=1)])
    assert assemble(Scene(bodies=[Solid(name="s", mesh=BOX), cloth])).pins[0].vertices.tolist() == [27 + i for i in expected]


def test_selections_keep_to_their_body():
    cloth = Cloth(name="c", mesh=GRID, pins=[Pin(select=Selection(vertices=[25]))])
    with pytest.raises(SceneError, match=r'body "c", pins\[0\]: vertex 25 is out of range; body "c" has the vertices 0 to 24'):
        assemble(Scene(bodies=[cloth]))


def test_hard_pins_and_obstacles_follow_their_motion():
    turning = Motion(angular_velocity=(0, np.pi / 2, 0))
    cloth = Cloth(name="c", mesh=GRID, velocity=(1, 0, 0), pins=[Pin(select=Selection(vertices=[0, 4]), motion=turning)])
    floor = Obstacle(name="o", mesh=generators.Plane(size=1), translation=(0, -1, 0), motion=Motion(velocity=(0, 2, 0)))
    whole = assemble(Scene(bodies=[cloth], obstacles=[floor]))
    assert whole.kinematic_vertices.tolist() == [0, 4, 25, 26, 27, 28]
    assert whole.kinematic_positions(0.0) == pytest.approx(whole.positions[whole.kinematic_vertices])
    later = whole.kinematic_positions(1.0)
    # the pins are at x = -0.5, z = -0.5 and 0.5; a quarter turn about their middle takes +z to +x
    assert later[:2] == pytest.approx(np.array([[-1, 0, 0], [0, 0, 0]]), abs=1e-12)
    assert later[2:] == pytest.approx(whole.positions[25:] + np.array([0, 2, 0]))
    assert np.all(whole.velocities[whole.kinematic_vertices] == 0)
    assert np.all(whole.velocities[[1, 2, 3]] == [1, 0, 0])


def test_attachments_join_pairs_or_what_is_near():
    cloth, other = Cloth(name="a", mesh=GRID), Cloth(name="b", mesh=GRID, translation=(0.9, 0.1, 0))
    near = Attachment(bodies=("a", "b"), within=0.15, stiffness=7)
    given = Attachment(bodies=("b", "a"), pairs=[(0, 24)], rest_length=0.0)
    whole = assemble(Scene(bodies=[cloth, other], attachments=[near, given]))
    first, second = whole.attachments
    assert first.vertices_a.tolist() == [20, 21, 22, 23, 24]
    assert first.vertices_b.tolist() == [25, 26, 27, 28, 29]
    assert first.rest_lengths == pytest.approx(np.full(5, 0.02**0.5))
    assert (second.vertices_a.tolist(), second.vertices_b.tolist(), second.rest_lengths.tolist()) == ([25], [24], [0])


def test_a_vertex_force_is_shared_and_wind_is_felt_by_the_named():
    bodies = [Cloth(name="a", mesh=GRID), Cloth(name="b", mesh=GRID, translation=(0, 1, 0))]
    push = VertexForce(body="b", select=Selection(vertices=[0, 1, 2, 3]), force=(0, 8, 0), start=1, end=2)
    wind = Wind(velocity=(1, 0, 0), bodies=["b"])
    whole = assemble(Scene(bodies=bodies, forces=[push, wind]))
    assert whole.forces[0].vertices.tolist() == [25, 26, 27, 28]
    assert whole.forces[0].force.tolist() == [0, 2, 0]
    assert (whole.forces[0].start, whole.forces[0].end, whole.winds[0].end) == (1, 2, np.inf)
    assert np.array_equal(whole.winds[0].triangles, whole.bodies[1].triangles)


FLOOR = Obstacle(name="o", mesh=generators.Plane(size=1), translation=(0, -1, 0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"attachments": [Attachment(bodies=("a", "z"), within=1)]}, r'attachments\[0\]: there is no body "z"; there are: a'),
        ({"forces": [Wind(velocity=(1, 0, 0), bodies=["z"])]}, r'forces\[0\]: there is no body "z"'),
        (
            {"attachments": [Attachment(bodies=("a", "a"), pairs=[(0, 2**32 + 1)])]},
            r"attachments\[0\]: vertex 4294967297 is out",
        ),
        ({"forces": [Wind(velocity=(1, 0, 0), bodies=["a", "a"])]}, r"forces\[0\]: names a body more than once: a, a"),
        (
            {"obstacles": [FLOOR], "forces": [Wind(velocity=(1, 0, 0), bodies=["o"])]},
            r'forces\[0\]: obstacle "o" feels no force',
        ),
        (
            {"obstacles": [FLOOR], "forces": [VertexForce(body="o", select=Selection(all=True), force=(0, 1, 0))]},
            r'forces\[0\]: obstacle "o" feels no force; it must be a body',
        ),
        (
            {"bodies": [Cloth(name="a", mesh=Arrays(vertices=np.eye(3), triangles=[[2**32, 1, 2]]))]},
            r'body "a": mesh: triangles\[0\] = \[4294967296, 1, 2\] is out of range',
        ),
        ({"bodies": [Solid(name="s", mesh=GRID)]}, r'body "s": a solid needs tetrahedra, its mesh has triangles only'),
    ],
)
def test_what_does_not_exist_is_refused(changes, message):
    with pytest.raises(SceneError, match=message):
        assemble(Scene(**({"bodies": [Cloth(name="a", mesh=GRID)]} | changes)))
