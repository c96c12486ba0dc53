"""Truncation of the motion x -> x~ so that nothing meets (Algorithm 1, lines 13 to 15), vertex by vertex.

Every pass runs conservative CCD on the linear motion from x to the float positions that would be committed. Vertices of pairs
that meet are shortened by the pair's time, candidates are listed again where that takes vertices out of the motion that the list
was made for, and the pass is repeated with a smaller back-off until one finds no hit: that pass proves the positions that are
committed.

**Lemma (the last pass).** After it no two primitives come nearer than xi while all vertices move from x to x_end. Proof: x_end are the float
positions that are committed, and CCD was asked about just these. A pair that has a shortened vertex is asked in every pass, if it
is listed; a pair without one makes the motion of the first pass, where it was not hit, or some of its vertices would be shortened; it was
listed there, or proven apart all the way. A pair that is not listed is apart by the lemmas of `candidates`, since the list was made for
this motion or one that `check` compared with it. Whatever shortens a vertex (a pair's time, its neighbours, a line search that begins at a
later pass) leaves a fraction below 1. Where the passes do not settle nobody moves: x_end = base + u, which is x to the bit (a step begins so, `inertia.predict`, and every motion
that is made ends so), and feasible.
Times only choose what to try: no rounding in them, in fractions or in base + u + f (u~ - u) matters.

The paper truncates every vertex by the one smallest time (`per_vertex=False`): correct, but one collision anywhere then
drags every body of the scene (docs/paper_map.md).
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.collision import ccd, distance
from pdipc.collision.candidates import Candidates, listed
from pdipc.device import atomic
from pdipc.device.language import filled, func, kernel, struct_of
from pdipc.device.launch import Device, Span
from pdipc.device.precision import Real

UNIT = 1 << 30  # times are kept as integers over this unit, rounded down: the least of several is then exact and race-free
FIRST_BACKOFF = 0.2  # of the gap stays, in the first pass
LATER_BACKOFF = 0.1  # in the passes that check shortened motions
SHRINK = 0.9
STUBBORN = 20  # passes after which vertices that still hit something stay where they are
DEEP = 0.5  # of d_hat: a pair that is hit at a smaller gap was squeezed before
GRADE = 0.1  # strain that an edge may take from a truncation, where neighbours are known
RINGS = 12  # of neighbours, over which a short motion is felt
MAX_PASSES = 60  # and after which all do


@functools.cache
def truncated(real: Real) -> Any:
    """A struct: the motion that is left, and how the passes stand; see `Truncation`."""
    return struct_of(
        "Truncated",
        __name__,
        fraction=wp.array(dtype=real.scalar),
        first_fraction=wp.array(dtype=real.scalar),
        u_end=wp.array(dtype=real.vec3),
        x_end=wp.array(dtype=real.vec3),
        passes=wp.array(dtype=wp.int32),
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec2, vec3, vec4 = real.scalar, real.vec2, real.vec3, real.vec4
    Truncated, Listed = truncated(real), listed(real)
    module = real.module(__name__)
    c = ccd.functions(real)
    unit = wp.constant(UNIT)

    lower = atomic.lower()

    @func
    def withdraws(
        edges: bool, q: wp.vec4i, x: wp.array(dtype=vec3), x_end: wp.array(dtype=vec3), rigid: wp.array(dtype=wp.int32)
    ):
        """Whether what is rigid in a pair goes away from the rest."""
        a = vec4(distance.pair_weights(edges, x[q[0]], x[q[1]], x[q[2]], x[q[3]]))
        apart = a[1] * (x[q[1]] - x[q[0]]) + a[2] * (x[q[2]] - x[q[0]]) + a[3] * (x[q[3]] - x[q[0]])
        away = scalar(0.0)
        for s in range(4):
            if rigid[q[s]] != 0:
                away += a[s] * wp.dot(apart, x_end[q[s]] - x[q[s]])
        return away >= scalar(0.0)

    @kernel(module)
    def sweep(
        span: Span,
        points: Listed,
        lines: Listed,
        x: wp.array(dtype=vec3),
        o: Truncated,
        body: wp.array(dtype=wp.int32),
        rigid: wp.array(dtype=wp.int32),
        multiplier: wp.array(dtype=wp.int32),
        any_hit_out: wp.array(dtype=wp.int32),
        deep_out: wp.array(dtype=wp.int32),
    ):
        """CCD of all pairs, first those of a vertex and a triangle. The vertices of a pair that is hit are shortened; but an obstacle that withdraws is
        not held by what comes after it. Flags: whoever writes, writes the same.
        """
        worker = span.first + wp.tid()
        backoff = scalar(FIRST_BACKOFF)
        if o.passes[0] > 0:
            backoff = scalar(LATER_BACKOFF)
        count = points.count[0] + lines.count[0]
        if o.passes[0] > MAX_PASSES:
            count = 0  # nobody moves
        for begin in range(worker * span.block, count, span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, count)):
                edges = k >= points.count[0]
                q = wp.vec4i()
                reach = vec2()
                if edges:
                    q = lines.quads[k - points.count[0]]
                    reach = lines.limits[k - points.count[0]]
                else:
                    q = points.quads[k]
                    reach = points.limits[k]
                shortest = wp.min(wp.min(o.fraction[q[0]], o.fraction[q[1]]), wp.min(o.fraction[q[2]], o.fraction[q[3]]))
                t = scalar(2.0)
                if (o.passes[0] == 0 or shortest < scalar(1.0)) and reach[1] >= scalar(0.0):
                    if edges:
                        t = c.edge_edge(
                            x[q[0]], x[q[1]], x[q[2]], x[q[3]],
                            o.x_end[q[0]], o.x_end[q[1]], o.x_end[q[2]], o.x_end[q[3]], reach[0], backoff, reach[1],
                        )  # fmt: skip
                    else:
                        t = c.vertex_triangle(
                            x[q[0]], x[q[1]], x[q[2]], x[q[3]],
                            o.x_end[q[0]], o.x_end[q[1]], o.x_end[q[2]], o.x_end[q[3]], reach[0], backoff, reach[1],
                        )  # fmt: skip
                if t <= scalar(1.0):
                    any_hit_out[0] = 1
                    time = wp.int32(wp.floor(t * scalar(unit) * scalar(0.999999)))
                    apart = scalar(distance.pair_distance(edges, x[q[0]], x[q[1]], x[q[2]], x[q[3]]))
                    if apart - reach[0] < scalar(DEEP) * reach[1]:
                        if body[q[0]] >= 0:
                            deep_out[body[q[0]]] = 1
                        if body[q[3]] >= 0:
                            deep_out[body[q[3]]] = 1
                    held = bool(True)
                    if o.passes[0] < STUBBORN and rigid[q[0]] != rigid[q[3]]:
                        held = not withdraws(edges, q, x, o.x_end, rigid)
                    for s in range(4):
                        if held or rigid[q[s]] == 0:
                            lower(multiplier, q[s], time)

    @kernel(module)
    def together(
        first: int,
        ends: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        multiplier: wp.array(dtype=wp.int32),
    ):
        """Vertices of a rigid obstacle keep one time, so that it stays rigid."""
        r = first + wp.tid()
        least = unit
        for k in range(ends[r], ends[r + 1]):
            least = wp.min(least, multiplier[members[k]])
        for k in range(ends[r], ends[r + 1]):
            multiplier[members[k]] = least

    @kernel(module)
    def find_least(
        first: int, group_of: wp.array(dtype=wp.int32), multiplier: wp.array(dtype=wp.int32), least: wp.array(dtype=wp.int32)
    ):
        """The least time of each rigid obstacle; the least of integers does not depend on who is first."""
        i = first + wp.tid()
        if group_of[i] >= 0 and multiplier[i] < unit:
            wp.atomic_min(least, group_of[i], multiplier[i])

    @kernel(module)
    def spread_least(
        first: int, group_of: wp.array(dtype=wp.int32), least: wp.array(dtype=wp.int32), multiplier: wp.array(dtype=wp.int32)
    ):
        i = first + wp.tid()
        if group_of[i] >= 0:
            multiplier[i] = wp.min(multiplier[i], least[group_of[i]])

    @kernel(module)
    def level(first: int, ends: wp.array(dtype=wp.int32), members: wp.array(dtype=wp.int32), fraction: wp.array(dtype=scalar)):
        """The same for what their neighbours left them."""
        r = first + wp.tid()
        least = scalar(1.0)
        for k in range(ends[r], ends[r + 1]):
            least = wp.min(least, fraction[members[k]])
        for k in range(ends[r], ends[r + 1]):
            fraction[members[k]] = least

    @kernel(module)
    def shorten(first: int, multiplier: wp.array(dtype=wp.int32), t: Truncated):
        """Clears the times for the next pass."""
        i = first + wp.tid()
        if multiplier[i] < unit:
            shrink = scalar(1.0)
            if t.passes[0] > 0:
                shrink = scalar(SHRINK)
            f = t.fraction[i] * shrink * scalar(multiplier[i]) / scalar(unit)
            if t.passes[0] >= STUBBORN:
                # not settled: these stay where they are, and the next outer iteration starts from a stronger barrier
                f = scalar(0.0)
            t.fraction[i] = f
            if t.passes[0] == 0:
                t.first_fraction[i] = f
            multiplier[i] = int(unit)
        if t.passes[0] >= MAX_PASSES:
            # nobody moves, which is always feasible
            t.fraction[i] = scalar(0.0)

    @kernel(module)
    def grade(
        first: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        fraction: wp.array(dtype=scalar),
        fraction_out: wp.array(dtype=scalar),
    ):
        """No vertex keeps so much more of its motion than a neighbour that the edge between them is strained by more than GRADE."""
        i = first + wp.tid()
        f = fraction[i]
        own = wp.length(u_tilde[i] - u[i])
        for e in range(offsets[i], offsets[i + 1]):
            j = columns[e]
            if fraction[j] < f:
                motion = wp.max(own, wp.length(u_tilde[j] - u[j]))
                f = wp.min(f, fraction[j] + scalar(GRADE) * wp.length(x[j] - x[i]) / wp.max(motion, scalar(1.0e-30)))
        fraction_out[i] = f

    @kernel(module)
    def place(
        first: int,
        groups: int,
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        t: Truncated,
        least_out: wp.array(dtype=wp.int32),
        any_hit_out: wp.array(dtype=wp.int32),
    ):
        """Where shortened vertices end; the next pass begins."""
        i = first + wp.tid()
        if t.fraction[i] < scalar(1.0):
            t.u_end[i] = u[i] + t.fraction[i] * (u_tilde[i] - u[i])
            t.x_end[i] = base[i] + t.u_end[i]
        if i < groups:
            least_out[i] = unit
        if i == 0:
            t.passes[0] = t.passes[0] + 1
            any_hit_out[0] = 0

    @kernel(module)
    def begin(
        first: int,
        bodies: int,
        base: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        t_out: Truncated,
        deep_out: wp.array(dtype=wp.int32),
    ):
        """The whole motion."""
        i = first + wp.tid()
        t_out.fraction[i] = scalar(1.0)
        t_out.first_fraction[i] = scalar(1.0)
        t_out.u_end[i] = u_tilde[i]
        t_out.x_end[i] = base[i] + u_tilde[i]
        if i < bodies:
            deep_out[i] = 0
        if i == 0:
            t_out.passes[0] = 0

    return SimpleNamespace(
        sweep=sweep,
        together=together,
        find_least=find_least,
        spread_least=spread_least,
        level=level,
        shorten=shorten,
        grade=grade,
        place=place,
        begin=begin,
    )


class Truncation:
    """Finds x_end between x and x~, vertex by vertex, such that no candidate pair meets on the way.

    neighbours: offsets (n + 1,) and columns of those that elasticity
    connects, or None. bodies: vertices (k,) of those that move as four points do, and so keep one time. body: (n,) the body of each vertex, -1 for none; deep: (bodies,) which bodies have a hit at a gap below DEEP d_hat; these are
    set by who wants to know. u_end, x_end: (n,) vec3, the result; fraction: (n,), the part of its motion
    that each vertex keeps, and first_fraction: what the first pass left it, the pair's time; passes: (1,) int32 on the device. truncated: these as
    kernels take them.
    """

    def __init__(self, device: Device, real: Real, n: int, per_vertex: bool = True, bodies: Sequence[np.ndarray] = ()):
        self.device, self.real, self.n, self.per_vertex = device, real, n, per_vertex
        self.kernels = kernels(real)
        self.multiplier = wp.full(n, UNIT, dtype=wp.int32, device=device.warp)
        self.fraction, self.first_fraction = (wp.zeros(n, dtype=real.scalar, device=device.warp) for _ in range(2))
        self.u_end, self.x_end = (wp.zeros(n, dtype=real.vec3, device=device.warp) for _ in range(2))
        self.body_count = 0
        self.body = wp.full(n, -1, dtype=wp.int32, device=device.warp)
        self.deep = wp.zeros(1, dtype=wp.int32, device=device.warp)
        self.neighbours: list[wp.array] | None = None
        self.graded = wp.zeros(n, dtype=real.scalar, device=device.warp)
        self.bodies = list(bodies)
        self.keep_rigid([])
        self.passes, self.any_hit = (wp.zeros(1, dtype=wp.int32, device=device.warp) for _ in range(2))
        self.truncated = filled(truncated(real), self)

    def keep_rigid(self, groups: list[np.ndarray]) -> None:
        """Vertices (k,) of each obstacle that must stay rigid: these share one time. What was recorded has to be recorded again."""
        rigid = np.zeros(self.n, dtype=np.int32)
        if self.per_vertex and groups:
            rigid[np.concatenate(groups)] = 1
        self.rigid = wp.array(rigid, device=self.device.warp)
        groups = [*groups, *self.bodies] if self.per_vertex else [np.arange(self.n)]
        ends = np.cumsum([0, *map(len, groups)]).astype(np.int32)
        self.group_count = len(groups)
        self.group_ends = wp.array(ends, device=self.device.warp)
        members = np.concatenate([np.zeros(0), *groups, np.zeros(1)]).astype(np.int32)
        self.group_members = wp.array(members, device=self.device.warp)
        group_of = np.full(self.n, -1, dtype=np.int32)
        for group, vertices in enumerate(groups):
            group_of[vertices] = group
        self.group_of = wp.array(group_of, device=self.device.warp)
        self.least = wp.full(max(1, len(groups)), UNIT, dtype=wp.int32, device=self.device.warp)

    def truncate(self, candidates: Candidates, base: wp.array, u: wp.array, u_tilde: wp.array, x: wp.array) -> None:
        """Fills u_end, x_end = base + u_end and `passes`, the number of passes that found hits: 0 where the whole motion is free.

        base: (n,) m, positions at the start of the step; u and u_tilde: displacements from there; x = base + u. Recordable.
        """
        self.device.launch(self.kernels.begin, self.n, [self.body_count, base, u_tilde, self.truncated, self.deep])
        self.prove(candidates, base, u, u_tilde, x)

    def prove(self, candidates: Candidates, base: wp.array, u: wp.array, u_tilde: wp.array, x: wp.array) -> None:
        """The passes over the motion x -> x_end, with `fraction`, `u_end` and `x_end` as they are; `passes` says where to begin:
        0 with all pairs, more with those of shortened vertices. Recordable.
        """
        k, device, n = self.kernels, self.device, self.n

        def sweep() -> None:
            pairs = [each.listed for each in candidates.lists]
            inputs = [*pairs, x, self.truncated, self.body, self.rigid, self.multiplier, self.any_hit, self.deep]
            device.launch_list(k.sweep, candidates.capacity, inputs)

        def shorten() -> None:
            if self.group_count and device.wide:
                device.launch(k.find_least, n, [self.group_of, self.multiplier, self.least])
                device.launch(k.spread_least, n, [self.group_of, self.least, self.multiplier])
            elif self.group_count:
                device.launch(k.together, self.group_count, [self.group_ends, self.group_members, self.multiplier])
            device.launch(k.shorten, n, [self.multiplier, self.truncated])
            if self.neighbours is not None:
                for _ in range(RINGS // 2):
                    for before, after in ((self.fraction, self.graded), (self.graded, self.fraction)):
                        device.launch(k.grade, n, [*self.neighbours, x, u, u_tilde, before, after], grain=16)
                if self.bodies:
                    device.launch(k.level, self.group_count, [self.group_ends, self.group_members, self.fraction])
            device.launch(k.place, n, [self.group_count, base, u, u_tilde, self.truncated, self.least, self.any_hit])
            candidates.check(x, self.x_end)  # shortened vertices no longer move along with their neighbours
            device.when(candidates.needed, lambda: candidates.cover(x, self.x_end))
            sweep()

        sweep()
        device.loop(self.any_hit, shorten)
