"""Plain projective dynamics (Bouaziz et al. 2014), with collisions detected at discrete times; and Section 4.1's case study.

A step alternates local projections and one linear solve of Eq. (3). A vertex that an iterate puts inside a closed surface, or
below a plane, gets the nearest point of the surface as its target for that solve. Nothing sees what happened on the way, so a
body passes through what is thinner than its motion in a step (Fig. 10).
"""

import math
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from .common import Cholesky
from .energies import Term

CHUNK = 4_000_000  # point-triangle pairs treated at once


@dataclass
class Problem:
    """What stays constant. masses: (n,) kg. terms: elastic energies. time_step: h, s. kinematic: (n,) bool; absent: none.

    surfaces: closed surfaces, each (m, 3) triangles, outward; a vertex that lies inside one of them and is no part of it is
    pushed out. planes: (point, normal) pairs that vertices stay above. collision_weight: N/m of such a vertex; by default 100
    times a typical m/h^2.
    """

    masses: np.ndarray
    terms: list[Term]
    time_step: float
    kinematic: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    surfaces: list[np.ndarray] = field(default_factory=list)
    planes: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    collision_weight: float | None = None

    def __post_init__(self):
        n = len(self.masses)
        if not len(self.kinematic):
            self.kinematic = np.zeros(n, dtype=bool)
        self.free, self.held = np.flatnonzero(~self.kinematic), np.flatnonzero(self.kinematic)
        if self.collision_weight is None:
            self.collision_weight = 100 * self.masses[self.free].mean() / self.time_step**2
        matrix = sp.diags(self.masses / self.time_step**2).tocsr()
        self._rows = []
        for term in self.terms:
            g, weight = term.rows(n)
            weighted = sp.diags(weight) @ g
            matrix = matrix + g.T @ weighted
            self._rows.append(sp.csr_matrix(weighted.T))
        self._coupling = matrix[self.free][:, self.held]
        self._matrix = sp.triu(matrix[self.free][:, self.free], format="csr")
        self._cholesky, self._colliding = Cholesky(), None

    def right_hand_side(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """M/h^2 z + sum w G^T p, (n, 3): the local step."""
        b = self.masses[:, None] / self.time_step**2 * z
        for term, rows in zip(self.terms, self._rows, strict=True):
            b += rows @ term.projections(x)
        return b

    def solve(self, b: np.ndarray, held: np.ndarray, colliding: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """The global step: positions of the free vertices. It factorises anew where other vertices collide than before."""
        if self._colliding is None or not np.array_equal(colliding, self._colliding):
            extra = self.collision_weight * colliding[self.free]
            self._cholesky.factorize((self._matrix + sp.diags(extra)).tocsr())
            self._colliding = colliding
        b = b + self.collision_weight * np.where(colliding[:, None], targets, 0.0)
        return self._cholesky.solve(b[self.free] - self._coupling @ held)


@dataclass
class State:
    """positions and velocities, (n, 3) m and m/s."""

    positions: np.ndarray
    velocities: np.ndarray


def step(
    problem: Problem,
    state: State,
    *,
    targets: np.ndarray | None = None,
    acceleration: np.ndarray | None = None,
    iterations: int = 20,
) -> tuple[State, int]:
    """One step of `iterations` local-global iterations; returns the state and how many vertices collided in the last one.

    targets: (n, 3) m, where kinematic vertices are at the end of the step; stay by default. acceleration: (n, 3) or (3,) m/s^2
    beside gravity.
    """
    h, held, free = problem.time_step, problem.held, problem.free
    total = np.asarray(problem.gravity) + (0.0 if acceleration is None else acceleration)
    z = state.positions + h * state.velocities + h * h * total
    z[held] = (state.positions if targets is None else targets)[held]
    x = z.copy()
    colliding = np.zeros(len(x), dtype=bool)
    for _ in range(iterations):
        colliding, nearest = detect(problem, x)
        x[free] = problem.solve(problem.right_hand_side(x, z), x[held], colliding, nearest)
    return State(x, (x - state.positions) / h), int(colliding.sum())


def detect(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which free vertices are inside a surface or below a plane, (n,) bool, and the nearest surface point of each, (n, 3)."""
    colliding, target = np.zeros(len(x), dtype=bool), x.copy()
    for triangles in problem.surfaces:
        corners = x[triangles]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        near = ~problem.kinematic & ((x >= low) & (x <= high)).all(axis=1)
        near[triangles.ravel()] = False
        found = np.flatnonzero(near)
        found = found[winding_number(x[found], corners) > 0.5]
        colliding[found] = True
        target[found] = nearest_points(x[found], corners)
    for point, normal in problem.planes:
        depth = (x - point) @ normal
        below = ~problem.kinematic & (depth < 0)
        colliding |= below
        target[below] = (x - depth[:, None] * normal)[below]
    return colliding, target


def winding_number(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Of points (k, 3) in a closed surface, corners (m, 3, 3): 1 inside, 0 outside (Van Oosterom, Strackee 1983)."""
    total = np.zeros(len(points))
    size = max(1, CHUNK // len(corners))
    for first in range(0, len(points), size):
        a, b, c = np.moveaxis(corners[None] - points[first : first + size, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
        determinant = np.einsum("kmi,kmi->km", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("kmi,kmi->km", u, v) for u, v in ((a, b), (b, c), (c, a)))
        total[first : first + size] = 2 * np.arctan2(determinant, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1)
    return total / (4 * np.pi)


def nearest_points(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The nearest point of triangles (m, 3, 3) to each of points (k, 3)."""
    result = np.empty_like(points)
    size = max(1, CHUNK // (4 * len(corners)))
    a, b, c = np.swapaxes(corners, 0, 1)
    u, v = b - a, c - a
    normal = np.cross(u, v)
    square = np.maximum(np.einsum("mi,mi->m", normal, normal), 1e-300)
    for first in range(0, len(points), size):
        p = points[first : first + size, None]
        w = p - a
        s = np.einsum("kmi,mi->km", np.cross(w, v), normal) / square
        t = np.einsum("kmi,mi->km", np.cross(u, w), normal) / square
        inside = (s > 0) & (t > 0) & (s + t < 1)
        candidates = [np.where(inside[:, :, None], a + s[:, :, None] * u + t[:, :, None] * v, np.inf)]
        for start, end in ((a, b), (b, c), (c, a)):
            along = end - start
            f = np.einsum("kmi,mi->km", p - start, along) / np.maximum(np.einsum("mi,mi->m", along, along), 1e-300)
            candidates.append(start + np.clip(f, 0, 1)[:, :, None] * along)
        every = np.concatenate(candidates, axis=1)
        best = ((every - p) ** 2).sum(axis=2).argmin(axis=1)
        result[first : first + size] = every[np.arange(len(best)), best]
    return result


METHODS = ("pd", "pd+ccd", "pd+ipc+ccd", "eq6", "barrier")


@dataclass
class Trace:
    """heights and velocities, (steps + 1,) m and m/s; iterates: per step the heights after each iteration."""

    heights: np.ndarray
    velocities: np.ndarray
    iterates: list[list[float]]


# Arguments: what a reader of Fig. 2 may want to vary, each with its default.
def vertex_and_plane(
    method: str,
    *,
    height: float = 0.05,
    velocity: float = -2.0,
    steps: int = 40,
    time_step: float = 0.01,
    gravity: float = -9.81,
    mass: float = 1.0,
    weight: float = 100.0,
    activation: float = 5e-3,
    restitution: float = 0.5,
    iterations: int = 20,
    backoff: float = 0.8,
) -> Trace:
    """Section 4.1's case study, Fig. 2: one vertex falls on the plane y = 0.

    method, one of METHODS: "pd" sets the nearest point of the plane as target of a vertex below it; "pd+ccd" rolls every
    iterate back to before its impact, which leaves nothing below the plane to push out; "pd+ipc+ccd" adds a barrier constraint
    with its target at d_hat; "eq6" takes the target of Eq. (6), x the start of the step and its velocity the predicted one;
    "barrier" minimises inertia and the barrier energy, as IPC does and pdipc by default. weight: of the constraint, in units of
    m/h^2; for "barrier" its kappa. activation: d_hat, m. backoff: part of the way to the impact that CCD allows. Raises
    ValueError for another method.
    """
    if method not in METHODS:
        raise ValueError(f"method: {method!r} is unknown; one of {', '.join(METHODS)}")
    h, inertia = time_step, mass / time_step**2
    w = weight * inertia
    x, v = height, velocity
    heights, velocities, iterates = [x], [v], []

    def pulled(target: float) -> float:
        return (inertia * z + w * target) / (inertia + w)

    for _ in range(steps):
        z, start, seen = x + h * v + h * h * gravity, x, []
        predicted = (z - start) / h
        impact = h if z >= 0 else h * start / (start - z)
        if method == "pd":
            x = z
        for _ in range(iterations):
            if method == "pd":
                wanted = pulled(0.0) if x < 0 else z
            elif method == "pd+ccd":
                wanted = z
            elif method == "pd+ipc+ccd":
                wanted = pulled(activation) if x < activation else z
            elif method == "eq6":
                target = start + impact * predicted - (h - impact) * restitution * predicted
                wanted = pulled(target) if x < activation else z
            else:
                wanted = _newton(x, z, inertia, w, activation)
            if method != "pd" and wanted < 0:
                wanted = x + backoff * x / (x - wanted) * (wanted - x)
            x = wanted
            seen.append(x)
        v = (x - start) / h
        heights.append(x)
        velocities.append(v)
        iterates.append(seen)
    return Trace(np.array(heights), np.array(velocities), iterates)


def _newton(x: float, z: float, inertia: float, kappa: float, d_hat: float) -> float:
    """One damped Newton iteration on inertia/2 (x - z)^2 + kappa b(x)."""

    def energy(y: float) -> float:
        active = 0 < y < d_hat
        return 0.5 * inertia * (y - z) ** 2 - (kappa * (y - d_hat) ** 2 * math.log(y / d_hat) if active else 0.0)

    gradient, hessian = inertia * (x - z), inertia
    if x < d_hat:
        s, log = x - d_hat, math.log(x / d_hat)
        gradient += kappa * (-2 * s * log - s * s / x)
        hessian += kappa * (-2 * log - 4 * s / x + (s / x) ** 2)
    step = -gradient / hessian
    if x + step <= 0:
        step = -0.8 * x
    while abs(step) > 1e-15 and energy(x + step) > energy(x):
        step *= 0.5
    return x + step
