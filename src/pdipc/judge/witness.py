"""The independent witness: does a triangle mesh intersect itself? Exact, and without any code of the collision detection.

Two triangles meet if and only if an edge of one meets the other, so it is enough to test edges against triangles that share no
vertex with them. Signs of determinants are taken in floating point where its error bound (Shewchuk 1997) leaves no doubt, and
in integers otherwise, as where something overflows: the verdict is that of exact arithmetic on the numbers given, up to 1e300 m.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from pdipc.judge import boxes

ORIENT2D_ERROR = (3.0 + 16.0 * 2.0**-53) * 2.0**-53  # Shewchuk's ccwerrboundA
ORIENT3D_ERROR = (7.0 + 56.0 * 2.0**-53) * 2.0**-53  # Shewchuk's o3derrboundA
UNDERFLOW = 1e-290  # far above what a product loses by underflow; times the factor that what was lost is multiplied with


def find_intersections(positions: np.ndarray, triangles: np.ndarray, obstacle: np.ndarray | None = None) -> np.ndarray:
    """All pairs of triangles that have a point in common which is no part of a vertex or edge that they share.

    positions: (n, 3). triangles: (m, 3) indices; a segment of a rod is a triangle without area, (a, b, b). obstacle: (n,) bool, vertices of obstacles; triangles of obstacles may meet
    each other, as a post stands in a floor, and such pairs are left out.

    Returns (k, 2) int64, i < j in each row, rows ascending; touching counts.
    Triangles that share one vertex are tested away from it; triangles that share an edge meet beyond it only when they lie
    folded flat on each other, and this is reported.

    Raises ValueError where positions are not finite or indices are out of range.
    """
    positions = np.ascontiguousarray(positions, dtype=np.float64)
    triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    if not np.all(np.isfinite(positions)):
        vertex = int(np.flatnonzero(~np.isfinite(positions).all(axis=1))[0])
        raise ValueError(f"positions[{vertex}] = {positions[vertex].tolist()} is not finite")
    if len(triangles) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    lowest, highest = triangles.min(), triangles.max()
    if lowest < 0 or highest >= len(positions):
        raise ValueError(f"triangles use the vertices {lowest} to {highest}; there are 0 to {len(positions) - 1}")

    sides = _edges(triangles)
    return _meeting(positions, triangles, obstacle, sides, edge_triangle_crossings(positions, sides[0], triangles))


class Watch:
    """`find_intersections` for states of one mesh that lie near each other, such as those of a solve, where boxes of edges and triangles are most
    of the work: they are looked up once, each larger by `margin` m to all sides, and again when a coordinate has changed by more than that since.
    Until then boxes that overlap are among these.
    """

    def __init__(self, triangles: np.ndarray, obstacle: np.ndarray | None = None, margin: float = 1e-3):
        self.triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
        self.obstacle, self.margin = obstacle, margin
        self.sides = edges, owner, first = _edges(self.triangles)
        self.fixed = np.zeros(len(self.triangles), dtype=bool)
        if obstacle is not None:
            self.fixed = np.asarray(np.asarray(obstacle)[self.triangles].all(axis=1))
        self.fixed_edge = np.logical_and.reduceat(self.fixed[owner], first[:-1]) if len(edges) else np.zeros(0, dtype=bool)
        self.start: np.ndarray | None = None

    def __call__(self, positions: np.ndarray) -> np.ndarray:
        """What `find_intersections(positions, triangles, obstacle)` returns; positions (n, 3), finite."""
        edges = self.sides[0]
        if self.start is None or not np.abs(positions - self.start).max() <= self.margin:
            self.start, self.near = positions.copy(), self._list(positions)
        (low, high), (low_t, high_t) = (_bounds(positions, of) for of in (edges, self.triangles))
        e, t = self.near.T
        for axis in range(3):
            kept = (low[e, axis] <= high_t[t, axis]) & (low_t[t, axis] <= high[e, axis])
            e, t = e[kept], t[kept]
        crossings = edge_triangle_crossings(positions, edges, self.triangles, [np.column_stack([e, t])])
        return _meeting(positions, self.triangles, self.obstacle, self.sides, crossings)

    def _list(self, positions: np.ndarray) -> np.ndarray:
        """(c, 2): edges and triangles that share no vertex, not both of obstacles, whose boxes overlap once they have grown."""
        edges, triangles = self.sides[0], self.triangles
        grown = self.margin * (1.0 + 1e-9) + 1e-12 * np.abs(positions).max()  # more than what sums round
        found = []
        for of_edges, of_triangles in ((~self.fixed_edge, slice(None)), (self.fixed_edge, ~self.fixed)):
            e, t = np.flatnonzero(of_edges), np.arange(len(triangles))[of_triangles]
            if not len(e) or not len(t):
                continue
            (low, high), (low_t, high_t) = _bounds(positions, edges[e]), _bounds(positions, triangles[t])
            low, high, low_t, high_t = low - grown, high + grown, low_t - grown, high_t + grown
            e_near = np.all((low <= high_t.max(axis=0)) & (high >= low_t.min(axis=0)), axis=1)
            t_near = np.all((low_t <= high.max(axis=0)) & (high_t >= low.min(axis=0)), axis=1)
            pairs = boxes.overlapping(low[e_near], high[e_near], low_t[t_near], high_t[t_near])
            found.append(np.column_stack([e[e_near][pairs[:, 0]], t[t_near][pairs[:, 1]]]))
        pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *found])
        return pairs[np.all(edges[pairs[:, 0], :, None] != triangles[pairs[:, 1], None], axis=(1, 2))]


def _bounds(positions: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corners (m, 3) of the boxes around elements (m, k)."""
    points = positions[corners]
    return points.min(axis=1), points.max(axis=1)


