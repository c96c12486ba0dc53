"""Coulomb friction with a lagged normal force (Li et al. 2020, Section 5): a term of the potential.

    D = sum mu lambda f0(|u|),   u = (I - n n^T) sum_i a_i u_i,   f0' = f1,   f1 = 2 y - y^2 for y = |u| / (eps_v h) < 1, else 1

u_i is the displacement of a vertex since the start of the step. lambda, a and n are those of the barrier where the step starts.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.barrier import pairs
from pdipc.barrier import potential as barrier
from pdipc.barrier.exact import BarrierTerm
from pdipc.barrier.pairs import Exerted, listed
from pdipc.device.language import Kernel, filled, func, kernel, struct_of
from pdipc.device.launch import Span
from pdipc.device.precision import Real, Scalar
from pdipc.linear import contact_rows
from pdipc.linear.contact_rows import ContactRows, first_entry
from pdipc.linear.wide_pcg import Operator


@func
def dissipation(slip: Scalar, threshold: Scalar):
    """f0(|u|), m, and f1(|u|), of 1, for slip = |u|: f0 begins at a third of the threshold and goes on as |u|."""
    one = type(slip)(1.0)
    y = slip / threshold
    if y < one:
        return threshold * (y * y - y * y * y / type(slip)(3.0) + one / type(slip)(3.0)), (
            type(slip)(2.0) - type(slip)(2.0) * y
        )
    return slip, type(slip)(0.0)


@functools.cache
def hessian_of(real: Real) -> Any:
    """A struct: the Hessian of the pairs, and what a product with it leaves at each vertex."""
    return struct_of(
        "FrictionHessian",
        __name__,
        count=wp.array(dtype=wp.int32),
        quads=wp.array(dtype=wp.vec4i),
        weights=wp.array(dtype=real.vec4),
        block=wp.array(dtype=real.mat33),  # N/m, per unit of both weights
        ends=wp.array(dtype=wp.int32),  # of each vertex, where its pairs end in
        entries=wp.array(dtype=wp.int32),  # 4 pair + place
        places=wp.array(dtype=wp.int32),  # of each pair's vertices in these lists, on CUDA, and
        shares=wp.array(dtype=real.vec3),  # what each gets there, N
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, vec4, mat33 = real.scalar, real.vec3, real.vec4, real.mat33
    Frozen, Hessian = pairs.frozen(real), hessian_of(real)
    module = real.module(__name__)
    zero = wp.constant(scalar(0.0))

    @kernel(module)
    def copy(
        span: Span,
        pairs: Frozen,
        entries: wp.array(dtype=wp.int32),
        quads_out: wp.array(dtype=wp.vec4i),
        weights_out: wp.array(dtype=vec4),
        normals_out: wp.array(dtype=vec3),
        limit_out: wp.array(dtype=scalar),
        entries_out: wp.array(dtype=wp.int32),
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                quads_out[k] = pairs.quads[k]
                weights_out[k] = pairs.weights[k]
                normals_out[k] = pairs.normals[k]
                steep = barrier.barrier_gradient(pairs.gaps[k], pairs.activation[k])
                limit_out[k] = -pairs.coefficient[k] * pairs.stiffness[k] * steep
                for s in range(4):
                    entries_out[4 * k + s] = entries[4 * k + s]

    @kernel(module)
    def copy_ends(
        first: int,
        count: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
        ends_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        ends_out[i] = ends[i]
        if i == 0:
            count_out[0] = count[0]

    @kernel(module)
    def copy_places(
        span: Span, count: wp.array(dtype=wp.int32), places: wp.array(dtype=wp.int32), places_out: wp.array(dtype=wp.int32)
    ):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, count[0])):
                for s in range(4):
                    places_out[4 * k + s] = places[4 * k + s]

    @func
    def slip(q: wp.vec4i, a: vec4, n: vec3, u: wp.array(dtype=vec3)) -> vec3:
        s = a[0] * u[q[0]] + a[1] * u[q[1]] + a[2] * u[q[2]] + a[3] * u[q[3]]
        return s - wp.dot(n, s) * n

    @kernel(module)
    def evaluate(
        span: Span,
        o: Hessian,
        u: wp.array(dtype=vec3),
        normals: wp.array(dtype=vec3),
        limit: wp.array(dtype=scalar),
        threshold: scalar,
        project: wp.array(dtype=wp.int32),
        energy_out: wp.array(dtype=wp.float64),
        force_out: wp.array(dtype=vec3),
        block_out: wp.array(dtype=mat33),
    ):
        """Energy, J; the force per unit of witness weight, N; and the block of the Hessian, N/m."""
        worker = span.first + wp.tid()
        for b in range(worker * span.block, o.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, o.count[0])):
                n = normals[k]
                s = slip(o.quads[k], o.weights[k], n, u)
                size = wp.length(s)
                rate = limit[k] * barrier.smoothed_coulomb(size, threshold)
                length, rising = dissipation(size, threshold)
                along = limit[k] * rising / threshold
                energy_out[k] = wp.float64(limit[k]) * wp.float64(length)
                force_out[k] = -rate * s
                h = rate * (mat33(wp.identity(n=3, dtype=scalar)) - wp.outer(n, n))
                # across the slip f1 / |u|, along it f1': nearly none once it slides, and Newton's step overshoots the kink at rest.
                # f1 / |u| in all directions bounds D from above, so that it descends.
                if size > zero and project[0] == 0:
                    t = s / size
                    h += (along - rate) * wp.outer(t, t)
                block_out[k] = h

    @kernel(module)
    def gather(
        first: int,
        o: Hessian,
        free: wp.array(dtype=scalar),
        energy: wp.array(dtype=wp.float64),
        force: wp.array(dtype=vec3),
        force_out: wp.array(dtype=vec3),
        diagonal_out: wp.array(dtype=mat33),
        energy_out: wp.array(dtype=wp.float64),
    ):
        v = first + wp.tid()
        total = vec3()
        d = mat33()
        own = wp.float64(0.0)
        for i in range(first_entry(v, o.ends), o.ends[v]):
            k = o.entries[i] // 4
            s = o.entries[i] % 4
            a = o.weights[k][s]
            total += a * force[k]
            d += (a * a) * o.block[k]
            if free[v] > zero:  # noqa: SIM102  (Warp evaluates both sides of an "and")
                if pairs.counts_here(o.quads[k], s, free):
                    own += energy[k]
        force_out[v] = total
        diagonal_out[v] = d
        energy_out[v] = own

    @func
    def feel(o: Hessian, k: int, p: wp.array(dtype=vec3)):
        """Of pair k under p: its force, N, per unit of weight, and p . (Hessian) p."""
        q = o.quads[k]
        a = o.weights[k]
        s = a[0] * p[q[0]] + a[1] * p[q[1]] + a[2] * p[q[2]] + a[3] * p[q[3]]
        response = o.block[k] * s
        return response, wp.dot(response, s)

    @func
    def exert(o: Hessian, v: int, response: wp.array(dtype=vec3)) -> vec3:
        """What the pairs of vertex v make of what they feel."""
        total = vec3()
        for i in range(first_entry(v, o.ends), o.ends[v]):
            k = o.entries[i] // 4
            total += o.weights[k][o.entries[i] % 4] * response[k]
        return total

    @kernel(module)
    def stretch(span: Span, o: Hessian, p: wp.array(dtype=vec3), response_out: wp.array(dtype=vec3)):
        worker = span.first + wp.tid()
        for b in range(worker * span.block, o.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, o.count[0])):
                response, _work = feel(o, k, p)
                response_out[k] = response

    @kernel(module)
    def spread(first: int, o: Hessian, free: wp.array(dtype=scalar), response: wp.array(dtype=vec3), y: wp.array(dtype=vec3)):
        v = first + wp.tid()
        if free[v] > zero and o.ends[v] > first_entry(v, o.ends):
            y[v] = y[v] + exert(o, v, response)

    return SimpleNamespace(
        copy=copy,
        copy_ends=copy_ends,
        copy_places=copy_places,
        evaluate=evaluate,
        gather=gather,
        stretch=stretch,
        spread=spread,
        feel=feel,
    )


class FrictionTerm:
    """force_of_vertex, diagonal, energy_of_vertex: as for `BarrierTerm`. threshold: eps_v h, m."""

    def __init__(self, barrier_term: BarrierTerm, threshold: float):
        self.source, self.device, self.real = barrier_term, barrier_term.device, barrier_term.real
        self.threshold, self.kernels = self.real.scalar(threshold), kernels(self.real)
        n, device = len(barrier_term.kappa), self.device.warp
        self.count = wp.zeros(1, dtype=wp.int32, device=device)
        self.ends = wp.zeros(n, dtype=wp.int32, device=device)
        self.diagonal = wp.zeros(n, dtype=self.real.mat33, device=device)
        self.force_of_vertex = wp.zeros(n, dtype=self.real.vec3, device=device)
        self.energy_of_vertex = wp.zeros(n, dtype=wp.float64, device=device)
        self.capacity = 0
        self.grow()

    def grow(self) -> None:
        """As much room as the barrier has."""
        capacity = self.source.capacity
        if capacity == self.capacity:
            return
        real = self.real

        def make(dtype, count=capacity):
            return wp.zeros(count, dtype=dtype, device=self.device.warp)

        self.capacity = capacity
        self.quads, self.weights, self.normals, self.limit = make(wp.vec4i), make(real.vec4), make(real.vec3), make(real.scalar)
        self.entries = make(wp.int32, 4 * capacity)
        self.energy_of_pair, self.force, self.block = make(wp.float64), make(real.vec3), make(real.mat33)
        self.response = make(real.vec3)
        wide = 4 * capacity if self.device.wide else 1
        self.places, self.shares = make(wp.int32, wide), make(real.vec3, wide)
        self.rows = None if self.device.wide else ContactRows(self.device, real, len(self.ends), capacity)

    def lag(self) -> None:
        """Launches the copy of the barrier's pairs, with the normal forces that they have now."""
        k, device, s = self.kernels, self.device, self.source
        device.launch(k.copy_ends, len(self.ends), [s.count, s.ends, self.count, self.ends])
        copies = [self.quads, self.weights, self.normals, self.limit, self.entries]
        device.launch_list(k.copy, self.capacity, [s.frozen, s.entries, *copies])
        if device.wide:
            device.launch_list(k.copy_places, self.capacity, [s.count, s.places, self.places])

    def differentiate(self, u: wp.array, project: wp.array) -> None:
        """Launches energy, force and Hessian at the displacements u since the start of the step; project: (1,) int32, whether the Hessian
        is to be a bound that never overshoots.
        """
        k, device = self.kernels, self.device
        o = self.operand()
        inputs = [o, u, self.normals, self.limit, self.threshold, project]
        device.launch_list(k.evaluate, self.capacity, [*inputs, self.energy_of_pair, self.force, self.block])
        inputs = [o, self.source.free, self.energy_of_pair, self.force]
        device.launch(k.gather, len(self.ends), [*inputs, self.force_of_vertex, self.diagonal, self.energy_of_vertex])

    def rubbed(self) -> Exerted:
        """The forces where they were last differentiated. Not recordable."""
        quads, weights, force = listed(int(self.count.numpy()[0]), self.quads, self.weights, self.force)
        return Exerted(quads, weights[:, :, None] * force[:, None, :])

    def assemble(self, count: int):
        """See `linear.block_pcg.Coupling`."""
        assert self.rows is not None
        return self.rows.assemble(count, assembly(self.real), self.operand(), self.source.free, self.ends, self.entries)

    def apply(self, p: wp.array, y: wp.array) -> None:
        """y += (friction Hessian) p at free vertices. Recordable."""
        k, device = self.kernels, self.device
        o = self.operand()
        device.launch_list(k.stretch, self.capacity, [o, p, self.response])
        device.launch(k.spread, len(self.ends), [o, self.source.free, self.response, y])

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
    """As in `exact`."""
    scalar, vec3, Hessian = real.scalar, real.vec3, hessian_of(real)
    feel_pair, total_share = kernels(real).feel, pairs.total_share(real)

    @func
    def feel(o: Hessian, k: int, p: wp.array(dtype=vec3)) -> scalar:
        response, work = feel_pair(o, k, p)
        for s in range(4):
            o.shares[o.places[4 * k + s]] = o.weights[k][s] * response
        return work

    @func
    def exert(o: Hessian, v: int) -> vec3:
        return total_share(v, o.ends, o.shares)

    return Operator(Hessian, feel, exert)


