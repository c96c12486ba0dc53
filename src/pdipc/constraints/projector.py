"""Elasticity: all constraints of a model at once, their local step (Algorithm 1, line 9), energies and Hessians."""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from pdipc.constraints import (
    axis_attachment,
    corotated,
    curved_bending,
    edge_length,
    enclosed_volume,
    neo_hookean,
    point_attachment,
    quadratic_bending,
    rod_bending,
    rod_frames,
    rod_ghost,
    stitch,
    strain_limit,
    surface_attachment,
    tet_strain,
    tet_volume,
    triangle_area,
    triangle_strain,
    woven,
    woven_bending,
)
from pdipc.constraints.base import ConstraintSet, merge
from pdipc.device.language import func, kernel, struct_of
from pdipc.device.launch import Device, Reducer
from pdipc.device.precision import Real
from pdipc.device.precision import real as real_of

KINDS = (
    axis_attachment,
    surface_attachment,
    tet_strain,
    tet_volume,
    corotated,
    neo_hookean,
    triangle_strain,
    triangle_area,
    woven,
    strain_limit,
    edge_length,
    quadratic_bending,
    woven_bending,
    curved_bending,
    enclosed_volume,
    stitch,
    rod_bending,
    rod_frames,
    rod_ghost,
    point_attachment,
)


@functools.cache
def corners(real: Real) -> Any:
    """A struct: what elements do to their corners, and where each vertex finds its own."""
    return struct_of(
        "Corners",
        __name__,
        offsets=wp.array(dtype=wp.int32),
        slots=wp.array(dtype=wp.int32),
        forces=wp.array(dtype=real.vec3),  # N
    )


@functools.cache
def kernels_of(real: Real) -> SimpleNamespace:
    scalar, vec3, Corners = real.scalar, real.vec3, corners(real)

    @func
    def total(i: int, force: vec3, o: Corners) -> vec3:
        """A force on vertex i, and what its elements add to it."""
        whole = force
        for k in range(o.offsets[i], o.offsets[i + 1]):
            whole += o.forces[o.slots[k]]
        return whole

    @kernel(real.module(__name__))
    def gather(first: int, force: wp.array(dtype=vec3), o: Corners, force_out: wp.array(dtype=vec3)):
        i = first + wp.tid()
        force_out[i] = total(i, force[i], o)

    @kernel(real.module(__name__))
    def store(first: int, total: wp.array(dtype=wp.float64), slot: int, out: wp.array(dtype=real.scalar)):
        out[slot] = scalar(total[0])

    return SimpleNamespace(total=total, gather=gather, store=store)


