"""Anderson acceleration of the local-global iterations.

An iteration maps the iterate x~ to g(x~) = x~ + f(x~), where f is the increment of the global step. Alone it converges
linearly, slowly for stiff cloth. From the last m increments, acceleration takes the combination whose increment would be
least, theta = argmin |f_k - sum_j theta_j df_j|, and goes on from x~ = g_k - sum_j theta_j dg_j (Walker and Ni 2011). The paper
names it as future work (Section 8). The fixed points are the same.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real

MEMORY = 8  # increments that are kept
BLOCK = 128  # vertices that one worker handles
GROWTH = 4.0  # history is dropped when the squared increment grew by more than this
REGULARIZATION = 1.0e-10  # of the trace, added to the normal equations


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)
    memory, block = wp.constant(MEMORY), wp.constant(BLOCK)
    # sums of one pass: df_new . df_j, then df_j . f, then f . f; and the largest |f|
    sums = wp.types.vector(2 * MEMORY + 2, wp.float64)
    small = wp.types.vector(MEMORY, wp.float64)
    square = wp.types.matrix((MEMORY, MEMORY), wp.float64)

    @kernel(module)
    def begin(
        first: int,
        iterations: int,
        fresh_out: wp.array(dtype=wp.int32),
        known_out: wp.array(dtype=wp.int32),
        left_out: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        fresh_out[0] = 1
        known_out[0] = 0  # increments seen since the history was last dropped
        left_out[0] = iterations
        going_out[0] = 1

    @kernel(module)
    def push(
        first: int,
        count: int,
        known: wp.array(dtype=wp.int32),
        increment: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        x_tilde: wp.array(dtype=vec3),
        f_last: wp.array(dtype=vec3),
        g_last: wp.array(dtype=vec3),
        df: wp.array2d(dtype=vec3),
        dg: wp.array2d(dtype=vec3),
        partial_out: wp.array(dtype=sums),
    ):
        b = first + wp.tid()
        total = sums()
        seen = known[0]
        slot = (seen - 1) % memory
        held = wp.min(seen, memory)
        for i in range(b * block, wp.min((b + 1) * block, count)):
            f = free[i] * increment[i]
            g = x_tilde[i] + f
            if seen > 0:
                d = f - f_last[i]
                df[slot, i] = d
                dg[slot, i] = g - g_last[i]
                for j in range(memory):
                    if j < held:
                        other = df[j, i]
                        total[j] += wp.float64(wp.dot(d, other))
                        total[memory + j] += wp.float64(wp.dot(other, f))
            f_last[i] = f
            g_last[i] = g
            squared = wp.float64(wp.dot(f, f))
            total[2 * memory] += squared
            # written so that NaN is not lost
            if not (squared <= total[2 * memory + 1]):
                total[2 * memory + 1] = squared
        partial_out[b] = total

    # Long: one thread's bookkeeping and a small system, solved in place.
    @kernel(module)
    def mix(
        first: int,
        partial: wp.array(dtype=sums),
        blocks: int,
        tolerance: scalar,
        relative_tolerance: scalar,
        gram: wp.array(dtype=square),
        theta_out: wp.array(dtype=small),
        norms: wp.array(dtype=wp.float64),
        moved_out: wp.array(dtype=scalar),
        fresh: wp.array(dtype=wp.int32),
        known: wp.array(dtype=wp.int32),
        left: wp.array(dtype=wp.int32),
        done: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        """Solves for theta and decides whether to go on. norms: |f|^2 of the last increment; largest |f| of the first."""
        total = sums()
        largest = wp.float64(0.0)
        for b in range(blocks):
            p = partial[b]
            total += p
            if not (p[2 * memory + 1] <= largest):
                largest = p[2 * memory + 1]
        squared = total[2 * memory]
        moved = wp.sqrt(largest)
        seen = known[0]
        if fresh[0] == 1:
            fresh[0] = 0
            norms[1] = moved
        done[0] = done[0] + 1
        left[0] = left[0] - 1
        moved_out[0] = scalar(moved)
        theta = small()
        stop = left[0] <= 0 or not (moved > wp.float64(tolerance)) or moved <= wp.float64(relative_tolerance) * norms[1]
        if seen > 0:
            a = gram[0]
            slot = (seen - 1) % memory
            held = wp.min(seen, memory)
            for j in range(memory):
                a[slot, j] = total[j]
                a[j, slot] = total[j]
            gram[0] = a
            if squared > wp.float64(GROWTH) * norms[0]:
                seen = 0
            elif not stop:
                # Cholesky of the normal equations; a direction that adds nothing new gets no part
                shift = wp.float64(0.0)
                for j in range(memory):
                    if j < held:
                        shift += a[j, j]
                shift *= wp.float64(REGULARIZATION)
                low = square()
                y = small()
                for i in range(memory):
                    if i < held:
                        for j in range(i + 1):
                            s = a[i, j]
                            if i == j:
                                s += shift
                            for k in range(j):
                                s -= low[i, k] * low[j, k]
                            if i == j:
                                low[i, i] = wp.sqrt(wp.max(s, shift + wp.float64(1.0e-300)))
                            else:
                                low[i, j] = s / low[j, j]
                        s = total[memory + i]
                        for k in range(i):
                            s -= low[i, k] * y[k]
                        y[i] = s / low[i, i]
                for back in range(memory):
                    i = memory - 1 - back
                    if i < held:
                        s = y[i]
                        for k in range(i + 1, memory):
                            if k < held:
                                s -= low[k, i] * theta[k]
                        theta[i] = s / low[i, i]
        norms[0] = squared
        known[0] = seen + 1
        theta_out[0] = theta
        if stop:
            going_out[0] = 0

    @kernel(module)
    def combine(
        first: int,
        known: wp.array(dtype=wp.int32),
        theta: wp.array(dtype=small),
        g: wp.array(dtype=vec3),
        dg: wp.array2d(dtype=vec3),
        x_tilde_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        x = g[i]
        held = wp.min(known[0] - 1, memory)
        weights = theta[0]
        for j in range(held):
            x -= scalar(weights[j]) * dg[j, i]
        x_tilde_out[i] = x

    return SimpleNamespace(begin=begin, push=push, mix=mix, combine=combine, sums=sums, small=small, square=square)


class Anderson:
    """The loop of local-global iterations and its acceleration; everything stays on the device and is recordable.

    going: (1,) int32, nonzero while the loop goes on. done: (1,) int32, iterations since the caller last set it to zero.
    moved: (1,) m, the largest motion of a vertex in the last iteration's increment.

    The loop ends at its cap of iterations, or once no vertex moves by more than `tolerance` (m), or by more than
    `relative_tolerance` of what it moved in the first iteration.
    """

    def __init__(self, device: Device, real: Real, count: int, tolerance: float, relative_tolerance: float):
        self.device, self.real, self.count, self.kernels = device, real, count, kernels(real)
        self.limits = [real.scalar(tolerance), real.scalar(relative_tolerance)]
        self.blocks = max(1, -(-count // BLOCK))

        def zeros(dtype, shape: int | tuple[int, int] = 1):
            return wp.zeros(shape, dtype=dtype, device=device.warp)

        self.f_last, self.g_last = zeros(real.vec3, count), zeros(real.vec3, count)
        self.df, self.dg = zeros(real.vec3, (MEMORY, count)), zeros(real.vec3, (MEMORY, count))
        self.partial = zeros(self.kernels.sums, self.blocks)
        self.gram, self.theta = zeros(self.kernels.square), zeros(self.kernels.small)
        self.norms, self.moved = zeros(wp.float64, 2), zeros(real.scalar)
        self.fresh, self.known, self.left, self.done, self.going = (zeros(wp.int32) for _ in range(5))

    def begin(self, iterations: int) -> None:
        """Launches the start of a loop of at most so many iterations, without history."""
        self.device.launch_serial(self.kernels.begin, [iterations, self.fresh, self.known, self.left, self.going])

    def advance(self, x_tilde: wp.array, increment: wp.array, free: wp.array) -> None:
        """Launches the update of x~ by the global step's increment, accelerated, and the decision whether to go on."""
        k, device = self.kernels, self.device
        history = [self.f_last, self.g_last, self.df, self.dg]
        device.launch(
            k.push, self.blocks, [self.count, self.known, increment, free, x_tilde, *history, self.partial], grain=BLOCK
        )
        counters = [self.fresh, self.known, self.left, self.done, self.going]
        device.launch_serial(
            k.mix, [self.partial, self.blocks, *self.limits, self.gram, self.theta, self.norms, self.moved, *counters]
        )
        device.launch(k.combine, self.count, [self.known, self.theta, self.g_last, self.dg, x_tilde])
