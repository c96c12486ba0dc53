"""Which bodies are near each other: an island is a set of bodies that candidate pairs, or pairs that rub, connect.

Islands do not see each other, so each can have a step length of its own: one that is jammed holds up no other. Obstacles connect nothing.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.collision.candidates import Candidates
from pdipc.device.language import filled, kernel, struct
from pdipc.device.launch import Device, Span
from pdipc.device.precision import Real

MOST = 512  # bodies; of more, all are one island


@struct
class Groups:
    """The bodies by island, as kernels take them; see `Islands`."""

    count: int  # of bodies
    body: wp.array[wp.int32]
    label: wp.array[wp.int32]
    driven: wp.array[wp.int32]


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    vec3 = real.vec3
    zero = wp.constant(real.scalar(0.0))
    module = real.module(__name__)

    @kernel(module)
    def clear(first: int, near_out: wp.array(dtype=wp.int32)):
        near_out[first + wp.tid()] = 0

    @kernel(module)
    def connect(
        span: Span,
        count: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.vec4i),
        island_of: wp.array(dtype=wp.int32),
        bodies: int,
        near_out: wp.array(dtype=wp.int32),
    ):
        """near[a, b] = 1 for the bodies of every pair; whoever writes, writes the same."""
        worker = span.first + wp.tid()
        for begin in range(worker * span.block, count[0], span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, count[0])):
                a = island_of[quads[k][0]]
                b = island_of[quads[k][3]]
                if a != b and a >= 0 and b >= 0:
                    near_out[wp.max(a, b) * bodies + wp.min(a, b)] = 1

    @kernel(module)
    def label(
        first: int,
        bodies: int,
        fixed: wp.array(dtype=wp.int32),
        near: wp.array(dtype=wp.int32),
        label_out: wp.array(dtype=wp.int32),
        renewed_out: wp.array(dtype=wp.int32),
    ):
        """The least body of each body's island; fixed: what attachments join from the start."""
        renewed_out[0] = 0
        for a in range(bodies):
            label_out[a] = fixed[a]
        for _ in range(bodies):  # as many as a chain of all of them takes
            changed = int(0)
            for a in range(bodies):
                least = wp.min(label_out[a], label_out[fixed[a]])
                if label_out[fixed[a]] != label_out[a]:
                    changed += 1
                label_out[fixed[a]] = least
                label_out[a] = least
                for b in range(a):
                    if near[a * bodies + b] == 1 and label_out[a] != label_out[b]:
                        low = wp.min(label_out[a], label_out[b])
                        label_out[a] = low
                        label_out[b] = low
                        changed += 1
            if changed == 0:
                break

    @kernel(module)
    def mark_driven(
        span: Span,
        count: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.vec4i),
        island_of: wp.array(dtype=wp.int32),
        u: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        driven_out: wp.array(dtype=wp.int32),
    ):
        """Bodies of pairs whose other side is an obstacle that moves."""
        worker = span.first + wp.tid()
        for begin in range(worker * span.block, count[0], span.step * span.block):
            for k in range(begin, wp.min(begin + span.block, count[0])):
                p = quads[k][0]
                q = quads[k][3]
                a = island_of[p]
                b = island_of[q]
                if a < 0 and b >= 0 and wp.length_sq(u_tilde[p] - u[p]) > zero:
                    driven_out[b] = 1
                if b < 0 and a >= 0 and wp.length_sq(u_tilde[q] - u[q]) > zero:
                    driven_out[a] = 1

    @kernel(module)
    def mark_pinned(
        first: int,
        pinned: wp.array(dtype=wp.vec2i),
        u: wp.array(dtype=vec3),
        u_tilde: wp.array(dtype=vec3),
        driven_out: wp.array(dtype=wp.int32),
    ):
        """Bodies that a scripted vertex moves: one of their own, or one of an obstacle that they are attached to."""
        i = first + wp.tid()
        v = pinned[i][0]
        if wp.length_sq(u_tilde[v] - u[v]) > zero:
            driven_out[pinned[i][1]] = 1

    return SimpleNamespace(clear=clear, connect=connect, label=label, mark_driven=mark_driven, mark_pinned=mark_pinned)


class Islands:
    """body: (n,) int32, the simulated body of each vertex, -1 for obstacles. label: (bodies,) the island of each body, named by its first body.
    driven: (bodies,) whether something that follows a script moves the body in this outer iteration. groups: all these as kernels take them.

    beside: what else has pairs, each with `count`, `quads` and `capacity`: friction, whose pairs were near where the step started.
    ranges: (first, last) vertices of each simulated body; joined: (k, 2) bodies that attachments join; pinned: (k, 2) scripted
    vertices and the simulated bodies that they move: their own, or those attached to them.
    """

    def __init__(
        self,
        device: Device,
        real: Real,
        n: int,
        ranges: list[tuple[int, int]],
        joined: np.ndarray,
        pinned: np.ndarray,
    ):
        self.device, self.real, self.count, self.ranges = device, real, len(ranges), ranges
        of = np.full(n, -1, dtype=np.int32)
        for body, (first, last) in enumerate(ranges):
            of[first:last] = body
        fixed = np.arange(self.count)
        for _ in range(self.count):
            for a, b in joined:
                fixed[[a, b]] = min(fixed[a], fixed[b])
        self.together = self.count > MOST
        if self.together:
            fixed[:] = 0

        def upload(values: np.ndarray) -> wp.array:
            return wp.array(np.append(values, 0).astype(np.int32), dtype=wp.int32, device=device.warp)

        self.body, self._fixed, self.label = upload(of), upload(fixed), upload(fixed)
        self._pinned = wp.array(pinned.reshape(-1, 2).astype(np.int32), dtype=wp.vec2i, device=device.warp)
        self._pinned_count = len(pinned)
        size = 1 if self.together else max(1, self.count**2)
        self._near = wp.zeros(size, dtype=wp.int32, device=device.warp)
        self.driven = wp.zeros(max(1, self.count), dtype=wp.int32, device=device.warp)
        self.groups = filled(Groups, self)
        self.beside: list = []
        self._kernels = kernels(real)

    def find(self, candidates: Candidates) -> None:
        """Launches the islands of the listed pairs."""
        if self.count < 2 or self.together:
            return
        k, device = self._kernels, self.device
        device.launch(k.clear, self.count**2, [self._near])
        for c in [*candidates.lists, *self.beside]:
            device.launch_list(k.connect, c.capacity, [c.count, c.quads, self.body, self.count, self._near])
        device.launch_serial(k.label, [self.count, self._fixed, self._near, self.label, candidates.renewed])

    def renew(self, candidates: Candidates) -> None:
        """Launches the islands where pairs were listed since they were found."""
        if self.count >= 2 and not self.together:
            self.device.when(candidates.renewed, lambda: self.find(candidates))

    def find_driven(self, candidates: Candidates, u: wp.array, u_tilde: wp.array) -> None:
        """Launches `driven` for the motion u -> u_tilde."""
        k, device = self._kernels, self.device
        device.launch(k.clear, max(1, self.count), [self.driven])
        for c in [*candidates.lists, *self.beside]:
            device.launch_list(k.mark_driven, c.capacity, [c.count, c.quads, self.body, u, u_tilde, self.driven])
        if self._pinned_count:
            device.launch(k.mark_pinned, self._pinned_count, [self._pinned, u, u_tilde, self.driven])
