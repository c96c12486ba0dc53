"""Implicit Euler around the solve: lines 1, 2 and 18 of Algorithm 1, the clock and the report of a step."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from pdipc.device import system
from pdipc.device.language import kernel, struct_of
from pdipc.device.precision import Real
from pdipc.integration import status

# What a step reports after its counts, in one array that the host reads once: iterations, numbers, gap, then the stages' times.
LOCAL_GLOBAL, LINEAR, GAP, FOREIGN, CHORDS, FIRST_NUMBER = (wp.constant(status.COUNTS + place) for place in range(6))
TIMES = wp.constant(status.COUNTS + 5 + status.NUMBERS)
SIZE = status.COUNTS + 5 + status.NUMBERS + len(status.STAGES)


@functools.cache
def start(real: Real) -> Any:
    """A struct: where a step starts."""
    return struct_of(
        "Start",
        __name__,
        x=wp.array(dtype=real.vec3),  # m
        rest=wp.array(dtype=real.vec3),  # m, what rounding took off x
        v=wp.array(dtype=real.vec3),  # m/s
        a=wp.array(dtype=real.vec3),  # m/s^2
    )


@functools.cache
def inertial(real: Real) -> Any:
    """A struct: what the potential of inertia and damping takes."""
    return struct_of(
        "Inertial",
        __name__,
        rest=wp.array(dtype=real.vec3),  # m, displacement at the start
        z=wp.array(dtype=real.vec3),  # m, inertial displacement
        mass=wp.array(dtype=real.scalar),  # kg
        free=wp.array(dtype=real.scalar),
        h=real.scalar,  # s
        damping=real.scalar,  # 1/s
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Start, Progress = real.scalar, real.vec3, start(real), status.progress(real)
    module = real.module(__name__)

    @kernel(module)
    def compare(
        first: int,
        x_start: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        foreign_out: wp.array(dtype=wp.int32),
    ):
        """Whether a step starts anywhere but where the last one ended."""
        i = first + wp.tid()
        for axis in range(3):
            if x_start[i][axis] != x[i][axis]:
                foreign_out[0] = 1

    @kernel(module)
    def predict(
        first: int,
        s: Start,
        acceleration: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        h: scalar,
        u_out: wp.array(dtype=vec3),
        z_out: wp.array(dtype=vec3),
        u_tilde_out: wp.array(dtype=vec3),
    ):
        """Lines 1 and 2 as displacements: z - x* = h v* + h^2 M^-1 f_ext, x~ - x* = h v* + h^2/4 a*. Kinematic vertices: their target.

        rest: what rounding took off the position x* when it was stored; nothing where x* + rest is not x* to the bit, as after a change of
        positions from outside: where no motion is proven a step ends at x* + rest (`collision.truncation`).
        """
        i = first + wp.tid()
        own = s.rest[i]
        for axis in range(3):
            if s.x[i][axis] + own[axis] != s.x[i][axis]:
                own[axis] = scalar(0.0)
        s.rest[i] = own
        u_out[i] = own
        if free[i] > scalar(0.0):
            inertial = s.rest[i] + h * s.v[i]
            z_out[i] = inertial + h * h * acceleration[i]
            u_tilde_out[i] = inertial + scalar(0.25) * h * h * s.a[i]
        else:
            z_out[i] = target[i] - s.x[i]
            u_tilde_out[i] = target[i] - s.x[i]

    @kernel(module)
    def begin(first: int, progress: Progress, local_global_out: wp.array(dtype=wp.int32), linear_out: wp.array(dtype=wp.int32)):
        for i in range(status.COUNTS):
            progress.count[i] = 0
        for i in range(status.NUMBERS):
            progress.numbers[i] = scalar(0.0)
        local_global_out[0] = 0
        linear_out[0] = 0
        progress.going[0] = 1

    @kernel(module)
    def finish(
        first: int,
        s: Start,
        u: wp.array(dtype=vec3),
        u_velocity: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        free: wp.array(dtype=scalar),
        h: scalar,
        rest_out: wp.array(dtype=vec3),
        v_out: wp.array(dtype=vec3),
        a_out: wp.array(dtype=vec3),
    ):
        """Line 18: v = (x - x*) / h, a = (v - v*) / h; and what rounding took off x. u_velocity: the motion that the velocity is of."""
        i = first + wp.tid()
        velocity = (u_velocity[i] - s.rest[i]) / h
        a_out[i] = (velocity - s.v[i]) / h
        v_out[i] = velocity
        left = (s.x[i] - x[i]) + u[i]
        if free[i] == scalar(0.0):
            left = vec3()
        rest_out[i] = left

    @kernel(module)
    def report(
        first: int,
        progress: Progress,
        local_global: wp.array(dtype=wp.int32),
        linear: wp.array(dtype=wp.int32),
        closest: wp.array(dtype=scalar),
        foreign: wp.array(dtype=wp.int32),
        chords: wp.array(dtype=wp.int32),
        report_out: wp.array(dtype=wp.float64),
    ):
        for i in range(status.COUNTS):
            report_out[i] = wp.float64(progress.count[i])
        report_out[LOCAL_GLOBAL] = wp.float64(local_global[0])
        report_out[LINEAR] = wp.float64(linear[0])
        report_out[FOREIGN] = wp.float64(foreign[0])
        report_out[CHORDS] = wp.float64(chords[0])
        report_out[GAP] = wp.float64(wp.inf)
        if progress.count[status.BARRIERS] > 0:
            report_out[GAP] = wp.float64(closest[0])
        for i in range(status.NUMBERS):
            report_out[FIRST_NUMBER + i] = wp.float64(progress.numbers[i])
        for stage in range(status.STARTED):
            report_out[TIMES + stage] = progress.clock[stage]

    milliseconds = system.milliseconds()  # the step is one graph, so its stages are timed where it runs

    @kernel(module)
    def start_clock(first: int, call: wp.uint64, argument: wp.int64, clock: wp.array(dtype=wp.float64)):
        for i in range(clock.shape[0]):
            clock[i] = wp.float64(0.0)
        now = milliseconds(call, argument)
        clock[status.STARTED] = now
        clock[status.LAST] = now

    @kernel(module)
    def mark(first: int, stage: int, call: wp.uint64, argument: wp.int64, clock: wp.array(dtype=wp.float64)):
        """The time since the last mark belongs to `stage`."""
        now = milliseconds(call, argument)
        clock[stage] = clock[stage] + now - clock[status.LAST]
        clock[status.LAST] = now

    return SimpleNamespace(
        compare=compare,
        predict=predict,
        begin=begin,
        finish=finish,
        report=report,
        start_clock=start_clock,
        mark=mark,
    )
