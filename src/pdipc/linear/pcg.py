"""Conjugate gradients with the 3x3 block diagonal as preconditioner.

In the form of Chronopoulos and Gear (1989), which keeps s = K p by a recurrence, so that all vector updates of an iteration
are one pass over the vertices and the matrix product is the other:

    w = K u,  delta = u . w                                   multiply
    alpha = gamma / (delta - beta gamma / alpha_before)       find_alpha
    p = u + beta p, s = w + beta s, x += alpha p, r -= alpha s, u = D^-1 r, gamma = r . u      update
    beta = gamma / gamma_before                               find_beta
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.device import language
from pdipc.device.language import kernel
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear.solver import Contact, Solver
from pdipc.linear.system import System

# Slots of the array of numbers that a solve carries along.
ALPHA, BETA, GAMMA = (wp.constant(k) for k in range(3))

# A loop over all components at once, which compilers turn into wide instructions.
_ADVANCE = """
    const SCALAR* wv = (const SCALAR*)w.data;
    const SCALAR* uv = (const SCALAR*)u.data;
    SCALAR* __restrict pv = (SCALAR*)p.data;
    SCALAR* __restrict sv = (SCALAR*)s.data;
    SCALAR* __restrict xv = (SCALAR*)x.data;
    SCALAR* __restrict rv = (SCALAR*)r.data;
    for (int k = 3 * low; k < 3 * high; ++k) {
        const SCALAR direction = uv[k] + beta * pv[k];
        const SCALAR image = wv[k] + beta * sv[k];
        pv[k] = direction;
        sv[k] = image;
        xv[k] += alpha * direction;
        rv[k] -= alpha * image;
    }
