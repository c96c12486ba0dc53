"""What both ways of culling share: the surface's primitives in a spatial order, the vertices' swept boxes, and lists of pairs.

Primitives are ordered by body and then along a Morton curve through the rest shape. Primitives that are neighbours in space are
so in memory, and both methods list pairs in this one order, so that a run's bits do not depend on the method.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.contact.surface import Surface
from pdipc.parallel import Device
from pdipc.precision import Real

MORTON_BITS = 20  # of each coordinate
FIRST_ROOM, MOST_ROOM = 16, 64  # slots of a primitive; what finds more is searched a second time
LARGEST_LIST = 2**31 - 1


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)
    # Boxes are float32. Rounding a coordinate to float32 errs by at most 2^-24 of it, and so does moving it outward; two such
    # errors are less than 1.2e-7. The second constant is above what tiny numbers lose.
    outward, tiny = wp.constant(1.2e-7), wp.constant(1.0e-30)

    @wp.func
    def below(v: vec3) -> wp.vec3:
        f = wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))
        return f - outward * wp.vec3(wp.abs(f[0]), wp.abs(f[1]), wp.abs(f[2])) - wp.vec3(tiny, tiny, tiny)

    @wp.func
    def above(v: vec3) -> wp.vec3:
        f = wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))
        return f + outward * wp.vec3(wp.abs(f[0]), wp.abs(f[1]), wp.abs(f[2])) + wp.vec3(tiny, tiny, tiny)

    @wp.kernel(module=module)
    def vertex_boxes(
        first: int,
        x0: wp.array(dtype=vec3),
        x1: wp.array(dtype=vec3),
        reach: wp.array(dtype=scalar),
        low_out: wp.array(dtype=wp.vec3),
        high_out: wp.array(dtype=wp.vec3),
        not_finite_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        r = vec3(reach[i], reach[i], reach[i])
        low, high = below(wp.min(x0[i], x1[i]) - r), above(wp.max(x0[i], x1[i]) + r)
        low_out[i] = low
        high_out[i] = high
        # min and max may swallow a NaN, sums do not; whoever finds one writes the same 1
        all = x0[i] + x1[i]
        if not (wp.isfinite(all[0] + all[1] + all[2] + reach[i]) and wp.isfinite(low) and wp.isfinite(high)):
            not_finite_out[0] = 1

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

    return SimpleNamespace(vertex_boxes=vertex_boxes, edge_boxes=edge_boxes, triangle_boxes=triangle_boxes)


def morton(points: np.ndarray, group: np.ndarray) -> np.ndarray:
    """(n,) uint64: where points (n, 3) lie on a Morton curve through the bounding box of their group (n,) int, one scale for all."""
    code = np.zeros(len(points), dtype=np.uint64)
    if len(points) == 0:
        return code
    low = np.full((group.max() + 1, 3), np.inf)
    np.minimum.at(low, group, points)
    points = points - low[group]
    cells = (points * ((2**MORTON_BITS - 1) / max(points.max(), np.finfo(float).tiny))).astype(np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


class Primitives:
    """Vertices, edges and triangles of a surface in spatial order; position r of the order is primitive `*_ids[r]`.

    vertices (s,) int32 are their own ids. body and code: what each was ordered by. low, high (n,) vec3 float32: boxes of all the
    model's vertices as of the last `sweep`.
    """

    def __init__(self, device: Device, real: Real, surface: Surface, rest_positions: np.ndarray):
        self.device, self.kernels, self.surface = device, kernels(real), surface
        x = np.asarray(rest_positions, dtype=np.float64)
        body = surface.body_of_vertex.numpy()
        members = [surface.vertices_numpy[:, None], surface.edges_numpy, surface.triangles_numpy]
        self.body = [body[m[:, 0]] for m in members]
        centers = [x[m].mean(axis=1) for m in members]
        codes = np.split(morton(np.concatenate(centers), np.concatenate(self.body)), np.cumsum([len(m) for m in members])[:-1])
        orders = [np.lexsort((code, body)) for code, body in zip(codes, self.body, strict=True)]
        self.code = [code[order] for code, order in zip(codes, orders, strict=True)]
        self.body = [body[order] for body, order in zip(self.body, orders, strict=True)]
        self.members = [np.ascontiguousarray(m[order]) for m, order in zip(members, orders, strict=True)]
        self.scripted = [surface.kinematic_numpy[m].all(axis=1) for m in self.members]

        def upload(values: np.ndarray, dtype) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device.warp)

        self.vertices = upload(self.members[0].ravel(), wp.int32)
        self.edges, self.triangles = upload(self.members[1], wp.vec2i), upload(self.members[2], wp.vec3i)
        self.edge_ids, self.triangle_ids = (upload(order.astype(np.int32), wp.int32) for order in orders[1:])
        self.triangle_order = orders[2]
        self.low = wp.zeros(len(x), dtype=wp.vec3, device=device.warp)
        self.high = wp.zeros(len(x), dtype=wp.vec3, device=device.warp)
        self._not_finite = wp.zeros(1, dtype=wp.int32, device=device.warp)

    def sweep(self, x0: wp.array, x1: wp.array, reach: wp.array) -> None:
        """The vertices' boxes for the motion x0 -> x1, grown by `reach`. Raises ValueError where a number is not finite."""
        inputs = [x0, x1, reach, self.low, self.high, self._not_finite]
        self.device.launch(self.kernels.vertex_boxes, len(x0), inputs)
        if self._not_finite.numpy()[0] != 0:
            self._not_finite.zero_()
            finite = np.isfinite(self.low.numpy()) & np.isfinite(self.high.numpy())
            finite &= np.isfinite(x0.numpy()) & np.isfinite(x1.numpy())
            finite = finite.all(axis=1) & np.isfinite(reach.numpy())
            v = int(np.argmin(finite))
            start, end, grown = x0.numpy()[v].tolist(), x1.numpy()[v].tolist(), float(reach.numpy()[v])
            raise ValueError(
                f"vertex {v} moves from {start} to {end} with reach {grown}; culling needs finite numbers within float32's range"
            )


