"""Candidate pairs: what culling leaves, with the distances that each pair must keep.

A list of candidates stays in use for as long as every vertex stays inside the box that the list was made for, usually a whole
step and, at rest, many steps. Culling then costs one comparison a vertex.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.contact import distance
from pdipc.contact.broad_phase import BroadPhase
from pdipc.contact.surface import Surface
from pdipc.parallel import Device, Reducer
from pdipc.precision import Real

REST_FRACTION = 0.8  # a pair of one body acts from this fraction of its distance in the rest shape on, at most
REST_SEPARATION = 0.2  # and keeps at least this fraction of that distance as minimum separation, at most


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec2, vec3 = real.scalar, real.vec2, real.vec3
    module = real.module(__name__)
    dist = distance.functions(real)

    @wp.func
    def limits(a: int, b: int, rest_distance: scalar, half_separation: wp.array(dtype=scalar), d_hat: scalar, same: bool):
        """(xi, d_hat) of a pair: smaller for a pair of one body that is close in the rest shape, so that rest is at rest."""
        xi = half_separation[a] + half_separation[b]
        reach = d_hat
        if same:
            xi = wp.min(xi, scalar(REST_SEPARATION) * rest_distance)
            reach = wp.min(reach, scalar(REST_FRACTION) * rest_distance - xi)
        return vec2(xi, reach)

    @wp.kernel(module=module)
    def vertex_triangle_limits(
        first: int,
        pairs: wp.array(dtype=wp.vec2i),
        triangles: wp.array(dtype=wp.vec3i),
        body: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=vec3),
        half_separation: wp.array(dtype=scalar),
        d_hat: scalar,
        quads_out: wp.array(dtype=wp.vec4i),
        limits_out: wp.array(dtype=vec2),
    ):
        k = first + wp.tid()
        v = pairs[k][0]
        t = triangles[pairs[k][1]]
        quads_out[k] = wp.vec4i(v, t[0], t[1], t[2])
        same = body[v] == body[t[0]]
        rest_distance = scalar(0.0)
        if same:
            rest_distance = dist.vertex_triangle_distance(rest[v], rest[t[0]], rest[t[1]], rest[t[2]])
        limits_out[k] = limits(v, t[0], rest_distance, half_separation, d_hat, same)

    @wp.kernel(module=module)
    def edge_edge_limits(
        first: int,
        pairs: wp.array(dtype=wp.vec2i),
        edges: wp.array(dtype=wp.vec2i),
        body: wp.array(dtype=wp.int32),
        rest: wp.array(dtype=vec3),
        half_separation: wp.array(dtype=scalar),
        d_hat: scalar,
        quads_out: wp.array(dtype=wp.vec4i),
        limits_out: wp.array(dtype=vec2),
    ):
        k = first + wp.tid()
        a = edges[pairs[k][0]]
        b = edges[pairs[k][1]]
        quads_out[k] = wp.vec4i(a[0], a[1], b[0], b[1])
        same = body[a[0]] == body[b[0]]
        rest_distance = scalar(0.0)
        if same:
            rest_distance = dist.edge_edge_distance(rest[a[0]], rest[a[1]], rest[b[0]], rest[b[1]])
        limits_out[k] = limits(a[0], b[0], rest_distance, half_separation, d_hat, same)

    @wp.kernel(module=module)
    def cover(
        first: int,
        x0: wp.array(dtype=vec3),
        x1: wp.array(dtype=vec3),
        margin: scalar,
        low_out: wp.array(dtype=vec3),
        high_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        grow = vec3(margin, margin, margin)
        low_out[i] = wp.min(x0[i], x1[i]) - grow
        high_out[i] = wp.max(x0[i], x1[i]) + grow

    @wp.kernel(module=module)
    def outside(
        first: int,
        x: wp.array(dtype=vec3),
        low: wp.array(dtype=vec3),
        high: wp.array(dtype=vec3),
        outside_out: wp.array(dtype=scalar),
    ):
        i = first + wp.tid()
        over = wp.max(wp.max(low[i] - x[i], x[i] - high[i]))
        # a comparison with NaN is false: not inside is outside
        if over <= scalar(0.0):
            outside_out[i] = scalar(0.0)
        else:
            outside_out[i] = scalar(1.0)

    @wp.kernel(module=module)
    def reach_of(
        first: int,
        half_separation: wp.array(dtype=scalar),
        half_activation: scalar,
        margin: scalar,
        reach_out: wp.array(dtype=scalar),
    ):
        i = first + wp.tid()
        reach_out[i] = half_separation[i] + half_activation + margin

    return SimpleNamespace(
        vertex_triangle_limits=vertex_triangle_limits,
        edge_edge_limits=edge_edge_limits,
        cover=cover,
        outside=outside,
        reach_of=reach_of,
    )


class Candidates:
    """The candidate pairs of a model, as vertex quadruples with their limits.

    Vertex-triangle pairs are (v, t0, t1, t2), edge-edge pairs (a0, a1, b0, b1); `*_quads` (k,) vec4i, `*_limits` (k,) vec2 of
    minimum separation xi and activation distance d_hat in metres, `*_count` how many.
    """

    def __init__(
        self,
        device: Device,
        real: Real,
        surface: Surface,
        broad_phase: BroadPhase,
        rest_positions: np.ndarray,
        half_separation: wp.array,
        activation_distance: float,
    ):
        n = len(rest_positions)
        self.device, self.real, self.surface, self.broad_phase = device, real, surface, broad_phase
        self.half_separation, self.activation_distance = half_separation, activation_distance
        self.kernels = kernels(real)
        self.rest = wp.array(rest_positions, dtype=real.vec3, device=device.warp)
        self.low = wp.zeros(n, dtype=real.vec3, device=device.warp)
        self.high = wp.zeros(n, dtype=real.vec3, device=device.warp)
        self.reach = wp.zeros(n, dtype=real.scalar, device=device.warp)
        self.flags = wp.zeros(n, dtype=real.scalar, device=device.warp)
        self.any_outside = wp.zeros(1, dtype=real.scalar, device=device.warp)
        self.reducer = Reducer(device, real, n)
        self.valid = False
        self.vertex_triangle_count = self.edge_edge_count = 0
        self._allocate(1024, 1024)

    def _allocate(self, vertex_triangle: int, edge_edge: int) -> None:
        self.vertex_triangle_quads = wp.zeros(vertex_triangle, dtype=wp.vec4i, device=self.device.warp)
        self.vertex_triangle_limits = wp.zeros(vertex_triangle, dtype=self.real.vec2, device=self.device.warp)
        self.edge_edge_quads = wp.zeros(edge_edge, dtype=wp.vec4i, device=self.device.warp)
        self.edge_edge_limits = wp.zeros(edge_edge, dtype=self.real.vec2, device=self.device.warp)

    def cover(self, x0: wp.array, x1: wp.array, margin: float) -> None:
        """Lists every pair that can meet, or act, while each vertex v stays within `margin` of the box of x0_v and x1_v."""
        n, k = len(x0), self.kernels
        self.device.launch(k.cover, n, [x0, x1, self.real.scalar(margin), self.low, self.high])
        half = 0.5 * self.activation_distance
        self.device.launch(k.reach_of, n, [self.half_separation, half, margin, self.reach])
        pairs = self.broad_phase.find(x0, x1, self.reach)
        self.vertex_triangle_count, self.edge_edge_count = pairs.vertex_triangle_count, pairs.edge_edge_count
        sizes = (len(self.vertex_triangle_quads), len(self.edge_edge_quads))
        if self.vertex_triangle_count > sizes[0] or self.edge_edge_count > sizes[1]:
            self._allocate(max(sizes[0], int(1.5 * self.vertex_triangle_count)), max(sizes[1], int(1.5 * self.edge_edge_count)))
        common = [self.surface.body_of_vertex, self.rest, self.half_separation, self.activation_distance]
        self.device.launch(
            k.vertex_triangle_limits,
            self.vertex_triangle_count,
            [pairs.vertex_triangle, self.surface.triangles, *common, self.vertex_triangle_quads, self.vertex_triangle_limits],
        )
        self.device.launch(
            k.edge_edge_limits,
            self.edge_edge_count,
            [pairs.edge_edge, self.surface.edges, *common, self.edge_edge_quads, self.edge_edge_limits],
        )
        self.valid = True

    def covers(self, x: wp.array) -> bool:
        """Whether every vertex of x is inside the box that the list was made for."""
        if not self.valid:
            return False
        self.device.launch(self.kernels.outside, len(x), [x, self.low, self.high, self.flags])
        self.reducer.max(self.flags, self.any_outside)
        return float(self.any_outside.numpy()[0]) == 0.0
