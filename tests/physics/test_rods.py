"""Rods against the mechanics of beams: bending, twist, buckling under load and under torque, the catenary, momentum; and their thickness."""

import numpy as np
import pytest
import scipy.optimize
import warp as wp

import pdipc
from pdipc.bodies.elasticity import elasticity
from pdipc.constraints import Projector
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.judge import boxes
from pdipc.judge.exact import stays_apart_exactly
from pdipc.scene.assembly import assemble

from .scenes import clean, cloth, floor, rod, scene, solid, too_near, watched

BEAM = 0.02  # relative
RADIUS, YOUNG, POISSON = 5e-3, 1e9, 0.3
EI = YOUNG * np.pi * RADIUS**4 / 4
GJ = EI / (1 + POISSON)
EA = YOUNG * np.pi * RADIUS**2
STATIC = {"time_step": 1.0, "tolerance": 1e-7, "gravity": (0, 0, 0)}  # so long a step leaves no inertia to speak of
DEVICE, PRECISION = Device("cpu", threads=1), real("float64")


def beam(length, segments, **more):
    return rod("beam", length, segments, radius=RADIUS, young=YOUNG, poisson=POISSON, **more)


def elastic(assembly, positions):
    """The projector of the elastic energy, and what it gives at `positions` (n, 3): the energy, J, and forces (n, 3), N."""
    sets, _ = elasticity(assembly, newton=True)
    n = len(positions)
    projector = Projector(DEVICE, PRECISION, n, sets)
    none, force = (wp.zeros(n, dtype=wp.vec3d, device="cpu") for _ in range(2))
    base = wp.array(positions, dtype=wp.vec3d, device="cpu")
    projector.add_forces(base, none, force, none)
    projector.evaluate(base, none)
    projector.differentiate(base, none, wp.zeros(1, dtype=wp.int32, device="cpu"))
    return projector, float(projector.energies.numpy().sum()), force.numpy()


def stable(assembly, positions, held):
    """Whether the elastic energy has a minimum at `positions` (n, 3) where the components `held` (n, 3) bool do not move."""
    projector, _, _ = elastic(assembly, positions)
    n, blocks, at = len(positions), projector.blocks.numpy(), 0
    hessian = np.zeros((n, 3, n, 3))
    for s in projector.bending:
        for v in s.vertices:
            for a in range(len(v)):
                for b in range(a, len(v)):
                    if a != b:  # rows add up to zero
                        for i, j, block in ((v[a], v[b], blocks[at]), (v[b], v[a], blocks[at].T)):
                            hessian[i, :, j] += block
                            hessian[i, :, i] -= block
                    at += 1
    free = ~held.ravel()
    return np.linalg.eigvalsh(hessian.reshape(3 * n, -1)[free][:, free])[0] > 0


def test_a_cantilever_bends_as_a_beam():
    length, segments, load = 0.5, 25, 0.02
    ends = {"pins": [{"select": {"vertices": [0, 1]}}]}
    simulation = pdipc.Simulation(scene([beam(length, segments, **ends)], **STATIC), "cpu")
    simulation.set_vertex_force(np.array([segments]), np.array([[0.0, -load, 0.0]]))
    for _ in range(3):
        assert simulation.step().converged
    clamped = length - 0.5 * length / segments  # a segment's direction is that at its middle
    assert -simulation.positions[segments, 1] == pytest.approx(load * clamped**3 / (3 * EI), rel=BEAM)


def test_a_shaft_twists_as_a_bar():
    """Both end segments are held, and one is turned by 90 degrees: energy, and the torque that it takes."""
    length, segments, angle = 0.5, 20, np.pi / 2
    turned = {"keyframes": [{"time": 0.0}, {"time": 1.0, "rotation": (90, 0, 0)}]}
    pins = [{"select": {"vertices": [0, 1]}}, {"select": {"vertices": [segments - 1, segments]}, "motion": turned}]
    simulation = pdipc.Simulation(scene([beam(length, segments, pins=pins)], **{**STATIC, "time_step": 0.1}), "cpu")
    for _ in range(20):
        assert simulation.step().converged
    x, assembly = simulation.positions, simulation.model.assembly
    _, energy, force = elastic(assembly, x)
    free = length - length / segments
    assert energy == pytest.approx(0.5 * GJ * angle**2 / free, rel=BEAM)
    held = assembly.pins[1].vertices
    torque = np.cross(x[held], force[held]).sum(axis=0)
    assert -torque[0] == pytest.approx(GJ * angle / free, rel=BEAM)
    assert np.abs(x[: segments + 1, 1:]).max() < 1e-6


