"""Culling by bounding volume hierarchies over primitives: Warp's, one over triangles and one over edges.

The trees are refitted for every list and rebuilt now and then. Each vertex asks the tree of triangles, each edge the tree of
edges; what it finds goes, in ascending order, into slots of its own, and the slots are then packed. What finds more than its
slots hold searches again, straight into the list, and a list that is full says so: nothing is dropped. Warp's trees know boxes
that rest, so what they find is compared once more as it moves. (Conditions are nested where the last is dear: Warp evaluates
both sides of an "and".)
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.collision import moving_boxes as sweep
from pdipc.collision import sieve
from pdipc.collision.moving_boxes import Box, Boxes, join, load, meet
from pdipc.collision.surface import Surface
from pdipc.device.language import func, kernel, struct
from pdipc.device.launch import Device
from pdipc.device.precision import Real


@struct
class Primitives:
    """What is searched for what: a tree, and the surface that it is over."""

    tree: wp.uint64
    vertices: wp.array[wp.int32]
    triangles: wp.array[wp.vec3i]
    edges: wp.array[wp.vec2i]
    obstacle: wp.array[wp.int32]
    boxes: Boxes  # of vertices


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    module = real.module(__name__)
    passes = sieve.functions(real)
    Sieve = passes.Sieve

    @func
    def of_edge(boxes: Boxes, e: wp.vec2i) -> Box:
        return join(load(boxes, e[0]), load(boxes, e[1]))

    @func
    def of_triangle(boxes: Boxes, t: wp.vec3i) -> Box:
        return join(join(load(boxes, t[0]), load(boxes, t[1])), load(boxes, t[2]))

    @kernel(module)
    def sweep_triangles(
        first: int,
        triangles: wp.array(dtype=wp.vec3i),
        boxes: Boxes,
        low_out: wp.array(dtype=wp.vec3),
        high_out: wp.array(dtype=wp.vec3),
    ):
        i = first + wp.tid()
        box = of_triangle(boxes, triangles[i])
        low_out[i] = wp.min(box.begin_low, box.end_low)
        high_out[i] = wp.max(box.begin_high, box.end_high)

    @kernel(module)
    def sweep_edges(
        first: int,
        edges: wp.array(dtype=wp.vec2i),
        boxes: Boxes,
        low_out: wp.array(dtype=wp.vec3),
        high_out: wp.array(dtype=wp.vec3),
    ):
        i = first + wp.tid()
        box = of_edge(boxes, edges[i])
        low_out[i] = wp.min(box.begin_low, box.end_low)
        high_out[i] = wp.max(box.begin_high, box.end_high)

    @func
    def insert(begin: int, held: int, pair: wp.vec2i, out: wp.array(dtype=wp.vec2i)):
        """Keeps a primitive's finds in ascending order, whatever the order of the tree."""
        p = int(held)
        while p > 0 and out[begin + wp.max(p - 1, 0)][1] > pair[1]:
            out[begin + p] = out[begin + p - 1]
            p -= 1
        out[begin + p] = pair

    @func
    def search_triangles(i: int, o: Primitives, sieve: Sieve, begin: int, room: int, out: wp.array(dtype=wp.vec2i)) -> int:
        """Counts the triangles that the i-th vertex may meet, and lists them if there are no more than `room`."""
        v = o.vertices[i]
        found = int(0)
        j = int(0)
        box = load(o.boxes, v)
        query = wp.bvh_query_aabb(o.tree, wp.min(box.begin_low, box.end_low), wp.max(box.begin_high, box.end_high))
        while wp.bvh_query_next(query, j):
            t = o.triangles[j]
            obstacles = o.obstacle[v] + o.obstacle[t[0]] + o.obstacle[t[1]] + o.obstacle[t[2]]
            if t[0] != v and t[1] != v and t[2] != v and obstacles < 4 and meet(box, of_triangle(o.boxes, t)):  # noqa: SIM102
                if passes.vertex_triangle(sieve, v, t):
                    if found < room:
                        insert(begin, found, wp.vec2i(v, j), out)
                    found += 1
        return found

    @func
    def search_edges(i: int, o: Primitives, sieve: Sieve, begin: int, room: int, out: wp.array(dtype=wp.vec2i)) -> int:
        """Counts the edges after the i-th that it may meet, and lists them if there are no more than `room`."""
        a = o.edges[i]
        found = int(0)
        j = int(0)
        box = of_edge(o.boxes, a)
        query = wp.bvh_query_aabb(o.tree, wp.min(box.begin_low, box.end_low), wp.max(box.begin_high, box.end_high))
        while wp.bvh_query_next(query, j):
            if j > i:
                b = o.edges[j]
                obstacles = o.obstacle[a[0]] + o.obstacle[a[1]] + o.obstacle[b[0]] + o.obstacle[b[1]]
                apart = a[0] != b[0] and a[0] != b[1] and a[1] != b[0] and a[1] != b[1]
                if apart and obstacles < 4 and meet(box, of_edge(o.boxes, b)):  # noqa: SIM102
                    if passes.edge_edge(sieve, a, b):
                        if found < room:
                            insert(begin, found, wp.vec2i(i, j), out)
                        found += 1
        return found

    find_triangles, pack_triangles = sweep.searching(module, "triangles", Primitives, Sieve, search_triangles)
    find_edges, pack_edges = sweep.searching(module, "edges", Primitives, Sieve, search_edges)
    return SimpleNamespace(
        sweep_triangles=sweep_triangles,
        sweep_edges=sweep_edges,
        find_triangles=find_triangles,
        pack_triangles=pack_triangles,
        find_edges=find_edges,
        pack_edges=pack_edges,
    )


class Bvh:
    """Candidate pairs by Warp's trees. `find` fills vertex_triangle and edge_edge."""

    def __init__(self, device: Device, real: Real, surface: Surface, overflow: wp.array):
        self.device, self.surface, self.kernels, self.sweep = device, surface, kernels(real), sweep.kernels(real)
        n, m, k = len(surface.body_of_vertex), len(surface.triangles), len(surface.edges)

        def corners(count: int) -> tuple[wp.array, wp.array]:
            low, high = (wp.zeros(count, dtype=wp.vec3, device=device.warp) for _ in range(2))
            return low, high

        self.of_vertices, self.of_triangles, self.of_edges = sweep.boxes(n, device), corners(m), corners(k)
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
        device.launch(self.sweep.vertex_boxes, len(x0), [x0, x1, reach, self.of_vertices])
        device.launch(k.sweep_triangles, len(s.triangles), [s.triangles, self.of_vertices, *self.of_triangles])
        device.launch(k.sweep_edges, len(s.edges), [s.edges, self.of_vertices, *self.of_edges])

    def find(self, x0: wp.array, x1: wp.array, reach: wp.array, sieve: Any) -> None:
        """Lists pairs; see `broad_phase.BroadPhase.find`. Recordable."""
        if not self.trees:
            return
        k = self.kernels
        self._fit(x0, x1, reach)
        for tree in self.trees:
            self.device.once(tree.refit)
        over_triangles, over_edges = (self._primitives(tree) for tree in self.trees)
        self.vertex_triangle.fill(k.find_triangles, k.pack_triangles, [over_triangles, sieve])
        self.edge_edge.fill(k.find_edges, k.pack_edges, [over_edges, sieve])

    def _primitives(self, tree: wp.Bvh) -> Any:
        s, made = self.surface, Primitives()
        made.tree, made.boxes = tree.id, self.of_vertices
        made.vertices, made.triangles, made.edges, made.obstacle = s.vertices, s.triangles, s.edges, s.obstacle
        return made
