"""Which pairs whose moving boxes overlap may meet, or act, at all.

A pair is looked at as its vertices move together, from begin_v to end_v at a common fraction of the way, each within reach_v of it.
It is left out only by Lemma 1 of `ccd`: if a direction n has n . (x_j - x_i) > R |n|, R = reach_i + reach_j, for every vertex i of the
first primitive and j of the second, where the motion begins and where it ends, then all points of the two are farther apart than R all
the way, and nothing happens between them. Any n will do, so a badly chosen one lets a pair pass, and never stops it: no distance and
no closest point is trusted here. Two are tried, the cheap one first: from center to center, and from closest point to closest
point, both where half of the way is made.

**Lemma (rounding).** u = 2^-53, |n|_1 is the sum of the sizes of n's components, and S is the largest component, in size, of the
computed differences from one vertex of the pair at its begin and its end. All is in double precision, whatever the scene's.
1. A difference is off by u S a component, and its product with n by 3u |n|_1 S more: 4u |n|_1 S. For edges, the largest of one edge is
   taken off the least of the other: twice that, and 2u |n|_1 S for the subtraction. Taking SLACK |n|_1 S off adds 2u |n|_1 S. Together
   this is 12u |n|_1 S and terms in u^2, below SLACK = 16u. So the gap that is left is at most the true one.
2. gap > R |n| is tested as gap^2 > R^2 |n|^2. R = reach_i + reach_j is off by u, |n|^2 by 3u, and with the products the two sides
   together by 9u, all relative. The right side has (1 + 16u) on it.
3. Range. S < LARGEST bounds n, a product of two differences at most, so that all products here stay below 1e290: nothing overflows,
   and nothing is NaN, but for R^2, which then is infinite and stops nothing. |n|^2 > SMALLEST and R >= LEAST keep the right side above
   1e-280: a square on the left that underflows is less than that. And S > R / 2 then, so that what products of n and a
   difference lose by underflow is far below u |n|_1 S. A pair outside of these ranges passes.
Fused multiply-adds only leave out roundings that are counted here. So this holds for any finite coordinates, in both precisions.

On a cloth of 200x200 vertices that folds at 3 m/s, with edges of 5 mm, swept boxes give 8.4 million pairs, moving ones 1.6, and
0.3 are left here (docs/culling.md).
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.collision import ccd
from pdipc.collision.distance import relative
from pdipc.device.language import func, struct_of
from pdipc.device.precision import Real, Scalar

SLACK = 16.0 * 2.0**-53
ENOUGH = 1.0 + SLACK
LARGEST = 1.0e45  # m: the S of the lemma
SMALLEST, LEAST = 1.0e-100, 1.0e-90  # of |n|^2, and of R in m


wide, wide3 = wp.float64, wp.vec3d


@func
def separates(n: wide3, gap: wide, size: wide, a: Scalar, b: Scalar) -> bool:
    """Whether a gap along n, times |n|, is proven to be more than the two reaches a and b; size: the S of the lemma."""
    left = gap - wide(SLACK) * (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2])) * size
    far = wp.max(wide(a) + wide(b), wide(LEAST))
    n_sq = wp.dot(n, n)
    return n_sq > wide(SMALLEST) and left > wide(0.0) and left * left > far * far * n_sq * wide(ENOUGH)


@func
def extent(a: wide3, b: wide3, c: wide3) -> wide:
    return wp.max(wp.max(wp.max(wp.abs(a), wp.abs(b)), wp.abs(c)))


@func
def least(n: wide3, a: wide3, b: wide3, c: wide3) -> wide:
    return wp.min(wp.min(wp.dot(n, a), wp.dot(n, b)), wp.dot(n, c))


@func
def between(n: wide3, a1: wide3, b0: wide3, b1: wide3) -> wide:
    """The gap along n between the edges 0-a1 and b0-b1, times |n|."""
    return wp.min(wp.dot(n, b0), wp.dot(n, b1)) - wp.max(wp.dot(n, a1), wide(0.0))


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3

    Sieve = struct_of(
        "Sieve",
        __name__,
        everything=int,  # 1: pairs of overlapping boxes all pass, and nothing else is read
        begin=wp.array(dtype=vec3),  # of each vertex, m
        end=wp.array(dtype=vec3),
        reach=wp.array(dtype=scalar),  # of each vertex, m; one for all of a body
    )

    @func
    def vertex_triangle(sieve: Sieve, v: int, t: wp.vec3i) -> bool:
        """Whether vertex v may meet, or act on, triangle t."""
        if sieve.everything == 1:
            return True
        # relative to the vertex, where it begins and where it ends
        begin, end = sieve.begin[v], sieve.end[v]
        b0, b1, b2 = (
            relative(sieve.begin[t[0]], begin),
            relative(sieve.begin[t[1]], begin),
            relative(sieve.begin[t[2]], begin),
        )
        e0, e1, e2 = relative(sieve.end[t[0]], end), relative(sieve.end[t[1]], end), relative(sieve.end[t[2]], end)
        size = wp.max(extent(b0, b1, b2), extent(e0, e1, e2))
        if not (size < wide(LARGEST)):
            return True
        m0, m1, m2 = b0 + e0, b1 + e1, b2 + e2  # twice where they are at half of the way
        n = m0 + m1 + m2
        if separates(n, wp.min(least(n, b0, b1, b2), least(n, e0, e1, e2)), size, sieve.reach[v], sieve.reach[t[0]]):
            return False
        n = ccd.vertex_triangle_direction(m0, m1, m2, 0)
        return not separates(n, wp.min(least(n, b0, b1, b2), least(n, e0, e1, e2)), size, sieve.reach[v], sieve.reach[t[0]])

    @func
    def edge_edge(sieve: Sieve, a: wp.vec2i, b: wp.vec2i) -> bool:
        """Whether edges a and b may meet, or act."""
        if sieve.everything == 1:
            return True
        # relative to a[0], where it begins and where it ends
        begin, end = sieve.begin[a[0]], sieve.end[a[0]]
        b1, p0, p1 = (
            relative(sieve.begin[a[1]], begin),
            relative(sieve.begin[b[0]], begin),
            relative(sieve.begin[b[1]], begin),
        )
        e1, q0, q1 = relative(sieve.end[a[1]], end), relative(sieve.end[b[0]], end), relative(sieve.end[b[1]], end)
        size = wp.max(extent(b1, p0, p1), extent(e1, q0, q1))
        if not (size < wide(LARGEST)):
            return True
        m1, n0, n1 = b1 + e1, p0 + q0, p1 + q1  # twice where they are at half of the way
        n = n0 + n1 - m1
        if separates(n, wp.min(between(n, b1, p0, p1), between(n, e1, q0, q1)), size, sieve.reach[a[0]], sieve.reach[b[0]]):
            return False
        n = ccd.edge_edge_direction(n0, n1, n0 - m1, n1 - m1, 0)
        return not separates(
            n, wp.min(between(n, b1, p0, p1), between(n, e1, q0, q1)), size, sieve.reach[a[0]], sieve.reach[b[0]]
        )

    return SimpleNamespace(Sieve=Sieve, vertex_triangle=vertex_triangle, edge_edge=edge_edge)


def everything(real: Real):
    """A sieve that lets all pairs of overlapping boxes pass."""
    sieve = functions(real).Sieve()
    sieve.everything = 1
    return sieve
