"""Projected Newton inside Algorithm 1: one step of Newton's method an outer iteration, and none that raises the potential.

The potential of a step is that of Section 3, with the barrier and lagged friction,

    Phi(x) = E + Psi + B + D,     E = sum m |u - z|^2 / (2 h^2) + damping,

over the displacements u since the start of the step. Its Hessian is made positive semidefinite element by element and pair by pair, and
conjugate gradients solve for the step (Section 4.3: "any existing Hessian-free nonlinear programming ... could fit in Alg. 1").

The step is straight, and a straight step that rotates a body stretches it, by the square of the angle: for a body of steel more than a few
microns cost more than they win, and a stretched body resists the rest of its rotation, so that the next step looks small. So where no vertex of a
body is held, the part of the step that rotates the body as a whole becomes a rotation: x~ = x + p + (R(w) - I - [w]) (x - c). It changes
p by its square, so it descends as p does, and solves as fast as p where that is small.

Where the Hessian is indefinite the projected one takes its place, whose bound makes steps creep along directions that the potential curves down in; as
long as they do not shrink, each is tried with twice the length of the last.

What is scripted goes as far as it can in an iteration, and Newton's step already sees what it will meet: a pair that it is about to close
acts with the tangent that its barrier will have where the gap will be half of d_hat. So bodies move out of the way with what pushes them. That
is the potential of no state, and need not be: it only chooses where to go.

After truncation Phi is compared, island by island. Where it rose, the island goes back along the same direction: first all of it to the least
fraction that truncation left to one of its vertices, then by halves. What CCD has not proven is proven anew. So every outer iteration descends,
unless a script moves something that the island may touch: then the potential itself has changed.

Newton's own step is the estimate of the error, since it is what one more iteration would change: the step has converged when no free
vertex would go further than the tolerance, was neither truncated nor turned back, nor held back, and all that is scripted has arrived. What is
scripted goes from waypoint to waypoint, an outer iteration each where nothing is in the way (`integration.script`).
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.barrier import exact, friction
from pdipc.barrier.exact import BarrierTerm
from pdipc.barrier.friction import FrictionTerm
from pdipc.barrier.pairs import Exerted
from pdipc.barrier.restitution import Restitution
from pdipc.collision.islands import Islands
from pdipc.device import blocks
from pdipc.device.launch import Largest
from pdipc.device.precision import Real
from pdipc.device.sums import BodySums
from pdipc.integration import status
from pdipc.integration.script import AHEAD, ARRIVED, WILL
from pdipc.linear.affine import AffineBodies
from pdipc.linear.block_pcg import BlockPcg
from pdipc.linear.blocks import BlockMatrix
from pdipc.linear.wide_pcg import WidePcg

FRICTION_LAGS = (
    12  # outer iterations in which the normal forces of friction are renewed; then they stay, so that a limit is reached
)
HALVINGS = 30  # of an island's step, then it stays where it is
SQUEEZED = 0.01  # of d_hat: a scripted vertex waits once a pair that it is part of has a smaller gap
SAMPLES = 128  # vertices of a body that tell how it rotates
MOST_TURN = 0.5  # rad of a step: more is not one of Newton's
RESTRAIN = 0.5  # an island that keeps less of its step, since a pair was squeezed, takes shorter steps from then on
CREEP = 0.7  # of the last step: a step of a projected Hessian that is as long creeps
MOST_STRETCH = 1024.0
RELEASE, RELEASED = 0.25, 0.3  # the restraint fades so fast, and is over below that
LEAST_PART, MOST_RESTRAINT = 0.01, 1.0e8
STALLS = 3  # outer iterations without any progress of some island, then the step ends
SLACK = {
    "float32": 4.0e-7,
    "float64": 1.0e-12,
}  # of the potential: a rise that rounding makes; beside it what the linear solve leaves
EXACT = 0.1  # of its length: what a step of a projected Hessian must be shorter by, to be believed
NEAR = 10.0  # tolerances: a step that is shorter, at indefinite Hessians, is one away from a saddle
KEEP = 5.0  # tolerances: an outer iteration that moved less is followed by one with the same matrix
PCG_TOLERANCE, PCG_MOST = 1.0e-3, 400
REBOUND_TOLERANCE = {
    "float32": 1.0e-5,
    "float64": 1.0e-9,
}  # of the one solve for restitution: what is left of it acts as from outside
PCG_PART = 0.05  # of the tolerance: an error of the linear solve that does not matter


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, vec4 = real.scalar, real.vec3, real.vec4
    module = real.module(__name__)
    wide = wp.float64
    slack = wp.constant(wp.float64(SLACK[real.name]))
    total_number, total_vector, total_matrix = (blocks.total(each) for each in (wide, wp.vec3d, wp.mat33d))
    least_number = blocks.least(scalar)

    @wp.func
    def wide_square(a: vec3, b: vec3) -> wide:
        total = wide(0.0)
        for k in range(3):
            d = wide(a[k]) - wide(b[k])
            total += d * d
        return total

    @wp.func
    def widened(a: vec3) -> wp.vec3d:
        return wp.vec3d(wide(a[0]), wide(a[1]), wide(a[2]))

    @wp.kernel(module=module)
    def inertia(
        first: int,
        u: wp.array(dtype=vec3),
        rest: wp.array(dtype=vec3),
        z: wp.array(dtype=vec3),
        mass: wp.array(dtype=scalar),
        free: wp.array(dtype=scalar),
        h: scalar,
        damping: scalar,
        beside: wp.array(dtype=wide),
        force_out: wp.array(dtype=vec3),
        energy_out: wp.array(dtype=wide),
    ):
        """-dE/du of each vertex (line 8), with mass-proportional damping, and E with what is beside it."""
        i = first + wp.tid()
        scale = free[i] * mass[i] / h
        force_out[i] = scale / h * (z[i] - u[i]) - scale * damping * (u[i] - rest[i])
        energy = wide(scale) / wide(h) * wide_square(u[i], z[i]) + wide(scale) * wide(damping) * wide_square(u[i], rest[i])
        energy_out[i] = wide(0.5) * energy + beside[i]

    @wp.kernel(module=module)
    def measure(
        first: int,
        p: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        inertial: wp.array(dtype=vec3),
        moved_out: wp.array(dtype=scalar),
        force_out: wp.array(dtype=scalar),
        scale_out: wp.array(dtype=scalar),
    ):
        """How far each free vertex wants to go, and the forces on it; what is no number is infinitely far from its goal."""
        i = first + wp.tid()
        moved = wp.length(p[i])
        if not (moved < scalar(1.0e30)):
            moved = scalar(wp.inf)
        moved_out[i] = moved
        if free[i] == scalar(0.0) and moved < scalar(wp.inf):
            moved_out[i] = scalar(0.0)
        force_out[i] = wp.length(rhs[i])
        scale_out[i] = wp.length(inertial[i])

    @wp.kernel(module=module)
    def lengthen(
        first: int,
        projected: wp.array(dtype=wp.int32),
        hits: wp.array(dtype=wp.int32),
        attempts: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        numbers: wp.array(dtype=scalar),
        stretch_out: wp.array(dtype=scalar),
    ):
        """How many times its length a step is tried with. Where the potential curves down, the projected Hessian has a bound instead, and steps
        creep, all alike or growing: as long as they do, each that descends is followed by one twice as long.
        """
        creeps = count[status.OUTER] > 0 and numbers[status.MOVED] >= scalar(CREEP) * numbers[status.MOVED_BEFORE]
        if projected[0] != 0 and hits[0] == 0 and attempts[0] == 1 and creeps:
            stretch_out[0] = wp.min(scalar(2.0) * stretch_out[0], scalar(MOST_STRETCH))
        else:
            stretch_out[0] = scalar(1.0)

    @wp.kernel(module=module)
    def look_ahead(
        first: int,
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        z: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        mover: wp.array(dtype=wp.int32),
        drive: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        ahead_out: wp.array(dtype=vec3),
        driven_out: wp.array(dtype=wp.int32),
    ):
        """Where vertices are going: what is driven to its target, others as inertia has it in the first iteration, and nowhere later."""
        i = first + wp.tid()
        place = base[i] + u[i]
        driven_out[i] = 0
        if free[i] == scalar(0.0):
            if drive[wp.max(mover[i], 0)] != 0 and mover[i] >= 0:
                place = target[i]
                driven_out[i] = 1
        elif count[status.OUTER] == 0:
            place = base[i] + z[i]
        ahead_out[i] = place

    @wp.kernel(module=module)
    def begin(
        first: int,
        u: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        mover: wp.array(dtype=wp.int32),
        drive: wp.array(dtype=wp.int32),
        barrier: wp.array(dtype=vec3),
        friction: wp.array(dtype=vec3),
        rhs: wp.array(dtype=vec3),
        p_out: wp.array(dtype=vec3),
    ):
        """The whole force; and where the step starts from: scripted vertices go to their targets where they are driven."""
        i = first + wp.tid()
        total = rhs[i] + barrier[i]
        if friction:
            total += friction[i]
        rhs[i] = free[i] * total
        p_out[i] = vec3()
        if free[i] == scalar(0.0) and drive[wp.max(mover[i], 0)] != 0:
            p_out[i] = (target[i] - base[i]) - u[i]

    @wp.func
    def sampled(k: int, number: int, count: int) -> int:
        """The k-th of `number` of `count` vertices: all where they are few, else spread, and not along the rows of a grid."""
        # In Warp's language the quotient of integers is one.
        return (k * count) / number + (k * 37) % (count / number)  # pyright: ignore[reportReturnType]

    @wp.kernel(module=module)
    def find_turn(
        first: int,
        starts: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        whole: wp.array(dtype=wp.int32),
        mass: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        stretch: wp.array(dtype=scalar),
        center_out: wp.array(dtype=wp.vec3d),
        turn_out: wp.array(dtype=wp.vec3d),
    ):
        """By how much the step, p as often as it is tried, rotates each body as a whole, rad, and about which point; nothing where some of its vertices are held."""
        worker = first + wp.tid()
        b = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        start = starts[b]
        count = ends[b] - start
        number = wp.min(count, SAMPLES)
        if whole[b] == 0:
            number = 0
        origin = base[start]
        total = wide(0.0)
        center = wp.vec3d()
        mean = wp.vec3d()
        for k in range(lane, number, wp.block_dim()):
            i = start + sampled(k, number, count)
            m = wide(mass[i])
            total += m
            center += m * widened((base[i] - origin) + u[i])
            mean += m * widened(p[i])
        total = total_number(total)
        center = total_vector(center)
        mean = total_vector(mean)
        if total > wide(0.0):
            center = center / total
            mean = mean / total
        momentum = wp.vec3d()
        square = wide(0.0)
        outer = wp.mat33d()
        for k in range(lane, number, wp.block_dim()):
            i = start + sampled(k, number, count)
            m = wide(mass[i])
            arm = widened((base[i] - origin) + u[i]) - center
            momentum += m * wp.cross(arm, widened(p[i]) - mean)
            square += m * wp.length_sq(arm)
            outer += m * wp.outer(arm, arm)
        momentum = total_vector(momentum)
        square = total_number(square)
        outer = total_matrix(outer)
        turn = wp.vec3d()
        if number > 0:
            # a little more than the inertia, for bodies on a line
            turn = wp.inverse(wide(1.0 + 1.0e-9) * square * wp.identity(n=3, dtype=wide) - outer) * momentum
            turn = wide(stretch[0]) * turn
            if not (wp.length(turn) < wide(MOST_TURN)):
                turn = wp.vec3d()
        if lane == 0:
            center_out[b] = widened(origin) + center
            turn_out[b] = turn

    @wp.func
    def curved(arm: wp.vec3d, turn: wp.vec3d) -> vec3:
        """What rotating by `turn` does beyond turn x arm."""
        angle = wp.length(turn)
        result = wp.vec3d()
        if angle > wide(0.0):
            along = wp.cross(turn, arm)
            half = wp.sin(wide(0.5) * angle) / angle
            # sin(a) / a - 1 without cancellation
            less = -angle * angle / wide(6.0) * (wide(1.0) - angle * angle / wide(20.0))
            if angle > wide(0.05):
                less = wp.sin(angle) / angle - wide(1.0)
            result = less * along + wide(2.0) * half * half * wp.cross(turn, along)
        return vec3(scalar(result[0]), scalar(result[1]), scalar(result[2]))

    @wp.kernel(module=module)
    def propose(
        first: int,
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        body: wp.array(dtype=wp.int32),
        center: wp.array(dtype=wp.vec3d),
        turn: wp.array(dtype=wp.vec3d),
        target: wp.array(dtype=vec3),
        mover: wp.array(dtype=wp.int32),
        drive: wp.array(dtype=wp.int32),
        stretch: wp.array(dtype=scalar),
        u_tilde_out: wp.array(dtype=vec3),
        x_tilde_out: wp.array(dtype=vec3),
    ):
        """x~ = x + p, and what makes the rotation of whole bodies one that does not stretch them. What is no number stays."""
        i = first + wp.tid()
        step = p[i]
        moved = wp.length(step)
        if not (moved < scalar(1.0e30)):
            moved = scalar(wp.inf)
            step = vec3()
        if free[i] > scalar(0.0):
            step = stretch[0] * step
        b = body[i]
        if b >= 0 and moved < scalar(wp.inf):
            step += curved(widened(base[i] + u[i]) - center[wp.max(b, 0)], turn[wp.max(b, 0)])
        u_tilde = u[i] + step
        if free[i] == scalar(0.0) and drive[wp.max(mover[i], 0)] != 0:
            u_tilde = target[i] - base[i]  # to the bit, so that it is known to have arrived
        u_tilde_out[i] = u_tilde
        x_tilde_out[i] = base[i] + u_tilde

    @wp.kernel(module=module)
    def judge(
        first: int,
        bodies: int,
        label: wp.array(dtype=wp.int32),
        driven: wp.array(dtype=wp.int32),
        deep: wp.array(dtype=wp.int32),
        base_old: wp.array(dtype=wide),
        friction_old: wp.array(dtype=wide),
        base_new: wp.array(dtype=wide),
        friction_new: wp.array(dtype=wide),
        overflow: wp.array(dtype=wp.int32),
        negligible: wide,
        before: wp.array(dtype=wide),
        after: wp.array(dtype=wide),
        squeezed: wp.array(dtype=wp.int32),
        attempts: wp.array(dtype=wp.int32),
        accepted_out: wp.array(dtype=wp.int32),
        lowered_out: wp.array(dtype=wp.int32),
        searching_out: wp.array(dtype=wp.int32),
    ):
        """Whether the potential of each island has not risen; lowered: whether that of any has fallen by more than rounding. before, after,
        squeezed: (bodies,) scratch. What was squeezed before is not squeezed again while the rest goes on: such an island goes back as a whole."""
        for b in range(bodies):
            before[b] = wide(0.0)
            after[b] = wide(0.0)
            accepted_out[b] = 0
            squeezed[b] = 0
        for b in range(bodies):
            if deep[b] != 0:
                squeezed[label[b]] = 1
            before[label[b]] = before[label[b]] + base_old[b] + friction_old[b]
            after[label[b]] = after[label[b]] + base_new[b] + friction_new[b]
            if driven[b] != 0:
                accepted_out[label[b]] = 1
        searching = int(0)
        lowered_out[0] = 0
        for b in range(bodies):
            island = label[b]
            ok = accepted_out[island]
            unseen = slack * wp.abs(before[island]) + negligible
            if after[island] <= before[island] + unseen or attempts[0] > HALVINGS:
                ok = 1
            if after[island] < before[island] - unseen:
                lowered_out[0] = 1
            if squeezed[island] != 0 and attempts[0] == 0:
                ok = 0
            accepted_out[b] = ok
            if ok == 0:
                searching = 1
        attempts[0] = attempts[0] + 1
        if overflow[0] != 0:
            searching = 0
        searching_out[0] = searching

    @wp.kernel(module=module)
    def least_fraction(
        first: int,
        starts: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        free: wp.array(dtype=scalar),
        attempts: wp.array(dtype=wp.int32),
        first_fraction: wp.array(dtype=scalar),
        fraction: wp.array(dtype=scalar),
        least_out: wp.array(dtype=scalar),
    ):
        """What the first pass of truncation left to every vertex of a body, or later what it makes now: CCD may have cut some anew, and only
        where all make the same part of the step it is the step, which descends.
        """
        worker = first + wp.tid()
        b = worker // wp.block_dim()
        least = scalar(1.0)
        for i in range(starts[b] + worker % wp.block_dim(), ends[b], wp.block_dim()):
            if free[i] > scalar(0.0):
                part = fraction[i]
                if attempts[0] == 1:
                    part = first_fraction[i]
                least = wp.min(least, part)
        least = least_number(least)
        if worker % wp.block_dim() == 0:
            least_out[b] = least

    @wp.kernel(module=module)
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

    @wp.kernel(module=module)
    def turn_back(
        first: int,
        body: wp.array(dtype=wp.int32),
        label: wp.array(dtype=wp.int32),
        accepted: wp.array(dtype=wp.int32),
        attempts: wp.array(dtype=wp.int32),
        least: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        center: wp.array(dtype=wp.vec3d),
        turn: wp.array(dtype=wp.vec3d),
        fraction: wp.array(dtype=scalar),
        u_end_out: wp.array(dtype=vec3),
        x_end_out: wp.array(dtype=vec3),
        passes_out: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        """A part of the step, and of the rotation of the body: where on the arc, not on its chord."""
        i = first + wp.tid()
        if i == 0:
            passes_out[0] = 1  # what is not shortened has been proven already
            going_out[0] = 1
        b = body[i]
        if b >= 0 and accepted[wp.max(b, 0)] == 0:
            f = least[label[b]]
            if attempts[0] > 1 or f >= scalar(1.0):
                f = scalar(0.5) * f
            if attempts[0] >= HALVINGS:
                f = scalar(0.0)
            fraction[i] = f
            arm = widened(base[i] + u[i]) - center[b]
            arc = curved(arm, wide(f) * turn[b]) - f * curved(arm, turn[b])
            u_end_out[i] = u[i] + f * (u_tilde[i] - u[i]) + arc
            x_end_out[i] = base[i] + u_end_out[i]

    @wp.kernel(module=module)
    def commit(
        first: int,
        count: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        base: wp.array(dtype=vec3),
        goal: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        u_end: wp.array(dtype=vec3),
        x_end: wp.array(dtype=vec3),
        u_out: wp.array(dtype=vec3),
        x_out: wp.array(dtype=vec3),
        lag_out: wp.array(dtype=scalar),
    ):
        """The motion is made. lag: how far a scripted vertex is from its goal, m."""
        i = first + wp.tid()
        lag_out[i] = scalar(0.0)
        if overflow[0] == 0:
            u_out[i] = u_end[i]
            x_out[i] = x_end[i]
            if free[i] == scalar(0.0):
                lag_out[i] = wp.length((goal[i] - base[i]) - u_end[i])

    @wp.kernel(module=module)
    def commit_energies(
        first: int,
        base_new: wp.array(dtype=wide),
        base_old_out: wp.array(dtype=wide),
    ):
        b = first + wp.tid()
        base_old_out[b] = base_new[b]

    @wp.kernel(module=module)
    def crowd(
        first: int,
        pairs: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.vec4i),
        free: wp.array(dtype=scalar),
        gaps: wp.array(dtype=scalar),
        activation: wp.array(dtype=scalar),
        weights: wp.array(dtype=vec4),
        normals: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        mover: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        label: wp.array(dtype=wp.int32),
        squeezed: wp.array(dtype=wp.int32),
        restraint: wp.array(dtype=scalar),
        crowded_out: wp.array(dtype=wp.int32),
    ):
        """Which movers have a pair that is squeezed, or whose body is held back or was just stopped by one, and that what is left of their
        way would close; whoever writes, writes the same.
        """
        k = first + wp.tid()
        waits = False
        if k < pairs[0]:
            waits = gaps[k] < scalar(SQUEEZED) * activation[k]
            for s in range(4):
                b = body[quads[k][s]]
                if b >= 0:
                    waits = waits or restraint[b] > scalar(0.0) or squeezed[label[b]] != 0
        if waits:
            closing = scalar(0.0)
            for s in range(4):
                i = quads[k][s]
                if free[i] == scalar(0.0):
                    closing += weights[k][s] * wp.dot(normals[k], (target[i] - base[i]) - u[i])
            for s in range(4):
                i = quads[k][s]
                if free[i] == scalar(0.0) and closing < scalar(0.0):
                    crowded_out[mover[i]] = 1

    @wp.kernel(module=module)
    def any_driven(first: int, movers: int, drive: wp.array(dtype=wp.int32), any_out: wp.array(dtype=wp.int32)):
        any_out[0] = 0
        for m in range(movers):
            any_out[0] = wp.max(any_out[0], drive[m])

    @wp.kernel(module=module)
    def clear(first: int, flags_out: wp.array(dtype=wp.int32)):
        flags_out[first + wp.tid()] = 0

    @wp.kernel(module=module)
    def exempt(first: int, flags_out: wp.array(dtype=wp.int32)):
        flags_out[first + wp.tid()] = 1

    @wp.kernel(module=module)
    def set_flag(first: int, flag_out: wp.array(dtype=wp.int32)):
        flag_out[0] = 1

    @wp.kernel(module=module)
    def choose(
        first: int,
        hits: wp.array(dtype=wp.int32),
        attempts: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        numbers: wp.array(dtype=scalar),
        tolerance: scalar,
        project_out: wp.array(dtype=wp.int32),
        renew_out: wp.array(dtype=wp.int32),
    ):
        """The Hessian is projected until an iteration has gone its whole way: far from the end, negative curvature misleads. Elastic
        Hessian and preconditioner are kept for an iteration when the last one moved so little that it may well be the last, and they
        are exact: a projected one, or one from where a body was stretched by what rotated it, is too stiff to tell how much is left.
        """
        was_projected = project_out[0] != 0
        project_out[0] = 1
        renew = int(1)
        if count[status.OUTER] > 0 and hits[0] == 0 and attempts[0] == 1:
            project_out[0] = 0
            if renew_out[0] == 1 and not was_projected and numbers[status.MOVED] <= scalar(KEEP) * tolerance:
                renew = int(0)
        renew_out[0] = renew

    @wp.kernel(module=module)
    def restrain(
        first: int,
        bodies: int,
        label: wp.array(dtype=wp.int32),
        driven: wp.array(dtype=wp.int32),
        squeezed: wp.array(dtype=wp.int32),
        attempts: wp.array(dtype=wp.int32),
        least: wp.array(dtype=scalar),
        restraint: wp.array(dtype=scalar),
        restrained_out: wp.array(dtype=wp.int32),
    ):
        """By how many times its inertia each body is held back, as in the method of Levenberg and Marquardt.

        Newton's step doubles a tiny gap, if it is made whole. But what slides past such a gap hits it at once, and an island that is shortened by
        that makes no way, and squeezes the gap further. Inertia shortens the sliding and leaves the opening, which is stiff, as it is.
        """
        restrained = int(0)
        for b in range(bodies):
            island = label[b]
            r = scalar(RELEASE) * restraint[b]
            if r < scalar(RELEASED):
                r = scalar(0.0)
            if squeezed[island] != 0 and attempts[0] > 1 and least[island] < scalar(RESTRAIN) and driven[b] == 0:
                r = wp.max(restraint[b], scalar(1.0)) / wp.max(least[island], scalar(LEAST_PART))
                r = wp.min(r, scalar(MOST_RESTRAINT))
            restraint[b] = r
            if r > scalar(0.0):
                restrained = 1
        restrained_out[0] = restrained

    @wp.kernel(module=module)
    def compare(
        first: int,
        free: wp.array(dtype=scalar),
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        a_out: wp.array(dtype=scalar),
        b_out: wp.array(dtype=scalar),
    ):
        """How far free vertices go in a and b, m."""
        i = first + wp.tid()
        a_out[i] = free[i] * wp.length(a[i])
        b_out[i] = free[i] * wp.length(b[i])

    @wp.kernel(module=module)
    def leave_saddle(
        first: int,
        free: wp.array(dtype=scalar),
        lengths: wp.array(dtype=scalar),
        limit: scalar,
        direction: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
    ):
        """A short step goes as far along the direction of negative curvature as it goes by itself."""
        i = first + wp.tid()
        if free[i] > scalar(0.0) and lengths[0] <= limit and lengths[1] > scalar(0.0):
            p[i] = p[i] + lengths[0] / lengths[1] * direction[i]

    @wp.kernel(module=module)
    def restart(first: int, free: wp.array(dtype=scalar), p: wp.array(dtype=vec3)):
        i = first + wp.tid()
        if free[i] > scalar(0.0):
            p[i] = vec3()

    @wp.kernel(module=module)
    def start(
        first: int,
        bodies: int,
        lagging_out: wp.array(dtype=wp.int32),
        restraint_out: wp.array(dtype=scalar),
        restrained_out: wp.array(dtype=wp.int32),
    ):
        for b in range(bodies):
            restraint_out[b] = scalar(0.0)
        restrained_out[0] = 0
        lagging_out[0] = FRICTION_LAGS

    @wp.kernel(module=module)
    def before_search(
        first: int,
        passes: wp.array(dtype=wp.int32),
        hits_out: wp.array(dtype=wp.int32),
        attempts_out: wp.array(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
    ):
        hits_out[0] = passes[0]
        attempts_out[0] = 0
        count_out[status.MOVING] = 0

    # Long: one decision, of all that was found out in an iteration.
    @wp.kernel(module=module)
    def decide(
        first: int,
        pairs: wp.array(dtype=wp.int32),
        hits: wp.array(dtype=wp.int32),
        attempts: wp.array(dtype=wp.int32),
        script: wp.array(dtype=wp.int32),
        projected: wp.array(dtype=wp.int32),
        restrained: wp.array(dtype=wp.int32),
        lowered: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        clock: wp.array(dtype=wide),
        tolerance: scalar,
        max_outer: int,
        budget_ms: wide,
        numbers: wp.array(dtype=scalar),
        lagging: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        """Line 16. script: its flags. numbers: the largest wanted motion and lag, m.

        Whatever is limited begins anew where something scripted came to a waypoint: what follows is another problem.
        """
        code = int(status.RUNNING)
        residual = numbers[status.MOVED]
        behind = numbers[status.LAG] > scalar(0.0)
        # of a sequence that shrinks by the ratio r, r / (1 - r) times the last motion is left; near the end Newton's ratio vanishes.
        # One motion alone says nothing: the first step out of a stiff barrier is short, however far the way is that it opens
        ratio = scalar(0.99)
        if count[status.OUTER] > 0:
            ratio = wp.min(residual / wp.max(numbers[status.MOVED_BEFORE], scalar(1.0e-30)), scalar(0.99))
        left = residual * wp.max(scalar(1.0), ratio / (scalar(1.0) - ratio))
        numbers[status.MOVED_BEFORE] = residual
        if overflow[0] != 0:
            code = status.OVERFLOW
        else:
            count[status.OUTER] = count[status.OUTER] + 1
            count[status.SINCE] = count[status.SINCE] + 1
            count[status.BARRIERS] = pairs[0]
            lagging[0] = lagging[0] - 1
            if script[ARRIVED] != 0:
                count[status.SINCE] = 0
                count[status.STALLED] = 0
                lagging[0] = FRICTION_LAGS
            if hits[0] > 0:
                count[status.TRUNCATIONS] = count[status.TRUNCATIONS] + 1
            if attempts[0] > 1:
                count[status.SEARCHES] = count[status.SEARCHES] + 1
            if attempts[0] > HALVINGS:
                count[status.STALLED] = count[status.STALLED] + 1
            if projected[0] != 0:
                left = left / scalar(EXACT)
            # a step that is short beside the tolerance, and that the potential does not show, is what rounding leaves of the forces
            done = left <= tolerance and attempts[0] == 1
            if attempts[0] > 1 and lowered[0] == 0 and residual <= scalar(EXACT) * tolerance:
                done = True
            settled = done and hits[0] == 0 and count[status.MOVING] == 0 and restrained[0] == 0
            if residual >= scalar(wp.inf):
                code = status.NOT_FINITE
            elif settled and not behind and script[AHEAD] == 0:
                code = status.CONVERGED
            elif settled and script[WILL] == 0:
                code = status.LAGGING
            elif count[status.STALLED] >= STALLS:
                code = status.STALLING
            elif budget_ms > wide(0.0) and clock[status.LAST] - clock[status.STARTED] > budget_ms:
                code = status.OUT_OF_TIME
            elif count[status.SINCE] >= max_outer:
                code = status.CAPPED
        # what is held back wants less than it would: a step that ends so tells of the last motion that was wanted freely
        if restrained[0] == 0:
            numbers[status.MOVED_FREELY] = residual
        elif code != status.RUNNING:
            numbers[status.MOVED] = wp.max(residual, numbers[status.MOVED_FREELY])
        count[status.STATUS] = code
        going_out[0] = 0
        if code == status.RUNNING:
            going_out[0] = 1

    @wp.kernel(module=module)
    def note_motion(
        first: int,
        free: wp.array(dtype=scalar),
        p: wp.array(dtype=vec3),
        count: wp.array(dtype=wp.int32),
    ):
        """Whether anything scripted moves in this iteration; whoever writes, writes the same."""
        i = first + wp.tid()
        if free[i] == scalar(0.0) and wp.length_sq(p[i]) > scalar(0.0):
            count[status.MOVING] = 1

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Kernel)})


class Newton:
    """The nonlinear solve of Algorithm 1 by projected Newton; see `nonlinear.protocol` for the seam.

    numbers: on the device, see `status`: the largest motion that the last iteration wanted, m; forces, N; lag, m.
    """

    # Long: all that lives as long as the solve is made here.
    def __init__(self, work):
        model = work.model
        device, real, n = model.device, model.real, model.vertex_count
        self.work, self.model, self.device, self.kernels = work, model, device, kernels(real)
        assembly, settings = model.assembly, model.settings
        surfaces = (device, real, model.kappa, model.friction, model.free, settings.slip_threshold)
        self.pairs = BarrierTerm(*surfaces)
        self.friction = FrictionTerm(self.pairs, settings.slip_threshold) if model.has_friction else None
        free = model.free_vertices
        held = model.held
        self.matrix = BlockMatrix(device, real, model.projector, held, free)
        equations = (device, real, self.matrix, free, PCG_TOLERANCE, PCG_MOST)
        operators = (exact.operator(real), friction.operator(real))
        self.affine = AffineBodies(device, real, n, model.followers) if model.followers else None
        wide = device.wide and self.affine is None
        self.solver = WidePcg(*equations, operators) if wide else BlockPcg(*equations, self.affine)
        work.truncation.neighbours = [self.matrix.offsets, self.matrix.columns]
        simulated = [body for body in assembly.bodies if not body.kinematic]
        ranges = [(body.first, body.last) for body in simulated]
        inside = assembly.body_of_vertex < len(simulated)
        ties = np.concatenate(
            [np.zeros((0, 2), dtype=np.int32)]
            + [np.column_stack([a.vertices_a, a.vertices_b]) for a in assembly.attachments]
            + [s.elements[:, [0, corner]] for s in (*assembly.stitches, *assembly.pins) for corner in (1, 2, 3)]
        )
        both = inside[ties].all(axis=1)
        joined = np.unique(assembly.body_of_vertex[ties[both]], axis=0)
        held_vertices = np.flatnonzero(inside & ~free)
        to_obstacles = np.concatenate([ties[~both], ties[~both][:, ::-1]])
        to_obstacles = to_obstacles[~inside[to_obstacles[:, 0]] & inside[to_obstacles[:, 1]]]
        pinned = np.column_stack(
            [
                np.concatenate([held_vertices, to_obstacles[:, 0]]),
                assembly.body_of_vertex[np.concatenate([held_vertices, to_obstacles[:, 1]])],
            ]
        )
        self.islands = Islands(device, real, n, ranges, joined, pinned)
        work.truncation.body, work.truncation.body_count = self.islands.body, len(simulated)
        work.truncation.deep = wp.zeros(max(1, len(simulated)), dtype=wp.int32, device=device.warp)
        owner = np.where(inside, assembly.body_of_vertex, -1)
        of_elements = [owner[s.vertices].max(axis=1) for s in model.projector.sets]
        elements = np.concatenate([*of_elements, np.zeros(0, dtype=owner.dtype)])
        self.bodies = len(simulated)
        self.descends = True  # whether a motion has to lower the potential
        self.base_sums = BodySums(device, [elements, owner], self.bodies)
        self.friction_sums = BodySums(device, [owner], self.bodies)

        def zeros(dtype, count=n):
            return wp.zeros(max(1, count), dtype=dtype, device=device.warp)

        def upload(values) -> wp.array:
            return wp.array(np.append(values, 0).astype(np.int32), dtype=wp.int32, device=device.warp)

        # a body that follows four points turns as these do
        ranges = [(body.handles[0], body.last) if len(body.handles) else (body.first, body.last) for body in simulated]
        self.starts, self.ends = upload([low for low, _ in ranges]), upload([high for _, high in ranges])
        self.whole = upload([free[low:high].all() for low, high in ranges])
        vec3, scalar = real.vec3, real.scalar
        self.inertial, self.rhs, self.p, self.curved = zeros(vec3), zeros(vec3), zeros(vec3, n + 1), zeros(vec3, n + 1)
        self.vertex_energy = zeros(wp.float64)
        self.moved, self.forces, self.scales, self.lags = (zeros(scalar) for _ in range(4))
        self.numbers, self.lengths = zeros(scalar, status.NUMBERS), zeros(scalar, 2)
        self.center, self.turn = (zeros(wp.vec3d, self.bodies) for _ in range(2))
        self.base_old, self.base_new, self.friction_old, self.friction_new = (zeros(wp.float64, self.bodies) for _ in range(4))
        self.before, self.after = (zeros(wp.float64, self.bodies) for _ in range(2))
        self.least, self.island_least = zeros(scalar, self.bodies), zeros(scalar, self.bodies)
        self.accepted, self.squeezed = zeros(wp.int32, self.bodies), zeros(wp.int32, self.bodies)
        (
            self.attempts,
            self.searching,
            self.hits,
            self.lagging,
            self.project,
            self.renew,
            self.restrained,
            self.lowered,
            self.driving,
        ) = (zeros(wp.int32, 1) for _ in range(9))
        self.driven = zeros(wp.int32)
        self.stretch = zeros(scalar, 1)
        self.nobody = zeros(wp.int32, len(work.script.movers))
        self.restraint, self.unrestrained = zeros(scalar, self.bodies), zeros(scalar, self.bodies)
        self.pairs.project = self.project
        self.largest, self.largest_of_two, self.largest_of_three = (Largest(device, real, [n] * k) for k in (1, 2, 3))
        mass = model.mass.numpy()
        lightest = float(mass[free & (mass > 0.0)].min()) if free.any() else 1.0
        self.tolerated = PCG_PART * settings.tolerance * np.sqrt(lightest) / settings.time_step
        self.iterations = self.solver.iterations
        self.inner = zeros(wp.int32, 1)  # no local-global iterations

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

    def exerted(self) -> tuple[Exerted, Exerted]:
        """See `nonlinear.Method`: the gradients of barrier and friction where the step ended."""
        w = self.work
        if w.restitution is not None:  # which leaves its own in their place
            self.pairs.freeze(w.candidates, w.x)
            self.pairs.differentiate(w.x)
        pushed = self.pairs.pushed()
        rubbed = Exerted(pushed.quads[:0], pushed.forces[:0]) if self.friction is None else self.friction.rubbed()
        return pushed, rubbed

    def _couplings(self) -> list:
        """What the matrix has beside the blocks of elements."""
        beside = self.model.projector.cavities, self.model.projector.rail_hessian
        return [each for each in (self.pairs, self.friction, *beside) if each is not None]

    # Algorithm 1, in launches only.

    def start(self) -> None:
        """Before the first outer iteration: the potential where the step starts."""
        w = self.work
        self.device.launch_serial(self.kernels.start, [self.bodies, self.lagging, self.restraint, self.restrained])
        self.islands.find(w.candidates)
        if self.friction is not None:
            self.pairs.freeze(w.candidates, w.x)
            self.friction.lag()
        self._evaluate(w.u, w.x)
        self._keep_energies()

    def _evaluate(self, u: wp.array, x: wp.array) -> None:
        """The potential and the forces at x; with friction as it lags."""
        w, k, device, n = self.work, self.kernels, self.device, self.model.vertex_count
        s, real = self.model.settings, self.model.real
        self.pairs.freeze(w.candidates, x)
        self.pairs.differentiate(x)
        inputs = [u, w.rest, w.z, self.model.mass, self.model.free, real.scalar(s.time_step), real.scalar(s.damping)]
        device.launch(k.inertia, n, [*inputs, self.pairs.energy_of_vertex, self.inertial, self.vertex_energy])
        self.model.projector.evaluate(w.x_start, u)
        self._sum_energies()
        if self.friction is not None:
            self.friction.differentiate(u, self.project)
            self.friction_sums.add([self.friction.energy_of_vertex], self.friction_new)

    def _sum_energies(self) -> None:
        self.base_sums.add([self.model.projector.energies, self.vertex_energy], self.base_new)

    def _keep_energies(self) -> None:
        """The energies that were evaluated last, at w.u, are those that the next are compared with."""
        if self.model.projector.cavities is not None:
            # a gas holds far more energy than a step changes, and what is put down to rounding is a part of the energy: so it counts from here
            self.model.projector.cavities.refer(self.work.x_start, self.work.u)
            self.model.projector.evaluate(self.work.x_start, self.work.u)
            self._sum_energies()
        if self.bodies:
            self.device.launch(self.kernels.commit_energies, self.bodies, [self.base_new, self.base_old])

    def freeze(self) -> None:
        """Line 5: barriers and their derivatives are those at x since x was accepted; friction takes over their forces."""
        w = self.work
        self.device.launch_serial(self.kernels.choose, [*self._last(), self.project, self.renew])
        if self.friction is not None:
            self.device.when(self._lags_now(), self.friction.lag)
            self.friction.differentiate(w.u, self.project)
            self.friction_sums.add([self.friction.energy_of_vertex], self.friction_old)
        if self.work.script.moves:
            self.device.launch_serial(self.kernels.any_driven, [len(w.script.movers), w.script.drive, self.driving])
            self.device.when(self.driving, self._foresee)

    def _foresee(self) -> None:
        """What is scripted will push what is in its way: pairs that it is about to close push already, where it will be."""
        w, model = self.work, self.model
        inputs = [w.x_start, w.u, w.z, w.script.target, model.free, w.script.mover, w.script.drive, w.count]
        self.device.launch(self.kernels.look_ahead, model.vertex_count, [*inputs, w.x_tilde, self.driven])
        w.candidates.check(w.x, w.x_tilde)
        self.device.when(w.candidates.needed, lambda: w.candidates.cover(w.x, w.x_tilde))
        self.pairs.freeze(w.candidates, w.x, w.x_tilde, self.driven)
        self.pairs.differentiate(w.x)

    def _last(self) -> list:
        """What is known of the last outer iteration."""
        return [self.hits, self.attempts, self.work.count, self.numbers, self.model.real.scalar(self.model.settings.tolerance)]

    def _lags_now(self) -> wp.array:
        self.device.launch_serial(_positive(self.model.real), [self.lagging, self.searching])
        return self.searching

    def solve(self) -> None:
        """Lines 6 to 12: x~ = x + p with K p = -grad Phi."""
        w, k, device, n, model = self.work, self.kernels, self.device, self.model.vertex_count, self.model
        model.projector.add_forces(w.x_start, w.u, self.rhs, self.inertial)
        friction = None if self.friction is None else self.friction.force_of_vertex
        where = [w.u, w.x_start, w.script.target, model.free, w.script.mover, w.script.drive]
        device.launch(k.begin, n, [*where, self.pairs.force_of_vertex, friction, self.rhs, self.p])
        if self.affine is not None:
            self.affine.fold(self.rhs)
        device.when(self.renew, self._assemble)
        self._solve_linear()
        device.when(self.solver.indefinite, self._solve_projected)
        device.launch(k.measure, n, [self.p, model.free, self.rhs, self.inertial, self.moved, self.forces, self.scales])
        wanted = [self.moved, self.forces, self.scales]
        self.largest_of_three.find(wanted, self.numbers, [status.MOVED, status.FORCE, status.FORCE_SCALE])
        states = [self.project, self.hits, self.attempts, w.count]
        device.launch_serial(k.lengthen, [*states, self.numbers, self.stretch])
        if self.bodies:
            inputs = [self.starts, self.ends, self.whole, model.mass, w.x_start, w.u, self.p]
            inputs += [self.stretch, self.center, self.turn]
            device.launch_blocks(k.find_turn, self.bodies, inputs, grain=SAMPLES)
        inputs = [w.x_start, w.u, self.p, model.free, self.islands.body, self.center, self.turn]
        inputs += [w.script.target, w.script.mover, w.script.drive, self.stretch]
        device.launch(k.propose, n, [*inputs, w.u_tilde, w.x_tilde])

    def _assemble(self) -> None:
        self.matrix.restrain(self.islands.body, self.restraint)
        self.matrix.assemble(self.work.x_start, self.work.u, self.project)
        self.solver.prepare(self.work.x, self._couplings())

    def _solve_linear(self) -> None:
        contacts = self._couplings()
        self.solver.solve(self.p, self.rhs, contacts, self.tolerated, self.project)

    def _solve_projected(self) -> None:
        """Anew, with every element's Hessian positive semidefinite.

        Near a saddle such steps are short and grow by little from one to the next; what led to the end of the first solve leads away from it.
        It descends, as every direction of conjugate gradients does, and the less so the farther from the saddle: so only there is it followed.
        """
        w, k, device, model, n = self.work, self.kernels, self.device, self.model, self.model.vertex_count
        device.launch_serial(k.set_flag, [self.project])
        device.launch(k.restart, n, [model.free, self.p])
        device.copy(self.curved, self.solver.direction)
        if self.friction is not None:
            self.friction.differentiate(w.u, self.project)
        self._assemble()
        self._solve_linear()
        device.launch(k.compare, n, [model.free, self.p, self.curved, self.moved, self.lags])
        self.largest_of_two.find([self.moved, self.lags], self.lengths, [0, 1])
        limit = model.real.scalar(NEAR * model.settings.tolerance)
        device.launch(k.leave_saddle, n, [model.free, self.lengths, limit, self.curved, self.p])
        if self.affine is not None:
            self.affine.expand(self.p)

    def correct(self, r: Restitution) -> None:
        """The velocities of restitution, `r.u_now`, by one step: the correction is small beside what bends an element."""
        w, model, n = self.work, self.model, self.model.vertex_count
        self.device.launch_serial(self.kernels.set_flag, [self.project])
        self.matrix.restrain(self.islands.body, self.unrestrained)
        self.matrix.assemble(w.x_start, w.u, self.project)
        r.linearize_exact(w.rest)
        self.device.launch(
            self.kernels.begin,
            n,
            [
                w.u,
                w.x_start,
                w.script.target,
                model.free,
                w.script.mover,
                self.nobody,
                self.pairs.force_of_vertex,
                None,
                r.zero,
                self.p,
            ],
        )
        couplings = [each for each in self._couplings() if each is not self.friction]
        self.solver.prepare(w.x, couplings)
        self.solver.solve(self.p, r.zero, couplings, 0.0, self.nobody, REBOUND_TOLERANCE[model.real.name])
        self.device.launch(r.kernels.move, n, [w.u, model.free, self.p, r.u_now])
        self.solver.clear(r.zero)

    def accept(self) -> None:
        """Line 16: the truncated motion, or as much of it as lowers the potential; and whether to go on."""
        w, k, device, n, model, t = (
            self.work,
            self.kernels,
            self.device,
            self.model.vertex_count,
            self.model,
            self.work.truncation,
        )
        device.launch_serial(k.before_search, [t.passes, self.hits, self.attempts, w.count])
        self.islands.renew(w.candidates)
        if w.script.moves:
            device.launch(k.note_motion, n, [model.free, self.p, w.count])
            self.islands.find_driven(w.candidates, w.u, w.u_tilde)
        if not self.descends and self.bodies:
            device.launch(k.exempt, self.bodies, [self.islands.driven])
        self._evaluate(t.u_end, t.x_end)
        energies = [
            self.base_old,
            self.friction_old,
            self.base_new,
            self.friction_new,
            w.candidates.overflow,
            self.tolerated**2,
        ]
        judged = [self.before, self.after, self.squeezed, self.attempts, self.accepted, self.lowered, self.searching]
        judging = [self.bodies, self.islands.label, self.islands.driven, t.deep, *energies, *judged]
        device.launch_serial(k.judge, judging)

        def search() -> None:
            if self.bodies:
                inputs = [self.starts, self.ends, model.free, self.attempts, t.first_fraction, t.fraction, self.least]
                device.launch_blocks(k.least_fraction, self.bodies, inputs, grain=1000)
                device.launch_serial(k.spread_least, [self.bodies, self.islands.label, self.least, self.island_least])
            which = [self.islands.body, self.islands.label, self.accepted, self.attempts, self.island_least]
            motion = [w.x_start, w.u, w.u_tilde, self.center, self.turn, t.fraction, t.u_end, t.x_end, t.passes, t.going]
            device.launch(k.turn_back, n, [*which, *motion])
            w.candidates.check(w.x, t.x_end)
            device.when(w.candidates.needed, lambda: w.candidates.cover(w.x, t.x_end))
            t.prove(w.candidates, w.x_start, w.u, w.u_tilde, w.x)
            self._evaluate(t.u_end, t.x_end)
            device.launch_serial(k.judge, judging)

        device.loop(self.searching, search)
        inputs = [w.count, w.candidates.overflow, w.x_start, w.script.goal, model.free, t.u_end, t.x_end]
        device.launch(k.commit, n, [*inputs, w.u, w.x, self.lags])
        self.largest.find([self.lags], self.numbers, [status.LAG])
        self._keep_energies()
        if w.script.moves:
            p = self.pairs
            device.launch(k.clear, len(w.script.movers), [w.script.crowded])
            inputs = [p.count, p.quads, model.free, p.gaps, p.activation, p.weights, p.normals]
            inputs += [w.u, w.x_start, w.script.target, w.script.mover, self.islands.body, self.islands.label]
            inputs += [self.squeezed, self.restraint, w.script.crowded]
            device.launch(k.crowd, p.capacity, inputs)
        w.script.advance(w.x_start, w.u, t.fraction)
        s = model.settings
        states = [
            self.pairs.count,
            self.hits,
            self.attempts,
            w.script.flags,
            self.project,
            self.restrained,
            self.lowered,
        ]
        limits = [model.real.scalar(s.tolerance), s.max_outer, s.budget_ms or 0.0]
        times = [w.candidates.overflow, w.clock]
        device.launch_serial(k.decide, [*states, *times, *limits, self.numbers, self.lagging, w.count, w.going])
        which = [self.islands.label, self.islands.driven, self.squeezed, self.attempts, self.island_least]
        device.launch_serial(k.restrain, [self.bodies, *which, self.restraint, self.restrained])


@functools.cache
def _positive(real: Real) -> wp.Kernel:
    @wp.kernel(module=real.module(f"{__name__}.positive"))
    def positive(first: int, number: wp.array(dtype=wp.int32), flag_out: wp.array(dtype=wp.int32)):
        flag_out[0] = wp.where(number[0] > 0, 1, 0)

    return positive  # pyright: ignore[reportReturnType]
