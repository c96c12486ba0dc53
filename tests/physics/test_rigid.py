"""Rigid bodies against the mechanics of solids: falling over, rolling, precession, momentum; stacks, chains; and what they meet."""

import numpy as np
import pytest
import scipy.integrate

import pdipc
from pdipc.scene.assembly import assemble
from pdipc.scene.errors import SceneWarning
from pdipc.scene.rigid import inertia

from .scenes import clean, cloth, floor, rod, scene, solid, too_near, watched

STEEL = 7800.0
MECHANICS = 0.03  # relative


def rigid(name, mesh, *, density=1000.0, stiffness=1e9, **more):
    return {"name": name, "kind": "rigid", "mesh": mesh, "material": {"density": density, "shape_stiffness": stiffness}, **more}


def cube(side, cells=1):
    return {"shape": "box", "size": (side, side, side), "cells": (cells, cells, cells)}


def frame(simulation, body=0):
    """The deformation gradient (3, 3) of a rigid body, from its four points, and where its centre is."""
    own = simulation.model.assembly.bodies[body]
    rest, now = simulation.model.assembly.rest_positions[own.handles], simulation.positions[own.handles]
    f = np.linalg.lstsq(rest - rest.mean(axis=0), now - now.mean(axis=0), rcond=None)[0].T
    return f, now.mean(axis=0)


def test_four_points_have_the_mass_and_inertia_of_a_box():
    sides = np.array([0.3, 0.2, 0.1])
    turned = rigid(
        "b", {"shape": "box", "size": tuple(sides), "cells": (3, 2, 1)}, rotation=(20, 30, 40), translation=(1, 2, 3)
    )
    model = pdipc.build(scene([turned]), "cpu")
    x, m = model.assembly.positions, model.mass.numpy()
    assert m.sum() == pytest.approx(1000.0 * sides.prod(), rel=1e-12)
    center = m @ x / m.sum()
    assert center == pytest.approx([1, 2, 3], abs=1e-12)
    moments = np.linalg.eigvalsh(np.einsum("i,ij,ik->jk", m, x - center, x - center)) / m.sum()
    assert moments == pytest.approx(np.sort(sides**2 / 12), rel=1e-12)
    (body,) = model.assembly.bodies
    assert body.weights @ x[body.handles] == pytest.approx(x[: body.count], abs=1e-12)


def test_a_steel_cube_tips_over_as_a_pendulum_upside_down():
    """About an edge that friction holds: theta'' = 3 g / (2 sqrt(2) s) sin theta, from 0.1 rad past the balance to 0.7 rad."""
    side, start, end, h = 0.1, 0.1, 0.7, 1e-3
    tilted = rigid("cube", cube(side), density=STEEL, rotation=(0, 0, -45 - np.degrees(start)), stiffness=1e10)
    corner = side / np.sqrt(2) * np.cos(start)
    tilted["translation"] = (0, corner + 1.2e-4, 0)
    made = scene([tilted], [floor()], time_step=h, contact={"friction": 2.0, "activation_distance": 2e-4})
    simulation = pdipc.Simulation(made, "cpu")
    rate = 3 * 9.81 / (2 * np.sqrt(2) * side)

    def past(t, y):
        return y[0] - end

    past.terminal = True
    fall = scipy.integrate.solve_ivp(lambda t, y: [y[1], rate * np.sin(y[0])], (0, 2), [start, 0], events=past, rtol=1e-9)
    expected = fall.t_events[0][0]
    angle, before, steps = start, start, 0
    while angle < end:
        assert simulation.step().converged
        f, _ = frame(simulation)
        before, angle, steps = angle, start - np.arctan2(f[1, 0], f[0, 0]), steps + 1
        assert steps * h < 2 * expected
    assert clean(simulation)
    time = h * (steps - (angle - end) / (angle - before))
    assert time == pytest.approx(expected, rel=MECHANICS)
    assert np.abs(f.T @ f - np.eye(3)).max() < 1e-5


