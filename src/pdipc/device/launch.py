"""Running kernels: on CUDA as they are, on the CPU split over threads, and both as recorded graphs.

Warp runs a CPU launch on one core and releases Python's lock while it does. So on the CPU each launch is cut into ranges, one or two a
thread. A recorded graph goes further: every thread replays a graph of its own ranges in native code, and the threads meet after
each kernel, which costs about a microsecond (`system.meet_kernel`) where a hand-over through Python costs sixty. Kernels never
depend on how a range was cut, so results are the same to the last bit for any number of threads, captured or not.

Three kinds of kernels:
- over a known range: the first parameter is `first: int`, the index is `first + wp.tid()`; `Device.launch`.
- over a known range, a block of BLOCK threads an index on CUDA and one thread on the CPU: with `worker = first + wp.tid()` the index is
  `worker // wp.block_dim()` and the thread of the block `worker % wp.block_dim()`; `Device.launch_blocks`. What the threads of a block
  add up goes through Warp's tiles, which add in one order.
- over a list whose length is on the device: the first parameter is `span: Span` and the loop is
      worker = span.first + wp.tid()
      for block in range(worker * span.block, count, span.step * span.block):
          for i in range(block, wp.min(block + span.block, count)):
  `Device.launch_list`.
"""

import concurrent.futures
import functools
import itertools
import queue
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.device import blocks, system
from pdipc.device import threads as shared
from pdipc.device.language import Kernel, filled, func, kernel, struct
from pdipc.device.precision import Real
from pdipc.device.threads import one_at_a_time as one_at_a_time

REDUCE_BLOCK = 512  # numbers that one worker adds up; fixed, so that sums do not depend on the number of threads
CPU_BLOCK = 64  # list entries that one CPU thread takes at a time
CUDA_BLOCK = 1
CPU_SPLIT = 2048  # ranges shorter than this stay on one CPU thread when launched from Python
GRAPH_SPLIT = 256  # likewise inside a recorded graph, where splitting is cheaper
TURNS = 2  # ranges that each CPU thread has of a large launch in a graph: indices at the end, obstacles' vertices as a rule, have less work
LARGE = 1024  # operations of such a range, at least
CUDA_WORKERS = 1 << 17  # threads that share a list on CUDA
BLOCK = 256  # threads of a block on CUDA where they work together
WIDE_BLOCKS = 1024  # blocks that share a sum on CUDA; more numbers make longer strides


@struct
class Span:
    """How a list is shared: worker `first + tid` takes every `step`-th block of `block` entries."""

    first: int
    step: int
    block: int


class ForkedError(RuntimeError):
    """What lives on CUDA was used in the child of a fork."""


class Graph:
    """A recorded sequence of launches, replayed by `launch()`."""

    def __init__(self, device: "Device", graphs: list[Any], keep_alive: Any):
        self._device = device
        self._graphs = graphs
        self._keep_alive = keep_alive

    @one_at_a_time
    def launch(self) -> None:
        """Replays the recorded kernels; on the CPU returns when all are done."""
        self._device.refuse_forked()
        _together([functools.partial(wp.capture_launch, graph) for graph in self._graphs])

    def begin(self, tell: Callable[[], None]) -> Future | None:
        """Replays beside what the caller goes on with; `tell` is called, in whatever thread, when what it wrote can be read.

        On the CPU the device must have one thread: the threads of another need the pool to themselves. On CUDA the work waits in the
        device's stream, in whose order the caller follows; None is returned.
        """
        self._device.refuse_forked()
        if self._device.is_cuda:
            wp.capture_launch(self._graphs[0])
            tell()
            return None
        (graph,) = self._graphs
        future = shared.pool(shared.thread_count()).submit(wp.capture_launch, graph)
        future.add_done_callback(lambda _: tell())
        return future


Task = Generator[Graph, None, Any]  # work of the host that yields graphs, and goes on when they have been replayed


@one_at_a_time
def _advance(task: Task, replay: Callable[[Graph], Any]) -> Any:
    return replay(next(task))


def replayed(task: Task) -> Any:
    """What a task returns; its graphs are replayed as they come."""
    while True:
        try:
            _advance(task, Graph.launch)
        except StopIteration as end:
            return end.value


