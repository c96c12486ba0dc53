"""The barrier as Newton's method needs it: gradient and positive semidefinite Hessian of the true potential, pair by pair.

    B = kappa m(c) b(d),   d the distance less xi,   c the squared sine of an edge pair over its threshold

By the envelope theorem grad_i d = a_i n. Without a mollifier the Hessian is kappa b'' (a n)(a n)^T, one direction a pair, and what turns n and
moves the witness points,

    kappa b' hess d,   |r| hess d = a a^T (I - n n^T) - sum_k q_k q_k^T,   q = C^(-1/2) B,  C = r_t^T r_t,  B = r_t^T (a I) + r^T (da/dt),

with t the parameters of the witness points that lie inside an edge or a triangle, and r_t = dr/dt. As b' < 0 that is negative for the most part: it is
left out where the Hessian is projected, and of the preconditioner.
With a mollifier B is a function of d and c, whose 2x2 Hessian has one positive eigenvalue: after projection such a pair has one direction, too.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.barrier import pairs
from pdipc.barrier import potential as barrier
from pdipc.barrier.pairs import ActivePairs, Exerted
from pdipc.device.language import Kernel, filled, func, kernel, struct_of
from pdipc.device.launch import Span
from pdipc.device.precision import Mat43, Real, Scalar, Vec3, Vec4
from pdipc.linear import contact_rows
from pdipc.linear.contact_rows import ContactRows, first_entry
from pdipc.linear.wide_pcg import Operator


@func
def row(m: Mat43, s: int):
    return m[s]


@func
def outer(a: Vec4, v: Vec3):
    """a v^T: the gradient of a . x where all vertices move along v."""
    return wp.matrix_from_rows(a[0] * v, a[1] * v, a[2] * v, a[3] * v)


@func
def free_directions(a: Vec4, edges: bool):
    """da/dt of the parameters of the witness points that are not at an end."""
    zero, one = type(a[0])(0.0), type(a[0])(1.0)
    d1 = type(a)()
    d2 = type(a)()
    if edges:
        if a[0] > zero and a[1] > zero:
            d1[0] = -one
            d1[1] = one
        if a[2] < zero and a[3] < zero:
            d2[2] = one
            d2[3] = -one
    else:
        # from the first corner with a part to each later one
        if a[1] < zero:
            if a[2] < zero:
                d1[1] = one
                d1[2] = -one
            if a[3] < zero:
                d2[1] = one
                d2[3] = -one
        elif a[2] < zero and a[3] < zero:
            d1[2] = one
            d1[3] = -one
    return d1, d2


@func
def slopes(gap: Scalar, d_hat: Scalar):
    """b' and b'' of a pair. Where the gap has a minus it is foreseen, and these are of the tangent of the barrier where the gap will be, seen from
    here; see `ActivePairs.freeze`.
    """
    if gap < type(gap)(0.0):
        at = type(gap)(barrier.FORESEEN) * d_hat
        steep = barrier.barrier_hessian(at, d_hat)
        return barrier.barrier_gradient(at, d_hat) - steep * (gap + at), steep
    return barrier.barrier_gradient(gap, d_hat), barrier.barrier_hessian(gap, d_hat)


@func
def mollified(gap: Scalar, d_hat: Scalar, c: Scalar, g1: Vec3, g2: Vec3, along: Mat43):
    """Of m(c) b(d), 0 < c < 1: its gradient by c times that of c, and the direction and the curvature of the positive part of its Hessian.

    g1, g2: gradients of c by the two edge vectors. along: a n^T, the gradient of d. All per unit of kappa.
    """
    zero, one, two = type(gap)(0.0), type(gap)(1.0), type(gap)(2.0)
    b0 = barrier.barrier(gap, d_hat)
    b1 = barrier.barrier_gradient(gap, d_hat)
    b2 = barrier.barrier_hessian(gap, d_hat)
    slant = two - two * c
    turn = wp.matrix_from_rows(-g1, g1, -g2, g2)
    alpha = wp.sqrt(wp.ddot(along, along))
    beta = wp.ddot(along, turn) / alpha
    rest = turn - (beta / alpha) * along
    gamma = wp.sqrt(wp.ddot(rest, rest))
    s_dd = c * (two - c) * b2
    s_dc = b1 * slant
    s_cc = -two * b0
    h11 = alpha * alpha * s_dd + two * alpha * beta * s_dc + beta * beta * s_cc
    h12 = gamma * (alpha * s_dc + beta * s_cc)
    h22 = gamma * gamma * s_cc
    half = type(gap)(0.5) * (h11 - h22)
    spread = wp.sqrt(half * half + h12 * h12)
    largest = type(gap)(0.5) * (h11 + h22) + spread
    v1 = one
    v2 = zero
    if gamma > zero and wp.abs(h12) > zero:
        # of the two forms of the eigenvector the one without cancellation
        if half >= zero:
            v1 = half + spread
            v2 = h12
        else:
            v1 = h12
            v2 = spread - half
        size = wp.sqrt(v1 * v1 + v2 * v2)
        v1 = v1 / size
        v2 = v2 / (size * gamma)
    else:
        largest = h11
    return b0 * slant, turn, (v1 / alpha) * along + v2 * rest, wp.max(largest, zero)


@func
def bending(a: Vec4, edges: bool, p1: Vec3, p2: Vec3, p3: Vec3, along: Mat43):
    """What turns n and moves the witness points, for vertices at 0, p1, p2 and p3: |r|; the two q, zero where a parameter is not free; and whether
    they can be told apart. along: a n^T.
    """
    zero = type(a[0])(0.0)
    d1, d2 = free_directions(a, edges)
    r = a[1] * p1 + a[2] * p2 + a[3] * p3
    r1 = d1[1] * p1 + d1[2] * p2 + d1[3] * p3
    r2 = d2[1] * p1 + d2[2] * p2 + d2[3] * p3
    first = type(along)()
    second = type(along)()
    apart = bool(True)
    # Cholesky of C; a parameter that is not free has no direction
    c11 = wp.dot(r1, r1)
    c12 = wp.dot(r1, r2)
    c22 = wp.dot(r2, r2)
    if c11 > zero:
        first = (outer(a, r1) + outer(d1, r)) / wp.sqrt(c11)
        c22 = c22 - c12 * c12 / c11
    if c22 > type(c22)(1.0e-6) * wp.dot(r2, r2):
        l21 = zero
        if c11 > zero:
            l21 = c12 / wp.sqrt(c11)
        second = (outer(a, r2) + outer(d2, r) - l21 * first) / wp.sqrt(c22)
    elif wp.dot(r2, r2) > zero:
        apart = False
    return wp.length(r), first, second, apart


@functools.cache
def hessian_of(real: Real) -> Any:
    """A struct: the Hessian of the pairs, and what a product with it leaves at each pair or vertex."""
    scalar, vec3, mat43 = real.scalar, real.vec3, wp.types.matrix((4, 3), real.scalar)
    return struct_of(
        "Hessian",
        __name__,
        count=wp.array(dtype=wp.int32),
        quads=wp.array(dtype=wp.vec4i),
        weights=wp.array(dtype=real.vec4),
        normals=wp.array(dtype=vec3),
        lever=wp.array(dtype=mat43),  # direction and
        hessian=wp.array(dtype=scalar),  # curvature, N/m, of the part that is always there
        bend=wp.array(dtype=scalar),  # -kappa b' / |r|, N/m, of the part that is left out where it is projected,
        first_bent=wp.array(dtype=mat43),  # with the two q
        second_bent=wp.array(dtype=mat43),
        project=wp.array(dtype=wp.int32),  # (1,) whether that is so
        ends=wp.array(dtype=wp.int32),  # of each vertex, where its pairs end in
        entries=wp.array(dtype=wp.int32),  # 4 pair + place
        places=wp.array(dtype=wp.int32),  # of each pair's vertices in these lists, on CUDA, and
        shares=wp.array(dtype=vec3),  # what each gets there, N
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    mat43 = wp.types.matrix((4, 3), scalar)
    Frozen, Hessian = pairs.frozen(real), hessian_of(real)
    module = real.module(__name__)
    zero, one = wp.constant(scalar(0.0)), wp.constant(scalar(1.0))

    @kernel(module)
    def differentiate(
        span: Span,
        pairs: Frozen,
        x: wp.array(dtype=vec3),
        energy_out: wp.array(dtype=wp.float64),
        slope_out: wp.array(dtype=mat43),
        lever_out: wp.array(dtype=mat43),
        hessian_out: wp.array(dtype=scalar),
        bend_out: wp.array(dtype=scalar),
        first_out: wp.array(dtype=mat43),
        second_out: wp.array(dtype=mat43),
    ):
        """Energy, J; its gradient, N, at the four vertices; and the direction and curvature, N/m, of the Hessian."""
        worker = span.first + wp.tid()
        for begin in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, pairs.count[0])):
                q = pairs.quads[k]
                a = pairs.weights[k]
                n = pairs.normals[k]
                d = pairs.gaps[k]
                d_hat = pairs.activation[k]
                km = pairs.stiffness[k]
                foreseen = d < zero
                edges = k >= pairs.count[2]
                b1, b2 = slopes(d, d_hat)
                lever = outer(a, n)
                slope = outer((km * b1) * a, n)
                hessian = km * b2
                bend = zero
                first_bent = mat43()
                second_bent = mat43()
                # in double precision: what tells two iterates apart may be far below one energy
                energy = wp.float64(0.0)
                if not foreseen:
                    energy = wp.float64(km) * barrier.barrier(wp.float64(d), wp.float64(d_hat))
                plain = not foreseen
                if edges and not foreseen:
                    c, g1, g2 = barrier.parallel_gradient(x[q[1]] - x[q[0]], x[q[3]] - x[q[2]])
                    if c < one and c > zero:
                        plain = False
                        kappa = km / (c * (scalar(2.0) - c))
                        fading, turn, direction, curvature = mollified(d, d_hat, c, g1, g2, lever)
                        slope += (kappa * fading) * turn
                        lever = direction
                        hessian = kappa * curvature
                if plain:
                    x0 = x[q[0]]
                    distance, first_q, second_q, apart = bending(a, edges, x[q[1]] - x0, x[q[2]] - x0, x[q[3]] - x0, lever)
                    first_bent = first_q
                    second_bent = second_q
                    if apart and distance > zero:
                        bend = -km * b1 / distance
                bend_out[k] = bend
                first_out[k] = first_bent
                second_out[k] = second_bent
                energy_out[k] = energy
                slope_out[k] = slope
                lever_out[k] = lever
                hessian_out[k] = hessian

    @func
    def change(k: int, pairs: Frozen, p: wp.array(dtype=vec3), held: wp.array(dtype=scalar)) -> scalar:
        """By how much the motion p would change the curvature of the barrier of pair k, as part of that, or of the inertia that it acts against
        where that is more. held: kg/s^2, mass over h^2.
        """
        q = pairs.quads[k]
        a = pairs.weights[k]
        lever = a[1] * (p[q[1]] - p[q[0]]) + a[2] * (p[q[2]] - p[q[0]]) + a[3] * (p[q[3]] - p[q[0]])
        yields = zero
        for s in range(4):
            if held[q[s]] > zero:
                yields += a[s] * a[s] / held[q[s]]
        d = wp.abs(pairs.gaps[k])  # that of a pair that is foreseen has the sign of its side
        after = wp.max(d + wp.dot(pairs.normals[k], lever), scalar(0.1) * d)
        now = pairs.stiffness[k] * yields * barrier.barrier_hessian(d, pairs.activation[k])
        then = pairs.stiffness[k] * yields * barrier.barrier_hessian(after, pairs.activation[k])
        return wp.abs(then - now) / wp.max(now, one)

    @kernel(module)
    def gather(
        first: int,
        o: Hessian,
        free: wp.array(dtype=scalar),
        energy: wp.array(dtype=wp.float64),
        slope: wp.array(dtype=mat43),
        force_out: wp.array(dtype=vec3),
        diagonal_out: wp.array(dtype=mat33),
        energy_out: wp.array(dtype=wp.float64),
    ):
        """Of each vertex: the force, the block of the Hessian, and the energy of the pairs whose first free vertex it is."""
        v = first + wp.tid()
        force = vec3()
        d = mat33()
        own = wp.float64(0.0)
        for i in range(first_entry(v, o.ends), o.ends[v]):
            k = o.entries[i] // 4
            s = o.entries[i] % 4
            force -= row(slope[k], s)
            j = row(o.lever[k], s)
            d += o.hessian[k] * wp.outer(j, j)
            if free[v] > zero:  # noqa: SIM102  (Warp evaluates both sides of an "and")
                if pairs.counts_here(o.quads[k], s, free):
                    own += energy[k]
        force_out[v] = force
        diagonal_out[v] = d
        energy_out[v] = own

    @func
    def feel(o: Hessian, k: int, p: wp.array(dtype=vec3)):
        """Of pair k under p: what its three directions feel, N, the part of a I, and p . (Hessian) p."""
        q = o.quads[k]
        p0 = p[q[0]]
        p1 = p[q[1]]
        p2 = p[q[2]]
        p3 = p[q[3]]
        j = o.lever[k]
        along = wp.dot(row(j, 0), p0) + wp.dot(row(j, 1), p1) + wp.dot(row(j, 2), p2) + wp.dot(row(j, 3), p3)
        response = vec3(o.hessian[k] * along, zero, zero)
        across = vec3()
        work = response[0] * along
        if o.project[0] == 0 and o.bend[k] > zero:
            c = o.bend[k]
            a = o.weights[k]
            n = o.normals[k]
            u = a[0] * p0 + a[1] * p1 + a[2] * p2 + a[3] * p3
            across = -c * (u - wp.dot(n, u) * n)
            g = o.first_bent[k]
            bent = wp.dot(row(g, 0), p0) + wp.dot(row(g, 1), p1) + wp.dot(row(g, 2), p2) + wp.dot(row(g, 3), p3)
            response[1] = c * bent
            work += wp.dot(across, u) + response[1] * bent
            g = o.second_bent[k]
            bent = wp.dot(row(g, 0), p0) + wp.dot(row(g, 1), p1) + wp.dot(row(g, 2), p2) + wp.dot(row(g, 3), p3)
            response[2] = c * bent
            work += response[2] * bent
        return response, across, work

    @func
    def exert(o: Hessian, v: int, response: wp.array(dtype=vec3), across: wp.array(dtype=vec3)) -> vec3:
        """What the pairs of vertex v make of what they feel."""
        total = vec3()
        for i in range(first_entry(v, o.ends), o.ends[v]):
            k = o.entries[i] // 4
            s = o.entries[i] % 4
            total += response[k][0] * row(o.lever[k], s)
            if o.project[0] == 0:
                total += o.weights[k][s] * across[k]
                total += response[k][1] * row(o.first_bent[k], s) + response[k][2] * row(o.second_bent[k], s)
        return total

    @kernel(module)
    def stretch(
        span: Span, o: Hessian, p: wp.array(dtype=vec3), response_out: wp.array(dtype=vec3), across_out: wp.array(dtype=vec3)
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, o.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, o.count[0])):
                response, across, _work = feel(o, k, p)
                response_out[k] = response
                across_out[k] = across

    @kernel(module)
    def spread(
        first: int,
        o: Hessian,
        free: wp.array(dtype=scalar),
        response: wp.array(dtype=vec3),
        across: wp.array(dtype=vec3),
        y: wp.array(dtype=vec3),
    ):
        v = first + wp.tid()
        if free[v] > zero and o.ends[v] > first_entry(v, o.ends):
            y[v] = y[v] + exert(o, v, response, across)

    return SimpleNamespace(
        differentiate=differentiate,
        change=change,
        gather=gather,
        stretch=stretch,
        spread=spread,
        mat43=mat43,
        feel=feel,
    )


class BarrierTerm(ActivePairs):
    """The barriers at the positions that were last frozen: a term of the potential.

    project: (1,) int32 on the device, whether the Hessian is positive semidefinite; set from outside.
    force_of_vertex: (n,) vec3, N; diagonal: (n,) 3x3 blocks, N/m; energy_of_vertex: (n,) float64, J: what `differentiate` fills.
    """

    def __init__(self, *arguments):
        super().__init__(*arguments)
        n = len(self.kappa)
        self.exact = kernels(self.real)
        self.project = wp.ones(1, dtype=wp.int32, device=self.device.warp)
        self.force_of_vertex = wp.zeros(n, dtype=self.real.vec3, device=self.device.warp)
        self.energy_of_vertex = wp.zeros(n, dtype=wp.float64, device=self.device.warp)

    def _allocate(self, capacity: int) -> None:
        super()._allocate(capacity)
        device, real = self.device.warp, self.real
        mat43 = kernels(real).mat43
        self.slope, self.lever = (wp.zeros(capacity, dtype=mat43, device=device) for _ in range(2))
        self.energy_of_pair = wp.zeros(capacity, dtype=wp.float64, device=device)
        self.bend = wp.zeros(capacity, dtype=real.scalar, device=device)
        self.first_bent, self.second_bent = (wp.zeros(capacity, dtype=mat43, device=device) for _ in range(2))
        self.felt, self.across = (wp.zeros(capacity, dtype=real.vec3, device=device) for _ in range(2))
        self.rows = None if self.device.wide else ContactRows(self.device, real, len(self.kappa), capacity)

    def differentiate(self, x: wp.array) -> None:
        """Launches energy, force and Hessian at the frozen positions x."""
        k, device = self.exact, self.device
        result = [self.energy_of_pair, self.slope, self.lever, self.hessian]
        bent = [self.bend, self.first_bent, self.second_bent]
        device.launch_list(k.differentiate, self.capacity, [self.frozen, x, *result, *bent])
        self.gather_pairs()

    def gather_pairs(self) -> None:
        """Launches what the pairs give each vertex: force, block of the Hessian, energy."""
        result = [self.force_of_vertex, self.diagonal, self.energy_of_vertex]
        inputs = [self.operand(), self.free, self.energy_of_pair, self.slope, *result]
        self.device.launch(self.exact.gather, len(self.ends), inputs)

    def pushed(self) -> Exerted:
        """The barrier's forces where it was last differentiated, and what restitution added. Not recordable."""
        quads, weights, normals, slope, rebound = self.listed(self.quads, self.weights, self.normals, self.slope, self.rebound)
        return Exerted(quads, weights[:, :, None] * (rebound[:, None] * normals)[:, None, :] - slope)

    def forces(self, x: wp.array) -> wp.array:
        """(n,) vec3, N: what the frozen pairs exert at x on each vertex."""
        self.differentiate(x)
        return self.force_of_vertex

    def assemble(self, count: int):
        """See `linear.block_pcg.Coupling`."""
        assert self.rows is not None
        return self.rows.assemble(count, assembly(self.real), self.operand(), self.free, self.ends, self.entries)

    def apply(self, p: wp.array, y: wp.array) -> None:
        """y += (contact Hessian) p at free vertices, pair by pair and gathered per vertex. Recordable."""
        k, device = self.exact, self.device
        o = self.operand()
        device.launch_list(k.stretch, self.capacity, [o, p, self.felt, self.across])
        device.launch(k.spread, len(self.ends), [o, self.free, self.felt, self.across, y])

    def couple(self, modes) -> None:
        """Adds the Hessian to the matrix of the rigid modes. Recordable."""
        if modes.wide:
            modes.couple(wide_coupling(self.real), self.operand(), self.capacity)
        else:
            self.device.launch(coupling(self.real), modes.groups, [modes.layout, self.operand(), modes.c], grain=64)

    def operand(self):
        """What the functions of `operator` work on."""
        return filled(hessian_of(self.real), self)


