"""Culling by bounding volume hierarchies over primitives: Warp's, one over triangles and one over edges.

The trees are refitted for every list and rebuilt when the boxes have drifted. Each vertex asks the tree of triangles, each edge
the tree of edges; what it finds goes, in ascending order, into slots of its own, and the slots are then packed. Where slots
run out, they grow and the query is made again: nothing is dropped.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.contact.surface import Surface
from pdipc.parallel import Device
from pdipc.precision import Real

FIRST_SLOTS = 8  # pairs that a primitive has room for at first
REBUILD_EVERY = 32  # refits; a refitted tree is correct but grows loose as things move


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)
    # Boxes are float32, as Warp's trees are. One rounding errs by less than 6e-8 of the coordinate; this is outward of that.
    outward = wp.constant(1.2e-7)

    @wp.func
    def below(v: vec3) -> wp.vec3:
        f = wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))
        return f - outward * wp.vec3(wp.abs(f[0]), wp.abs(f[1]), wp.abs(f[2])) - wp.vec3(1.0e-30, 1.0e-30, 1.0e-30)

    @wp.func
    def above(v: vec3) -> wp.vec3:
        f = wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))
        return f + outward * wp.vec3(wp.abs(f[0]), wp.abs(f[1]), wp.abs(f[2])) + wp.vec3(1.0e-30, 1.0e-30, 1.0e-30)

    @wp.kernel(module=module)
    def vertex_boxes(
        first: int,
        x0: wp.array(dtype=vec3),
        x1: wp.array(dtype=vec3),
        reach: wp.array(dtype=scalar),
        low_out: wp.array(dtype=wp.vec3),
        high_out: wp.array(dtype=wp.vec3),
    ):
        i = first + wp.tid()
        r = vec3(reach[i], reach[i], reach[i])
        low_out[i] = below(wp.min(x0[i], x1[i]) - r)
        high_out[i] = above(wp.max(x0[i], x1[i]) + r)

    @wp.kernel(module=module)
    def triangle_boxes(
        first: int,
        triangles: wp.array(dtype=wp.vec3i),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        low_out: wp.array(dtype=wp.vec3),
        high_out: wp.array(dtype=wp.vec3),
    ):
        i = first + wp.tid()
        t = triangles[i]
        low_out[i] = wp.min(wp.min(low[t[0]], low[t[1]]), low[t[2]])
        high_out[i] = wp.max(wp.max(high[t[0]], high[t[1]]), high[t[2]])

    @wp.kernel(module=module)
    def edge_boxes(
        first: int,
        edges: wp.array(dtype=wp.vec2i),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        low_out: wp.array(dtype=wp.vec3),
        high_out: wp.array(dtype=wp.vec3),
    ):
        i = first + wp.tid()
        e = edges[i]
        low_out[i] = wp.min(low[e[0]], low[e[1]])
        high_out[i] = wp.max(high[e[0]], high[e[1]])

    @wp.func
    def insert(slots: wp.array(dtype=wp.int32), begin: int, held: int, j: int):
        """Keeps a primitive's finds in ascending order, whatever the order of the tree."""
        p = int(held)
        while p > 0 and slots[begin + wp.max(p - 1, 0)] > j:
            slots[begin + p] = slots[begin + p - 1]
            p -= 1
        slots[begin + p] = j

    @wp.kernel(module=module)
    def find_vertex_triangle(
        first: int,
        tree: wp.uint64,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        kinematic: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        room: int,
        slots_out: wp.array(dtype=wp.int32),
        found_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        v = vertices[i]
        found = int(0)
        j = int(0)
        query = wp.bvh_query_aabb(tree, low[v], high[v])
        while wp.bvh_query_next(query, j):
            t = triangles[j]
            scripted = kinematic[v] + kinematic[t[0]] + kinematic[t[1]] + kinematic[t[2]]
            if t[0] != v and t[1] != v and t[2] != v and scripted < 4:
                if found < room:
                    insert(slots_out, i * room, found, j)
                found += 1
        found_out[i] = found

    @wp.kernel(module=module)
    def find_edge_edge(
        first: int,
        tree: wp.uint64,
        edges: wp.array(dtype=wp.vec2i),
        kinematic: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        room: int,
        slots_out: wp.array(dtype=wp.int32),
        found_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        a = edges[i]
        found = int(0)
        j = int(0)
        query = wp.bvh_query_aabb(tree, low[i], high[i])
        while wp.bvh_query_next(query, j):
            if j > i:
                b = edges[j]
                scripted = kinematic[a[0]] + kinematic[a[1]] + kinematic[b[0]] + kinematic[b[1]]
                if a[0] != b[0] and a[0] != b[1] and a[1] != b[0] and a[1] != b[1] and scripted < 4:
                    if found < room:
                        insert(slots_out, i * room, found, j)
                    found += 1
        found_out[i] = found

    @wp.kernel(module=module)
    def pack(
        first: int,
        names: wp.array(dtype=wp.int32),
        room: int,
        slots: wp.array(dtype=wp.int32),
        found: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec2i),
    ):
        i = first + wp.tid()
        begin = ends[i] - found[i]
        name = i
        if names:
            name = names[i]
        for k in range(found[i]):
            pairs_out[begin + k] = wp.vec2i(name, slots[i * room + k])

    return SimpleNamespace(
        vertex_boxes=vertex_boxes,
        triangle_boxes=triangle_boxes,
        edge_boxes=edge_boxes,
        find_vertex_triangle=find_vertex_triangle,
        find_edge_edge=find_edge_edge,
        pack=pack,
    )


class _List:
    """Pairs of one kind: slots a primitive, and the packed list."""

    def __init__(self, device: Device, primitives: int):
        self.device, self.primitives, self.room = device, primitives, FIRST_SLOTS
        self.found = wp.zeros(max(1, primitives), dtype=wp.int32, device=device.warp)
        self.ends = wp.zeros(max(1, primitives), dtype=wp.int32, device=device.warp)
        self.slots = wp.zeros(max(1, primitives * self.room), dtype=wp.int32, device=device.warp)
        self.pairs = wp.zeros(1024, dtype=wp.vec2i, device=device.warp)
        self.count = 0

    def fill(self, query, pack: wp.Kernel, names: wp.array | None) -> None:
        """query(room, slots, found) launches the search; repeated with more room until everything found fits."""
        if self.primitives == 0:
            return
        query(self.room, self.slots, self.found)
        most = int(self.found.numpy().max())
        if most > self.room:
            self.room = most + most // 2
            self.slots = wp.zeros(self.primitives * self.room, dtype=wp.int32, device=self.device.warp)
            query(self.room, self.slots, self.found)
        wp.utils.array_scan(self.found, self.ends, inclusive=True)
        self.count = int(self.ends[self.primitives - 1 :].numpy()[0])
        if self.count > len(self.pairs):
            self.pairs = wp.zeros(self.count + self.count // 2, dtype=wp.vec2i, device=self.device.warp)
        self.device.launch(pack, self.primitives, [names, self.room, self.slots, self.found, self.ends, self.pairs])


class Bvh:
    """Candidate pairs by Warp's trees. `find` fills vertex_triangle and edge_edge."""

    def __init__(self, device: Device, real: Real, surface: Surface):
        self.device, self.surface, self.kernels = device, surface, kernels(real)
        n, m, k = len(surface.body_of_vertex), len(surface.triangles), len(surface.edges)

        def boxes(count: int) -> tuple[wp.array, wp.array]:
            return tuple(wp.zeros(count, dtype=wp.vec3, device=device.warp) for _ in range(2))

        self.of_vertices, self.of_triangles, self.of_edges = boxes(n), boxes(m), boxes(k)
        self.vertex_triangle, self.edge_edge = _List(device, len(surface.vertices)), _List(device, k)
        self._trees: tuple[wp.Bvh, wp.Bvh] | None = None
        self._refits = 0

    def find(self, x0: wp.array, x1: wp.array, reach: wp.array) -> None:
        """Lists the pairs whose swept, inflated boxes overlap; see `broad_phase.BroadPhase.find`."""
        device, k, s = self.device, self.kernels, self.surface
        device.launch(k.vertex_boxes, len(x0), [x0, x1, reach, *self.of_vertices])
        device.launch(k.triangle_boxes, len(s.triangles), [s.triangles, *self.of_vertices, *self.of_triangles])
        device.launch(k.edge_boxes, len(s.edges), [s.edges, *self.of_vertices, *self.of_edges])
        if self._trees is None or self._refits >= REBUILD_EVERY:
            self._trees, self._refits = (wp.Bvh(*self.of_triangles), wp.Bvh(*self.of_edges)), 0
        else:
            for tree in self._trees:
                tree.refit()
            self._refits += 1
        triangle_tree, edge_tree = self._trees

        def vertex_triangle(room: int, slots: wp.array, found: wp.array) -> None:
            inputs = [triangle_tree.id, s.vertices, s.triangles, s.kinematic, *self.of_vertices, room, slots, found]
            device.launch(k.find_vertex_triangle, len(s.vertices), inputs, grain=64)

        def edge_edge(room: int, slots: wp.array, found: wp.array) -> None:
            inputs = [edge_tree.id, s.edges, s.kinematic, *self.of_edges, room, slots, found]
            device.launch(k.find_edge_edge, len(s.edges), inputs, grain=64)

        self.vertex_triangle.fill(vertex_triangle, k.pack, s.vertices)
        self.edge_edge.fill(edge_edge, k.pack, None)
