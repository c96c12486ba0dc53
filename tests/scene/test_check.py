"""Everything that is refused before a simulation, each with what the message must say; and that good scenes pass."""

import numpy as np
import pytest

from pdipc.model import build
from pdipc.scene import generators
from pdipc.scene.assembly import assemble
from pdipc.scene.check import (
    _fans,
    check,
    edge_edge_distances,
    point_segment_distances,
    refuse,
    smallest_activation,
    smallest_separation,
    vertex_triangle_distances,
    winding_number,
)
from pdipc.scene.errors import SceneError
from pdipc.scene.load import bundled_scenes, load_scene
from pdipc.scene.schema import (
    Arrays,
    Attachment,
    Cloth,
    Contact,
    Keyframe,
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
NOWHERE = Selection(sphere=((9, 9, 9), 1))
TET = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


def findings(*bodies, **others) -> str:
    return "\n".join(map(str, check(Scene(bodies=list(bodies), **others))))


@pytest.mark.parametrize("name", bundled_scenes())
def test_bundled_scenes_can_be_simulated(name):
    if name == "bear_on_stairs":
        pytest.importorskip("pxr", reason='the extra "usd" is not installed')
    scene = load_scene(name)
    assert check(scene) == []
    assert check(scene, "float32") == [], "and in single precision"


def test_bodies_that_intersect():
    text = findings(Solid(name="a", mesh=BOX), Cloth(name="b", mesh=GRID, translation=(0.9, 0.1, 0)))
    assert 'body "a" and body "b"' in text
    assert "pairs of triangles intersect at the start, one near (0.5, 0.1" in text
    assert text.count("\n") == 0, "one finding says it"


def test_a_body_that_passes_through_itself():
    sheet = GRID.mesh()
    folded = sheet.vertices.copy()
    folded[folded[:, 0] > 0.2] += [-0.6, 0.01, 0.05]
    folded[-1] -= [0, 0.1, 0]
    text = findings(Cloth(name="c", mesh=Arrays(vertices=sheet.vertices, triangles=sheet.triangles, start=folded)))
    assert text.startswith('body "c": ')
    assert "the surface must not pass through itself" in text


def gap(distance: float, **contact) -> str:
    """Two boxes one above the other."""
    boxes = Solid(name="a", mesh=BOX), Solid(name="b", mesh=BOX, rotation=(0, 30, 0), translation=(0.1, 1 + distance, 0))
    return findings(*boxes, contact=Contact(activation_distance=0.01, **contact))


def test_bodies_nearer_than_the_minimum_separation():
    assert gap(0.0003, minimum_separation=2e-4) == ""
    text = gap(0.0001, minimum_separation=2e-4)
    assert 'body "a" and body "b"' in text
    assert "start too close, the nearest 0.0001 m apart near (" in text
    assert "their gap must be more than the minimum separation of 0.0002 m" in text


def test_the_separation_of_a_pair_is_the_mean_of_its_bodies():
    box = Solid(name="a", mesh=BOX, translation=(0, 0.515, 0))

    def above(separation: float) -> str:
        floor = Obstacle(name="floor", mesh=generators.Plane(), minimum_separation=separation)
        return findings(box, obstacles=[floor], contact=Contact(minimum_separation=2e-4))

    assert above(0.0297) == ""
    assert "more than the minimum separation of 0.0151 m" in above(0.03)


def test_fine_cloth_nearer_to_itself_than_the_separation_is_fine():
    assert findings(Cloth(name="c", mesh=generators.Grid(size=(1, 1), cells=(50, 50)), minimum_separation=0.05)) == ""


def test_obstacles_may_overlap_each_other():
    obstacles = [Obstacle(name=name, mesh=BOX, translation=(0, y, 0)) for name, y in (("o", 0), ("p", 0.5))]
    assert findings(Solid(name="a", mesh=BOX, translation=(0, 5, 0)), obstacles=obstacles) == ""


def test_an_obstacle_that_faces_inward_holds_what_is_inside():
    inside = Solid(name="s", mesh=BOX, scale=0.5)
    (finding,) = check(Scene(bodies=[inside], obstacles=[Obstacle(name="o", mesh=BOX)]))
    assert str(finding).endswith("an obstacle that is to hold bodies must be open, or face inward (inward = true)")
    assert not check(Scene(bodies=[inside], obstacles=[Obstacle(name="o", mesh=BOX, inward=True)]))


@pytest.mark.parametrize(
    ("tets", "vertices", "message"),
    [
        ([[0, 1, 2, 3], [0, 2, 1, 4]], [*TET, [0.3, 0.3, 1.0]], "1 of 2 tets are inverted, first tets[1] = [0, 2, 1, 4]"),
        ([[0, 1, 2, 3], [0, 1, 2, 4]], [*TET, [0.3, 0.3, 0.0]], "1 of 2 tets have no volume, first tets[1] = [0, 1, 2, 4]"),
        ([[0, 1, 2, 3], [1, 2, 0, 3]], TET, "1 tets are there more than once"),
        ([[0, 1, 2, 3]], [*TET, [5, 5, 5]], "1 vertices belong to no tet, first vertex 4"),
        (
            [[0, 1, 2, 3]],
            TET * [[1], [np.nan], [1], [1]],
            "rest_positions of 1 vertices are not finite, first vertex 1 = [nan, nan, nan]",
        ),
    ],
)
def test_bad_tets(tets, vertices, message):
    assert message in findings(Solid(name="s", mesh=Arrays(vertices=vertices, tets=tets)))


@pytest.mark.parametrize(
    ("triangles", "message"),
    [
        ([[0, 1, 2], [0, 1, 3], [1, 0, 4]], "1 edges of its surface belong to more than two triangles, first [0, 1]"),
        ([[0, 1, 2], [2, 1, 0], [0, 3, 4]], "1 triangles are there more than once"),
        ([[0, 1, 2], [3, 4, 5]], "1 of 2 triangles have no area, first triangles[1] = [3, 4, 5]"),
    ],
)
def test_bad_triangles(triangles, message):
    vertices = np.array([*TET, [1, -1, -1], [2, -2, -3]])[: np.max(triangles) + 1]
    text = findings(Cloth(name="c", mesh=Arrays(vertices=vertices, triangles=triangles)))
    assert message in text


def fan(center: int, first: int, closed: bool) -> list[list[int]]:
    """Four triangles around a vertex, on a rim of the vertices from `first` on."""
    rim = [first + k for k in range(4 if closed else 5)]
    return [[center, rim[k], rim[(k + 1) % len(rim)]] for k in range(4)]


@pytest.mark.parametrize("kind", [Solid, Cloth])
def test_vertices_that_join_fans_of_triangles(kind):
    """Three cubes in a chain that only their corners hold together."""
    cube = generators.Box(size=(1, 1, 1), cells=(1, 1, 1)).mesh()
    vertices, number = np.unique(np.concatenate([cube.vertices + k for k in range(3)]), axis=0, return_inverse=True)
    tets = np.concatenate([number.ravel()[cube.tets + 8 * k] for k in range(3)])
    chain = kind(name="c", mesh=Arrays(vertices=vertices, tets=tets))
    assert findings(chain) == (
        'body "c": 2 vertices of its surface join fans of triangles that share no edge there: '
        "vertex 7 at (0.5, 0.5, 0.5) m joins 2, vertex 14 at (1.5, 1.5, 1.5) m joins 2; "
        "the surface must be a manifold: give each fan a vertex of its own, with a gap between them"
    )


@pytest.mark.parametrize(
    ("triangles", "fans"),
    [
        (fan(0, 1, True), 1),
        (fan(0, 1, False), 1),
        (fan(0, 1, True) + fan(0, 5, True), 2),
        (fan(0, 1, True) + fan(0, 5, False), 2),
        (fan(0, 1, False) + fan(0, 6, False) + [[0, 11, 12]], 3),
        ([[0, 1, 2], [2, 1, 3], [2, 4, 0]], 1),
        ([[0, 1, 2], [0, 2, 3], [4, 2, 0]], 1),  # an edge of three triangles, which is refused for that
        ([triangle[::-1] for triangle in fan(0, 1, True)[:2]] + fan(0, 1, True)[2:], 1),  # of two orientations
    ],
)
def test_counting_fans(triangles, fans):
    vertices, counts = _fans(np.array(triangles))
    assert np.array_equal(vertices, np.unique(triangles))
    assert counts.tolist() == [fans] + [1] * (len(counts) - 1)


def test_selections_of_nothing():
    cloth = Cloth(name="c", mesh=GRID, pins=[Pin(select=NOWHERE)])
    force = VertexForce(body="c", select=NOWHERE, force=(1, 0, 0))
    wind = Wind(velocity=(1, 0, 0))
    text = findings(cloth, forces=[wind, force], attachments=[Attachment(bodies=("c", "c"), pairs=[(1, 1)])])
    reach = 'selects no vertex; body "c" reaches from (-0.5, 0, -0.5) to (0.5, 0, 0.5) m at the start'
    assert f'body "c", pins[0].select = {NOWHERE}: {reach}' in text
    assert f"forces[1].select = {NOWHERE}: {reach}" in text
    assert "attachments[0]: attaches a vertex to itself" in text
    other = Cloth(name="d", mesh=GRID, translation=(0, 3, 0))
    assert "attachments[0]: attaches no vertex" in findings(cloth, other, attachments=[Attachment(bodies=("c", "d"), within=1)])


def test_a_vertex_held_by_two_pins():
    hold = Pin(select=Selection(vertices=[0, 1]))
    assert "1 vertices are held exactly by more than one pin" in findings(
        Cloth(name="c", mesh=GRID, pins=[hold, Pin(select=Selection(vertices=[1, 2]))])
    )
    assert findings(Cloth(name="c", mesh=GRID, pins=[hold, Pin(select=Selection(vertices=[1, 2]), stiffness=5)])) == ""


@pytest.mark.parametrize("large", ["obstacle", "body"])
def test_inside_each_other(large):
    """A surface that nothing crosses, and yet one starts inside the other."""
    small = {"mesh": BOX, "scale": 0.2}
    if large == "obstacle":
        text = findings(Solid(name="s", **small), obstacles=[Obstacle(name="o", mesh=BOX)])
        assert text.startswith('body "s": starts inside obstacle "o", at (')
    else:
        text = findings(Solid(name="s", mesh=BOX), obstacles=[Obstacle(name="o", **small)])
        assert text.startswith('obstacle "o": starts inside body "s", at (') and text.endswith("move it out")


def test_an_obstacle_that_faces_inward_is_a_container():
    box = BOX.mesh().surface()
    container = Obstacle(name="o", mesh=Arrays(vertices=box.vertices, triangles=box.triangles[:, ::-1]))
    assert findings(Solid(name="s", mesh=BOX, scale=0.2), obstacles=[container]) == ""
    assert findings(Cloth(name="s", mesh=GRID, scale=0.2), obstacles=[container]) == ""


def test_a_motion_that_begins_elsewhere():
    jump = Motion(keyframes=[Keyframe(time=0, translation=(0, -0.9, 0)), Keyframe(time=1)])
    plate = Obstacle(name="o", mesh=GRID, translation=(0, 1, 0), motion=jump)
    text = findings(Solid(name="s", mesh=BOX), obstacles=[plate])
    assert 'obstacle "o": its motion begins 0.9 m away from where it stands' in text


def test_separations_below_rounding():
    scene = Scene(bodies=[Solid(name="s", mesh=BOX, translation=(1000, 0, 0))])
    assert check(scene) == []
    scene.simulation.precision = "float32"
    (finding,) = check(scene)
    assert "is lost in the rounding of float32 coordinates up to 1000 m" in str(finding)
    least = smallest_separation(assemble(scene), "float32")
    assert least == pytest.approx(100 * 2.0**-14)
    scene.contact.minimum_separation = least
    assert check(scene) == []


def test_activation_distances_too_short_for_forces():
    scene = load_scene("box_stack")
    size = assemble(scene).body_sizes[1]
    scene.contact.activation_distance = 2e-9 * size
    (finding,) = check(scene)
    told = str(finding)
    assert told.startswith(f"contact.activation_distance: {2e-9 * size:.3g} m is so short a range that rounding decides")
    assert f"it must be at least {1e-7 * size:.3g} m: 1e-07 of the largest body's size of {size:.4g} m" in told
    scene.contact.activation_distance = smallest_activation(assemble(scene), "float64")
    assert check(scene) == []


def test_activation_distances_below_rounding():
    """In float32 it is the coordinates that count."""
    scene = Scene(bodies=[Solid(name="s", mesh=BOX, translation=(1000, 0, 0))], contact={"minimum_separation": 0.01})
    scene.simulation.precision = "float32"
    least = smallest_activation(assemble(scene), "float32")
    assert least == pytest.approx(10 * 2.0**-14)
    scene.contact.activation_distance = least
    assert check(scene) == []
    scene.contact.activation_distance = 0.99 * least
    (finding,) = check(scene)
    assert "10 roundings of float32 coordinates up to 1000 m" in str(finding)


def test_unreadable_meshes_are_found_together():
    text = findings(Solid(name="a", mesh="nowhere.msh"), Solid(name="b", mesh=GRID), Cloth(name="c", mesh=GRID))
    assert 'body "a": mesh file "nowhere.msh": there is no such file' in text
    assert 'body "b": a solid needs tetrahedra' in text


def test_everything_is_found_at_once_though_a_mesh_and_names_are_missing():
    unread = Solid(name="unread", mesh="nowhere.msh")
    held = Solid(name="held", mesh=BOX, pins=[Pin(select=NOWHERE), Pin(select=Selection(vertices=[10**6]))])
    within = Solid(name="within", mesh=BOX, translation=(0.5, 0, 0))
    scene = Scene(
        bodies=[unread, held, within],
        attachments=[Attachment(bodies=("held", name), pairs=[(0, 0)]) for name in ("unread", "unknown")],
        forces=[VertexForce(body="within", select=Selection(vertices=[10**6]), force=(1, 0, 0))],
    )
    text = "\n".join(map(str, check(scene)))
    for line in (
        'body "unread": mesh file "nowhere.msh": there is no such file',
        'body "held", pins[1]: vertex 1000000 is out of range',
        'attachments[1]: there is no body "unknown"; there are: held, within',
        "forces[0]: vertex 1000000 is out of range",
        'body "held", pins[0].select = ',
        'body "held" and body "within": ',
    ):
        assert line in text
    assert len(text.splitlines()) == 6
    with pytest.raises(SceneError, match="cannot be put together, 4 things"):
        assemble(scene)


@pytest.mark.parametrize("scene", ["thin_rod", {"bodies": []}, None])
def test_what_is_no_scene(scene):
    with pytest.raises(TypeError, match=f"a scene is a pdipc.Scene, not a {type(scene).__name__}: use"):
        check(scene)


def test_refuse_says_everything_in_one_error():
    scene = Scene(bodies=[Solid(name="a", mesh=BOX), Cloth(name="b", mesh=GRID, pins=[Pin(select=NOWHERE)])])
    with pytest.raises(SceneError, match="cannot be simulated, 2 things to put right:") as caught:
        refuse(scene, assemble(scene), "float64")
    assert len(str(caught.value).splitlines()) == 3
    scene = Scene(bodies=[Solid(name="a", mesh=BOX)])
    refuse(scene, assemble(scene), "float64")


@pytest.mark.parametrize(
    ("method", "simulation", "found"),
    [
        ("barrier", {"linear_solver": "a-jacobi"}, '"a-jacobi" cannot take the contacts of contact.method = "barrier"'),
        ("barrier", {"solver_drop": 0.01}, 'is 0.01, but only a-jacobi has A-products; the solver is "auto"'),
        ("paper", {"linear_solver": "pcg", "solver_drop": 0.01}, 'only a-jacobi has A-products; the solver is "pcg"'),
        ("paper", {"linear_solver": "auto", "solver_drop": 0.01}, ""),
        ("paper", {"linear_solver": "a-jacobi"}, ""),
    ],
)
def test_settings_that_do_not_go_together(method, simulation, found):
    """The check finds what a run refuses, beside what else is wrong."""
    scene = Scene(
        bodies=[Solid(name="a", mesh=BOX, pins=[Pin(select=NOWHERE)])], simulation=simulation, contact={"method": method}
    )
    text = "\n".join(map(str, check(scene)))
    assert found in text and "selects no vertex" in text
    assert len(text.splitlines()) == 1 + bool(found)
    with pytest.raises(SceneError) as caught:
        build(scene, "cpu")
    assert found in str(caught.value)


# --- the distances that the check uses ---


def sampled(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.linalg.norm(first[:, :, None] - second[:, None], axis=-1).min(axis=(1, 2))


@pytest.mark.parametrize("seed", range(3))
def test_distances_against_dense_sampling(seed):
    rng = np.random.default_rng(seed)
    e, f, triangle, p = rng.random((60, 2, 3)), rng.random((60, 2, 3)), rng.random((60, 3, 3)), rng.random((60, 3))
    s = np.linspace(0, 1, 101)
    weights = np.array([[1 - a - b, a, b] for a in s for b in s if a + b <= 1])
    on_e, on_f = (np.einsum("sk,nki->nsi", np.column_stack([1 - s, s]), edge) for edge in (e, f))
    on_triangle = np.einsum("sk,nki->nsi", weights, triangle)
    for exact, dense in (
        (edge_edge_distances(e, f), sampled(on_e, on_f)),
        (point_segment_distances(p, e[:, 0], e[:, 1]), sampled(p[:, None], on_e)),
        (vertex_triangle_distances(p, triangle), sampled(p[:, None], on_triangle)),
    ):
        assert np.all(exact <= dense + 1e-12)
        assert np.all(dense <= exact + 0.02)


def test_distance_of_parallel_edges():
    e = np.array([[[0, 0, 0], [1, 0, 0]]] * 3, dtype=float)
    f = np.array([[[0.5, 2, 0], [3, 2, 0]], [[2, 0, 0], [3, 0, 0]], [[-1, 0, 1], [3, 0, 1]]], dtype=float)
    assert edge_edge_distances(e, f) == pytest.approx([2, 1, 1])


def test_winding_number_is_one_inside_and_zero_outside():
    ball = generators.Sphere(radius=1, cells=6).mesh()
    corners = ball.vertices[ball.triangles]
    values = [winding_number(np.array(point), corners) for point in ([0, 0, 0], [0.6, 0.2, 0.5], [0, 1.1, 0], [5, 5, 5])]
    assert values == pytest.approx([1, 1, 0, 0], abs=1e-12)


def test_two_sides_that_rounding_brings_together_are_refused():
    """A sheet 0.2 mm thick, 5 km away: in float64 it is fine, in float32 its sides are in one place."""
    material = {"young_modulus": 1e5, "poisson_ratio": 0.0}
    mesh = {"shape": "box", "size": (0.05, 2e-4, 0.05), "cells": (2, 1, 2)}
    body = {"name": "thin", "kind": "solid", "mesh": mesh, "material": material, "translation": (4e3, 5e3, 3e3)}
    contact = {"minimum_separation": 0.06, "activation_distance": 0.2}
    for precision, refused in (("float64", False), ("float32", True)):
        found = check(Scene(bodies=[body], simulation={"precision": precision}, contact=contact))
        assert any("intersect at the start" in str(each) and "in float32 coordinates" in str(each) for each in found) == refused
        assert bool(found) == refused