@functools.cache
def operator(real: Real) -> Operator:
    """The Hessian for the kernels of `wide_pcg`."""
    scalar, vec3, Hessian = real.scalar, real.vec3, hessian_of(real)
    feel_pair, total_share = kernels(real).feel, pairs.total_share(real)

    @func
    def feel(o: Hessian, k: int, p: wp.array(dtype=vec3)) -> scalar:
        response, across, work = feel_pair(o, k, p)
        for s in range(4):
            share = response[0] * row(o.lever[k], s)
            if o.project[0] == 0:
                share += o.weights[k][s] * across
                share += response[1] * row(o.first_bent[k], s) + response[2] * row(o.second_bent[k], s)
            o.shares[o.places[4 * k + s]] = share
        return work

    @func
    def exert(o: Hessian, v: int) -> vec3:
        return total_share(v, o.ends, o.shares)

    return Operator(Hessian, feel, exert)


@functools.cache
def assembly(real: Real) -> Kernel:
    """The kernel that fills the rows of the Hessian."""
    mat33, Hessian = real.mat33, hessian_of(real)
    identity = wp.constant(mat33(1, 0, 0, 0, 1, 0, 0, 0, 1))

    @func
    def block_of(o: Hessian, k: int, s: int, t: int) -> mat33:
        block = o.hessian[k] * wp.outer(row(o.lever[k], s), row(o.lever[k], t))
        if o.project[0] == 0 and o.bend[k] > real.scalar(0.0):
            n = o.normals[k]
            block += o.bend[k] * wp.outer(row(o.first_bent[k], s), row(o.first_bent[k], t))
            block += o.bend[k] * wp.outer(row(o.second_bent[k], s), row(o.second_bent[k], t))
            block -= (o.bend[k] * o.weights[k][s] * o.weights[k][t]) * (identity - wp.outer(n, n))
        return block

    return contact_rows.assembly(real, real.module(f"{__name__}.assembly"), Hessian, block_of)


