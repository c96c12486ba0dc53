"""Starts that intersect: found, separated within a bound, drawn, written anew."""

import data
import numpy as np
import pytest
from physics.scenes import cloth, floor, scene, solid
from typer.testing import CliRunner

import pdipc
from pdipc.cli import app
from pdipc.scene.assembly import assemble
from pdipc.scene.check import check
from pdipc.scene.distances import closest_on_segments, closest_on_triangles, winding_numbers
from pdipc.scene.errors import SceneWarning
from pdipc.scene.generators import Grid
from pdipc.scene.repair import repaired
from pdipc.scene.separate import separate


def test_closest_points_against_brute_force():
    rng = np.random.default_rng(0)
    points, corners = rng.normal(size=(200, 3)), rng.normal(size=(200, 3, 3))
    weights = closest_on_triangles(points, corners)
    assert weights.min() >= 0.0 and np.allclose(weights.sum(axis=1), 1.0)
    found = np.linalg.norm(np.einsum("kc,kci->ki", weights, corners) - points, axis=1)
    tried = rng.dirichlet([0.4, 0.4, 0.4], size=3000)
    brute = np.linalg.norm(np.einsum("tc,kci->kti", tried, corners) - points[:, None], axis=2).min(axis=1)
    assert np.all(found <= brute + 1e-12) and np.all(brute <= found + 0.15)
    e, f = rng.normal(size=(2, 200, 2, 3))
    s, t = closest_on_segments(e, f)
    ways = np.linspace(0.0, 1.0, 60)

    def at(segments, part):
        return segments[:, 0] + part[:, None] * (segments[:, 1] - segments[:, 0])

    found = np.linalg.norm(at(e, s) - at(f, t), axis=1)
    grid = [np.linalg.norm(at(e, np.full(200, a)) - at(f, np.full(200, b)), axis=1) for a in ways for b in ways]
    assert np.all(found <= np.min(grid, axis=0) + 1e-12) and np.all(np.min(grid, axis=0) <= found + 0.1)


def test_winding_numbers_are_one_inside_and_zero_outside():
    box = assemble(scene([solid("box", (1, 1, 1), (2, 2, 2))]))
    points = np.array([[0.0, 0.0, 0.0], [0.4, -0.3, 0.2], [0.6, 0.0, 0.0], [3.0, 3.0, 3.0]])
    np.testing.assert_allclose(winding_numbers(points, box.positions[box.triangles]), [1, 1, 0, 0], atol=1e-12)


def judged(made, limit=None):
    """What separating the scene gives, after which nothing may be left to put right."""
    assembly = assemble(made)
    done = separate(assembly, limit)
    assert np.linalg.norm(done.positions - assembly.positions, axis=1).max() <= done.limit * (1 + 1e-12)
    held = assembly.scripted
    assert np.array_equal(done.positions[held], assembly.positions[held])
    assembly.positions = done.positions
    assert done.left == []
    assert check(assembly) == []
    return assembly, done


@pytest.mark.parametrize("depth", [1e-3, 3e-3, 1e-2, 3e-2])
def test_solids_that_overlap_move_apart_as_a_whole(depth):
    """A box sunk into another: together they move by the depth and a gap, and keep their shapes."""
    boxes = [solid("low", (0.2,) * 3, (3,) * 3), solid("high", (0.2,) * 3, (3,) * 3, at=(0.02, 0.2 - depth, 0.01))]
    assembly, done = judged(scene(boxes))
    assert done.crossings > 0 and set(done.moved) == {"low", "high"}
    assert depth < sum(done.moved.values()) < 2.5 * depth + 2e-3
    for body in assembly.bodies:
        own = slice(body.first, body.last)
        moved = done.positions[own] - assembly.rest_positions[own]
        np.testing.assert_allclose(moved, np.broadcast_to(moved[:1], moved.shape), atol=1e-12)


def test_a_ball_in_the_floor_rises_by_its_depth():
    depth = 0.01
    ball = {
        "name": "ball",
        "kind": "solid",
        "mesh": {"shape": "sphere", "radius": 0.1, "cells": 8},
        "translation": [0, 0.1 - depth, 0],
    }
    assembly, done = judged(scene([ball], [floor()]))
    assert depth < done.moved["ball"] < 1.5 * depth + 2 * assembly.activation_distance


@pytest.mark.parametrize("depth", [0.0, 0.01, 0.03])
def test_cloth_that_starts_in_a_body_comes_out_of_it(depth):
    """No further than it was in, and a gap; elements hardly strained elsewhere."""
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.3, "cells": 10}}
    assembly, done = judged(scene([cloth("sheet", (0.8, 0.8), (16, 16), at=(0, 0.3 - depth, 0))], [ball]))
    assert done.moved["sheet"] < depth + 2 * assembly.activation_distance


