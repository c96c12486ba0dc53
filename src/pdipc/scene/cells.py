"""Polygons cut into triangles, and the cells of volume meshes into tetrahedra."""

import numpy as np

# Faces of the cells that are cut, outward, in the order of vertices that Gmsh, VTK and Medit share.
CELL_FACES = {
    "hexahedron": [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
    "wedge": [[0, 2, 1], [3, 4, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]],
    "pyramid": [[0, 3, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
    "tetra": [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
}
ROUNDING = 1e-12  # of a polygon's extent squared: what lies nearer to an edge lies on it
MOST_CORNERS = 2000  # of a polygon: the time to cut it grows with their square
BETTER = 1.0 + 1e-6  # the second diagonal of a quad is taken where its smaller triangle is larger by this factor


def tetrahedra(kind: str, cells: np.ndarray) -> np.ndarray:
    """(t, 4): cells (c, k) of a kind in `CELL_FACES`, cut so that neighbours agree.

    Every quadrilateral is cut by the diagonal from its vertex of smallest number, so a face is cut alike from both sides
    (Dompierre et al. 1999, "How to subdivide pyramids, prisms and hexahedra into tetrahedra"). A cell is the cone from its own
    smallest vertex over the faces that do not touch it. Tets that a collapsed cell does not fill are left out.
    """
    if kind == "tetra":
        return cells
    apex = np.argmin(cells, axis=1)
    tets = []
    for face in map(np.array, CELL_FACES[kind]):
        away = ~np.isin(apex, face)
        ring, tip = cells[away][:, face], cells[away, apex[away]]
        if len(face) == 4:
            first = np.argmin(ring, axis=1)[:, None]
            ring = np.take_along_axis(ring, (first + np.arange(4)) % 4, axis=1)
        tets += [np.column_stack([tip, ring[:, 0], ring[:, k], ring[:, k + 1]]) for k in range(1, len(face) - 1)]
    whole = np.concatenate(tets) if tets else np.zeros((0, 4), dtype=np.int64)
    ordered = np.sort(whole, axis=1)
    return whole[np.all(ordered[:, 1:] != ordered[:, :-1], axis=1)]


def triangulate(points: np.ndarray, corners: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, int]:
    """Triangles (m, 3) of polygons, n - 2 of each with n corners, and the number of polygons that cross themselves.

    points: (n, 3). corners: the vertices of all polygons, one after another. counts: (p,) corners of each, all at least 3.
    Polygons may be concave. All corners are used, also those on straight sides, so that no neighbour is torn off.
    """
    first = np.cumsum(counts) - counts
    triangles, origin, crossed = [], [], 0
    for size in np.unique(counts):
        which = np.flatnonzero(counts == size)
        rings = corners[first[which, None] + np.arange(size)]
        if size == 3:
            cut = rings[:, None]
        elif size == 4:
            cut, bad = _quads(points, rings)
            crossed += bad
        else:
            cut = np.stack([rings[:, [0, k, k + 1]] for k in range(1, size - 1)], axis=1)
            for number in np.flatnonzero(~_are_fans(points[rings])):
                part, bad = _clip(points[rings[number]])
                cut[number] = rings[number][part]
                crossed += bad
        triangles.append(cut.reshape(-1, 3))
        origin.append(np.repeat(which, size - 2))
    if not triangles:
        return np.zeros((0, 3), dtype=np.int64), 0
    order = np.argsort(np.concatenate(origin), kind="stable")  # triangles in the order of the polygons
    return np.concatenate(triangles)[order], crossed


def _quads(points: np.ndarray, rings: np.ndarray) -> tuple[np.ndarray, int]:
    """(q, 2, 3) triangles of quadrilaterals (q, 4): of the two diagonals the one whose smaller triangle is larger."""
    normal = np.cross(points[rings[:, 2]] - points[rings[:, 0]], points[rings[:, 3]] - points[rings[:, 1]])

    def least(cut: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
        a, b, c = np.moveaxis(points[rings[:, cut]], 2, 0)
        areas = np.cross(b - a, c - a)
        return np.einsum("qti,qi->qt", areas, normal).min(axis=1), np.abs(areas).max(axis=2).min(axis=1)

    one, other = [[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]
    with np.errstate(over="ignore", invalid="ignore"):
        (least_one, size_one), (least_other, size_other) = least(one), least(other)
    turned = (least_other > 0) & (least_other > BETTER * least_one)
    crossed = int(np.count_nonzero((np.maximum(least_one, least_other) <= 0) & (size_one > 0) & (size_other > 0)))
    return np.where(turned[:, None, None], rings[:, other], rings[:, one]), crossed


def _are_fans(rings: np.ndarray) -> np.ndarray:
    """(p,) bool: which polygons (p, n, 3) are cut rightly from their first corner, as all convex ones are."""
    sides = rings[:, 1:] - rings[:, :1]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        normal = np.cross(sides[:, :-1], sides[:, 1:]).sum(axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        flat = sides - np.einsum("pki,pi->pk", sides, normal)[..., None] * normal[:, None]
        areas = np.einsum("pki,pi->pk", np.cross(flat[:, :-1], flat[:, 1:]), normal)
        angles = np.arctan2(areas, np.einsum("pki,pki->pk", flat[:, :-1], flat[:, 1:]))
        extent = np.abs(sides).max(axis=(1, 2))
        return np.all(areas > ROUNDING * extent[:, None] ** 2, axis=1) & (angles.sum(axis=1) < 2 * np.pi - 1e-6)


def _clip(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """(n - 2, 3) corners of the triangles of one polygon (n, 3), by clipping its best-shaped ears; whether it crosses itself."""
    n = len(points)
    if not np.isfinite(points).all():
        return np.array([[0, k, k + 1] for k in range(1, n - 1)]), False
    centered = points - points.mean(axis=0)
    extent = np.abs(centered).max() or 1.0
    centered = centered / extent
    normal = np.cross(centered, np.roll(centered, -1, axis=0)).sum(axis=0)  # Newell's
    axes = np.linalg.svd(centered - np.outer(centered @ normal, normal) / max(normal @ normal, 1e-300))[2][:2]
    flat = centered @ axes.T
    if np.cross(axes[0], axes[1]) @ normal < 0:
        flat = flat * [1.0, -1.0]
    ring, triangles = list(range(n)), []

    def shape(k: int) -> float:
        """Twice the area over the longest side squared; at most 0 where the corner is no ear."""
        ids = [ring[k - 1], ring[k], ring[(k + 1) % len(ring)]]
        a, b, c = flat[ids]
        others = flat[ring]
        others = others[~np.any([np.all(others == p, axis=1) for p in (a, b, c)], axis=0)]
        sides = [_cross(q - p, others - p) for p, q in ((a, b), (b, c), (c, a))]
        if np.any(np.min(sides, axis=0) >= -ROUNDING):
            return 0.0
        longest = max(np.sum((q - p) ** 2) for p, q in ((a, b), (b, c), (c, a)))
        return float(_cross(b - a, c - a)) / longest if longest > 0 else 0.0

    quality = [shape(k) for k in range(n)]
    while len(ring) > 3:
        k = int(np.argmax(quality))
        if quality[k] <= ROUNDING:
            quality = [shape(k) for k in range(len(ring))]  # what was in the way may be gone
            k = int(np.argmax(quality))
            if quality[k] <= ROUNDING:  # what is left has no area, or crosses itself
                break
        triangles.append([ring[k - 1], ring[k], ring[(k + 1) % len(ring)]])
        del ring[k], quality[k]
        for near in (k - 1, k % len(ring)):
            quality[near] = shape(near)
    triangles += [[ring[0], ring[k], ring[k + 1]] for k in range(1, len(ring) - 1)]
    return np.array(triangles), _crosses(flat)


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _crosses(ring: np.ndarray) -> bool:
    """Whether two sides of a polygon (n, 2) cross within both."""
    a, b = ring[:, None], np.roll(ring, -1, axis=0)[:, None]
    side = _cross(b - a, ring - a)  # of each vertex from each side
    parted = side * np.roll(side, -1, axis=1) < 0  # [i, j]: the line of side i parts the ends of side j
    return bool(np.any(parted & parted.T))