def side_by_side(tasks: Sequence[Task]) -> list[Any]:
    """What each task returns; their graphs are replayed at the same time, on as many threads as there may be.

    The tasks' own work is done here, one at a time. Where one raises, the others are finished first; then the error of the first of
    them is raised, with a note of its number.
    """
    ready: queue.SimpleQueue[int] = queue.SimpleQueue()
    results: list[Any] = [None] * len(tasks)
    errors: dict[int, Exception] = {}
    begun: dict[int, Future | None] = {}
    for number in range(len(tasks)):
        ready.put(number)
    left = len(tasks)
    try:
        while left:
            number = ready.get()
            try:
                if (replay := begun.pop(number, None)) is not None:
                    replay.result()
                tell = functools.partial(ready.put, number)
                begun[number] = _advance(tasks[number], lambda graph: graph.begin(tell))
            except StopIteration as end:
                results[number], left = end.value, left - 1
            except Exception as error:
                errors[number], left = error, left - 1
    finally:  # nothing is written any more when this returns, or is interrupted
        concurrent.futures.wait([replay for replay in begun.values() if replay is not None])
    for number, error in sorted(errors.items()):
        error.add_note(f"in world {number} of {len(tasks)}")
        raise error
    return results


def _together(parts: list[Callable[[], None]]) -> None:
    """Runs all parts at once, the first one here."""
    others = [shared.pool(len(parts) - 1).submit(part) for part in parts[1:]]
    parts[0]()
    for other in others:
        other.result()