def waving(name, y, seed, amplitude, cells=14):
    """A sheet with waves about the height y."""
    mesh, rng = Grid(size=(0.5, 0.5), cells=(cells, cells)).mesh(), np.random.default_rng(seed)
    start = mesh.vertices + np.array([0.0, y, 0.0])
    for _ in range(4):
        start[:, 1] += amplitude / 4 * np.sin(mesh.vertices[:, [0, 2]] @ rng.uniform(3, 14, 2) + rng.uniform(0, 6))
    return {"name": name, "kind": "cloth", "mesh": {"vertices": mesh.vertices, "triangles": mesh.triangles, "start": start}}


@pytest.mark.parametrize("amplitude", [6e-3, 1.2e-2])
@pytest.mark.parametrize("seed", [0, 1])
def test_layers_of_cloth_that_cut_through_each_other(amplitude, seed):
    _, done = judged(scene([waving(f"layer {k}", 3e-3 * k, 7 * seed + k, amplitude) for k in range(3)]))
    assert done.crossings > 100
    assert max(done.moved.values()) < 1.5 * amplitude


def test_the_folds_of_one_cloth_that_cut_through_each_other():
    mesh = Grid(size=(0.5, 0.5), cells=(12, 12)).mesh()
    n = len(mesh.vertices)
    low, high = (np.array(waving("", y, k, 8e-3, 12)["mesh"]["start"]) for k, y in enumerate((0.0, 3e-3)))
    vertices = np.concatenate([mesh.vertices, mesh.vertices + np.array([0, 0.2, 0])])
    both = {"vertices": vertices, "triangles": np.concatenate([mesh.triangles, mesh.triangles + n])}
    both["start"] = np.concatenate([low, high])
    _, done = judged(scene([{"name": "both", "kind": "cloth", "mesh": both}]))
    assert done.crossings > 0


@pytest.mark.parametrize("degrees", [2, 8, 12])
def test_sheets_that_cross_along_a_line_through_both(degrees):
    sheets = [
        cloth("a", (0.4, 0.4), (12, 12)),
        cloth("b", (0.4, 0.4), (12, 12), at=(0.003, 0, 0.002), rotation=(0, 3, degrees)),
    ]
    _, done = judged(scene(sheets))
    most = 0.2 * np.sin(np.deg2rad(degrees))  # half of a sheet is so deep, at most, and both give way
    assert done.crossings > 40 and max(done.moved.values()) < most + 0.01


@pytest.mark.parametrize("degrees", [3, 8])
def test_sheets_that_cross_along_a_line_that_ends_within_both(degrees):
    other = cloth("b", (0.4, 0.4), (12, 12), at=(0.15, 0.001, 0.2), rotation=(degrees, 5, degrees))
    _, done = judged(scene([cloth("a", (0.4, 0.4), (12, 12)), other]))
    assert done.crossings > 20 and max(done.moved.values()) < 0.04


def across(depth, pinned=()):
    """A sheet, and another at right angles to it whose lower edge reaches through it by `depth`, m, in the mean."""
    sheets = cloth("a", (0.4, 0.4), (8, 8)), cloth("b", (0.4, 0.4), (8, 8), at=(0.01, 0.2 - depth, 0.0), rotation=(0, 3, 90))
    for sheet in sheets:
        if sheet["name"] in pinned:
            sheet["pins"] = [{"select": {"vertices": [0]}}]
    return scene(sheets)


@pytest.mark.parametrize("pinned", ["", "a", "b"])
def test_sheets_across_each_other_part_as_wholes(pinned):
    """One moves out of the other, unstrained, by as much as it reaches through; what is pinned stays."""
    start = assemble(across(0.03, pinned))
    _, done = judged(across(0.03, pinned))
    ((name, far),) = done.moved.items()
    deep = -start.positions[:, 1].min()  # of the lowest corner
    assert name not in pinned and deep < far < deep + start.activation_distance
    body = next(body for body in start.bodies if body.name == name)
    own = slice(body.first, body.last)
    np.testing.assert_allclose(np.ptp(done.positions[own] - start.positions[own], axis=0), 0.0, atol=1e-12)


def test_sheets_across_each_other_are_left_and_named_where_either_way_is_too_far():
    assert separate(assemble(across(0.2))).left == [("a", "b")]
    assert separate(assemble(across(0.03, "ab"))).left == [("a", "b")]
    judged(across(0.2), 0.25)


def test_a_skirt_that_starts_in_a_body():
    """Real meshes: a body of eight parts that intersect each other, with holes."""
    skirt, body = np.load(data.path("meshes/cloth/skirt_16k.npz")), np.load(data.path("meshes/cloth/mannequin_25k.npz"))
    garment = {"vertices": skirt["V"] * [0.55, 1, 0.55] + np.array([0, 0.15, -0.02]), "triangles": skirt["F"]}
    obstacle = {"name": "body", "mesh": {"vertices": body["V"], "triangles": body["F"]}}
    made = scene([{"name": "skirt", "kind": "cloth", "mesh": garment}], [obstacle], contact={"activation_distance": 2e-3})
    done = separate(assemble(made))
    assert done.left == [] and done.crossings > 100 and done.moved["skirt"] < 0.02


