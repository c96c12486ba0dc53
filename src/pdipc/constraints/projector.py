"""The local step (Algorithm 1, line 9): all local projections at once, and what they pull at each vertex."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import (
    curved_bending,
    edge_length,
    point_attachment,
    quadratic_bending,
    tet_strain,
    tet_volume,
    triangle_area,
    triangle_strain,
)
from pdipc.constraints.base import ConstraintSet
from pdipc.device.launch import Device, Reducer
from pdipc.device.precision import Real

KINDS = (
    tet_strain,
    tet_volume,
    triangle_strain,
    triangle_area,
    edge_length,
    quadratic_bending,
    curved_bending,
    point_attachment,
)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    vec3 = real.vec3

    @wp.kernel(module=real.module(__name__))
    def gather(
        first: int,
        base: wp.array(dtype=vec3),
        offsets: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        corners: wp.array(dtype=vec3),
        sum_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        total = base[i]
        for k in range(offsets[i], offsets[i + 1]):
            total += corners[slots[k]]
        sum_out[i] = total

    return SimpleNamespace(gather=gather)


class Projector:
    """Local projections of `sets` over `n_vertices` vertices. count: number of elements ("# Con." of Table 1).

    anchors: the points of attachments in the order of their sets, (k,) vec3 each; assign to them to move the points.
    """

    def __init__(self, device: Device, real: Real, n_vertices: int, sets: list[ConstraintSet]):
        known = {kind.NAME: kind for kind in KINDS}
        self.device, self.real, self.n = device, real, n_vertices
        self.sets = [s for s in sets if len(s)]
        self.count = sum(len(s) for s in self.sets)
        self._batches = []
        self.anchors: list[wp.array] = []
        slot = element = 0
        for s in self.sets:
            if s.kind not in known:
                raise ValueError(f'constraint kind "{s.kind}" is unknown; there are: {", ".join(known)}')
            kind = known[s.kind]
            vector = wp.types.vector(kind.CORNERS, wp.int32)
            rest = kind.arguments(device, real, s)
            if kind is point_attachment:
                self.anchors.append(rest[0])
            arrays = [wp.array(s.vertices, dtype=vector, device=device.warp), *rest]
            arrays.append(wp.array(s.weight, dtype=real.scalar, device=device.warp))
            self._batches.append((kind.kernels(real), len(s), arrays, slot, element))
            slot += s.vertices.size
            element += len(s)
        vertices = np.concatenate([np.zeros(0, dtype=np.int32), *(s.vertices.ravel() for s in self.sets)])
        order = np.argsort(vertices, kind="stable").astype(np.int32)
        offsets = np.searchsorted(vertices[order], np.arange(n_vertices + 1)).astype(np.int32)
        self._offsets = wp.array(offsets, device=device.warp)
        self._slots = wp.array(np.append(order, 0).astype(np.int32), device=device.warp)
        self._corners = wp.zeros(max(1, slot), dtype=real.vec3, device=device.warp)
        self._energies = wp.zeros(max(1, element), dtype=real.scalar, device=device.warp)
        self._sum = Reducer(device, real, element)
        self._gather = kernels(real).gather

    def add_forces(self, x: wp.array, force_out: wp.array, base: wp.array) -> None:
        """force_out = base + sum over elements of w G^T (p - G x): the right-hand side of Eq. (3) less A x, without mass.

        Every corner writes to a place of its own and every vertex gathers its own: no atomics. Recordable.
        """
        for kind, count, arrays, slot, _ in self._batches:
            self.device.launch(kind.force, count, [*arrays, x, slot, self._corners], grain=16)
        self.device.launch(self._gather, self.n, [base, self._offsets, self._slots, self._corners, force_out], grain=8)

    def energy(self, x: wp.array, out: wp.array, slot: int) -> None:
        """out[slot] = Psi(x), J: the sum of all elements' energies. Recordable."""
        for kind, count, arrays, _, element in self._batches:
            self.device.launch(kind.energy, count, [*arrays, x, element, self._energies], grain=16)
        self._sum.sum(self._energies, out, slot)
