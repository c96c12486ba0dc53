"""The motion against closed forms, ordinary differential equations and linear finite elements, over sizes, stiffnesses, steps and precisions."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import pdipc

from .elasticity import lowest_mode, prescribed, sagging, stiffness
from .scenes import clean, cloth, floor, scene, solid

G = 9.81
BEAMS = [  # length m, Pa, kg/m^3, precision: sizes and stiffnesses that small deflections go with
    (0.05, 1e6, 1000.0, "float64"),
    (0.05, 1e6, 1000.0, "float32"),
    (0.5, 1e8, 1000.0, "float64"),
    (2.0, 1e9, 1000.0, "float32"),
    (10.0, 2e11, 7850.0, "float64"),
    (0.5, 2e11, 7850.0, "float64"),
    (0.5, 2e11, 7850.0, "float32"),
    (0.02, 5e9, 1200.0, "float64"),
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


@pytest.mark.parametrize(("length", "young", "density", "precision"), BEAMS[:-1])
def test_a_cantilever_sags(length, young, density, precision):
    """Steps of several periods end at rest, within 2 % of where small deflections put the tip.

    Not the last: 30 nm of 2 cm are less than what float32 keeps of the shape at rest.
    """
    beam = Beam(length, young, density)
    expected = sagging(beam.k, beam.mass, beam.held)[beam.tip, 1].mean()
    h = 20.0 * np.sqrt(-expected / G)
    made = beam.simulation(time_step=h, precision=precision, tolerance=-1e-3 * expected / h)
    results = [made.step() for _ in range(6)]
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
    assert np.diff(crossings)[0] == pytest.approx(np.pi / rate, rel=0.03)
    assert all(result.converged for result in results)


@pytest.mark.parametrize(
    ("size", "young", "density", "h", "precision"),
    [
        (0.01, 1e6, 1000.0, 1 / 1000, "float64"),
        (0.1, 1e8, 1000.0, 1 / 250, "float32"),
        (0.1, 2e11, 7850.0, 1 / 250, "float64"),
        (0.1, 2e11, 7850.0, 1 / 500, "float32"),
        (2.0, 2e11, 7850.0, 1 / 100, "float64"),
    ],
)
def test_a_cube_tips_over_like_a_rigid_one(size, young, density, h, precision):
    """From 3 degrees off balance on an edge to 30, about the edge, which friction holds: as a rigid body's ODE says, within 3 %."""
    start, end = np.radians(3.0), np.radians(30.0)
    cube = solid("cube", (size,) * 3, (2,) * 3, young=young, density=density, poisson=0.3, friction=2.0)
    d_hat = 1e-3 * size
    turned = {**cube, "rotation": (0, 0, 45.0 - 3.0), "translation": (0, size / np.sqrt(2) * np.cos(start) + 0.5 * d_hat, 0)}
    contact = {"activation_distance": d_hat}
    made = pdipc.Simulation(
        scene([turned], [floor(10 * size, friction=2.0)], contact=contact, time_step=h, precision=precision), "cpu"
    )
    mass, x = made.model.external.mass[:27], made.positions[:27]
    center = mass @ x / mass.sum()
    low = x[x[:, 1] < x[:, 1].min() + 1e-3 * size].mean(axis=0)
    arm = np.linalg.norm((center - low)[:2])
    inertia = mass @ ((x - low)[:, :2] ** 2).sum(axis=1)

    def angle(x):
        away = mass @ x / mass.sum() - x[np.argsort(x[:, 1])[:3]].mean(axis=0)
        return np.arctan2(abs(away[0]), away[1])

    def rigid(t, y):
        return y[1], mass.sum() * G * arm * np.sin(y[0]) / inertia

    over = solve_ivp(rigid, (0, 10), (angle(x), 0.0), events=lambda t, y: y[0] - end, rtol=1e-8, atol=1e-10)
    expected = over.t_events[0][0]
    angles, results = [angle(x)], []
    while angles[-1] < end and len(angles) < 1.5 * expected / h:
        results.append(made.step())
        angles.append(angle(made.positions[:27]))
    took = h * np.interp(end, angles, np.arange(len(angles)))
    assert took == pytest.approx(expected, rel=0.03)
    assert all(result.converged for result in results)


@pytest.mark.parametrize(
    ("size", "young", "h", "precision"),
    [
        (0.01, 1e3, 1 / 500, "float64"),
        (0.2, 1e6, 1 / 50, "float64"),
        (0.2, 2e11, 1 / 100, "float32"),
        (5.0, 1e9, 1 / 25, "float64"),
    ],
)
def test_a_spinning_body_keeps_its_angular_momentum(size, young, h, precision):
    """Implicit Euler takes h m v_1 x v_0 off a point's angular momentum in a step: that, and no more."""
    body = solid(
        "block", (size, 0.7 * size, 0.4 * size), (3, 2, 2), young=young, poisson=0.3, angular_velocity=(3.0, -5.0, 4.0)
    )
    lost, spin = momentum_lost(body, 20, gravity=(0, 0, 0), time_step=h, precision=precision, tolerance=1e-3 * size)
    assert np.abs(lost).max() < 2e-4 * spin


@pytest.mark.parametrize(
    ("size", "h", "precision"), [(0.02, 1 / 500, "float64"), (0.3, 1 / 100, "float32"), (4.0, 1 / 25, "float64")]
)
def test_a_cloth_hung_by_a_corner_does_not_begin_to_turn(size, h, precision):
    """About the corner only gravity has a moment, and none about the vertical."""
    pins = [{"select": {"vertices": [0]}}]
    body = cloth("cloth", (size, size), (6, 6), rotation=(0, 15, 10), pins=pins)
    lost, spin = momentum_lost(body, 20, time_step=h, precision=precision)
    assert np.abs(lost).max() < 2e-4 * spin


