"""How a step stands: codes, and places in the arrays that the device keeps and the host reads once a step."""

import functools
from typing import Any

import warp as wp

from pdipc.device.language import struct_of
from pdipc.device.precision import Real

STAGES = ("solver", "ccd", "barrier", "misc")
STARTED, LAST = wp.constant(len(STAGES)), wp.constant(len(STAGES) + 1)  # places of the clock, in milliseconds

RUNNING, CONVERGED, LAGGING, CAPPED, OUT_OF_TIME, STALLING, OVERFLOW, NOT_FINITE = (wp.constant(code) for code in range(8))

# `count`, int32: of a step
# OUTER: outer iterations; SINCE: those since something scripted came to a waypoint; IDLE: those in a row that
# lowered no potential by more than rounding
STATUS, OUTER, TRUNCATIONS, BARRIERS, SEARCHES, STALLED, MOVING, SINCE, IDLE = (wp.constant(place) for place in range(9))
COUNTS = 9

# `numbers`, in the scene's precision: the largest motion that the last outer iteration wanted, m; the largest force that is left, N, and
# the largest force of inertia, to compare it with; how far something scripted is behind, m; the motion that the iteration before wanted, and
# the one that last wanted it while nothing was held back, m; by what part the last motion
# wanted would change the curvature of a barrier, at most; how far forces that are not balanced would move a body as a whole, m
MOVED, FORCE, FORCE_SCALE, LAG, MOVED_BEFORE, MOVED_FREELY, BARRIER_CHANGE, UNBALANCED = (
    wp.constant(place) for place in range(8)
)
NUMBERS = 8


@functools.cache
def progress(real: Real) -> Any:
    """A struct: how a step stands."""
    return struct_of(
        "Progress",
        __name__,
        count=wp.array(dtype=wp.int32),
        numbers=wp.array(dtype=real.scalar),
        clock=wp.array(dtype=wp.float64),
        going=wp.array(dtype=wp.int32),  # (1,) whether outer iterations go on
    )