def test_a_ball_rolls_down_a_slope():
    """g sin(slope) / (1 + I / (m r^2)), I the mesh's own; and without friction it slides at g sin(slope)."""
    slope, radius, h = np.radians(15), 0.1, 2e-3
    gravity = (9.81 * np.sin(slope), -9.81 * np.cos(slope), 0)
    for friction in (0.6, 0.0):
        mesh = {"shape": "sphere", "radius": radius, "cells": 20}
        speed = 0.5
        ball = rigid("ball", mesh, translation=(0, radius + 2e-4, 0), velocity=(speed, 0, 0))
        if friction:
            ball["angular_velocity"] = (0, 0, -speed / radius)
        made = scene([ball], [floor()], time_step=h, gravity=gravity, contact={"friction": friction})
        simulation = pdipc.Simulation(made, "cpu")
        (body,) = (b for b in simulation.model.assembly.bodies if b.name == "ball")
        own = simulation.model.assembly.rest_positions[body.first : body.first + body.count]
        gyration = (inertia(own, body.triangles).radii ** 2)[:2].sum()
        expected = 9.81 * np.sin(slope) / (1 + gyration / radius**2 if friction else 1)
        before, steps = frame(simulation)[1][0], 100
        for _ in range(steps):
            assert simulation.step().converged
        time = steps * h
        found = 2 * (frame(simulation)[1][0] - before - speed * time) / time**2
        assert found == pytest.approx(expected, rel=MECHANICS)


