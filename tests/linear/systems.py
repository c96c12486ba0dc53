"""Systems of Eq. (3) for the solver tests: cloth and tetrahedral blocks from Young's modulus, density and step size."""

import numpy as np
import scipy.sparse as sp
import scipy.spatial


def tet_grid(cells: int, size: float = 0.2, jitter: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A cube of cells^3 boxes cut into six tetrahedra each (all along the same diagonal): vertices and tetrahedra."""
    n = cells + 1
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    corner = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = lambda c: (c[:, 0] * n + c[:, 1]) * n + c[:, 2]  # noqa: E731
    tets = []
    for a, b, c in ((0, 1, 2), (1, 0, 2), (1, 2, 0), (2, 1, 0), (2, 0, 1), (0, 2, 1)):
        path = [corner]
        for axis in (a, b, c):
            path.append(path[-1] + np.eye(3, dtype=int)[axis])
        tets.append(np.stack([index(p) for p in path], axis=1))
    x = grid * (size / cells)
    inner = np.all((grid > 0) & (grid < cells), axis=1)
    x[inner] += jitter * size / cells * np.random.default_rng(seed).uniform(-0.5, 0.5, (inner.sum(), 3))
    return x, _oriented(x, np.concatenate(tets))


def tet_delaunay(points: int, size: float = 0.2, seed: int = 0, least_quality: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Random points in a cube, tetrahedralized by Delaunay; tetrahedra flatter than `least_quality` are left out."""
    rng = np.random.default_rng(seed)
    side = max(2, round(points ** (1 / 3)))
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) / (side - 1)
    x = (grid + rng.uniform(-0.5, 0.5, grid.shape) / (side - 1)) * size
    tets = _oriented(x, scipy.spatial.Delaunay(x).simplices)
    volume = np.linalg.det(x[tets[:, 1:]] - x[tets[:, :1]]) / 6.0
    edges = np.linalg.norm(x[tets[:, [0, 0, 0, 1, 1, 2]]] - x[tets[:, [1, 2, 3, 2, 3, 3]]], axis=2)
    quality = 6.0 * np.sqrt(2.0) * volume / np.mean(edges**2, axis=1) ** 1.5
    tets = tets[quality > least_quality]
    used, flat = np.unique(tets, return_inverse=True)
    return x[used], flat.reshape(tets.shape)


def _oriented(x: np.ndarray, tets: np.ndarray) -> np.ndarray:
    negative = np.linalg.det(x[tets[:, 1:]] - x[tets[:, :1]]) < 0.0
    tets = tets.copy()
    tets[negative] = tets[negative][:, [1, 0, 2, 3]]
    return tets


def tet_matrix(x: np.ndarray, tets: np.ndarray, young: float = 1e5, density: float = 1e3, h: float = 0.01) -> sp.csr_matrix:
    """M/h^2 + sum of w G^T G for the strain of each tetrahedron, w = 2 mu volume, mu for Poisson's ratio 0.3."""
    edges = np.transpose(x[tets[:, 1:]] - x[tets[:, :1]], (0, 2, 1))
    volume = np.linalg.det(edges) / 6.0
    inverse = np.linalg.inv(edges)
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    weight = 2.0 * young / 2.6 * volume
    mass = np.bincount(tets.ravel(), np.repeat(density * volume / 4.0, 4), len(x))
    return _assemble(len(x), tets, np.einsum("e,eic,ejc->eij", weight, gradient, gradient), mass / h**2)


def cloth_grid(side: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A square cloth of side x side vertices: vertices and triangles, diagonals alternating."""
    i, j = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    x = np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * (size / (side - 1))
    index = i * side + j
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    even = ((i + j)[:-1, :-1] % 2 == 0).ravel()
    first = np.where(even[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(even[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return x, np.concatenate([first, second])


def cloth_parts(
    x: np.ndarray, triangles: np.ndarray, young: float = 1e6, thickness: float = 1e-3, density: float = 200.0, h: float = 0.01
) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """The two parts of A of a cloth: inertia with in-plane strain, and quadratic bending (Bergou et al. 2006)."""
    e1, e2 = x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    metric = np.linalg.inv(np.stack([np.stack([(p * q).sum(1) for q in (e1, e2)], -1) for p in (e1, e2)], -2))
    factor = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    stretch = np.einsum("e,ia,eab,jb->eij", young * thickness * area, factor, metric, factor)
    mass = np.bincount(triangles.ravel(), np.repeat(density * thickness * area / 3.0, 3), len(x))
    inertia = _assemble(len(x), triangles, stretch, mass / h**2)

    half = np.concatenate([triangles[:, [0, 1, 2]], triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]])
    key = np.sort(half[:, :2], axis=1)
    order = np.lexsort((key[:, 1], key[:, 0]))
    same = np.all(key[order[1:]] == key[order[:-1]], axis=1)
    first, second = half[order[:-1][same]], half[order[1:][same]]
    hinge = np.stack([key[order[:-1][same]][:, 0], key[order[:-1][same]][:, 1], first[:, 2], second[:, 2]], axis=1)
    p0, p1, p2, p3 = (x[hinge[:, k]] for k in range(4))

    def cot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (u * v).sum(1) / np.linalg.norm(np.cross(u, v), axis=1)

    c01, c02 = cot(p1 - p0, p2 - p0), cot(p1 - p0, p3 - p0)
    c03, c04 = cot(p0 - p1, p2 - p1), cot(p0 - p1, p3 - p1)
    rows = np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], axis=1)
    pair_area = 0.5 * np.linalg.norm(np.cross(p1 - p0, p2 - p0), axis=1) + 0.5 * np.linalg.norm(
        np.cross(p1 - p0, p3 - p0), axis=1
    )
    rigidity = young * thickness**3 / 12.0
    bending = np.einsum("e,ei,ej->eij", 3.0 * rigidity / pair_area, rows, rows)
    return inertia, _assemble(len(x), hinge, bending, np.zeros(len(x)))


def cloth_matrix(x: np.ndarray, triangles: np.ndarray, **material: float) -> sp.csr_matrix:
    """A of a cloth."""
    inertia, bending = cloth_parts(x, triangles, **material)
    return sp.csr_matrix(inertia + bending)


def _assemble(count: int, elements: np.ndarray, blocks: np.ndarray, diagonal: np.ndarray) -> sp.csr_matrix:
    width = elements.shape[1]
    rows, columns = np.repeat(elements, width, axis=1).ravel(), np.tile(elements, (1, width)).ravel()
    matrix = sp.coo_matrix((blocks.ravel(), (rows, columns)), shape=(count, count)).tocsr()
    matrix = (matrix + matrix.T) / 2.0
    return sp.csr_matrix(matrix + sp.diags_array(diagonal))


def meshes() -> dict[str, tuple[np.ndarray, sp.csr_matrix]]:
    """Small systems of every kind: vertices and matrix."""
    found = {}
    x, tets = tet_grid(5)
    found["regular tets"] = (x, tet_matrix(x, tets))
    x, tets = tet_delaunay(216)
    found["jittered Delaunay"] = (x, tet_matrix(x, tets))
    x, tets = tet_delaunay(216, least_quality=1e-4)
    found["slivers"] = (x, tet_matrix(x, tets))
    x, triangles = cloth_grid(14)
    found["soft cloth"] = (x, cloth_matrix(x, triangles, young=1e4))
    found["stiff cloth"] = (x, cloth_matrix(x, triangles, young=1e6))
    return found
