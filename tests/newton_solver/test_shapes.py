"""Shapes of Newton models as meshes: closed, outward, of the right volume, with long axes along z."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from pdipc.newton import shapes

pytest.importorskip("newton")

ROUNDNESS = 0.01  # of the volume of a round shape, that its polyhedron may lack


@pytest.mark.parametrize(
    ("kind", "scale", "volume", "half"),
    [
        ("SPHERE", (0.3, 0, 0), 4 / 3 * np.pi * 0.3**3, (0.3, 0.3, 0.3)),
        ("ELLIPSOID", (0.3, 0.2, 0.1), 4 / 3 * np.pi * 0.3 * 0.2 * 0.1, (0.3, 0.2, 0.1)),
        ("BOX", (0.3, 0.2, 0.1), 8 * 0.3 * 0.2 * 0.1, (0.3, 0.2, 0.1)),
        ("CYLINDER", (0.2, 0.5, 0), np.pi * 0.2**2 * 1.0, (0.2, 0.2, 0.5)),
        ("CAPSULE", (0.2, 0.5, 0), np.pi * 0.2**2 * 1.0 + 4 / 3 * np.pi * 0.2**3, (0.2, 0.2, 0.7)),
        ("CONE", (0.2, 0.5, 0), np.pi * 0.2**2 * 1.0 / 3, (0.2, 0.2, 0.5)),
    ],
)
def test_solids(kind, scale, volume, half):
    vertices, triangles = shapes.triangles_of(kind, np.array(scale, dtype=float), None, 1.0, "shape 0")
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert (1 - ROUNDNESS) * volume <= mesh.volume <= volume * (1 + 1e-12), "a polyhedron is within its shape"
    np.testing.assert_allclose(mesh.bounds, [[-h for h in half], half], rtol=2e-3)


def test_the_cones_tip_is_up():
    vertices, _ = shapes.triangles_of("CONE", np.array([0.2, 0.5, 0.0]), None, 1.0, "shape 0")
    np.testing.assert_allclose(vertices[vertices[:, 2] > 0.4], [[0, 0, 0.5]], atol=1e-12)


def test_planes_and_heights_face_up():
    endless, _ = shapes.triangles_of("PLANE", np.zeros(3), None, 7.0, "shape 0")
    assert np.abs(endless[:, :2]).tolist() == [[7.0, 7.0]] * 4
    finite, triangles = shapes.triangles_of("PLANE", np.array([2.0, 3.0, 0.0]), None, 7.0, "shape 0")
    assert np.ptp(finite, axis=0).tolist() == [4.0, 6.0, 0.0]
    data = np.array([[0.0, 0.5], [1.0, 0.25], [0.0, 0.0]])
    field = SimpleNamespace(data=data, nrow=3, ncol=2, hx=1.0, hy=2.0, min_z=-1.0, max_z=3.0)
    heights, cells = shapes.triangles_of("HFIELD", np.ones(3), field, 7.0, "shape 0")
    assert heights[2].tolist() == [-1.0, 0.0, 3.0], "row 1, column 0, of 1.0"
    for points, faces in ((finite, triangles), (heights, cells)):
        a, b, c = np.moveaxis(points[faces], 1, 0)
        assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()


def test_mirrored_meshes_are_turned_and_others_refused():
    source = trimesh.creation.box()
    source = SimpleNamespace(vertices=np.asarray(source.vertices), indices=np.asarray(source.faces).ravel())
    vertices, triangles = shapes.triangles_of("MESH", np.array([1.0, 1.0, -2.0]), source, 1.0, "shape 0")
    assert trimesh.Trimesh(vertices, triangles, process=False).volume == pytest.approx(2.0)
    with pytest.raises(NotImplementedError, match="shape 3 is a GAUSSIAN"):
        shapes.triangles_of("GAUSSIAN", np.ones(3), None, 1.0, "shape 3")