def test_what_would_have_to_go_too_far_is_left_and_told():
    ball = {
        "name": "ball",
        "kind": "solid",
        "mesh": {"shape": "sphere", "radius": 0.1, "cells": 6},
        "translation": [0, 0.05, 0],
    }
    made = scene([ball], [floor()], contact={"start": "separate", "start_limit": 0.02})
    with pytest.raises(
        pdipc.SceneError, match=r"intersect at the start.*move them apart; raising contact.start_limit may help"
    ):
        pdipc.Simulation(made, "cpu")
    assert separate(assemble(made), 0.02).left == [("ball", "floor")]
    judged(made, 0.1)


def test_a_simulation_begins_from_the_separated_start(tmp_path):
    """With a word for what was moved, in Python and in the run folder; and nothing is shot away."""
    made = scene([solid("block", (0.2,) * 3, (2,) * 3, at=(0, 0.095, 0))], [floor()], contact={"start": "separate"}, steps=5)
    with pytest.warns(SceneWarning, match=r'body "block": moved by up to 0\.00\d+ m'):
        simulation = pdipc.Simulation(made, "cpu")
    for _ in range(5):
        assert simulation.step().converged
    assert np.abs(simulation.state.velocities.numpy()).max() < 0.5
    with pytest.warns(SceneWarning, match="moved"):
        pdipc.run_scene(made, tmp_path / "run", device="cpu")
    assert 0.005 < pdipc.open_run(tmp_path / "run").meta["moved_at_the_start"]["block"] < 0.01


def test_findings_name_triangles_and_a_place_on_both():
    made = scene([solid("block", (0.2,) * 3, (2,) * 3, at=(0, 0.095, 0))], [floor()])
    (found,) = check(assemble(made))
    assert 'body "block" and obstacle "floor"' in str(found) and 'contact.start = "separate"' in str(found)
    numbers = str(found).split("(triangles ")[1].split(", ")[0].split(" and ")
    block, ground = (int(each) for each in numbers)
    assembly = assemble(made)
    assert ground in (0, 1)
    assert assembly.positions[assembly.bodies[0].triangles[block]][:, 1].min() < 0.0


def test_start_limit_alone_is_refused():
    with pytest.raises(pdipc.SceneError, match="start_limit has no effect unless"):
        scene([solid("block", (1, 1, 1), (1, 1, 1))], contact={"start_limit": 0.1})


def test_check_scene_draws_and_repairs(tmp_path):
    wrong, right, picture = tmp_path / "wrong.toml", tmp_path / "right.toml", tmp_path / "start.png"
    sheets = cloth("sheet", [0.4, 0.4], [4, 4], at=[0, 0.3, 0], copies={"counts": [1, 2, 1], "spacing": [1, 0.4, 1]})
    block = solid("block", [0.2] * 3, [2] * 3, at=[0, 0.21, 0], rotation=[0, 30, 0], scale=1.1)
    scene([sheets, block], [floor(2.0)]).save(wrong)
    told = CliRunner().invoke(app, ["check-scene", str(wrong)])
    assert (told.exit_code, 'body "sheet[0]" and body "block"' in told.stdout) == (1, True)
    made = CliRunner().invoke(app, ["check-scene", str(wrong), "--repair", str(right)])
    assert made.exit_code == 0, made.stdout + made.stderr
    assert 'note: body "sheet[0]": moved by up to' in made.stdout
    assert CliRunner().invoke(app, ["check-scene", str(right)]).exit_code == 0
    before, after = (assemble(pdipc.load_scene(each)) for each in (wrong, right))
    assert [body.name for body in after.bodies] == [body.name for body in before.bodies]
    np.testing.assert_allclose(after.rest_positions, before.rest_positions, atol=1e-12)
    assert not np.allclose(after.positions, before.positions)
    pytest.importorskip("pyvista", reason="needs pyvista (extra: pictures)")
    imageio = pytest.importorskip("imageio.v3", reason="needs imageio (extra: pictures)")
    reds = []
    for each in (wrong, right):
        CliRunner().invoke(app, ["check-scene", str(each), "--picture", str(picture)])
        pixels = imageio.imread(picture)[..., :3].astype(int)
        reds.append(int(((pixels[..., 0] > 120) & (pixels[..., 1:].max(axis=-1) < 70)).sum()))
    assert reds[0] > 1000 and reds[1] == 0


def test_a_scene_with_a_rigid_body_is_repaired():
    box = {"shape": "box", "size": [0.3, 0.3, 0.3], "cells": [1, 1, 1]}
    rigid = {"name": "rigid", "kind": "rigid", "mesh": box, "rotation": [0, 30, 0], "velocity": [0, 1, 0]}
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 5.0}, "translation": [0, -0.1, 0]}
    made, notes, left = repaired(pdipc.Scene(bodies=[rigid], obstacles=[floor]))
    assert len(notes) == 1 and not left
    simulation = pdipc.Simulation(made, "cpu")
    assert 0.05 < simulation.positions[:8, 1].mean() < 0.08
    assert simulation.step().converged
