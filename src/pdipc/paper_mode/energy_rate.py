"""The inner loop as printed (Algorithm 1, lines 7 to 12): plain iterations until E + Psi + B hardly changes any more."""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.constraints import Projector
from pdipc.device.language import kernel
from pdipc.device.launch import Device, Reducer
from pdipc.device.precision import Real
from pdipc.paper_mode.targets import INNER_RATE, PaperPairs

MOMENTUM, ELASTIC, BARRIER, TOTAL = (wp.constant(slot) for slot in range(4))  # places of `energies`


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)

    @kernel(module)
    def begin(
        first: int,
        iterations: int,
        energies: wp.array(dtype=scalar),
        left_out: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        energies[TOTAL] = scalar(wp.inf)
        left_out[0] = iterations
        going_out[0] = 1

    @kernel(module)
    def move(
        first: int,
        increment: wp.array(dtype=vec3),
        z: wp.array(dtype=vec3),
        mass: wp.array(dtype=scalar),
        free: wp.array(dtype=scalar),
        h: scalar,
        x_tilde: wp.array(dtype=vec3),
        momentum_out: wp.array(dtype=scalar),
    ):
        """x~ moves; and the momentum potential (line 8, with M^(1/2) as in Eq. 1)."""
        i = first + wp.tid()
        x = x_tilde[i] + free[i] * increment[i]
        x_tilde[i] = x
        momentum_out[i] = scalar(0.5) * mass[i] / (h * h) * wp.length_sq(x - z[i])

    @kernel(module)
    def decide(
        first: int,
        rate: scalar,
        energies: wp.array(dtype=scalar),
        left: wp.array(dtype=wp.int32),
        done: wp.array(dtype=wp.int32),
        going_out: wp.array(dtype=wp.int32),
    ):
        """Line 11: dE = |change of E + Psi + B| / (E + Psi + B)."""
        total = energies[MOMENTUM] + energies[ELASTIC] + energies[BARRIER]
        change = wp.abs(total - energies[TOTAL])
        energies[TOTAL] = total
        done[0] = done[0] + 1
        left[0] = left[0] - 1
        # a comparison with NaN is false, which ends the loop
        if left[0] <= 0 or not (change > rate * wp.abs(total)):
            going_out[0] = 0

    return SimpleNamespace(begin=begin, move=move, decide=decide)


class EnergyRate:
    """The loop of local-global iterations in the paper's form; the same names as `Anderson`.

    base, x, z: (n,) m, buffers of the step: where it starts, and as displacements from there where the outer iteration starts, and the
    inertial target.
    energies: (4,) on the device, of the last iterate: E, Psi, B and their sum, J.
    """

    def __init__(
        self,
        device: Device,
        real: Real,
        projector: Projector,
        pairs: PaperPairs,
        base: wp.array,
        x: wp.array,
        z: wp.array,
        mass: wp.array,
    ):
        n = len(mass)
        self.device, self.real, self.kernels = device, real, kernels(real)
        self.projector, self.pairs, self.base, self.x, self.z, self.mass = projector, pairs, base, x, z, mass
        self.per_vertex, self.reducer = wp.zeros(n, dtype=real.scalar, device=device.warp), Reducer(device, real, n)
        self.energies = wp.zeros(4, dtype=real.scalar, device=device.warp)
        self.left, self.done, self.going = (wp.zeros(1, dtype=wp.int32, device=device.warp) for _ in range(3))

    def begin(self, iterations: int) -> None:
        """Launches the start of a loop of at most so many iterations."""
        self.device.launch_serial(self.kernels.begin, [iterations, self.energies, self.left, self.going])

    def advance(self, x_tilde: wp.array, increment: wp.array, free: wp.array) -> None:
        """Launches the update of x~ by the global step's increment, and the decision whether to go on."""
        k, device, n = self.kernels, self.device, len(self.mass)
        inputs = [increment, self.z, self.mass, free, self.pairs.h, x_tilde, self.per_vertex]
        device.launch(k.move, n, inputs)
        self.reducer.sum(self.per_vertex, self.energies, MOMENTUM)
        self.projector.energy(self.base, x_tilde, self.energies, ELASTIC)
        self.pairs.vertex_energy(self.x, x_tilde, self.per_vertex)
        self.reducer.sum(self.per_vertex, self.energies, BARRIER)
        counters = [self.left, self.done, self.going]
        device.launch_serial(k.decide, [self.real.scalar(INNER_RATE), self.energies, *counters])
