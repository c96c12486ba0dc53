"""Collision culling (Algorithm 1, line 13; Section 7.2): which pairs of primitives may meet."""

from dataclasses import dataclass

import warp as wp

from pdipc.contact import bvh
from pdipc.contact.surface import Surface
from pdipc.parallel import Device
from pdipc.precision import Real


@dataclass
class Pairs:
    """Candidates: vertex_triangle (vertex, triangle) and edge_edge (edge, later edge) as vec2i, sorted by first, then second.

    The arrays may be longer than the counts.
    """

    vertex_triangle: wp.array
    edge_edge: wp.array
    vertex_triangle_count: int
    edge_edge_count: int


class BroadPhase:
    """Finds candidate pairs, by primitive BVH."""

    def __init__(self, device: Device, real: Real, surface: Surface):
        self.searcher = bvh.Bvh(device, real, surface)

    def find(self, x0: wp.array, x1: wp.array, reach: wp.array) -> Pairs:
        """Every pair whose boxes overlap; a primitive's box holds, of each vertex v, x0_v and x1_v grown by reach_v (m).

        Left out: pairs that share a vertex, and pairs of which all vertices are kinematic.
        """
        self.searcher.find(x0, x1, reach)
        s = self.searcher
        return Pairs(s.vertex_triangle.pairs, s.edge_edge.pairs, s.vertex_triangle.count, s.edge_edge.count)
