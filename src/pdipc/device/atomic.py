"""Integers that many threads change together, in any order: the result does not depend on it. On the CPU, too, where Warp's own are not atomic."""

import functools

import warp as wp

from pdipc.device import language
from pdipc.device.language import Function

_LOWER = """
#if defined(__CUDA_ARCH__)
    atomicMin(&values[i], value);
#else
    int now = __atomic_load_n(&values[i], __ATOMIC_RELAXED);
    while (value < now && !__atomic_compare_exchange_n(&values[i], &now, value, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
#endif
"""


@functools.cache
def lower() -> Function:
    """(values: int32, i, value): values[i] becomes `value` where that is less."""

    @language.func_native(_LOWER)
    def lower_to(values: wp.array(dtype=wp.int32), i: int, value: int): ...

    return lower_to
