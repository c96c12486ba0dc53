"""Many CCD queries at once, from NumPy."""

import functools
import numbers
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.collision import ccd
from pdipc.device.language import kernel
from pdipc.device.launch import Device, one_at_a_time
from pdipc.device.precision import Real
from pdipc.device.precision import real as real_of

KINDS = ("vertex_triangle", "edge_edge")
BACKOFF = 0.01  # fraction of the starting gap that is still there at the times returned


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """One kernel for each kind of pair."""
    module = real.module(__name__)
    scalar, vec3 = real.scalar, real.vec3
    functions = ccd.functions(real)

    def batch(time_of):
        @kernel(module)
        def many(
            first: int,
            points: wp.array(dtype=vec3, ndim=2),
            xi: scalar,
            backoff: scalar,
            reach: scalar,
            time_out: wp.array(dtype=scalar),
        ):
            i = first + wp.tid()
            time_out[i] = time_of(
                points[i, 0], points[i, 1], points[i, 2], points[i, 3],
                points[i, 4], points[i, 5], points[i, 6], points[i, 7],
                xi, backoff, reach,
            )  # fmt: skip

        return many

    return SimpleNamespace(vertex_triangle=batch(functions.vertex_triangle), edge_edge=batch(functions.edge_edge))


@one_at_a_time
def time_of_impact(
    points: np.ndarray,
    kind: str,
    *,
    minimum_separation: float = 0.0,
    precision: str = "float64",
    device: str | None = None,
) -> np.ndarray:
    """Conservative times of impact of n pairs of primitives that move linearly over t in [0, 1].

    points: (n, 8, 3) in metres, rows 0 to 3 at t = 0 and rows 4 to 7 at t = 1. kind: "vertex_triangle" (the vertex, then the
    triangle's three) or "edge_edge" (two vertices of each edge). minimum_separation: the distance xi to keep, in metres.
    precision: "float64" or "float32", to which the coordinates are rounded first. device: "cpu", "cuda:0", None for CUDA
    where there is one.

    Returns (n,) float64: a time up to which the distance provably stays above xi, within a hundredth of the starting gap of the
    earliest such time; 0 where the pair starts at xi or closer; inf where it is proven for all of [0, 1].

    Raises ValueError for a wrong shape, kind, precision or type, a separation below zero, and numbers that are not finite.
    """
    if kind not in KINDS:
        raise ValueError(f'kind is "{kind}"; it must be "vertex_triangle" or "edge_edge"')
    real = real_of(precision)
    points = np.asarray(points)
    if points.dtype.kind not in "biuf":
        raise ValueError(f"points holds {points.dtype}; it must hold real numbers")
    if points.ndim != 3 or points.shape[1:] != (8, 3):
        raise ValueError(f"points has shape {points.shape}; it must be (n, 8, 3): four vertices at the start, four at the end")
    if not (isinstance(minimum_separation, numbers.Real) and np.isfinite(minimum_separation) and minimum_separation >= 0.0):
        raise ValueError(f"minimum_separation is {minimum_separation!r}; it must be one number, finite and not negative")
    with np.errstate(over="ignore"):  # what is too large for the precision becomes infinite: points are refused, xi gives 0
        points = points.astype(real.numpy)
        separation = real.numpy.type(minimum_separation)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"points[{bad[0]}] is not finite in {precision} (one of {len(bad)} such queries)")
    where = Device(device)
    n = len(points)
    times = wp.zeros(n, dtype=real.scalar, device=where.warp)
    if float(separation) < minimum_separation:
        separation = np.nextafter(separation, real.numpy.type(np.inf))
    if n:
        moved = wp.array(points, dtype=real.vec3, ndim=2, device=where.warp)
        inputs = [moved, separation, real.scalar(BACKOFF), real.scalar(np.inf), times]
        where.launch(getattr(kernels(real), kind), n, inputs, grain=64)
    found = times.numpy().astype(np.float64)
    return np.where(found > 1.0, np.inf, found)