@pytest.mark.parametrize(
    ("size", "young", "squeeze", "precision"),
    [(0.01, 1e4, 0.02, "float64"), (0.2, 1e6, 0.02, "float32"), (0.1, 2e11, 1e-3, "float64"), (3.0, 1e9, 5e-3, "float64")],
)
def test_a_squeezed_block_pushes_back_as_finite_elements_do(size, young, squeeze, precision):
    """Between two plates: the force on them against linear finite elements whose ends are moved as much, within 3 %."""
    d_hat, h = 2e-3 * size, 0.02
    block = solid("block", (size, size, size), (3, 3, 3), young=young, poisson=0.3)
    way = 0.5 * (squeeze * size + 2.0 * d_hat)
    closing = (
        [{"time": 0.0}, {"time": h, "translation": (0.0, -way, 0.0)}],
        [{"time": 0.0}, {"time": h, "translation": (0.0, way, 0.0)}],
    )
    plates = [
        floor(3 * size, name="upper", rotation=(180, 0, 0), at=(0, 0.5 * size + d_hat, 0), motion={"keyframes": closing[0]}),
        floor(3 * size, name="lower", at=(0, -0.5 * size - d_hat, 0), motion={"keyframes": closing[1]}),
    ]
    tolerance = {"float64": 1e-3, "float32": 1e-2}[precision] * squeeze * size / h
    made = pdipc.Simulation(
        scene(
            [block],
            plates,
            contact={"activation_distance": d_hat},
            gravity=(0, 0, 0),
            time_step=h,
            precision=precision,
            tolerance=tolerance,
        ),
        "cpu",
    )
    for _ in range(20):
        result = made.step(forces=True)
        assert result.converged, result.message
    x, tets = made.model.assembly.rest_positions[:64], made.model.assembly.bodies[0].tets
    moved = (made.positions + made.state.remainders.numpy())[:64] - x
    held = np.abs(x[:, 1]) > 0.49 * size
    _, force = prescribed(stiffness(x, tets, young, 0.3), moved, held)
    pushed = result.forces.on("block", by="upper").normal
    assert abs(pushed[1]) == pytest.approx(-force[x[:, 1] > 0.49 * size, 1].sum(), rel=0.03)


@pytest.mark.parametrize(("radius", "young", "h"), [(1.0, 1e6, 1 / 50)])
def test_a_ball_squeezed_flat_recovers_its_volume(radius, young, h):
    """To 2 % of its height and free again."""
    d_hat = 2e-3 * radius
    ball = {"name": "ball", "kind": "solid", "mesh": {"shape": "sphere", "radius": radius, "cells": 4}}
    ball["material"] = {"young_modulus": young, "poisson_ratio": 0.3}
    gap, way = radius + d_hat, 0.98 * radius + d_hat
    keys = [
        [{"time": 0.0}, {"time": 25 * h, "translation": (0, s * way, 0)}, {"time": 35 * h, "translation": (0, 0, 0)}]
        for s in (-1, 1)
    ]
    plates = [
        floor(8 * radius, name="upper", rotation=(180, 0, 0), at=(0, gap, 0), motion={"keyframes": keys[0]}),
        floor(8 * radius, name="lower", at=(0, -gap, 0), motion={"keyframes": keys[1]}),
    ]
    contact = {"activation_distance": d_hat}
    made = pdipc.Simulation(scene([ball], plates, contact=contact, gravity=(0, 0, 0), time_step=h, damping=2.0), "cpu")
    tets = made.model.assembly.bodies[0].tets

    def volumes():
        a = made.positions[tets]
        return np.linalg.det(a[:, 1:] - a[:, :1]) / 6.0

    start, heights = volumes(), []
    for _ in range(60):
        made.step()
        heights.append(np.ptp(made.positions[made.model.assembly.bodies[0].first : made.model.assembly.bodies[0].last, 1]))
    assert min(heights) < 0.025 * 2 * radius
    assert volumes().sum() == pytest.approx(start.sum(), rel=0.01)
    assert volumes().min() > 0.0
    assert clean(made)


def momentum_lost(body, steps, **settings):
    """(3,) N m s: what the angular momentum about the held vertex, or the origin, has changed by beyond gravity and the integrator; and its
    scale, r m v.
    """
    made = pdipc.Simulation(scene([body], **settings), "cpu")
    mass, h = made.model.external.mass, made.model.settings.time_step
    held = made.positions[made.model.assembly.kinematic_vertices]
    center = held[0] if len(held) else np.zeros(3)

    def momentum(x, v):
        return (mass[:, None] * np.cross(x - center, v)).sum(axis=0)

    def state():
        return made.positions + made.state.remainders.numpy(), made.state.velocities.numpy().astype(float)

    x, v = state()
    first, off, scale = momentum(x, v), np.zeros(3), 0.0
    for _ in range(steps):
        assert made.step().converged
        before, (x, v) = v, state()
        turning = np.cross(v, before) + np.cross(x - center, made.model.scene.simulation.gravity)
        off += h * (mass[:, None] * turning).sum(axis=0)
        scale = max(scale, mass @ (np.linalg.norm(x - center, axis=1) * np.linalg.norm(v, axis=1)))
    return momentum(x, v) - first - off, scale
