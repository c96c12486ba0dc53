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
from typing import Any

import warp as wp

from pdipc.device import language
from pdipc.device.language import filled, kernel, struct_of
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear.solver import Contact, Solver
from pdipc.linear.system import System

# Slots of the array of numbers that a solve carries along.
ALPHA, BETA, GAMMA = (wp.constant(k) for k in range(3))

# A loop over all components at once, which compilers turn into wide instructions.
_ADVANCE = """
    const SCALAR* wv = (const SCALAR*)v.w.data;
    const SCALAR* uv = (const SCALAR*)v.u.data;
    SCALAR* __restrict pv = (SCALAR*)v.p.data;
    SCALAR* __restrict sv = (SCALAR*)v.s.data;
    SCALAR* __restrict xv = (SCALAR*)x.data;
    SCALAR* __restrict rv = (SCALAR*)v.r.data;
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
        self.r, self.u, self.w, self.p, self.s = (self.zeros(vec3) for _ in range(5))
        self.vectors = filled(vectors(self.real), self)
        self._numbers = self.zeros(scalar, 3)
        self.steps = wp.zeros((max_iterations, 2), dtype=scalar, device=self.device.warp)
        self._kernels = kernels(self.real)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        apply = contact.apply if contact is not None else None
        coupled = int(apply is not None)
        k, sums = self._kernels, self.sums
        equation, status = self.equation(b), self.status
        if not prepared:
            self.prepare(contact)
        if apply:
            self.clear(self.w)
            apply(x, self.w)
        self.copy(self.p, x)
        sums.launch(k.start, [equation, coupled, self.vectors, self.partial])
        self.clear(self.p)
        self._precondition(equation)
        sums.conclude(k.begin, [self.partial, sums.slots, self._numbers, status])

        def iterate() -> None:
            if apply:
                apply(self.u, self.w)
            sums.launch(k.multiply, [equation, coupled, self.vectors, self.partial])
            sums.conclude(k.find_alpha, [self.partial, sums.slots, self._numbers, self.left])
            self._update(equation, x, coupled)
            sums.conclude(k.find_beta, [self.partial, sums.slots, self._numbers, self.steps, status])

        self.device.loop(self.condition, iterate)

    def _precondition(self, equation: Any) -> None:
        """For a preconditioner that is more than the block diagonal: launches u = M^-1 r and the partial sums of gamma."""

    def _update(self, equation: Any, x: wp.array, coupled: int) -> None:
        """Launches one step of all vectors and the partial sums of gamma."""
        self.sums.launch(self._kernels.update, [equation, self._numbers, coupled, self.vectors, x, self.partial])


@functools.cache
def vectors(real: Real) -> Any:
    """A struct: the vectors of the solve but x, as at the top."""
    return struct_of("Vectors", __name__, **{name: wp.array(dtype=real.vec3) for name in ("r", "u", "w", "p", "s")})


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """The step of all vectors that needs no preconditioner, for the vertices low to high - 1."""
    scalar, vec3, Vectors = real.scalar, real.vec3, vectors(real)

    @language.func_native(_ADVANCE.replace("SCALAR", f"wp::{real.name}"))
    def advance(low: int, high: int, alpha: scalar, beta: scalar, v: Vectors, x: wp.array(dtype=vec3)): ...

    return SimpleNamespace(advance=advance)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """The kernels of one iteration."""
    scalar, vec3 = real.scalar, real.vec3
    Equation, Status, Vectors = shared.equation(real), shared.status(real), vectors(real)
    module = real.module(__name__)
    f = shared.functions(real)
    advance = functions(real).advance

    @kernel(module)
    def start(
        first: int,
        share: int,
        count: int,
        k: Equation,
        coupled: int,
        v: Vectors,
        partial_out: wp.array(dtype=scalar),
    ):
        """r = b - K x, u = D^-1 r, gamma = r . u; p holds x, and w the contacts' part of K x, which is left zero."""
        worker = first + wp.tid()
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            r = zero
            u = zero
            if k.inverse[i] != scalar(0.0):
                r = k.b[i] - k.held[i] * v.p[i] - f.row_difference(i, k.rows, v.p)
                if coupled != 0:
                    r -= v.w[i]
                u = f.precondition(i, k, r)
                gamma += wp.dot(r, u)
            v.r[i] = r
            v.u[i] = u
            v.s[i] = zero
            if coupled != 0:
                v.w[i] = zero
        f.store_sum(gamma, worker, partial_out)

    @kernel(module)
    def multiply(
        first: int,
        share: int,
        count: int,
        k: Equation,
        coupled: int,
        v: Vectors,
        partial_out: wp.array(dtype=scalar),
    ):
        """w = K u, where w holds the contacts' part already, and delta = u . w."""
        worker = first + wp.tid()
        delta = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            own = v.u[i]
            product = k.held[i] * own + f.row_difference(i, k.rows, v.u)
            if coupled != 0:
                product += v.w[i]
            v.w[i] = product
            delta += wp.dot(own, product)
        f.store_sum(delta, worker, partial_out)

    @kernel(module)
    def update(
        first: int,
        share: int,
        count: int,
        k: Equation,
        numbers: wp.array(dtype=scalar),
        coupled: int,
        v: Vectors,
        x: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """All vectors one step on, and gamma = r . u; w is left zero where contacts will add to it."""
        worker = first + wp.tid()
        low = worker * share
        high = wp.min(low + share, count)
        advance(low, high, numbers[ALPHA], numbers[BETA], v, x)
        gamma = scalar(0.0)
        for i in range(low, high):
            residual = v.r[i]
            corrected = f.precondition(i, k, residual)
            v.u[i] = corrected
            gamma += wp.dot(residual, corrected)
            if coupled != 0:
                v.w[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        f.store_sum(gamma, worker, partial_out)

    @kernel(module)
    def begin(first: int, partial: wp.array(dtype=scalar), slots: int, numbers: wp.array(dtype=scalar), status: Status):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            numbers[ALPHA] = scalar(1.0)
            numbers[BETA] = scalar(0.0)
            numbers[GAMMA] = gamma
            f.begin_status(gamma, status)

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
        status: Status,
    ):
        lane = first + wp.tid()
        gamma = f.sum_partials(partial, slots, lane)
        if lane == 0:
            beta = gamma / numbers[GAMMA]
            steps_out[status.max_iterations - status.left[0], 0] = numbers[ALPHA]
            steps_out[status.max_iterations - status.left[0], 1] = beta
            numbers[BETA] = beta
            numbers[GAMMA] = gamma
            f.update_status(gamma, 1, 1, status)

    return SimpleNamespace(
        start=start, multiply=multiply, update=update, begin=begin, find_alpha=find_alpha, find_beta=find_beta
    )