@functools.cache
def assembly(real: Real) -> Kernel:
    """The kernel that fills the rows of the Hessian."""
    Hessian = hessian_of(real)

    @func
    def block_of(o: Hessian, k: int, s: int, t: int) -> real.mat33:
        return (o.weights[k][s] * o.weights[k][t]) * o.block[k]

    return contact_rows.assembly(real, real.module(f"{__name__}.assembly"), Hessian, block_of)


@functools.cache
def wide_coupling(real: Real) -> Kernel:
    """`coupling` with a block of threads a pair of groups."""
    from pdipc.linear import wide_modes

    Hessian, wide, widened = hessian_of(real), wp.float64, wide_modes.functions(real).widened

    @func
    def block_of(o: Hessian, k: int, s: int, t: int) -> wp.mat33d:
        return (wide(o.weights[k][s]) * wide(o.weights[k][t])) * widened(o.block[k])

    return wide_modes.coupling(real, real.module(f"{__name__}.wide_coupling"), Hessian, block_of)


@functools.cache
def coupling(real: Real) -> Kernel:
    """As in `exact`, for terms of rank two."""
    from pdipc.linear import rigid_modes

    scalar, vec3, Layout, Hessian = real.scalar, real.vec3, rigid_modes.layout_of(real), hessian_of(real)
    f = rigid_modes.functions(real)

    @kernel(real.module(f"{__name__}.coupling"))
    def couple(first: int, of: Layout, o: Hessian, c: wp.array(dtype=wp.float64)):
        g = first + wp.tid()
        size = rigid_modes.MODES * of.groups
        one = wp.float64(1.0)
        for m in range(of.starts[g], of.starts[g + 1]):
            v = of.members[m]
            for e in range(first_entry(v, o.ends), o.ends[v]):
                k = o.entries[e] // 4
                a = o.weights[k][o.entries[e] % 4]
                b = o.block[k]
                for t in range(4):
                    i = o.quads[k][t]
                    other = of.label[i]
                    outside = other >= 0 and (other < of.low[g] or g < of.low[wp.max(other, 0)])
                    for axis in range(3):
                        # block = sum over axes of its column times the unit vector
                        unit = vec3()
                        unit[axis] = scalar(1.0)
                        column = vec3(b[0, axis], b[1, axis], b[2, axis])
                        own = f.mode(of.arms[v], a * column)
                        if other >= of.low[g] and other <= g:
                            f.add_outer(c, size, g, other, one, own, f.mode(of.arms[i], o.weights[k][t] * unit))
                        if outside:
                            f.add_outer(c, size, g, g, one, own, f.mode(of.arms[v], a * unit))

    return couple
