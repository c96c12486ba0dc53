"""The surface that contact sees: triangles, their edges and vertices, over the model's one numbering of vertices.

Primitives are in spatial order: by body, then along a Morton curve through the rest shape. Neighbours in space are neighbours in
memory, a voxel of the rest shape is a range of each kind, and every way of culling lists its pairs in this one order.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from pdipc.collision import faces
from pdipc.device.launch import Device

MORTON_BITS = 20  # of each coordinate


@dataclass
class Surface:
    """Primitives of all bodies and obstacles.

    triangles: (m,) vec3i, segments of rods as (a, b, b), without area; edges: (k,) vec2i, each edge of a triangle once, ends in ascending order; vertices: (s,) int32, those
    that have a triangle; body_of_vertex: (n,) int32; obstacle: (n,) int32, 1 where the vertex is an obstacle's (obstacles may
    pass through each other; a body's held vertices may meet nothing, or an edge that they pull would pass through).
    members: vertices (s, 1), edges (k, 2) and triangles (m, 3) as NumPy arrays; codes: their Morton codes, uint64, ascending
    within a body.
    face: (m,) int32, the flat face of each triangle (`collision.faces`), -1 for none; inner_edge: (k,) and inner_vertex: (n,) int32, 1 inside of one.
    """

    triangles: wp.array
    edges: wp.array
    vertices: wp.array
    body_of_vertex: wp.array
    obstacle: wp.array
    members: list[np.ndarray]
    codes: list[np.ndarray]
    obstacle_numpy: np.ndarray
    face: wp.array
    inner_edge: wp.array
    inner_vertex: wp.array
    has_faces: bool


def unique_edges(triangles: np.ndarray) -> np.ndarray:
    """(k, 2) int32: the edges of triangles (m, 3), each once, in ascending order."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]  # a segment of a rod (a, b, b) has one
    return np.unique(pairs, axis=0).astype(np.int32)


def morton(points: np.ndarray) -> np.ndarray:
    """(n,) uint64: where points (n, 3) lie on a Morton curve through their bounding cube."""
    code = np.zeros(len(points), dtype=np.uint64)
    if len(points):
        points = points - points.min(axis=0)
        cells = (points * ((2**MORTON_BITS - 1) / max(points.max(), np.finfo(float).tiny))).astype(np.uint64)
        for bit in range(MORTON_BITS):
            for axis in range(3):
                code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def build(
    device: Device,
    triangles: np.ndarray,
    rest_positions: np.ndarray,
    body_of_vertex: np.ndarray,
    obstacle: np.ndarray,
    face: np.ndarray | None = None,
) -> Surface:
    """The surface of triangles (m, 3) int32; rest_positions (n, 3), body_of_vertex (n,) and obstacle (n,) bool of all vertices.

    face: (m,) int32 of each triangle, as `faces.flat_faces` finds them.
    """
    triangles = np.ascontiguousarray(triangles, dtype=np.int32).reshape(-1, 3)
    rest = np.asarray(rest_positions, dtype=np.float64)
    body = np.asarray(body_of_vertex, dtype=np.int32)
    if body.shape != rest.shape[:1] or np.shape(obstacle) != rest.shape[:1]:
        raise ValueError(f"body_of_vertex and obstacle must have the shape ({len(rest)},)")
    members = [np.unique(triangles).astype(np.int32)[:, None], unique_edges(triangles), triangles]
    bodies = [body[m[:, 0]] for m in members]
    codes = np.split(morton(np.concatenate([rest[m].mean(axis=1) for m in members])), np.cumsum([len(m) for m in members])[:-1])
    orders = [np.lexsort((code, own)) for code, own in zip(codes, bodies, strict=True)]
    members = [np.ascontiguousarray(m[order]) for m, order in zip(members, orders, strict=True)]
    codes = [code[order] for code, order in zip(codes, orders, strict=True)]
    face = (np.full(len(triangles), -1) if face is None else face)[orders[2]]
    inner_edge, inner_vertex = faces.inside(members[2], face, members[1], len(rest))

    def upload(values: np.ndarray, dtype) -> wp.array:
        return wp.array(values, dtype=dtype, device=device.warp)

    return Surface(
        upload(members[2], wp.vec3i),
        upload(members[1], wp.vec2i),
        upload(members[0].ravel(), wp.int32),
        upload(body, wp.int32),
        upload(np.asarray(obstacle).astype(np.int32), wp.int32),
        members,
        codes,
        np.asarray(obstacle, dtype=bool),
        upload(face.astype(np.int32), wp.int32),
        upload(inner_edge.astype(np.int32), wp.int32),
        upload(inner_vertex.astype(np.int32), wp.int32),
        bool((face >= 0).any()),
    )
