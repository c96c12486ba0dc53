"""Isosurface stuffing and the figures: closed manifolds of well-shaped tets that converge to what the level set encloses."""

import numpy as np
import pytest

from pdipc.judge.witness import find_intersections
from pdipc.scene import figures, generators
from pdipc.scene.frames import read_frames
from pdipc.scene.load import BUNDLED
from pdipc.scene.meshes import boundary, tet_volumes
from pdipc.scene.stuffing import _pinched, stuffed
from scene.test_generators import dihedral_angles

LOW, HIGH = -0.5 * np.ones(3), 0.5 * np.ones(3)
SMALLEST_ANGLE, LARGEST_ANGLE = 8.0, 165.0  # degrees; Labelle and Shewchuk prove 10.78 and 164.74 for their rule of diagonals


def ball(x):
    return np.linalg.norm(x, axis=1) - 0.5


def two_holes(x):
    """A plate with two round holes: the surface has genus 2."""
    plate = np.max(np.abs(x) - [0.48, 0.12, 0.3], axis=1)
    holes = [0.13 - np.hypot(x[:, 0] - side * 0.22, x[:, 2]) for side in (-1, 1)]
    return np.maximum(plate, np.maximum(*holes))


def check_solid(mesh, euler):
    """Positive tets, a surface that is a closed manifold of one piece and passes through itself nowhere."""
    assert tet_volumes(mesh.vertices, mesh.tets).min() > 0.0
    sides = mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(sides, axis=0)) == len(sides), "every edge is passed once each way"
    assert len(_pinched(mesh.tets)) == 0
    angles = dihedral_angles(mesh)
    assert angles.min() > SMALLEST_ANGLE and angles.max() < LARGEST_ANGLE
    assert len(find_intersections(mesh.vertices, mesh.triangles)) == 0
    if euler is not None:
        assert len(np.unique(mesh.triangles)) - len(sides) // 2 + len(mesh.triangles) == euler


@pytest.mark.parametrize("level, cell, euler", [(ball, 0.3, 2), (ball, 0.11, 2), (two_holes, 0.07, -2)])
def test_solids(level, cell, euler):
    check_solid(stuffed(level, LOW, HIGH, cell), euler)


def test_any_place_of_the_lattice_gives_good_tets():
    """The bound on angles does not depend on where the surface meets the lattice."""
    for shift in np.random.default_rng(3).uniform(-0.1, 0.1, (12, 3)):
        check_solid(stuffed(lambda x, s=shift: ball((x - s) * [1.0, 1.3, 1.6]), LOW - 0.1, HIGH + 0.1, 0.19), 2)


def test_volume_and_surface_converge():
    """Second order in the cell, and every vertex of the surface is on it."""
    errors = []
    for cell in (0.16, 0.08):
        mesh = stuffed(ball, LOW, HIGH, cell)
        errors.append(np.pi / 6 - tet_volumes(mesh.vertices, mesh.tets).sum())
        assert np.abs(ball(mesh.vertices[np.unique(mesh.triangles)])).max() < 1e-3 * cell
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.25)


def test_a_touching_pair_is_taken_apart():
    """Two tets that share an edge, and two that share a vertex, are no manifold; two that share a face are."""
    shared = {3: [4, 1, 2, 3], 2: [2, 3, 4, 5], 1: [3, 4, 5, 6]}
    for count, other in shared.items():
        tets = np.array([[0, 1, 2, 3], other])
        assert len(boundary(tets)) == (6 if count == 3 else 8)
        assert bool(len(_pinched(tets))) == (count < 3)


def test_what_is_thinner_than_a_cell_is_told():
    with pytest.raises(ValueError, match="thinner than a cell"):
        stuffed(lambda x: np.linalg.norm(x - 0.013, axis=1) - 0.01, LOW, HIGH, 0.25)


@pytest.mark.parametrize("name", figures.FIGURES)
def test_figures(name):
    """Coarse and finer, all in one piece, of the size that was asked for and centred."""
    for cells in (11, 17):
        mesh = figures.mesh(name, 0.8, cells)
        check_solid(mesh, None)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        assert (high - low).max() == pytest.approx(0.8)
        np.testing.assert_allclose(low, -high, atol=1e-12)


def test_level_of_a_single_part_is_its_distance():
    rod = figures.Figure([((0, 0, 0), (0, 1, 0), 0.2, 0.2)])
    at = np.array([[0.5, 0.5, 0.0], [0.0, 1.5, 0.0], [0.0, 0.5, 0.0]])
    np.testing.assert_allclose(rod.level(at), [0.3, 0.3, -0.2], atol=1e-12)


def test_holes_are_outside():
    pumpkin = figures.FIGURES["pumpkin"]
    eye = np.array([[0.145, 0.115, 0.38]])
    assert pumpkin.level(eye) > 0.0
    assert figures.Figure(pumpkin.parts, pumpkin.blend).level(eye) < 0.0


def test_the_dancers_cache_is_what_the_generator_makes():
    """The file beside the bundled scene: the dancer's surface, moved by `dance`; she starts at rest and never folds over."""
    frames, _ = read_frames(str(BUNDLED / "dancer.npz"), None)
    mesh = figures.mesh("dancer", 1.0, 26).surface()
    for points, time in zip(frames.points, frames.times, strict=True):
        np.testing.assert_allclose(points, figures.dance(mesh.vertices, time), atol=1e-6)
        assert len(find_intersections(points.astype(float), mesh.triangles)) == 0
    np.testing.assert_allclose(figures.dance(mesh.vertices, 1e-4), mesh.vertices, atol=1e-6)


@pytest.mark.parametrize("layers, waves", [(1, 0), (3, 7)])
def test_skirt(layers, waves):
    """Layers that nowhere touch, each a tube, outward, as long as said; without waves of the area of a cone."""
    skirt = generators.Skirt(waist=0.1, hem=0.3, length=0.4, layers=layers, waves=waves, cells=(60, 12))
    mesh = skirt.mesh()
    assert len(find_intersections(mesh.vertices, mesh.triangles)) == 0
    sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, uses = np.unique(sides, axis=0, return_counts=True)
    assert set(uses) == {1, 2} and np.count_nonzero(uses == 1) == layers * 2 * 60
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert (np.cross(b - a, c - a) * ((a + b + c) * [1, 0, 1])).sum(axis=1).min() > 0.0
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(0.4)
    if waves == 0:
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert area == pytest.approx(np.pi * (0.1 + 0.3) * np.hypot(0.4, 0.2), rel=5e-3)


def test_a_skirt_widens():
    with pytest.raises(ValueError, match="must be larger than waist"):
        generators.Skirt(waist=0.3, hem=0.2)