@pytest.mark.parametrize(("part", "holds"), [(1 - BEAM, True), (1 + BEAM, False)])
def test_a_column_buckles_at_eulers_load(part, holds):
    length, segments = 1.0, 24
    assembly = assemble(scene([beam(length, segments)]))
    strain = part * np.pi**2 * EI / length**2 / EA
    x, last = assembly.positions * [1 - strain, 1, 1], segments
    held = np.zeros(x.shape, dtype=bool)
    held[[0, last], 1:] = held[0, 0] = True
    held[last + 1, 1:] = True  # a ghost point: nothing else keeps it from turning about its axis
    assert stable(assembly, x, held) == holds


@pytest.mark.parametrize(("part", "holds"), [(1 - BEAM, True), (1 + BEAM, False)])
def test_a_shaft_buckles_at_greenhills_torque(part, holds):
    """Clamped at both ends: tan(k) = k, k = M L / (2 EI), so M = 8.987 EI / L (Greenhill 1883)."""
    length, segments = 1.0, 60
    assembly = assemble(scene([beam(length, segments)]))
    spacing = length / segments
    torque = part * 2 * 4.493409 * EI / (length - spacing)
    turn = np.arcsin(torque * spacing / GJ) * np.arange(segments)
    x = assembly.positions.copy()
    ghosts = x[segments + 1 :]
    c, s = np.cos(turn), np.sin(turn)
    ghosts[:, 1], ghosts[:, 2] = c * ghosts[:, 1] - s * ghosts[:, 2], s * ghosts[:, 1] + c * ghosts[:, 2]
    held = np.zeros(x.shape, dtype=bool)
    held[[0, 1, segments - 1, segments, segments + 1, -1]] = True
    assert stable(assembly, x, held) == holds


def test_a_rope_hangs_as_a_catenary():
    length, segments, span = 1.0, 40, 0.7
    x = np.linspace(-0.5, 0.5, segments + 1)
    lines = np.column_stack([np.arange(segments), np.arange(1, segments + 1)])
    rest, start = np.column_stack([x * length, 0 * x, 0 * x]), np.column_stack([x * span, 0.3 * (4 * x**2 - 1), 0 * x])
    pins = [{"select": {"vertices": [0, segments]}}]
    material = {"stretch_stiffness": 1e4, "bending_stiffness": 0.0, "radius": RADIUS}
    rope = {
        "name": "rope",
        "kind": "rod",
        "mesh": {"vertices": rest, "lines": lines, "start": start},
        "material": material,
        "pins": pins,
    }
    simulation = pdipc.Simulation(scene([rope], time_step=0.2, tolerance=1e-5), "cpu")
    for _ in range(30):
        assert simulation.step().converged
    a = scipy.optimize.brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - length, 0.05, 10)
    sag = a * (np.cosh(span / (2 * a)) - 1)
    assert -simulation.positions[:, 1].min() == pytest.approx(sag, rel=0.005)
    expected = a * np.cosh(simulation.positions[:, 0] / a) - a - sag
    assert np.abs(simulation.positions[:, 1] - expected).max() < 0.005 * sag


def test_what_keeps_a_rod_in_shape_moves_it_nowhere():
    """Forces within a bent, twisted, stretched rod and a ring have no resultant and no moment."""
    for mesh in ({"shape": "rope", "length": 1.0, "segments": 12}, {"shape": "ring", "radius": 0.2, "segments": 12}):
        assembly = assemble(scene([{**beam(1.0, 12), "mesh": mesh}]))
        x = assembly.positions + 0.01 * np.random.default_rng(0).standard_normal(assembly.positions.shape)
        _, energy, force = elastic(assembly, x)
        assert energy > 0.1
        size = np.abs(force).sum()
        assert np.abs(force.sum(axis=0)).max() < 1e-12 * size
        assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-12 * size


def test_a_rod_is_as_heavy_as_its_volume_and_at_rest_as_it_is_made():
    for mesh in ({"shape": "coil", "turns": 3.0, "segments": 60}, {"shape": "ring", "segments": 17}):
        body = {**rod("r", 1.0, 1, radius=2e-3, density=700.0), "mesh": mesh}
        simulation = pdipc.Simulation(scene([body], gravity=(0, 0, 0)), "cpu")
        segments = simulation.model.assembly.bodies[0].segments
        length = np.linalg.norm(simulation.positions[segments[:, 1]] - simulation.positions[segments[:, 0]], axis=1).sum()
        assert simulation.model.mass.numpy().sum() == pytest.approx(700.0 * np.pi * 4e-6 * length, rel=1e-12)
        before = simulation.positions
        simulation.step()
        assert np.abs(simulation.positions - before).max() < 1e-9


