"""Conservative continuous collision detection (CCD): times up to which a pair provably keeps its minimum separation.

A pair is two convex sets, a vertex and a triangle or two edges, whose vertices move linearly. q_k(t) = (1 - t) q_k(0) + t q_k(1)
are the differences x_j - x_i of one vertex of each: three for vertex-triangle, four for edge-edge.

**Lemma 1 (separating direction).** Let n be any vector, |n| = 1. If n . q_k(t) >= g for every k at t = t1 and at t = t2, then
the distance is at least g at every t in [t1, t2]. Proof: n . q_k is linear in t, so it is at least g in between; any point of one set
less any point of the other is a convex combination of the q_k, so its projection on n is at least g, and so is its length.

So *any* n gives a valid time, and rounding in the choice of n costs quality, never safety. With the direction between the
closest points at t the minimum over k of n . q_k(t) is the distance itself, and the first t' at which one n . q_k falls to
g is at least what an additive CCD step would reach, (d - g) / l_p with l_p = max |q_k'| (Li et al. 2021): n . q_k' >= -l_p. The
iteration is conservative advancement with directions: choose n at t, go on to t', repeat until the gap is used up.

**Lemma 2 (rounding).** Coordinates are scaled so that all |q_k| components are at most 1; u = 2^-53. A computed q_k is
off by 2u a component (difference, scaling), n . q_k by at most (2 + 3) sqrt(3) u < 9u, its value at t by 9u more, |n| by 3u relative, the
crossing time by 3u of a slope below 3.5. Together below 50 u; `SLACK` = 64 u is added to what a projection must exceed.

All of this is in double precision, whatever the precision of the scene. Differences of float32 coordinates are exact there or
nearly so, so float32 scenes are as safe as float64 ones. What comes before is a reject in the scene's own precision, which
is where nearly all candidates end (Lemma 1 over [0, 1], with the three axes and the direction at the start):

**Lemma 3 (reject).** With components of q_k at most Q and the unit roundoff u of the scene, a computed n . q_k is off by at most
u |n|_1 Q for the differences and 3u |n|_1 Q for the sum; what is made of it before it is compared adds 4u |n|_1 Q. REJECT_SLACK = 16 u
|n|_1 Q is taken off first.

**Target.** The gap kept is g = xi + s min(d(0) - xi, reach), s = `backoff`: the barrier needs room. Times are returned as soon as
the gap is below xi + 1.5 s min(d(0) - xi, reach). What ends in the middle of the iteration (cap of iterations, no
direction separates any more) returns the last time that is proven.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.contact import distance
from pdipc.precision import Real

MAX_ITERATIONS = 32
SLACK = 64.0 * 2.0**-53
REJECT_SLACK = 16.0
STOP = 1.5
NEVER = 2.0
ALIGNED = 1.0e-14  # squared sine below which the normal of two edges is not trusted first


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """The CCD in one precision."""
    scalar, vec3 = real.scalar, real.vec3
    wide, wide3 = wp.float64, wp.vec3d
    dist = distance.functions(real)
    along_segment = dist.along_segment
    relative = dist.relative
    zero, one = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
    narrowing = wp.constant(wp.float64(1.0 - 4.0 * real.unit_roundoff))
    smallest = wp.constant(wp.float64(1.0e-30))

    @wp.func
    def across(r: wide3, e: wide3) -> wide3:
        """r made orthogonal to e once more: cancellation in r left a part along e, which is long where r is short."""
        return r - (wp.dot(r, e) / wp.dot(e, e)) * e

    @wp.func
    def segment_direction(a: wide3, b: wide3) -> wide3:
        """From the origin to the nearest point of a segment."""
        s = along_segment(a, b)
        if s <= zero:
            return a
        if s >= one:
            return b
        return across(a + s * (b - a), b - a)

    @wp.func
    def shorter(a: wide3, b: wide3) -> wide3:
        if wp.dot(b, b) < wp.dot(a, a):
            return b
        return a

    @wp.func
    def facing(n: wide3, q: wide3) -> wide3:
        if wp.dot(n, q) < zero:
            return -n
        return n

    @wp.func
    def vertex_triangle_direction(a: wide3, b: wide3, c: wide3, second: int) -> wide3:
        """From a vertex at the origin to the nearest point of a triangle; not normalized. second: the second choice."""
        normal = wp.cross(b - a, c - a)
        out_a = wp.dot(normal, wp.cross(b, c)) <= zero
        out_b = wp.dot(normal, wp.cross(c, a)) <= zero
        out_c = wp.dot(normal, wp.cross(a, b)) <= zero
        inside = not (out_a or out_b or out_c)
        if inside == (second == 0):
            return facing(normal, a)
        n = a
        found = bool(False)
        if out_a or inside:
            n = segment_direction(b, c)
            found = True
        if out_b or inside:
            m = segment_direction(c, a)
            if found:
                n = shorter(n, m)
            else:
                n = m
            found = True
        if out_c or inside:
            m = segment_direction(a, b)
            if found:
                n = shorter(n, m)
            else:
                n = m
        return n

    @wp.func
    def edge_edge_direction(q00: wide3, q01: wide3, q10: wide3, q11: wide3, second: int) -> wide3:
        """From the nearest point of edge a to that of edge b, q_ij = b_j - a_i; not normalized. second: the second choice."""
        e1 = q00 - q10
        e2 = q01 - q00
        a = wp.dot(e1, e1)
        b = wp.dot(e1, e2)
        e = wp.dot(e2, e2)
        c = -wp.dot(e1, q00)
        f = -wp.dot(e2, q00)
        sine_sq = a * e - b * b
        s = b * f - c * e
        t = a * f - b * c
        inside = s > zero and s < sine_sq and t > zero and t < sine_sq and sine_sq > wide(ALIGNED) * a * e
        if inside == (second == 0):
            return facing(wp.cross(e1, e2), q00)
        # from each end of one edge to the other edge
        n = shorter(segment_direction(q00, q01), segment_direction(q10, q11))
        return shorter(n, -shorter(segment_direction(-q00, -q10), segment_direction(-q01, -q11)))

    @wp.func
    def largest(q: wide3) -> wide:
        return wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.abs(q[2]))

    @wp.func
    def begin(t: wide) -> scalar:
        """A time in the scene's precision, rounded down."""
        if t < smallest:
            return scalar(0.0)
        return scalar(t * narrowing)

    def advance(edge_edge: bool):
        @wp.func
        def kernel(
            p0: wide3, p1: wide3, p2: wide3, p3: wide3,
            r0: wide3, r1: wide3, r2: wide3, r3: wide3,
            xi: wide, backoff: wide, reach: wide,
        ) -> wide:  # fmt: skip
            """Differences p at the start and r at the end -> time up to which the gap stays, or NEVER."""
            size = wp.max(wp.max(largest(p0), largest(p1)), wp.max(largest(p2), largest(p3)))
            size = wp.max(size, wp.max(wp.max(largest(r0), largest(r1)), wp.max(largest(r2), largest(r3))))
            if not size > zero:
                return zero
            scale = one / size
            p0 *= scale
            p1 *= scale
            p2 *= scale
            p3 *= scale
            r0 *= scale
            r1 *= scale
            r2 *= scale
            r3 *= scale
            slack = wide(SLACK)
            separation = xi * scale * (one + slack)
            t = zero
            keep = zero
            stop = zero
            second = int(0)
            for _iteration in range(wp.static(MAX_ITERATIONS)):
                q0 = p0 + t * (r0 - p0)
                q1 = p1 + t * (r1 - p1)
                q2 = p2 + t * (r2 - p2)
                n = wide3()
                if wp.static(edge_edge):
                    n = edge_edge_direction(q0, q1, q2, p3 + t * (r3 - p3), second)
                else:
                    n = vertex_triangle_direction(q0, q1, q2, second)
                length_sq = wp.dot(n, n)
                gap = -one
                reached = zero
                if length_sq > wide(1.0e-280):
                    n *= one / wp.sqrt(length_sq)
                    f0 = wp.dot(n, p0)
                    f1 = wp.dot(n, p1)
                    f2 = wp.dot(n, p2)
                    g0 = wp.dot(n, r0)
                    g1 = wp.dot(n, r1)
                    g2 = wp.dot(n, r2)
                    gap = wp.min(wp.min(f0 + t * (g0 - f0), f1 + t * (g1 - f1)), f2 + t * (g2 - f2))
                    f3 = zero
                    g3 = one
                    if wp.static(edge_edge):
                        f3 = wp.dot(n, p3)
                        g3 = wp.dot(n, r3)
                        gap = wp.min(gap, f3 + t * (g3 - f3))
                    gap -= slack
                    if t == zero and gap > separation:
                        room = wp.min(gap - separation, reach * scale)
                        keep = separation + backoff * room
                        stop = separation + wide(STOP) * backoff * room
                    if gap >= keep and gap > separation:
                        if t > zero and gap <= stop:
                            return t
                        h = keep + slack
                        reached = wide(NEVER)
                        if g0 < h:
                            reached = wp.min(reached, (f0 - h) / (f0 - g0))
                        if g1 < h:
                            reached = wp.min(reached, (f1 - h) / (f1 - g1))
                        if g2 < h:
                            reached = wp.min(reached, (f2 - h) / (f2 - g2))
                        if wp.static(edge_edge):
                            if g3 < h:
                                reached = wp.min(reached, (f3 - h) / (f3 - g3))
                        if reached >= one:
                            return wide(NEVER)
                if reached > t:
                    t = reached
                    second = 0
                elif second == 0:
                    second = 1
                else:
                    return t
            return t

        return kernel

    advance_vertex_triangle = advance(False)
    advance_edge_edge = advance(True)

    @wp.func
    def vertex_triangle(
        p0: vec3, a0: vec3, b0: vec3, c0: vec3, p1: vec3, a1: vec3, b1: vec3, c1: vec3,
        xi: scalar, backoff: scalar, reach: scalar,
    ) -> scalar:  # fmt: skip
        """Time in [0, 1] up to which a vertex and a triangle provably stay farther apart than xi, or 2 for all of [0, 1].

        Positions at the start (0) and end (1) of a linear motion. xi: minimum separation in metres. backoff, reach: the
        fraction of the gap that is kept, and the gap (metres) above which it counts no more.
        """
        q0 = relative(a0, p0)
        q1 = relative(b0, p0)
        q2 = relative(c0, p0)
        r0 = relative(a1, p1)
        r1 = relative(b1, p1)
        r2 = relative(c1, p1)
        return begin(advance_vertex_triangle(q0, q1, q2, q2, r0, r1, r2, r2, wide(xi), wide(backoff), wide(reach)))

    @wp.func
    def edge_edge(
        a00: vec3, a10: vec3, b00: vec3, b10: vec3, a01: vec3, a11: vec3, b01: vec3, b11: vec3,
        xi: scalar, backoff: scalar, reach: scalar,
    ) -> scalar:  # fmt: skip
        """The same for the edges a0-a1 and b0-b1; the last digit is 0 at the start and 1 at the end of the motion."""
        return begin(
            advance_edge_edge(
                relative(b00, a00), relative(b10, a00), relative(b00, a10), relative(b10, a10),
                relative(b01, a01), relative(b11, a01), relative(b01, a11), relative(b11, a11),
                wide(xi), wide(backoff), wide(reach),
            )
        )  # fmt: skip

    return SimpleNamespace(vertex_triangle=vertex_triangle, edge_edge=edge_edge)
