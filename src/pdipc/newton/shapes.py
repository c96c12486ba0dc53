"""Shapes of a Newton model as triangle meshes: what obstacles are made of.

Round shapes are polyhedra whose vertices lie on the shape, so an obstacle is nowhere outside of it, and inside of it by no more than
`deviation` times its radius.
"""

from typing import Any

import numpy as np
import trimesh

ROUND = 48  # corners of a circle
SUBDIVISIONS = 4  # of an icosahedron, for spheres
deviation = 1.0 - np.cos(np.pi / ROUND)


class Unsupported(NotImplementedError):
    """Something of a Newton model that SolverPDIPC does not simulate; the message says what, where, and what would do."""


def triangles_of(kind: str, scale: np.ndarray, source: Any, size: float, where: str) -> tuple[np.ndarray, np.ndarray]:
    """V (n, 3) m and F (m, 3), facing outward, of a shape in its own frame, long axes along z.

    kind: the name of its `newton.GeoType`. scale: (3,) its dimensions as Newton keeps them. size: m, half the edge of the square that stands
    for a plane without end. Raises Unsupported for other kinds.
    """
    if kind in ("MESH", "CONVEX_MESH"):
        vertices = np.asarray(source.vertices, dtype=np.float64).reshape(-1, 3) * scale
        triangles = np.asarray(source.indices, dtype=np.int64).reshape(-1, 3)
        return vertices, triangles[:, ::-1] if np.prod(scale) < 0.0 else triangles
    if kind == "PLANE":
        x, y = (float(half) if half > 0.0 else size for half in scale[:2])
        corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])
    if kind == "HFIELD":
        return _heights(source)
    make = {
        "SPHERE": lambda: trimesh.creation.icosphere(subdivisions=SUBDIVISIONS, radius=scale[0]),
        "ELLIPSOID": lambda: trimesh.creation.icosphere(subdivisions=SUBDIVISIONS).apply_transform(np.diag([*scale, 1.0])),
        "BOX": lambda: trimesh.creation.box(2.0 * scale),
        "CAPSULE": lambda: _capsule(*scale[:2]),
        "CYLINDER": lambda: trimesh.creation.cylinder(scale[0], 2.0 * scale[1], sections=ROUND),
        "CONE": lambda: trimesh.creation.cone(scale[0], 2.0 * scale[1], sections=ROUND).apply_translation([0, 0, -scale[1]]),
    }.get(kind)
    if make is None:
        raise Unsupported(f"{where} is a {kind}, which has no surface to keep apart from; take a mesh in its place")
    mesh = make()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _capsule(radius: float, half_height: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.capsule(2.0 * half_height, radius, count=(ROUND, ROUND))
    mesh.merge_vertices()
    return mesh.apply_translation(-mesh.bounds.mean(axis=0))


def _heights(field) -> tuple[np.ndarray, np.ndarray]:
    """A grid that faces up: rows along y, columns along x."""
    x, y = np.meshgrid(np.linspace(-field.hx, field.hx, field.ncol), np.linspace(-field.hy, field.hy, field.nrow))
    z = field.min_z + np.asarray(field.data, dtype=np.float64) * (field.max_z - field.min_z)
    row, column = (each.ravel() for each in np.indices((field.nrow - 1, field.ncol - 1)))
    a = row * field.ncol + column
    b, c, d = a + 1, a + field.ncol + 1, a + field.ncol
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()]), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
