"""As much of a motion as lowers the true potential, island by island, and whether the step has ended (line 16 of Algorithm 1).

The potential of a step is that of Section 3, with the barrier and lagged friction,

    Phi(x) = E + Psi + B + D,     E = sum m |u - z|^2 / (2 h^2) + damping,

over the displacements u since the start of the step. After truncation Phi is compared, island by island. Where it rose, the island goes back
along the same direction: first all of it to the least fraction that truncation left to one of its vertices, then by halves. What CCD has not
proven is proven anew. So every outer iteration descends, unless a script moves something that the island may touch: then the potential itself
has changed, and the island only goes back where truncation cut its step and it rose tenfold: to the least fraction, then by a few halves.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.barrier.exact import BarrierTerm
from pdipc.barrier.friction import FrictionTerm
from pdipc.barrier.pairs import frozen
from pdipc.collision.islands import Groups, Islands
from pdipc.collision.truncation import truncated
from pdipc.device import blocks
from pdipc.device.language import filled, func, kernel, struct, struct_of
from pdipc.device.launch import Largest, Parts, Share
from pdipc.device.precision import Real
from pdipc.device.sums import BodySums
from pdipc.integration import inertia as implicit
from pdipc.integration import status
from pdipc.integration.script import AHEAD, ARRIVED, WILL, led

FIERCE = 10.0  # times its potential: where what is driven raises it by more, truncation has cut the step unevenly, and it is made even first
PULLED = 5  # how often such a step is then halved, at most, as long as elements hold that many times what there was and what inertia has against it
HALVINGS = 30  # of an island's step, then it stays where it is
SQUEEZED = 1.0e-4  # of d_hat: a scripted vertex waits once a pair that it is part of has a smaller gap; what is heavy beside a cloth under it rests at 2e-4
RESTRAIN = 0.5  # an island that keeps less of its step, since a pair was squeezed, takes shorter steps from then on
RELEASE, RELEASED = 0.25, 0.3  # the restraint fades so fast, and is over below that
LEAST_PART, MOST_RESTRAINT = 0.01, 1.0e8
STALLS = 3  # outer iterations without any progress of some island, then the step ends
IDLE = 12  # outer iterations in a row in which no potential falls by more than rounding, likewise
ROUNDED = 3.0  # tolerances: what may then be left of a step that has converged
SLACK = {
    "float32": 4.0e-7,
    "float64": 1.0e-12,
}  # of the potential: a rise that rounding makes; beside it what the linear solve leaves
BARRIER_CHANGE = (
    0.4  # of the curvature of a barrier: a step that changes one by more is not near the end; out of a tiny gap each doubles it
)
FORCE_CHANGE = (
    0.1  # the same where there is friction, which the next step takes over: what pairs push with is then true to a hundredth
)
TIES = (
    "point_attachment",
    "axis_attachment",
    "surface_attachment",
    "stitch",
)  # kinds of elements whose forces act on a body from outside
KEEP = 5.0  # tolerances: an outer iteration that moved less is followed by one with the same matrix
EXACT = 0.1  # of its length: what a step of a projected Hessian must be shorter by, to be believed
PCG_PART = 0.05  # of the tolerance: an error of the linear solve that does not matter


@func
def widened(a: Any) -> wp.vec3d:
    return wp.vec3d(wp.float64(a[0]), wp.float64(a[1]), wp.float64(a[2]))


@func
def squared(a: Any, b: Any) -> wp.float64:
    """|a - b|^2."""
    total = wp.float64(0.0)
    for k in range(3):
        d = wp.float64(a[k]) - wp.float64(b[k])
        total += d * d
    return total


@func
def curved(arm: wp.vec3d, turn: wp.vec3d) -> wp.vec3d:
    """What rotating by `turn`, rad, does beyond turn x arm."""
    angle = wp.length(turn)
    result = wp.vec3d()
    if angle > wp.float64(0.0):
        along = wp.cross(turn, arm)
        half = wp.sin(wp.float64(0.5) * angle) / angle
        # sin(a) / a - 1 without cancellation
        less = -angle * angle / wp.float64(6.0) * (wp.float64(1.0) - angle * angle / wp.float64(20.0))
        if angle > wp.float64(0.05):
            less = wp.sin(angle) / angle - wp.float64(1.0)
        result = less * along + wp.float64(2.0) * half * half * wp.cross(turn, along)
    return result


@struct
class Energies:
    """The potential of each body, J: at x and where it is tried, without friction and that alone; and of its island."""

    base_old: wp.array[wp.float64]
    friction_old: wp.array[wp.float64]
    base_new: wp.array[wp.float64]
    friction_new: wp.array[wp.float64]
    effort: wp.array[wp.float64]  # what inertia has against the motion; this and the next are known where something is scripted
    elastic: wp.array[wp.float64]  # what elements hold where it is tried
    before: wp.array[wp.float64]  # scratch
    after: wp.array[wp.float64]
    most: wp.array[wp.float64]
    stretched: wp.array[wp.float64]


@struct
class Search:
    """How the line search of an outer iteration stands. Arrays of one entry but those of bodies."""

    hits: wp.array[wp.int32]  # passes of truncation that found hits
    attempts: wp.array[wp.int32]  # lengths that were tried; 0 between iterations
    whole: wp.array[wp.int32]  # whether the last iteration went its whole way
    searching: wp.array[wp.int32]  # whether another one is to be tried
    lowered: wp.array[wp.int32]  # whether the potential of any island has fallen by more than rounding
    accepted: wp.array[wp.int32]  # of bodies, whether their island is done
    squeezed: wp.array[wp.int32]  # of bodies, by their island's first: whether a pair that was squeezed before was hit
    project: wp.array[wp.int32]  # whether Hessians are made positive semidefinite
    restrained: wp.array[wp.int32]  # whether any body is held back


@functools.cache
def limits(real: Real) -> Any:
    """A struct: where a step ends."""
    return struct_of(
        "Limits",
        __name__,
        tolerance=real.scalar,  # m
        most_change=real.scalar,  # of a barrier's curvature, in parts of it
        max_outer=int,
        most_idle=int,  # outer iterations in a row in which no potential falls by more than rounding
        budget_ms=wp.float64,
    )


@functools.cache
def bodies(real: Real) -> Any:
    """A struct: bodies as ranges of vertices."""
    return struct_of(
        "Bodies",
        __name__,
        starts=wp.array(dtype=wp.int32),
        ends=wp.array(dtype=wp.int32),
        whole=wp.array(dtype=wp.int32),  # whether none of its vertices is held
        mass=wp.array(dtype=real.scalar),  # of each vertex, kg
    )


@functools.cache
def motion(real: Real) -> Any:
    """A struct: the step that an outer iteration wants to make, u -> u_tilde, with the rotation of each body in it."""
    return struct_of(
        "Motion",
        __name__,
        base=wp.array(dtype=real.vec3),
        u=wp.array(dtype=real.vec3),
        u_tilde=wp.array(dtype=real.vec3),
        free=wp.array(dtype=real.scalar),
        center=wp.array(dtype=wp.vec3d),  # of each body, m
        turn=wp.array(dtype=wp.vec3d),  # rad
    )


@func
def turned(square: wp.float64, outer: wp.mat33d, momentum: wp.vec3d) -> wp.vec3d:
    """The rotation, rad, whose angular momentum is that given, m L: of masses whose m |arm|^2 and m arm arm^T sum to square and outer."""
    # a little more than the inertia, for bodies on a line
    return wp.inverse(wp.float64(1.0 + 1.0e-9) * square * wp.identity(n=3, dtype=wp.float64) - outer) * momentum


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Frozen, Truncated, Led = real.scalar, real.vec3, frozen(real), truncated(real), led(real)
    Inertial, Progress, Bodies, Limits, Motion = (
        each(real) for each in (implicit.inertial, status.progress, bodies, limits, motion)
    )
    module = real.module(__name__)
    wide = wp.float64
    slack = wp.constant(wp.float64(SLACK[real.name]))
    least_number, largest_number, last_block = blocks.least(scalar), blocks.largest(scalar), blocks.last()
    total_number, total_vector, total_matrix = (blocks.total(each) for each in (wide, wp.vec3d, wp.mat33d))

    @func
    def largest_of_all(mine: scalar, worker: int, parts: Share, partial: wp.array(dtype=scalar)) -> scalar:
        """The largest number of all threads, none of which is negative, in the block that is done last; in the others -1."""
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        largest = largest_number(mine)
        if lane == 0:
            partial[block] = largest
        result = scalar(-1.0)
        if last_block(parts.arrived, 0, parts.number):
            largest = scalar(0.0)
            for k in range(lane, parts.number, wp.block_dim()):
                largest = wp.max(largest, partial[k])
            result = largest_number(largest)
        return result

    @kernel(module)
    def inertia(
        first: int,
        u: wp.array(dtype=vec3),
        o: Inertial,
        beside: wp.array(dtype=wide),
        force_out: wp.array(dtype=vec3),
        energy_out: wp.array(dtype=wide),
    ):
        """-dE/du of each vertex (line 8), with mass-proportional damping, and E with what is beside it."""
        i = first + wp.tid()
        scale = o.free[i] * o.mass[i] / o.h
        force_out[i] = scale / o.h * (o.z[i] - u[i]) - scale * o.damping * (u[i] - o.rest[i])
        energy = wide(scale) / wide(o.h) * squared(u[i], o.z[i]) + wide(scale) * wide(o.damping) * squared(u[i], o.rest[i])
        energy_out[i] = wide(0.5) * energy + beside[i]

    @kernel(module)
    def strive(first: int, o: Motion, mass: wp.array(dtype=scalar), h: scalar, energy_out: wp.array(dtype=wide)):
        """m |u_tilde - u|^2 / (2 h^2) of each vertex."""
        i = first + wp.tid()
        energy_out[i] = wide(0.5) * wide(mass[i]) / (wide(h) * wide(h)) * squared(o.u_tilde[i], o.u[i])

    @kernel(module)
    def judge(
        first: int,
        islands: Groups,
        deep: wp.array(dtype=wp.int32),
        e: Energies,
        passes: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        negligible: wide,
        search: Search,
    ):
        """Whether the potential of each island has not risen. What was squeezed before is not squeezed again while the rest goes on: such an
        island goes back as a whole.
        """
        if search.attempts[0] == 0:
            search.hits[0] = passes[0]
        for b in range(islands.count):
            e.before[b] = wide(0.0)
            e.after[b] = wide(0.0)
            e.most[b] = wide(0.0)
            e.stretched[b] = wide(0.0)
            search.accepted[b] = 0
            search.squeezed[b] = 0
        for b in range(islands.count):
            island = islands.label[b]
            if deep[b] != 0:
                search.squeezed[island] = 1
            e.before[island] = e.before[island] + e.base_old[b] + e.friction_old[b]
            e.after[island] = e.after[island] + e.base_new[b] + e.friction_new[b]
            e.most[island] = e.most[island] + e.effort[b]
            e.stretched[island] = e.stretched[island] + e.elastic[b]
            if islands.driven[b] != 0:
                search.accepted[island] = 1
        searching = int(0)
        search.lowered[0] = 0
        for b in range(islands.count):
            island = islands.label[b]
            ok = search.accepted[island]
            unseen = slack * wp.abs(e.before[island]) + negligible
            risen = e.after[island] > wide(FIERCE) * wp.abs(e.before[island]) + unseen
            if search.attempts[0] > 0:
                risen = e.stretched[island] > wide(FIERCE) * (wp.abs(e.before[island]) + e.most[island]) + unseen
            if risen and search.attempts[0] <= PULLED and search.hits[0] > 0:
                ok = 0
            if e.after[island] <= e.before[island] + unseen or search.attempts[0] > HALVINGS:
                ok = 1
            if e.after[island] < e.before[island] - unseen:
                search.lowered[0] = 1
            if search.squeezed[island] != 0 and search.attempts[0] == 0:
                ok = 0
            search.accepted[b] = ok
            if ok == 0:
                searching = 1
        search.attempts[0] = search.attempts[0] + 1
        if overflow[0] != 0:
            searching = 0
        search.searching[0] = searching

    @kernel(module)
    def least_fraction(
        first: int,
        bodies: Bodies,
        free: wp.array(dtype=scalar),
        attempts: wp.array(dtype=wp.int32),
        t: Truncated,
        least_out: wp.array(dtype=scalar),
    ):
        """What the first pass of truncation left to every vertex of a body, or later what it makes now: CCD may have cut some anew, and only
        where all make the same part of the step it is the step, which descends.
        """
        worker = first + wp.tid()
        b = worker // wp.block_dim()
        least = scalar(1.0)
        for i in range(bodies.starts[b] + worker % wp.block_dim(), bodies.ends[b], wp.block_dim()):
            if free[i] > scalar(0.0):
                part = t.fraction[i]
                if attempts[0] == 1:
                    part = t.first_fraction[i]
                least = wp.min(least, part)
        least = least_number(least)
        if worker % wp.block_dim() == 0:
            least_out[b] = least

    @kernel(module)
    def spread_least(
        first: int,
        bodies: int,
        label: wp.array(dtype=wp.int32),
        least: wp.array(dtype=scalar),
        island_least_out: wp.array(dtype=scalar),
    ):
        for b in range(bodies):
            island_least_out[b] = scalar(1.0)
        for b in range(bodies):
            island_least_out[label[b]] = wp.min(island_least_out[label[b]], least[b])

    @kernel(module)
    def turn_back(
        first: int,
        islands: Groups,
        search: Search,
        least: wp.array(dtype=scalar),
        o: Motion,
        t: Truncated,
    ):
        """A part of the step, and of the rotation of the body: where on the arc, not on its chord."""
        i = first + wp.tid()
        if i == 0:
            t.passes[0] = 1  # what is not shortened has been proven already
        b = islands.body[i]
        if b >= 0 and search.accepted[wp.max(b, 0)] == 0:
            f = least[islands.label[b]]
            if search.attempts[0] > 1 or f >= scalar(1.0):
                f = scalar(0.5) * f
            if search.attempts[0] >= HALVINGS:
                f = scalar(0.0)
            t.fraction[i] = f
            arm = widened(o.base[i] + o.u[i]) - o.center[b]
            arc = vec3(curved(arm, wide(f) * o.turn[b])) - f * vec3(curved(arm, o.turn[b]))
            if o.free[i] == scalar(0.0):
                arc = vec3()
            t.u_end[i] = o.u[i] + f * (o.u_tilde[i] - o.u[i]) + arc
            t.x_end[i] = o.base[i] + t.u_end[i]

    @kernel(module)
    def commit(
        first: int,
        overflow: wp.array(dtype=wp.int32),
        o: Motion,
        goal: wp.array(dtype=vec3),
        t: Truncated,
        parts: Share,
        partial: wp.array(dtype=scalar),
        x_out: wp.array(dtype=vec3),
        numbers_out: wp.array(dtype=scalar),
    ):
        """The motion is made, by blocks of threads; and how far the last vertex that is scripted is from its goal, m."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        lag = scalar(0.0)
        if overflow[0] == 0:
            for i in range(block * parts.size + lane, wp.min((block + 1) * parts.size, o.free.shape[0]), wp.block_dim()):
                o.u[i] = t.u_end[i]
                x_out[i] = t.x_end[i]
                if o.free[i] == scalar(0.0):
                    lag = wp.max(lag, wp.length((goal[i] - o.base[i]) - t.u_end[i]))
        lag = largest_of_all(lag, worker, parts, partial)
        if lane == 0 and lag >= scalar(0.0):
            numbers_out[status.LAG] = lag

    @kernel(module)
    def commit_energies(
        first: int,
        base_new: wp.array(dtype=wide),
        base_old_out: wp.array(dtype=wide),
    ):
        b = first + wp.tid()
        base_old_out[b] = base_new[b]

    @kernel(module)
    def crowd(
        first: int,
        pairs: Frozen,
        o: Led,
        islands: Groups,
        squeezed: wp.array(dtype=wp.int32),
        restraint: wp.array(dtype=scalar),
        crowded_out: wp.array(dtype=wp.int32),
    ):
        """Which movers have a pair that is squeezed, or whose body is held back or was just stopped by one, and that what is left of their
        way would close; whoever writes, writes the same.
        """
        k = first + wp.tid()
        waits = False
        if k < pairs.count[0]:
            waits = pairs.gaps[k] < scalar(SQUEEZED) * pairs.activation[k]
            for s in range(4):
                b = islands.body[pairs.quads[k][s]]
                if b >= 0:
                    waits = waits or restraint[b] > scalar(0.0) or squeezed[islands.label[b]] != 0
        if waits:
            closing = scalar(0.0)
            for s in range(4):
                i = pairs.quads[k][s]
                if o.free[i] == scalar(0.0):
                    closing += pairs.weights[k][s] * wp.dot(pairs.normals[k], (o.target[i] - o.base[i]) - o.u[i])
            for s in range(4):
                i = pairs.quads[k][s]
                if o.free[i] == scalar(0.0) and closing < scalar(0.0):
                    crowded_out[o.mover[i]] = 1

    @kernel(module)
    def weigh(
        first: int,
        bodies: Bodies,
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        inertial: wp.array(dtype=vec3),
        barrier: wp.array(dtype=vec3),
        h: scalar,
        left_out: wp.array(dtype=scalar),
    ):
        """How far what is left of forces and torques on each body would move it, against its inertia: within the body they cancel."""
        worker = first + wp.tid()
        b = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        start = bodies.starts[b]
        end = bodies.ends[b]
        if bodies.whole[b] == 0:
            end = start
        origin = base[start]
        total = wide(0.0)
        center = wp.vec3d()
        force = wp.vec3d()
        for i in range(start + lane, end, wp.block_dim()):
            m = wide(bodies.mass[i])
            total += m
            center += m * widened((base[i] - origin) + u[i])
            force += widened(inertial[i] + barrier[i])
        total = total_number(total)
        center = total_vector(center)
        force = total_vector(force)
        if total > wide(0.0):
            center = center / total
        square = wide(0.0)
        outer = wp.mat33d()
        torque = wp.vec3d()
        for i in range(start + lane, end, wp.block_dim()):
            m = wide(bodies.mass[i])
            arm = widened((base[i] - origin) + u[i]) - center
            square += m * wp.length_sq(arm)
            outer += m * wp.outer(arm, arm)
            torque += wp.cross(arm, widened(inertial[i] + barrier[i]))
        square = total_number(square)
        outer = total_matrix(outer)
        torque = total_vector(torque)
        if lane == 0:
            left = wide(0.0)
            if total > wide(0.0) and square > wide(0.0):
                turn = turned(square, outer, torque)
                left = wide(h) * wide(h) * (wp.length(force) / total + wp.sqrt(square / total) * wp.length(turn))
            left_out[b] = scalar(left)

    @kernel(module)
    def clear(first: int, flags_out: wp.array(dtype=wp.int32)):
        flags_out[first + wp.tid()] = 0

    @kernel(module)
    def exempt(first: int, flags_out: wp.array(dtype=wp.int32)):
        flags_out[first + wp.tid()] = 1

    @kernel(module)
    def start(
        first: int,
        bodies: int,
        restraint_out: wp.array(dtype=scalar),
        renew_out: wp.array(dtype=wp.int32),
        search_out: Search,
    ):
        for b in range(bodies):
            restraint_out[b] = scalar(0.0)
            search_out.squeezed[b] = 0
        search_out.restrained[0] = 0
        search_out.attempts[0] = 0
        search_out.whole[0] = 0
        if renew_out:
            renew_out[0] = 1
            search_out.project[0] = 1

    @func
    def restrain(islands: Groups, search: Search, least: wp.array(dtype=scalar), restraint: wp.array(dtype=scalar)) -> int:
        """By how many times its inertia each body is held back, as in the method of Levenberg and Marquardt; returns whether any is.

        Newton's step doubles a tiny gap, if it is made whole. But what slides past such a gap hits it at once, and an island that is shortened by
        that makes no way, and squeezes the gap further. Inertia shortens the sliding and leaves the opening, which is stiff, as it is.
        """
        restrained = int(0)
        for b in range(islands.count):
            island = islands.label[b]
            r = scalar(RELEASE) * restraint[b]
            if r < scalar(RELEASED):
                r = scalar(0.0)
            if (
                search.squeezed[island] != 0
                and search.attempts[0] > 1
                and least[island] < scalar(RESTRAIN)
                and islands.driven[b] == 0
            ):
                r = wp.max(restraint[b], scalar(1.0)) / wp.max(least[island], scalar(LEAST_PART))
                r = wp.min(r, scalar(MOST_RESTRAINT))
            restraint[b] = r
            if r > scalar(0.0):
                restrained = 1
        return restrained

    @func
    def choose(search: Search, moved: scalar, tolerance: scalar, renew: wp.array(dtype=wp.int32)):
        """The Hessian is projected until an iteration has gone its whole way: far from the end, negative curvature misleads. Elastic
        Hessian and preconditioner are kept for an iteration when the last one moved so little that it may well be the last, and they
        are exact: a projected one, or one from where a body was stretched by what rotated it, is too stiff to tell how much is left.
        """
        was_projected = search.project[0] != 0
        search.project[0] = 1
        anew = int(1)
        if search.whole[0] != 0:
            search.project[0] = 0
            if renew[0] == 1 and not was_projected and moved <= scalar(KEEP) * tolerance:
                anew = int(0)
        renew[0] = anew

    # Long: one decision, of all that was found out in an iteration.
    @func
    def conclude(
        pairs: wp.array(dtype=wp.int32),
        script: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        search: Search,
        limits: Limits,
        progress: Progress,
    ):
        """Line 16. pairs: how many act. script: its flags.

        Whatever is limited begins anew where something scripted came to a waypoint: what follows is another problem.
        """
        code = int(status.RUNNING)
        residual = progress.numbers[status.MOVED]
        behind = progress.numbers[status.LAG] > scalar(0.0)
        # of a sequence that shrinks by the ratio r, r / (1 - r) times the last motion is left; near the end Newton's ratio vanishes.
        # One motion alone says nothing: the first step out of a stiff barrier is short, however far the way is that it opens
        ratio = scalar(0.99)
        if progress.count[status.OUTER] > 0:
            ratio = wp.min(residual / wp.max(progress.numbers[status.MOVED_BEFORE], scalar(1.0e-30)), scalar(0.99))
        left = wp.max(residual * wp.max(scalar(1.0), ratio / (scalar(1.0) - ratio)), progress.numbers[status.UNBALANCED])
        progress.numbers[status.MOVED_BEFORE] = residual
        if overflow[0] != 0:
            code = status.OVERFLOW
        else:
            progress.count[status.OUTER] = progress.count[status.OUTER] + 1
            progress.count[status.SINCE] = progress.count[status.SINCE] + 1
            progress.count[status.BARRIERS] = pairs[0]
            if script[ARRIVED] != 0:
                progress.count[status.SINCE] = 0
                progress.count[status.STALLED] = 0
            if search.hits[0] > 0:
                progress.count[status.TRUNCATIONS] = progress.count[status.TRUNCATIONS] + 1
            if search.attempts[0] > 1:
                progress.count[status.SEARCHES] = progress.count[status.SEARCHES] + 1
            if search.attempts[0] > HALVINGS:
                progress.count[status.STALLED] = progress.count[status.STALLED] + 1
            progress.count[status.IDLE] = progress.count[status.IDLE] + 1
            if search.lowered[0] != 0 or progress.count[status.MOVING] != 0 or script[ARRIVED] != 0:
                progress.count[status.IDLE] = 0
            most_rounded = scalar(ROUNDED) * limits.tolerance
            if search.project[0] != 0:
                left = left / scalar(EXACT)
                most_rounded = scalar(EXACT) * most_rounded
            # a step that is short beside the tolerance, and that the potential does not show, is what rounding leaves of the forces
            done = (
                left <= limits.tolerance
                and search.attempts[0] == 1
                and progress.numbers[status.BARRIER_CHANGE] <= limits.most_change
            )
            if search.attempts[0] > 1 and search.lowered[0] == 0 and residual <= scalar(EXACT) * limits.tolerance:
                done = True
            # and where nothing falls for long, motions are rounding's: their ratios say nothing
            if (
                progress.count[status.IDLE] >= limits.most_idle
                and wp.max(residual, progress.numbers[status.UNBALANCED]) <= most_rounded
            ):
                done = True
            settled = done and search.hits[0] == 0 and progress.count[status.MOVING] == 0 and search.restrained[0] == 0
            if residual >= scalar(wp.inf):
                code = status.NOT_FINITE
            elif settled and not behind and script[AHEAD] == 0:
                code = status.CONVERGED
            elif settled and script[WILL] == 0:
                code = status.LAGGING
            elif progress.count[status.STALLED] >= STALLS or progress.count[status.IDLE] >= limits.most_idle:
                code = status.STALLING
            elif (
                limits.budget_ms > wide(0.0) and progress.clock[status.LAST] - progress.clock[status.STARTED] > limits.budget_ms
            ):
                code = status.OUT_OF_TIME
            elif progress.count[status.SINCE] >= limits.max_outer:
                code = status.CAPPED
        # what is held back wants less than it would: a step that ends so tells of the last motion that was wanted freely
        if search.restrained[0] == 0:
            progress.numbers[status.MOVED_FREELY] = residual
        elif code != status.RUNNING:
            progress.numbers[status.MOVED] = wp.max(residual, progress.numbers[status.MOVED_FREELY])
        progress.count[status.STATUS] = code
        progress.going[0] = 0
        if code == status.RUNNING:
            progress.going[0] = 1

    # Arguments: all that an iteration hands on to the next, in one launch.
    @kernel(module)
    def decide(
        first: int,
        pairs: wp.array(dtype=wp.int32),
        script: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        search: Search,
        limits: Limits,
        progress: Progress,
        islands: Groups,
        e: Energies,
        least: wp.array(dtype=scalar),
        restraint: wp.array(dtype=scalar),
        renew: wp.array(dtype=wp.int32),
    ):
        """Whether to go on, and with what: who is held back, the potential to compare the next with and, where `renew` is given, which Hessian and
        whether it is made anew.
        """
        conclude(pairs, script, overflow, search, limits, progress)
        search.restrained[0] = restrain(islands, search, least, restraint)
        for b in range(islands.count):
            e.base_old[b] = e.base_new[b]
        search.whole[0] = 0
        if progress.count[status.OUTER] > 0 and search.hits[0] == 0 and search.attempts[0] == 1:
            search.whole[0] = 1
        if renew:
            choose(search, progress.numbers[status.MOVED], limits.tolerance, renew)
        search.attempts[0] = 0

    @kernel(module)
    def note_motion(
        first: int,
        free: wp.array(dtype=scalar),
        p: wp.array(dtype=vec3),
        parts: Share,
        partial: wp.array(dtype=scalar),
        count_out: wp.array(dtype=wp.int32),
    ):
        """Whether anything scripted moves in this iteration, by blocks of threads."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        moves = scalar(0.0)
        for i in range(block * parts.size + lane, wp.min((block + 1) * parts.size, free.shape[0]), wp.block_dim()):
            if free[i] == scalar(0.0) and wp.length_sq(p[i]) > scalar(0.0):
                moves = scalar(1.0)
        moves = largest_of_all(moves, worker, parts, partial)
        if lane == 0 and moves >= scalar(0.0):
            count_out[status.MOVING] = int(moves)

    return SimpleNamespace(
        inertia=inertia,
        strive=strive,
        judge=judge,
        least_fraction=least_fraction,
        spread_least=spread_least,
        turn_back=turn_back,
        commit=commit,
        commit_energies=commit_energies,
        crowd=crowd,
        weigh=weigh,
        clear=clear,
        exempt=exempt,
        start=start,
        decide=decide,
        note_motion=note_motion,
    )


def islands_of(model, owner: np.ndarray) -> Islands:
    """Which bodies may push on each other. owner: (n,), the simulated body of each vertex, -1 for obstacles."""
    assembly, simulated = model.assembly, owner >= 0
    ties = np.concatenate(
        [np.zeros((0, 2), dtype=np.int32)]
        + [np.column_stack([a.vertices_a, a.vertices_b]) for a in assembly.attachments]
        + [s.elements[:, [0, corner]] for s in (*assembly.stitches, *assembly.pins) for corner in (1, 2, 3)]
    )
    both = simulated[ties].all(axis=1)
    joined = np.unique(owner[ties[both]], axis=0)
    held = np.flatnonzero(simulated & ~model.free_vertices)
    to_obstacles = np.concatenate([ties[~both], ties[~both][:, ::-1]])
    to_obstacles = to_obstacles[~simulated[to_obstacles[:, 0]] & simulated[to_obstacles[:, 1]]]
    scripted, moved = np.concatenate([held, to_obstacles[:, 0]]), np.concatenate([held, to_obstacles[:, 1]])
    ranges = [(body.first, body.last) for body in assembly.bodies if not body.kinematic]
    return Islands(model.device, model.real, len(owner), ranges, joined, np.column_stack([scripted, owner[moved]]))


class Descent:
    """What the methods of the default mode share: the potential, the line search and the end of a step.

    p: (n + 1,) vec3, m, the motion that an iteration wants. numbers: on the device, see `status`: the largest such motion, m; forces, N; lag, m.
    descends: whether a motion has to lower the potential. frictional: whether friction is part of it. weighs: whether a step has also to leave no
    force that would move a body as a whole: for methods whose motions say little of how much is left, such as local-global iterations of stiff bodies.
    renew: (1,) int32, whether the elastic Hessian and the preconditioner are made anew, of methods that have some.
    """

    renew: wp.array | None = None

    def __init__(self, work, frictional: bool = True, descends: bool = True, weighs: bool = False):
        model = work.model
        device, real, n = model.device, model.real, model.vertex_count
        self.work, self.model, self.device, self.descending = work, model, device, kernels(real)
        self.descends = descends
        assembly, settings, free = model.assembly, model.settings, model.free_vertices
        self.pairs = BarrierTerm(device, real, model.kappa, model.friction, model.free, settings.slip_threshold)
        self.friction = FrictionTerm(self.pairs, settings.slip_threshold) if model.has_friction and frictional else None
        simulated = [body for body in assembly.bodies if not body.kinematic]
        owner = np.where(assembly.body_of_vertex < len(simulated), assembly.body_of_vertex, -1)
        self.bodies = len(simulated)
        self.islands = islands_of(model, owner)
        self.islands.beside = [] if self.friction is None else [self.friction]
        work.truncation.body, work.truncation.body_count = self.islands.body, len(simulated)
        work.truncation.deep = wp.zeros(max(1, len(simulated)), dtype=wp.int32, device=device.warp)
        of_elements = [owner[s.vertices].max(axis=1) for s in model.projector.sets]
        elements = np.concatenate([*of_elements, np.zeros(0, dtype=owner.dtype)])
        self.base_sums = BodySums(device, [elements, owner], self.bodies)
        self.elastic_sums = BodySums(device, [elements], self.bodies)
        self.vertex_sums = BodySums(device, [owner], self.bodies)

        def zeros(dtype, count=n):
            return wp.zeros(max(1, count), dtype=dtype, device=device.warp)

        # a body that follows four points turns as these do
        self.ranges = [(body.handles[0] if len(body.handles) else body.first, body.last) for body in simulated]
        of_bodies = np.array([*self.ranges, (0, 0)], dtype=np.int32)
        self.starts, self.ends = (wp.array(side, device=device.warp) for side in of_bodies.T.copy())
        vec3, scalar = real.vec3, real.scalar
        self.inertial, self.p = zeros(vec3), zeros(vec3, n + 1)
        self.vertex_energy = zeros(wp.float64)
        self.numbers = zeros(scalar, status.NUMBERS)
        self.parts = Parts(device, n)
        self.partial = zeros(scalar, self.parts.number)
        self.center, self.turn = (zeros(wp.vec3d, self.bodies) for _ in range(2))
        self.base_old, self.base_new, self.friction_old, self.friction_new = (zeros(wp.float64, self.bodies) for _ in range(4))
        self.before, self.after, self.most, self.stretched = (zeros(wp.float64, self.bodies) for _ in range(4))
        self.effort, self.elastic = (zeros(wp.float64, self.bodies) for _ in range(2))
        self.vertex_effort = zeros(wp.float64)
        self.least, self.island_least = zeros(scalar, self.bodies), zeros(scalar, self.bodies)
        self.accepted, self.squeezed = zeros(wp.int32, self.bodies), zeros(wp.int32, self.bodies)
        flags = (zeros(wp.int32, 1) for _ in range(7))
        self.attempts, self.searching, self.hits, self.project, self.restrained, self.lowered, self.whole = flags
        self.restraint = zeros(scalar, self.bodies)
        self.energies, self.search = filled(Energies, self), filled(Search, self)
        self.limits = limits(real)()
        self.limits.tolerance, self.limits.max_outer = settings.tolerance, settings.max_outer
        self.limits.most_change = BARRIER_CHANGE if self.friction is None else FORCE_CHANGE
        # what need not lower the potential does not idle where it does not
        self.limits.most_idle = IDLE if descends else settings.max_outer
        self.limits.budget_ms = settings.budget_ms or 0.0
        self.motion = motion(real)()
        self.motion.base, self.motion.u, self.motion.u_tilde = work.x_start, work.u, work.u_tilde
        self.motion.free, self.motion.center, self.motion.turn = model.free, self.center, self.turn
        self.pairs.project = self.project
        tied = {int(owner[v]) for s in model.projector.sets if s.kind in TIES for v in s.vertices.ravel()}
        whole = [bool(free[low:high].all()) and b not in tied for b, (low, high) in enumerate(self.ranges)]
        self.weighs = weighs and any(whole)
        self.balanced = self._bodies(whole)
        if self.weighs:
            self.unbalanced = zeros(scalar, self.bodies)
            self.largest_of_bodies = Largest(device, real, [self.bodies])
        mass = model.mass.numpy()
        lightest = float(mass[free & (mass > 0.0)].min()) if free.any() else 1.0
        self.tolerated = PCG_PART * settings.tolerance * np.sqrt(lightest) / settings.time_step

    def _bodies(self, whole: list[bool]) -> Any:
        """The bodies as kernels take them, of which these count as whole."""
        made = bodies(self.model.real)()
        made.starts, made.ends, made.mass = self.starts, self.ends, self.model.mass
        made.whole = wp.array(np.array([*whole, False], dtype=np.int32), device=self.device.warp)
        return made

    @property
    def generation(self) -> int:
        """Grows whenever arrays were replaced."""
        return self.pairs.generation

    def grow(self) -> bool:
        """Makes room where a list was full."""
        grown = self.pairs.grow()
        if grown and self.friction is not None:
            self.friction.grow()
        return grown

    def start(self) -> None:
        """Before the first outer iteration: the potential where the step starts."""
        w = self.work
        self.device.launch_serial(self.descending.start, [self.bodies, self.restraint, self.renew, self.search])
        if self.friction is not None:
            self.pairs.freeze(w.candidates, w.x)
            self.friction.lag()
        self.islands.find(w.candidates)
        self._evaluate(w.u, w.x)
        self._refer()
        if self.bodies:
            self.device.launch(self.descending.commit_energies, self.bodies, [self.base_new, self.base_old])
        if w.script.moves:
            self._find_crowded()
            w.script.hold()

    def _find_crowded(self) -> None:
        """Which movers wait, as things are since the potential was evaluated."""
        w, p = self.work, self.pairs
        self.device.launch(self.descending.clear, len(w.script.movers), [w.script.crowded])
        inputs = [p.frozen, w.led(), self.islands.groups, self.squeezed, self.restraint, w.script.crowded]
        self.device.launch(self.descending.crowd, p.capacity, inputs)

    def _evaluate(self, u: wp.array, x: wp.array) -> None:
        """The potential and the forces at x; with friction as it lags."""
        w, k, device, n = self.work, self.descending, self.device, self.model.vertex_count
        self.pairs.freeze(w.candidates, x)
        self.pairs.differentiate(x)
        inputs = [u, w.inertial(), self.pairs.energy_of_vertex, self.inertial, self.vertex_energy]
        device.launch(k.inertia, n, inputs)
        self.model.projector.evaluate(w.x_start, u)
        self._sum_energies()
        if self.friction is not None:
            self.friction.differentiate(u, self.project)
            self.vertex_sums.add([self.friction.energy_of_vertex], self.friction_new)

    def _sum_energies(self) -> None:
        self.base_sums.add([self.model.projector.energies, self.vertex_energy], self.base_new)
        if self.work.script.moves:
            self.elastic_sums.add([self.model.projector.energies], self.elastic)

    def _refer(self) -> None:
        """Energies count from what was accepted, at w.u."""
        if self.model.projector.cavities is not None:
            # a gas holds far more energy than a step changes, and what is put down to rounding is a part of the energy: so it counts from here
            self.model.projector.cavities.refer(self.work.x_start, self.work.u)
            self.model.projector.evaluate(self.work.x_start, self.work.u)
            self._sum_energies()

    def accept(self) -> None:
        """Line 16: the truncated motion, or as much of it as lowers the potential; and whether to go on."""
        w, t, model = self.work, self.work.truncation, self.model
        k, device, n, islands = self.descending, self.device, model.vertex_count, self.islands
        islands.renew(w.candidates)
        if w.script.moves:
            inputs = [model.free, self.p, self.parts.share, self.partial, w.count]
            device.launch_blocks(k.note_motion, self.parts.number, inputs, grain=self.parts.size)
            islands.find_driven(w.candidates, w.u, w.u_tilde)
            h = model.real.scalar(model.settings.time_step)
            device.launch(k.strive, n, [self.motion, model.mass, h, self.vertex_effort])
            self.vertex_sums.add([self.vertex_effort], self.effort)
        if not self.descends and self.bodies:
            device.launch(k.exempt, self.bodies, [islands.driven])
        self._evaluate(t.u_end, t.x_end)
        judging = [islands.groups, t.deep, self.energies, t.passes, w.candidates.overflow, self.tolerated**2, self.search]
        device.launch_serial(k.judge, judging)

        def search() -> None:
            if self.bodies:
                inputs = [self.balanced, model.free, self.attempts, t.truncated, self.least]
                device.launch_blocks(k.least_fraction, self.bodies, inputs, grain=1000)
                device.launch_serial(k.spread_least, [self.bodies, islands.label, self.least, self.island_least])
            inputs = [islands.groups, self.search, self.island_least, self.motion, t.truncated]
            device.launch(k.turn_back, n, inputs)
            w.candidates.check(w.x, t.x_end)
            device.when(w.candidates.needed, lambda: w.candidates.cover(w.x, t.x_end))
            t.prove(w.candidates, w.x_start, w.u, w.u_tilde, w.x)
            self._evaluate(t.u_end, t.x_end)
            device.launch_serial(k.judge, judging)

        device.loop(self.searching, search)
        inputs = [w.candidates.overflow, self.motion, w.script.goal, t.truncated, self.parts.share, self.partial]
        device.launch_blocks(k.commit, self.parts.number, [*inputs, w.x, self.numbers], grain=self.parts.size)
        self._refer()
        if self.weighs:
            h = model.real.scalar(model.settings.time_step)
            inputs = [self.balanced, w.x_start, w.u, self.inertial, self.pairs.force_of_vertex, h, self.unbalanced]
            device.launch_blocks(k.weigh, self.bodies, inputs, grain=1000)
            self.largest_of_bodies.find([self.unbalanced], self.numbers, [status.UNBALANCED])
        if w.script.moves:
            self._find_crowded()
        w.script.advance(w.x_start, w.u, t.fraction, w.count)
        states = [self.pairs.count, w.script.flags, w.candidates.overflow]
        bodies = [islands.groups, self.energies, self.island_least, self.restraint, self.renew]
        device.launch_serial(k.decide, [*states, self.search, self.limits, w.progress(), *bodies])
