"""What kernels ask of the operating system, also as other systems do it."""

import ctypes
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import warp as wp

from pdipc.device import system, threads
from pdipc.device.launch import Device


def test_the_clock_runs_with_the_systems():
    module = wp.get_module(f"{__name__}.clock")
    milliseconds = system.milliseconds()

    @wp.kernel(module=module)
    def read(call: wp.uint64, argument: wp.int64, out: wp.array(dtype=wp.float64)):
        out[0] = milliseconds(call, argument)

    out = wp.zeros(1, dtype=wp.float64, device="cpu")

    def now() -> float:
        wp.launch(read, dim=1, inputs=[*system.clock_call(), out], device="cpu")
        return float(out.numpy()[0])

    now()
    begun, first = time.perf_counter(), now()
    time.sleep(0.05)
    last, ended = now(), time.perf_counter()
    assert 50.0 <= last - first <= 1e3 * (ended - begun)


def test_the_clock_of_windows(monkeypatch):
    """Its counter, made by hand: 500 ticks at 1,000 a second."""
    counter = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_longlong))(lambda ticks: ticks.__setitem__(0, 500) or 1)
    snippet = system._CLOCK.replace("defined(_WIN32)", "1")

    @wp.func_native(snippet)
    def milliseconds(clock_call: wp.uint64, clock_argument: wp.int64) -> wp.float64: ...

    module = wp.get_module(f"{__name__}.windows")

    @wp.kernel(module=module)
    def read(call: wp.uint64, argument: wp.int64, out: wp.array(dtype=wp.float64)):
        out[0] = milliseconds(call, argument)

    out = wp.zeros(1, dtype=wp.float64, device="cpu")
    wp.launch(read, dim=1, inputs=[system._address(counter), wp.int64(1000), out], device="cpu")
    assert out.numpy()[0] == 500.0


@pytest.mark.parametrize("spins", [0, 10, system.SPINS])
@pytest.mark.parametrize("way", ["of this system", "giving way"])
def test_threads_meet(way, spins, monkeypatch):
    """Five threads, so that some share a core: none is ever more than one meeting ahead, and none is left asleep."""
    meet = system.meet_kernel()
    if way == "giving way":
        if not sys.platform.startswith("linux"):
            pytest.skip("is what this system does")
        module = wp.get_module(f"{__name__}.giving_way")

        @wp.func_native(system._MEET.replace("defined(__linux__)", "0"))
        def meeting_others(
            meeting: wp.array(dtype=wp.int32), threads: int, spin_limit: int, wait_call: wp.uint64, futex_number: int
        ): ...

        @wp.kernel(module=module)
        def meet_giving_way(
            meeting: wp.array(dtype=wp.int32), threads: int, spin_limit: int, wait_call: wp.uint64, futex_number: int
        ):
            meeting_others(meeting, threads, spin_limit, wait_call, futex_number)

        meet = meet_giving_way
        monkeypatch.setattr(system, "wait_call", lambda: system._address(ctypes.CDLL(None).sched_yield))
    monkeypatch.setattr(system, "SPINS", spins)
    count, times = 5, 2000
    monkeypatch.setattr(system, "cores", lambda: count)
    meeting = wp.zeros(system.MEETING, dtype=wp.int32, device="cpu")
    launch = wp.launch(meet, dim=1, inputs=system.meet_inputs(meeting, count), device="cpu", record_cmd=True)
    done, apart = [0] * count, []

    def take_part(thread: int) -> None:
        for _ in range(times):
            done[thread] += 1
            launch.launch()
            apart.append(max(done) - min(done))

    with ThreadPoolExecutor(count) as pool:
        list(pool.map(take_part, range(count)))
    assert max(apart) == 1
    arrived, generation, sleeping = meeting.numpy()[[0, 16, 32]]
    assert (arrived, generation, sleeping) == (0, times, 0)


def test_devices_share_one_pool():
    pools = set()
    for count in (2, 3, 2, 3):
        device = Device("cpu", count)
        device.capture(device._meet).launch()
        pools.add(threads.pool(1))
    assert len(pools) <= 2  # it may have grown once


def test_warp_starts_quietly_and_says_what_matters():
    """No word of a CUDA driver that is not there; what else is written meanwhile is passed on."""
    code = (
        "import os, warp as wp; from pdipc.device import system; from pdipc.device.launch import Device; "
        "start = wp.init; wp.init = lambda: (os.write(2, b'something else\\n'), start()); Device('cpu')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr, done.stdout) == (0, "something else\n", "")
