"""The log barrier of one pair of primitives, Eq. (4), its derivatives, and what keeps it well-behaved in a solver.

All functions take the gap d = |r| - xi: the distance of the two primitives less their minimum separation.
"""

import warp as wp

from pdipc.device.language import func
from pdipc.device.precision import Scalar, Vec3

EXTENSION = 0.5  # gamma: below this fraction of its gap at the start of an outer iteration the barrier goes on as a parabola
FORESEEN = 0.5  # of d_hat: where the barrier of a pair is linearized that something scripted is about to close
PARALLEL = 1.0e-3  # edges whose squared sine is below this are near-parallel


@func
def barrier(d: Scalar, d_hat: Scalar):
    """Eq. (4): b(d) = -(d - d_hat)^2 ln(d / d_hat) for 0 < d < d_hat, else 0. In m^2."""
    if d >= d_hat:
        return type(d)(0.0)
    return -(d - d_hat) * (d - d_hat) * wp.log(d / d_hat)


@func
def barrier_gradient(d: Scalar, d_hat: Scalar):
    """b'(d) = -2 (d - d_hat) ln(d / d_hat) - (d - d_hat)^2 / d; never positive. In m."""
    if d >= d_hat:
        return type(d)(0.0)
    s = d - d_hat
    return -type(d)(2.0) * s * wp.log(d / d_hat) - s * s / d


@func
def barrier_hessian(d: Scalar, d_hat: Scalar):
    """b''(d) = -2 ln(d / d_hat) - 4 (d - d_hat) / d + (d - d_hat)^2 / d^2; positive and decreasing."""
    if d >= d_hat:
        return type(d)(0.0)
    s = (d - d_hat) / d
    return -type(d)(2.0) * wp.log(d / d_hat) - type(d)(4.0) * s + s * s


@func
def extended_gradient(d: Scalar, d_floor: Scalar, d_hat: Scalar):
    """b'(d), continued below d_floor by its tangent: the iterate may be past contact until it is truncated."""
    at = wp.max(d, d_floor)
    return barrier_gradient(at, d_hat) + barrier_hessian(at, d_hat) * (d - at)


@func
def mollifier(a0: Vec3, a1: Vec3, b0: Vec3, b1: Vec3):
    """Fades out an edge-edge pair as its edges become parallel: c (2 - c), c = sin^2 / 1e-3, and 1 from c = 1 on.

    The paper has none. Without it two aligned blocks limit-cycle: where edges are parallel the closest points jump.
    """
    e1 = a1 - a0
    e2 = b1 - b0
    c = wp.length_sq(wp.cross(e1, e2)) / (wp.length_sq(e1) * wp.length_sq(e2) * type(a0[0])(PARALLEL))
    if c >= type(a0[0])(1.0):
        return type(a0[0])(1.0)
    return c * (type(a0[0])(2.0) - c)


@func
def parallel_gradient(e1: Vec3, e2: Vec3):
    """c = sin^2 / 1e-3 of two edges, as in `mollifier`, and its gradients by both edge vectors."""
    a = wp.length_sq(e1)
    b = wp.length_sq(e2)
    w = wp.cross(e1, e2)
    scale = type(e1[0])(1.0) / (a * b * type(e1[0])(PARALLEL))
    c = wp.length_sq(w) * scale
    two = type(e1[0])(2.0)
    return c, two * (scale * wp.cross(e2, w) - (c / a) * e1), two * (scale * wp.cross(w, e1) - (c / b) * e2)


@func
def smoothed_coulomb(slip: Scalar, slip_threshold: Scalar):
    """f1(|u|) / |u| of IPC's smoothed Coulomb friction: f1 rises from 0 to 1 over |u| < eps_v h. In 1/m."""
    if slip >= slip_threshold:
        return type(slip)(1.0) / slip
    return (type(slip)(2.0) - slip / slip_threshold) / slip_threshold
