"""Attachment of a vertex to a point along some of the axes: a rail, a plane, a height. The projection of x is the point along these, and
x along the others.

The points are `Projector.rails`, in the order of the elements. The Hessian w diag(axes) is the same for ever, and no multiple of the
identity; for Newton's matrix it is a coupling, `Rails`.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints.base import ConstraintSet, make_set
from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real

NAME = "axis_attachment"
CORNERS = 1
PROJECTIVE = True


def rest(points: np.ndarray, vertices: np.ndarray, axes: np.ndarray, stiffness) -> ConstraintSet:
    """Attaches `vertices` (k,) to `points` (k, 3) m along axes (k, 3), 1 or 0, with springs of `stiffness` N/m, one or one each."""
    vertices = np.asarray(vertices).reshape(-1, 1)
    data = {"point": np.asarray(points, dtype=np.float64), "axes": np.asarray(axes, dtype=np.float64)}
    return make_set(NAME, vertices, np.ones((len(vertices), 1, 1)), stiffness, **data)


def arguments(device: Device, real: Real, s: ConstraintSet) -> list:
    """What the kernels take between the vertices and the weights: the points and the axes."""
    return [wp.array(s.data[name], dtype=real.vec3, device=device.warp) for name in ("point", "axes")]


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    module = real.module(__name__)
    element = wp.types.vector(1, wp.int32)

    @kernel(module)
    def force(
        first: int,
        vertices: wp.array(dtype=element),
        point: wp.array(dtype=vec3),
        axes: wp.array(dtype=vec3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        corners_out: wp.array(dtype=vec3),
    ):
        """w (p - x) along the axes."""
        e = first + wp.tid()
        v = vertices[e][0]
        corners_out[offset + e] = weight[e] * wp.cw_mul(axes[e], (point[e] - base[v]) - u[v])

    @kernel(module)
    def energy(
        first: int,
        vertices: wp.array(dtype=element),
        point: wp.array(dtype=vec3),
        axes: wp.array(dtype=vec3),
        weight: wp.array(dtype=scalar),
        base: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        offset: int,
        energy_out: wp.array(dtype=wp.float64),
    ):
        e = first + wp.tid()
        v = vertices[e][0]
        d = wp.vec3d()
        for k in range(3):
            d[k] = wp.float64(axes[e][k]) * (wp.float64(point[e][k]) - wp.float64(base[v][k]) - wp.float64(u[v][k]))
        energy_out[offset + e] = wp.float64(0.5) * wp.float64(weight[e]) * wp.length_sq(d)

    @kernel(module)
    def multiply(
        first: int,
        vertices: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=mat33),
        p: wp.array(dtype=vec3),
        y_out: wp.array(dtype=vec3),
    ):
        k = first + wp.tid()
        i = vertices[k]
        y_out[i] = y_out[i] + blocks[k] * p[i]

    @kernel(module)
    def stiffen(
        first: int,
        vertices: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=mat33),
        diagonal_out: wp.array(dtype=mat33),
    ):
        k = first + wp.tid()
        i = vertices[k]
        diagonal_out[i] = diagonal_out[i] + blocks[k]

    return SimpleNamespace(force=force, energy=energy, multiply=multiply, stiffen=stiffen)


class Rails:
    """The Hessian of a set as what Newton's matrix has beside the blocks of elements (`linear.block_pcg.Coupling`).

    diagonal: None, what it adds to the preconditioner is added to the matrix's own, see `stiffen`.
    """

    diagonal = rows = None

    def __init__(self, device: Device, real: Real, s: ConstraintSet):
        self.device, self._kernels = device, kernels(real)
        held, own = np.unique(s.vertices[:, 0], return_inverse=True)
        blocks = np.zeros((len(held), 3, 3))  # kg/s^2
        np.add.at(blocks, own.ravel(), s.weight[:, None, None] * np.eye(3) * s.data["axes"][:, None, :])
        self._blocks = wp.array(blocks, dtype=real.mat33, device=device.warp)
        self._vertices, self._count = wp.array(held.astype(np.int32), device=device.warp), len(held)

    def apply(self, p: wp.array, y: wp.array) -> None:
        """y += w diag(axes) p. Recordable."""
        self.device.launch(self._kernels.multiply, self._count, [self._vertices, self._blocks, p, y])

    def stiffen(self, diagonal: wp.array) -> None:
        """diagonal: (n,) 3x3 blocks, to which its own are added. Recordable."""
        self.device.launch(self._kernels.stiffen, self._count, [self._vertices, self._blocks, diagonal])

    def couple(self, modes) -> None:
        """Nothing: few vertices, which the diagonal knows."""

    def operand(self) -> None:
        """None: there is `apply`."""
