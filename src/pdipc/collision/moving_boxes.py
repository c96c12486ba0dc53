"""What both ways of culling share: boxes of moving vertices, and lists of pairs that say when they are full.

**Lemma 1 (moving boxes).** Let thing A stay within (1 - s) a(0) + s a(1) at every fraction s of the way, a box at the begin and one at
the end, and B within b(s) likewise. If the least of a is above the greatest of b along one axis at s = 0 and at s = 1, it is in between,
since both are linear in s; so A and B never share a point. A box around several holds each at both ends, so it holds each all the way:
what is apart from a node of a tree is apart from all below it, and from all of a patch.

**Lemma 2 (rounding).** A corner is x - reach or x + reach, rounded to double precision, clamped to +-FARTHEST, and rounded to float32, as
Warp's trees are. Each of these maps is monotone, and the same for all corners. So a corner that is above another one after them, not
equal to it, is above it in real arithmetic: no rounding makes a gap where there is none, and nothing has to be rounded outward. Minima,
maxima and comparisons of corners, which is all that happens to them here, in `patches` and in Warp's trees, do not round. The clamp keeps
the sums and areas that a tree makes finite; what is farther out meets all that is, and the sieve decides. A box of something that is
there is never empty, and an empty one, from +inf to -inf, is apart from all. So boxes hold for all finite coordinates.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.device.language import Function, Kernel, func, kernel, struct
from pdipc.device.launch import Device
from pdipc.device.precision import Real

SLOTS, MOST_SLOTS = 8, 48  # finds of a primitive that are kept; what finds more is searched a second time
FIRST_PAIRS = 1024  # room of a list at first, at least: one that grows has the step retaken and recorded anew
PAIRS_OF_EACH = 1.0  # room of a list at first for each primitive
MOST_SPARE = 1 << 20  # pairs; a list that grows has room for twice as many as were found, but for no more than so many besides
LARGEST_LIST = 2**31 - 1
FARTHEST = 1.0e18  # m


@struct
class Boxes:
    """Boxes of things that move in straight lines, where the motion begins and where it ends; float32.

    At a fraction s of the way a thing is inside the box (1 - s) begin + s end.
    """

    begin_low: wp.array[wp.vec3]
    begin_high: wp.array[wp.vec3]
    end_low: wp.array[wp.vec3]
    end_high: wp.array[wp.vec3]


@struct
class Box:
    """One of `Boxes`."""

    begin_low: wp.vec3
    begin_high: wp.vec3
    end_low: wp.vec3
    end_high: wp.vec3


@func
def load(boxes: Boxes, i: int) -> Box:
    box = Box()
    box.begin_low = boxes.begin_low[i]
    box.begin_high = boxes.begin_high[i]
    box.end_low = boxes.end_low[i]
    box.end_high = boxes.end_high[i]
    return box


@func
def store(boxes: Boxes, i: int, box: Box):
    boxes.begin_low[i] = box.begin_low
    boxes.begin_high[i] = box.begin_high
    boxes.end_low[i] = box.end_low
    boxes.end_high[i] = box.end_high


@func
def join(a: Box, b: Box) -> Box:
    """The box around two."""
    box = Box()
    box.begin_low = wp.min(a.begin_low, b.begin_low)
    box.begin_high = wp.max(a.begin_high, b.begin_high)
    box.end_low = wp.min(a.end_low, b.end_low)
    box.end_high = wp.max(a.end_high, b.end_high)
    return box


@func
def meet(a: Box, b: Box) -> bool:
    """Whether they may overlap at some fraction of their ways: not where one begins, and ends, on the same side of the other (Lemma 1)."""
    for axis in range(3):
        if a.begin_low[axis] > b.begin_high[axis] and a.end_low[axis] > b.end_high[axis]:
            return False
        if a.begin_high[axis] < b.begin_low[axis] and a.end_high[axis] < b.end_low[axis]:
            return False
    return True


def boxes(count: int, device: Device) -> Boxes:
    """Room for `count` boxes; each is empty, and meets nothing."""
    made = Boxes()
    for name, value in (("begin_low", np.inf), ("begin_high", -np.inf), ("end_low", np.inf), ("end_high", -np.inf)):
        setattr(made, name, wp.full(max(1, count), wp.vec3(value, value, value), dtype=wp.vec3, device=device.warp))
    return made


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)
    wide = wp.float64
    farthest = wp.constant(wide(FARTHEST))

    @func
    def corner(x: vec3, reach: wide) -> wp.vec3:
        """x + reach, by the maps of Lemma 2."""
        v = wp.vec3d(wide(x[0]) + reach, wide(x[1]) + reach, wide(x[2]) + reach)
        return wp.vec3(
            wp.float32(wp.clamp(v[0], -farthest, farthest)),
            wp.float32(wp.clamp(v[1], -farthest, farthest)),
            wp.float32(wp.clamp(v[2], -farthest, farthest)),
        )

    @kernel(module)
    def vertex_boxes(
        first: int,
        x0: wp.array(dtype=vec3),
        x1: wp.array(dtype=vec3),
        reach: wp.array(dtype=scalar),
        boxes_out: Boxes,
    ):
        i = first + wp.tid()
        r = wide(reach[i])
        boxes_out.begin_low[i] = corner(x0[i], -r)
        boxes_out.begin_high[i] = corner(x0[i], r)
        boxes_out.end_low[i] = corner(x1[i], -r)
        boxes_out.end_high[i] = corner(x1[i], r)

    @kernel(module)
    def settle(
        first: int,
        ends: wp.array(dtype=wp.int32),
        capacity: int,
        count: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
    ):
        """count: entries in use; the most ever found, so that a later find, which fits, does not hide one that did not."""
        total = ends[ends.shape[0] - 1]
        count[0] = total
        count[1] = wp.max(count[1], total)
        if total > capacity or total < 0:
            count[0] = 0
            overflow[0] = 1

    return SimpleNamespace(vertex_boxes=vertex_boxes, settle=settle)


def searching(module: wp.Module, kind: str, operand: Any, sieve: Any, search: Function) -> tuple[Kernel, Kernel]:
    """Two kernels over the first primitives of pairs of a kind, see `PairList.fill`: one that counts what each may meet and keeps what fits
    its slots, and one that packs the slots and searches again where they did not hold all.

    search(i, o, sieve, begin, room, out): a Warp function that counts the partners of primitive i, and lists them in out from `begin` on, as
    long as there is `room`. operand, sieve: the types of o and sieve.
    """

    @kernel(module, f"find_{kind}")
    def find(
        first: int,
        o: operand,
        sieve: sieve,
        room: int,
        slots_out: wp.array(dtype=wp.vec2i),
        found_out: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        found_out[i] = search(i, o, sieve, i * room, room, slots_out)

    @kernel(module, f"pack_{kind}")
    def pack(
        first: int,
        o: operand,
        sieve: sieve,
        room: int,
        slots: wp.array(dtype=wp.vec2i),
        found: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec2i),
        overflow: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        begin = ends[i] - found[i]
        if begin < 0:
            overflow[0] = 1  # more than 2^31 pairs: the scan has wrapped
        elif ends[i] <= pairs_out.shape[0]:
            if found[i] > room:
                search(i, o, sieve, begin, found[i], pairs_out)
            else:
                for k in range(found[i]):
                    pairs_out[begin + k] = slots[i * room + k]

    return find, pack


class PairList:
    """Pairs of one kind: a few slots for each first primitive, and the packed list in order of the first, then the second.

    pairs: vec2i. count: (2,) int32 on the device, pairs in use and the most found. Where the list is too short it is empty, and
    `overflow` (1,) int32 is set.
    """

    def __init__(self, device: Device, kernels: SimpleNamespace, primitives: int, overflow: wp.array):
        self.device, self.kernels, self.primitives, self.overflow = device, kernels, primitives, overflow
        self.found = wp.zeros(max(1, primitives), dtype=wp.int32, device=device.warp)
        self.ends = wp.zeros(max(1, primitives), dtype=wp.int32, device=device.warp)
        self._room_for_slots(SLOTS)
        self.pairs = wp.zeros(max(FIRST_PAIRS, int(PAIRS_OF_EACH * primitives)), dtype=wp.vec2i, device=device.warp)
        self.count = wp.zeros(2, dtype=wp.int32, device=device.warp)

    def _room_for_slots(self, each: int) -> None:
        self.room, self.slots = each, None  # the old ones are given back first
        self.slots = wp.zeros(max(1, self.primitives * each), dtype=wp.vec2i, device=self.device.warp)

    def fill(self, find: Kernel, pack: Kernel, inputs: list) -> None:
        """Launches the search `find(first, *inputs, room, slots, found)`, which counts all and keeps what fits the slots, and
        `pack`, which searches again where the slots did not hold all."""
        device, common = self.device, [*inputs, self.room, self.slots, self.found]
        device.launch(find, self.primitives, common, grain=64)
        device.scan(self.found, self.ends)
        device.launch_serial(self.kernels.settle, [self.ends, len(self.pairs), self.count, self.overflow])
        device.launch(pack, self.primitives, [*common, self.ends, self.pairs, self.overflow], grain=16)

    def grow(self) -> bool:
        """Makes room for what was found; returns whether anything had to."""
        found = max(int(self.count.numpy()[1]), int(self.found.numpy().sum(dtype=np.int64)))
        if found > LARGEST_LIST:
            raise MemoryError(f"{found} candidate pairs: the motion of a step or the activation distance is too large")
        if found <= len(self.pairs):
            return False
        average = 2 * found // max(1, self.primitives)
        if average > self.room:
            self._room_for_slots(min(average, MOST_SLOTS))
        del self.pairs  # freed before the larger one is made
        self.pairs = wp.zeros(min(found + min(found, MOST_SPARE), LARGEST_LIST), dtype=wp.vec2i, device=self.device.warp)
        return True
