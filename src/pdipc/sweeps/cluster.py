"""Workers on Dask: on this machine or at a scheduler's address."""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pdipc.output.results import RunError
from pdipc.scene.errors import SceneError, SceneWarning
from pdipc.sweeps.cases import Case, check_case

if TYPE_CHECKING:
    from distributed import Client

LISTED = 5  # refused combinations that a message names
SUCCESSOR_SECONDS = (
    3600.0  # that a dead worker's successor may take to start: Dask's 15 s pass on a busy machine, and then nobody is left
)
CONNECT_SECONDS = 10.0  # after which a scheduler counts as not there


@dataclass(frozen=True)
class Progress:
    """doing: "check" or "run". done of total; workers: how many there are at the moment."""

    doing: str
    done: int
    total: int
    workers: int


def cores() -> int:
    from pdipc.device.threads import thread_count

    return thread_count()


@contextmanager
def cluster_of(scheduler: str | None, workers: int) -> Iterator["Client"]:
    """A client of the cluster at an address, or of one of processes on this machine, which end with it."""
    import dask.config
    from distributed import Client, LocalCluster

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise RunError(f'no Dask scheduler answers at "{scheduler}": {error}') from None
        with client:
            yield client
        return
    share, log = str(max(1, cores() // workers)), logging.getLogger("distributed.nanny")
    level = log.level
    try:
        with (
            dask.config.set({"distributed.deploy.lost-worker-timeout": SUCCESSOR_SECONDS}),
            # without a limit of memory: Dask would end a worker for using more than an even share
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=0,
                dashboard_address=None,  # pyright: ignore[reportArgumentType]  (its default alone says that it is a str)
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # what it serves all the same, at a port that is free
                env={"PDIPC_THREADS": share},
            ) as cluster,
            Client(cluster) as client,
        ):
            try:
                yield client
            finally:
                # all is done, or stopped: that a busy machine is slow to end the workers is nothing to warn of
                log.setLevel(logging.ERROR)
    finally:
        log.setLevel(level)


def each_of(
    client: "Client", doing: str, function: Callable, arguments: list[tuple], tell: Callable[[Progress], None]
) -> Iterator[tuple[int, Any]]:
    """The number of the case that each tuple of arguments begins with, and what the function makes of it on a worker, or raises."""
    from distributed import as_completed

    # not pure: what it does is on the disk, so the same call twice is two calls
    futures = {client.submit(function, *each, pure=False): each[0].number for each in arguments}

    def told(done: int) -> None:
        tell(Progress(doing, done, len(arguments), len(client.scheduler_info()["workers"])))

    told(0)
    finished = as_completed(list(futures))
    done = 0
    while done < len(arguments):
        if finished.is_empty():
            raise RunError("the Dask scheduler is gone; go on with --resume once there is one")
        future = finished.next()
        if future.cancelled():
            raise RunError("the Dask scheduler is gone, or has dropped what it was given; go on with --resume")
        yield futures.pop(future), future.exception() or future.result()
        future.release()  # else it would be computed again where a worker dies that has its result
        done += 1
        told(done)


def check(client: "Client", cases: list[Case], tell: Callable[[Progress], None]) -> None:
    """Raises SceneError where a worker refuses a case; warns of what was left out of files."""
    from pdipc import __version__

    refused: list[tuple[int, Exception]] = []
    notes: dict[str, None] = {}
    for number, outcome in each_of(client, "check", check_case, [(case, __version__) for case in cases], tell):
        if isinstance(outcome, list):
            notes |= dict.fromkeys(outcome)
        elif isinstance(outcome, ModuleNotFoundError):
            raise RunError(f"the workers have no pdipc: {outcome}")
        elif isinstance(outcome, SceneError):
            refused.append((number, outcome))
        else:
            raise outcome
    for note in notes:
        warnings.warn(note, SceneWarning, stacklevel=3)
    if refused:
        by_number = {case.number: case for case in cases}
        told = [f"{by_number[number]}: {error}" for number, error in sorted(refused, key=lambda each: each[0])]
        more = [f"... and {len(told) - LISTED} more"] if len(told) > LISTED else []
        listed = "\n  ".join([*told[:LISTED], *more])
        raise SceneError(f"{len(told)} of {len(cases)} combinations cannot be simulated:\n  {listed}")