@pytest.mark.parametrize("angle", [90.0, 2.0, 0.0])
def test_rods_lie_on_rods_at_their_thickness(angle):
    """Across, nearly along and exactly along two that are held, where the two nearest segments are parallel: all at twice the radius."""
    apart = 0.014
    under = [
        rod(name, 0.3, 10, at=(0, 0, z), pins=[{"select": {"all": True}}], young=1e7)
        for name, z in (("a", -apart / 2), ("b", apart / 2))
    ]
    over = rod("over", 0.2, 7, at=(0.003, 0.014, 0), rotation=(0, angle, 0), young=1e8)
    simulation = watched(scene([*under, over], time_step=0.01, contact={"activation_distance": 2e-4}, damping=5.0))
    for _ in range(40):
        assert simulation.step().converged
    assert too_near(simulation) == []
    x = simulation.positions[simulation.model.assembly.body_of_vertex == 2][:8]
    height = 2 * RADIUS if angle == 90.0 else np.sqrt((2 * RADIUS) ** 2 - (apart / 2) ** 2)
    middle = x[3:5, 1].mean()
    assert height < middle < height + 4e-4
    assert np.ptp(x[:, 1]) < 1e-3


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_rods_that_meet_fast_do_not_pass(precision):
    """Two crossing rods at 40 m/s, twenty times their thickness a step: every committed motion is judged in whole numbers."""
    a = rod("a", 0.4, 12, velocity=(0, 20, 0))
    b = rod("b", 0.4, 11, at=(0.01, 0.1, 0.005), rotation=(0, 70, 0), velocity=(0, -20, 0))
    simulation = pdipc.Simulation(scene([a, b], time_step=0.005, precision=precision), "cpu")
    first, second = (body.segments for body in simulation.model.assembly.bodies)
    judged = 0

    def judge(x, x_end):
        nonlocal judged
        ends = [np.asarray(each.numpy(), dtype=np.float64) for each in (x, x_end)]
        moving = [np.concatenate([each[lines] for each in ends], axis=1) for lines in (first, second)]
        bounds = [corner for each in moving for corner in (each.min(axis=1), each.max(axis=1))]
        for i, j in boxes.overlapping(*bounds):
            p, q = moving[0][i], moving[1][j]
            assert stays_apart_exactly(np.concatenate([p[:2], q[:2], p[2:], q[2:]]), "edge_edge", 1.0)
            judged += 1

    simulation.observe = judge
    for _ in range(8):
        simulation.step()
    assert judged > 10


def test_every_kind_meets_a_rod():
    """A solid, a cloth and a rod fall on a rod that lies over a ball; all contacts are judged, with their thickness."""
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.1, "cells": 6}}
    first = rod("first", 0.4, 16, at=(0, 0.115, 0), young=1e7)
    second = rod("second", 0.4, 15, at=(0.01, 0.13, 0.02), rotation=(0, 60, 0), young=1e7)
    sheet = cloth("sheet", (0.25, 0.25), (6, 6), at=(0, 0.15, 0), minimum_separation=1e-3)
    block = solid("block", (0.08, 0.08, 0.08), (2, 2, 2), at=(0, 0.2, 0))
    made = scene([first, second, sheet, block], [ball, floor(at=(0, -0.12, 0))], contact={"friction": 0.3}, time_step=0.01)
    simulation = pdipc.Simulation(made, "cpu")
    met = set()
    for number in range(20):
        assert simulation.step().converged
        assert clean(simulation) and (number % 4 or too_near(simulation) == [])
        pairs = simulation.work.pairs
        quads = pairs.quads.numpy()[: int(pairs.count.numpy()[0])]
        met |= {tuple(sorted(pair)) for pair in simulation.model.assembly.body_of_vertex[quads[:, [0, 3]]].tolist()}
    names = [body.name for body in simulation.model.assembly.bodies]
    together = {frozenset(names[k] for k in pair) for pair in met}
    for other in ("second", "sheet", "ball"):
        assert frozenset(("first", other)) in together
    assert frozenset(("sheet", "block")) in together


def test_rods_step_alike_on_any_number_of_threads():
    found = []
    for threads in (1, 3):
        model = pdipc.build(scene([rod("a", 0.3, 20, at=(0, 0.012, 0)), rod("b", 0.3, 20, rotation=(0, 50, 0))]), "cpu")
        model.device.threads = threads
        simulation = pdipc.Simulation(model)
        for _ in range(5):
            simulation.step()
        found.append(simulation.positions)
    assert np.array_equal(*found)
