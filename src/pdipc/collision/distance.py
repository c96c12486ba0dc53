"""Closest points and distances of a vertex and a triangle, and of two edges.

The arithmetic is in double precision, on coordinates taken relative to one vertex, whatever precision the scene has: with
float32 the usual formulas lose near-parallel edges and sliver triangles, which is where barriers and contacts happen.

Every result belongs to two points *on* the primitives, so a distance is at most rounding too small, and it was never found more than
`OVERESTIMATE` (or 4 units in the last place of the scene's precision, where that is more) of the primitives' extent too large, by
exact arithmetic on edges and slivers of any angle. That is measured, not proven.

Nothing here is needed for safety: `ccd` proves its times, and `sieve` what it leaves out, without trusting a distance.
"""

import warp as wp

from pdipc.device.language import func
from pdipc.device.precision import Vec3

OVERESTIMATE = 1.0e-12
wide, wide3, wide4 = wp.float64, wp.vec3d, wp.vec4d

WELL_SHAPED = 1.0e-8  # squared sine between edges above which the plain formulas of the closest points inside do


@func
def relative(x: Vec3, origin: Vec3) -> wide3:
    """x - origin in double precision."""
    return wide3(wide(x[0]) - wide(origin[0]), wide(x[1]) - wide(origin[1]), wide(x[2]) - wide(origin[2]))


@func
def along_segment(a: wide3, b: wide3) -> wide:
    """The parameter in [0, 1] of the point of segment a-b that is nearest to the origin; 0 for a segment of no length."""
    e = b - a
    length_sq = wp.dot(e, e)
    if length_sq > wide(0.0):
        return wp.clamp(-wp.dot(a, e) / length_sq, wide(0.0), wide(1.0))
    return wide(0.0)


@func
def slide(w: wide4, a: wide3, b: wide3, c: wide3, i: int, j: int) -> wide4:
    """The point of weights w moved parallel to the edge of the corners i and j to where it is nearest to the origin."""
    e = a - b
    if i == 2:
        e = b - c
    elif j == 3:
        e = a - c
    length_sq = wp.dot(e, e)
    if length_sq > wide(0.0):
        step = wp.dot(w[1] * a + w[2] * b + w[3] * c, e) / length_sq
        step = wp.clamp(step, w[i], -w[j])  # weights are negative, and stay so
        w[i] = w[i] - step
        w[j] = w[j] + step
    return w


@func
def triangle_weights(a: wide3, b: wide3, c: wide3) -> wide4:
    """(1, -b0, -b1, -b2): the point of a triangle that is nearest to the origin, in barycentric coordinates."""
    ab = b - a
    ac = c - a
    normal = wp.cross(ab, ac)
    inside_a = wp.dot(normal, wp.cross(b, c))
    inside_b = wp.dot(normal, wp.cross(c, a))
    inside_c = wp.dot(normal, wp.cross(a, b))
    best = wide4(wide(1.0), -wide(1.0), wide(0.0), wide(0.0))
    best_sq = wp.dot(a, a)
    if inside_a > wide(0.0) and inside_b > wide(0.0) and inside_c > wide(0.0):
        total = inside_a + inside_b + inside_c
        best = wide4(wide(1.0), -inside_a / total, -inside_b / total, -inside_c / total)
        if wp.dot(normal, normal) > wide(WELL_SHAPED) * wp.dot(ab, ab) * wp.dot(ac, ac):
            return best
        # of a sliver the point is far off along its length, where it is put right here
        best = slide(slide(slide(best, a, b, c, 1, 2), a, b, c, 1, 3), a, b, c, 2, 3)
        r = best[1] * a + best[2] * b + best[3] * c
        best_sq = wp.dot(r, r)
    # the nearest point is on an edge, or the triangle is a sliver; where it has no area at all, its edges are all there is
    s = along_segment(a, b)
    r = a + s * ab
    if wp.dot(r, r) < best_sq:
        best_sq = wp.dot(r, r)
        best = wide4(wide(1.0), s - wide(1.0), -s, wide(0.0))
    s = along_segment(a, c)
    r = a + s * ac
    if wp.dot(r, r) < best_sq:
        best_sq = wp.dot(r, r)
        best = wide4(wide(1.0), s - wide(1.0), wide(0.0), -s)
    s = along_segment(b, c)
    r = b + s * (c - b)
    if wp.dot(r, r) < best_sq:
        best = wide4(wide(1.0), wide(0.0), s - wide(1.0), -s)
    return best


