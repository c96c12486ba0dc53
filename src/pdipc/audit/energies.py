"""Energies and momenta of a state, and the barrier's forces in it: what `pdipc audit` prints, and what tests compare with mechanics."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from pdipc.barrier.pairs import ActivePairs
from pdipc.device.launch import one_at_a_time
from pdipc.model import Model, State
from pdipc.work import Work


@dataclass
class Audit:
    """Energies in J; linear momentum (3,) in kg m/s and angular momentum about the origin (3,) in kg m^2/s.

    gravity: potential energy with the origin as its zero. Kinematic vertices do not count.
    """

    time: float
    kinetic: float
    elastic: float
    barrier: float
    gravity: float
    linear_momentum: np.ndarray
    angular_momentum: np.ndarray

    @property
    def total(self) -> float:
        """Sum of the four energies."""
        return self.kinetic + self.elastic + self.barrier + self.gravity


@one_at_a_time
def audit(model: Model, state: State, work: Work) -> Audit:
    """The energies and momenta of `state`."""
    work.list_pairs(state.positions)
    if model.projector.cavities is not None:
        model.projector.cavities.reference.zero_()
    numbers = wp.zeros(2, dtype=model.real.scalar, device=model.device.warp)
    model.projector.energy(state.positions, state.remainders, numbers, 0)
    work.pairs.energy(numbers, 1)
    elastic, barrier = (float(value) for value in numbers.numpy())
    mass = model.external.mass[:, None]
    x, v = state.positions.numpy().astype(np.float64), state.velocities.numpy().astype(np.float64)
    gravity = work.loads.external.gravity[0]
    return Audit(
        time=state.time,
        kinetic=0.5 * float((mass * v * v).sum()),
        elastic=elastic,
        barrier=barrier,
        gravity=-float((mass * x * gravity).sum()),
        linear_momentum=(mass * v).sum(axis=0),
        angular_momentum=np.cross(x, mass * v).sum(axis=0),
    )


@one_at_a_time
def barrier_forces(model: Model, state: State, work: Work) -> np.ndarray:
    """(n, 3) N: the barrier's force on every vertex, on obstacles too. Friction and what restitution adds belong to a step and not to a
    state: `Simulation.step(forces=True)` has them.

    Raises ValueError in the paper's mode, whose forces all belong to a step.
    """
    if model.settings.method == "paper":
        raise ValueError(
            "in the paper's mode forces belong to a step, not to a state: run with --forces, or step with forces=True"
        )
    work.list_pairs(state.positions)
    assert isinstance(work.pairs, ActivePairs)
    return work.pairs.forces(state.positions).numpy().astype(np.float64)
