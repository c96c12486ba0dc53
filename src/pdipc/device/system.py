"""What stands between Warp and the operating system: its start, and what kernels on the CPU ask for, to wait for each other and the
time.

Native snippets cannot include headers, and what symbols they find differs between systems. So the functions are found from Python
and go into kernels as addresses.
"""

import ctypes
import functools
import os
import platform
import sys
import tempfile
import time
from typing import Any

import warp as wp

from pdipc.device import language
from pdipc.device.language import Kernel, kernel
from pdipc.device.threads import cores

# Threads meet after each kernel of a recorded graph. The last to arrive wakes the others. Those spin at first, since what they wait
# for takes a microsecond as a rule. Where it takes longer, another process has a thread's core, two threads share one, or one has work
# alone: they sleep (Linux) or give way (elsewhere). Who sleeps uses nothing of its share of the core and gets it at once when woken; who
# spins, or gives way and comes back, waits behind whoever is busy, once more at every meeting. Where spinning was in vain eight times
# without a success between, each time after lasts half as long, but for one trial at length in 64. Not at once: one thread's long work makes the
# other sleep, which then comes late to the next meeting, so that the first would sleep there in turn, and so on.
_MEET = """
    int* arrived = &meeting[0];
    int* generation = &meeting[16];
    int* sleeping = &meeting[32];
    int* failures = &meeting[48];
    int now = __atomic_load_n(generation, __ATOMIC_ACQUIRE);
#if defined(__linux__)
    long (*futex)(long, int*, int, int, void*) = (long (*)(long, int*, int, int, void*))wait_call;
    const int WAIT = 128, WAKE = 129;  // within this process
#endif
    if (__atomic_add_fetch(arrived, 1, __ATOMIC_ACQ_REL) == threads) {
        __atomic_store_n(arrived, 0, __ATOMIC_RELAXED);
        __atomic_add_fetch(generation, 1, __ATOMIC_SEQ_CST);
#if defined(__linux__)
        if (__atomic_load_n(sleeping, __ATOMIC_SEQ_CST) != 0) { futex(futex_number, generation, WAKE, threads, 0); }
#endif
        return;
    }
    int failed = __atomic_load_n(failures, __ATOMIC_RELAXED);
    const int shorter = failed < 8 ? 0 : failed < 16 ? failed - 8 : 8;
    int spins = failed % 64 == 0 ? spin_limit : spin_limit >> shorter;
    for (; spins > 0; --spins) {
        if (__atomic_load_n(generation, __ATOMIC_ACQUIRE) != now) {
            if (failed != 0) { __atomic_store_n(failures, 0, __ATOMIC_RELAXED); }
            return;
        }
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        __builtin_arm_yield();
#endif
    }
    __atomic_store_n(failures, failed + 1, __ATOMIC_RELAXED);
    __atomic_add_fetch(sleeping, 1, __ATOMIC_SEQ_CST);
    while (__atomic_load_n(generation, __ATOMIC_ACQUIRE) == now) {
#if defined(__linux__)
        futex(futex_number, generation, WAIT, now, 0);  // returns at once where the generation is another by now
#else
        ((void (*)())wait_call)();
#endif
    }
    __atomic_sub_fetch(sleeping, 1, __ATOMIC_SEQ_CST);
"""

# With POSIX's clock `clock_argument` is the number of a clock, on Windows the ticks of a second. Warp makes a macro of int(, so types say
# `signed` where a parenthesis follows.
_CLOCK = """
#if defined(__CUDA_ARCH__)
    unsigned long long now;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
    return double(now) * 1e-6;
#elif defined(_WIN32)
    long long ticks;
    ((signed (*)(long long*))clock_call)(&ticks);
    return double(ticks) * 1e3 / double(clock_argument);
#else
    struct { long long seconds, nanoseconds; } now;
    ((signed (*)(signed, void*))clock_call)((signed)clock_argument, &now);
    return double(now.seconds) * 1e3 + double(now.nanoseconds) * 1e-6;
#endif
"""

FUTEX = {"x86_64": 202}.get(platform.machine(), 98)  # the number of Linux's system call
SPINS = 16000  # looks at the others before a thread sleeps or gives way, at most: some hundred microseconds


def _address(function: Any) -> wp.uint64:
    return wp.uint64(ctypes.cast(function, ctypes.c_void_p).value or 0)


@functools.cache
def wait_call() -> wp.uint64:
    """Address of what a waiting thread calls: Linux's `syscall`, elsewhere what gives the core away."""
    if sys.platform == "win32":
        return _address(ctypes.windll.kernel32.SwitchToThread)
    return _address(ctypes.CDLL(None).syscall if sys.platform == "linux" else ctypes.CDLL(None).sched_yield)


@functools.cache
def clock_call() -> tuple[wp.uint64, wp.int64]:
    """Address of the monotonic clock and its argument."""
    if sys.platform == "win32":
        frequency = ctypes.c_int64()
        ctypes.windll.kernel32.QueryPerformanceFrequency(ctypes.byref(frequency))
        return _address(ctypes.windll.kernel32.QueryPerformanceCounter), wp.int64(frequency.value)
    return _address(ctypes.CDLL(None).clock_gettime), wp.int64(time.CLOCK_MONOTONIC)


NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


@functools.cache
def start_warp() -> None:
    """Starts Warp, without what it writes to stderr at every start on a machine that has no CUDA: that is no fault."""
    try:
        stderr = os.dup(2)
    except OSError:  # there is none
        wp.init()
        return
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            said.seek(0)
            os.write(2, b"".join(line for line in said if NO_DRIVER not in line))


MEETING = 64  # int32 that threads meet in: four counters, each in a cache line of its own


def meeting_module() -> wp.Module:
    """Of `meet_kernel`."""
    module = wp.get_module(f"{__name__}.meet")
    module.options["enable_backward"] = False
    return module


@functools.cache
def meet_kernel() -> Kernel:
    """A kernel that ends when all threads have called it."""
    module = meeting_module()

    @language.func_native(_MEET)
    def meet(meeting: wp.array(dtype=wp.int32), threads: int, spin_limit: int, wait_call: wp.uint64, futex_number: int): ...

    @kernel(module)
    def meet_others(meeting: wp.array(dtype=wp.int32), threads: int, spin_limit: int, wait_call: wp.uint64, futex_number: int):
        meet(meeting, threads, spin_limit, wait_call, futex_number)

    return meet_others


def meet_inputs(meeting: wp.array, threads: int) -> list[Any]:
    """What `meet_kernel` takes: (MEETING,) int32, zero before the first meeting, and how many threads meet.

    Where there are more of them than cores, spinning keeps from work those that are waited for.
    """
    return [meeting, threads, SPINS if threads <= cores() else SPINS >> 9, wait_call(), FUTEX]


@functools.cache
def milliseconds() -> Any:
    """Warp function (clock_call, clock_argument) -> ms since some moment; on the device in CUDA."""

    @language.func_native(_CLOCK)
    def milliseconds(clock_call: wp.uint64, clock_argument: wp.int64) -> wp.float64: ...

    return milliseconds
