"""Conservative continuous collision detection (CCD): times up to which a pair provably keeps its minimum separation.

A pair is two convex sets, a vertex and a triangle or two edges, whose vertices move linearly. The differences x_j - x_i of a
vertex of each, q_k(t) = (1 - t) q_k(0) + t q_k(1), are all that is needed: three for vertex-triangle, four for edge-edge.

**Lemma 1 (separating direction).** Let |n| = 1. If n . q_k(t) >= g for every k at t = t1 and at t = t2, the distance is at
least g at every t in [t1, t2]. Proof: n . q_k is linear in t, so it is at least g in between. A point of one set less a
point of the other is a convex combination of the q_k, so its projection on n is at least g, and so is its length.

So *any* n gives a valid time, and rounding in the choice of n costs quality, never safety. For the direction between the
closest points at t, the least n . q_k(t) is the distance d itself, and the first time at which one n . q_k falls to g is not
before that of an additive CCD step (Li et al. 2021), t + (d - g) / l_p with l_p = max |q_k'|, since n . q_k' >= -l_p. The
iteration is: choose n at t, go on to that time, repeat until the gap is used up. Near-parallel edges, slivers, points in
place of triangles: all are just bad n, and then others are tried.

A fixed n is a poor one while a pair rotates. Section 6's cubic follows the rotation: while the volume exceeds g times the
largest area, the distance exceeds g (`cubic`). Its root from below is where the iteration starts; without one the pair is done.

**Lemma 2 (rounding).** Coordinates are scaled so that all components of q_k are at most 1 in size; u = 2^-53. A computed q_k is
off by 2u a component (difference, scaling), n . q_k by at most (2 + 3) sqrt(3) u < 9u, its value at t by 9u more; |n| is off
by 3u relative, and the crossing time by 3u of a slope below 3.5. Together this is below 50u. SLACK = 64u is taken off. Where the
largest component is not between SMALLEST and LARGEST, so that it cannot be scaled, the time is 0.

All of this is in double precision, whatever the precision of the scene: differences of float32 coordinates are exact there,
or nearly so, and a float32 scene is as safe as a float64 one. What comes before is a reject in the scene's own precision,
which is where nearly all candidates end: Lemma 1 over [0, 1] with the three axes and the direction at the start.

**Lemma 3 (reject).** With components of q_k at most Q and u the unit roundoff of the scene, a computed n . q_k is off by at
most u |n|_1 Q for the differences and 3u |n|_1 Q for the sum. For edges, n . (b_j - a_1) is n . (b_j - a_0) less
n . (a_1 - a_0): 15u |n|_1 Q. What is made of it before it is compared adds 4u |n|_1 Q. REJECT_SLACK = 24u |n|_1 Q is taken off,
at the start and once more for the least of both ends. On an axis nothing rounds but the difference, by u relative. Two computed
numbers of which one is greater are so before their last rounding, even where that under- or overflows; so what counts in over^2 >
near^2 |n|^2 is the underflow of near^2 alone, by 2^-150 in float32, and the slack that is not needed, 5u Q twice, is more: |n|^2 > small_sq
takes Q > 2e-16, so (5u Q)^2 > 2^-148. In float64 both are farther apart.

**Target.** The gap to keep is g = xi + s min(d(0) - xi, reach), s = `backoff`, since the barrier needs room. A time is good
enough, and returned, when the gap there is below xi + 1.5 s min(d(0) - xi, reach). When iterations run out, or no direction
separates any more, the last proven time is returned: 0 for a pair that starts at xi, or at rounding from it.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.collision import cubic as cubics
from pdipc.collision.distance import relative
from pdipc.device.language import func
from pdipc.device.precision import Real, Scalar, Vec3, unit_roundoff

MAX_ITERATIONS = 64
SLACK = 64.0 * 2.0**-53
REJECT_SLACK = 24.0
STOP = 1.5
NEVER = 2.0
TOLERANCE = 0.05  # of the volume at the start: where the cubic's iteration ends
ALIGNED = 1.0e-14  # squared sine of two edges below which their normal is not trusted first
SMALLEST, LARGEST = 1.0e-300, 1.0e300  # m, of a difference
DIRECTIONS = 3  # choices of n that are tried before giving up


# Directions between closest points; `choice` 0 is the best guess, 1 and 2 are tried when that one does not separate.


@func
def across(r: Vec3, e: Vec3):
    """r made orthogonal to e once more: cancellation in r left a part along e, which is long where r is short."""
    return r - (wp.dot(r, e) / wp.dot(e, e)) * e


@func
def segment_direction(a: Vec3, b: Vec3):
    """From the origin to the nearest point of a segment."""
    e = b - a
    along = -wp.dot(a, e)
    length_sq = wp.dot(e, e)
    if not along > type(along)(0.0):
        return a
    if not along < length_sq:
        return b
    return across(a + (along / length_sq) * e, e)


@func
def shorter(a: Vec3, b: Vec3):
    if wp.dot(b, b) < wp.dot(a, a):
        return b
    return a


@func
def facing(n: Vec3, q: Vec3):
    if wp.dot(n, q) < type(n[0])(0.0):
        return -n
    return n


@func
def vertex_triangle_direction(a: Vec3, b: Vec3, c: Vec3, choice: int):
    """From a vertex at the origin to the nearest point of a triangle; not normalized."""
    zero = type(a[0])(0.0)
    normal = wp.cross(b - a, c - a)
    out_a = wp.dot(normal, wp.cross(b, c)) <= zero
    out_b = wp.dot(normal, wp.cross(c, a)) <= zero
    out_c = wp.dot(normal, wp.cross(a, b)) <= zero
    inside = not (out_a or out_b or out_c)
    if inside == (choice == 0):
        return facing(normal, a)
    if not inside:
        # the nearest point is on an edge that the vertex is outside of; mostly there is just one
        if not (out_b or out_c):
            return segment_direction(b, c)
        if not (out_a or out_c):
            return segment_direction(c, a)
        if not (out_a or out_b):
            return segment_direction(a, b)
    return shorter(shorter(segment_direction(a, b), segment_direction(b, c)), segment_direction(c, a))


@func
def edge_edge_direction(q00: Vec3, q01: Vec3, q10: Vec3, q11: Vec3, choice: int):
    """From the nearest point of edge a to that of edge b, q_ij = b_j - a_i; not normalized."""
    zero = type(q00[0])(0.0)
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
    skew = sine_sq > type(zero)(ALIGNED) * a * e
    inside = skew and s > zero and s < sine_sq and t > zero and t < sine_sq
    if choice == 2 or (inside and choice == 1):
        # from each end of one edge to the other edge
        n = shorter(segment_direction(q00, q01), segment_direction(q10, q11))
        return shorter(n, -shorter(segment_direction(-q00, -q10), segment_direction(-q01, -q11)))
    if inside or choice == 1:
        return facing(wp.cross(e1, e2), q00)
    # an end of an edge is nearest: clamp s, then t, then s again
    end1 = s >= sine_sq and skew
    if skew and s > zero and not end1:
        # t is past an end of b, and s is free
        if t <= zero:
            return -segment_direction(-q00, -q10)
        return -segment_direction(-q01, -q11)
    p0 = q00
    t = f
    if end1:
        p0 = q10
        t = f + b
    if t <= zero:
        return -segment_direction(-q00, -q10)
    if t >= e:
        return -segment_direction(-q01, -q11)
    return across(p0 + (t / e) * e2, e2)


# Whether a pair keeps the gap all the time, decided by four directions, without a division or a root (Lemma 3).


# Outside of these a square could under- or overflow.
@func
def small_square(like: wp.float64):
    return wp.float64(1.0e-250)


@func
def small_square(like: wp.float32):  # noqa: F811
    return wp.float32(1.0e-30)


@func
def large_number(like: wp.float64):
    return wp.float64(1.0e45)


@func
def large_number(like: wp.float32):  # noqa: F811
    return wp.float32(1.0e6)


@func
def keeps_on_axis(m0: Scalar, m1: Scalar, near: Scalar, far: Scalar, kept: Scalar) -> bool:
    m = wp.min(m0, m1)
    return m > far or m - kept * m0 > near


@func
def boxes_keep(above0: Vec3, above1: Vec3, below0: Vec3, below1: Vec3, xi: Scalar, backoff: Scalar, reach: Scalar) -> bool:
    """Gaps of boxes along the axes in both orders, at the start and the end."""
    u = type(xi)(REJECT_SLACK) * unit_roundoff(xi)
    near = (type(xi)(1.0) - backoff) * xi * (type(xi)(1.0) + u)
    far = (xi + backoff * reach) * (type(xi)(1.0) + u)
    kept = backoff + u
    return (
        keeps_on_axis(above0[0], above1[0], near, far, kept)
        or keeps_on_axis(below0[0], below1[0], near, far, kept)
        or keeps_on_axis(above0[1], above1[1], near, far, kept)
        or keeps_on_axis(below0[1], below1[1], near, far, kept)
        or keeps_on_axis(above0[2], above1[2], near, far, kept)
        or keeps_on_axis(below0[2], below1[2], near, far, kept)
    )


@func
def plane_keeps(n: Vec3, m0: Scalar, m1: Scalar, size: Scalar, xi: Scalar, backoff: Scalar, reach: Scalar) -> bool:
    """Projections on n, at least m0 at the start and m1 at the end, each off by the slack."""
    zero = type(xi)(0.0)
    u = type(xi)(REJECT_SLACK) * unit_roundoff(xi)
    slack = u * (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2])) * size
    m0 -= slack
    m = wp.min(m0, m1 - slack)
    m -= slack
    n_sq = wp.dot(n, n) * (type(xi)(1.0) + u)
    near = (type(xi)(1.0) - backoff) * xi
    far = xi + backoff * reach
    over = m - backoff * m0
    return (
        n_sq > small_square(xi)
        and size < large_number(xi)
        and ((over > zero and over * over > near * near * n_sq) or (m > zero and m * m > far * far * n_sq))
    )


# Arguments: a pair's eight points, and what it is to keep.
@func
def vertex_triangle_keep(
    p0: Vec3, a0: Vec3, b0: Vec3, c0: Vec3, p1: Vec3, a1: Vec3, b1: Vec3, c1: Vec3,
    xi: Scalar, backoff: Scalar, reach: Scalar,
) -> bool:  # fmt: skip
    low0 = wp.min(wp.min(a0, b0), c0) - p0
    low1 = wp.min(wp.min(a1, b1), c1) - p1
    high0 = p0 - wp.max(wp.max(a0, b0), c0)
    high1 = p1 - wp.max(wp.max(a1, b1), c1)
    if boxes_keep(low0, low1, high0, high1, xi, backoff, reach):
        return True
    qa = a0 - p0
    qb = b0 - p0
    qc = c0 - p0
    n = vertex_triangle_direction(qa, qb, qc, 0)
    m0 = wp.min(wp.min(wp.dot(n, qa), wp.dot(n, qb)), wp.dot(n, qc))
    m1 = wp.min(wp.min(wp.dot(n, a1 - p1), wp.dot(n, b1 - p1)), wp.dot(n, c1 - p1))
    # the boxes of the differences hold every component
    size = -wp.min(wp.min(wp.min(low0), wp.min(low1)), wp.min(wp.min(high0), wp.min(high1)))
    return plane_keeps(n, m0, m1, size, xi, backoff, reach)


# Arguments: a pair's eight points, and what it is to keep.
@func
def edge_edge_keep(
    a00: Vec3, a10: Vec3, b00: Vec3, b10: Vec3, a01: Vec3, a11: Vec3, b01: Vec3, b11: Vec3,
    xi: Scalar, backoff: Scalar, reach: Scalar,
) -> bool:  # fmt: skip
    low0 = wp.min(b00, b10) - wp.max(a00, a10)
    low1 = wp.min(b01, b11) - wp.max(a01, a11)
    high0 = wp.min(a00, a10) - wp.max(b00, b10)
    high1 = wp.min(a01, a11) - wp.max(b01, b11)
    if boxes_keep(low0, low1, high0, high1, xi, backoff, reach):
        return True
    q00 = b00 - a00
    q01 = b10 - a00
    q10 = b00 - a10
    q11 = b10 - a10
    n = edge_edge_direction(q00, q01, q10, q11, 0)
    m0 = wp.min(wp.dot(n, q00), wp.dot(n, q01)) - wp.max(wp.dot(n, a10 - a00), type(xi)(0.0))
    m1 = wp.min(wp.dot(n, b01 - a01), wp.dot(n, b11 - a01)) - wp.max(wp.dot(n, a11 - a01), type(xi)(0.0))
    wide0 = wp.max(b00, b10) - wp.min(a00, a10)
    wide1 = wp.max(b01, b11) - wp.min(a01, a11)
    size = wp.max(wp.max(wp.max(wide0), wp.max(wide1)), -wp.min(wp.min(low0), wp.min(low1)))
    return plane_keeps(n, m0, m1, size, xi, backoff, reach)


@functools.cache
def variant(real: Real, rejects: bool = True, cubic: str = "head start", steps: str = "directions") -> SimpleNamespace:
    """The CCD with some stages left out, so that each can be measured (benchmarks/ccd.py). The defaults are what is used.

    cubic: "off", "filter" (no root of Section 6's cubic: done) or "head start" (and begin at its root).
    steps: "directions" (Lemma 1) or "additive" (Li et al. 2021).
    """
    scalar, vec3 = real.scalar, real.vec3
    wide, wide3 = wp.float64, wp.vec3d
    zero, one = wp.constant(wide(0.0)), wp.constant(wide(1.0))
    rounding_down = wp.constant(wide(1.0 - 4.0 * real.unit_roundoff))
    smallest = wp.constant(wide(1.0e-30))  # below, a float32 loses digits
    shortest_sq = wp.constant(wide(1.0e-280))  # below, a square does
    least_size, most_size = wp.constant(wide(SMALLEST)), wp.constant(wide(LARGEST))

    @func
    def narrow(t: wide) -> scalar:
        """A time in the scene's precision, rounded down."""
        if t < smallest:
            return scalar(0.0)
        return scalar(t * rounding_down)

    def advance(edge_edge: bool):
        # Arguments: the same, less the vertex that they are relative to.
        # Long: one loop, whose parts share all of its state.
        @func
        def time_kept(
            p0: wide3, p1: wide3, p2: wide3, p3: wide3, r0: wide3, r1: wide3, r2: wide3, r3: wide3,
            xi: wide, backoff: wide, reach: wide,
        ) -> wide:  # fmt: skip
            """Time up to which the gap stays, from the differences p at the start and r at the end; p3, r3 for edges only."""
            size = wp.max(
                wp.max(wp.max(wp.max(wp.abs(p0), wp.abs(p1)), wp.max(wp.abs(p2), wp.abs(p3)))),
                wp.max(wp.max(wp.max(wp.abs(r0), wp.abs(r1)), wp.max(wp.abs(r2), wp.abs(r3)))),
            )
            if not (size > least_size and size < most_size):
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
            reach *= scale
            speed = zero
            if wp.static(steps == "additive"):
                speed = wp.max(wp.max(wp.length(r0 - p0), wp.length(r1 - p1)), wp.length(r2 - p2))
                if wp.static(edge_edge):
                    speed = wp.max(speed, wp.length(r3 - p3))
            t = zero
            keep = separation
            enough = zero
            choice = int(0)
            for _iteration in range(wp.static(MAX_ITERATIONS)):
                q0 = p0 + t * (r0 - p0)
                q1 = p1 + t * (r1 - p1)
                q2 = p2 + t * (r2 - p2)
                n = wide3()
                if wp.static(edge_edge):
                    n = edge_edge_direction(q0, q1, q2, p3 + t * (r3 - p3), choice)
                else:
                    n = vertex_triangle_direction(q0, q1, q2, choice)
                length_sq = wp.dot(n, n)
                if length_sq > shortest_sq:
                    n *= one / wp.sqrt(length_sq)
                else:
                    n = wide3()  # no direction: the gap below is negative
                f0 = wp.dot(n, p0)
                f1 = wp.dot(n, p1)
                f2 = wp.dot(n, p2)
                g0 = wp.dot(n, r0)
                g1 = wp.dot(n, r1)
                g2 = wp.dot(n, r2)
                f3 = f2
                g3 = g2
                gap = wp.min(wp.min(f0 + t * (g0 - f0), f1 + t * (g1 - f1)), f2 + t * (g2 - f2))
                if wp.static(edge_edge):
                    f3 = wp.dot(n, p3)
                    g3 = wp.dot(n, r3)
                    gap = wp.min(gap, f3 + t * (g3 - f3))
                gap -= slack
                ahead = zero
                if t == zero and gap > separation:
                    room = wp.min(gap - separation, reach)
                    keep = separation + backoff * room
                    enough = separation + wide(STOP) * backoff * room
                    if wp.static(cubic != "off"):
                        u0 = p1 - p0
                        v0 = p2 - p0
                        u1 = r1 - r0
                        v1 = r2 - r0
                        k = cubics.coefficients(u0, v0, p0, u1, v1, r0)
                        margin = keep * cubics.largest_area(u0, v0, u1, v1)
                        margin += cubics.coefficient_error(u0, v0, p0, u1, v1, r0, one)
                        ahead = cubics.first_root(k, margin * (one + slack), wide(TOLERANCE))
                        if ahead > one:
                            return wide(NEVER)
                        if wp.static(cubic == "filter"):
                            ahead = zero
                if gap >= keep and gap > separation:
                    if t > zero and gap <= enough:
                        return t
                    if wp.static(steps == "additive"):
                        ahead = wp.max(ahead, t + (gap - keep) / speed * (one - slack))
                    else:
                        h = keep + slack
                        soonest = wide(NEVER)
                        if g0 < h:
                            soonest = (f0 - h) / (f0 - g0)
                        if g1 < h:
                            soonest = wp.min(soonest, (f1 - h) / (f1 - g1))
                        if g2 < h:
                            soonest = wp.min(soonest, (f2 - h) / (f2 - g2))
                        if wp.static(edge_edge):  # noqa: SIM102
                            if g3 < h:
                                soonest = wp.min(soonest, (f3 - h) / (f3 - g3))
                        ahead = wp.max(ahead, soonest)
                    if ahead >= one:
                        return wide(NEVER)
                if ahead > t:
                    t = ahead
                    choice = 0
                else:
                    choice += 1
                    if choice == wp.static(DIRECTIONS):
                        return t
            return t

        return time_kept

    advance_vertex_triangle = advance(False)
    advance_edge_edge = advance(True)

    # Arguments: a pair's eight points, and what it is to keep.
    @func
    def vertex_triangle(
        p0: vec3, a0: vec3, b0: vec3, c0: vec3, p1: vec3, a1: vec3, b1: vec3, c1: vec3,
        xi: scalar, backoff: scalar, reach: scalar,
    ) -> scalar:  # fmt: skip
        """Time in [0, 1] up to which a vertex and a triangle provably stay farther apart than xi, or 2 for all of [0, 1].

        Positions at the start (0) and end (1) of a linear motion. xi: minimum separation in metres. backoff: the fraction
        of the gap that is kept. reach: the gap in metres above which it counts no more; may be infinite.
        """
        if wp.static(rejects):  # noqa: SIM102
            if vertex_triangle_keep(p0, a0, b0, c0, p1, a1, b1, c1, xi, backoff, reach):
                return scalar(NEVER)
        q2 = relative(c0, p0)
        r2 = relative(c1, p1)
        return narrow(
            advance_vertex_triangle(
                relative(a0, p0), relative(b0, p0), q2, q2, relative(a1, p1), relative(b1, p1), r2, r2,
                wide(xi), wide(backoff), wide(reach),
            )
        )  # fmt: skip

    # Arguments: the same.
    @func
    def edge_edge(
        a00: vec3, a10: vec3, b00: vec3, b10: vec3, a01: vec3, a11: vec3, b01: vec3, b11: vec3,
        xi: scalar, backoff: scalar, reach: scalar,
    ) -> scalar:  # fmt: skip
        """The same for the edges a0-a1 and b0-b1; the second digit is 0 at the start and 1 at the end of the motion."""
        if wp.static(rejects):  # noqa: SIM102
            if edge_edge_keep(a00, a10, b00, b10, a01, a11, b01, b11, xi, backoff, reach):
                return scalar(NEVER)
        return narrow(
            advance_edge_edge(
                relative(b00, a00), relative(b10, a00), relative(b00, a10), relative(b10, a10),
                relative(b01, a01), relative(b11, a01), relative(b01, a11), relative(b11, a11),
                wide(xi), wide(backoff), wide(reach),
            )
        )  # fmt: skip

    return SimpleNamespace(vertex_triangle=vertex_triangle, edge_edge=edge_edge)


def functions(real: Real) -> SimpleNamespace:
    """The CCD of the time step: `vertex_triangle` and `edge_edge`, see `variant`."""
    return variant(real)
