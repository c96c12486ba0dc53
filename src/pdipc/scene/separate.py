"""Separates surfaces that intersect, or are too near, at the start: bounded displacements, before anything is simulated.

Which side is the right one? An edge that crosses a surface cuts the mesh graph of its own. Where the surface that is crossed encloses space, the parts
that lie inside are on the wrong side (generalized winding number, Jacobson et al. 2013: it may have holes). Where it is open, as cloth is, the largest
part is on the right side and all others are not (global intersection analysis, Baraff et al. 2003). An edge that cuts nothing off has its nearer end on
the wrong side. Where that does not separate open surfaces, as where sheets cross along a line, so that neither half is wrong more than the other, or along a line
that ends within both, which cuts nothing off, they are tried again by their *order*: one sheet is to lie wholly on one side of the other, the one that is
reached with less motion, and what is over the other on the other side is wrong. Pairs that neither separates, such as sheets across each other, are tried a
third time, one body of each moved as a whole before, until a plane lies between the two, where that is within the limit.

A vertex on the wrong side goes to the nearest point of the surface and a gap beyond, and the surface comes to meet it; each side moves as it may:
obstacles and what pins hold exactly do not, solids as a whole first, each other vertex by itself, and displacements spread to its neighbours so that
elements are strained little.

Nothing here is trusted: the exact witness says when it is done.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pdipc.judge import boxes
from pdipc.judge.witness import edge_triangle_crossings, find_intersections
from pdipc.scene import rods
from pdipc.scene.assembly import Assembly
from pdipc.scene.distances import closest_on_segments, closest_on_triangles, encloses, winding_numbers

MOST = 150  # rounds
PATIENCE = 30  # rounds without fewer crossings, then it ends
RIGID_ROUNDS = 50  # in which solids move as a whole only
GAP = 0.5  # of the activation distance: how far beyond the surface things are put
LIMIT = 0.1  # of the largest body's size: default bound of displacements
SOLID_WEIGHT = 0.1  # how readily a solid moves, beside cloth
NEAREST = 12  # triangles of which the nearest is looked for, by their middles
SPREAD = 0.5  # how much of its neighbours' displacement a vertex takes over in a round
HURRY = 1.5  # times the mean of what a solid's vertices ask for: the deepest ask for more than the mean
OVER = 0.5  # cosine to the normal of a surface from which on a vertex is over it, not beside it
NEAR = 1.2  # of the minimum separation: pairs that start nearer are put apart, too


@dataclass
class Separation:
    """What was done. positions: (n, 3) m. moved: by name, how far the farthest vertex of each body that was moved went, m. crossings: edges
    and triangles that crossed before. left: names of pairs of bodies that could not be separated; limit: the bound of displacements, m.
    """

    positions: np.ndarray
    moved: dict[str, float]
    crossings: int
    left: list[tuple[str, str]]
    limit: float

    def notes(self) -> list[str]:
        """A line for each body that was moved."""
        return [
            f'body "{name}": moved by up to {far:.3g} m, so that nothing intersects or is too near at the start'
            for name, far in self.moved.items()
        ]


def separate(assembly: Assembly, limit: float | None = None) -> Separation:
    """Moves what is not held until nothing of `assembly` intersects and all pairs of bodies keep their minimum separation, by at most
    `limit` m a vertex; None: a part of the largest body's size. The assembly stays as it is.
    """
    limit = LIMIT * assembly.body_sizes[1] if limit is None else limit
    found = _Separator(assembly, limit).run()
    if found.left and (again := _Separator(assembly, limit, by_order=True)).orders:
        found = min(found, again.run(), key=lambda each: len(each.left))
    if found.left and (again := _Separator(assembly, limit)).shift(found.left):
        found = min(found, again.run(), key=lambda each: len(each.left))
    return found


class _Separator:
    """x: (n, 3) m, where the vertices are now. weight: (n,) how readily each moves. pushed: (n,) bool, whether it was ever pushed.

    orders: of pairs of open surfaces that cross, on which side of the second the first is to be, 1 or -1; empty unless `by_order`.
    """

    def __init__(self, assembly: Assembly, limit: float, by_order: bool = False):
        self.assembly, self.limit = assembly, limit
        self.x = assembly.positions.copy()
        self.triangles = assembly.triangles
        sides = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        self.edges = np.unique(sides[sides[:, 0] != sides[:, 1]], axis=0)  # a rod's segment is a triangle (a, b, b)
        self.owner, self.obstacle, held = assembly.body_of_vertex, assembly.obstacle, assembly.scripted
        rigid = np.array([body.kind == "rigid" for body in assembly.bodies])
        solid = rigid | np.array([body.kind == "solid" for body in assembly.bodies])
        self.weight = np.where(held, 0.0, np.where(solid[self.owner], SOLID_WEIGHT, 1.0))
        # solids that nothing holds move as a whole
        loose = solid & (np.bincount(self.owner, held, minlength=len(solid)) == 0)
        self.rigid, self.stiff = loose[self.owner], rigid[self.owner]
        self.half = np.array([body.half_separation for body in assembly.bodies])[self.owner]
        self.gap = GAP * assembly.activation_distance
        self.encloses = [encloses(assembly.positions, body.triangles) for body in assembly.bodies]
        self.mean = _neighbour_mean(assembly)
        self.pushed = np.zeros(len(self.x), dtype=bool)
        self.orders: dict[tuple[int, int], float] = {}
        if by_order:
            crossings = self._crossings()
            for a, b in np.unique(np.sort(self._owners(crossings), axis=1), axis=0):
                if a != b and not (self.encloses[a] or self.encloses[b]):
                    self._order(a, b)

    def shift(self, left: list[tuple[str, str]]) -> bool:
        """Moves bodies that nothing holds as wholes until a plane lies between them and those that they intersect, for the pairs `left` by name:
        one of each pair, along a principal axis of either, the way that is shortest. Whether any could go within the limit.
        """
        bodies, shifted = self.assembly.bodies, False
        number = {body.name: k for k, body in enumerate(bodies)}
        for pair in left:
            a, b = (np.flatnonzero(self.owner == number[name]) for name in pair)
            axes = np.concatenate(
                [np.linalg.svd(self.x[own] - self.x[own].mean(axis=0), full_matrices=False)[2] for own in (a, b)]
            )
            wanted = self.half[a[0]] + self.half[b[0]] + self.gap
            ways = []
            for own, other in ((a, b), (b, a)):
                for axis in (*axes, *-axes) if np.all(self.weight[own] > 0.0) else ():
                    length = (self.x[other] @ axis).max() - (self.x[own] @ axis).min() + wanted
                    ways.append((length, own, self.x[own] + length * axis))
            if ways and pair[0] != pair[1]:
                _, own, there = min(ways, key=lambda way: way[0])
                if np.linalg.norm(there - self.assembly.positions[own], axis=1).max() <= self.limit:
                    self.x[own], shifted = there, True
        return shifted

    def run(self) -> Separation:
        crossings = self._crossings()
        first, best, best_x, waited = len(crossings), len(crossings), self.x, 0
        near = self._too_near() if not first else None
        for number in range(MOST):
            if len(crossings):
                pushes = self._through(crossings)
            elif near is not None and len(near[0]):
                pushes = near
            else:
                break
            self._apply(*pushes, rigid=number < RIGID_ROUNDS)
            crossings = self._crossings()
            near = self._too_near() if not len(crossings) else None
            waited += 1
            if len(crossings) < best:
                best, best_x, waited = len(crossings), self.x.copy(), 0
            if waited > PATIENCE:
                break
        if len(crossings) > best:
            self.x = best_x
        return self._result(first)

    def _result(self, first: int) -> Separation:
        bodies = self.assembly.bodies
        for body in bodies:
            if len(body.ghosts):  # which follow their rods
                own = slice(body.first, body.first + body.count)
                rest, radius = self.assembly.rest_positions[own], body.material.radius  # pyright: ignore
                self.x[body.ghosts] = rods.ghost_points(rest, self.x[own], body.segments - body.first, body.joints, radius)[1]
        pairs = find_intersections(self.x, self.triangles, self.obstacle)
        left = np.unique(np.sort(self.owner[self.triangles[pairs][:, :, 0]], axis=1), axis=0)
        far = np.linalg.norm(self.x - self.assembly.positions, axis=1)
        largest = np.zeros(len(bodies))
        np.maximum.at(largest, self.owner, far)
        moved = {body.name: float(largest[k]) for k, body in enumerate(bodies) if largest[k] > 0.0}
        names = [(bodies[a].name, bodies[b].name) for a, b in left]
        return Separation(self.x, moved, first, names, self.limit)

    # --- what is wrong ---

    def _crossings(self) -> np.ndarray:
        """(k, 2): an edge and a triangle that cross, not both of obstacles."""
        found = edge_triangle_crossings(self.x, self.edges, self.triangles)
        both = self.obstacle[self.edges[found[:, 0], 0]] & self.obstacle[self.triangles[found[:, 1], 0]]
        return found[~both]

    def _through(self, crossings: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pushes of vertices on the wrong side through the surface that they are behind; see `_apply`."""
        owners = self._owners(crossings)
        pushes = []
        settled = np.zeros(len(crossings), dtype=bool)
        for a, b in np.unique(owners, axis=0):
            own = np.flatnonzero(np.all(owners == (a, b), axis=1))
            if (a, b) in self.orders:
                _, height, push = self._over(a, b)
                wrong = height * self.orders[a, b] < 0.0
                pushes += [tuple(each[wrong] for each in push), self._wrong_ends(crossings[own], self.orders[a, b])]
                settled[own] = True
                continue
            part = self._wrong(a, b, crossings[own])
            if a == b:
                settled[own] |= (part[self.edges[crossings[own, 0]]] >= 0).any(axis=1)
                candidates = self._candidates_within(a, crossings[own], part)
            else:
                settled[own] |= (part[self.edges[crossings[own, 0]]] >= 0).any(axis=1)
                candidates = np.flatnonzero(self.owner[self.triangles[:, 0]] == b)
            vertices = np.flatnonzero(part >= 0)
            if len(vertices):
                pushes.append(self._pushed(vertices, candidates, part if a == b else None))
        # crossings that cut nothing off, seen from neither side: the nearer end goes through
        for a, b in np.unique(np.sort(owners, axis=1), axis=0):
            own = np.all(np.sort(owners, axis=1) == (a, b), axis=1)
            if not settled[own].any():
                pushes.append(self._nearer_ends(crossings[own]))
        return tuple(np.concatenate(columns) for columns in zip(*pushes, strict=True))

    def _owners(self, crossings: np.ndarray) -> np.ndarray:
        """(k, 2): the body of the edge and that of the triangle of crossings."""
        return np.column_stack([self.owner[self.edges[crossings[:, 0], 0]], self.owner[self.triangles[crossings[:, 1], 0]]])

    def _over(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
        """The vertices of body a over or under the open surface of b within the limit: which, how high, m, and their pushes through it."""
        body = self.assembly.bodies[a]
        candidates = np.flatnonzero(self.owner[self.triangles[:, 0]] == b)
        push = self._pushed(np.unique(body.triangles), candidates, None)
        quads, weights, _, lengths = push
        corners = self.x[quads[:, 1:]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        away = np.einsum("kc,kci->ki", weights, self.x[quads])
        height = np.einsum("ki,ki->k", away, normal) / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
        far = lengths - self._wanted(quads)
        over = (np.abs(height) > OVER * far) & (far < 2.0 * self.limit)
        return quads[over, 0], height[over], tuple(each[over] for each in push)

    def _wrong_ends(self, crossings: np.ndarray, side: float) -> tuple[np.ndarray, ...]:
        """Pushes of edges' ends that are on the wrong side of the triangles that they cross, along the normals of these, whatever is beside them."""
        ends, faces = self.edges[crossings[:, 0]], self.triangles[crossings[:, 1]]
        corners = self.x[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal *= side / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        height = np.einsum("kei,ki->ke", self.x[ends] - corners[:, :1], normal)
        row, low = np.arange(len(ends)), np.argmin(height, axis=1)
        share = (height[row, 1 - low] / np.maximum(np.ptp(height, axis=1), 1e-300))[:, None]  # of the low end in the crossing
        crossing = share * self.x[ends[row, low]] + (1.0 - share) * self.x[ends[row, 1 - low]]
        quads = np.column_stack([ends[row, low], faces])
        weights = np.column_stack([np.ones(len(ends)), -closest_on_triangles(crossing, corners)])
        return quads, weights, normal, self._wanted(quads) - height[row, low]

    def _order(self, a: int, b: int) -> None:
        """Decides which of two open surfaces that cross is above the other: what takes less motion."""
        vertices, height, push = self._over(a, b)
        below, above = (np.sum(np.maximum(sign * height, 0.0)) for sign in (-1.0, 1.0))
        side = 1.0 if above >= below else -1.0
        # b is to be on the other side of a, along a's own normal
        faces = self.triangles[self.owner[self.triangles[:, 0]] == a]
        corners = self.x[faces]
        normals = np.zeros_like(self.x)
        for k in range(3):
            np.add.at(normals, faces[:, k], np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        along = np.sum(np.einsum("ki,ki->k", normals[vertices], push[2]) * -np.sign(height))
        self.orders[a, b] = side
        self.orders[b, a] = -side if along >= 0.0 else side

    def _wrong(self, a: int, b: int, crossings: np.ndarray) -> np.ndarray:
        """(n,) int: which part of body a each vertex belongs to that is on the wrong side of body b; -1 for all others."""
        body = self.assembly.bodies[a]
        of_body = np.flatnonzero(self.owner[self.edges[:, 0]] == a)
        own, cut = self.edges[of_body], np.unique(crossings[:, 0])
        kept = own[~np.isin(of_body, cut)] - body.first
        count = body.last - body.first
        graph = scipy.sparse.coo_matrix((np.ones(len(kept)), kept.T), shape=(count, count))
        _, label = connected_components(graph, directed=False)
        ends = np.unique(label[self.edges[cut] - body.first])
        if self.encloses[b]:
            other = self.assembly.bodies[b]
            first = np.array([np.flatnonzero(label == each)[0] for each in ends])
            inside = winding_numbers(self.x[first + body.first], self.x[other.triangles]) > 0.5
            wrong = ends[inside]
        else:
            surface = np.unique(body.triangles) - body.first
            sizes = np.bincount(label[surface], minlength=label.max() + 1)
            whole = scipy.sparse.coo_matrix((np.ones(len(own)), (own - body.first).T), shape=(count, count))
            _, piece = connected_components(whole, directed=False)
            piece_of = np.zeros(len(sizes), dtype=np.int64)
            piece_of[label] = piece
            largest = np.zeros(piece.max() + 1, dtype=np.int64)
            order = np.argsort(sizes, kind="stable")
            largest[piece_of[order]] = order  # the last one stays
            wrong = ends[ends != largest[piece_of[ends]]]
        part = np.full(len(self.x), -1)
        chosen = np.isin(label, wrong) & np.isin(np.arange(count), np.unique(body.triangles) - body.first)
        part[np.flatnonzero(chosen) + body.first] = label[chosen]
        return part

    def _candidates_within(self, a: int, crossings: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Triangles of a body that parts of it may have to go back through: those that are crossed, and those of other parts."""
        own = self.owner[self.triangles[:, 0]] == a
        return np.union1d(crossings[:, 1], np.flatnonzero(own & (part[self.triangles] >= 0).any(axis=1)))

    def _pushed(self, vertices: np.ndarray, candidates: np.ndarray, part: np.ndarray | None) -> tuple[np.ndarray, ...]:
        """Each vertex to the nearest point of the triangles, and the gap beyond. part: vertices of one part do not push themselves."""
        corners = self.x[self.triangles[candidates]]
        count = min(NEAREST, len(candidates))
        _, near = cKDTree(corners.mean(axis=1)).query(self.x[vertices], k=count)
        near = np.asarray(near).reshape(len(vertices), count)
        points = np.repeat(vertices, count)
        faces = self.triangles[candidates[near.ravel()]]
        weights = closest_on_triangles(self.x[points], self.x[faces])
        ways = np.einsum("kc,kci->ki", weights, self.x[faces]) - self.x[points]
        lengths = np.linalg.norm(ways, axis=1)
        shared = (faces == points[:, None]).any(axis=1)
        if part is not None:
            shared |= (part[faces] == part[points][:, None]).any(axis=1)
        lengths[shared] = np.inf
        best = np.argmin(lengths.reshape(-1, count), axis=1) + count * np.arange(len(vertices))
        best = best[np.isfinite(lengths[best])]
        return self._push(points[best], faces[best], weights[best], ways[best], lengths[best])

    def _nearer_ends(self, crossings: np.ndarray) -> tuple[np.ndarray, ...]:
        ends, faces = self.edges[crossings[:, 0]], self.triangles[crossings[:, 1]]
        corners = self.x[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        above = np.abs(np.einsum("kei,ki->ke", self.x[ends] - corners[:, :1], normal))
        vertices = ends[np.arange(len(ends)), np.argmin(above, axis=1)]
        weights = closest_on_triangles(self.x[vertices], corners)
        ways = np.einsum("kc,kci->ki", weights, corners) - self.x[vertices]
        return self._push(vertices, faces, weights, ways, np.linalg.norm(ways, axis=1))

    def _push(self, vertices, faces, weights, ways, lengths) -> tuple[np.ndarray, ...]:
        """Quads, weights of their witness points, directions, and how far the first side has to go along them relative to the other."""
        corners = self.x[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        touching = lengths < 1e-9 * self.assembly.body_sizes[0]
        directions = np.where(touching[:, None], normal, ways / np.maximum(lengths, 1e-300)[:, None])
        quads = np.column_stack([vertices, faces])
        return quads, np.column_stack([np.ones(len(vertices)), -weights]), directions, lengths + self._wanted(quads)

    def _wanted(self, quads: np.ndarray) -> np.ndarray:
        return self.half[quads[:, 0]] + self.half[quads[:, 3]] + self.gap

    def _too_near(self) -> tuple[np.ndarray, ...]:
        """Pushes of pairs of two bodies that are nearer than their minimum separation."""
        x, reach = self.x, NEAR * self.half
        points = np.unique(self.triangles)[:, None]
        found = []
        for first, second in ((points, self.triangles), (self.edges, self.edges)):
            bounds = [(x[kind] - reach[kind][..., None], x[kind] + reach[kind][..., None]) for kind in (first, second)]
            (low_a, high_a), (low_b, high_b) = ((low.min(axis=1), high.max(axis=1)) for low, high in bounds)
            for met in boxes.parts(low_a, high_a, low_b, high_b):
                i, j = first[met[:, 0]], second[met[:, 1]]
                apart = (self.owner[i[:, 0]] != self.owner[j[:, 0]]) & ~(self.obstacle[i[:, 0]] & self.obstacle[j[:, 0]])
                if first is second:
                    apart &= met[:, 0] < met[:, 1]
                i, j = i[apart], j[apart]
                if first is second:
                    s, t = closest_on_segments(x[i], x[j])
                    weights = np.column_stack([1.0 - s, s, t - 1.0, -t])
                else:
                    weights = np.column_stack([np.ones(len(i)), -closest_on_triangles(x[i[:, 0]], x[j])])
                quads = np.column_stack([i, j])
                ways = np.einsum("kc,kci->ki", weights, x[quads])
                lengths = np.linalg.norm(ways, axis=1)
                close = (lengths < NEAR * (self.half[quads[:, 0]] + self.half[quads[:, 3]])) & (lengths > 0.0)
                quads, weights, ways, lengths = quads[close], weights[close], ways[close], lengths[close]
                found.append((quads, weights, ways / lengths[:, None], self._wanted(quads) - lengths))
        return tuple(np.concatenate(columns) for columns in zip(*found, strict=True))

    # --- what is done ---

    def _apply(self, quads: np.ndarray, weights: np.ndarray, directions: np.ndarray, ways: np.ndarray, rigid: bool) -> None:
        """Moves the two sides of each push apart along its direction by `ways`, as a mean over the pushes of a vertex, or of a body."""
        n = len(self.x)
        give = weights * weights * self.weight[quads]
        total = give.sum(axis=1)
        free = total > 0.0
        quads, weights, directions, ways, total = (each[free] for each in (quads, weights, directions, ways, total))
        own = (weights * self.weight[quads] * (ways / total)[:, None])[:, :, None] * directions[:, None, :]
        as_whole = self.rigid & rigid | self.stiff
        if as_whole.any():
            # a body gives way as readily as its vertices do
            side = np.where(self.owner[quads] == self.owner[quads[:, :1]], 0, 1)
            gives = np.array([np.where(side == k, self.weight[quads], 0.0).max(axis=1) for k in (0, 1)])
            part = gives / np.maximum(gives.sum(axis=0), 1e-300)
            sign = np.where(side == 0, 1.0, -1.0)
            whole = (sign * ways[:, None] * np.where(side == 0, part[0][:, None], part[1][:, None]))[:, :, None] * directions[
                :, None, :
            ]
            own = np.where(as_whole[quads][:, :, None], whole, own)
        parts = np.abs(weights) * (self.weight[quads] > 0.0)
        count = np.bincount(quads.ravel(), parts.ravel(), minlength=n)
        moves = (parts[:, :, None] * own).reshape(-1, 3)
        move = np.column_stack([np.bincount(quads.ravel(), moves[:, k], minlength=n) for k in range(3)])
        before = self.x - self.assembly.positions
        self.pushed |= count > 0.0
        moved = before + move / np.maximum(count, 1e-12)[:, None]
        # what was pushed stays where it was pushed to
        moved = np.where(self.pushed[:, None], moved, (1.0 - SPREAD) * moved + SPREAD * (self.mean @ moved))
        moved = np.where((self.weight > 0.0)[:, None], moved, 0.0)
        if as_whole.any():
            bodies = len(self.assembly.bodies)
            total = np.bincount(self.owner, count, minlength=bodies)
            mean = np.column_stack([np.bincount(self.owner, move[:, k], minlength=bodies) for k in range(3)])
            mean *= HURRY / np.maximum(total, 1e-12)[:, None]
            moved = np.where(as_whole[:, None], before + mean[self.owner], moved)
        far = np.linalg.norm(moved, axis=1)
        moved *= np.minimum(1.0, self.limit / np.maximum(far, 1e-300))[:, None]
        self.x = self.assembly.positions + moved


def _neighbour_mean(assembly: Assembly) -> scipy.sparse.csr_array:
    """(n, n): the mean over a vertex's neighbours in its mesh."""
    n = len(assembly.positions)
    elements = [(assembly.triangles, 3), (assembly.tets, 4)]
    pairs = [e[:, [a, b]] for e, width in elements for a in range(width) for b in range(width) if a != b]
    rows, columns = np.concatenate(pairs).T
    graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsr()
    graph.data[:] = 1.0
    return scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / np.maximum(graph.sum(axis=1), 1.0)) @ graph)
