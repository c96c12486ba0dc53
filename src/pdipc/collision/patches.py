"""Patch-based culling (Section 7.2, Fig. 9): voxels of the rest surface, a hierarchy of their boxes, pairs of those that overlap.

A patch holds the primitives whose centers lie in one voxel of the rest shape. The paper's voxels are regular; here a voxel that
holds more than WIDTH primitives of a kind is halved until it does not, so that a patch is one block of WIDTH boxes whatever the
mesh. The hierarchy is a complete binary tree in one linear array: node 1 is the root, nodes 2i and 2i + 1 are the children of
node i, and patch p is node `leaves + p`. Its structure never changes; its boxes are refitted, leaves to root, for each list.

For each patch the tree gives the patches that it overlaps. Then every primitive tests its box against whole blocks: one
comparison of WIDTH boxes gives a bit mask. Within a patch, the pairs to be considered (no common vertex, not of two obstacles) are
pre-built, as a bit mask for each primitive.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.collision import moving_boxes as sweep
from pdipc.collision import sieve
from pdipc.collision.moving_boxes import Box, Boxes, join, load, meet, store
from pdipc.collision.surface import MORTON_BITS, Surface
from pdipc.device import language
from pdipc.device.language import func, kernel, struct
from pdipc.device.launch import Device
from pdipc.device.precision import Real

WIDTH = 32  # primitives of one kind in a patch at most: bits of a mask
FIRST_NEIGHBOURS = 8  # room for overlapping patches of a patch at first, on average

# A block holds the boxes of a patch's primitives by coordinate, so that compilers compare many of them at once: the least and the
# greatest x, y, z where the motion begins, then where it ends. Free places hold an empty box, which meets nothing.
_MEETING = """
    const float* b = boxes.data + block * 384;
    unsigned int mask = 0;
    for (int k = 0; k < 32; ++k) {
        unsigned int apart = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const float* c = b + 32 * axis + k;
            apart |= (unsigned int)(c[0] > box.begin_high[axis]) & (unsigned int)(c[192] > box.end_high[axis]);
            apart |= (unsigned int)(c[96] < box.begin_low[axis]) & (unsigned int)(c[288] < box.end_low[axis]);
        }
        mask |= (apart ^ 1u) << k;
    }
    return mask;
