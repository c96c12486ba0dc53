"""Patch-based culling (Section 7.2, Fig. 9): voxels of the rest surface, a hierarchy of their boxes, pairs of those that overlap.

A patch holds the primitives whose centers lie in one voxel cell of the rest shape. The paper's voxels are regular; here a cell
that holds more than WIDTH edges or triangles is halved until it does not, so that a patch is one block of WIDTH boxes whatever
the mesh. The hierarchy is a complete binary tree in one linear array: node 1 is the root, nodes 2i and 2i + 1 are the children of
node i, and patch p is node `leaves + p`. Its structure never changes; its boxes are refitted, leaves to root, for each list.

For each patch the tree gives the patches that it overlaps. Then every primitive tests its box against whole blocks: one
comparison of WIDTH boxes gives a bit mask. Within a patch, the pairs to be considered (not of a common vertex, not all scripted)
are pre-built, as a bit mask for each primitive.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.contact.primitives import MORTON_BITS, PairList, Primitives
from pdipc.parallel import Device, Span

WIDTH = 32  # primitives of one kind in a patch at most: bits of a mask
CPU_TOP = 4096  # tree nodes that one CPU thread refits faster than a launch for each level would

# A block holds the boxes of a patch's primitives by coordinate, so that compilers compare many of them at once. Free places hold
# an empty box, which overlaps nothing.
_OVERLAPPING = """
    const float* b = boxes.data + block * 192;
    unsigned int mask = 0;
    for (int k = 0; k < 32; ++k) {
        unsigned int apart = (unsigned int)(b[k] > high[0]) | (unsigned int)(b[32 + k] > high[1])
            | (unsigned int)(b[64 + k] > high[2]) | (unsigned int)(b[96 + k] < low[0])
            | (unsigned int)(b[128 + k] < low[1]) | (unsigned int)(b[160 + k] < low[2]);
        mask |= (apart ^ 1u) << k;
    }
    return mask;
