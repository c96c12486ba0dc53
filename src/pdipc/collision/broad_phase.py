"""Collision culling (Algorithm 1, line 13; Section 7.2): which pairs of primitives may meet."""

from typing import Any

import warp as wp

from pdipc.collision import bvh, patches
from pdipc.collision.sieve import everything
from pdipc.collision.surface import Surface
from pdipc.device.launch import Device
from pdipc.device.precision import Real

METHODS = {"bvh": bvh.Bvh, "patches": patches.PatchCulling}
AUTO = "patches"  # measured: docs/culling.md


class BroadPhase:
    """Finds candidate pairs: "bvh", by trees over primitives, or "patches" (Section 7.2). Both list the same.

    lists: vertex-triangle pairs (vertex, triangle) and edge-edge pairs (edge, later edge), each with `pairs` (vec2i, sorted by
    first, then second) and `count` on the device. overflow: (1,) int32 on the device, set where a list was too short.
    """

    def __init__(self, device: Device, real: Real, surface: Surface, method: str = "auto"):
        self.overflow = wp.zeros(1, dtype=wp.int32, device=device.warp)
        make = METHODS[AUTO if method == "auto" else method]
        self.searcher = make(device, real, surface, self.overflow)
        self.everything = everything(real)
        self.lists = [self.searcher.vertex_triangle, self.searcher.edge_edge]

    def find(self, x0: wp.array, x1: wp.array, reach: wp.array, sieve: Any = None) -> None:
        """Lists every pair whose boxes overlap; a primitive's box holds, of each vertex v, x0_v and x1_v grown by reach_v (m).

        Left out: pairs that share a vertex, pairs of two obstacles, and what a `Sieve` stops. Recordable.
        """
        self.searcher.find(x0, x1, reach, self.everything if sieve is None else sieve)

    def restructure(self, x: wp.array, reach: wp.array) -> None:
        """Builds what `find` searches anew around x, for speed."""
        self.searcher.restructure(x, reach)

    def grow(self) -> bool:
        """Makes room for what overflowed; returns whether anything had to."""
        return any([self.searcher.grow(), *(found.grow() for found in self.lists)])
