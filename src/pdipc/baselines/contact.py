"""Contact of the IPC baseline: closest points, barriers of distances, lagged friction; culling and CCD by ipctk.

`DistanceBarrier` has pdipc's energy, kappa m b(d) with b(d) = -(d - d_hat)^2 ln(d / d_hat) of the gap d = |r| - xi, so that
states can be compared. `SquaredDistanceBarrier` is ipctk's own potential of squared distances, as in Li et al. 2020.
"""

from dataclasses import dataclass

import ipctk
import numpy as np
import scipy.sparse as sp

PARALLEL = 1e-3  # squared sine below which the mollifier fades an edge-edge pair out
_DIFFERENCES = np.linalg.svd(np.ones((1, 4)))[2][1:]  # (3, 4), orthonormal rows: what a pair's translation leaves as it is


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _on_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameter of the point of a-b that is nearest to p, and the squared distance."""
    ab = b - a
    t = np.clip(_dot(p - a, ab) / np.maximum(_dot(ab, ab), 1e-300), 0.0, 1.0)
    r = p - a - t[:, None] * ab
    return t, _dot(r, r)


def vertex_triangle(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Witness weights a (k, 4) of (vertex, t0, t1, t2) corners (k, 4, 3), r = sum a_i x_i; and da/dbeta (k, 2, 4), zero where a
    parameter is at its bound.
    """
    p, *t = np.swapaxes(corners, 0, 1)
    k = np.arange(len(p))
    u, v, w = t[1] - t[0], t[2] - t[0], p - t[0]
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    det = np.maximum(uu * vv - uv * uv, 1e-300)
    beta = np.stack([(vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det], axis=1)
    inside = (beta > 0).all(axis=1) & (beta.sum(axis=1) < 1)
    sides = np.array([[0, 1], [1, 2], [2, 0]])
    found = [_on_segment(p, t[i], t[j]) for i, j in sides]
    best = np.argmin([square for _, square in found], axis=0)
    along = np.array([parameter for parameter, _ in found])[best, k]
    i, j = 1 + sides[best].T

    weights, slope = np.zeros((len(p), 4)), np.zeros((len(p), 2, 4))
    weights[:, 0] = 1.0
    weights[k, i], weights[k, j] = along - 1.0, -along
    moving = ((along > 0) & (along < 1)).astype(float)
    slope[k, 0, i], slope[k, 0, j] = moving, -moving
    weights[inside, 1:] = -np.stack([1 - beta.sum(axis=1), beta[:, 0], beta[:, 1]], axis=1)[inside]
    slope[inside] = [[0, 1, -1, 0], [0, 1, 0, -1]]
    return weights, slope


def edge_edge(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Witness weights a (k, 4) of (a0, a1, b0, b1) corners (k, 4, 3), and da/d(s, t) (k, 2, 4), as for `vertex_triangle`."""
    a0, a1, b0, b1 = np.swapaxes(corners, 0, 1)
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    det = uu * vv - uv * uv
    solvable = det > 1e-14 * uu * vv
    safe = np.where(solvable, det, 1.0)
    s, t = (uv * wv - vv * wu) / safe, (uu * wv - uv * wu) / safe
    inside = solvable & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    r = w + s[:, None] * u - t[:, None] * v
    zero, one = np.zeros(len(a0)), np.ones(len(a0))
    t0, d0 = _on_segment(a0, b0, b1)
    t1, d1 = _on_segment(a1, b0, b1)
    s0, d2 = _on_segment(b0, a0, a1)
    s1, d3 = _on_segment(b1, a0, a1)
    choice = np.argmin([np.where(inside, _dot(r, r), np.inf), d0, d1, d2, d3], axis=0)
    k = np.arange(len(a0))
    s = np.stack([s, zero, one, s0, s1])[choice, k]
    t = np.stack([t, t0, t1, zero, one])[choice, k]
    weights = np.stack([1 - s, s, t - 1, -t], axis=1)
    slope = np.zeros((len(a0), 2, 4))
    slope[:, 0, :2] = np.where((s > 0) & (s < 1), 1.0, 0.0)[:, None] * [-1, 1]
    slope[:, 1, 2:] = np.where((t > 0) & (t < 1), 1.0, 0.0)[:, None] * [1, -1]
    return weights, slope


def mollifier(corners: np.ndarray) -> np.ndarray:
    """c (2 - c) with c = sin^2 / 1e-3 of edge-edge corners (k, 4, 3), 1 from c = 1 on."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 2]
    across = np.cross(u, v)
    c = np.minimum(_dot(across, across) / (PARALLEL * _dot(u, u) * _dot(v, v)), 1.0)
    return c * (2 - c)


def barrier(d: np.ndarray, d_hat: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """b, b' and b'' of gaps 0 < d < d_hat (Eq. 4)."""
    s, log = d - d_hat, np.log(d / d_hat)
    return -s * s * log, -2 * s * log - s * s / d, -2 * log - 4 * s / d + (s / d) ** 2


def _element_matrix(quads: np.ndarray, hessian: np.ndarray, vertex_count: int) -> sp.csr_matrix:
    """Sums element Hessians (k, 12, 12) into a (3n, 3n) matrix."""
    dofs = (3 * quads[:, :, None] + np.arange(3)).reshape(-1, 12)
    row, column = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()
    return sp.csr_matrix((hessian.ravel(), (row, column)), shape=(3 * vertex_count, 3 * vertex_count))


@dataclass
class Pairs:
    """Pairs nearer than their activation distance. quads (k, 4) vertices; weights a and slope da/dbeta; r (k, 3) = sum a_i x_i;
    length |r|; gap d; activation d_hat, stiffness kappa m, friction coefficient mu, each (k,).
    """

    quads: np.ndarray
    weights: np.ndarray
    slope: np.ndarray
    r: np.ndarray
    length: np.ndarray
    gap: np.ndarray
    activation: np.ndarray
    stiffness: np.ndarray
    friction: np.ndarray


class Surface:
    """The contact surface: triangles (m, 3) over all n vertices; kinematic (n,) bool. For ipctk its vertices are numbered anew,
    simulated ones first.
    """

    def __init__(self, rest: np.ndarray, triangles: np.ndarray, kinematic: np.ndarray):
        used = np.unique(triangles)
        self.vertices = np.concatenate([used[~kinematic[used]], used[kinematic[used]]])
        number = np.full(len(rest), -1, dtype=np.int32)
        number[self.vertices] = np.arange(len(self.vertices))
        faces = np.asfortranarray(number[triangles])
        edges = ipctk.edges(faces)
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(rest[self.vertices]), edges, faces)
        self.mesh.can_collide = ipctk.make_static_obstacle_filter(int((~kinematic[used]).sum()))
        self.triangles = np.asarray(triangles)
        self.edges = self.vertices[np.asarray(self.mesh.edges)]  # ipctk may reorder what it is given
        self.faces = self.vertices[np.asarray(self.mesh.faces)]

    def of(self, x: np.ndarray) -> np.ndarray:
        """The surface's part of positions x (n, 3), as ipctk takes it."""
        return np.asfortranarray(x[self.vertices])

    def intersects(self, x: np.ndarray) -> bool:
        """Whether an edge passes through a triangle, by ipctk."""
        return ipctk.has_intersections(self.mesh, self.of(x))

    def free_step(self, x0: np.ndarray, x1: np.ndarray, separation: float) -> float:
        """A fraction in [0, 1] of the straight motion x0 -> x1 that keeps every pair apart by more than `separation`, m."""
        ccd, broad_phase = ipctk.AdditiveCCD(), ipctk.LBVH()
        return ipctk.compute_collision_free_stepsize(self.mesh, self.of(x0), self.of(x1), separation, broad_phase, ccd)

    def candidates(self, x: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertex-triangle and edge-edge pairs (k, 4), of vertices, that may be nearer than `reach`."""
        found = ipctk.Candidates()
        found.build(self.mesh, self.of(x), 0.5 * reach, ipctk.LBVH())
        vt = np.array([(c.vertex_id, c.face_id) for c in found.fv_candidates], dtype=int).reshape(-1, 2)
        ee = np.array([(c.edge0_id, c.edge1_id) for c in found.ee_candidates], dtype=int).reshape(-1, 2)
        return (
            np.column_stack([self.vertices[vt[:, 0]], self.faces[vt[:, 1]]]),
            np.column_stack([self.edges[ee[:, 0]], self.edges[ee[:, 1]]]),
        )


def mean_stiffness(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """kappa of a pair from those of its sides: their mean; where one is zero (kinematic), the other."""
    return np.where((a == 0) | (b == 0), a + b, 0.5 * (a + b))


class DistanceBarrier:
    """pdipc's barrier: kappa m b(d), d = |r| - xi, kappa constant per pair, the mollifier m frozen per Newton iteration.

    stiffness: kappa per vertex (n,), N/m, 0 for kinematic ones; `pair_stiffness` joins two. activation: d_hat, m.
    separation: xi, m, or half of it per vertex (n,). friction: coefficient or (n,), the geometric mean counts. slip: m, eps_v h
    of the smoothed Coulomb friction. body: (n,) int; pairs of one body that are near in the rest shape have d_hat and xi below
    their rest distance.
    """

    # Arguments: all that the package's barrier depends on, which is compared with it.
    def __init__(
        self,
        surface: Surface,
        rest: np.ndarray,
        *,
        stiffness: np.ndarray,
        activation: float,
        separation: float | np.ndarray = 0.0,
        body: np.ndarray | None = None,
        friction: float | np.ndarray = 0.0,
        slip: float = 1e-5,
        pair_stiffness=mean_stiffness,
        rest_fraction: float = 0.8,
        rest_separation: float = 0.2,
    ):
        n = len(rest)
        self.surface, self.rest, self.activation, self.slip = surface, rest, activation, slip
        self.stiffness = np.broadcast_to(stiffness, n)
        self.half = np.full(n, 0.5 * separation) if np.ndim(separation) == 0 else np.asarray(separation)
        self.body = np.zeros(n, dtype=int) if body is None else body
        self.friction = np.broadcast_to(friction, n)
        self.pair_stiffness = pair_stiffness
        self.rest_fraction, self.rest_separation = rest_fraction, rest_separation
        self._listed: np.ndarray | None = None

    def _cover(self, x: np.ndarray) -> None:
        """Lists candidates anew where a vertex has left the margin of the last list."""
        margin = 0.5 * self.activation
        if self._listed is not None and np.linalg.norm(x - self._listed, axis=1).max() < margin:
            return
        self._listed = x.copy()
        reach = self.activation + 2 * self.half[self.surface.vertices].max() + 2 * margin
        self._vt, self._ee = self.surface.candidates(x, reach)
        self._quads = np.concatenate([self._vt, self._ee])
        a, b = self._quads[:, 0], self._quads[:, 3]
        xi, d_hat = self.half[a] + self.half[b], np.full(len(a), float(self.activation))
        same = np.flatnonzero(self.body[a] == self.body[b])
        rest = self._closest(self.rest)[2][same]
        xi[same] = np.minimum(xi[same], self.rest_separation * rest)
        d_hat[same] = np.minimum(d_hat[same], self.rest_fraction * rest - xi[same])
        self._xi, self._d_hat = xi, d_hat
        self._kappa = self.pair_stiffness(self.stiffness[a], self.stiffness[b])

    def _closest(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights, slopes and distances of all candidates."""
        split = len(self._vt)
        corners = x[self._quads]
        found = [vertex_triangle(corners[:split]), edge_edge(corners[split:])]
        weights, slope = (np.concatenate(part) for part in zip(*found, strict=True))
        return weights, slope, np.linalg.norm(np.einsum("ki,kij->kj", weights, corners), axis=1)

    def pairs(self, x: np.ndarray, frozen_at: np.ndarray | None = None) -> Pairs:
        """The active pairs at x, their mollifiers taken at the positions `frozen_at`."""
        self._cover(x)
        weights, slope, length = self._closest(x)
        active = length - self._xi < self._d_hat
        quads = self._quads[active]
        m = np.ones(len(quads))
        edges = np.flatnonzero(active) >= len(self._vt)
        m[edges] = mollifier((x if frozen_at is None else frozen_at)[quads[edges]])
        r = np.einsum("ki,kij->kj", weights[active], x[quads])
        mu = np.sqrt(self.friction[quads[:, 0]] * self.friction[quads[:, 3]])
        return Pairs(
            quads,
            weights[active],
            slope[active],
            r,
            length[active],
            (length - self._xi)[active],
            self._d_hat[active],
            m * self._kappa[active],
            mu,
        )

    def ready(self, x: np.ndarray) -> None:
        """Nothing to prepare before a step."""

    def smallest_separation(self, x: np.ndarray) -> float:
        """The smallest xi of any pair that is near at x, m: what CCD may keep everywhere."""
        self._cover(x)
        return float(self._xi.min(initial=np.inf)) if len(self._xi) else 0.0

    def smallest_gap(self, x: np.ndarray) -> float:
        """m beyond the minimum separation; inf without contact."""
        return float(self.pairs(x).gap.min(initial=np.inf))

    def energy(self, x: np.ndarray, frozen_at: np.ndarray) -> float:
        """In joules; inf where a pair is nearer than its minimum separation."""
        p = self.pairs(x, frozen_at)
        if (p.gap <= 0).any():
            return np.inf
        return float(p.stiffness @ barrier(p.gap, p.activation)[0])

    def derivatives(self, x: np.ndarray, psd: bool = True) -> tuple[np.ndarray, sp.csr_matrix]:
        """Gradient (n, 3) and Hessian (3n, 3n), mollifiers frozen at x."""
        p, n = self.pairs(x), len(x)
        _, b1, b2 = barrier(p.gap, p.activation)
        normal = p.r / p.length[:, None]
        g = (p.weights[:, :, None] * normal[:, None, :]).reshape(-1, 12)
        gradient = np.zeros((n, 3))
        np.add.at(gradient, p.quads, (p.stiffness * b1)[:, None, None] * g.reshape(-1, 4, 3))
        # |r|^2 / 2 is minimal over the witness parameters beta: its Hessian is a a^T (x) I - C^T (T T^T)^-1 C with T = dr/dbeta
        # and C = d^2 (|r|^2 / 2) / dbeta dx = da/dbeta (x) r + a (x) T
        tangent = np.einsum("kqi,kij->kqj", p.slope, x[p.quads])
        square = np.einsum("kqj,ksj->kqs", tangent, tangent)
        square[:, range(2), range(2)] += (p.slope == 0).all(axis=2)
        cross = p.slope[:, :, :, None] * p.r[:, None, None, :] + p.weights[:, None, :, None] * tangent[:, :, None, :]
        cross = cross.reshape(-1, 2, 12)
        half_square = np.einsum("ki,kj,ab->kiajb", p.weights, p.weights, np.eye(3)).reshape(-1, 12, 12)
        half_square = half_square - np.matmul(np.swapaxes(cross, 1, 2), np.linalg.solve(square, cross))
        outer = g[:, :, None] * g[:, None, :]
        across = (half_square - outer) / p.length[:, None, None]
        hessian = p.stiffness[:, None, None] * (b2[:, None, None] * outer + b1[:, None, None] * across)
        if psd and len(hessian):
            basis = np.kron(_DIFFERENCES, np.eye(3))
            small = basis @ hessian @ basis.T
            value, vector = np.linalg.eigh(0.5 * (small + np.swapaxes(small, 1, 2)))
            small = np.matmul(vector * np.maximum(value, 0.0)[:, None, :], np.swapaxes(vector, 1, 2))
            hessian = basis.T @ small @ basis
        return gradient, _element_matrix(p.quads, hessian, n)

    def friction_at(self, x: np.ndarray, start: np.ndarray) -> "Friction | None":
        """Friction with pressures, normals and witness weights lagged at x; None where there is none."""
        p = self.pairs(x)
        limit = -p.friction * p.stiffness * barrier(p.gap, p.activation)[1]
        acting = limit > 0
        if not acting.any():
            return None
        normal = (p.r / p.length[:, None])[acting]
        return Friction(p.quads[acting], p.weights[acting], normal, limit[acting], start, self.slip)


@dataclass
class Friction:
    """Lagged Coulomb friction mu lambda f0(|u|), smoothed below a slip of `slip` metres; u is the step's slip so far."""

    quads: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    limit: np.ndarray  # mu lambda, N
    start: np.ndarray
    slip: float

    def _slip(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = np.einsum("ki,kij->kj", self.weights, (x - self.start)[self.quads])
        u -= _dot(u, self.normal)[:, None] * self.normal
        return u, np.linalg.norm(u, axis=1)

    def energy(self, x: np.ndarray) -> float:
        """In joules."""
        _, size = self._slip(x)
        y = np.minimum(size, self.slip)
        f0 = y * y / self.slip - y**3 / (3 * self.slip**2) + np.maximum(size - self.slip, 0.0)
        return float(self.limit @ f0)

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_matrix]:
        """Gradient (n, 3) and Hessian (3n, 3n), which is positive semi-definite."""
        u, size = self._slip(x)
        y = np.minimum(size, self.slip)
        sliding = size >= self.slip
        over = np.where(sliding, 1 / np.maximum(size, self.slip), (2 - y / self.slip) / self.slip)  # f1 / |u|
        second = np.where(sliding, 0.0, 2 * (1 - y / self.slip) / self.slip)  # f1'
        gradient = np.zeros_like(x)
        np.add.at(gradient, self.quads, (self.limit * over)[:, None, None] * self.weights[:, :, None] * u[:, None, :])
        along = u / np.maximum(size, 1e-300)[:, None]
        plane = np.eye(3) - self.normal[:, :, None] * self.normal[:, None, :]
        core = over[:, None, None] * plane + (second - over)[:, None, None] * along[:, :, None] * along[:, None, :]
        core *= self.limit[:, None, None]
        hessian = np.einsum("ki,kj,kab->kiajb", self.weights, self.weights, core).reshape(-1, 12, 12)
        return gradient, _element_matrix(self.quads, hessian, len(x))


class SquaredDistanceBarrier:
    """ipctk's barrier of squared distances, as in Li et al. 2020, with its adaptive stiffness; without friction.

    activation: d_hat, m. mass: typical mass of a vertex, kg, for the first stiffness.
    """

    def __init__(self, surface: Surface, rest: np.ndarray, *, activation: float, mass: float):
        self.surface, self.activation, self.mass = surface, activation, mass
        self.diagonal = float(np.linalg.norm(np.ptp(rest[surface.vertices], axis=0)))
        self.stiffness, self._largest = self._initial(np.zeros(0), np.zeros(0))
        self._last_gap = np.inf

    def _initial(self, energy_gradient: np.ndarray, barrier_gradient: np.ndarray) -> tuple[float, float]:
        one = ipctk.ClampedLogBarrier()
        return ipctk.initial_barrier_stiffness(
            self.diagonal, one, self.activation, self.mass, energy_gradient, barrier_gradient
        )

    def _collisions(self, x: np.ndarray) -> ipctk.NormalCollisions:
        collisions = ipctk.NormalCollisions()
        collisions.build(self.surface.mesh, self.surface.of(x), self.activation, 0.0, ipctk.LBVH())
        return collisions

    def ready(self, x: np.ndarray) -> None:
        """Stiffens the barrier where the smallest gap is tiny and still shrinking."""
        gap = self.smallest_gap(x)
        self.stiffness = ipctk.update_barrier_stiffness(self._last_gap, gap, self._largest, self.stiffness, self.diagonal)
        self._last_gap = gap

    def smallest_separation(self, x: np.ndarray) -> float:
        """None is kept."""
        return 0.0

    def smallest_gap(self, x: np.ndarray) -> float:
        """m; inf without contact."""
        collisions = self._collisions(x)
        if collisions.empty():
            return np.inf
        return float(np.sqrt(collisions.compute_minimum_distance(self.surface.mesh, self.surface.of(x))))

    def energy(self, x: np.ndarray, frozen_at: np.ndarray) -> float:
        """In joules; its mollifier is part of the energy, so `frozen_at` plays no part."""
        potential = ipctk.BarrierPotential(self.activation, self.stiffness)
        return float(potential(self._collisions(x), self.surface.mesh, self.surface.of(x)))

    def derivatives(self, x: np.ndarray, psd: bool = True) -> tuple[np.ndarray, sp.csr_matrix]:
        """Gradient (n, 3) and Hessian (3n, 3n)."""
        collisions, mesh, xs = self._collisions(x), self.surface.mesh, self.surface.of(x)
        potential = ipctk.BarrierPotential(self.activation, self.stiffness)
        method = ipctk.PSDProjectionMethod.CLAMP if psd else ipctk.PSDProjectionMethod.NONE
        gradient = np.zeros_like(x)
        gradient[self.surface.vertices] = potential.gradient(collisions, mesh, xs).reshape(-1, 3)
        hessian = potential.hessian(collisions, mesh, xs, method).tocoo()
        dofs = (3 * self.surface.vertices[:, None] + np.arange(3)).ravel()
        size = 3 * len(x)
        return gradient, sp.csr_matrix((hessian.data, (dofs[hessian.row], dofs[hessian.col])), shape=(size, size))

    def friction_at(self, x: np.ndarray, start: np.ndarray) -> None:
        """None: this barrier has no friction here."""
