"""Bodies that move as four points do: the unknowns of a solve are those of the points, and the other vertices follow.

With J from the points to all vertices, what is solved is J^T K J q = J^T b. A vector over the vertices belongs to motions where the followers are
those of J (`expand`), and to forces where they have been given to the points (`fold`), and are zero. Between the two K is applied as it is, contacts
and attachments of the followers with it.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real

CHUNK = 64  # followers whose forces are added up by one worker


@dataclass(frozen=True)
class Follower:
    """Vertices (k,) that follow the four points `handles` (4,) with weights (k, 4), which add up to 1 in each row."""

    handles: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray

    @property
    def all(self) -> np.ndarray:
        """(k + 4,): vertices and points."""
        return np.concatenate([self.vertices, self.handles])


class AffineBodies:
    """The followers of all bodies on the device. bodies: what was given. diagonal: (n,) 3x3 blocks, what `fold_diagonal` fills at the points."""

    def __init__(self, device: Device, real: Real, n: int, bodies: list[Follower]):
        self.device, self.bodies, self.kernels = device, bodies, kernels(real)
        counts = [len(body.vertices) for body in bodies]
        chunks = [np.append(np.arange(0, count, CHUNK), count) for count in counts]
        first = np.cumsum([0, *counts])
        begins = np.concatenate([at + chunk[:-1] for at, chunk in zip(first, chunks, strict=False)])
        ends = np.concatenate([at + chunk[1:] for at, chunk in zip(first, chunks, strict=False)])
        body_ends = np.cumsum([0, *(len(chunk) - 1 for chunk in chunks)])

        def upload(values, dtype) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device.warp)

        self.count, self.chunk_count = sum(counts), len(begins)
        self.vertices = upload(np.concatenate([body.vertices for body in bodies]).astype(np.int32), wp.int32)
        self.weights = upload(np.concatenate([body.weights for body in bodies]).astype(real.numpy), real.vec4)
        self.handles = upload(np.stack([body.handles for body in bodies]).astype(np.int32), wp.vec4i)
        self.body = upload(np.repeat(np.arange(len(bodies)), counts).astype(np.int32), wp.int32)
        self.begins, self.ends = upload(begins.astype(np.int32), wp.int32), upload(ends.astype(np.int32), wp.int32)
        self.body_ends = upload(body_ends.astype(np.int32), wp.int32)
        self.diagonal = wp.zeros(n, dtype=real.mat33, device=device.warp)
        self._sums = wp.zeros(4 * self.chunk_count, dtype=real.vec3, device=device.warp)
        self._blocks = wp.zeros(4 * self.chunk_count, dtype=real.mat33, device=device.warp)

    def expand(self, u: wp.array) -> None:
        """Launches u = J q for the followers, q what u is at the points."""
        self.device.launch(self.kernels.expand, self.count, [self.vertices, self.body, self.handles, self.weights, u])

    def fold(self, r: wp.array) -> None:
        """Launches r = J^T r: what followers have goes to the points, and they are zero."""
        k, device = self.kernels, self.device
        device.launch(k.add_up, self.chunk_count, [self.begins, self.ends, self.vertices, self.weights, r, self._sums], grain=8)
        device.launch(k.hand_over, 4 * len(self.bodies), [self.body_ends, self.handles, self._sums, r])

    def fold_diagonal(self, blocks: list[wp.array]) -> None:
        """Launches `diagonal`: what the blocks (n,) of the followers, summed over at most three arrays, are in terms of each point."""
        k, device = self.kernels, self.device
        inputs = [*blocks, *[None] * (3 - len(blocks)), self._blocks]
        device.launch(
            k.add_up_blocks, self.chunk_count, [self.begins, self.ends, self.vertices, self.weights, *inputs], grain=8
        )
        device.launch(k.hand_over_blocks, 4 * len(self.bodies), [self.body_ends, self.handles, self._blocks, self.diagonal])


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    vec3, vec4, mat33 = real.vec3, real.vec4, real.mat33
    module = real.module(__name__)

    @kernel(module)
    def expand(
        first: int,
        vertices: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        handles: wp.array(dtype=wp.vec4i),
        weights: wp.array(dtype=vec4),
        u: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        q = handles[body[i]]
        w = weights[i]
        # the weights add up to 1: differences keep the common motion exact
        origin = u[q[0]]
        u[vertices[i]] = origin + w[1] * (u[q[1]] - origin) + w[2] * (u[q[2]] - origin) + w[3] * (u[q[3]] - origin)

    @kernel(module)
    def add_up(
        first: int,
        begins: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        vertices: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=vec4),
        r: wp.array(dtype=vec3),
        sums_out: wp.array(dtype=vec3),
    ):
        c = first + wp.tid()
        s0 = vec3()
        s1 = vec3()
        s2 = vec3()
        s3 = vec3()
        for i in range(begins[c], ends[c]):
            v = vertices[i]
            w = weights[i]
            own = r[v]
            s0 += w[0] * own
            s1 += w[1] * own
            s2 += w[2] * own
            s3 += w[3] * own
            r[v] = vec3()
        sums_out[4 * c] = s0
        sums_out[4 * c + 1] = s1
        sums_out[4 * c + 2] = s2
        sums_out[4 * c + 3] = s3

    @kernel(module)
    def hand_over(
        first: int,
        body_ends: wp.array(dtype=wp.int32),
        handles: wp.array(dtype=wp.vec4i),
        sums: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        b = i // 4
        total = vec3()
        for c in range(body_ends[b], body_ends[b + 1]):
            total += sums[4 * c + i % 4]
        h = handles[b][i % 4]
        r[h] = r[h] + total

    @kernel(module)
    def add_up_blocks(
        first: int,
        begins: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        vertices: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=vec4),
        elastic: wp.array(dtype=mat33),
        contact_a: wp.array(dtype=mat33),
        contact_b: wp.array(dtype=mat33),
        sums_out: wp.array(dtype=mat33),
    ):
        c = first + wp.tid()
        s0 = mat33()
        s1 = mat33()
        s2 = mat33()
        s3 = mat33()
        for i in range(begins[c], ends[c]):
            v = vertices[i]
            w = weights[i]
            own = elastic[v]
            if contact_a:
                own += contact_a[v]
            if contact_b:
                own += contact_b[v]
            s0 += (w[0] * w[0]) * own
            s1 += (w[1] * w[1]) * own
            s2 += (w[2] * w[2]) * own
            s3 += (w[3] * w[3]) * own
        sums_out[4 * c] = s0
        sums_out[4 * c + 1] = s1
        sums_out[4 * c + 2] = s2
        sums_out[4 * c + 3] = s3

    @kernel(module)
    def hand_over_blocks(
        first: int,
        body_ends: wp.array(dtype=wp.int32),
        handles: wp.array(dtype=wp.vec4i),
        sums: wp.array(dtype=mat33),
        diagonal_out: wp.array(dtype=mat33),
    ):
        i = first + wp.tid()
        b = i // 4
        total = mat33()
        for c in range(body_ends[b], body_ends[b + 1]):
            total += sums[4 * c + i % 4]
        diagonal_out[handles[b][i % 4]] = total

    return SimpleNamespace(
        expand=expand, add_up=add_up, hand_over=hand_over, add_up_blocks=add_up_blocks, hand_over_blocks=hand_over_blocks
    )