class Device:
    """Where a model lives and how its kernels are launched.

    name: "cpu", "cuda:0", or None for CUDA where there is one, else the CPU.
    threads: CPU threads; None for `threads.thread_count()`.
    wide: whether work is cut for many threads that each do little, as on CUDA, or for a few that each do much.
    """

    @one_at_a_time
    def __init__(self, name: str | None = None, threads: int | None = None):
        system.start_warp()
        if name is None:
            name = "cuda:0" if wp.is_cuda_available() else "cpu"
        try:
            self.warp = wp.get_device(name)
        except Exception as error:
            known = ", ".join(device.alias for device in wp.get_devices())
            raise ValueError(f'device "{name}" is not available; this machine has: {known}') from error
        self.name = self.warp.alias
        self.is_cuda = self.wide = self.warp.is_cuda
        self.threads = 1 if self.is_cuda else threads or shared.thread_count()
        self.block = CUDA_BLOCK if self.is_cuda else CPU_BLOCK  # list entries of a span's block
        self._recording: int | None = None  # the CPU thread whose graph is being recorded
        self._meeting = None if self.is_cuda else wp.zeros(system.MEETING, dtype=wp.int32, device=self.warp)
        self._scanned = wp.zeros(1, dtype=wp.int32, device=self.warp)  # see `scan`
        self._process = shared.process

    @functools.cached_property
    def records_loops(self) -> bool:
        """Whether a recorded graph may hold loops and conditions: on CUDA from toolkit and driver 12.4 on."""
        return not self.is_cuda or wp.is_conditional_graph_supported()

    def __deepcopy__(self, memo: dict) -> "Device":
        return self

    def refuse_forked(self) -> None:
        """Raises ForkedError in a process that got the device over a fork, where that does not work."""
        if self.is_cuda and self._process != shared.process:
            raise ForkedError(
                f"this was made on {self.name} before the process forked, and CUDA does not survive a fork; "
                'start processes with multiprocessing\'s "spawn", and make simulations in them'
            )

    def _meet(self) -> None:
        if self._meeting is not None and self.threads > 1:
            wp.launch(system.meet_kernel(), dim=1, inputs=system.meet_inputs(self._meeting, self.threads), device=self.warp)

    @one_at_a_time
    def launch(self, kernel: Kernel, dim: int, inputs: Sequence[Any], grain: int = 1) -> None:
        """Runs `kernel(first, *inputs)` for indices 0 to dim - 1; each index is worth `grain` simple operations."""
        if self.is_cuda:
            wp.launch(kernel, dim=dim, inputs=[0, *inputs], device=self.warp)
        elif self._recording is not None:
            parts = self.threads if dim * grain >= GRAPH_SPLIT else 1
            turns = 1 if parts == 1 else max(1, min(TURNS, dim * grain // (parts * LARGE)))
            ranges = parts * turns
            for own in range(self._recording, ranges, parts):
                low, high = (dim * own) // ranges, (dim * (own + 1)) // ranges
                if high > low:
                    wp.launch(kernel, dim=high - low, inputs=[low, *inputs], device=self.warp)
            self._meet()
        elif self.threads == 1 or dim * grain < CPU_SPLIT:
            wp.launch(kernel, dim=dim, inputs=[0, *inputs], device=self.warp)
        else:
            bounds = [(dim * part) // self.threads for part in range(self.threads + 1)]
            commands: list[Any] = [
                wp.launch(kernel, dim=high - low, inputs=[low, *inputs], device=self.warp, record_cmd=True)
                for low, high in itertools.pairwise(bounds)
            ]
            _together([command.launch for command in commands])

    @one_at_a_time
    def launch_blocks(self, kernel: Kernel, blocks: int, inputs: Sequence[Any], grain: int = BLOCK) -> None:
        """Runs `kernel(first, *inputs)` for indices 0 to blocks - 1, each by a block of threads on CUDA and by one on the CPU."""
        if self.wide:
            wp.launch(kernel, dim=blocks * BLOCK, inputs=[0, *inputs], device=self.warp, block_dim=BLOCK)
        else:
            self.launch(kernel, blocks, inputs, grain)

    @one_at_a_time
    def launch_list(self, kernel: Kernel, capacity: int, inputs: Sequence[Any]) -> None:
        """Runs `kernel(span, *inputs)` over a list of at most `capacity` entries whose length the kernel reads itself."""
        if self.is_cuda:
            workers = max(1, min(capacity, CUDA_WORKERS))
            wp.launch(kernel, dim=workers, inputs=[_span(0, workers, CUDA_BLOCK), *inputs], device=self.warp)
        elif self._recording is not None:
            part, parts = self._recording, self.threads if capacity >= GRAPH_SPLIT else 1
            if part < parts:
                wp.launch(kernel, dim=1, inputs=[_span(part, parts, CPU_BLOCK), *inputs], device=self.warp)
            self._meet()
        elif self.threads == 1 or capacity < CPU_SPLIT:
            wp.launch(kernel, dim=1, inputs=[_span(0, 1, CPU_BLOCK), *inputs], device=self.warp)
        else:
            parts = self.threads
            commands: list[Any] = [
                wp.launch(kernel, dim=1, inputs=[_span(part, parts, CPU_BLOCK), *inputs], device=self.warp, record_cmd=True)
                for part in range(parts)
            ]
            _together([command.launch for command in commands])

    @one_at_a_time
    def launch_serial(self, kernel: Kernel, inputs: Sequence[Any]) -> None:
        """Runs `kernel(0, *inputs)` once, in one thread: the last step of a sum, a counter, a decision."""
        if self._recording is None or self._recording == 0:
            wp.launch(kernel, dim=1, inputs=[0, *inputs], device=self.warp)
        if self._recording is not None:
            self._meet()

    @one_at_a_time
    def launch_scatter(self, kernel: Kernel, capacity: int, inputs: Sequence[Any]) -> None:
        """Runs a kernel over a list that counts with integer atomics: in one thread on the CPU, where those are not atomic."""
        if self.is_cuda:
            self.launch_list(kernel, capacity, inputs)
        else:
            if self._recording is None or self._recording == 0:
                wp.launch(kernel, dim=1, inputs=[_span(0, 1, CPU_BLOCK), *inputs], device=self.warp)
            if self._recording is not None:
                self._meet()

    @one_at_a_time
    def copy(self, destination: wp.array, source: wp.array) -> None:
        """Copies an array inside or outside of a recording."""
        if self._recording is None or self._recording == 0:
            wp.copy(destination, source)
        if self._recording is not None:
            self._meet()

    @one_at_a_time
    def once(self, operation: Callable[[], None]) -> None:
        """Runs, or records, what Warp does as one operation: a scan, the refit of a tree."""
        if self._recording is None or self._recording == 0:
            operation()
        if self._recording is not None:
            self._meet()

    @one_at_a_time
    def scan(self, counts: wp.array, ends_out: wp.array) -> None:
        """ends_out[i] = counts[0] + ... + counts[i], int32.

        On CUDA by kernels of our own: Warp's scan allocates memory, which CUDA refuses inside the loops of a graph.
        """
        if self.wide:
            n, k = counts.size, scan_kernels()
            self.launch_blocks(k.scan, -(-n // BLOCK), [n, counts, self._scanned, ends_out])
            self.launch(k.add_ends, n, [BLOCK, ends_out])
        else:
            self.once(lambda: wp.utils.array_scan(counts, ends_out, inclusive=True))

    def loop(self, condition: wp.array, body: Callable[[], None]) -> None:
        """Repeats `body` while the one int32 in `condition` is not zero; the body must launch before it changes that."""
        wp.capture_while(condition, body)

    def when(self, condition: wp.array, body: Callable[[], None]) -> None:
        """Runs `body` if the one int32 in `condition` is not zero; the body must launch before it changes that."""
        wp.capture_if(condition, body)

    @one_at_a_time
    def capture(self, launches: Callable[[], None], keep_alive: Any = None) -> Graph:
        """Records what `launches()` launches and returns it as a graph; nothing is run.

        `launches` is called once for each CPU thread and must do the same each time. Kernels are compiled first where they
        were not yet. Arrays used must stay allocated as long as the graph: pass what owns them as keep_alive.
        """
        self.refuse_forked()
        if self.is_cuda:
            with wp.ScopedCapture(device=self.warp) as capture:
                launches()
            return Graph(self, [capture.graph], (launches, keep_alive))
        wp.load_module(system.meeting_module(), device=self.warp)
        graphs = []
        try:
            for part in range(self.threads):
                self._recording = part
                with wp.ScopedCapture(device=self.warp) as capture:
                    launches()
                graphs.append(capture.graph)
        finally:
            self._recording = None
        return Graph(self, graphs, (launches, keep_alive))


def _span(first: int, step: int, block: int) -> Any:
    span = Span()
    span.first, span.step, span.block = first, step, block
    return span


@functools.cache
def scan_kernels() -> SimpleNamespace:
    """Inclusive sums in place of an array: within blocks and, by who is last, over the ends of blocks; then ends are added to the blocks after them.

    The last number of each block is final after the first kernel, so no other memory is needed.
    """
    module = wp.get_module(f"{__name__}.scan")
    module.options["enable_backward"] = False
    block_scan, block_total, last_block = blocks.scan(), blocks.total(wp.int32), blocks.last()

    @kernel(module)
    def scan(
        first: int,
        count: int,
        counts: wp.array(dtype=wp.int32),
        arrived: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
    ):
        i = first + wp.tid()
        size = wp.block_dim()
        lane = i % size
        value = int(0)
        if i < count:
            value = counts[i]
        total = block_scan(value)
        if i < count:
            ends[i] = total
        if last_block(arrived, 0, (count + size - 1) // size):
            before = int(0)
            for begin in range(0, count, size * size):
                end = begin + (lane + 1) * size - 1
                value = int(0)
                if end < count:
                    value = ends[end]
                total = before + block_scan(value)
                if end < count:
                    ends[end] = total
                before += block_total(value)

    @kernel(module)
    def add_ends(first: int, size: int, ends: wp.array(dtype=wp.int32)):
        i = first + wp.tid()
        if i >= size and i % size != size - 1:
            ends[i] = ends[i] + ends[i // size * size - 1]

    return SimpleNamespace(scan=scan, add_ends=add_ends)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """Sums and largest values that do not depend on the number of threads: of fixed parts, then, by who is last, over the parts."""
    scalar = real.scalar
    module = real.module(__name__)
    block_total, block_largest, last_block = blocks.total(scalar), blocks.largest(scalar), blocks.last()

    @func
    def one_of(which: int, i: int, a: wp.array(dtype=scalar), b: wp.array(dtype=scalar), c: wp.array(dtype=scalar)):
        value = scalar(0.0)
        if which == 0:
            value = a[i]
        elif which == 1:
            value = b[i]
        else:
            value = c[i]
        return value

    @kernel(module)
    def find_largest(
        first: int,
        a: wp.array(dtype=scalar),
        b: wp.array(dtype=scalar),
        c: wp.array(dtype=scalar),
        counts: wp.vec3i,
        parts: Share,
        slots: wp.vec3i,
        partial: wp.array(dtype=scalar),
        out: wp.array(dtype=scalar),
    ):
        """A block of threads a part of the numbers, of which each array has so many."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        which = block // parts.number
        begin = wp.min((block - which * parts.number) * parts.size, counts[which] - 1)
        largest = one_of(which, begin, a, b, c)
        for i in range(begin + lane, wp.min(begin + parts.size, counts[which]), wp.block_dim()):
            largest = wp.max(largest, one_of(which, i, a, b, c))
        largest = block_largest(largest)
        if lane == 0:
            partial[block] = largest
        if last_block(parts.arrived, which, parts.number):
            largest = partial[which * parts.number]
            for k in range(lane, parts.number, wp.block_dim()):
                largest = wp.max(largest, partial[which * parts.number + k])
            largest = block_largest(largest)
            if lane == 0:
                out[slots[which]] = largest

    @kernel(module)
    def add_up(
        first: int,
        values: wp.array(dtype=scalar),
        count: int,
        parts: Share,
        slot: int,
        partial: wp.array(dtype=scalar),
        out: wp.array(dtype=scalar),
    ):
        """A block of threads a part of the numbers."""
        worker = first + wp.tid()
        block = worker // wp.block_dim()
        lane = worker % wp.block_dim()
        total = scalar(0.0)
        for i in range(block * parts.size + lane, wp.min((block + 1) * parts.size, count), wp.block_dim()):
            total += values[i]
        total = block_total(total)
        if lane == 0:
            partial[block] = total
        if last_block(parts.arrived, 0, parts.number):
            total = scalar(0.0)
            for k in range(lane, parts.number, wp.block_dim()):
                total += partial[k]
            total = block_total(total)
            if lane == 0:
                out[slot] = total

    return SimpleNamespace(find_largest=find_largest, add_up=add_up)


@struct
class Share:
    """`Parts` as kernels take them."""

    number: int
    size: int
    arrived: wp.array[wp.int32]


class Parts:
    """How `count` entries are cut for blocks of threads that finish together: `number` parts of `size` entries.

    arrived: int32 on the device, the counters of `blocks.last`, of so many `slots`. share: these as kernels take them.
    """

    def __init__(self, device: Device, count: int, slots: int = 1):
        self.size = max(REDUCE_BLOCK, -(-count // WIDE_BLOCKS)) if device.wide else REDUCE_BLOCK
        self.number = max(1, -(-count // self.size))
        self.arrived = wp.zeros(slots, dtype=wp.int32, device=device.warp)
        self.share = filled(Share, self)


class Largest:
    """The largest numbers of up to three arrays on the device, in one launch. counts: how many numbers each has."""

    def __init__(self, device: Device, real: Real, counts: Sequence[int]):
        self.device, self.kernels, self.arrays = device, kernels(real), len(counts)
        self.counts = wp.vec3i(*counts, *([1] * (3 - len(counts))))
        self.parts = Parts(device, max(counts), self.arrays)
        self.partial = wp.zeros(self.arrays * self.parts.number, dtype=real.scalar, device=device.warp)

    def find(self, values: Sequence[wp.array], out: wp.array, slots: Sequence[int]) -> None:
        """Launches out[slots[k]] = largest of values[k]."""
        parts, fill = self.parts, 3 - self.arrays
        inputs = [*values, *[values[0]] * fill, self.counts, parts.share, wp.vec3i(*slots, *[0] * fill), self.partial, out]
        self.device.launch_blocks(self.kernels.find_largest, self.arrays * parts.number, inputs, grain=REDUCE_BLOCK // 8)


class Reducer:
    """Adds up, or takes the largest of, `count` numbers in an array on the device; the result stays on the device."""

    def __init__(self, device: Device, real: Real, count: int):
        self.device, self.count, self.kernels = device, count, kernels(real)
        self.parts = Parts(device, count)
        self.partial = wp.zeros(self.parts.number, dtype=real.scalar, device=device.warp)
        self._largest = Largest(device, real, [count])

    def sum(self, values: wp.array, out: wp.array, slot: int = 0) -> None:
        """out[slot] = sum of values[0:count], always in the same order on a device."""
        parts = self.parts
        inputs = [values, self.count, parts.share, slot, self.partial, out]
        self.device.launch_blocks(self.kernels.add_up, parts.number, inputs, grain=REDUCE_BLOCK // 8)

    def max(self, values: wp.array, out: wp.array, slot: int = 0) -> None:
        """out[slot] = largest of values[0:count]."""
        self._largest.find([values], out, [slot])
