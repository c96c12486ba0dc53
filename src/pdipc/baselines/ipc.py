"""Incremental potential contact (Li et al. 2020), the accuracy reference and the peer of Section 7.3.

A step of implicit Euler minimises, by projected Newton with a line search that continuous collision detection bounds,

    E(x) = 1/(2 h^2) |x - z|_M^2 + Psi(x) + B(x) + D(x),    z = x* + h v* + h^2 a

with the elastic energies of `energies.py`, a barrier and lagged friction of `contact.py`.
"""

import time
from dataclasses import dataclass, field

import numpy as np

from .common import BlockPattern, Cholesky, scatter
from .contact import DistanceBarrier, Friction, SquaredDistanceBarrier
from .energies import Term

ROUNDING = 1e-12  # rise of the energy that a search takes for rounding, of the energy and that of the predicted motion;
NEGLIGIBLE = 1e-6  # or of the kinetic energy of all moving by the tolerance
LAG_ITERATIONS = 30  # iterations that may move kinematic vertices towards their targets


@dataclass
class Problem:
    """What stays constant. masses: (n,) kg. kinematic: (n,) bool, vertices that follow targets; absent: none. terms: elastic energies.

    time_step: h, s. gravity: (3,) m/s^2. damping: 1/s, as a force -damping m v. contact: None for none.
    """

    masses: np.ndarray
    terms: list[Term]
    time_step: float
    kinematic: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    contact: DistanceBarrier | SquaredDistanceBarrier | None = None
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    damping: float = 0.0

    def __post_init__(self):
        n = len(self.masses)
        if not len(self.kinematic):
            self.kinematic = np.zeros(n, dtype=bool)
        self.free = np.flatnonzero(~self.kinematic)
        if (self.masses[self.free] <= 0).any():
            raise ValueError("masses: every simulated vertex needs a positive one")
        self.number = np.full(n, -1)
        self.number[self.free] = np.arange(len(self.free))
        self.free_dofs = (3 * self.free[:, None] + np.arange(3)).ravel()
        own = np.arange(n)[:, None]
        self.pattern = BlockPattern([own, *(term.vertices for term in self.terms)], self.number)
        inertia = np.zeros((n, 1, 3, 1, 3))
        weight = self.masses / self.time_step**2 + self.damping * self.masses / self.time_step
        inertia[:, 0, range(3), 0, range(3)] = weight[:, None]
        self.inertia = inertia
        self.cholesky = Cholesky()


@dataclass
class State:
    """positions and velocities, (n, 3) m and m/s."""

    positions: np.ndarray
    velocities: np.ndarray


@dataclass
class Info:
    """What a step took. residual: m, largest entry of the last Newton direction. smallest_gap: m beyond xi. lag: m, how far
    kinematic vertices are still from their targets. energies: before and after each line search,
    and the most that was allowed, J.
    """

    converged: bool = False
    iterations: int = 0
    seconds: float = 0.0
    solve_seconds: float = 0.0
    residual: float = np.inf
    smallest_gap: float = np.inf
    lag: float = 0.0
    energies: list[tuple[float, float, float]] = field(default_factory=list)


class _Step:
    """The objective of one step."""

    def __init__(self, problem: Problem, state: State, acceleration: np.ndarray, tolerance: float):
        h, self.problem, self.start = problem.time_step, problem, state.positions
        self.z = state.positions + h * state.velocities + h * h * acceleration
        self.friction: Friction | None = None
        self._elastic: tuple[np.ndarray | None, float] = (None, 0.0)  # the last positions asked for, and their elastic energy
        free = problem.free
        motion = (self.z - self.start)[free]
        predicted = float(problem.masses[free] @ (motion**2).sum(axis=1))
        negligible = problem.masses[free].sum() * tolerance**2
        self.rounding = 0.5 / h**2 * (ROUNDING * predicted + NEGLIGIBLE * negligible)  # J

    def energy(self, x: np.ndarray, frozen_at: np.ndarray) -> float:
        p, h = self.problem, self.problem.time_step
        total = p.contact.energy(x, frozen_at) if p.contact else 0.0
        if not np.isfinite(total):
            return total
        free = p.free
        total += 0.5 / h**2 * float(p.masses[free] @ ((x - self.z)[free] ** 2).sum(axis=1))
        total += 0.5 * p.damping / h * float(p.masses[free] @ ((x - self.start)[free] ** 2).sum(axis=1))
        if self._elastic[0] is not x:
            self._elastic = (x, sum(term.energy(x) for term in p.terms))
        return total + self._elastic[1] + (self.friction.energy(x) if self.friction else 0.0)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """dE/dx of the inertia alone, (n, 3)."""
        p, h = self.problem, self.problem.time_step
        m = p.masses[:, None]
        return m / h**2 * (x - self.z) + p.damping / h * m * (x - self.start)

    def newton_direction(self, x: np.ndarray, kinematic_motion: np.ndarray, info: Info) -> np.ndarray:
        """The projected Newton direction (n, 3), with kinematic vertices moving as prescribed."""
        p, n = self.problem, len(x)
        gradient, hessians = self.gradient(x), [p.inertia]
        moving = bool(kinematic_motion.any())
        for term in p.terms:
            g, hessian = term.derivatives(x)
            gradient += scatter(term.vertices, g, n)
            if moving and p.kinematic[term.vertices].any():
                pull = np.einsum("ksatb,ktb->ksa", hessian, kinematic_motion[term.vertices], optimize=True)
                gradient += scatter(term.vertices, pull, n)
            hessians.append(hessian)
        matrix = p.pattern.assemble(hessians)
        for part in (p.contact, self.friction):
            if part is None:
                continue
            g, hessian = part.derivatives(x)
            gradient += g
            if not hessian.nnz:
                continue
            rows = hessian[p.free_dofs]
            if moving:
                gradient.ravel()[p.free_dofs] += rows @ kinematic_motion.ravel()
            block = rows[:, p.free_dofs].tocoo()
            upper = block.col >= block.row
            block.data, block.row, block.col = block.data[upper], block.row[upper], block.col[upper]
            matrix = matrix + block.tocsr()
        started = time.perf_counter()
        direction = kinematic_motion.copy()
        solution = p.cholesky.factorize(matrix).solve(-gradient[p.free].ravel())
        direction[p.free] = solution.reshape(-1, 3)
        info.solve_seconds += time.perf_counter() - started
        return direction