"""


class Pcg(Solver):
    """Preconditioned conjugate gradients.

    steps: (max_iterations, 2) on the device, alpha and beta of each iteration of the last solve.
    """

    def __init__(self, system: System, tolerance: float, max_iterations: int):
        super().__init__(system, tolerance, max_iterations)
        vec3, scalar = self.real.vec3, self.real.scalar
        self._r, self._u, self._w, self._p, self._s = (self.zeros(vec3) for _ in range(5))
        self._numbers = self.zeros(scalar, 3)
        self.steps = wp.zeros((max_iterations, 2), dtype=scalar, device=self.device.warp)
        self._kernels = kernels(self.real)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        reference: wp.array | None = None,
        prepared: bool = False,
    ) -> None:
        apply = contact.apply if contact is not None else None
        coupled = int(apply is not None)
        k, sums = self._kernels, self.sums
        matrix = [*self.system.rows.arguments, self.held]
        status = [self.first, self.left, self.iterations, self.residual, self.condition]
        if not prepared:
            self.prepare(contact)
        if apply:
            self.clear(self._w)
            apply(x, self._w)
        self.copy(self._p, x)
        vectors = [self._w, self._s, self._r, self._u]
        sums.launch(k.start, [*matrix, *self.preconditioner, b, self._p, coupled, *vectors, self.partial])
        self.clear(self._p)
        self._precondition()
        sums.conclude(k.begin, [self.partial, sums.slots, self._numbers, reference, *self.limits, *status])

        def iterate() -> None:
            if apply:
                apply(self._u, self._w)
            sums.launch(k.multiply, [*matrix, self._u, coupled, self._w, self.partial])
            sums.conclude(k.find_alpha, [self.partial, sums.slots, self._numbers, self.left])
            self._update(x, coupled)
            sums.conclude(k.find_beta, [self.partial, sums.slots, self._numbers, self.steps, *self.limits, *status])

        self.device.loop(self.condition, iterate)

    def _precondition(self) -> None:
        """For a preconditioner that is more than the block diagonal: launches u = M^-1 r and the partial sums of gamma."""

    def _update(self, x: wp.array, coupled: int) -> None:
        """Launches one step of all vectors and the partial sums of gamma."""
        vectors = [self._w, self._p, self._s, x, self._r, self._u]
        inputs = [*self.preconditioner, self._numbers, coupled, *vectors, self.partial]
        self.sums.launch(self._kernels.update, inputs)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """The step of all vectors that needs no preconditioner, for the vertices low to high - 1."""
    scalar, vec3 = real.scalar, real.vec3

    @language.func_native(_ADVANCE.replace("SCALAR", f"wp::{real.name}"))
    def advance(
        low: int,
        high: int,
        alpha: scalar,
        beta: scalar,
        w: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        s: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
    ): ...

    return SimpleNamespace(advance=advance)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The kernels of one iteration."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    f = shared.functions(real)
    advance = functions(real).advance

    @kernel(module)
    def start(
        first: int,
        share: int,
        count: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        held: wp.array(dtype=scalar),
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        b: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        coupled: int,
        w: wp.array(dtype=vec3),
        s_out: wp.array(dtype=vec3),
        r_out: wp.array(dtype=vec3),
        u_out: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """r = b - K x, u = D^-1 r, gamma = r . u; w holds the contacts' part of K x and is left zero."""
        worker = first + wp.tid()
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            r = zero
            u = zero
            if inverse[i] != scalar(0.0):
                r = b[i] - held[i] * x[i] - f.row_difference(i, offsets, columns, values, x)
                if coupled != 0:
                    r -= w[i]
                u = f.precondition(i, inverse, inverse_block, r)
                gamma += wp.dot(r, u)
            r_out[i] = r
            u_out[i] = u
            s_out[i] = zero
            if coupled != 0:
                w[i] = zero
        f.store_sum(gamma, worker, partial_out)

    @kernel(module)
    def multiply(
        first: int,
        share: int,
        count: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        held: wp.array(dtype=scalar),
        u: wp.array(dtype=vec3),
        coupled: int,
        w: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """w = K u, where w holds the contacts' part already, and delta = u . w."""
        worker = first + wp.tid()
        delta = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            own = u[i]
            product = held[i] * own + f.row_difference(i, offsets, columns, values, u)
            if coupled != 0:
                product += w[i]
            w[i] = product
            delta += wp.dot(own, product)
        f.store_sum(delta, worker, partial_out)

    @kernel(module)
    def update(
        first: int,
        share: int,
        count: int,
        inverse: wp.array(dtype=scalar),
        inverse_block: wp.array(dtype=mat33),
        numbers: wp.array(dtype=scalar),
        coupled: int,
        w: wp.array(dtype=vec3),
        p: wp.array(dtype=vec3),
        s: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """All vectors one step on, and gamma = r . u; w is left zero where contacts will add to it."""
        worker = first + wp.tid()
        low = worker * share
        high = wp.min(low + share, count)
        advance(low, high, numbers[ALPHA], numbers[BETA], w, u, p, s, x, r)
        gamma = scalar(0.0)
        for i in range(low, high):
            residual = r[i]
            corrected = f.precondition(i, inverse, inverse_block, residual)
            u[i] = corrected
            gamma += wp.dot(residual, corrected)
            if coupled != 0:
                w[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        f.store_sum(gamma, worker, partial_out)

    @kernel(module)
    def begin(
        first: int,
        partial: wp.array(dtype=scalar),
        slots: int,
        numbers: wp.array(dtype=scalar),
        reference: wp.array(dtype=scalar),
        tolerance: scalar,
        max_iterations: int,
        first_out: wp.array(dtype=scalar),
        left_out: wp.array(dtype=wp.int32),
        iterations: wp.array(dtype=wp.int32),
        residual_out: wp.array(dtype=scalar),
        condition_out: wp.array(dtype=wp.int32),
    ):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            numbers[ALPHA] = scalar(1.0)
            numbers[BETA] = scalar(0.0)
            numbers[GAMMA] = gamma
            f.begin_status(gamma, reference, tolerance, max_iterations, first_out, left_out, residual_out, condition_out)

    @kernel(module)
    def find_alpha(
        first: int,
        partial: wp.array(dtype=scalar),
        slots: int,
        numbers: wp.array(dtype=scalar),
        left: wp.array(dtype=wp.int32),
    ):
        """alpha; where rounding has made K look indefinite, no step and the end."""
        lane = first + wp.tid()
        delta = f.sum_partials(partial, slots, lane)
        if lane == 0:
            gamma = numbers[GAMMA]
            curvature = delta - numbers[BETA] * gamma / numbers[ALPHA]
            if curvature > scalar(0.0) or wp.isnan(curvature):
                numbers[ALPHA] = gamma / curvature
            else:
                numbers[ALPHA] = scalar(0.0)
                left[0] = 1

    @kernel(module)
    def find_beta(
        first: int,
        partial: wp.array(dtype=scalar),
        slots: int,
        numbers: wp.array(dtype=scalar),
        steps_out: wp.array2d(dtype=scalar),
        tolerance: scalar,
        max_iterations: int,
        first_norm: wp.array(dtype=scalar),
        left: wp.array(dtype=wp.int32),
        iterations: wp.array(dtype=wp.int32),
        residual_out: wp.array(dtype=scalar),
        condition_out: wp.array(dtype=wp.int32),
    ):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            beta = gamma / numbers[GAMMA]
            steps_out[max_iterations - left[0], 0] = numbers[ALPHA]
            steps_out[max_iterations - left[0], 1] = beta
            numbers[BETA] = beta
            numbers[GAMMA] = gamma
            f.update_status(gamma, 1, 1, tolerance, first_norm, left, iterations, residual_out, condition_out)

    return SimpleNamespace(**locals())