@func
def segment_weights(a1: wide3, b0: wide3, b1: wide3) -> wide4:
    """(1 - s, s, t - 1, -t): the nearest points of the edges 0-a1 and b0-b1."""
    one = wide(1.0)
    zero = wide(0.0)
    e2 = b1 - b0
    a = wp.dot(a1, a1)
    b = wp.dot(a1, e2)
    e = wp.dot(e2, e2)
    c = -wp.dot(a1, b0)
    f = -wp.dot(e2, b0)
    sine_sq = a * e - b * b
    s_inside = b * f - c * e
    t_inside = a * f - b * c
    best = wide4(one, zero, -one, zero)
    best_sq = wp.dot(b0, b0)
    parallel = not (sine_sq > wide(WELL_SHAPED) * a * e)
    if parallel:
        # the same, by cross products: these lose a sine where the others lose its square
        normal = wp.cross(a1, e2)
        sine_sq = wp.dot(normal, normal)
        s_inside = wp.dot(wp.cross(b0, e2), normal)
        t_inside = wp.dot(wp.cross(b0, a1), normal)
    if s_inside > zero and s_inside < sine_sq and t_inside > zero and t_inside < sine_sq:
        # rounding in s matters less than in t, where t is the one that belongs to s
        s = s_inside / sine_sq
        t = wp.clamp((b * s + f) / e, zero, one)
        best = wide4(one - s, s, t - one, -t)
        if not parallel:
            return best
        r = b0 + t * e2 - s * a1
        best_sq = wp.dot(r, r)
    # an end of one edge is nearest, or the edges are near-parallel
    t = along_segment(b0, b1)
    r = b0 + t * e2
    if wp.dot(r, r) < best_sq:
        best_sq = wp.dot(r, r)
        best = wide4(one, zero, t - one, -t)
    t = along_segment(b0 - a1, b1 - a1)
    r = b0 - a1 + t * e2
    if wp.dot(r, r) < best_sq:
        best_sq = wp.dot(r, r)
        best = wide4(zero, one, t - one, -t)
    s = along_segment(-b0, a1 - b0)
    r = s * a1 - b0
    if wp.dot(r, r) < best_sq:
        best_sq = wp.dot(r, r)
        best = wide4(one - s, s, -one, zero)
    s = along_segment(-b1, a1 - b1)
    r = s * a1 - b1
    if wp.dot(r, r) < best_sq:
        best = wide4(one - s, s, zero, -one)
    return best


@func
def vertex_triangle_weights(p: Vec3, a: Vec3, b: Vec3, c: Vec3) -> wide4:
    """Weights w = (1, -b0, -b1, -b2) of the closest points: r = sum w_i x_i points from the triangle to the vertex."""
    return triangle_weights(relative(a, p), relative(b, p), relative(c, p))


@func
def edge_edge_weights(a0: Vec3, a1: Vec3, b0: Vec3, b1: Vec3) -> wide4:
    """Weights w = (1 - s, s, -(1 - t), -t) of the closest points: r = sum w_i x_i points from edge b to edge a."""
    return segment_weights(relative(a1, a0), relative(b0, a0), relative(b1, a0))


@func
def origin_triangle_distance(a: wide3, b: wide3, c: wide3) -> wide:
    """Distance of the origin and a triangle."""
    w = triangle_weights(a, b, c)
    return wp.length(w[1] * a + w[2] * b + w[3] * c)


@func
def origin_segment_distance(a1: wide3, b0: wide3, b1: wide3) -> wide:
    """Distance of the edges 0-a1 and b0-b1."""
    w = segment_weights(a1, b0, b1)
    return wp.length(w[1] * a1 + w[2] * b0 + w[3] * b1)


@func
def vertex_triangle_distance(p: Vec3, a: Vec3, b: Vec3, c: Vec3) -> wide:
    """Distance of a vertex and a triangle, in metres."""
    return origin_triangle_distance(relative(a, p), relative(b, p), relative(c, p))


@func
def edge_edge_distance(a0: Vec3, a1: Vec3, b0: Vec3, b1: Vec3) -> wide:
    """Distance of two edges, in metres."""
    return origin_segment_distance(relative(a1, a0), relative(b0, a0), relative(b1, a0))


@func
def pair_weights(edges: bool, x0: Vec3, x1: Vec3, x2: Vec3, x3: Vec3) -> wide4:
    """Of a pair of edges x0-x1 and x2-x3, or of a vertex and a triangle."""
    if edges:
        return edge_edge_weights(x0, x1, x2, x3)
    return vertex_triangle_weights(x0, x1, x2, x3)


@func
def pair_distance(edges: bool, x0: Vec3, x1: Vec3, x2: Vec3, x3: Vec3) -> wide:
    """Likewise, m."""
    if edges:
        return edge_edge_distance(x0, x1, x2, x3)
    return vertex_triangle_distance(x0, x1, x2, x3)