def _meeting(positions, triangles, obstacle, sides, crossings) -> np.ndarray:
    """The pairs of triangles that `find_intersections` returns; sides: `_edges(triangles)`; crossings: (c, 2) edges and triangles that meet."""
    edges, owner, first = sides
    # every triangle that has the edge meets the triangle that the edge meets
    counts = np.diff(first)[crossings[:, 0]]
    rows = np.repeat(np.arange(len(crossings)), counts)
    places = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts) + first[crossings[rows, 0]]
    pairs = np.column_stack([owner[places], crossings[rows, 1]])
    pairs = np.concatenate([pairs, _folded(positions, triangles, edges, owner, first)])
    if obstacle is not None:
        pairs = pairs[~np.asarray(obstacle)[triangles[pairs]].all(axis=(1, 2))]
    return np.unique(np.sort(pairs, axis=1), axis=0)


@np.errstate(over="ignore", invalid="ignore")  # what overflows is in doubt
def edge_triangle_crossings(
    positions: np.ndarray, edges: np.ndarray, triangles: np.ndarray, candidates: Iterable[np.ndarray] | None = None
) -> np.ndarray:
    """(k, 2): edge and triangle that share no vertex and have a point in common. candidates: arrays (c, 2) of those whose boxes overlap, where
    they are known.
    """
    ends, corners = positions[edges], positions[triangles]
    if candidates is None:
        candidates = boxes.parts(*_bounds(positions, edges), *_bounds(positions, triangles))
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(u, v)
    normal_sum = _cross_of_magnitudes(u, v)
    found = [np.zeros((0, 2), dtype=np.int64)]
    for pairs in candidates:
        e, t = edges[pairs[:, 0]], triangles[pairs[:, 1]]
        apart = np.all(e[:, :, None] != t[:, None, :], axis=(1, 2))
        pairs = pairs[apart]
        t = pairs[:, 1]
        above = [_sign(w, normal[t], normal_sum[t]) for w in (ends[pairs[:, 0], k] - a[t] for k in (0, 1))]
        kept = above[0] * above[1] <= 0
        pairs, crosses_plane = pairs[kept], (above[0] * above[1] < 0)[kept]
        p, q = ends[pairs[:, 0], 0], ends[pairs[:, 0], 1]
        sides = []
        for k in range(3):
            r, s = corners[pairs[:, 1], k], corners[pairs[:, 1], (k + 1) % 3]
            u_p, v_p = r - p, s - p
            sides.append(_sign(q - p, np.cross(u_p, v_p), _cross_of_magnitudes(u_p, v_p)))
        low, high = np.min(sides, axis=0), np.max(sides, axis=0)
        certain = crosses_plane & (np.abs(low + high) == 2)
        doubtful = pairs[~certain & (low * high >= 0)]
        doubtful = doubtful[~_separated_in_projection(ends[doubtful[:, 0]], corners[doubtful[:, 1]])]
        exact = [segment_meets_triangle(*ends[i], *corners[j]) for i, j in doubtful]
        found += [pairs[certain], doubtful[np.array(exact, dtype=bool)]]
    return np.concatenate(found)


