"""Flat faces: found where triangles are one convex polygon, and nowhere else; and what lies inside of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdipc.collision import faces, surface
from pdipc.scene import generators

TOLERANCE = 1e-6


def found(mesh, keeps=True, turned=True):
    x = Rotation.from_euler("xyz", (20, 30, 40), degrees=True).apply(mesh.vertices) if turned else mesh.vertices
    return faces.flat_faces(x, mesh.triangles, np.full(len(x), keeps), TOLERANCE)


def inside(mesh, face):
    edges = surface.unique_edges(mesh.triangles)
    at, vertices = faces.inside(mesh.triangles, face, edges, len(mesh.vertices))
    return int(at.sum()), int(vertices.sum())


def without(mesh, removed):
    """The mesh less the triangles whose centre satisfies `removed`."""
    mesh.triangles = mesh.triangles[~removed(mesh.vertices[mesh.triangles].mean(axis=1))]
    return mesh


def test_a_floor_of_many_triangles_is_one_polygon():
    mesh = generators.Grid(cells=(7, 5)).mesh()
    face = found(mesh)
    assert np.array_equal(face, np.zeros(70))
    assert inside(mesh, face) == (70 + 7 * 4 + 5 * 6 - 35, 6 * 4)  # a diagonal a cell, and the edges between cells


def test_a_box_has_six_faces_and_its_edges_and_corners_are_none_of_them():
    mesh = generators.Box(cells=(3, 3, 3)).mesh().surface()
    face = found(mesh)
    assert np.array_equal(np.bincount(face), [18] * 6)
    assert inside(mesh, face) == (6 * (9 + 12), 6 * 4)


@pytest.mark.parametrize("shape", [generators.Sphere(cells=6), generators.Torus(cells=(6, 12))])
def test_round_bodies_have_few_faces_and_no_vertex_inside_of_one(shape):
    mesh = shape.mesh()
    mesh = mesh.surface() if len(mesh.tets) else mesh
    assert inside(mesh, found(mesh))[1] == 0


def test_a_region_that_is_not_convex_is_cut_into_parts_that_are():
    floor = without(generators.Grid(size=(1.0, 1.0), cells=(8, 8)).mesh(), lambda c: (c[:, 0] > 0) & (c[:, 2] > 0))
    with_hole = without(
        generators.Grid(size=(1.0, 1.0), cells=(9, 9)).mesh(), lambda c: np.abs(c[:, [0, 2]]).max(axis=1) < 0.16
    )
    for mesh, fewest in ((floor, 2), (with_hole, 4)):
        face = found(mesh)
        assert (face >= 0).all() and fewest <= face.max() + 1 <= 12
        for part in range(face.max() + 1):
            corners = mesh.vertices[mesh.triangles[face == part]]
            area = 0.5 * np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).sum()
            hull = faces.ConvexHull(corners.reshape(-1, 3)[:, [0, 2]])
            assert hull.volume == pytest.approx(area, rel=1e-9)


def test_what_is_bent_folded_or_deforms_has_none():
    bent = generators.Grid(cells=(4, 4)).mesh()
    bent.vertices[:, 1] = 1e-3 * bent.vertices[:, 0] ** 2
    assert found(bent).max() <= 3  # strips along the bend, which are flat
    assert (found(generators.Grid(cells=(4, 4)).mesh(), keeps=False) == -1).all()
    folded = generators.Grid(cells=(1, 1)).mesh()
    apart = np.setxor1d(*folded.triangles)
    folded.vertices[apart[1]] = folded.vertices[apart[0]] + 0.1 * (folded.vertices[apart[1]] - folded.vertices[apart[0]])
    assert (found(folded) == -1).all()  # the second lies on the first, on the same side of their edge