class PairList:
    """Pairs of one kind: a few slots for each first primitive, and the packed list in order of the first, then the second.

    pairs: vec2i of ids, valid up to count.
    """

    def __init__(self, device: Device, primitives: int):
        self.device, self.primitives, self.room = device, primitives, FIRST_ROOM
        self.found = wp.zeros(max(1, primitives), dtype=wp.int32, device=device.warp)
        self.ends = wp.zeros(max(1, primitives), dtype=wp.int32, device=device.warp)
        self.slots = wp.zeros(max(1, primitives * self.room), dtype=wp.vec2i, device=device.warp)
        self.pairs = wp.zeros(1024, dtype=wp.vec2i, device=device.warp)
        self.count = 0

    def fill(self, search: wp.Kernel, pack: wp.Kernel, inputs: list) -> None:
        """Runs `search(span, n, *inputs, room, slots, found)`, then `pack` with the same and (ends, pairs).

        `search` counts all that a primitive finds and stores what its slots hold; `pack` copies the slots into the list, and
        searches again, straight into the list, where they did not hold all. Raises MemoryError for a list beyond 2^31 pairs.
        """
        n = self.primitives
        if n == 0:
            return
        common = [n, *inputs, self.room, self.slots, self.found]
        self.device.launch_list(search, n, common)
        self.count = int(self.found.numpy().sum(dtype=np.int64))
        if self.count > LARGEST_LIST:
            raise MemoryError(f"{self.count} candidate pairs; the motion of a step or the activation distance is too large")
        wp.utils.array_scan(self.found, self.ends, inclusive=True)
        if self.count > len(self.pairs):
            self.pairs = wp.zeros(min(self.count + self.count // 2, LARGEST_LIST), dtype=wp.vec2i, device=self.device.warp)
        self.device.launch_list(pack, n, [*common, self.ends, self.pairs])
        wanted = min(MOST_ROOM, 2 * self.count // n)
        if wanted > self.room:
            self.room = wanted
            self.slots = wp.zeros(n * wanted, dtype=wp.vec2i, device=self.device.warp)
