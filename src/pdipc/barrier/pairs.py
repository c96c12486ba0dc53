"""Active pairs: the barriers of one outer iteration, and what the inner loop needs of them (Algorithm 1, line 5).

At the feasible x of an outer iteration the pairs nearer than d_hat are listed and their witness weights a, normal n, gap d0 and
stiffness are frozen. In the inner loop a pair's gap is linear in the iterate x~:

    delta = d0 + n . sum_i a_i (x~_i - x_i),    force on vertex i: -f a_i n,    f = kappa m b'(delta)

with b' extended linearly below gamma d0, since the iterate may pass through before it is truncated. This departs from Eq. (6):
a position target cannot carry a force that grows without bound (docs/paper_map.md).

Friction is Coulomb's, smoothed as in IPC: mu lambda f1(|u|) / |u| times the slip u since the start of the step, with the normal
force lambda = -f and u of the iterate, as a spring that is renewed with every local-global iteration. Lagging it over an outer
iteration does not work here: after a truncation the frozen gap, and so lambda, is far from equilibrium, and states limit-cycle.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.barrier import potential as barrier
from pdipc.collision import distance
from pdipc.collision.candidates import SILENT, Candidates, grouped
from pdipc.collision.candidates import listed as candidates_of
from pdipc.device import blocks
from pdipc.device.language import Function, filled, func, kernel, struct_of
from pdipc.device.launch import Device, Reducer, Span
from pdipc.device.precision import Real, Scalar
from pdipc.linear.contact_rows import first_entry

FIRST_PAIRS = 1024  # room at first, at least: a list that grows has the step retaken and recorded anew
PAIRS_OF_EACH = 0.25  # room at first for each vertex
MOST_SPARE = 1 << 18  # pairs; a list that grows has room for twice as many as were found, but for no more than so many besides
LEAST_GAP = 16.0  # unit roundoffs of d_hat: smaller gaps are taken for this


@functools.cache
def frozen(real: Real) -> Any:
    """A struct: the pairs of an outer iteration as kernels read them."""
    scalar = real.scalar
    return struct_of(
        "Frozen",
        __name__,
        count=wp.array(dtype=wp.int32),  # pairs in use; most found; of these vertex-triangle
        quads=wp.array(dtype=wp.vec4i),
        weights=wp.array(dtype=real.vec4),  # a
        normals=wp.array(dtype=real.vec3),  # n
        gaps=wp.array(dtype=scalar),  # d0, m
        activation=wp.array(dtype=scalar),  # d_hat, m
        stiffness=wp.array(dtype=scalar),  # kappa m, N/m
        coefficient=wp.array(dtype=scalar),  # of friction
        ends=wp.array(dtype=wp.int32),  # of each vertex, where its pairs end in
        entries=wp.array(dtype=wp.int32),  # 4 pair + place
    )


@functools.cache
def brought(real: Real) -> Any:
    """A struct: what vertices bring to their pairs; see `FrozenPairs`."""
    return struct_of(
        "Brought",
        __name__,
        kappa=wp.array(dtype=real.scalar),
        friction=wp.array(dtype=real.scalar),
        free=wp.array(dtype=real.scalar),
    )


@func
def pair_stiffness(a: Scalar, b: Scalar, mollifier: Scalar):
    """N/m, of a pair whose sides bring a and b: their mean, since a pair is as stiff as its bodies are heavy; kinematic vertices, which bring 0,
    have no say.
    """
    zero = type(a)(0.0)
    if a == zero or b == zero:
        return mollifier * (a + b)
    return mollifier * type(a)(0.5) * (a + b)


@func
def counts_here(q: wp.vec4i, s: int, free: wp.array(dtype=Scalar)) -> bool:
    """Whether vertex s of a pair is the first that is free: with it the pair's energy is counted."""
    first = bool(True)
    for t in range(4):
        if t < s and free[q[t]] > type(free[0])(0.0):
            first = False
    return first


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    Frozen, Brought, Listed, Grouped = frozen(real), brought(real), candidates_of(real), grouped(real)
    scalar, vec2, vec3, vec4, mat33 = real.scalar, real.vec2, real.vec3, real.vec4, real.mat33
    module = real.module(__name__)
    far = wp.constant(real.scalar(1.0e30))
    least = wp.constant(real.scalar(LEAST_GAP * real.unit_roundoff))
    silent = wp.constant(SILENT)
    block_total, block_least = blocks.total(wp.int32), blocks.least(scalar)
    block_scan, last_block = blocks.scan(), blocks.last()

    @func
    def vertex_triangle_gap(x: wp.array(dtype=vec3), q: wp.vec4i, limits: vec2) -> scalar:
        p = x[q[0]]
        a = x[q[1]]
        b = x[q[2]]
        c = x[q[3]]
        apart = wp.max(wp.max(wp.min(wp.min(a, b), c) - p, p - wp.max(wp.max(a, b), c)))
        if apart >= limits[0] + limits[1]:
            return far
        w = vec4(distance.vertex_triangle_weights(p, a, b, c))
        return wp.length(w[0] * (p - a) + w[2] * (b - a) + w[3] * (c - a)) - limits[0]

    @func
    def edge_edge_gap(x: wp.array(dtype=vec3), q: wp.vec4i, limits: vec2) -> scalar:
        a0 = x[q[0]]
        a1 = x[q[1]]
        b0 = x[q[2]]
        b1 = x[q[3]]
        apart = wp.max(wp.max(wp.min(b0, b1) - wp.max(a0, a1), wp.min(a0, a1) - wp.max(b0, b1)))
        if apart >= limits[0] + limits[1]:
            return far
        w = vec4(distance.edge_edge_weights(a0, a1, b0, b1))
        return wp.length(w[1] * (a1 - a0) + w[2] * (b0 - a0) + w[3] * (b1 - a0)) - limits[0]

    @func
    def gap_of(edges: bool, x: wp.array(dtype=vec3), q: wp.vec4i, limits: vec2) -> scalar:
        if edges:
            return edge_edge_gap(x, q, limits)
        return vertex_triangle_gap(x, q, limits)

    @func
    def foreseen(
        edges: bool, gap: scalar, q: wp.vec4i, limits: vec2, x: wp.array(dtype=vec3), ahead: wp.array(dtype=vec3)
    ) -> scalar:
        """The gap, negative where the motion x -> ahead closes it to less than the part FORESEEN of d_hat."""
        a = vec4(distance.pair_weights(edges, x[q[0]], x[q[1]], x[q[2]], x[q[3]]))
        r = a[1] * (x[q[1]] - x[q[0]]) + a[2] * (x[q[2]] - x[q[0]]) + a[3] * (x[q[3]] - x[q[0]])
        apart = wp.length(r)
        left = apart - limits[0]
        closing = scalar(0.0)
        for s in range(4):
            closing -= a[s] * wp.dot(r, ahead[q[s]] - x[q[s]]) / apart
        least_left = scalar(barrier.FORESEEN) * limits[1]
        if limits[1] > scalar(0.0) and left > least_left and left - closing < least_left:
            return -left
        return gap

    @kernel(module)
    def measure(
        span: Span,
        points: Listed,
        lines: Listed,
        x: wp.array(dtype=vec3),
        ahead: wp.array(dtype=vec3),
        driven: wp.array(dtype=wp.int32),
    ):
        """Gaps of the candidates, first of those of a vertex and a triangle; far where they are not active."""
        worker = span.first + wp.tid()
        count = points.count[0] + lines.count[0]
        for begin in range(worker * span.block, count, span.step * span.block):
            for i in range(begin, wp.min(begin + span.block, count)):
                edges = i >= points.count[0]
                k = i
                q = wp.vec4i()
                limits = vec2()
                face = int(silent)
                if edges:
                    k = i - points.count[0]
                    q = lines.quads[k]
                    limits = lines.limits[k]
                    face = lines.faces[k]
                else:
                    q = points.quads[k]
                    limits = points.limits[k]
                    face = points.faces[k]
                gap = far
                if face != silent:
                    # CCD has proven it positive; measured in this precision it may round to less, of which there is no logarithm
                    gap = wp.max(gap_of(edges, x, q, limits), least * limits[1])
                    if ahead:  # noqa: SIM102  (Warp evaluates both sides of an "and")
                        if driven[q[0]] + driven[q[1]] + driven[q[2]] + driven[q[3]] > 0:
                            gap = foreseen(edges, gap, q, limits, x, ahead)
                if gap >= limits[1]:
                    gap = far
                if edges:
                    lines.gaps[k] = gap
                else:
                    points.gaps[k] = gap

    @func
    def nearest_of_face(k: int, c: Listed) -> bool:
        """Whether no other triangle of its face is as near to the vertex of pair k, which has its pairs in a row; the first of equals is."""
        nearest = bool(True)
        own = wp.abs(c.gaps[k])  # what is foreseen has a minus
        if c.faces[k] >= 0:
            for way in range(2):
                step = 1 - 2 * way
                j = k + step
                while nearest and j >= 0 and j < c.count[0]:
                    if c.quads[j][0] != c.quads[k][0]:
                        j = c.count[0]
                    else:
                        other = wp.abs(c.gaps[j])
                        if c.faces[j] == c.faces[k] and (other < own or (way == 1 and other == own)):
                            nearest = False
                        j += step
        return nearest

    @func
    def acts(edges: bool, k: int, c: Listed) -> bool:
        """Whether a pair is active; of those of a flat face one is."""
        active = c.gaps[k] < far
        if active and not edges:
            active = nearest_of_face(k, c)
        return active

    @func
    def of_kind(edges: bool, points: Listed, lines: Listed) -> Listed:
        if edges:
            return lines
        return points

    @kernel(module)
    def count_active(
        first: int,
        points: Listed,
        lines: Listed,
        o: Grouped,
        capacity: int,
        count_out: wp.array(dtype=wp.int32),
        closest_out: wp.array(dtype=scalar),
        overflow: wp.array(dtype=wp.int32),
    ):
        """A block of threads a group of `size` pairs of one kind: how many are active. Who is last adds up: ends, where the active ones of each
        group end; count: pairs that fit, the most ever found, those of the first kind.
        """
        worker = first + wp.tid()
        group = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        before_lines = (points.count[0] + o.size - 1) // o.size
        groups = wp.max(before_lines + (lines.count[0] + o.size - 1) // o.size, 1)
        if group >= groups:
            return
        edges = group >= before_lines
        c = of_kind(edges, points, lines)
        begin = group * o.size
        if edges:
            begin = (group - before_lines) * o.size
        active = int(0)
        closest = far
        for k in range(begin + lane, wp.min(begin + o.size, c.count[0]), wp.block_dim()):
            closest = wp.min(closest, c.gaps[k])
            if acts(edges, k, c):
                active += 1
        active = block_total(active)
        closest = block_least(closest)
        if lane == 0:
            o.ends[group] = active
            o.smallest[group] = closest
        if last_block(o.arrived, 0, groups):
            found = int(0)
            closest = far
            for start in range(0, groups, wp.block_dim()):
                g = start + lane
                own = int(0)
                if g < groups:
                    own = o.ends[g]
                    closest = wp.min(closest, o.smallest[g])
                end = found + block_scan(own)
                if g < groups:
                    o.ends[g] = end
                found += block_total(own)
            closest = block_least(closest)
            if lane == 0:
                count_out[0] = wp.min(found, capacity)
                count_out[1] = wp.max(count_out[1], found)
                count_out[2] = 0
                if before_lines > 0:
                    count_out[2] = o.ends[before_lines - 1]
                closest_out[0] = closest
                if found > capacity:
                    overflow[0] = 1

    @kernel(module)
    def freeze(
        first: int,
        points: Listed,
        lines: Listed,
        o: Grouped,
        x: wp.array(dtype=vec3),
        brought: Brought,
        degree: wp.array(dtype=wp.int32),
        pairs_out: Frozen,
        share_out: wp.array(dtype=scalar),
    ):
        """The active pairs of each group, in their order. degree: where it is given, how many pairs each vertex has."""
        worker = first + wp.tid()
        group = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        before_lines = (points.count[0] + o.size - 1) // o.size
        if group >= before_lines + (lines.count[0] + o.size - 1) // o.size:
            return
        slot = int(0)
        if group > 0:
            slot = o.ends[group - 1]
        if o.ends[group] == slot:
            return
        edges = group >= before_lines
        c = of_kind(edges, points, lines)
        begin = group * o.size
        if edges:
            begin = (group - before_lines) * o.size
        end = wp.min(begin + o.size, c.count[0])
        for start in range(begin, end, wp.block_dim()):
            k = start + lane
            active = int(0)
            if k < end:  # noqa: SIM102  (Warp evaluates both sides of an "and")
                if acts(edges, k, c):
                    active = 1
            own = slot + block_scan(active) - 1
            slot += block_total(active)
            if active == 1 and own < pairs_out.quads.shape[0]:
                q = c.quads[k]
                p0 = x[q[0]]
                p1 = x[q[1]] - p0
                p2 = x[q[2]] - p0
                p3 = x[q[3]] - p0
                zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
                a = vec4(distance.pair_weights(edges, zero, p1, p2, p3))
                m = scalar(1.0)
                if edges:
                    m = barrier.mollifier(zero, p1, p2, p3)
                pairs_out.quads[own] = q
                pairs_out.weights[own] = a
                pairs_out.normals[own] = wp.normalize(a[1] * p1 + a[2] * p2 + a[3] * p3)
                pairs_out.gaps[own] = c.gaps[k]
                pairs_out.activation[own] = c.limits[k][1]
                pairs_out.stiffness[own] = pair_stiffness(brought.kappa[q[0]], brought.kappa[q[3]], m)
                pairs_out.coefficient[own] = wp.sqrt(brought.friction[q[0]] * brought.friction[q[3]])
                share = brought.free[q[0]] * wp.abs(a[0]) + brought.free[q[1]] * wp.abs(a[1])
                share_out[own] = share + brought.free[q[2]] * wp.abs(a[2]) + brought.free[q[3]] * wp.abs(a[3])
                if degree:
                    for s in range(4):
                        wp.atomic_add(degree, q[s], 1)

    @kernel(module)
    def count_incident(
        span: Span, count: wp.array(dtype=wp.int32), quads: wp.array(dtype=wp.vec4i), degree: wp.array(dtype=int)
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, count[0])):
                for s in range(4):
                    wp.atomic_add(degree, quads[k][s], 1)

    @kernel(module)
    def fill_incident(
        span: Span,
        count: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.vec4i),
        ends: wp.array(dtype=wp.int32),
        degree: wp.array(dtype=wp.int32),
        entries_out: wp.array(dtype=wp.int32),
    ):
        """Takes off `degree` what was counted: it is left at zero."""
        worker = span.first + wp.tid()
        for b in range(worker * span.block, count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, count[0])):
                for s in range(4):
                    v = quads[k][s]
                    left = wp.atomic_add(degree, v, -1)
                    entries_out[ends[v] - left] = k * 4 + s

    @kernel(module)
    def sort_incident(
        span: Span,
        count: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.vec4i),
        ends: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        sorted_out: wp.array(dtype=wp.int32),
        place_out: wp.array(dtype=wp.int32),
    ):
        """Puts a vertex's pairs in order, so that its sums do not depend on how threads raced to fill the list: each goes after as many
        as are less. place: where each vertex of each pair has gone."""
        worker = span.first + wp.tid()
        for b in range(worker * span.block, count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, count[0])):
                for s in range(4):
                    v = quads[k][s]
                    low = first_entry(v, ends)
                    before = int(0)
                    for i in range(low, ends[v]):
                        if entries[i] < k * 4 + s:
                            before += 1
                    sorted_out[low + before] = k * 4 + s
                    place_out[k * 4 + s] = low + before

    @kernel(module)
    def linearize(
        span: Span,
        pairs: Frozen,
        x: wp.array(dtype=vec3),
        x_tilde: wp.array(dtype=vec3),
        x_start: wp.array(dtype=vec3),
        slip_threshold: scalar,
        friction_out: wp.array(dtype=scalar),
        hessian_out: wp.array(dtype=scalar),
        force_out: wp.array(dtype=vec3),
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                q = pairs.quads[k]
                a = pairs.weights[k]
                n = pairs.normals[k]
                gap = pairs.gaps[k]
                d_hat = pairs.activation[k]
                stiffness = pairs.stiffness[k]
                coefficient = pairs.coefficient[k]
                move = a[0] * (x_tilde[q[0]] - x[q[0]]) + a[1] * (x_tilde[q[1]] - x[q[1]])
                move += a[2] * (x_tilde[q[2]] - x[q[2]]) + a[3] * (x_tilde[q[3]] - x[q[3]])
                delta = gap + wp.dot(n, move)
                floor = scalar(barrier.EXTENSION) * gap
                hessian_out[k] = stiffness * barrier.barrier_hessian(wp.max(delta, floor), d_hat)
                f = stiffness * barrier.extended_gradient(delta, floor, d_hat)
                # `force` is what the pair exerts, per unit of witness weight: barrier along n, friction across
                force = -f * n
                friction = scalar(0.0)
                if coefficient > scalar(0.0):
                    u = a[0] * (x_tilde[q[0]] - x_start[q[0]]) + a[1] * (x_tilde[q[1]] - x_start[q[1]])
                    u += a[2] * (x_tilde[q[2]] - x_start[q[2]]) + a[3] * (x_tilde[q[3]] - x_start[q[3]])
                    u -= wp.dot(u, n) * n
                    friction = -coefficient * f * barrier.smoothed_coulomb(wp.length(u), slip_threshold)
                    force -= friction * u
                friction_out[k] = friction
                force_out[k] = force

    @kernel(module)
    def gather(
        first: int,
        pairs: Frozen,
        friction: wp.array(dtype=scalar),
        share: wp.array(dtype=scalar),
        hessian: wp.array(dtype=scalar),
        force: wp.array(dtype=vec3),
        rhs: wp.array(dtype=vec3),
        diagonal_out: wp.array(dtype=mat33),
    ):
        """Adds the contact forces to the right-hand side and makes the block diagonal that dominates the contact Hessian."""
        v = first + wp.tid()
        low = first_entry(v, pairs.ends)
        total = vec3()
        d = mat33()
        for i in range(low, pairs.ends[v]):
            k = pairs.entries[i] // 4
            w = pairs.weights[k][pairs.entries[i] % 4]
            n = pairs.normals[k]
            total += w * force[k]
            scale = wp.abs(w) * share[k]
            d += scale * (hessian[k] - friction[k]) * wp.outer(n, n)
            f = scale * friction[k]
            d[0, 0] = d[0, 0] + f
            d[1, 1] = d[1, 1] + f
            d[2, 2] = d[2, 2] + f
        if pairs.ends[v] > low:
            rhs[v] = rhs[v] + total
        diagonal_out[v] = d

    @kernel(module)
    def stretch(
        span: Span,
        pairs: Frozen,
        p: wp.array(dtype=vec3),
        friction: wp.array(dtype=scalar),
        hessian: wp.array(dtype=scalar),
        response_out: wp.array(dtype=vec3),
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                q = pairs.quads[k]
                a = pairs.weights[k]
                n = pairs.normals[k]
                u = a[0] * p[q[0]] + a[1] * p[q[1]] + a[2] * p[q[2]] + a[3] * p[q[3]]
                response_out[k] = (hessian[k] - friction[k]) * wp.dot(n, u) * n + friction[k] * u

    @kernel(module)
    def spread(first: int, pairs: Frozen, response: wp.array(dtype=vec3), y: wp.array(dtype=vec3)):
        v = first + wp.tid()
        low = first_entry(v, pairs.ends)
        if pairs.ends[v] > low:
            total = vec3()
            for i in range(low, pairs.ends[v]):
                total += pairs.weights[pairs.entries[i] // 4][pairs.entries[i] % 4] * response[pairs.entries[i] // 4]
            y[v] = y[v] + total

    @kernel(module)
    def pair_energy(
        first: int,
        pairs: Frozen,
        energy_out: wp.array(dtype=scalar),
    ):
        k = first + wp.tid()
        energy_out[k] = scalar(0.0)
        if k < pairs.count[0]:
            energy_out[k] = pairs.stiffness[k] * barrier.barrier(pairs.gaps[k], pairs.activation[k])

    return SimpleNamespace(
        measure=measure,
        count_active=count_active,
        freeze=freeze,
        count_incident=count_incident,
        fill_incident=fill_incident,
        sort_incident=sort_incident,
        linearize=linearize,
        gather=gather,
        stretch=stretch,
        spread=spread,
        pair_energy=pair_energy,
    )


@functools.cache
def total_share(real: Real) -> Function:
    """What vertex v gets of its pairs, each of which has put its share in its place in the list of the vertex."""
    vec3 = real.vec3

    @func
    def total(v: int, ends: wp.array(dtype=wp.int32), shares: wp.array(dtype=vec3)) -> vec3:
        total_of_vertex = vec3()
        for i in range(first_entry(v, ends), ends[v]):
            total_of_vertex += shares[i]
        return total_of_vertex

    return total


@dataclass
class Exerted:
    """Forces of pairs. quads: (k, 4) int32, the vertices of each, of which the first is on one side and the last on the other. forces:
    (k, 4, 3) float64, N, on each of these vertices.
    """

    quads: np.ndarray
    forces: np.ndarray


class FrozenPairs:
    """The pairs of one outer iteration.

    kappa: (n,) barrier stiffness that a vertex brings to its pairs, N/m, 0 for kinematic vertices.
    friction: (n,) Coulomb coefficient; a pair has the geometric mean of its two sides. slip_threshold: eps_v h in metres.
    free: (n,) 1 for simulated, 0 for kinematic vertices.
    """

    def __init__(self, device: Device, real: Real, kappa: wp.array, friction: wp.array, free: wp.array, slip_threshold: float):
        n = len(kappa)
        self.device, self.real, self.kernels = device, real, kernels(real)
        self.kappa, self.friction_of_vertex, self.free, self.slip_threshold = kappa, friction, free, slip_threshold
        self.brought = brought(real)()
        self.brought.kappa, self.brought.friction, self.brought.free = kappa, friction, free
        self.count = wp.zeros(3, dtype=wp.int32, device=device.warp)  # pairs in use; most found; of these vertex-triangle
        self.closest = wp.zeros(1, dtype=real.scalar, device=device.warp)  # smallest gap, m
        self.degree = wp.zeros(n, dtype=wp.int32, device=device.warp)
        self.ends = wp.zeros(n, dtype=wp.int32, device=device.warp)
        self.generation = 0  # grows whenever arrays were replaced, so that recorded graphs are renewed
        self._allocate(max(FIRST_PAIRS, int(PAIRS_OF_EACH * n)))

    def _allocate(self, capacity: int) -> None:
        real = self.real

        def make(dtype):
            return wp.zeros(capacity, dtype=dtype, device=self.device.warp)

        self.capacity = capacity
        self.quads, self.weights, self.normals = make(wp.vec4i), make(real.vec4), make(real.vec3)
        self.gaps, self.activation, self.stiffness = make(real.scalar), make(real.scalar), make(real.scalar)
        self.coefficient, self.friction = make(real.scalar), make(real.scalar)
        self.share, self.hessian = make(real.scalar), make(real.scalar)
        self.force, self.response, self.energies = make(real.vec3), make(real.vec3), make(real.scalar)
        self.rebound = make(real.scalar)  # N: what restitution adds along the normal, see `Restitution.keep`
        self.entries = wp.zeros(4 * capacity, dtype=wp.int32, device=self.device.warp)
        self.frozen = filled(frozen(real), self)
        wide = 4 * capacity if self.device.wide else 1
        self.unsorted, self.places = (wp.zeros(wide, dtype=wp.int32, device=self.device.warp) for _ in range(2))
        self.shares = wp.zeros(wide, dtype=real.vec3, device=self.device.warp)
        self.energy_sum = Reducer(self.device, real, capacity)
        self.generation += 1

    def freeze(
        self, candidates: Candidates, x: wp.array, ahead: wp.array | None = None, driven: wp.array | None = None
    ) -> None:
        """Lists the pairs nearer than d_hat at the feasible x (Algorithm 1, line 5). Recordable.

        ahead: (n,) where vertices are going; with it those are listed, too, that have a vertex in `driven`, (n,) int32, and will be nearer than
        FORESEEN d_hat, their gap with a minus. Where they do not fit, `candidates.overflow` is set and the list is incomplete.
        """
        k, device, groups = self.kernels, self.device, candidates.groups
        pairs = [each.listed for each in candidates.lists]
        device.launch_list(k.measure, candidates.capacity, [*pairs, x, ahead, driven])
        inputs = [*pairs, groups.grouped, self.capacity, self.count, self.closest, candidates.overflow]
        device.launch_blocks(k.count_active, groups.number, inputs, grain=groups.size)
        degree = self.degree if device.wide else None
        inputs = [*pairs, groups.grouped, x, self.brought, degree, self.frozen, self.share]
        device.launch_blocks(k.freeze, groups.number, inputs, grain=groups.size)
        # each vertex's pairs, in order
        if not device.wide:
            device.launch_scatter(k.count_incident, self.capacity, [self.count, self.quads, self.degree])
        device.scan(self.degree, self.ends)
        filled = self.unsorted if device.wide else self.entries
        device.launch_scatter(k.fill_incident, self.capacity, [self.count, self.quads, self.ends, self.degree, filled])
        if device.wide:
            inputs = [self.count, self.quads, self.ends, self.unsorted, self.entries, self.places]
            device.launch_list(k.sort_incident, self.capacity, inputs)

    def expect(self, x: wp.array, x_tilde: wp.array, fraction: wp.array | None = None) -> None:
        """What is left of the motion x -> x~ of which each vertex made `fraction`: only the paper's mode needs to know."""

    def grow(self) -> bool:
        """Makes room for what overflowed; returns whether anything had to."""
        found = int(self.count.numpy()[1])
        if found <= self.capacity:
            return False
        self._allocate(found + min(found, MOST_SPARE))
        return True

    def listed(self, *arrays: wp.array) -> list[np.ndarray]:
        """The entries in use of arrays with one a pair, numbers as float64."""
        return listed(int(self.count.numpy()[0]), *arrays)

    def energy(self, out: wp.array, slot: int) -> None:
        """out[slot] = sum of kappa m b(d0) over the pairs, in joules. Recordable."""
        self.device.launch(self.kernels.pair_energy, self.capacity, [self.frozen, self.energies])
        self.energy_sum.sum(self.energies, out, slot)


class ActivePairs(FrozenPairs):
    """Their barriers and friction, and the contact operator that the linear solver applies. diagonal: (n,) 3x3 blocks, kg/s^2."""

    scalar = None  # the paper mode's diagonal; this mode couples the vertices of a pair instead

    def __init__(self, device: Device, real: Real, kappa: wp.array, friction: wp.array, free: wp.array, slip_threshold: float):
        super().__init__(device, real, kappa, friction, free, slip_threshold)
        self.diagonal = wp.zeros(len(kappa), dtype=real.mat33, device=device.warp)

    def linearize(self, x: wp.array, x_tilde: wp.array, x_start: wp.array, rhs: wp.array) -> None:
        """Forces at the iterate x~ added to rhs, and their Hessian and block diagonal there. Recordable.

        x_start: positions at the start of the step, from which slip is measured.
        """
        inputs = [self.frozen, x, x_tilde, x_start, self.slip_threshold, self.friction, self.hessian, self.force]
        self.device.launch_list(self.kernels.linearize, self.capacity, inputs)
        self.gather(rhs)

    def forces(self, x: wp.array) -> wp.array:
        """(n,) vec3, N: what the frozen pairs exert at x on each vertex."""
        force = wp.zeros(len(self.ends), dtype=self.real.vec3, device=self.device.warp)
        self.linearize(x, x, x, force)
        return force

    def exerted(self, u: wp.array, u_start: wp.array) -> tuple[Exerted, Exerted]:
        """Along the normals and across them: what the frozen pairs exert where they were frozen, with the slip u - u_start since the start
        of the step, and what restitution added. Not recordable.
        """
        self.linearize(u, u, u_start, wp.zeros(len(self.ends), dtype=self.real.vec3, device=self.device.warp))
        quads, weights, normals, force = self.listed(self.quads, self.weights, self.normals, self.force)
        along = np.einsum("ki,ki->k", force, normals)
        across = force - along[:, None] * normals
        along += self.listed(self.rebound)[0]
        pushed, rubbed = (weights[:, :, None] * each[:, None, :] for each in (along[:, None] * normals, across))
        return Exerted(quads, pushed), Exerted(quads, rubbed)

    def gather(self, rhs: wp.array) -> None:
        """Adds the forces of the pairs to rhs, and makes the block diagonal that dominates their Hessian. Recordable."""
        inputs = [self.frozen, self.friction, self.share, self.hessian, self.force]
        self.device.launch(self.kernels.gather, len(self.ends), [*inputs, rhs, self.diagonal])

    def apply(self, p: wp.array, y: wp.array) -> None:
        """y += (contact Hessian) p, pair by pair and gathered per vertex. Recordable."""
        k = self.kernels
        inputs = [self.frozen, p, self.friction, self.hessian, self.response]
        self.device.launch_list(k.stretch, self.capacity, inputs)
        self.device.launch(k.spread, len(self.ends), [self.frozen, self.response, y])


def listed(count: int, *arrays: wp.array) -> list[np.ndarray]:
    """The first `count` entries, numbers as float64."""
    found = [array[:count].numpy() for array in arrays]
    return [each if each.dtype.kind == "i" else each.astype(np.float64) for each in found]