"""


@wp.func_native(_OVERLAPPING)
def overlapping(boxes: wp.array(dtype=wp.float32), block: int, low: wp.vec3, high: wp.vec3) -> wp.uint32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def lowest_bit(mask: wp.uint32) -> int: ...


@wp.struct
class Patches:
    """Device arrays of the hierarchy; see `PatchCulling`."""

    leaves: int
    low: wp.array(dtype=wp.vec3)  # of each node
    high: wp.array(dtype=wp.vec3)
    neighbours_end: wp.array(dtype=wp.int32)  # of each patch: where its overlapping patches end in `neighbours`
    neighbours: wp.array(dtype=wp.int32)  # in ascending order
    scripted: wp.array(dtype=wp.int32)  # of each patch: 1 where all vertices of all its primitives are kinematic


@wp.struct
class Members:
    """The primitives of one kind, by patch."""

    start: wp.array(dtype=wp.int32)  # (patches + 1,) position of a patch's first primitive
    home: wp.array(dtype=wp.int32)  # patch of each position
    inside: wp.array(dtype=wp.uint32)  # of each position: its partners in its own patch, as a mask
    moving: wp.array(dtype=wp.uint32)  # of each patch: mask of the members that are not all kinematic
    boxes: wp.array(dtype=wp.float32)  # (patches, 6, WIDTH): least x, y, z, greatest x, y, z


@functools.cache
def kernels() -> SimpleNamespace:
    module = wp.get_module(__name__)
    module.options["enable_backward"] = False
    width = wp.constant(WIDTH)
    nowhere = wp.constant(3.0e38)

    @wp.func
    def overlap(low_a: wp.vec3, high_a: wp.vec3, low_b: wp.vec3, high_b: wp.vec3) -> bool:
        return (
            low_a[0] <= high_b[0]
            and low_b[0] <= high_a[0]
            and low_a[1] <= high_b[1]
            and low_b[1] <= high_a[1]
            and low_a[2] <= high_b[2]
            and low_b[2] <= high_a[2]
        )

    @wp.func
    def store(boxes: wp.array(dtype=wp.float32), slot: int, low: wp.vec3, high: wp.vec3):
        begin = (slot / width) * 6 * width + slot % width
        for axis in range(3):
            boxes[begin + axis * width] = low[axis]
            boxes[begin + (3 + axis) * width] = high[axis]

    @wp.func
    def load_low(boxes: wp.array(dtype=wp.float32), begin: int) -> wp.vec3:
        return wp.vec3(boxes[begin], boxes[begin + width], boxes[begin + 2 * width])

    @wp.func
    def load_high(boxes: wp.array(dtype=wp.float32), begin: int) -> wp.vec3:
        return wp.vec3(boxes[begin + 3 * width], boxes[begin + 4 * width], boxes[begin + 5 * width])

    @wp.kernel(module=module)
    def fill_blocks(
        first: int,
        edge_members: Members,
        triangle_members: Members,
        edges: wp.array(dtype=wp.vec2i),
        triangles: wp.array(dtype=wp.vec3i),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
    ):
        slot = first + wp.tid()
        p = slot / width
        r = edge_members.start[p] + slot % width
        if r < edge_members.start[p + 1]:
            e = edges[r]
            store(edge_members.boxes, slot, wp.min(low[e[0]], low[e[1]]), wp.max(high[e[0]], high[e[1]]))
        r = triangle_members.start[p] + slot % width
        if r < triangle_members.start[p + 1]:
            t = triangles[r]
            least = wp.min(wp.min(low[t[0]], low[t[1]]), low[t[2]])
            greatest = wp.max(wp.max(high[t[0]], high[t[1]]), high[t[2]])
            store(triangle_members.boxes, slot, least, greatest)

    @wp.kernel(module=module)
    def fit_patches(
        first: int,
        patches: Patches,
        vertex_members: Members,
        edge_members: Members,
        triangle_members: Members,
        vertices: wp.array(dtype=wp.int32),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
    ):
        """The box of everything in a patch."""
        p = first + wp.tid()
        least, greatest = wp.vec3(nowhere, nowhere, nowhere), wp.vec3(-nowhere, -nowhere, -nowhere)
        for r in range(vertex_members.start[p], vertex_members.start[p + 1]):
            least = wp.min(least, low[vertices[r]])
            greatest = wp.max(greatest, high[vertices[r]])
        for k in range(edge_members.start[p + 1] - edge_members.start[p]):
            least = wp.min(least, load_low(edge_members.boxes, p * 6 * width + k))
            greatest = wp.max(greatest, load_high(edge_members.boxes, p * 6 * width + k))
        for k in range(triangle_members.start[p + 1] - triangle_members.start[p]):
            least = wp.min(least, load_low(triangle_members.boxes, p * 6 * width + k))
            greatest = wp.max(greatest, load_high(triangle_members.boxes, p * 6 * width + k))
        patches.low[patches.leaves + p] = least
        patches.high[patches.leaves + p] = greatest

    @wp.func
    def refit(patches: Patches, node: int):
        patches.low[node] = wp.min(patches.low[2 * node], patches.low[2 * node + 1])
        patches.high[node] = wp.max(patches.high[2 * node], patches.high[2 * node + 1])

    @wp.kernel(module=module)
    def refit_level(first: int, patches: Patches, begin: int):
        refit(patches, begin + first + wp.tid())

    @wp.kernel(module=module)
    def refit_top(first: int, patches: Patches, count: int):
        for i in range(1, count):
            refit(patches, count - i)

    @wp.func
    def traverse(patches: Patches, p: int, begin: int, fill: bool) -> int:
        """Counts, or lists from `begin` on, the patches that patch p overlaps, itself among them, left to right."""
        low, high = patches.low[patches.leaves + p], patches.high[patches.leaves + p]
        found = int(0)
        node = int(1)
        while node != 0:
            if overlap(low, high, patches.low[node], patches.high[node]) and node < patches.leaves:
                node = 2 * node
            else:
                if node >= patches.leaves:
                    q = node - patches.leaves
                    if overlap(low, high, patches.low[node], patches.high[node]) and patches.scripted[p] + patches.scripted[q] < 2:
                        if fill:
                            patches.neighbours[begin + found] = q
                        found += 1
                # to the next subtree on the right: up while on a right child; from the root there is none
                while node & 1 == 1:
                    node = node >> 1
                if node != 0:
                    node += 1
        return found

    @wp.kernel(module=module)
    def count_neighbours(first: int, patches: Patches, found_out: wp.array(dtype=wp.int32)):
        p = first + wp.tid()
        found_out[p] = traverse(patches, p, 0, False)

    @wp.kernel(module=module)
    def list_neighbours(first: int, patches: Patches, found: wp.array(dtype=wp.int32)):
        p = first + wp.tid()
        traverse(patches, p, patches.neighbours_end[p] - found[p], True)

    @wp.func
    def search_triangles(
        r: int,
        patches: Patches,
        vertex_members: Members,
        members: Members,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        begin: int,
        room: int,
        out: wp.array(dtype=wp.vec2i),
    ) -> int:
        """Counts the triangles that the vertex at position r may meet; the first `room` of them go to `out`."""
        p = vertex_members.home[r]
        bit = wp.uint32(1) << wp.uint32(r - vertex_members.start[p])
        scripted = vertex_members.moving[p] & bit == wp.uint32(0)
        v = vertices[r]
        low_v, high_v = low[v], high[v]
        first_neighbour = int(0)
        if p > 0:
            first_neighbour = patches.neighbours_end[p - 1]
        found = int(0)
        for n in range(first_neighbour, patches.neighbours_end[p]):
            q = patches.neighbours[n]
            if overlap(low_v, high_v, patches.low[patches.leaves + q], patches.high[patches.leaves + q]):
                mask = overlapping(members.boxes, q, low_v, high_v)
                if q == p:
                    mask = mask & vertex_members.inside[r]
                elif scripted:
                    mask = mask & members.moving[q]
                while mask != wp.uint32(0):
                    k = members.start[q] + lowest_bit(mask)
                    mask = mask & (mask - wp.uint32(1))
                    t = triangles[k]
                    if t[0] != v and t[1] != v and t[2] != v:
                        if found < room:
                            out[begin + found] = wp.vec2i(r, k)
                        found += 1
        return found

    @wp.func
    def search_edges(
        r: int,
        patches: Patches,
        members: Members,
        edges: wp.array(dtype=wp.vec2i),
        begin: int,
        room: int,
        out: wp.array(dtype=wp.vec2i),
    ) -> int:
        """Counts the edges after position r that the edge there may meet; the first `room` of them go to `out`."""
        p = members.home[r]
        own = r - members.start[p]
        scripted = members.moving[p] & (wp.uint32(1) << wp.uint32(own)) == wp.uint32(0)
        a = edges[r]
        low, high = load_low(members.boxes, p * 6 * width + own), load_high(members.boxes, p * 6 * width + own)
        first_neighbour = int(0)
        if p > 0:
            first_neighbour = patches.neighbours_end[p - 1]
        found = int(0)
        for n in range(first_neighbour, patches.neighbours_end[p]):
            q = patches.neighbours[n]
            if q >= p and overlap(low, high, patches.low[patches.leaves + q], patches.high[patches.leaves + q]):
                mask = overlapping(members.boxes, q, low, high)
                if q == p:
                    mask = mask & members.inside[r]
                elif scripted:
                    mask = mask & members.moving[q]
                while mask != wp.uint32(0):
                    k = members.start[q] + lowest_bit(mask)
                    mask = mask & (mask - wp.uint32(1))
                    b = edges[k]
                    if a[0] != b[0] and a[0] != b[1] and a[1] != b[0] and a[1] != b[1]:
                        if found < room:
                            out[begin + found] = wp.vec2i(r, k)
                        found += 1
        return found

    @wp.kernel(module=module)
    def find_triangles(
        span: Span,
        count: int,
        patches: Patches,
        vertex_members: Members,
        members: Members,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        ids: wp.array(dtype=wp.int32),
        room: int,
        slots_out: wp.array(dtype=wp.vec2i),
        found_out: wp.array(dtype=wp.int32),
    ):
        worker = span.first + wp.tid()
        for block in range(worker * span.block, count, span.step * span.block):
            for r in range(block, wp.min(block + span.block, count)):
                found_out[r] = search_triangles(
                    r, patches, vertex_members, members, vertices, triangles, low, high, r * room, room, slots_out
                )

    @wp.kernel(module=module)
    def pack_triangles(
        span: Span,
        count: int,
        patches: Patches,
        vertex_members: Members,
        members: Members,
        vertices: wp.array(dtype=wp.int32),
        triangles: wp.array(dtype=wp.vec3i),
        low: wp.array(dtype=wp.vec3),
        high: wp.array(dtype=wp.vec3),
        ids: wp.array(dtype=wp.int32),
        room: int,
        slots: wp.array(dtype=wp.vec2i),
        found: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec2i),
    ):
        worker = span.first + wp.tid()
        for block in range(worker * span.block, count, span.step * span.block):
            for r in range(block, wp.min(block + span.block, count)):
                n = found[r]
                begin = ends[r] - n
                if n <= room:
                    for k in range(n):
                        pair = slots[r * room + k]
                        pairs_out[begin + k] = wp.vec2i(vertices[r], ids[pair[1]])
                else:
                    search_triangles(r, patches, vertex_members, members, vertices, triangles, low, high, begin, n, pairs_out)
                    for k in range(n):
                        pair = pairs_out[begin + k]
                        pairs_out[begin + k] = wp.vec2i(vertices[r], ids[pair[1]])

    @wp.kernel(module=module)
    def find_edges(
        span: Span,
        count: int,
        patches: Patches,
        members: Members,
        edges: wp.array(dtype=wp.vec2i),
        ids: wp.array(dtype=wp.int32),
        room: int,
        slots_out: wp.array(dtype=wp.vec2i),
        found_out: wp.array(dtype=wp.int32),
    ):
        worker = span.first + wp.tid()
        for block in range(worker * span.block, count, span.step * span.block):
            for r in range(block, wp.min(block + span.block, count)):
                found_out[r] = search_edges(r, patches, members, edges, r * room, room, slots_out)

    @wp.kernel(module=module)
    def pack_edges(
        span: Span,
        count: int,
        patches: Patches,
        members: Members,
        edges: wp.array(dtype=wp.vec2i),
        ids: wp.array(dtype=wp.int32),
        room: int,
        slots: wp.array(dtype=wp.vec2i),
        found: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec2i),
    ):
        worker = span.first + wp.tid()
        for block in range(worker * span.block, count, span.step * span.block):
            for r in range(block, wp.min(block + span.block, count)):
                n = found[r]
                begin = ends[r] - n
                if n > room:
                    search_edges(r, patches, members, edges, begin, n, pairs_out)
                for k in range(n):
                    pair = wp.vec2i(0, 0)
                    if n <= room:
                        pair = slots[r * room + k]
                    else:
                        pair = pairs_out[begin + k]
                    i, j = ids[pair[0]], ids[pair[1]]
                    pairs_out[begin + k] = wp.vec2i(wp.min(i, j), wp.max(i, j))

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Kernel)})
