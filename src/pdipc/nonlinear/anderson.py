"""Anderson acceleration of the local-global iterations.

An iteration maps the iterate x~ to g(x~) = x~ + f(x~), where f is the increment of the global step. Alone it converges
linearly, slowly for stiff cloth. From the last m increments, acceleration takes the combination whose increment would be
least, theta = argmin |f_k - sum_j theta_j df_j|, and goes on from x~ = g_k - sum_j theta_j dg_j (Walker and Ni 2011). The paper
names it as future work (Section 8). The fixed points are the same.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.device.language import filled, kernel, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real

MEMORY = 8  # increments that are kept
BLOCK = 128  # vertices that one worker handles
GROWTH = 4.0  # history is dropped when the squared increment grew by more than this
REGULARIZATION = 1.0e-10  # of the trace, added to the normal equations


# sums of one pass: df_new . df_j, then df_j . f, then f . f; and the largest |f|
sums = wp.types.vector(2 * MEMORY + 2, wp.float64)
small = wp.types.vector(MEMORY, wp.float64)
square = wp.types.matrix((MEMORY, MEMORY), wp.float64)


@functools.cache
def history(real: Real) -> Any:
    """A struct: the last iterations, and how the loop stands. Arrays without a shape have one entry."""
    return struct_of(
        "History",
        __name__,
        f_last=wp.array(dtype=real.vec3),  # (n,) the last increment, m, and
        g_last=wp.array(dtype=real.vec3),  # where it led
        df=wp.array2d(dtype=real.vec3),  # (MEMORY, n) their changes
        dg=wp.array2d(dtype=real.vec3),
        gram=wp.array(dtype=square),  # df_i . df_j
        theta=wp.array(dtype=small),
        norms=wp.array(dtype=wp.float64),  # (2,) |f|^2 of the last increment; largest |f| of the first
        fresh=wp.array(dtype=wp.int32),  # whether none was seen in this loop
        known=wp.array(dtype=wp.int32),  # increments seen since the history was last dropped
        left=wp.array(dtype=wp.int32),  # iterations
        done=wp.array(dtype=wp.int32),
        going=wp.array(dtype=wp.int32),
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, History = real.scalar, real.vec3, history(real)
    module = real.module(__name__)
    memory, block = wp.constant(MEMORY), wp.constant(BLOCK)

    @kernel(module)
    def begin(first: int, iterations: int, o: History):
        o.fresh[0] = 1
        o.known[0] = 0
        o.left[0] = iterations
        o.going[0] = 1

    @kernel(module)
    def push(
        first: int,
        count: int,
        o: History,
        increment: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        x_tilde: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=sums),
    ):
        b = first + wp.tid()
        total = sums()
        seen = o.known[0]
        slot = (seen - 1) % memory
        held = wp.min(seen, memory)
        for i in range(b * block, wp.min((b + 1) * block, count)):
            f = free[i] * increment[i]
            g = x_tilde[i] + f
            if seen > 0:
                d = f - o.f_last[i]
                o.df[slot, i] = d
                o.dg[slot, i] = g - o.g_last[i]
                for j in range(memory):
                    if j < held:
                        other = o.df[j, i]
                        total[j] += wp.float64(wp.dot(d, other))
                        total[memory + j] += wp.float64(wp.dot(other, f))
            o.f_last[i] = f
            o.g_last[i] = g
            squared = wp.float64(wp.dot(f, f))
            total[2 * memory] += squared
            # written so that NaN is not lost
            if not (squared <= total[2 * memory + 1]):
                total[2 * memory + 1] = squared
        partial_out[b] = total

    @kernel(module)
    def mix(
        first: int,
        partial: wp.array(dtype=sums),
        blocks: int,
        tolerance: scalar,
        relative_tolerance: scalar,
        o: History,
    ):
        """Solves for theta and decides whether to go on."""
        total = sums()
        largest = wp.float64(0.0)
        for b in range(blocks):
            p = partial[b]
            total += p
            if not (p[2 * memory + 1] <= largest):
                largest = p[2 * memory + 1]
        squared = total[2 * memory]
        moved = wp.sqrt(largest)
        seen = o.known[0]
        if o.fresh[0] == 1:
            o.fresh[0] = 0
            o.norms[1] = moved
        o.done[0] = o.done[0] + 1
        o.left[0] = o.left[0] - 1
        theta = small()
        stop = o.left[0] <= 0 or not (moved > wp.float64(tolerance)) or moved <= wp.float64(relative_tolerance) * o.norms[1]
        if seen > 0:
            a = o.gram[0]
            slot = (seen - 1) % memory
            held = wp.min(seen, memory)
            for j in range(memory):
                a[slot, j] = total[j]
                a[j, slot] = total[j]
            o.gram[0] = a
            if squared > wp.float64(GROWTH) * o.norms[0]:
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
        o.norms[0] = squared
        o.known[0] = seen + 1
        o.theta[0] = theta
        if stop:
            o.going[0] = 0

    @kernel(module)
    def combine(first: int, o: History, x_tilde_out: wp.array(dtype=vec3)):
        i = first + wp.tid()
        x = o.g_last[i]
        held = wp.min(o.known[0] - 1, memory)
        weights = o.theta[0]
        for j in range(held):
            x -= scalar(weights[j]) * o.dg[j, i]
        x_tilde_out[i] = x

    return SimpleNamespace(begin=begin, push=push, mix=mix, combine=combine)


class Anderson:
    """The loop of local-global iterations and its acceleration; everything stays on the device and is recordable.

    going: (1,) int32, nonzero while the loop goes on. done: (1,) int32, iterations since the caller last set it to zero.

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
        self.partial = zeros(sums, self.blocks)
        self.gram, self.theta = zeros(square), zeros(small)
        self.norms = zeros(wp.float64, 2)
        self.fresh, self.known, self.left, self.done, self.going = (zeros(wp.int32) for _ in range(5))
        self.history = filled(history(real), self)

    def begin(self, iterations: int) -> None:
        """Launches the start of a loop of at most so many iterations, without history."""
        self.device.launch_serial(self.kernels.begin, [iterations, self.history])

    def advance(self, x_tilde: wp.array, increment: wp.array, free: wp.array) -> None:
        """Launches the update of x~ by the global step's increment, accelerated, and the decision whether to go on."""
        k, device = self.kernels, self.device
        inputs = [self.count, self.history, increment, free, x_tilde, self.partial]
        device.launch(k.push, self.blocks, inputs, grain=BLOCK)
        device.launch_serial(k.mix, [self.partial, self.blocks, *self.limits, self.history])
        device.launch(k.combine, self.count, [self.history, x_tilde])
