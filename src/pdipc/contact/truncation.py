"""Truncation of the motion x -> x~ so that nothing meets (Algorithm 1, lines 13 to 15), vertex by vertex.

Every pass runs conservative CCD on the linear motion from x to the float positions that would be committed. Vertices of pairs
that meet are shortened by the pair's time, and the pass is repeated with a smaller back-off until one finds no hit: that pass
proves the positions that are committed. Shortened motions stay inside the swept boxes, so the candidate list stays complete.

The paper truncates every vertex by the one smallest time (`per_vertex=False`): correct, but one collision anywhere then
drags every body of the scene (docs/paper_map.md).
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.contact import ccd
from pdipc.contact.candidates import Candidates
from pdipc.parallel import Device
from pdipc.precision import Real

BLOCK = 32
UNIT = 1 << 30  # times are kept as integers over this unit, rounded down: the least of several is then exact and race-free
FIRST_BACKOFF = 0.2  # of the gap stays, in the first pass
LATER_BACKOFF = 0.1  # in the passes that check shortened motions
SHRINK = 0.9
MAX_PASSES = 30


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec2, vec3 = real.scalar, real.vec2, real.vec3
    module = real.module(__name__)
    # The cubic's verdict "no root" spares pairs that slide along each other with a tiny gap: there, separating directions
    # advance by about gap / speed, run into their cap, and would report a meeting that is none.
    c = ccd.variant(real, cubic="filter")
    block = wp.constant(BLOCK)
    unit = wp.constant(UNIT)

    def sweep(edge_edge: bool):
        @wp.kernel(module=module)
        def kernel(
            first: int,
            x: wp.array(dtype=vec3),
            x_end: wp.array(dtype=vec3),
            fraction: wp.array(dtype=scalar),
            only_shortened: int,
            backoff: scalar,
            quads: wp.array(dtype=wp.vec4i),
            limits: wp.array(dtype=vec2),
            count: int,
            time_out: wp.array(dtype=wp.int32),
            hits_out: wp.array(dtype=wp.int32),
        ):
            b = first + wp.tid()
            hits = int(0)
            for k in range(b * block, wp.min((b + 1) * block, count)):
                q = quads[k]
                time = unit
                shortest = wp.min(wp.min(fraction[q[0]], fraction[q[1]]), wp.min(fraction[q[2]], fraction[q[3]]))
                if only_shortened == 0 or shortest < scalar(1.0):
                    xi = limits[k][0]
                    t = scalar(2.0)
                    if wp.static(edge_edge):
                        t = c.edge_edge(
                            x[q[0]], x[q[1]], x[q[2]], x[q[3]],
                            x_end[q[0]], x_end[q[1]], x_end[q[2]], x_end[q[3]], xi, backoff, limits[k][1],
                        )  # fmt: skip
                    else:
                        t = c.vertex_triangle(
                            x[q[0]], x[q[1]], x[q[2]], x[q[3]],
                            x_end[q[0]], x_end[q[1]], x_end[q[2]], x_end[q[3]], xi, backoff, limits[k][1],
                        )  # fmt: skip
                    if t <= scalar(1.0):
                        time = wp.int32(wp.floor(t * scalar(unit) * scalar(0.999999)))
                        hits += 1
                time_out[k] = time
            hits_out[b] = hits

        return kernel

    @wp.kernel(module=module)
    def reset(first: int, multiplier_out: wp.array(dtype=wp.int32)):
        multiplier_out[first + wp.tid()] = unit

    @wp.kernel(module=module)
    def spread(
        first: int,
        quads: wp.array(dtype=wp.vec4i),
        times: wp.array(dtype=wp.int32),
        hits: wp.array(dtype=wp.int32),
        count: int,
        multiplier: wp.array(dtype=wp.int32),
    ):
        b = first + wp.tid()
        if hits[b] > 0:
            for k in range(b * block, wp.min((b + 1) * block, count)):
                if times[k] < unit:
                    for s in range(4):
                        wp.atomic_min(multiplier, quads[k][s], times[k])

    @wp.kernel(module=module)
    def together(first: int, begin: wp.array(dtype=int), end: wp.array(dtype=int), multiplier: wp.array(dtype=wp.int32)):
        """Vertices of a rigid obstacle keep one time, so that it stays rigid."""
        r = first + wp.tid()
        least = unit
        for i in range(begin[r], end[r]):
            least = wp.min(least, multiplier[i])
        for i in range(begin[r], end[r]):
            multiplier[i] = least

    @wp.kernel(module=module)
    def shorten(
        first: int,
        multiplier: wp.array(dtype=wp.int32),
        shrink: scalar,
        x: wp.array(dtype=vec3),
        x_tilde: wp.array(dtype=vec3),
        fraction: wp.array(dtype=scalar),
        x_end_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        if multiplier[i] < unit:
            fraction[i] = fraction[i] * shrink * scalar(multiplier[i]) / scalar(unit)
            x_end_out[i] = x[i] + fraction[i] * (x_tilde[i] - x[i])

    @wp.kernel(module=module)
    def begin_pass(
        first: int, x_tilde: wp.array(dtype=vec3), fraction_out: wp.array(dtype=scalar), x_end_out: wp.array(dtype=vec3)
    ):
        i = first + wp.tid()
        fraction_out[i] = scalar(1.0)
        x_end_out[i] = x_tilde[i]

    return SimpleNamespace(
        sweep_vertex_triangle=sweep(False),
        sweep_edge_edge=sweep(True),
        reset=reset,
        spread=spread,
        together=together,
        shorten=shorten,
        begin_pass=begin_pass,
    )


class Truncation:
    """Finds x_end between x and x~, vertex by vertex, such that no candidate pair meets on the way.

    rigid: (first, last) vertex ranges of obstacles that must stay rigid. x_end: (n,) vec3, the result.
    """

    def __init__(self, device: Device, real: Real, n: int, rigid: list[tuple[int, int]], per_vertex: bool = True):
        self.device, self.real, self.n, self.per_vertex = device, real, n, per_vertex
        self.kernels = kernels(real)
        self.multiplier = wp.zeros(n, dtype=wp.int32, device=device.warp)
        self.fraction = wp.zeros(n, dtype=real.scalar, device=device.warp)
        self.x_end = wp.zeros(n, dtype=real.vec3, device=device.warp)
        ranges = rigid if per_vertex else [(0, n)]
        self.rigid_begin = wp.array(np.array([first for first, _ in ranges], dtype=np.int32), device=device.warp)
        self.rigid_end = wp.array(np.array([last for _, last in ranges], dtype=np.int32), device=device.warp)
        self._buffers = {kind: self._allocate(1024) for kind in ("vertex_triangle", "edge_edge")}

    def _allocate(self, size: int) -> SimpleNamespace:
        return SimpleNamespace(
            size=size,
            times=wp.zeros(size, dtype=wp.int32, device=self.device.warp),
            hits=wp.zeros(-(-size // BLOCK), dtype=wp.int32, device=self.device.warp),
        )

    def truncate(self, candidates: Candidates, x: wp.array, x_tilde: wp.array) -> int:
        """Fills x_end. Returns the number of passes that found hits: 0 where the whole motion is free."""
        k, device, n = self.kernels, self.device, self.n
        device.launch(k.begin_pass, n, [x_tilde, self.fraction, self.x_end])
        for done in range(MAX_PASSES + 1):
            if not self._sweep(candidates, x, done):
                return done
            shrink = 1.0 if done == 0 else SHRINK
            if len(self.rigid_begin):
                device.launch(k.together, len(self.rigid_begin), [self.rigid_begin, self.rigid_end, self.multiplier])
            device.launch(k.shorten, n, [self.multiplier, self.real.scalar(shrink), x, x_tilde, self.fraction, self.x_end])
        # Not settled: nobody moves. Always feasible, and the next outer iteration starts from a stronger barrier.
        wp.copy(self.x_end, x)
        self.fraction.zero_()
        return MAX_PASSES + 1

    def _sweep(self, candidates: Candidates, x: wp.array, done: int) -> bool:
        """One pass of CCD from x to x_end; sets the multipliers. Returns whether any pair meets."""
        k, device = self.kernels, self.device
        backoff = FIRST_BACKOFF if done == 0 else LATER_BACKOFF
        device.launch(k.reset, self.n, [self.multiplier])
        any_hit = False
        for kind in ("vertex_triangle", "edge_edge"):
            quads, limits = getattr(candidates, f"{kind}_quads"), getattr(candidates, f"{kind}_limits")
            count = getattr(candidates, f"{kind}_count")
            if count == 0:
                continue
            if count > self._buffers[kind].size:
                self._buffers[kind] = self._allocate(len(quads))
            buffers = self._buffers[kind]
            blocks = -(-count // BLOCK)
            inputs = [x, self.x_end, self.fraction, int(done > 0), self.real.scalar(backoff), quads, limits, count]
            device.launch(getattr(k, f"sweep_{kind}"), blocks, [*inputs, buffers.times, buffers.hits], grain=BLOCK * 8)
            if int(buffers.hits[:blocks].numpy().max()) > 0:
                any_hit = True
                inputs = [0, quads, buffers.times, buffers.hits, count, self.multiplier]
                wp.launch(k.spread, dim=blocks, inputs=inputs, device=device.warp)
        return any_hit