def _edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unique edges (e, 2); their triangles `owner`: those of edge i are owner[first[i]:first[i + 1]]."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, which = np.unique(sides, axis=0, return_inverse=True)
    which = which.ravel()
    owner = np.argsort(which, kind="stable") // 3
    return edges, owner, np.concatenate([[0], np.cumsum(np.bincount(which, minlength=len(edges)))])


@np.errstate(over="ignore", invalid="ignore")
def _folded(positions, triangles, edges, owner, first) -> np.ndarray:
    """Pairs of triangles that share an edge and lie in one plane on the same side of it."""
    counts = np.diff(first)
    found = [np.zeros((0, 2), dtype=np.int64)]
    for i in range(counts.max()):
        for j in range(i + 1, counts.max()):
            edge = np.flatnonzero(counts > j)
            pair = np.column_stack([owner[first[edge] + i], owner[first[edge] + j]])
            other = pair[:, 0] != pair[:, 1]  # a segment of a rod (a, b, b) has its edge twice
            edge, pair = edge[other], pair[other]
            ends = edges[edge]
            # the third corner; where a triangle names a vertex twice, it has no area and folds onto nothing
            tips = [triangles[pair[:, k]].sum(axis=1) - ends.sum(axis=1) for k in (0, 1)]
            o, d = positions[ends[:, 0]], positions[ends[:, 1]] - positions[ends[:, 0]]
            arms = [positions[tip] - o for tip in tips]
            normals = [np.cross(d, arm) for arm in arms]
            bounds = [_cross_of_magnitudes(d, arm) for arm in arms]
            doubt = 16 * 2.0**-53 * np.einsum("ij,ij->i", *bounds) + UNDERFLOW * (
                1.0 + sum(each.sum(axis=1) for each in bounds)
            )
            same_side = np.einsum("ij,ij->i", *normals) > -doubt
            flat = _sign(arms[1], normals[0], bounds[0]) == 0
            for row in np.flatnonzero(same_side & flat):
                if _is_folded(*positions[[*ends[row], tips[0][row], tips[1][row]]]):
                    found.append(pair[row : row + 1])
    return np.concatenate(found)


# --- signs in floating point, 0 where in doubt ---


def _cross_of_magnitudes(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3): what the rounding errors of u x v are measured by."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    u, v = np.abs(u), np.abs(v)
    return u[:, ahead] * v[:, behind] + u[:, behind] * v[:, ahead]


def _sign(w: np.ndarray, normal: np.ndarray, normal_sum: np.ndarray) -> np.ndarray:
    """Sign of w . normal with normal = u x v, of differences u, v, w of points."""
    value = np.einsum("ij,ij->i", w, normal)
    size = np.abs(w)
    bound = ORIENT3D_ERROR * np.einsum("ij,ij->i", size, normal_sum) + UNDERFLOW * (1.0 + size.sum(axis=1))
    return np.where(np.abs(value) > bound, np.sign(value), 0.0)


