"""The log barrier of one pair of primitives, Eq. (4), its derivatives, and what keeps it well-behaved in a solver.

All functions take the gap d = |r| - xi: the distance of the two primitives less their minimum separation.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.device.precision import Real

EXTENSION = 0.5  # gamma: below this fraction of its gap at the start of an outer iteration the barrier goes on as a parabola
PARALLEL = 1.0e-3  # edges whose squared sine is below this are near-parallel


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """The barrier in one precision."""
    scalar, vec3 = real.scalar, real.vec3

    @wp.func
    def barrier(d: scalar, d_hat: scalar) -> scalar:
        """Eq. (4): b(d) = -(d - d_hat)^2 ln(d / d_hat) for 0 < d < d_hat, else 0. In m^2."""
        if d >= d_hat:
            return scalar(0.0)
        return -(d - d_hat) * (d - d_hat) * wp.log(d / d_hat)

    @wp.func
    def barrier_gradient(d: scalar, d_hat: scalar) -> scalar:
        """b'(d) = -2 (d - d_hat) ln(d / d_hat) - (d - d_hat)^2 / d; never positive. In m."""
        if d >= d_hat:
            return scalar(0.0)
        s = d - d_hat
        return -scalar(2.0) * s * wp.log(d / d_hat) - s * s / d

    @wp.func
    def barrier_hessian(d: scalar, d_hat: scalar) -> scalar:
        """b''(d) = -2 ln(d / d_hat) - 4 (d - d_hat) / d + (d - d_hat)^2 / d^2; positive and decreasing."""
        if d >= d_hat:
            return scalar(0.0)
        s = (d - d_hat) / d
        return -scalar(2.0) * wp.log(d / d_hat) - scalar(4.0) * s + s * s

    @wp.func
    def extended_gradient(d: scalar, d_floor: scalar, d_hat: scalar) -> scalar:
        """b'(d), continued below d_floor by its tangent: the iterate may be past contact until it is truncated."""
        at = wp.max(d, d_floor)
        return barrier_gradient(at, d_hat) + barrier_hessian(at, d_hat) * (d - at)

    @wp.func
    def mollifier(a0: vec3, a1: vec3, b0: vec3, b1: vec3) -> scalar:
        """Fades out an edge-edge pair as its edges become parallel: c (2 - c), c = sin^2 / 1e-3, and 1 from c = 1 on.

        The paper has none. Without it two aligned blocks limit-cycle: where edges are parallel the closest points jump.
        """
        e1 = a1 - a0
        e2 = b1 - b0
        c = wp.length_sq(wp.cross(e1, e2)) / (wp.length_sq(e1) * wp.length_sq(e2) * scalar(PARALLEL))
        if c >= scalar(1.0):
            return scalar(1.0)
        return c * (scalar(2.0) - c)

    @wp.func
    def wide_barrier(d: wp.float64, d_hat: wp.float64) -> wp.float64:
        """`barrier` in double precision, whatever the scene's."""
        if d >= d_hat:
            return wp.float64(0.0)
        return -(d - d_hat) * (d - d_hat) * wp.log(d / d_hat)

    @wp.func
    def parallel_gradient(e1: vec3, e2: vec3):
        """c = sin^2 / 1e-3 of two edges, as in `mollifier`, and its gradients by both edge vectors."""
        a = wp.length_sq(e1)
        b = wp.length_sq(e2)
        w = wp.cross(e1, e2)
        scale = scalar(1.0) / (a * b * scalar(PARALLEL))
        c = wp.length_sq(w) * scale
        two = scalar(2.0)
        return c, two * (scale * wp.cross(e2, w) - (c / a) * e1), two * (scale * wp.cross(w, e1) - (c / b) * e2)

    @wp.func
    def smoothed_coulomb(slip: scalar, slip_threshold: scalar) -> scalar:
        """f1(|u|) / |u| of IPC's smoothed Coulomb friction: f1 rises from 0 to 1 over |u| < eps_v h. In 1/m."""
        if slip >= slip_threshold:
            return scalar(1.0) / slip
        return (scalar(2.0) - slip / slip_threshold) / slip_threshold

    return SimpleNamespace(**{name: value for name, value in locals().items() if isinstance(value, wp.Function)})
