"""Projected Newton inside Algorithm 1: one step of Newton's method an outer iteration, and none that raises the potential.

The potential of a step is that of Section 3, with the barrier and lagged friction,

    Phi(x) = E + Psi + B + D,

as `descent` has it, over the displacements u since the start of the step. Its Hessian is made positive semidefinite element by element and pair by pair, and
conjugate gradients solve for the step (Section 4.3: "any existing Hessian-free nonlinear programming ... could fit in Alg. 1").

The step is straight, and a straight step that rotates a body stretches it, by the square of the angle: for a body of steel more than a few
microns cost more than they win, and a stretched body resists the rest of its rotation, so that the next step looks small. So the part of the step
that rotates the body as a whole, about what holds it if something does, becomes a rotation: x~ = x + p + (R(w) - I - [w]) (x - c). It changes
p by its square, so it descends as p does, and solves as fast as p where that is small. A step that would rotate by more than a radian is made in part.

Where the Hessian is indefinite the projected one takes its place, whose bound makes steps creep along directions that the potential curves down in; as
long as they do not shrink, each is tried with twice the length of the last.

What is scripted goes as far as it can in an iteration, and Newton's step already sees what it will meet: a pair that it is about to close
acts with the tangent that its barrier will have where the gap will be half of d_hat. So bodies move out of the way with what pushes them. That
is the potential of no state, and need not be: it only chooses where to go.

Newton's own step is the estimate of the error, since it is what one more iteration would change: the step has converged when no free
vertex would go further than the tolerance, was neither truncated nor turned back, nor held back, and all that is scripted has arrived. What is
scripted goes from waypoint to waypoint, an outer iteration each where nothing is in the way (`integration.script`).
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.barrier import exact, friction
from pdipc.barrier.pairs import Exerted, frozen
from pdipc.barrier.restitution import Restitution
from pdipc.collision.islands import Groups
from pdipc.constraints.projector import corners
from pdipc.constraints.projector import kernels_of as elastic_kernels
from pdipc.device import blocks
from pdipc.device.language import func, kernel, struct
from pdipc.device.launch import Largest, Parts, Share
from pdipc.device.precision import Real
from pdipc.integration import status
from pdipc.integration.script import led
from pdipc.linear.affine import AffineBodies
from pdipc.linear.block_pcg import BlockPcg
from pdipc.linear.blocks import BlockMatrix
from pdipc.linear.wide_pcg import WidePcg
from pdipc.nonlinear.descent import Descent, Search, curved, motion, turned, widened

SAMPLES = 128  # vertices of a body that tell how it rotates
GRIP = 1.0e6  # how much more than all of them those weigh that are held
ON_A_LINE = 1.0e-5  # of the sum of m |arm|^2: the inertia about an axis that a body is taken to turn about
MOST_TURN = 1.0  # rad of a step: of a longer one a part is made
CREEP = 0.7  # of the last step: a step of a projected Hessian that is as long creeps
MOST_STRETCH = 1024.0
NEAR = 10.0  # tolerances: a step that is shorter, at indefinite Hessians, is one away from a saddle
PCG_TOLERANCE, PCG_MOST = 1.0e-3, 400
REBOUND_TOLERANCE = {
    "float32": 1.0e-5,
    "float64": 1.0e-9,
}  # of the one solve for restitution: what is left of it acts as from outside


@struct
class Samples:
    """The vertices of each body that tell how it rotates; see `samples_of`."""

    starts: wp.array[wp.int32]
    vertices: wp.array[wp.int32]
    weights: wp.array[wp.float64]  # kg


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, vec4, Led = real.scalar, real.vec3, real.vec4, led(real)
    Frozen, Progress, Corners, Motion = frozen(real), status.progress(real), corners(real), motion(real)
    change, elastic_total = exact.kernels(real).change, elastic_kernels(real).total
    block_largest, last_block = blocks.largest(vec4), blocks.last()
    module = real.module(__name__)
    wide = wp.float64
    total_number, total_vector, total_matrix = (blocks.total(each) for each in (wide, wp.vec3d, wp.mat33d))

    @func
    def wanted(p: vec3, free: scalar) -> scalar:
        """How far a free vertex wants to go; what is no number is infinitely far from its goal."""
        moved = wp.length(p)
        if not (moved < scalar(1.0e30)):
            moved = scalar(wp.inf)
        elif free == scalar(0.0):
            moved = scalar(0.0)
        return moved

    @func
    def lengthened(search: Search, progress: Progress, stretch: scalar) -> scalar:
        """How many times its length a step is tried with. Where the potential curves down, the projected Hessian has a bound instead, and steps
        creep, all alike or growing: as long as they do, each that descends is followed by one twice as long.
        """
        creeps = progress.numbers[status.MOVED] >= scalar(CREEP) * progress.numbers[status.MOVED_BEFORE]
        if search.project[0] != 0 and search.whole[0] != 0 and creeps:
            return wp.min(scalar(2.0) * stretch, scalar(MOST_STRETCH))
        return scalar(1.0)

    # Arguments: all that tells how far an iteration is from the end of the step, in one launch.
    @kernel(module)
    def measure(
        first: int,
        p: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        inertial: wp.array(dtype=vec3),
        pairs: Frozen,
        held: wp.array(dtype=scalar),
        search: Search,
        progress: Progress,
        parts: Share,
        partial: wp.array(dtype=vec4),
        stretch: wp.array(dtype=scalar),
    ):
        """The largest motion that is wanted, forces, and changes of barriers by it, by blocks of threads; then how far the step is tried."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        largest = vec4()
        begin = block * parts.size
        for i in range(begin + lane, wp.min(begin + parts.size, free.shape[0]), wp.block_dim()):
            largest = wp.max(largest, vec4(wanted(p[i], free[i]), wp.length(rhs[i]), wp.length(inertial[i]), scalar(0.0)))
        for k in range(begin + lane, wp.min(begin + parts.size, pairs.count[0]), wp.block_dim()):
            largest[3] = wp.max(largest[3], change(k, pairs, p, held))
        largest = block_largest(largest)
        if lane == 0:
            partial[block] = largest
        if last_block(parts.arrived, 0, parts.number):
            largest = vec4()
            for k in range(lane, parts.number, wp.block_dim()):
                largest = wp.max(largest, partial[k])
            largest = block_largest(largest)
            if lane == 0:
                progress.numbers[status.MOVED] = largest[0]
                progress.numbers[status.FORCE] = largest[1]
                progress.numbers[status.FORCE_SCALE] = largest[2]
                progress.numbers[status.BARRIER_CHANGE] = largest[3]
                stretch[0] = lengthened(search, progress, stretch[0])

    @kernel(module)
    def look_ahead(
        first: int,
        o: Led,
        z: wp.array(dtype=vec3),
        count: wp.array(dtype=wp.int32),
        ahead_out: wp.array(dtype=vec3),
        driven_out: wp.array(dtype=wp.int32),
    ):
        """Where vertices are going: what is driven to its target, others as inertia has it in the first iteration, and nowhere later."""
        i = first + wp.tid()
        place = o.base[i] + o.u[i]
        driven_out[i] = 0
        if o.free[i] == scalar(0.0):
            if o.drive[wp.max(o.mover[i], 0)] != 0 and o.mover[i] >= 0:
                place = o.target[i]
                driven_out[i] = 1
        elif count[status.OUTER] == 0:
            place = o.base[i] + z[i]
        ahead_out[i] = place

    @kernel(module)
    def begin(
        first: int,
        o: Led,
        inertial: wp.array(dtype=vec3),
        elastic: Corners,
        barrier: wp.array(dtype=vec3),
        friction: wp.array(dtype=vec3),
        rhs_out: wp.array(dtype=vec3),
        p_out: wp.array(dtype=vec3),
    ):
        """The whole force; and where the step starts from: scripted vertices go to their targets where they are driven."""
        i = first + wp.tid()
        total = inertial[i]
        if elastic.offsets:
            total = elastic_total(i, total, elastic)
        total += barrier[i]
        if friction:
            total += friction[i]
        rhs_out[i] = o.free[i] * total
        p_out[i] = vec3()
        if o.free[i] == scalar(0.0) and o.drive[wp.max(o.mover[i], 0)] != 0:
            p_out[i] = (o.target[i] - o.base[i]) - o.u[i]

    @func
    def share_part(
        islands: Groups,
        part: wp.array(dtype=scalar),
        least_out: wp.array(dtype=scalar),
        turn: wp.array(dtype=wp.vec3d),
    ):
        """All bodies of an island make the same part of the step: only that descends. least_out: that of each body's island."""
        for b in range(islands.count):
            least_out[b] = scalar(1.0)
        for b in range(islands.count):
            least_out[islands.label[b]] = wp.min(least_out[islands.label[b]], part[b])
        for b in range(islands.count):
            least_out[b] = least_out[islands.label[b]]
            turn[b] = wide(least_out[b]) * turn[b]

    @kernel(module)
    def find_turn(
        first: int,
        bodies: Samples,
        o: Motion,
        p: wp.array(dtype=vec3),
        stretch: wp.array(dtype=scalar),
        islands: Groups,
        arrived: wp.array(dtype=wp.int32),
        own_part: wp.array(dtype=scalar),
        part_out: wp.array(dtype=scalar),
    ):
        """By how much the step, p as often as it is tried, rotates each body as a whole, rad, and about which point, as its samples tell.
        A part of the step is made where all of it would rotate by more than MOST_TURN. What lies on a line, as ropes do, does not turn about it: there any small
        motion is a large angle."""
        worker = first + wp.tid()
        b = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        start = bodies.starts[b]
        end = bodies.starts[b + 1]
        origin = o.base[bodies.vertices[start]]
        total = wide(0.0)
        center = wp.vec3d()
        mean = wp.vec3d()
        for k in range(start + lane, end, wp.block_dim()):
            i = bodies.vertices[k]
            m = bodies.weights[k]
            total += m
            center += m * widened((o.base[i] - origin) + o.u[i])
            mean += m * widened(p[i])
        total = total_number(total)
        center = total_vector(center)
        mean = total_vector(mean)
        if total > wide(0.0):
            center = center / total
            mean = mean / total
        momentum = wp.vec3d()
        square = wide(0.0)
        loose = wide(0.0)
        outer = wp.mat33d()
        for k in range(start + lane, end, wp.block_dim()):
            i = bodies.vertices[k]
            m = bodies.weights[k]
            arm = widened((o.base[i] - origin) + o.u[i]) - center
            momentum += m * wp.cross(arm, widened(p[i]) - mean)
            square += m * wp.length_sq(arm)
            if o.free[i] > scalar(0.0):
                loose += m * wp.length_sq(arm)
            outer += m * wp.outer(arm, arm)
        momentum = total_vector(momentum)
        square = total_number(square)
        loose = total_number(loose)
        outer = total_matrix(outer)
        if lane == 0:
            turn = wp.vec3d()
            if square > wide(0.0):
                turn = turned(square, outer, momentum)
                if wp.dot(turn, momentum) < wide(ON_A_LINE) * loose * wp.length_sq(turn):
                    turn = wp.vec3d()
                turn = wide(stretch[0]) * turn
            if not (wp.length(turn) < wide(wp.inf)):
                turn = wp.vec3d()
            part = wp.min(wide(1.0), wide(MOST_TURN) / wp.max(wp.length(turn), wide(MOST_TURN)))
            o.center[b] = widened(origin) + center
            o.turn[b] = turn
            own_part[b] = scalar(part)
        if last_block(arrived, 0, islands.count):  # noqa: SIM102  (all threads of a block ask)
            if lane == 0:
                share_part(islands, own_part, part_out, o.turn)

    @kernel(module)
    def propose(
        first: int,
        o: Led,
        p: wp.array(dtype=vec3),
        body: wp.array(dtype=wp.int32),
        center: wp.array(dtype=wp.vec3d),
        turn: wp.array(dtype=wp.vec3d),
        part: wp.array(dtype=scalar),
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
        if o.free[i] > scalar(0.0):
            step = stretch[0] * step
        b = body[i]
        if b >= 0 and o.free[i] > scalar(0.0) and moved < scalar(wp.inf):
            step = part[wp.max(b, 0)] * step
            step += vec3(curved(widened(o.base[i] + o.u[i]) - center[wp.max(b, 0)], turn[wp.max(b, 0)]))
        u_tilde = o.u[i] + step
        if o.free[i] == scalar(0.0) and o.drive[wp.max(o.mover[i], 0)] != 0:
            u_tilde = o.target[i] - o.base[i]  # to the bit, so that it is known to have arrived
        u_tilde_out[i] = u_tilde
        x_tilde_out[i] = o.base[i] + u_tilde

    @kernel(module)
    def any_driven(first: int, movers: int, drive: wp.array(dtype=wp.int32), any_out: wp.array(dtype=wp.int32)):
        any_out[0] = 0
        for m in range(movers):
            any_out[0] = wp.max(any_out[0], drive[m])

    @kernel(module)
    def set_flag(first: int, flag_out: wp.array(dtype=wp.int32)):
        flag_out[0] = 1

    @kernel(module)
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

    @kernel(module)
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

    @kernel(module)
    def restart(first: int, free: wp.array(dtype=scalar), p: wp.array(dtype=vec3)):
        i = first + wp.tid()
        if free[i] > scalar(0.0):
            p[i] = vec3()

    return SimpleNamespace(
        measure=measure,
        look_ahead=look_ahead,
        begin=begin,
        find_turn=find_turn,
        propose=propose,
        any_driven=any_driven,
        set_flag=set_flag,
        compare=compare,
        leave_saddle=leave_saddle,
        restart=restart,
    )


def samples_of(vertices: np.ndarray, free: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a body that tell how it rotates as a whole, and their weights: masses, and for what is held far more than all of these,
    so that a body turns about what holds it and not at all where that is more than an axis.

    vertices: (k,); free: (n,) bool; mass: (n,) kg. Returns at most SAMPLES of each kind, (s,) int and (s,) kg.
    """
    loose, held = vertices[free[vertices]], vertices[~free[vertices]]
    loose, held = (_spread(each, SAMPLES) for each in (loose, held))
    grip = np.full(len(held), GRIP * mass[loose].sum() / max(1, len(held)))
    return np.concatenate([loose, held]), np.concatenate([mass[loose], grip])


def _spread(vertices: np.ndarray, most: int) -> np.ndarray:
    """At most so many of them: all where they are few, else spread, and not along the rows of a grid."""
    if len(vertices) <= most:
        return vertices
    k, every = np.arange(most), len(vertices) // most
    return vertices[k * len(vertices) // most + (37 * k) % every]


class Newton(Descent):
    """The nonlinear solve of Algorithm 1 by projected Newton; see `nonlinear.Method` for the seam."""

    def __init__(self, work):
        super().__init__(work)
        model = work.model
        device, real, n = model.device, model.real, model.vertex_count
        self.kernels = kernels(real)
        free, mass = model.free_vertices, model.mass.numpy().astype(np.float64)
        self.matrix = BlockMatrix(device, real, model.projector, model.held, free)
        equations = (device, real, self.matrix, free, PCG_TOLERANCE, PCG_MOST)
        operators = (exact.operator(real), friction.operator(real))
        self.affine = AffineBodies(device, real, n, model.followers) if model.followers else None
        wide = device.wide and self.affine is None
        self.solver = WidePcg(*equations, operators) if wide else BlockPcg(*equations, self.affine)
        work.truncation.neighbours = [self.matrix.offsets, self.matrix.columns]

        def zeros(dtype, count=n):
            return wp.zeros(max(1, count), dtype=dtype, device=device.warp)

        found = [samples_of(np.arange(low, high), free, mass) for low, high in self.ranges]
        starts = np.cumsum([0, *(len(samples) for samples, _ in found)])
        samples, weights = (np.concatenate([*side, [0]]) for side in zip(*found, strict=True)) if found else ([0], [0.0])
        self.samples = Samples()
        arrays = {"starts": (starts, np.int32), "vertices": (samples, np.int32), "weights": (weights, np.float64)}
        for name, (values, kind) in arrays.items():
            setattr(self.samples, name, wp.array(np.asarray(values, dtype=kind), device=device.warp))
        vec3, scalar = real.vec3, real.scalar
        self.rhs, self.curved = zeros(vec3), zeros(vec3, n + 1)
        self.moved, self.curves = (zeros(scalar) for _ in range(2))
        self.lengths, self.stretch, self.unrestrained = zeros(scalar, 2), zeros(scalar, 1), zeros(scalar, self.bodies)
        self.own_part, self.part = zeros(scalar, self.bodies), zeros(scalar, self.bodies)
        self.renew, self.driving, self.turns_found = (zeros(wp.int32, 1) for _ in range(3))
        self.driven = zeros(wp.int32)
        self.nobody = zeros(wp.int32, len(work.script.movers))
        self.largest_of_two = Largest(device, real, [n] * 2)
        self._make_parts()
        self.iterations = self.solver.iterations
        self.inner = zeros(wp.int32, 1)  # no local-global iterations

    def _make_parts(self) -> None:
        """How vertices and pairs are cut where they are measured."""
        self.measured = Parts(self.device, max(self.model.vertex_count, self.pairs.capacity))
        self.largest = wp.zeros(self.measured.number, dtype=self.model.real.vec4, device=self.device.warp)

    def grow(self) -> bool:
        """Makes room where a list was full."""
        grown = super().grow()
        if grown:
            self._make_parts()
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

    def freeze(self) -> None:
        """Line 5: barriers and their derivatives are those at x since x was accepted; friction has those of where the step started."""
        w = self.work
        if self.friction is not None:
            self.friction.differentiate(w.u, self.project)
            self.vertex_sums.add([self.friction.energy_of_vertex], self.friction_old)
        if self.work.script.moves:
            self.device.launch_serial(self.kernels.any_driven, [len(w.script.movers), w.script.drive, self.driving])
            self.device.when(self.driving, self._foresee)

    def _foresee(self) -> None:
        """What is scripted will push what is in its way: pairs that it is about to close push already, where it will be."""
        w = self.work
        inputs = [w.led(), w.z, w.count, w.x_tilde, self.driven]
        self.device.launch(self.kernels.look_ahead, self.model.vertex_count, inputs)
        w.candidates.check(w.x, w.x_tilde)
        self.device.when(w.candidates.needed, lambda: w.candidates.cover(w.x, w.x_tilde))
        self.pairs.freeze(w.candidates, w.x, w.x_tilde, self.driven)
        self.pairs.differentiate(w.x)

    def solve(self) -> None:
        """Lines 6 to 12: x~ = x + p with K p = -grad Phi."""
        w, k, device, n, model = self.work, self.kernels, self.device, self.model.vertex_count, self.model
        model.projector.find_forces(w.x_start, w.u)
        friction = None if self.friction is None else self.friction.force_of_vertex
        led = w.led()
        device.launch(
            k.begin, n, [led, self.inertial, model.projector.corners, self.pairs.force_of_vertex, friction, self.rhs, self.p]
        )
        if self.affine is not None:
            self.affine.fold(self.rhs)
        device.when(self.renew, self._assemble)
        self._solve_linear()
        device.when(self.solver.indefinite, self._solve_projected)
        inputs = [self.p, model.free, self.rhs, self.inertial, self.pairs.frozen, self.matrix.held, self.search, w.progress()]
        inputs += [self.measured.share, self.largest, self.stretch]
        device.launch_blocks(k.measure, self.measured.number, inputs, grain=self.measured.size)
        if self.bodies:
            inputs = [self.samples, self.motion, self.p, self.stretch, self.islands.groups, self.turns_found]
            device.launch_blocks(k.find_turn, self.bodies, [*inputs, self.own_part, self.part], grain=SAMPLES)
        inputs = [led, self.p, self.islands.body, self.center, self.turn, self.part, self.stretch]
        device.launch(k.propose, n, [*inputs, w.u_tilde, w.x_tilde])

    def _assemble(self) -> None:
        self._assemble_matrix(self.restraint)
        self.solver.prepare(self.work.x, self._couplings())

    def _assemble_matrix(self, restraint: wp.array) -> None:
        self.matrix.restrain(self.islands.body, restraint)
        self.matrix.assemble(self.work.x_start, self.work.u, self.project)
        if self.model.projector.rail_hessian is not None:
            self.model.projector.rail_hessian.stiffen(self.matrix.diagonal)

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
        device.launch(k.compare, n, [model.free, self.p, self.curved, self.moved, self.curves])
        self.largest_of_two.find([self.moved, self.curves], self.lengths, [0, 1])
        limit = model.real.scalar(NEAR * model.settings.tolerance)
        device.launch(k.leave_saddle, n, [model.free, self.lengths, limit, self.curved, self.p])
        if self.affine is not None:
            self.affine.expand(self.p)

    def correct(self, r: Restitution) -> None:
        """The velocities of restitution, `r.u_now`, by one step: the correction is small beside what bends an element."""
        w, model, n = self.work, self.model, self.model.vertex_count
        self.device.launch_serial(self.kernels.set_flag, [self.project])
        self._assemble_matrix(self.unrestrained)
        r.linearize_exact(w.rest)
        led = w.led()
        led.drive = self.nobody
        self.device.launch(
            self.kernels.begin, n, [led, r.zero, corners(model.real)(), self.pairs.force_of_vertex, None, r.zero, self.p]
        )
        couplings = [each for each in self._couplings() if each is not self.friction]
        self.solver.prepare(w.x, couplings)
        self.solver.solve(self.p, r.zero, couplings, 0.0, self.nobody, REBOUND_TOLERANCE[model.real.name])
        self.device.launch(r.kernels.move, n, [w.u, model.free, self.p, r.u_now])
        self.solver.clear(r.zero)