def spindle(radius, height, sides=24):
    """Two cones, tip to tip outward, that stand on the origin: vertex 0."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.column_stack([radius * np.cos(angle), np.full(sides, height), radius * np.sin(angle)])
    points = np.concatenate([[[0, 0, 0], [0, 2 * height, 0]], ring])
    a, b = 2 + np.arange(sides), 2 + (np.arange(sides) + 1) % sides
    low, high = np.zeros(sides, dtype=int), np.ones(sides, dtype=int)
    return points, np.concatenate([np.column_stack([low, a, b]), np.column_stack([high, b, a])])


def test_a_top_precesses():
    """Steadily at W with I1 W^2 cos(theta) - I3 w W + m g l = 0, w the spin about the axis and I1 about the tip."""
    points, triangles = spindle(0.05, 0.03)
    of_mesh = inertia(points, triangles)
    along, across, _ = np.sort(of_mesh.radii**2)
    third, first = 2 * across, along + across + of_mesh.center[1] ** 2  # over m
    tilt, spin, length, h, steps = np.radians(20), 60.0, of_mesh.center[1], 1e-4, 700
    wanted = np.roots([first * np.cos(tilt), -third * spin, 9.81 * length]).min()
    axis = np.array([np.sin(tilt), np.cos(tilt), 0])
    turning = wanted * np.array([0, 1, 0]) + (spin - wanted * np.cos(tilt)) * axis
    top = rigid("top", {"vertices": points, "triangles": triangles}, rotation=(0, 0, -np.degrees(tilt)), stiffness=1e8)
    top["angular_velocity"], top["velocity"] = tuple(turning), tuple(np.cross(turning, length * axis))
    top["pins"] = [{"select": {"vertices": [0]}, "stiffness": 1e6}]
    simulation = pdipc.Simulation(scene([top], time_step=h, tolerance=1e-4), "cpu")
    for _ in range(steps):
        assert simulation.step().converged
    f, center = frame(simulation)
    now = f @ axis
    angle = np.arctan2(-now[2], now[0])
    assert angle == pytest.approx(wanted * h * steps, rel=MECHANICS)
    assert np.arccos(now[1] / np.linalg.norm(now)) == pytest.approx(tilt, abs=0.01)
    assert np.linalg.norm(center) == pytest.approx(length, rel=1e-3)


def test_a_free_body_keeps_its_momenta_and_what_it_loses_of_its_spin_is_known():
    """Implicit Euler takes (w h)^2 of a spin a step, and nothing of a translation."""
    h, spin = 1e-3, 20.0
    body = rigid("b", cube(0.2), velocity=(1, 2, 3), angular_velocity=(0, spin, 0))
    simulation = pdipc.Simulation(scene([body], time_step=h, gravity=(0, 0, 0), tolerance=1e-5), "cpu")
    start = frame(simulation)[1]
    for _ in range(100):
        simulation.step()
    assert frame(simulation)[1] - start == pytest.approx(np.array([0.1, 0.2, 0.3]), rel=1e-6)
    v, x, m = simulation.state.velocities.numpy(), simulation.positions, simulation.model.mass.numpy()[:, None]
    arm = x - (m * x).sum(axis=0) / m.sum()
    turning = (m * np.cross(arm, v)).sum(axis=0)[1] / (m * (arm[:, [0, 2]] ** 2).sum(axis=1, keepdims=True)).sum()
    assert 1 - turning / spin == pytest.approx(100 * (spin * h) ** 2, rel=0.1)


def test_a_stack_of_heavy_on_light_stands():
    bodies = [rigid("light", cube(0.1), density=100.0, translation=(0, 0.0503, 0))]
    bodies.append(rigid("heavy", cube(0.1), density=10000.0, translation=(0.003, 0.1506, 0.002), rotation=(0, 15, 0)))
    simulation = watched(scene(bodies, [floor()], time_step=0.01, contact={"friction": 0.5}))
    for _ in range(30):
        assert simulation.step().converged
    x = simulation.positions
    assert np.abs(simulation.state.velocities.numpy()).max() < 2e-3
    assert 0.2 < x[simulation.model.assembly.bodies[1].handles].mean(axis=0)[1] + 0.05 < 0.2015
    assert too_near(simulation) == []


def test_a_chain_of_rings_hangs():
    """Three rings through each other, the first of them held: they hang, straight, and none comes apart."""
    torus = {"shape": "torus", "major_radius": 0.05, "minor_radius": 0.01, "cells": (4, 16)}
    rings = [
        rigid(f"ring{k}", torus, density=STEEL, translation=(0, -0.062 * (k + 1), 0), rotation=(90, 90 * ((k + 1) % 2), 0))
        for k in range(3)
    ]
    held = {"name": "held", "mesh": torus, "rotation": (90, 0, 0)}
    simulation = pdipc.Simulation(scene(rings, [held], time_step=0.005, damping=5.0, contact={"friction": 0.2}), "cpu")
    for number in range(60):
        assert simulation.step().converged
        assert number % 6 or clean(simulation)
    heights = [simulation.positions[body.handles].mean(axis=0)[1] for body in simulation.model.assembly.bodies[:3]]
    assert -np.diff([0.0, *heights]) == pytest.approx(np.full(3, 0.08), abs=2.5e-3)
    assert too_near(simulation) == []


def test_every_kind_meets_a_rigid_body():
    """A rigid box on a sheet that four ropes hold, a solid on the box, a rod over both, and a rigid box that falls on a ball."""
    bodies = [
        cloth(
            "sheet",
            (0.3, 0.3),
            (8, 8),
            at=(0, 0.1, 0),
            minimum_separation=1e-3,
            pins=[{"select": {"box": ((-0.2, 0, -0.2), (-0.12, 1, 0.2))}}],
        ),
        rigid("box", cube(0.08), translation=(-0.07, 0.145, 0)),
        solid("soft", (0.06, 0.06, 0.06), (2, 2, 2), at=(-0.07, 0.219, 0)),
        rod("rod", 0.4, 14, at=(-0.07, 0.1925, 0.035), radius=3e-3, young=1e7),
        rigid("other", {"shape": "sphere", "radius": 0.04, "cells": 6}, translation=(0.0, 0.25, 0.0), density=500.0),
    ]
    obstacles = [{"name": "ball", "mesh": {"shape": "sphere", "radius": 0.09, "cells": 6}, "translation": (0, 0.0, 0)}]
    simulation = pdipc.Simulation(scene(bodies, obstacles, time_step=0.01, contact={"friction": 0.3}), "cpu")
    together = set()
    for number in range(20):
        assert simulation.step().converged
        assert clean(simulation) and (number % 5 or too_near(simulation) == [])
        pairs = simulation.work.pairs
        quads = pairs.quads.numpy()[: int(pairs.count.numpy()[0])]
        names = [body.name for body in simulation.model.assembly.bodies]
        met = simulation.model.assembly.body_of_vertex[quads[:, [0, 3]]]
        together |= {frozenset((names[a], names[b])) for a, b in met.tolist()}
    for pair in (("box", "sheet"), ("box", "soft"), ("box", "rod")):
        assert frozenset(pair) in together, together
    for body in (1, 4):
        f, _ = frame(simulation, body)
        assert np.abs(f.T @ f - np.eye(3)).max() < 1e-4


def test_what_is_no_rigid_body_is_refused():
    for mesh, said in (
        ({"shape": "grid"}, "belong to one triangle only; the surface of a rigid body must be closed"),
        ({"vertices": spindle(1, 1)[0], "triangles": spindle(1, 1)[1][:, ::-1]}, "it must face outward around an inside"),
    ):
        with pytest.raises(pdipc.SceneError, match=said):
            assemble(scene([rigid("b", mesh)]))
    held = scene([rigid("b", cube(0.1), pins=[{"select": {"all": True}}])])
    assert ["holds vertices of a rigid body exactly" in str(finding) for finding in pdipc.check_scene(held)] == [True]
    slow = scene([rigid("b", cube(0.1))], nonlinear_solver="local-global")
    assert ["take the Newton solver" in str(finding) for finding in pdipc.check_scene(slow)] == [True]


def test_a_state_in_which_a_rigid_body_is_torn_is_refused():
    simulation = pdipc.Simulation(scene([rigid("b", cube(0.1))]), "cpu")
    x = simulation.positions
    turned = np.array([1, 0, 0]) + x @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    simulation.set_positions("b", turned)
    assert simulation.step().converged
    turned[3] += [0, 0, 0.001]
    with pytest.raises(ValueError, match=r'vertex 3 of the rigid body "b" is 0\.001 m from where its four points have it'):
        simulation.set_positions("b", turned)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_pull_at_a_corner_turns_and_moves_a_body_as_it_must(precision):
    """A force F off the centre for a step: v = F h / m, and w = h I^-1 (r x F)."""
    side, h, pull = 0.2, 1e-2, np.array([0.0, 0.3, 0.0])
    made = scene([rigid("b", cube(side))], time_step=h, gravity=(0, 0, 0), tolerance=1e-6, precision=precision)
    simulation = pdipc.Simulation(made, "cpu")
    x = simulation.positions
    corner = int(np.argmax(x[:8].sum(axis=1)))
    simulation.set_vertex_force(np.array([corner]), pull[None])
    simulation.step()
    v, mass = simulation.state.velocities.numpy(), 1000 * side**3
    expected = h / mass * (pull + np.cross(np.cross(x[corner], pull) * 6 / side**2, x))
    close = 1e-3 if precision == "float64" else 1e-2
    assert v == pytest.approx(expected, rel=close, abs=close * np.abs(expected).max())


def test_rigid_bodies_step_alike_on_any_number_of_threads():
    found = []
    for threads in (1, 3):
        bodies = [
            rigid(str(k), {"shape": "sphere", "radius": 0.05, "cells": 6}, translation=(0.01 * k, 0.0505 + 0.101 * k, 0))
            for k in range(2)
        ]
        model = pdipc.build(scene(bodies, [floor()]), "cpu")
        model.device.threads = threads
        simulation = pdipc.Simulation(model)
        for _ in range(5):
            simulation.step()
        found.append(simulation.positions)
    assert np.array_equal(*found)


def test_bodies_that_start_in_each_other_are_separated_as_they_are():
    """A rigid cube in another, and a rod through both: moved apart, the cubes keep their shape, and ghost points stay by their rods."""
    bodies = [
        rigid("a", cube(0.1)),
        rigid("b", cube(0.1), translation=(0.02, 0.095, 0.01)),
        rod("r", 0.4, 9, at=(0, 0.02, 0.048)),
    ]
    made = scene(bodies, contact={"start": "separate"}, gravity=(0, 0, 0))
    with pytest.warns(SceneWarning):
        simulation = pdipc.Simulation(made, "cpu")
    assert clean(simulation)
    assert simulation.step().converged
    for body in simulation.model.assembly.bodies[:2]:
        side = np.linalg.norm(np.diff(simulation.positions[body.handles], axis=0), axis=1)
        at_rest = np.linalg.norm(np.diff(simulation.model.assembly.rest_positions[body.handles], axis=0), axis=1)
        assert side == pytest.approx(at_rest, rel=1e-4)