"""


@language.func_native(_MEETING)
def meeting(boxes: wp.array(dtype=wp.float32), block: int, box: Box) -> wp.uint32: ...


@language.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def lowest_bit(mask: wp.uint32) -> int: ...


@struct
class Patches:
    """Device arrays of the hierarchy; see `PatchCulling`."""

    leaves: int
    capacity: int  # of `neighbours`
    nodes: Boxes
    neighbours_end: wp.array[wp.int32]  # of each patch: where its overlapping patches end in `neighbours`
    neighbours: wp.array[wp.int32]  # in ascending order
    obstacle: wp.array[wp.int32]  # of each patch: 1 where all its primitives are obstacles


@struct
class Members:
    """The primitives of one kind, by patch."""

    start: wp.array[wp.int32]  # (patches + 1,) position of a patch's first primitive
    home: wp.array[wp.int32]  # patch of each position
    inside: wp.array[wp.uint32]  # of each position: its partners in its own patch, as a mask
    moving: wp.array[wp.uint32]  # of each patch: mask of the members that are no obstacles
    boxes: wp.array[wp.float32]  # (patches, 12, WIDTH): see above


@struct
class Searched:
    """What is searched for what: the hierarchy, and the primitives by patch, of the surface that it is over."""

    patches: Patches
    vertex_members: Members
    edge_members: Members
    triangle_members: Members
    vertices: wp.array[wp.int32]
    edges: wp.array[wp.vec2i]
    triangles: wp.array[wp.vec3i]
    of_vertices: Boxes


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    module = real.module(__name__)
    passes = sieve.functions(real)
    Sieve = passes.Sieve
    width = wp.constant(WIDTH)
    nowhere = wp.constant(wp.inf)

    @func
    def store_in_block(boxes: wp.array(dtype=wp.float32), slot: int, box: Box):
        begin = (slot / width) * 12 * width + slot % width
        for axis in range(3):
            boxes[begin + axis * width] = box.begin_low[axis]
            boxes[begin + (3 + axis) * width] = box.begin_high[axis]
            boxes[begin + (6 + axis) * width] = box.end_low[axis]
            boxes[begin + (9 + axis) * width] = box.end_high[axis]

    @func
    def corner(boxes: wp.array(dtype=wp.float32), begin: int) -> wp.vec3:
        return wp.vec3(boxes[begin], boxes[begin + width], boxes[begin + 2 * width])

    @func
    def load_from_block(boxes: wp.array(dtype=wp.float32), p: int, k: int) -> Box:
        begin = p * 12 * width + k
        box = Box()
        box.begin_low = corner(boxes, begin)
        box.begin_high = corner(boxes, begin + 3 * width)
        box.end_low = corner(boxes, begin + 6 * width)
        box.end_high = corner(boxes, begin + 9 * width)
        return box

    @kernel(module)
    def fill_blocks(first: int, o: Searched):
        slot = first + wp.tid()
        p = slot / width
        r = o.edge_members.start[p] + slot % width
        if r < o.edge_members.start[p + 1]:
            e = o.edges[r]
            store_in_block(o.edge_members.boxes, slot, join(load(o.of_vertices, e[0]), load(o.of_vertices, e[1])))
        r = o.triangle_members.start[p] + slot % width
        if r < o.triangle_members.start[p + 1]:
            t = o.triangles[r]
            box = join(join(load(o.of_vertices, t[0]), load(o.of_vertices, t[1])), load(o.of_vertices, t[2]))
            store_in_block(o.triangle_members.boxes, slot, box)

    @kernel(module)
    def fit_patches(first: int, o: Searched):
        """The box of everything in a patch."""
        p = first + wp.tid()
        box = Box()
        box.begin_low = wp.vec3(nowhere, nowhere, nowhere)
        box.begin_high = wp.vec3(-nowhere, -nowhere, -nowhere)
        box.end_low = box.begin_low
        box.end_high = box.begin_high
        for r in range(o.vertex_members.start[p], o.vertex_members.start[p + 1]):
            box = join(box, load(o.of_vertices, o.vertices[r]))
        for k in range(o.edge_members.start[p + 1] - o.edge_members.start[p]):
            box = join(box, load_from_block(o.edge_members.boxes, p, k))
        for k in range(o.triangle_members.start[p + 1] - o.triangle_members.start[p]):
            box = join(box, load_from_block(o.triangle_members.boxes, p, k))
        store(o.patches.nodes, o.patches.leaves + p, box)

    @func
    def refit(patches: Patches, node: int):
        store(patches.nodes, node, join(load(patches.nodes, 2 * node), load(patches.nodes, 2 * node + 1)))

    @kernel(module)
    def refit_level(first: int, patches: Patches, begin: int):
        refit(patches, begin + first + wp.tid())

    @kernel(module)
    def refit_top(first: int, patches: Patches, count: int):
        for i in range(1, count):
            refit(patches, count - i)

    @func
    def traverse(patches: Patches, p: int, begin: int, fill: bool) -> int:
        """Counts, or lists from `begin` on, the patches that patch p overlaps, itself among them, left to right."""
        box = load(patches.nodes, patches.leaves + p)
        found = int(0)
        node = int(1)
        while node != 0:
            near = meet(box, load(patches.nodes, node))
            if near and node < patches.leaves:
                node = 2 * node
            else:
                if near and node >= patches.leaves:
                    q = node - patches.leaves
                    if patches.obstacle[p] + patches.obstacle[q] < 2:
                        if fill:
                            patches.neighbours[begin + found] = q
                        found += 1
                # to the next subtree on the right: up while on a right child; from the root there is none
                while node & 1 == 1:
                    node = node >> 1
                if node != 0:
                    node += 1
        return found

    @kernel(module)
    def count_neighbours(first: int, patches: Patches, found_out: wp.array(dtype=wp.int32)):
        p = first + wp.tid()
        found_out[p] = traverse(patches, p, 0, False)

    @kernel(module)
    def list_neighbours(first: int, patches: Patches, found: wp.array(dtype=wp.int32), overflow: wp.array(dtype=wp.int32)):
        p = first + wp.tid()
        begin = patches.neighbours_end[p] - found[p]
        if begin < 0:
            overflow[0] = 1  # more than 2^31: the scan has wrapped, and its end may look as if all fits
        elif patches.neighbours_end[p] <= patches.capacity:
            traverse(patches, p, begin, True)

    @func
    def first_neighbour(patches: Patches, p: int) -> int:
        """Where the patches that p overlaps begin."""
        begin = int(0)
        if p > 0:
            begin = wp.max(patches.neighbours_end[p - 1], 0)
        return begin

    @func
    def search_triangles(r: int, o: Searched, sieve: Sieve, begin: int, room: int, out: wp.array(dtype=wp.vec2i)) -> int:
        """Counts the triangles that the vertex at position r may meet; the first `room` of them go to `out`."""
        p = o.vertex_members.home[r]
        bit = wp.uint32(1) << wp.uint32(r - o.vertex_members.start[p])
        obstacle = o.vertex_members.moving[p] & bit == wp.uint32(0)
        v = o.vertices[r]
        box = load(o.of_vertices, v)
        found = int(0)
        for n in range(first_neighbour(o.patches, p), wp.min(o.patches.neighbours_end[p], o.patches.capacity)):
            q = o.patches.neighbours[n]
            if meet(box, load(o.patches.nodes, o.patches.leaves + q)):
                mask = meeting(o.triangle_members.boxes, q, box)
                if q == p:
                    mask = mask & o.vertex_members.inside[r]
                elif obstacle:
                    mask = mask & o.triangle_members.moving[q]
                while mask != wp.uint32(0):
                    k = o.triangle_members.start[q] + lowest_bit(mask)
                    mask = mask & (mask - wp.uint32(1))
                    t = o.triangles[k]
                    if t[0] != v and t[1] != v and t[2] != v:  # noqa: SIM102  (Warp evaluates both sides of an "and")
                        if passes.vertex_triangle(sieve, v, t):
                            if found < room:
                                out[begin + found] = wp.vec2i(v, k)
                            found += 1
        return found

    @func
    def search_edges(r: int, o: Searched, sieve: Sieve, begin: int, room: int, out: wp.array(dtype=wp.vec2i)) -> int:
        """Counts the edges after position r that the edge there may meet; the first `room` of them go to `out`."""
        p = o.edge_members.home[r]
        own = r - o.edge_members.start[p]
        obstacle = o.edge_members.moving[p] & (wp.uint32(1) << wp.uint32(own)) == wp.uint32(0)
        a = o.edges[r]
        box = load_from_block(o.edge_members.boxes, p, own)
        found = int(0)
        for n in range(first_neighbour(o.patches, p), wp.min(o.patches.neighbours_end[p], o.patches.capacity)):
            q = o.patches.neighbours[n]
            if q >= p and meet(box, load(o.patches.nodes, o.patches.leaves + q)):
                mask = meeting(o.edge_members.boxes, q, box)
                if q == p:
                    mask = mask & o.edge_members.inside[r]
                elif obstacle:
                    mask = mask & o.edge_members.moving[q]
                while mask != wp.uint32(0):
                    k = o.edge_members.start[q] + lowest_bit(mask)
                    mask = mask & (mask - wp.uint32(1))
                    b = o.edges[k]
                    if a[0] != b[0] and a[0] != b[1] and a[1] != b[0] and a[1] != b[1]:  # noqa: SIM102
                        if passes.edge_edge(sieve, a, b):
                            if found < room:
                                out[begin + found] = wp.vec2i(r, k)
                            found += 1
        return found

    find_triangles, pack_triangles = sweep.searching(module, "triangles", Searched, Sieve, search_triangles)
    find_edges, pack_edges = sweep.searching(module, "edges", Searched, Sieve, search_edges)
    return SimpleNamespace(
        fill_blocks=fill_blocks,
        fit_patches=fit_patches,
        refit_level=refit_level,
        refit_top=refit_top,
        count_neighbours=count_neighbours,
        list_neighbours=list_neighbours,
        find_triangles=find_triangles,
        pack_triangles=pack_triangles,
        find_edges=find_edges,
        pack_edges=pack_edges,
    )


class PatchCulling:
    """Candidate pairs by patches. `find` fills vertex_triangle and edge_edge.

    starts: (patches + 1,) first vertex, edge and triangle of each patch, in the order of the surface.
    """

    def __init__(self, device: Device, real: Real, surface: Surface, overflow: wp.array):
        self.device, self.surface, self.overflow = device, surface, overflow
        self.kernels, self.sweep = kernels(real), sweep.kernels(real)
        self.starts = divide(surface)
        count = self.count = len(self.starts[0]) - 1
        members = surface.members
        obstacle = [surface.obstacle_numpy[m].all(axis=1) for m in members]
        homes = [np.repeat(np.arange(count), np.diff(start)) for start in self.starts]

        def upload(values: np.ndarray, dtype) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device.warp)

        def empty(size: int, dtype) -> wp.array:
            return wp.zeros(max(1, size), dtype=dtype, device=device.warp)

        moving = [np.zeros(count, dtype=np.uint32) for _ in members]
        for mask, home, start, still in zip(moving, homes, self.starts, obstacle, strict=True):
            bits = np.where(still, 0, 1 << (np.arange(len(home)) - start[home])).astype(np.uint32)
            np.bitwise_or.at(mask, home, bits)
        inside = [
            _inside(members[0], members[2], homes[0], self.starts[2], obstacle[0], obstacle[2], False),
            _inside(members[1], members[1], homes[1], self.starts[1], obstacle[1], obstacle[1], True),
            np.zeros(0, dtype=np.uint32),
        ]
        self.members = []
        for kind in range(3):
            m = Members()
            m.start, m.home = upload(self.starts[kind], wp.int32), upload(homes[kind], wp.int32)
            m.inside, m.moving = upload(inside[kind], wp.uint32), upload(moving[kind], wp.uint32)
            nowhere = np.tile(np.repeat(np.array([np.inf, -np.inf], dtype=np.float32), 3 * WIDTH), 2)
            m.boxes = upload(np.tile(nowhere, count if kind else 0), wp.float32)
            self.members.append(m)

        self.tree = Patches()
        self.tree.leaves = 1 << max(0, count - 1).bit_length()
        self.tree.nodes = sweep.boxes(2 * self.tree.leaves, device)
        self.tree.obstacle = upload(np.all([mask == 0 for mask in moving], axis=0).astype(np.int32), wp.int32)
        self.tree.neighbours_end = empty(count, wp.int32)
        self.found = empty(count, wp.int32)
        self.neighbour_count = empty(2, wp.int32)  # listed, and the most found: a later, shorter list must not hide an overflow
        self._room_for_neighbours(FIRST_NEIGHBOURS * count)
        self.of_vertices = sweep.boxes(len(surface.body_of_vertex), device)
        self.vertex_triangle = sweep.PairList(device, self.sweep, len(members[0]), overflow)
        self.edge_edge = sweep.PairList(device, self.sweep, len(members[1]), overflow)

    def _room_for_neighbours(self, capacity: int) -> None:
        self.tree.capacity = max(1, capacity)
        self.tree.neighbours = wp.zeros(self.tree.capacity, dtype=wp.int32, device=self.device.warp)

    def restructure(self, x: wp.array, reach: wp.array) -> None:
        """Nothing: patches are those of the rest shape."""

    def grow(self) -> bool:
        """Makes room for more overlapping patches; returns whether anything had to. The pair lists grow by themselves."""
        wanted = max(int(self.neighbour_count.numpy()[1]), int(self.found.numpy().sum(dtype=np.int64)))
        if wanted > sweep.LARGEST_LIST:
            raise MemoryError(f"{wanted} overlapping patches: the motion of a step or the activation distance is too large")
        if wanted <= self.tree.capacity:
            return False
        self._room_for_neighbours(min(wanted + wanted // 2, sweep.LARGEST_LIST))
        return True

    def find(self, x0: wp.array, x1: wp.array, reach: wp.array, sieve: Any) -> None:
        """Lists pairs; see `broad_phase.BroadPhase.find`. Recordable."""
        if self.count == 0:
            return
        device, k, s, tree, o = self.device, self.kernels, self.surface, self.tree, Searched()
        o.patches, o.of_vertices = tree, self.of_vertices
        o.vertex_members, o.edge_members, o.triangle_members = self.members
        o.vertices, o.edges, o.triangles = s.vertices, s.edges, s.triangles
        device.launch(self.sweep.vertex_boxes, len(x0), [x0, x1, reach, self.of_vertices])
        device.launch(k.fill_blocks, self.count * WIDTH, [o])
        device.launch(k.fit_patches, self.count, [o], grain=WIDTH)
        if device.wide:
            begin = tree.leaves
            while begin > 1:
                begin //= 2
                device.launch(k.refit_level, begin, [tree, begin])
        else:
            device.launch_serial(k.refit_top, [tree, tree.leaves])
        device.launch(k.count_neighbours, self.count, [tree, self.found], grain=64)
        device.scan(self.found, tree.neighbours_end)
        inputs = [tree.neighbours_end, tree.capacity, self.neighbour_count, self.overflow]
        device.launch_serial(self.sweep.settle, inputs)
        device.launch(k.list_neighbours, self.count, [tree, self.found, self.overflow], grain=64)
        self.vertex_triangle.fill(k.find_triangles, k.pack_triangles, [o, sieve])
        self.edge_edge.fill(k.find_edges, k.pack_edges, [o, sieve])

    def statistics(self) -> dict[str, int]:
        """Of the last `find`: patches, overlapping pairs of patches, and candidates within a patch and between patches."""
        homes = [np.zeros(len(self.surface.body_of_vertex), dtype=np.int64), *(m.home.numpy() for m in self.members[1:])]
        homes[0][self.surface.members[0].ravel()] = self.members[0].home.numpy()
        inside = total = 0
        for found, (first, second) in ((self.vertex_triangle, (0, 2)), (self.edge_edge, (1, 1))):
            assert found.pairs is not None  # it is only while the list grows
            pairs = found.pairs.numpy()[: int(found.count.numpy()[0])]
            inside += int(np.count_nonzero(homes[first][pairs[:, 0]] == homes[second][pairs[:, 1]]))
            total += len(pairs)
        own = self.count - int(self.tree.obstacle.numpy().sum())
        overlapping = (int(self.found.numpy().sum()) - own) // 2
        return {"patches": self.count, "overlapping": overlapping, "inside": inside, "between": total - inside}


def divide(surface: Surface) -> list[np.ndarray]:
    """Starts of the patches in the surface's vertices, edges and triangles: voxels, halved while they hold more than WIDTH.

    Voxels are cells of a Morton curve, so they are ranges of each kind.
    """
    body = surface.body_of_vertex.numpy()
    bodies = [body[m[:, 0]] for m in surface.members]
    ends = [[0] for _ in range(3)]

    def split(ranges: list[tuple[int, int]], bit: int) -> None:
        sizes = [last - first for first, last in ranges]
        if max(sizes) == 0:
            return
        if max(sizes) <= WIDTH:
            for end, (_, last) in zip(ends, ranges, strict=True):
                end.append(last)
            return
        if bit < 0:  # more than WIDTH centers in one place
            middle = [(first + last) // 2 for first, last in ranges]
        else:
            lowest = next(codes[first] for codes, (first, last) in zip(surface.codes, ranges, strict=True) if last > first)
            half = (lowest >> np.uint64(bit + 1) << np.uint64(bit + 1)) | np.uint64(1 << bit)
            middle = [
                first + int(np.searchsorted(codes[first:last], half))
                for codes, (first, last) in zip(surface.codes, ranges, strict=True)
            ]
        split([(first, m) for (first, _), m in zip(ranges, middle, strict=True)], bit - 1)
        split([(m, last) for (_, last), m in zip(ranges, middle, strict=True)], bit - 1)

    for b in np.unique(bodies[2]):
        split([(int(np.searchsorted(of, b)), int(np.searchsorted(of, b, side="right"))) for of in bodies], 3 * MORTON_BITS - 1)
    return [np.array(end, dtype=np.int32) for end in ends]


def _inside(first, second, home, starts, first_obstacle, second_obstacle, later: bool) -> np.ndarray:
    """(len(first),) uint32: for each primitive a mask of the partners in its own patch that it may meet.

    later: only partners after itself, for pairs of one kind.
    """
    mask = np.zeros(len(first), dtype=np.uint32)
    for bit in range(WIDTH):
        partner = starts[home] + bit
        there = partner < starts[home + 1]
        partner = np.minimum(partner, len(second) - 1)
        shared = (first[:, :, None] == second[partner][:, None, :]).any(axis=(1, 2))
        wanted = there & ~shared & ~(first_obstacle & second_obstacle[partner])
        if later:
            wanted &= partner > np.arange(len(first))
        mask |= np.where(wanted, np.uint32(1 << bit), np.uint32(0)).astype(np.uint32)
    return mask
