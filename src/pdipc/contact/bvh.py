"""Culling by bounding volume hierarchies over primitives: Warp's, one over triangles and one over edges.

The trees are refitted for every list and rebuilt now and then. Each vertex asks the tree of triangles, each edge the tree of
edges; what it finds goes, in ascending order, into slots of its own, and the slots are then packed. What finds more than its
slots hold searches again, straight into the list, and a list that is full says so: nothing is dropped.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.contact import sweep
from pdipc.contact.surface import Surface
from pdipc.parallel import Device
from pdipc.precision import Real


@functools.cache
def kernels() -> SimpleNamespace:
    module = wp.get_module(__name__)
    module.options["enable_backward"] = False

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
    def insert(begin: int, held: int, pair: wp.vec2i, out: wp.array(dtype=wp.vec2i)):
        """Keeps a primitive's finds in ascending order, whatever the order of the tree."""
        p = int(held)
        while p > 0 and out[begin + wp.max(p - 1, 0)][1] > pair[1]:
            out[begin + p] = out[begin + p - 1]
            p -= 1
        out[begin + p] = pair

    @wp.func
    def search_triangles(
        i: int,
        tree: wp.uint64,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        obstacle: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        begin: int,
        room: int,
        out: wp.array(dtype=wp.vec2i),
    ) -> int:
        """Counts the triangles that the i-th vertex may meet, and lists them if there are no more than `room`."""
        v = vertices[i]
        found = int(0)
        j = int(0)
        query = wp.bvh_query_aabb(tree, low[v], high[v])
        while wp.bvh_query_next(query, j):
            t = triangles[j]
            obstacles = obstacle[v] + obstacle[t[0]] + obstacle[t[1]] + obstacle[t[2]]
            if t[0] != v and t[1] != v and t[2] != v and obstacles < 4:
                if found < room:
                    insert(begin, found, wp.vec2i(v, j), out)
                found += 1
        return found

    @wp.func
    def search_edges(
        i: int,
        tree: wp.uint64,
        edges: wp.array(dtype=wp.vec2i),
        obstacle: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        begin: int,
        room: int,
        out: wp.array(dtype=wp.vec2i),
    ) -> int:
        """Counts the edges after the i-th that it may meet, and lists them if there are no more than `room`."""
        a = edges[i]
        found = int(0)
        j = int(0)
        query = wp.bvh_query_aabb(tree, low[i], high[i])
        while wp.bvh_query_next(query, j):
            if j > i:
                b = edges[j]
                obstacles = obstacle[a[0]] + obstacle[a[1]] + obstacle[b[0]] + obstacle[b[1]]
                if a[0] != b[0] and a[0] != b[1] and a[1] != b[0] and a[1] != b[1] and obstacles < 4:
                    if found < room:
                        insert(begin, found, wp.vec2i(i, j), out)
                    found += 1
        return found

    @wp.kernel(module=module)
    def find_triangles(
        first: int,
        tree: wp.uint64,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        obstacle: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        room: int,
        slots_out: wp.array(dtype=wp.vec2i),
        found_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        found_out[i] = search_triangles(i, tree, vertices, triangles, obstacle, low, high, i * room, room, slots_out)

    @wp.kernel(module=module)
    def find_edges(
        first: int,
        tree: wp.uint64,
        edges: wp.array(dtype=wp.vec2i),
        obstacle: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        room: int,
        slots_out: wp.array(dtype=wp.vec2i),
        found_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        found_out[i] = search_edges(i, tree, edges, obstacle, low, high, i * room, room, slots_out)

    @wp.kernel(module=module)
    def pack_triangles(
        first: int,
        tree: wp.uint64,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        obstacle: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        room: int,
        slots: wp.array(dtype=wp.vec2i),
        found: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec2i),
        overflow: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        begin = ends[i] - found[i]
        if begin < 0:
            overflow[0] = 1  # more than 2^31 pairs: the scan has wrapped
        elif ends[i] <= pairs_out.shape[0]:
            if found[i] > room:
                search_triangles(i, tree, vertices, triangles, obstacle, low, high, begin, found[i], pairs_out)
            else:
                for k in range(found[i]):
                    pairs_out[begin + k] = slots[i * room + k]

    @wp.kernel(module=module)
    def pack_edges(
        first: int,
        tree: wp.uint64,
        edges: wp.array(dtype=wp.vec2i),
        obstacle: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        room: int,
        slots: wp.array(dtype=wp.vec2i),
        found: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec2i),
        overflow: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        begin = ends[i] - found[i]
        if begin < 0:
            overflow[0] = 1  # more than 2^31 pairs: the scan has wrapped
        elif ends[i] <= pairs_out.shape[0]:
            if found[i] > room:
                search_edges(i, tree, edges, obstacle, low, high, begin, found[i], pairs_out)
            else:
                for k in range(found[i]):
                    pairs_out[begin + k] = slots[i * room + k]

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Kernel)})


class Bvh:
    """Candidate pairs by Warp's trees. `find` fills vertex_triangle and edge_edge."""

    def __init__(self, device: Device, real: Real, surface: Surface, overflow: wp.array):
        self.device, self.surface, self.kernels, self.sweep = device, surface, kernels(), sweep.kernels(real)
        n, m, k = len(surface.body_of_vertex), len(surface.triangles), len(surface.edges)

        def boxes(count: int) -> tuple[wp.array, wp.array]:
            low, high = (wp.zeros(count, dtype=wp.vec3, device=device.warp) for _ in range(2))
            return low, high

        self.of_vertices, self.of_triangles, self.of_edges = boxes(n), boxes(m), boxes(k)
        self.vertex_triangle = sweep.PairList(device, self.sweep, len(surface.vertices), overflow)
        self.edge_edge = sweep.PairList(device, self.sweep, k, overflow)
        self.trees = [wp.Bvh(*self.of_triangles), wp.Bvh(*self.of_edges)] if m else []

    def restructure(self, x: wp.array, reach: wp.array) -> None:
        """Builds the trees anew around x: refitted ones stay correct, but grow loose as things move."""
        self._fit(x, x, reach)
        for tree in self.trees:
            tree.rebuild()

    def grow(self) -> bool:
        """Nothing beyond the pair lists can overflow."""
        return False

    def _fit(self, x0: wp.array, x1: wp.array, reach: wp.array) -> None:
        device, k, s = self.device, self.kernels, self.surface
        device.launch(self.sweep.vertex_boxes, len(x0), [x0, x1, reach, *self.of_vertices])
        device.launch(k.triangle_boxes, len(s.triangles), [s.triangles, *self.of_vertices, *self.of_triangles])
        device.launch(k.edge_boxes, len(s.edges), [s.edges, *self.of_vertices, *self.of_edges])

    def find(self, x0: wp.array, x1: wp.array, reach: wp.array) -> None:
        """Lists the pairs whose swept, inflated boxes overlap; see `broad_phase.BroadPhase.find`. Recordable."""
        if not self.trees:
            return
        k, s = self.kernels, self.surface
        self._fit(x0, x1, reach)
        for tree in self.trees:
            self.device.once(tree.refit)
        triangle_tree, edge_tree = self.trees
        inputs = [triangle_tree.id, s.vertices, s.triangles, s.obstacle, *self.of_vertices]
        self.vertex_triangle.fill(k.find_triangles, k.pack_triangles, inputs)
        self.edge_edge.fill(k.find_edges, k.pack_edges, [edge_tree.id, s.edges, s.obstacle, *self.of_edges])