class Projector:
    """The constraints `sets` over `n_vertices` vertices. count: number of elements ("# Con." of Table 1).

    sets: one a kind, elements in the order of the bodies. bending: those of them whose Hessian depends on the state, in the order in
    which their blocks are stored.
    anchors: the points of attachments, (k,) vec3, or None; assign to it to move the points.
    rails: likewise of attachments along some axes, and rail_hessian, what they add to Newton's matrix. threads: the lengths of stitches, (k,), or None; assign to it to sew.
    cavities: what closed sheets hold, or None; a part of the Newton matrix as well.
    energies: (count,) float64 on the device, J, in the order of the elements; what `evaluate` fills.
    corners: the forces of elements on their corners, as kernels read them; what `find_forces` fills.
    blocks: 3x3 blocks on the device, what `differentiate` fills: for each element of `bending` those of its corners a <= b, row by row;
    only a < b need be filled, since rows add up to zero.
    """

    def __init__(self, device: Device, real: Real, n_vertices: int, sets: list[ConstraintSet]):
        known = {kind.NAME: kind for kind in KINDS}
        self.device, self.real, self.n = device, real, n_vertices
        for s in sets:
            if s.kind not in known:
                raise ValueError(f'constraint kind "{s.kind}" is unknown; there are: {", ".join(known)}')
        self.sets = merge([s for s in sets if len(s)])
        self.count = sum(len(s) for s in self.sets)
        self.projective = all(known[s.kind].PROJECTIVE for s in self.sets)
        self._batches = []
        self.bending: list[ConstraintSet] = []
        self.anchors: wp.array | None = None
        self.rails: wp.array | None = None
        self.rail_hessian: axis_attachment.Rails | None = None
        self.threads: wp.array | None = None
        self.cavities: enclosed_volume.Cavities | None = None
        slot = element = block = 0
        for s in self.sets:
            kind = known[s.kind]
            vector = wp.types.vector(kind.CORNERS, wp.int32)
            rest = kind.arguments(device, real, s)
            if kind is point_attachment:
                self.anchors = rest[0]
            if kind is axis_attachment:
                self.rails, self.rail_hessian = rest[0], axis_attachment.Rails(device, real, s)
            if kind is stitch:
                self.threads = rest[1]
            if kind is enclosed_volume:
                c = self.cavities = enclosed_volume.Cavities(device, real, n_vertices, s)
                rest = [c.held]
            arrays = [wp.array(s.vertices, dtype=vector, device=device.warp), *rest]
            arrays.append(wp.array(s.weight, dtype=real.scalar, device=device.warp))
            kernels = kind.kernels(real)
            self._batches.append((kernels, len(s), arrays, slot, element, block))
            slot += s.vertices.size
            element += len(s)
            if hasattr(kernels, "hessian"):
                self.bending.append(s)
                block += len(s) * kind.CORNERS * (kind.CORNERS + 1) // 2
        vertices = np.concatenate([np.zeros(0, dtype=np.int32), *(s.vertices.ravel() for s in self.sets)])
        order = np.argsort(vertices, kind="stable").astype(np.int32)
        offsets = np.searchsorted(vertices[order], np.arange(n_vertices + 1)).astype(np.int32)
        self._offsets = wp.array(offsets, device=device.warp)
        self._slots = wp.array(np.append(order, 0).astype(np.int32), device=device.warp)
        self._corners = wp.zeros(max(1, slot), dtype=real.vec3, device=device.warp)
        self.corners = corners(real)()
        self.corners.offsets, self.corners.slots, self.corners.forces = self._offsets, self._slots, self._corners
        self.energies = wp.zeros(max(1, element), dtype=wp.float64, device=device.warp)
        self.block_count = block
        self._kernels = kernels_of(real)
        self._sum, self._total = Reducer(device, real_of("float64"), element), wp.zeros(1, dtype=wp.float64, device=device.warp)

    @functools.cached_property
    def blocks(self) -> wp.array:
        """Made when first asked for: only a solver that uses Hessians needs the room."""
        return wp.zeros(max(1, self.block_count), dtype=self.real.mat33, device=self.device.warp)

    def add_forces(self, base: wp.array, u: wp.array, force_out: wp.array, force: wp.array) -> None:
        """force_out = force + sum over elements of w G^T (p - G x) at x = base + u, for kinds with a projection the right-hand side of
        Eq. (3) less A x, without mass.

        Every corner writes to a place of its own and every vertex gathers its own: no atomics. Recordable.
        """
        self.find_forces(base, u)
        self.device.launch(self._kernels.gather, self.n, [force, self.corners, force_out], grain=8)

    def find_forces(self, base: wp.array, u: wp.array) -> None:
        """Fills `corners` with the forces of `add_forces`, for who adds them up. Recordable."""
        if self.cavities is not None:
            self.cavities.measure(base, u)
        for kind, count, arrays, slot, _, _ in self._batches:
            self.device.launch(kind.force, count, [*arrays, base, u, slot, self._corners], grain=16)

    def evaluate(self, base: wp.array, u: wp.array) -> None:
        """Fills `energies` at x = base + u. Recordable."""
        if self.cavities is not None:
            self.cavities.measure(base, u)
        for kind, count, arrays, _, element, _ in self._batches:
            self.device.launch(kind.energy, count, [*arrays, base, u, element, self.energies], grain=16)

    def energy(self, base: wp.array, u: wp.array, out: wp.array, slot: int) -> None:
        """out[slot] = Psi, J, at x = base + u, in the scene's precision. Recordable."""
        self.evaluate(base, u)
        self._sum.sum(self.energies, self._total)
        self.device.launch_serial(self._kernels.store, [self._total, slot, out])

    def differentiate(self, base: wp.array, u: wp.array, project: wp.array) -> None:
        """Fills `blocks`: the Hessians at x = base + u; project: (1,) int32 on the device, whether each is to be positive semidefinite.
        Recordable.
        """
        if self.cavities is not None:
            self.cavities.differentiate(base, u)
        for kind, count, arrays, _, _, block in self._batches:
            if hasattr(kind, "hessian"):
                self.device.launch(kind.hessian, count, [*arrays, base, u, block, project, self.blocks], grain=64)
