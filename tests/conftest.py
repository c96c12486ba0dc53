"""A run on several workers shares the machine between them: each has its part of the cores, and before a whole run each compiles its part
of the kernels, which otherwise all of them would compile at once.
"""

import os
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from pdipc.device import threads

settings.register_profile("any_machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any_machine")  # a busy one is no failure

sys.path.insert(0, str(Path(__file__).parent))
WHOLE = 1000  # tests, about half of all
WORKER, WORKERS = os.environ.get("PYTEST_XDIST_WORKER", ""), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if WORKERS > 1:  # tests of threads say how many they want
    share = str(max(1, threads.thread_count() // WORKERS))
    for name in ("PDIPC_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, share)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Loads what this worker is to compile; what is in Warp's cache already takes no time. Tests begin when all workers have."""
    if WORKERS == 1 or len(session.items) < WHOLE:
        return
    import factories

    from pdipc.device.precision import real

    made = [factory(real("float64")) for factory in factories.ON_CPU.values()]  # of float32 not all is used
    modules = list(dict.fromkeys(module for each in made for module in sorted(factories.modules(each), key=lambda m: m.name)))
    for module in modules[int(WORKER.removeprefix("gw")) :: WORKERS]:
        module.load("cpu", block_dim=1)
