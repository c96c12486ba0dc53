"""The motion against closed forms, ordinary differential equations and linear finite elements, over sizes, stiffnesses, steps and precisions."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import pdipc

from .elasticity import lowest_mode, prescribed, sagging, stiffness
from .scenes import cloth, clean, floor, scene, solid

G = 9.81
BEAMS = [  # length m, Pa, kg/m^3, precision: sizes and stiffnesses that small deflections go with
    (0.05, 1e6, 1000.0, "float64"),
    (0.05, 1e6, 1000.0, "float32"),
    (0.5, 1e8, 1000.0, "float64"),
    (2.0, 1e9, 1000.0, "float32"),
    (10.0, 2e11, 7850.0, "float64"),
    (0.5, 2e11, 7850.0, "float64"),
    (0.5, 2e11, 7850.0, "float32"),
    (0.02, 5e9, 1200.0, "float32"),
]


class Beam:
    """A beam along x, a tenth as thick as long, held at its left end. k, mass: of its linear finite elements."""

    def __init__(self, length, young, density):
        self.length, thick = length, 0.1 * length
        body = solid("beam", (length, thick, thick), (10, 1, 1), young=young, poisson=0.3, density=density)
        model = pdipc.build(scene([body]), "cpu")
        self.material, self.tets = body["material"], model.assembly.bodies[0].tets
        self.rest, self.mass = model.assembly.rest_positions, model.external.mass
        self.k = stiffness(self.rest, self.tets, young, 0.3)
        self.held, self.tip = self.rest[:, 0] < -0.499 * length, self.rest[:, 0] > 0.499 * length

    def simulation(self, start=0.0, **settings):
        pins = [{"select": {"box": [[-self.length] * 3, [-0.499 * self.length, self.length, self.length]]}}]
        mesh = {"vertices": self.rest, "tets": self.tets, "start": self.rest + start}
        body = {"name": "beam", "kind": "solid", "mesh": mesh, "material": self.material, "pins": pins}
        return pdipc.Simulation(scene([body], **settings), "cpu")

    def sag(self, simulation):
        """m, by which the tip is off its place at rest; with what rounding took off the positions."""
        moved = simulation.positions + simulation.state.remainders.numpy() - self.rest
        return moved[self.tip, 1].mean()


@pytest.mark.parametrize(("length", "young", "density", "precision"), BEAMS)
def test_a_cantilever_sags(length, young, density, precision):
    """Steps of several periods end at rest, within 2 % of where small deflections put the tip."""
    beam = Beam(length, young, density)
    expected = sagging(beam.k, beam.mass, beam.held)[beam.tip, 1].mean()
    h = 20.0 * np.sqrt(-expected / G)
    made = beam.simulation(time_step=h, precision=precision, tolerance=-1e-3 * expected / h)
    results = [made.step() for _ in range(6)]
    print(beam.sag(made) / expected, [r.outer for r in results], [r.message for r in results])
    assert beam.sag(made) == pytest.approx(expected, rel=0.02)
    assert all(result.converged for result in results)


@pytest.mark.parametrize(("length", "young", "density", "precision"), BEAMS)
def test_a_cantilever_swings_as_fast_as_its_lowest_mode(length, young, density, precision):
    """Let go bent by a thousandth of its length, it is straight after a quarter of a period and three."""
    beam = Beam(length, young, density)
    rate, shape = lowest_mode(beam.k, beam.mass, beam.held)
    h, bent = 2.0 * np.pi / rate / 120.0, 1e-3 * length
    made = beam.simulation(bent * shape, gravity=(0, 0, 0), time_step=h, precision=precision, tolerance=1e-3 * bent * rate)
    results, path = [], [beam.sag(made)]
    for _ in range(100):
        results.append(made.step())
        path.append(beam.sag(made))
    path = np.array(path)
    at = np.flatnonzero(np.signbit(path[1:]) != np.signbit(path[:-1]))
    crossings = h * (at + path[at] / (path[at] - path[at + 1]))
    print(np.diff(crossings) * rate / np.pi, np.mean([r.outer for r in results]), sum(not r.converged for r in results))
    assert np.diff(crossings)[0] == pytest.approx(np.pi / rate, rel=0.03)
    assert all(result.converged for result in results)
