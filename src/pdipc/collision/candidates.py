"""Candidate pairs: what culling leaves, with the distances that each pair must keep.

A list of candidates stays in use for as long as every vertex stays near an end of the motion that the list was made for: some
outer iterations and, at rest, many steps. Culling then costs one comparison a vertex.

**Lemma (reuse).** A list that was made for the motion y(s) = (1 - s) y(0) + s y(1) of all vertices holds for a motion x(t) = (1 - t) x(0) +
t x(1) if all of x(0) are within the margin of the same end y(s0), s0 = 0 or 1, and all of x(1) of the same end y(s1). Proof: x(t) - y((1 -
t) s0 + t s1) = (1 - t) (x(0) - y(s0)) + t (x(1) - y(s1)) for every vertex, which is no longer than the margin; so at every t all vertices
are within it of y at one common fraction. For a pair that is not listed the two primitives of y are there, all the way, farther apart
than reach_i + reach_j, with reach = half of the separation and half of the activation distance and the margin: so those of x stay
farther apart than the separation xi and the activation distance. Where *some* vertices of x(0) are near the one end and some near the other,
nothing of this holds, and `check` asks for a new list: it counts who is away from each end, and asks that nobody is.

**Rounding.** What CCD and barriers take for xi, d_hat and the length of a stray is off by a few units in the last place of the scene's
precision, below 1e-6 relative, and so is a reach. The reach that pairs are listed by has (1 + ROUNDING) on it, which is ten times that.
A stray is measured in double precision; where a margin is below LEAST_MARGIN, where its square would underflow, nothing is near.

What happens between two primitives that are farther apart than xi + d_hat all the way: nothing. Barriers act nearer than d_hat beyond xi
(`barrier.pairs`), and CCD shortens a motion only where a gap falls to xi + s min(d(0) - xi, d_hat) at most, s < 1 (`ccd`).
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.collision import distance, sieve
from pdipc.collision.broad_phase import BroadPhase
from pdipc.collision.surface import Surface
from pdipc.device import blocks
from pdipc.device.language import filled, func, kernel, struct_of
from pdipc.device.launch import BLOCK, CPU_BLOCK, Device, Parts, Share, Span
from pdipc.device.precision import Real, Scalar

REST_FRACTION = 0.8  # a pair of one body acts from this fraction of its distance in the rest shape on, at most
ROUNDING = 1.0e-5  # relative, of all that a reach is made of
LEAST_MARGIN = 1.0e-100  # m
SILENT = -2  # in place of a face: the pair is stopped by CCD, and has no barrier of its own (`faces`)
IGNORED = -1.0  # the activation distance of a pair that ignores each other: it neither acts nor stops anything
REST_SEPARATION = 0.2  # and keeps at least this fraction of that distance as minimum separation, at most
ROD_SEPARATION = 0.7  # the same of rods, which are as thick as their radius also where they touch themselves


@func
def of_one_body(xi: Scalar, d_hat: Scalar, part: Scalar, rest_distance: Scalar):
    """(xi, d_hat) of a pair of one body: at most parts of its distance in the rest shape, so that rest is at rest."""
    kept = wp.min(xi, part * rest_distance)
    return kept, wp.min(d_hat, type(xi)(REST_FRACTION) * rest_distance - kept)


@functools.cache
def vertices(real: Real) -> Any:
    """A struct: what pairs take their limits from."""
    return struct_of(
        "Vertices",
        __name__,
        d_hat=real.scalar,  # m
        body=wp.array(dtype=wp.int32),  # of each vertex
        rest=wp.array(dtype=real.vec3),  # m, where it is at rest
        half_separation=wp.array(dtype=real.scalar),  # m
        rest_separation=wp.array(dtype=real.scalar),  # the part of its distance at rest that a pair of one body keeps at most
        inner_vertex=wp.array(dtype=wp.int32),  # whether it is inside a flat face
        flat=wp.array(dtype=wp.int32),  # of each body, whether it has the shape that these were found in
        ignored=wp.array(dtype=wp.vec2i),  # pairs of bodies that ignore each other
    )


@functools.cache
def listed(real: Real) -> Any:
    """A struct: the candidates of one kind as kernels read them; see `CandidateList`."""
    return struct_of(
        "Listed",
        __name__,
        count=wp.array(dtype=wp.int32),
        quads=wp.array(dtype=wp.vec4i),
        limits=wp.array(dtype=real.vec2),
        faces=wp.array(dtype=wp.int32),
        gaps=wp.array(dtype=real.scalar),
    )


@functools.cache
def grouped(real: Real) -> Any:
    """A struct: `Groups` as kernels take them."""
    return struct_of(
        "Grouped",
        __name__,
        size=int,
        ends=wp.array(dtype=wp.int32),
        smallest=wp.array(dtype=real.scalar),  # m
        arrived=wp.array(dtype=wp.int32),
    )


@functools.cache
def reuse(real: Real) -> Any:
    """A struct: the motion that candidates were listed for, and whether they hold for another; see `Candidates`."""
    return struct_of(
        "Reuse",
        __name__,
        begin=wp.array(dtype=real.vec3),
        end=wp.array(dtype=real.vec3),
        margin=real.scalar,
        overflow=wp.array(dtype=wp.int32),
        away=wp.array(dtype=wp.int32),  # (4,) whether any vertex begins away from `begin`, or from `end`, or ends so
        needed=wp.array(dtype=wp.int32),
        renewed=wp.array(dtype=wp.int32),
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec2, vec3, Vertices = real.scalar, real.vec2, real.vec3, vertices(real)
    Reuse = reuse(real)
    module = real.module(__name__)
    least_margin = wp.constant(wp.float64(LEAST_MARGIN))
    nothing = wp.constant(scalar(IGNORED))
    silent = wp.constant(SILENT)
    last_block = blocks.last()

    @func
    def limits(o: Vertices, a: int, b: int, rest_distance: scalar):
        """(xi, d_hat) of a pair; IGNORED for a pair of two bodies that ignore each other."""
        low = wp.min(o.body[a], o.body[b])
        high = wp.max(o.body[a], o.body[b])
        for i in range(o.ignored.shape[0]):
            if o.ignored[i][0] == low and o.ignored[i][1] == high:
                return vec2(scalar(0.0), nothing)
        xi = o.half_separation[a] + o.half_separation[b]
        if low == high:
            kept, reach = of_one_body(xi, o.d_hat, o.rest_separation[a], rest_distance)
            return vec2(kept, reach)
        return vec2(xi, o.d_hat)

    @kernel(module)
    def vertex_triangle_limits(
        span: Span,
        count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        triangles: wp.array(dtype=wp.vec3i),
        o: Vertices,
        face: wp.array(dtype=wp.int32),
        quads_out: wp.array(dtype=wp.vec4i),
        limits_out: wp.array(dtype=vec2),
        faces_out: wp.array(dtype=wp.int32),
    ):
        worker = span.first + wp.tid()
        for begin in range(worker * span.block, count[0], span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, count[0])):
                v = pairs[k][0]
                t = triangles[pairs[k][1]]
                quads_out[k] = wp.vec4i(v, t[0], t[1], t[2])
                rest_distance = scalar(0.0)
                faces_out[k] = -1
                if o.body[v] != o.body[t[0]]:
                    if o.flat[o.body[v]] * o.inner_vertex[v] > 0:
                        faces_out[k] = silent
                    elif o.flat[o.body[t[0]]] > 0:
                        faces_out[k] = face[pairs[k][1]]
                else:
                    rest_distance = scalar(
                        distance.vertex_triangle_distance(o.rest[v], o.rest[t[0]], o.rest[t[1]], o.rest[t[2]])
                    )
                limits_out[k] = limits(o, v, t[0], rest_distance)

    @kernel(module)
    def edge_edge_limits(
        span: Span,
        count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        edges: wp.array(dtype=wp.vec2i),
        o: Vertices,
        inner: wp.array(dtype=wp.int32),
        quads_out: wp.array(dtype=wp.vec4i),
        limits_out: wp.array(dtype=vec2),
        faces_out: wp.array(dtype=wp.int32),
    ):
        worker = span.first + wp.tid()
        for begin in range(worker * span.block, count[0], span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, count[0])):
                a = edges[pairs[k][0]]
                b = edges[pairs[k][1]]
                quads_out[k] = wp.vec4i(a[0], a[1], b[0], b[1])
                rest_distance = scalar(0.0)
                faces_out[k] = -1
                if o.body[a[0]] != o.body[b[0]]:
                    if o.flat[o.body[a[0]]] * inner[pairs[k][0]] + o.flat[o.body[b[0]]] * inner[pairs[k][1]] > 0:
                        faces_out[k] = silent
                else:
                    rest_distance = scalar(distance.edge_edge_distance(o.rest[a[0]], o.rest[a[1]], o.rest[b[0]], o.rest[b[1]]))
                limits_out[k] = limits(o, a[0], b[0], rest_distance)

    @func
    def near(x: vec3, y: vec3, margin: scalar) -> bool:
        """A comparison with NaN is false: what is not known to be near is away."""
        return wp.length(distance.relative(x, y)) <= wp.float64(margin) and wp.float64(margin) > least_margin

    @kernel(module)
    def check(first: int, x0: wp.array(dtype=vec3), x1: wp.array(dtype=vec3), parts: Share, o: Reuse):
        """Who is away, by blocks of threads; the last decides, and clears that for the next time."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        for i in range(block * parts.size + lane, wp.min((block + 1) * parts.size, x0.shape[0]), wp.block_dim()):
            # whoever writes, writes the same
            if not near(x0[i], o.begin[i], o.margin):
                o.away[0] = 1
            if not near(x0[i], o.end[i], o.margin):
                o.away[1] = 1
            if not near(x1[i], o.begin[i], o.margin):
                o.away[2] = 1
            if not near(x1[i], o.end[i], o.margin):
                o.away[3] = 1
        if last_block(parts.arrived, 0, parts.number):  # noqa: SIM102  (all threads of a block ask)
            if lane == 0:
                o.needed[0] = wp.max(wp.min(o.away[0], o.away[1]), wp.min(o.away[2], o.away[3]))
                if o.overflow[0] != 0:
                    o.needed[0] = 0  # what was found stays known, until there is room for it
                if o.needed[0] != 0:
                    o.renewed[0] = 1
                for k in range(4):
                    o.away[k] = 0

    @kernel(module)
    def keep(
        first: int,
        x0: wp.array(dtype=vec3),
        x1: wp.array(dtype=vec3),
        begin_out: wp.array(dtype=vec3),
        end_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        begin_out[i] = x0[i]
        end_out[i] = x1[i]

    return SimpleNamespace(
        vertex_triangle_limits=vertex_triangle_limits,
        edge_edge_limits=edge_edge_limits,
        near=near,
        check=check,
        keep=keep,
    )


class CandidateList:
    """The candidate pairs of one kind, as vertex quadruples with their limits, and room for what is found out about each.

    Vertex-triangle pairs are (v, t0, t1, t2), edge-edge pairs (a0, a1, b0, b1). quads: (capacity,) vec4i. limits: (capacity,)
    vec2 of minimum separation xi and activation distance d_hat, m. faces: (capacity,) int32, the flat face that the triangle of a pair is part of, -1
    for none, or SILENT. count: (1,) int32 on the device. gaps: (capacity,) m. listed: all of these as kernels read them.
    """

    def __init__(self, device: Device, real: Real, kind: str):
        self.device, self.real, self.kind = device, real, kind

    def allocate(self, count: wp.array, capacity: int) -> None:
        """Arrays for `capacity` pairs, of which `count` are in use."""

        def make(size: int, dtype) -> wp.array:
            return wp.zeros(size, dtype=dtype, device=self.device.warp)

        real = self.real
        self.quads = self.limits = self.faces = self.gaps = self.listed = None  # the old ones are given back first
        self.count, self.capacity = count, capacity
        self.quads, self.limits = make(capacity, wp.vec4i), make(capacity, real.vec2)
        self.gaps, self.faces = make(capacity, real.scalar), make(capacity, wp.int32)
        self.listed = filled(listed(real), self)


class Groups:
    """Candidates that are counted together, `size` of one kind: number, of both kinds in lists of these capacities, of which each may end in a part of a
    group. ends, smallest: a number for each; arrived: the counter of `blocks.last`. grouped: these as kernels take them.
    """

    def __init__(self, device: Device, real: Real, capacities: list[int]):
        self.size = BLOCK if device.wide else CPU_BLOCK
        self.number = max(1, sum(-(-capacity // self.size) for capacity in capacities))
        self.ends = wp.zeros(self.number, dtype=wp.int32, device=device.warp)
        self.smallest = wp.zeros(self.number, dtype=real.scalar, device=device.warp)
        self.arrived = wp.zeros(1, dtype=wp.int32, device=device.warp)
        self.grouped = filled(grouped(real), self)


class Candidates:
    """The candidate pairs of a model: `vertex_triangle` and `edge_edge`, each a `CandidateList`.

    Everything but `grow` only launches, so that it can be recorded. A list that is full is flagged in `overflow`, (1,) int32 on
    the device; what was listed is then incomplete, and the caller has to `grow` and list again.
    rest_separation: (n,) the part of its distance at rest that a pair of one body keeps at most, REST_SEPARATION where None.
    capacity: of both lists together; groups: see `Groups`. flat: (bodies,) int32, 1 where the faces of a body are flat; see `flatten`. ignored: (quarantined,) vec2i, pairs of bodies in ascending order whose pairs are IGNORED, -1 for none; see `ignore`.
    needed: (1,) int32 on the device, what `check` writes; renewed: (1,) int32, whether it has asked for a list since somebody took that back. generation: grows whenever arrays were replaced.
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
        margin: float,
        rest_separation: wp.array | None = None,
        quarantined: int = 0,
    ):
        n = len(rest_positions)
        self.ignored = wp.full(quarantined, wp.vec2i(-1, -1), dtype=wp.vec2i, device=device.warp)
        if rest_separation is None:
            rest_separation = wp.full(n, real.scalar(REST_SEPARATION), dtype=real.scalar, device=device.warp)
        self.rest_separation = rest_separation
        self.device, self.real, self.surface, self.broad_phase = device, real, surface, broad_phase
        self.half_separation, self.activation_distance, self.margin = half_separation, activation_distance, margin
        self.kernels = kernels(real)
        self.flat = wp.ones(int(surface.body_of_vertex.numpy().max(initial=-1)) + 1, dtype=wp.int32, device=device.warp)
        self.rest = wp.array(rest_positions, dtype=real.vec3, device=device.warp)
        self.begin = wp.zeros(n, dtype=real.vec3, device=device.warp)
        self.end = wp.zeros(n, dtype=real.vec3, device=device.warp)
        reach = (half_separation.numpy().astype(float) + (0.5 * activation_distance + margin)) * (1.0 + ROUNDING)
        self.reach = wp.array(reach, dtype=real.scalar, device=device.warp)
        self._parts = Parts(device, n)
        self.away = wp.zeros(4, dtype=wp.int32, device=device.warp)
        self.needed, self.renewed = (wp.zeros(1, dtype=wp.int32, device=device.warp) for _ in range(2))
        self.sieve = sieve.functions(real).Sieve()
        self.sieve.begin, self.sieve.end, self.sieve.reach = self.begin, self.end, self.reach
        self.overflow = broad_phase.overflow
        self._reuse = filled(reuse(real), self)
        self.lists = [CandidateList(device, real, kind) for kind in ("vertex_triangle", "edge_edge")]
        self.vertex_triangle, self.edge_edge = self.lists
        self.generation = 0
        self._allocate()
        self.invalidate()

    def _allocate(self) -> None:
        for own, found in zip(self.lists, self.broad_phase.lists, strict=True):
            if self.generation == 0 or own.capacity != len(found.pairs):
                own.allocate(found.count, len(found.pairs))
        capacities = [own.capacity for own in self.lists]
        self.capacity, self.groups = sum(capacities), Groups(self.device, self.real, capacities)
        self.generation += 1

    def invalidate(self) -> None:
        """Forgets the list: the next `check` asks for a new one."""
        self.begin.fill_(wp.nan)
        self.end.fill_(wp.nan)

    def ignore(self, bodies: np.ndarray) -> None:
        """Pairs (quarantined, 2) of bodies ignore each other from now on, and no others."""
        if len(self.ignored) and not np.array_equal(self.ignored.numpy(), bodies):
            self.ignored.assign(bodies.astype(np.int32))
            self.invalidate()

    def flatten(self, bodies: np.ndarray) -> None:
        """Which bodies, (b,) bool, have their faces from now on: those that still have the shape that these were found in."""
        if not np.array_equal(self.flat.numpy(), bodies):
            self.flat.assign(bodies.astype(np.int32))
            self.invalidate()

    def restructure(self, x: wp.array) -> None:
        """Renews the structures of the culling around x; what they find does not depend on it."""
        self.broad_phase.restructure(x, self.half_separation)

    def grow(self) -> bool:
        """Makes room for what overflowed; returns whether anything had to."""
        if not self.broad_phase.grow():
            return False
        self.overflow.zero_()
        self._allocate()
        self.invalidate()
        return True

    def cover(self, x0: wp.array, x1: wp.array) -> None:
        """Lists every pair that can meet, or act, while each vertex stays within the margin of its way from x0 to x1, all of
        them at the same fraction of it."""
        self.device.launch(self.kernels.keep, len(x0), [x0, x1, self.begin, self.end])
        self.broad_phase.find(self.begin, self.end, self.reach, self.sieve)
        o = vertices(self.real)()
        o.d_hat, o.body, o.rest = self.activation_distance, self.surface.body_of_vertex, self.rest
        o.half_separation, o.rest_separation = self.half_separation, self.rest_separation
        o.inner_vertex, o.flat, o.ignored = self.surface.inner_vertex, self.flat, self.ignored
        primitives = ((self.surface.triangles, self.surface.face), (self.surface.edges, self.surface.inner_edge))
        for own, found, (of, flat) in zip(self.lists, self.broad_phase.lists, primitives, strict=True):
            inputs = [found.count, found.pairs, of, o, flat, own.quads, own.limits, own.faces]
            self.device.launch_list(getattr(self.kernels, f"{own.kind}_limits"), own.capacity, inputs)

    def check(self, x0: wp.array, x1: wp.array) -> None:
        """needed[0] = 0 if the list holds for the motion x0 -> x1, or one has overflowed before, else 1.

        It does where all of x0 are near one end of the motion that the list was made for, and all of x1 near one end.
        """
        parts = self._parts
        self.device.launch_blocks(self.kernels.check, parts.number, [x0, x1, parts.share, self._reuse], grain=parts.size)
