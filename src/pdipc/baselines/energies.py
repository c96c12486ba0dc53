"""Elastic energies w/2 |F - P(F)|^2 of linear maps F = G x, and their derivatives.

Projective dynamics and IPC minimise the same energies here: P projects to the constraint manifold, the local step of the first;
the second needs the Hessian of the squared distance. With F = U diag(s) V^T and P = U diag(p) V^T that is the identity less

    (p_i + p_j) / (s_i + s_j)  on the twists,      (p_i - p_j) / (s_i - s_j)  on the flips,
    p_i / s_i  on the directions out of the plane,  and dp/ds on the scalings

(Smith, de Goes, Kim 2019: Analytic eigensystems for isotropic distortion energies). Keeping each of these at 1 or less makes
the Hessian positive semi-definite.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

SMALLEST = 1e-12  # what a sum of singular values may be divided by

_threads = ThreadPoolExecutor(os.cpu_count() or 1)


def _in_parts(function, values: np.ndarray):
    """function(values) of a batch, split over the cores; LAPACK runs without Python's lock."""
    parts = min(os.cpu_count() or 1, 1 + len(values) // 2000)
    if parts == 1:
        return function(values)
    results = list(_threads.map(function, np.array_split(values, parts)))
    return tuple(map(np.concatenate, zip(*results, strict=True)))


def _svd(f: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """U, s, V of (k, 3, r) maps. For r = 3, U and V are rotations and the last of s carries the sign of det F."""
    u, s, vt = _in_parts(np.linalg.svd, f)
    v = np.swapaxes(vt, 1, 2).copy()
    if f.shape[2] == 3:
        for q in (u, v):
            mirrored = np.linalg.det(q) < 0
            q[mirrored, :, 2] *= -1
            s[mirrored, 2] *= -1
    return u, s, v


def _outer(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[:, :, None] * v[:, None, :]


class Isotropic:
    """A projection that acts on singular values alone: `values(s)` gives p (k, r) and dp/ds (k, r, r), None for zero."""

    def __init__(self, values):
        self.values = values

    def project(self, f: np.ndarray) -> np.ndarray:
        """The nearest point P of the manifold, (k, 3, r)."""
        u, s, v = _svd(f)
        p = self.values(s)[0]
        return np.einsum("kij,kj,klj->kil", u[:, :, : p.shape[1]], p, v)

    def squared_distance(self, f: np.ndarray) -> np.ndarray:
        """|F - P(F)|^2 = |s - p|^2, (k,)."""
        (s,) = _in_parts(lambda part: (np.linalg.svd(part, compute_uv=False),), f)
        if f.shape[2] == 3:
            s[:, 2] *= np.sign(np.linalg.det(f))
        return ((s - self.values(s)[0]) ** 2).sum(axis=1)

    def linearize(self, f: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """P, and dP/dF = sum_q c_q T_q T_q^T as c (k, q) and T (k, q, 3, r)."""
        u, s, v = _svd(f)
        p, slope = self.values(s)
        r = s.shape[1]
        projected = np.einsum("kij,kj,klj->kil", u[:, :, :r], p, v)
        c, modes = [], []
        for i in range(r):
            for j in range(i + 1, r):
                a, b = _outer(u[:, :, i], v[:, :, j]), _outer(u[:, :, j], v[:, :, i])
                c.append((p[:, i] + p[:, j]) / np.maximum(s[:, i] + s[:, j], SMALLEST))
                modes.append((a - b) / np.sqrt(2))
                if slope is not None:
                    apart = s[:, i] - s[:, j]
                    close = np.abs(apart) < 1e-6 * np.abs(s[:, i])
                    limit = slope[:, i, i] - slope[:, i, j]
                    c.append(np.where(close, limit, (p[:, i] - p[:, j]) / np.where(close, 1.0, apart)))
                    modes.append((a + b) / np.sqrt(2))
        if r == 2:
            for i in range(2):
                c.append(p[:, i] / np.maximum(s[:, i], SMALLEST))
                modes.append(_outer(u[:, :, 2], v[:, :, i]))
        if slope is not None:
            scale, direction = np.linalg.eigh(slope)
            for i in range(r):
                c.append(scale[:, i])
                modes.append(np.einsum("kij,kj,klj->kil", u[:, :, :r], direction[:, :, i], v))
        return projected, np.stack(c, axis=1), np.stack(modes, axis=1)


def _ones(s: np.ndarray):
    return np.ones_like(s), None


def _unit_product(s: np.ndarray):
    """The nearest p > 0 with product 1: p_i - s_i + y / p_i = 0, y by Newton's method kept within a bracket.

    The sum of log p_i falls as y rises. Every p_i is the larger root of its equation, but for the smallest, which is the
    smaller root where even the largest y leaves the product above 1.
    """
    rows, last = np.arange(len(s)), np.argmin(s, axis=1)
    largest = np.where(s[rows, last] > 0, 0.25 * s[rows, last] ** 2, 0.0)

    def roots(y: np.ndarray, smaller: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """p, the sum of log p, and its derivative."""
        root = np.sqrt(np.maximum(s * s - 4 * y[:, None], 0.0))
        p = np.where(s > 0, 0.5 * (s + root), -2 * y[:, None] / np.where(s > 0, 1.0, root - s + 1e-300))
        sign = np.full_like(s, -1.0)
        k = rows[smaller]
        p[k, last[k]] = 2 * y[k] / (s[k, last[k]] + root[k, last[k]])
        sign[k, last[k]] = 1.0
        p = np.maximum(p, 1e-300)
        slope = (sign / np.maximum(p * root, 1e-300)).sum(axis=1)
        return p, np.log(p).sum(axis=1), slope

    smaller = roots(largest, np.zeros(len(s), dtype=bool))[1] > 0
    low, high = np.where(smaller, 0.0, -1.0 - np.abs(s).max(axis=1)), largest
    y = np.where(high > 0, np.where(smaller, 0.5 * high, 0.0), 0.5 * low)
    before = high - low
    for _ in range(200):
        _, excess, slope = roots(y, smaller)
        up = (excess > 0) != smaller
        low, high = np.where(up, y, low), np.where(up, high, y)
        newton = y - excess / np.where(slope == 0, np.inf, slope)
        settled = np.abs(newton - y) <= 1e-15 * (1 + np.abs(y))
        if settled.all():
            break
        fast = (newton > low) & (newton < high) & (np.abs(newton - y) < 0.5 * np.abs(before))
        following = np.where(settled, y, np.where(fast, newton, 0.5 * (low + high)))
        before, y = following - y, following
    p = roots(y, smaller)[0]
    # differentiate p_i - s_i + y / p_i = 0 and sum log p_i = 0
    r = s.shape[1]
    system = np.zeros((len(s), r + 1, r + 1))
    system[:, range(r), range(r)] = 1 - y[:, None] / p**2
    system[:, :r, r] = system[:, r, :r] = 1 / p
    return p, np.linalg.inv(system)[:, :r, :r]


def nearest_isometry() -> Isotropic:
    """Rotations for tets, isometries for triangles: strain."""
    return Isotropic(_ones)


def unit_product() -> Isotropic:
    """Maps of determinant, or area, one: preservation of volume and area."""
    return Isotropic(_unit_product)


class Length:
    """Vectors (r = 1) of given lengths (k,): springs, and bending of a curved rest shape."""

    def __init__(self, lengths: np.ndarray):
        self.lengths = np.asarray(lengths, dtype=float)

    def project(self, f: np.ndarray) -> np.ndarray:
        """The vector of the right length in the same direction, (k, 3, 1)."""
        return f * (self.lengths / np.maximum(np.linalg.norm(f[:, :, 0], axis=1), SMALLEST))[:, None, None]

    def squared_distance(self, f: np.ndarray) -> np.ndarray:
        """|F - P(F)|^2, (k,)."""
        return (np.linalg.norm(f[:, :, 0], axis=1) - self.lengths) ** 2

    def linearize(self, f: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """P; and dP/dF, which scales what is across F by L / |F|."""
        size = np.maximum(np.linalg.norm(f[:, :, 0], axis=1), SMALLEST)
        n = f[:, :, 0] / size[:, None]
        n[size == SMALLEST] = (1.0, 0.0, 0.0)
        helper = np.eye(3)[np.argmin(np.abs(n), axis=1)]
        a = np.cross(n, helper)
        a /= np.linalg.norm(a, axis=1)[:, None]
        across = np.stack([a, np.cross(n, a)], axis=1)[:, :, :, None]
        c = (self.lengths / size)[:, None].repeat(2, axis=1)
        return self.project(f), c, across


class Fixed:
    """Given values (k, 3, r): attachment to points; zero for quadratic bending of a flat rest shape."""

    def __init__(self, values: np.ndarray):
        self.values = np.asarray(values, dtype=float)

    def project(self, f: np.ndarray) -> np.ndarray:
        """The given values."""
        return np.broadcast_to(self.values, f.shape)

    def squared_distance(self, f: np.ndarray) -> np.ndarray:
        """|F - P|^2, (k,)."""
        return ((f - self.values) ** 2).sum(axis=(1, 2))

    def linearize(self, f: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The given values, which do not depend on F."""
        return self.project(f), np.zeros((len(f), 0)), np.zeros((len(f), 0, *f.shape[1:]))


@dataclass
class Term:
    """An energy sum_k w_k/2 |F_k - P(F_k)|^2 with F_k = (G_k x)^T.

    vertices: (k, s) stencils. operator: G, (k, r, s). weight: w, (k,). manifold: one of the above.
    """

    vertices: np.ndarray
    operator: np.ndarray
    weight: np.ndarray
    manifold: Isotropic | Length | Fixed

    def __post_init__(self):
        self.weight = np.broadcast_to(np.asarray(self.weight, dtype=float), len(self.vertices)).copy()

    def maps(self, x: np.ndarray) -> np.ndarray:
        """F (k, 3, r) at positions x (n, 3)."""
        return np.einsum("krs,ksi->kir", self.operator, x[self.vertices], optimize=True)

    def energy(self, x: np.ndarray) -> float:
        """In joules."""
        return 0.5 * float(self.weight @ self.manifold.squared_distance(self.maps(x)))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """dE/dx per stencil vertex, (k, s, 3)."""
        f = self.maps(x)
        return self._pull_back(f - self.manifold.project(f))

    def derivatives(self, x: np.ndarray, psd: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (k, s, 3) and Hessian (k, s, 3, s, 3) per stencil; made positive semi-definite if psd."""
        f = self.maps(x)
        projected, c, modes = self.manifold.linearize(f)
        if psd:
            c = np.minimum(c, 1.0)
        k, s = self.vertices.shape
        g = self.operator
        hessian = np.zeros((k, s, 3, s, 3))
        mass = np.matmul(np.swapaxes(g, 1, 2), g)
        for i in range(3):
            hessian[:, :, i, :, i] = mass
        if c.shape[1]:
            rows = np.matmul(modes.reshape(k, -1, g.shape[1]), g).reshape(k, c.shape[1], 3, s)
            rows = np.swapaxes(rows, 2, 3).reshape(k, c.shape[1], 3 * s)
            hessian -= np.matmul(np.swapaxes(rows, 1, 2), c[:, :, None] * rows).reshape(hessian.shape)
        return self._pull_back(f - projected), self.weight[:, None, None, None, None] * hessian

    def projections(self, x: np.ndarray) -> np.ndarray:
        """P per row of `rows`, (k r, 3): the local step."""
        return np.swapaxes(self.manifold.project(self.maps(x)), 1, 2).reshape(-1, 3)

    def rows(self, vertex_count: int) -> tuple[sp.csr_matrix, np.ndarray]:
        """G of all stencils as one sparse matrix (k r, n), and the weight of each row."""
        k, r, s = self.operator.shape
        row = np.repeat(np.arange(k * r), s)
        column = np.repeat(self.vertices, r, axis=0).ravel()
        g = sp.csr_matrix((self.operator.ravel(), (row, column)), shape=(k * r, vertex_count))
        return g, np.repeat(self.weight, r)

    def _pull_back(self, difference: np.ndarray) -> np.ndarray:
        weighted = self.weight[:, None, None] * difference
        return np.einsum("krs,kir->ksi", self.operator, weighted, optimize=True)


def _difference_operator(corners: np.ndarray) -> np.ndarray:
    """G (k, r, r + 1) of simplices (k, r + 1, r): G x = dx/dX, the transposed deformation gradient."""
    r = corners.shape[2]
    spokes = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)  # columns
    g = np.swapaxes(np.linalg.inv(spokes), 1, 2)
    return np.concatenate([-g.sum(axis=2, keepdims=True), g], axis=2).reshape(-1, r, r + 1)


def in_plane(corners: np.ndarray) -> np.ndarray:
    """Triangles (k, 3, 3) in two coordinates of their own plane, (k, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    e1 = a / np.linalg.norm(a, axis=1)[:, None]
    e2 = b - np.einsum("ij,ij->i", b, e1)[:, None] * e1
    e2 /= np.linalg.norm(e2, axis=1)[:, None]
    frame = np.stack([e1, e2], axis=2)
    return np.matmul(corners - corners[:, :1], frame)


def tet_volumes(rest: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Signed volumes, m^3."""
    corners = rest[tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def triangle_areas(rest: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Areas, m^2."""
    c = rest[triangles]
    return 0.5 * np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1)


def tet_strain(rest: np.ndarray, tets: np.ndarray, weight: np.ndarray) -> Term:
    """As rigid as possible: w/2 |F - R|^2 a tet. weight: 2 mu V, J."""
    return Term(tets, _difference_operator(rest[tets]), weight, nearest_isometry())


def tet_volume(rest: np.ndarray, tets: np.ndarray, weight: np.ndarray) -> Term:
    """Volume preservation: w/2 of the squared distance of F to det F = 1."""
    return Term(tets, _difference_operator(rest[tets]), weight, unit_product())


def triangle_strain(rest: np.ndarray, triangles: np.ndarray, weight: np.ndarray) -> Term:
    """w/2 |F - nearest isometry|^2 a triangle. weight: 2 mu t A, J."""
    return Term(triangles, _difference_operator(in_plane(rest[triangles])), weight, nearest_isometry())


def triangle_area(rest: np.ndarray, triangles: np.ndarray, weight: np.ndarray) -> Term:
    """Area preservation: w/2 of the squared distance of the 3 x 2 map F to area 1."""
    return Term(triangles, _difference_operator(in_plane(rest[triangles])), weight, unit_product())


def springs(pairs: np.ndarray, lengths: np.ndarray, stiffness: np.ndarray) -> Term:
    """k/2 (|x_i - x_j| - L)^2 a pair (k, 2). stiffness: N/m."""
    operator = np.broadcast_to(np.array([[[1.0, -1.0]]]), (len(pairs), 1, 2))
    return Term(pairs, operator, stiffness, Length(lengths))


def attachment(vertices: np.ndarray, targets: np.ndarray, stiffness: np.ndarray) -> Term:
    """k/2 |x_i - target|^2 a vertex (k,). stiffness: N/m."""
    return Term(vertices[:, None], np.ones((len(vertices), 1, 1)), stiffness, Fixed(targets[:, :, None]))


def hinges(triangles: np.ndarray) -> np.ndarray:
    """(k, 4) per interior edge: its ends, then the two opposite vertices."""
    sides: dict[tuple[int, int], list[int]] = {}
    for a, b, c in np.asarray(triangles).tolist():
        for i, j, opposite in ((a, b, c), (b, c, a), (c, a, b)):
            sides.setdefault((min(i, j), max(i, j)), []).append(opposite)
    found = [(*edge, *opposite) for edge, opposite in sides.items() if len(opposite) == 2]
    return np.array(found, dtype=int).reshape(-1, 4)


def bending(rest: np.ndarray, triangles: np.ndarray, stiffness: float, curved: bool = False) -> Term:
    """Bending over each interior edge (Wardetzky 2007, Bergou 2006): w/2 |K x|^2, w = 3 k / (A_1 + A_2), K the cotangent row.

    stiffness: k, J. curved: w/2 (|K x| - |K rest|)^2, which keeps a curved rest shape. A rest shape that is curved and not
    `curved` flattens.
    """
    stencil = hinges(triangles)
    x = rest[stencil]

    def cotangent(at, to, other):
        u, v = x[:, to] - x[:, at], x[:, other] - x[:, at]
        return np.einsum("ij,ij->i", u, v) / np.linalg.norm(np.cross(u, v), axis=1)

    c01, c02 = cotangent(0, 1, 2), cotangent(0, 1, 3)  # angles at vertex 0 in both triangles
    c11, c12 = cotangent(1, 0, 2), cotangent(1, 0, 3)
    row = np.stack([c11 + c12, c01 + c02, -c01 - c11, -c02 - c12], axis=1)
    areas = triangle_areas(rest, stencil[:, [0, 1, 2]]) + triangle_areas(rest, stencil[:, [0, 1, 3]])
    bent = np.linalg.norm(np.einsum("ks,ksi->ki", row, x), axis=1)
    manifold = Length(bent) if curved else Fixed(np.zeros((len(stencil), 3, 1)))
    return Term(stencil, row[:, None, :], stiffness / areas, manifold)
