"""Energies by body: sums of fixed blocks of BLOCK numbers, so that they depend neither on threads nor on what other bodies do."""

import functools
import itertools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.device import blocks
from pdipc.device.language import kernel, struct
from pdipc.device.launch import BLOCK, Device


@struct
class Blocks:
    """The blocks of `BodySums`: where each starts and ends in its array, `own` of them in the first one, and whose it is; and the blocks of each body."""

    starts: wp.array[wp.int32]
    ends: wp.array[wp.int32]
    own: int
    body_of: wp.array[wp.int32]
    offsets: wp.array[wp.int32]  # of each body, into
    listed: wp.array[wp.int32]
    partial: wp.array[wp.float64]  # sums
    arrived: wp.array[wp.int32]  # of each body, see `blocks.last`


@functools.cache
def kernels() -> SimpleNamespace:
    module = wp.get_module(__name__)
    module.options["enable_backward"] = False
    block_total, last_block = blocks.total(wp.float64), blocks.last()

    @kernel(module)
    def add(
        first: int,
        o: Blocks,
        values: wp.array(dtype=wp.float64),
        more: wp.array(dtype=wp.float64),
        total_out: wp.array(dtype=wp.float64),
    ):
        """The first `own` blocks are of `values`, the others of `more`; the last of a body to be done adds up the body's."""
        worker = first + wp.tid()
        b = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        total = wp.float64(0.0)
        for i in range(o.starts[b] + lane, o.ends[b], wp.block_dim()):
            if b < o.own:
                total += values[i]
            else:
                total += more[i]
        total = block_total(total)
        if lane == 0:
            o.partial[b] = total
        body = o.body_of[b]
        if last_block(o.arrived, body, o.offsets[body + 1] - o.offsets[body]):
            total = wp.float64(0.0)
            for k in range(o.offsets[body] + lane, o.offsets[body + 1], wp.block_dim()):
                total += o.partial[o.listed[k]]
            total = block_total(total)
            if lane == 0:
                total_out[body] = total

    return SimpleNamespace(add=add)


class BodySums:
    """Adds up one or two arrays whose entries belong to bodies. owners: for each array the body of every entry, -1 for none; bodies: how many."""

    def __init__(self, device: Device, owners: list[np.ndarray], bodies: int):
        self.device, self._kernels = device, kernels()
        cuts, bodies_of_blocks, at = [], [], 0
        for owner in owners:
            owner = np.asarray(owner)
            change = np.flatnonzero(np.diff(owner)) + 1
            runs = np.concatenate([[0], change, [len(owner)]]).astype(np.int64)
            starts = np.concatenate([np.arange(low, high, BLOCK) for low, high in itertools.pairwise(runs)] or [[]])
            starts = starts.astype(np.int64)
            ends = np.minimum(starts + BLOCK, runs[np.searchsorted(runs, starts, side="right").clip(max=len(runs) - 1)])
            inside = owner[starts] >= 0 if len(starts) else np.zeros(0, dtype=bool)
            starts, ends = starts[inside], ends[inside]
            bodies_of_blocks.append(owner[starts] if len(starts) else np.zeros(0, dtype=np.int64))
            cuts.append((starts, ends))
            at += len(starts)
        self._count = at
        body = np.concatenate([*bodies_of_blocks, np.zeros(0, dtype=np.int64)])
        order = np.argsort(body, kind="stable")
        o = self._blocks = Blocks()
        o.starts, o.ends = (self._upload(np.concatenate(each)) for each in zip(*cuts, strict=True))
        o.own, o.body_of, o.listed = len(cuts[0][0]), self._upload(body), self._upload(order)
        o.offsets = wp.array(np.searchsorted(body[order], np.arange(bodies + 1)).astype(np.int32), device=device.warp)
        o.partial = wp.zeros(max(1, at), dtype=wp.float64, device=device.warp)
        o.arrived = wp.zeros(max(1, bodies), dtype=wp.int32, device=device.warp)

    def _upload(self, values: np.ndarray) -> wp.array:
        return wp.array(np.append(values, 0).astype(np.int32), dtype=wp.int32, device=self.device.warp)

    def add(self, arrays: list[wp.array], total_out: wp.array) -> None:
        """Launches total_out[b] = sum of the entries of body b over all arrays; of a body without entries it stays as it is."""
        if self._count:
            inputs = [self._blocks, arrays[0], arrays[-1], total_out]
            self.device.launch_blocks(self._kernels.add, self._count, inputs, grain=BLOCK // 4)
