"""What a block of threads adds up: on CUDA, and where blocks are emulated, by Warp's tiles; in a block of one thread the number itself. And
how blocks that run at the same time finish what they do together: the last that is done does it (`last`).

Warp's own `tile_extract` takes memory that the threads of a CPU would have to share, and they run kernels at the same time.
"""

import functools

import warp as wp

from pdipc.device import language
from pdipc.device.language import Function, func

_REDUCE = """
#if WP_TILE_BLOCK_DIM == 1
    return value;
#else
    using T = typename wp::remove_reference<decltype(value)>::type;
    wp::tile_register_t<T, wp::tile_layout_register_t<wp::tile_shape_t<WP_TILE_BLOCK_DIM>>> own(value);
    auto all = wp::tile_reduce_impl([](auto a, auto b) { return OPERATION; }, own);
    return all.extract(wp::tile_coord(0));
#endif
"""


@functools.cache
def total(dtype: type) -> Function:
    """The sum over the threads of a block, in one order, for each of them. dtype: of the numbers, vectors or matrices."""

    @language.func_native(_REDUCE.replace("OPERATION", "wp::add(a, b)"))
    def block_total(value: dtype) -> dtype: ...

    return block_total


@functools.cache
def least(dtype: type) -> Function:
    """The least of what the threads of a block have."""

    @language.func_native(_REDUCE.replace("OPERATION", "wp::min(a, b)"))
    def block_least(value: dtype) -> dtype: ...

    return block_least


@functools.cache
def largest(dtype: type) -> Function:
    """The largest of what the threads of a block have."""

    @language.func_native(_REDUCE.replace("OPERATION", "wp::max(a, b)"))
    def block_largest(value: dtype) -> dtype: ...

    return block_largest


_SCAN = """
#if WP_TILE_BLOCK_DIM == 1
    return value;
#else
    wp::tile_register_t<int, wp::tile_layout_register_t<wp::tile_shape_t<WP_TILE_BLOCK_DIM>>> own(value);
    return wp::tile_scan_inclusive_impl(own).data[0];
#endif
"""


@functools.cache
def scan() -> Function:
    """For each thread of a block the sum of the integers that it and the threads before it have."""

    @language.func_native(_SCAN)
    def block_scan(value: int) -> int: ...

    return block_scan


# What a block has written is seen before its arrival is counted, and what others have written after all of theirs are. Warp's own atomics
# are none on the CPU. The counter is left as it was found, for the next launch.
_ARRIVE = """
    WP_TILE_SYNC();
    int told = 0;
    if (WP_TILE_THREAD_IDX == 0) {
#if defined(__CUDA_ARCH__)
        __threadfence();
        told = atomicAdd(&arrived[slot], 1) == of - 1;
        __threadfence();
#else
        told = __atomic_add_fetch(&arrived[slot], 1, __ATOMIC_ACQ_REL) == of;
#endif
        if (told) { arrived[slot] = 0; }
    }
    return told;
"""


@functools.cache
def last() -> Function:
    """(arrived, slot, of) -> for each thread of a block: whether its block is the last of `of` that call this with a slot in a launch. It then
    sees what the others had written before they called. arrived: int32, zero before the launch, and after it."""
    any_of_block = largest(wp.int32)

    @language.func_native(_ARRIVE)
    def arrive(arrived: wp.array(dtype=wp.int32), slot: int, of: int) -> int: ...

    @func
    def last_block(arrived: wp.array(dtype=wp.int32), slot: int, of: int) -> bool:
        return any_of_block(arrive(arrived, slot, of)) != 0

    return last_block
