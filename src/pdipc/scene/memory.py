"""How much memory is free, for refusing what needs more before it is asked for; and how much this process has."""

from pathlib import Path

import psutil

CONTAINER = Path("/sys/fs/cgroup")


def free_memory() -> int:
    """Bytes that can be had: those of the machine, or of the container that this process runs in."""
    free = psutil.virtual_memory().available
    try:
        limit, used = ((CONTAINER / f"memory.{name}").read_text().strip() for name in ("max", "current"))
        return min(free, max(0, int(limit) - int(used)))
    except (OSError, ValueError):  # no container, or one without a limit
        return free


def used_memory() -> int:
    """Bytes of the machine's memory that this process has."""
    return psutil.Process().memory_info().rss


def gib(size: int) -> str:
    """A number of bytes for people."""
    return f"{size / 2**30:.3g} GiB"
