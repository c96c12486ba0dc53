"""Generated shapes: closed, outward, of the right volume, without bad elements, symmetric."""

import numpy as np
import pytest

from pdipc.scene import generators
from pdipc.scene.meshes import TET_FACES, Mesh, tet_volumes, triangle_areas

PI = np.pi
CAP = (1 - np.cos(np.radians(80))) * 2 * PI / 3  # volume of a ball's sector of 80 degrees, per radius^3
CLOSED = {  # shape, exact volume, Euler characteristic of its surface, least dihedral angle in degrees
    "box": (generators.Box(size=(1, 2, 3), cells=(3, 4, 5)), 6.0, 2, 29),
    "sphere": (generators.Sphere(radius=0.5, cells=24), 4 / 3 * PI * 0.5**3, 2, 25),
    "coarse sphere": (generators.Sphere(radius=0.5, cells=3), None, 2, 20),
    "cylinder": (generators.Cylinder(radius=0.5, length=2, cells=(20, 20)), PI * 0.5, 2, 16),
    "rod": (generators.Cylinder(radius=0.01, length=0.04, cells=(2, 4)), None, 2, 20),
    "capsule": (generators.Capsule(radius=0.5, length=1, cells=(20, 20)), PI * 0.25 + 4 / 3 * PI / 8, 2, 20),
    "torus": (generators.Torus(major_radius=1, minor_radius=0.25, cells=(16, 100)), 2 * PI**2 * 0.25**2, 0, 14),
    "smallest torus": (generators.Torus(cells=(2, 3)), None, 0, 4),
    "bowl": (generators.Bowl(radius=1, thickness=0.1, opening=80, cells=(40, 2)), CAP * (1.1**3 - 1), 2, 10),
    "stairs": (generators.Stairs(steps=4, rise=0.2, run=0.3, width=2), 10 * 0.2 * 0.3 * 2, 2, 1),
}


def dihedral_angles(mesh: Mesh) -> np.ndarray:
    """(t, 6) degrees."""
    corners = mesh.vertices[mesh.tets]
    normals = np.stack([np.cross(*(corners[:, face[k]] - corners[:, face[0]] for k in (1, 2))) for face in TET_FACES])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    cosines = [-np.einsum("ij,ij->i", normals[i], normals[j]) for i in range(4) for j in range(i)]
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))).T


@pytest.mark.parametrize("name", CLOSED)
def test_solid_shapes(name):
    shape, volume, euler, angle = CLOSED[name]
    mesh = shape.mesh()
    volumes = tet_volumes(mesh.vertices, mesh.tets)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(np.einsum("ij,ij->", a, np.cross(b, c)) / 6), "the surface is closed and outward"
    if volume is not None:
        assert volumes.sum() == pytest.approx(volume, rel=2e-2)
    directed = mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed), "every edge is passed once each way"
    assert len(np.unique(mesh.triangles)) - len(directed) // 2 + len(mesh.triangles) == euler
    assert dihedral_angles(mesh).min() > angle


def test_volume_converges_to_the_ball():
    balls = [generators.Sphere(radius=1, cells=cells).mesh() for cells in (6, 12)]
    errors = [4 / 3 * PI - tet_volumes(ball.vertices, ball.tets).sum() for ball in balls]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1), "second order"


@pytest.mark.parametrize("name", ["box", "sphere", "capsule", "cylinder"])
def test_even_shapes_are_their_own_mirror_image(name):
    shape = {
        "box": generators.Box(cells=(4, 2, 6)),
        "sphere": generators.Sphere(cells=6),
        "capsule": generators.Capsule(cells=(4, 4)),
        "cylinder": generators.Cylinder(cells=(4, 4)),
    }[name]
    mesh = shape.mesh()

    def tets_at(vertices: np.ndarray) -> set:
        return {frozenset(map(tuple, tet)) for tet in np.round(vertices, 9)[mesh.tets] + 0.0}

    for axis in range(3):
        assert tets_at(mesh.vertices) == tets_at(mesh.vertices * np.where(np.arange(3) == axis, -1, 1))


@pytest.mark.parametrize("diagonals", ["alternating", "parallel"])
def test_grid_faces_up_and_covers_its_rectangle(diagonals):
    mesh = generators.Grid(size=(2, 3), cells=(5, 7), diagonals=diagonals).mesh()
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert np.cross(b - a, c - a)[:, 1].min() > 0
    assert triangle_areas(mesh.vertices, mesh.triangles).sum() == pytest.approx(6)
    assert len(mesh.triangles) == 70
    degree = np.bincount(np.unique(np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0).ravel())
    assert degree.max() == (8 if diagonals == "alternating" else 6)


def test_a_ring_without_a_hole_is_refused():
    with pytest.raises(ValueError, match="must be smaller than major_radius"):
        generators.Torus(major_radius=0.1, minor_radius=0.1)