def step(
    problem: Problem,
    state: State,
    *,
    targets: np.ndarray | None = None,
    acceleration: np.ndarray | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 200,
    friction_iterations: int = 1,
) -> tuple[State, Info]:
    """One step of h.

    targets: (n, 3) m, where kinematic vertices shall be at its end; stay by default. They move within the line search, and a
    lag is made up in the next step. acceleration: (n, 3) or (3,) m/s^2 beside gravity. tolerance: m, on the largest entry of
    the full Newton direction. friction_iterations: how often friction is lagged anew (1 in Li et al.).
    """
    info, begun = Info(), time.perf_counter()
    h, kinematic = problem.time_step, problem.kinematic
    total = np.broadcast_to(
        np.asarray(problem.gravity) + (0.0 if acceleration is None else acceleration), state.positions.shape
    )
    objective = _Step(problem, state, total, tolerance)
    x = state.positions.copy()
    wanted = x if targets is None else targets
    motion = np.zeros_like(x)
    if problem.contact:
        problem.contact.ready(x)
    lagged = 0
    for _ in range(friction_iterations):
        before, settled = info.iterations, False
        if problem.contact:
            objective.friction = problem.contact.friction_at(x, state.positions)
        for _ in range(max_iterations):
            motion[kinematic] = wanted[kinematic] - x[kinematic]
            # every second iteration moves kinematic vertices, the others let the rest come after
            following = bool(motion.any())
            if following and (lagged >= LAG_ITERATIONS or info.iterations % 2):
                motion[:] = 0.0
            moves = bool(motion.any())
            lagged += moves
            direction = objective.newton_direction(x, motion, info)
            info.iterations += 1
            info.residual = float(np.abs(direction).max())
            x, fraction = _search(objective, x, direction, moves, info)
            settled = info.residual <= tolerance and fraction == 1.0 and not moves
            if settled and (not following or lagged >= LAG_ITERATIONS):
                break
            if fraction == 0.0 and not moves:
                break
        info.converged = settled
        if not settled or objective.friction is None or info.iterations == before + 1:
            break
    info.lag = float(np.abs(wanted - x)[kinematic].max(initial=0.0))
    if problem.contact:
        info.smallest_gap = problem.contact.smallest_gap(x)
    info.seconds = time.perf_counter() - begun
    return State(x, (x - state.positions) / h), info


def _search(objective: _Step, x: np.ndarray, direction: np.ndarray, moves: bool, info: Info) -> tuple[np.ndarray, float]:
    """Goes along the direction as far as CCD allows, halved until the energy falls; with moving kinematic vertices, which do
    work, only until it is finite. Returns the new positions and the fraction gone.
    """
    contact, fraction = objective.problem.contact, 1.0
    if contact:
        fraction = contact.surface.free_step(x, x + direction, contact.smallest_separation(x))
    before = objective.energy(x, x)
    limit = np.inf if moves else before + ROUNDING * before + objective.rounding
    while fraction > 1e-14:
        trial = x + fraction * direction
        after = objective.energy(trial, x)
        if np.isfinite(after) and after <= limit:
            if not moves:
                info.energies.append((before, after, limit))
            return trial, fraction
        fraction *= 0.5
    return x, 0.0
