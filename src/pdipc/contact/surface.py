"""The surface that contact sees: triangles, their edges and vertices, over the model's one numbering of vertices."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from pdipc.parallel import Device


@dataclass
class Surface:
    """Primitives of all bodies and obstacles.

    triangles: (m,) vec3i; edges: (k,) vec2i, each edge of a triangle once, ends in ascending order; vertices: (s,) int32, those
    that have a triangle; body_of_vertex: (n,) int32; kinematic: (n,) int32, 1 where the vertex is scripted. *_numpy: the same.
    """

    triangles: wp.array
    edges: wp.array
    vertices: wp.array
    body_of_vertex: wp.array
    kinematic: wp.array
    triangles_numpy: np.ndarray
    edges_numpy: np.ndarray
    vertices_numpy: np.ndarray
    kinematic_numpy: np.ndarray


def unique_edges(triangles: np.ndarray) -> np.ndarray:
    """(k, 2) int32: the edges of triangles (m, 3), each once, in ascending order."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0).astype(np.int32)


def build(device: Device, triangles: np.ndarray, n_vertices: int, body_of_vertex: np.ndarray, kinematic: np.ndarray) -> Surface:
    """The surface of triangles (m, 3) int32; body_of_vertex (n,) and kinematic (n,) bool over all n_vertices."""
    triangles = np.ascontiguousarray(triangles, dtype=np.int32)
    edges, vertices = unique_edges(triangles), np.unique(triangles).astype(np.int32)
    body_of_vertex = np.asarray(body_of_vertex, dtype=np.int32)
    if body_of_vertex.shape != (n_vertices,) or np.shape(kinematic) != (n_vertices,):
        raise ValueError(f"body_of_vertex and kinematic must have the shape ({n_vertices},)")

    def upload(values: np.ndarray, dtype) -> wp.array:
        return wp.array(values, dtype=dtype, device=device.warp)

    return Surface(
        upload(triangles, wp.vec3i),
        upload(edges, wp.vec2i),
        upload(vertices, wp.int32),
        upload(body_of_vertex, wp.int32),
        upload(np.asarray(kinematic).astype(np.int32), wp.int32),
        triangles,
        edges,
        vertices,
        np.asarray(kinematic, dtype=bool),
    )
