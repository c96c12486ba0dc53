"""What a block of threads adds up: on CUDA, and where blocks are emulated, by Warp's tiles; in a block of one thread the number itself.

Warp's own `tile_extract` takes memory that the threads of a CPU would have to share, and they run kernels at the same time.
"""

import functools

from pdipc.device import language
from pdipc.device.language import Function

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
