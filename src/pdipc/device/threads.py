"""The CPU's threads: how many there may be, the one pool that they come from, and the turns that callers take.

A simulation survives a fork: the fork waits for the launch of another thread to end, and the child makes threads of its own. On
CUDA, whose contexts do not survive one, the child is refused (`launch.Device`).
"""

import functools
import os
import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

CGROUPS = Path("/sys/fs/cgroup")
GROUPS_OF_PROCESS = Path("/proc/self/cgroup")
UNLIMITED = 1e6  # CPUs
ALONE = 250  # vertices of a model that one thread steps: two would lose more in waiting for each other than they win, on a busy machine most

_turn = threading.RLock()
_pool: ThreadPoolExecutor | None = None
_pool_size = 0
process = os.getpid()


def one_at_a_time(function: Callable) -> Callable:
    """Decorator for what launches or records: callers in several threads take turns.

    Warp has one recording at a time, and a replay needs every thread of the pool. A launch uses all cores anyway.
    """

    @functools.wraps(function)
    def taking_turns(*args: Any, **kwargs: Any) -> Any:
        with _turn:
            return function(*args, **kwargs)

    return taking_turns


def pool(workers: int) -> ThreadPoolExecutor:
    """At least `workers` threads, shared by all devices of the process; for holders of the turn only."""
    global _pool, _pool_size
    if _pool is None or _pool_size < workers:
        if _pool is not None:
            _pool.shutdown()
        _pool, _pool_size = ThreadPoolExecutor(workers, thread_name_prefix="pdipc"), workers
    return _pool


def _start_anew() -> None:
    """In the child of a fork: the pool's threads stayed with the parent, and so would a lock that one of them held."""
    global _turn, _pool, _pool_size, process
    _turn, _pool, _pool_size, process = threading.RLock(), None, 0, os.getpid()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    # a fork waits for its turn, so that the child never inherits half a launch
    os.register_at_fork(before=lambda: _turn.acquire(), after_in_parent=lambda: _turn.release(), after_in_child=_start_anew)


def thread_count() -> int:
    """CPU threads: PDIPC_THREADS where it is set, else the cores that the process may use and its container's quota allows.

    Raises ValueError where PDIPC_THREADS is no whole number above zero.
    """
    wanted = os.environ.get("PDIPC_THREADS", "").strip()
    if wanted:
        if re.fullmatch("0*[1-9][0-9]{0,3}", wanted) is None:
            raise ValueError(f'PDIPC_THREADS is "{wanted}"; it must be a number of threads, 1 to 9999')
        return int(wanted)
    # one thread that has used up the container's time keeps all others waiting, so quotas are rounded down
    return max(1, min(cores(), int(_quota(GROUPS_OF_PROCESS, CGROUPS))))


def thread_count_for(vertices: int) -> int | None:
    """CPU threads of a model of so many vertices; None for as many as there may be, which PDIPC_THREADS always says by itself."""
    return 1 if vertices <= ALONE and not os.environ.get("PDIPC_THREADS", "").strip() else None


def cores() -> int:
    """Those that the process may use."""
    count = getattr(os, "process_cpu_count", None)  # from Python 3.13 on
    if count is not None:
        return count() or 1
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _quota(groups_of_process: Path, mounted: Path) -> float:
    """CPUs that the control groups of the process, of version 1 or 2, grant it; UNLIMITED where none does.

    A container may see its own group as the root, or its host's path, of which then only the root is there: every group on the way
    up is asked.
    """
    try:
        lines = groups_of_process.read_text().splitlines()
    except OSError:
        return UNLIMITED  # no Linux
    granted = [UNLIMITED]
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            roots, files = (mounted, mounted / "unified"), ("cpu.max",)  # "max 100000" or "150000 100000"
        elif "cpu" in controllers.split(","):
            roots, files = (mounted / controllers, mounted / "cpu"), ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        else:
            continue
        group = Path(path.lstrip("/"))
        for root in roots:
            granted += [_granted([root / part / file for file in files]) for part in (group, *group.parents)]
    return min(granted)


def _granted(files: list[Path]) -> float:
    """Quota / period, two numbers in microseconds that the files hold together."""
    try:
        quota, period = (float(word) for file in files for word in file.read_text().split())
    except (OSError, ValueError):  # not there, or "max"
        return UNLIMITED
    return quota / period if quota > 0.0 and period > 0.0 else UNLIMITED