def _separated_in_projection(ends: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n,) bool: some projection along an axis, and a line through two of the five points, surely separates the two.

    Decides nearly all that is coplanar, such as every flat cloth.
    """
    points = np.concatenate([ends, corners], axis=1)
    separated = np.zeros(len(points), dtype=bool)
    for x, y in ((0, 1), (1, 2), (2, 0)):
        flat = points[:, :, [x, y]]
        for i, j in ((0, 1), (2, 3), (3, 4), (4, 2)):
            side = np.zeros((len(points), 5))
            for k in set(range(5)) - {i, j}:
                left = (flat[:, i, 0] - flat[:, k, 0]) * (flat[:, j, 1] - flat[:, k, 1])
                right = (flat[:, i, 1] - flat[:, k, 1]) * (flat[:, j, 0] - flat[:, k, 0])
                sure = np.abs(left - right) > ORIENT2D_ERROR * (np.abs(left) + np.abs(right)) + UNDERFLOW
                side[:, k] = np.where(sure, np.sign(left - right), np.nan)
            # the line's own two points count as neither side: strictness comes from the other body
            segment, triangle = side[:, :2], side[:, 2:]
            if i == 0:
                separated |= np.all(triangle > 0, axis=1) | np.all(triangle < 0, axis=1)
            else:
                inner = side[:, ({2, 3, 4} - {i, j}).pop()]
                separated |= (inner > 0) & np.all(segment < 0, axis=1) | (inner < 0) & np.all(segment > 0, axis=1)
    return separated


# --- exact, in Python's integers ---

Point = Sequence[int]


def _integers(*points: np.ndarray) -> list[list[int]]:
    """The points times one power of two that makes every coordinate whole."""
    ratios = [[float(x).as_integer_ratio() for x in point] for point in points]
    scale = max(denominator for point in ratios for _, denominator in point)
    return [[numerator * (scale // denominator) for numerator, denominator in point] for point in ratios]


def _minus(a: Point, b: Point) -> list[int]:
    return [x - y for x, y in zip(a, b, strict=True)]


def _cross(a: Point, b: Point) -> list[int]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a: Point, b: Point) -> int:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _of(value: int) -> int:
    return (value > 0) - (value < 0)


def _orient3d(a: Point, b: Point, c: Point, d: Point) -> int:
    return _of(_dot(_cross(_minus(b, a), _minus(c, a)), _minus(d, a)))


def _is_folded(u: np.ndarray, v: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    iu, iv, ia, ib = _integers(u, v, a, b)
    edge = _minus(iv, iu)
    return _orient3d(iu, iv, ia, ib) == 0 and _dot(_cross(edge, _minus(ia, iu)), _cross(edge, _minus(ib, iu))) > 0


def segment_meets_triangle(p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:
    """Whether the closed segment p q and the closed triangle a b c (five (3,) points) share a point, exactly."""
    ip, iq, ia, ib, ic = _integers(p, q, a, b, c)
    normal = _cross(_minus(ib, ia), _minus(ic, ia))
    if not any(normal):  # a triangle without area is its edges
        return any(_segments_meet(ip, iq, r, s) for r, s in ((ia, ib), (ib, ic), (ic, ia)))
    above = [_of(_dot(normal, _minus(point, ia))) for point in (ip, iq)]
    if above[0] * above[1] > 0:
        return False
    if any(above):
        sides = {_orient3d(ip, iq, r, s) for r, s in ((ia, ib), (ib, ic), (ic, ia))}
        return not {-1, 1} <= sides
    axis = next(k for k in range(3) if normal[k])
    fp, fq, *corners = ([x for k, x in enumerate(point) if k != axis] for point in (ip, iq, ia, ib, ic))
    sides = {_orient2d(r, s, fp) for r, s in ((corners[0], corners[1]), (corners[1], corners[2]), (corners[2], corners[0]))}
    inside = not {-1, 1} <= sides
    return inside or any(_segments_meet_2d(fp, fq, corners[k], corners[k - 1]) for k in range(3))


def _segments_meet(p: Point, q: Point, a: Point, b: Point) -> bool:
    normal = next((n for n in (_cross(_minus(q, p), _minus(r, p)) for r in (a, b)) if any(n)), None)
    if normal is None:  # p q is a point, or all four lie on a line
        normal = _cross(_minus(b, a), _minus(p, a))
        if not any(normal):
            return all(max(min(p[k], q[k]), min(a[k], b[k])) <= min(max(p[k], q[k]), max(a[k], b[k])) for k in range(3))
    if any(_dot(normal, _minus(r, p)) for r in (q, a, b)):
        return False
    axis = next(k for k in range(3) if normal[k])
    return _segments_meet_2d(*([x for k, x in enumerate(point) if k != axis] for point in (p, q, a, b)))


def _orient2d(a: Point, b: Point, c: Point) -> int:
    return _of((a[0] - c[0]) * (b[1] - c[1]) - (a[1] - c[1]) * (b[0] - c[0]))


def _segments_meet_2d(p: Point, q: Point, a: Point, b: Point) -> bool:
    if _orient2d(p, q, a) * _orient2d(p, q, b) > 0 or _orient2d(a, b, p) * _orient2d(a, b, q) > 0:
        return False
    return all(max(min(p[k], q[k]), min(a[k], b[k])) <= min(max(p[k], q[k]), max(a[k], b[k])) for k in range(2))