@functools.cache
def wide_coupling(real: Real) -> Kernel:
    """`coupling` with a block of threads a pair of groups."""
    from pdipc.linear import wide_modes

    Hessian, wide = hessian_of(real), wp.float64

    @func
    def block_of(o: Hessian, k: int, s: int, t: int) -> wp.mat33d:
        a = row(o.lever[k], s)
        b = row(o.lever[k], t)
        return wide(o.hessian[k]) * wp.outer(
            wp.vec3d(wide(a[0]), wide(a[1]), wide(a[2])), wp.vec3d(wide(b[0]), wide(b[1]), wide(b[2]))
        )

    return wide_modes.coupling(real, real.module(f"{__name__}.wide_coupling"), Hessian, block_of)


@functools.cache
def coupling(real: Real) -> Kernel:
    """The kernel that adds rank-one terms of pairs to the matrix of rigid modes, a group of vertices a worker."""
    from pdipc.linear import rigid_modes

    f, Layout, Hessian = rigid_modes.functions(real), rigid_modes.layout_of(real), hessian_of(real)

    @kernel(real.module(f"{__name__}.coupling"))
    def couple(first: int, of: Layout, o: Hessian, c: wp.array(dtype=wp.float64)):
        g = first + wp.tid()
        size = rigid_modes.MODES * of.groups
        for m in range(of.starts[g], of.starts[g + 1]):
            v = of.members[m]
            for e in range(first_entry(v, o.ends), o.ends[v]):
                k = o.entries[e] // 4
                s = o.entries[e] % 4
                h = wp.float64(o.hessian[k])
                own = f.mode(of.arms[v], row(o.lever[k], s))
                for t in range(4):
                    i = o.quads[k][t]
                    other = of.label[i]
                    if other >= 0 and other <= g:
                        far = f.mode(of.arms[i], row(o.lever[k], t))
                        if other >= of.low[g]:
                            f.add_outer(c, size, g, other, h, own, far)
                    # a partner outside of the profile, on either side, is bounded by the diagonals
                    if other >= 0 and (other < of.low[g] or g < of.low[wp.max(other, 0)]):
                        f.add_outer(c, size, g, g, h, own, own)

    return couple
