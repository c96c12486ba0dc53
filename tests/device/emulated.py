"""A device whose work is cut as for CUDA, on the CPU: blocks of threads are run as fibers, and threads in any order."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from pdipc.device import launch
from pdipc.device.launch import BLOCK, Device, Span

WORKERS = 16  # threads that share a list


class Emulated(Device):
    """order: "given", or "reversed" or "shuffled", in which every thread, or block of threads, is run by itself.

    launches: the kernel, the threads and the inputs of each launch so far.
    """

    def __init__(self, order: str = "given", seed: int = 0):
        super().__init__("cpu", threads=1)
        self.wide, self.block, self.order = True, launch.CUDA_BLOCK, order
        self._random = np.random.default_rng(seed)
        self.launches: list[tuple[wp.Kernel, int, Sequence[Any]]] = []

    def _turns(self, count: int) -> Iterator[tuple[int, int]]:
        """Where each launch begins, and how long it is."""
        if self.order == "given":
            if count:
                yield 0, count
            return
        indices = np.arange(count)[::-1] if self.order == "reversed" else self._random.permutation(count)
        for i in indices.tolist():
            yield i, 1

    def launch(self, kernel: wp.Kernel, dim: int, inputs: Sequence[Any], grain: int = 1) -> None:
        self.launches.append((kernel, dim, inputs))
        for first, count in self._turns(dim):
            wp.launch(kernel, dim=count, inputs=[first, *inputs], device=self.warp)

    def launch_blocks(self, kernel: wp.Kernel, blocks: int, inputs: Sequence[Any], grain: int = BLOCK) -> None:
        self.launches.append((kernel, BLOCK * blocks, inputs))
        with fibers():
            for first, count in self._turns(blocks):
                wp.launch(kernel, dim=BLOCK * count, inputs=[BLOCK * first, *inputs], device=self.warp, block_dim=BLOCK)

    def launch_list(self, kernel: wp.Kernel, capacity: int, inputs: Sequence[Any]) -> None:
        self.launches.append((kernel, capacity, inputs))
        workers = max(1, min(capacity, WORKERS))
        for first, count in self._turns(workers):
            span = Span()
            span.first, span.step, span.block = first, workers, self.block
            wp.launch(kernel, dim=count, inputs=[span, *inputs], device=self.warp)

    def launch_scatter(self, kernel: wp.Kernel, capacity: int, inputs: Sequence[Any]) -> None:
        self.launch_list(kernel, capacity, inputs)

    def launch_serial(self, kernel: wp.Kernel, inputs: Sequence[Any]) -> None:
        self.launches.append((kernel, 1, inputs))
        wp.launch(kernel, dim=1, inputs=[0, *inputs], device=self.warp)


@contextlib.contextmanager
def fibers():
    """Launches on the CPU may have blocks of more than one thread."""
    before = wp.config.enable_cpu_blocks
    wp.config.enable_cpu_blocks = True
    try:
        yield
    finally:
        wp.config.enable_cpu_blocks = before
