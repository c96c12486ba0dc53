"""Contact against what mechanics says: momentum, friction, slopes."""

import numpy as np
import pytest

import pdipc

from .scenes import cloth, floor, scene, solid, watched

G = 9.81


def test_free_collision_conserves_linear_momentum():
    a = solid("a", (0.2, 0.2, 0.2), (2, 2, 2), at=(-0.15, 0, 0), velocity=(2, 0, 0), density=500)
    b = solid("b", (0.2, 0.2, 0.2), (2, 2, 2), at=(0.15, 0.03, 0.02), velocity=(-1, 0, 0), rotation=(10, 20, 30))
    # what a step leaves unsolved is a force from outside: momentum is kept as far as steps converge
    simulation = watched(scene([a, b], gravity=(0, 0, 0), time_step=0.01, tolerance=1e-6))
    mass = simulation.model.external.mass[:, None]

    def momentum():
        return (mass * simulation.state.velocities.numpy()).sum(axis=0)

    before, barriers = momentum(), 0
    for _ in range(30):
        barriers += simulation.step().barriers
    assert barriers > 0
    scale = (mass * np.abs(simulation.model.assembly.velocities)).sum()
    assert np.abs(momentum() - before).max() < 1e-5 * scale


def slide(angle, friction, seconds, h=0.01):
    """Distance that a stiff block slides down a slope of `angle` degrees from rest, and the analytic g t^2 / 2."""
    slope = np.radians(angle)
    gap, size = 1.5e-3, 0.2
    normal = np.array([np.sin(slope), np.cos(slope), 0])  # of a plane turned by -angle about z
    down = np.array([np.cos(slope), -np.sin(slope), 0])
    at = tuple((size / 4 + gap) * normal)
    block = solid("block", (size, size / 2, size), (3, 2, 3), at=at, rotation=(0, 0, -angle), young=1e6, friction=friction)
    ground = floor(20.0, rotation=(0, 0, -angle), friction=friction)
    contact = {"activation_distance": 2e-3}
    simulation = watched(scene([block], [ground], contact=contact, time_step=h, max_outer=200))
    mass = simulation.model.external.mass[:, None]
    speeds = []
    for _ in range(round(seconds / h)):
        simulation.step()
        speeds.append(((mass * simulation.state.velocities.numpy()).sum(axis=0) / mass.sum()) @ down)
    return np.array(speeds)


def acceleration(speeds, h=0.01):
    """Slope of the speed over the second half, when the block has settled."""
    half = len(speeds) // 2
    return np.polyfit(h * np.arange(half, len(speeds)), speeds[half:], 1)[0]


def test_frictionless_slope():
    assert acceleration(slide(20.0, 0.0, 0.6)) == pytest.approx(G * np.sin(np.radians(20.0)), rel=0.02)


def test_sliding_with_friction():
    angle, mu = np.radians(30.0), 0.3
    assert acceleration(slide(30.0, 0.3, 0.6)) == pytest.approx(G * (np.sin(angle) - mu * np.cos(angle)), rel=0.02)


def test_sticks_below_the_friction_angle():
    assert abs(slide(15.0, 0.4, 0.5)[-1]) < 2e-3


def test_a_gap_that_rounds_to_less_than_nothing_still_pushes():
    """Sheets that meet at 100 m in float32: gaps are a few roundings, and may measure as negative. No force is lost."""
    place = {"rotation": (10, 20, 30)}
    low = cloth("low", (0.3, 0.3), (4, 4), at=(100, 0, 0), **place)
    high = cloth("high", (0.3, 0.3), (4, 4), at=(100, 0.02, 0), velocity=(0, -60, 0), **place)
    contact = {"minimum_separation": 2e-3, "activation_distance": 5e-3, "stiffness_scale": 1e-3}
    made = watched(scene([low, high], contact=contact, precision="float32", max_outer=30))
    pressed, smallest = 0, np.inf
    for _ in range(6):
        result = made.step()
        count = int(made.work.pairs.count.numpy()[0])
        pressed += count
        assert np.isfinite(made.work.pairs.slope.numpy()[:count]).all()
        assert result.smallest_gap > 0
        smallest = min(smallest, result.smallest_gap)
    assert pressed > 20
    assert smallest < 10 * np.spacing(np.float32(100))


def test_the_stiffest_barriers_of_float32_stay_numbers():
    """A ball thrown on a rod at 3 km/s, under stiff barriers and cut short, leaves gaps whose barriers have determinants beyond float32."""
    ball = {"name": "ball", "kind": "solid", "mesh": {"shape": "sphere", "radius": 0.1, "cells": 4}}
    ball |= {"translation": (0, 0.32, 0), "velocity": (0, -3000, 0), "material": {"young_modulus": 1e5}}
    rod = {"name": "rod", "mesh": {"shape": "cylinder", "radius": 0.01, "length": 1, "cells": [2, 1]}, "rotation": (90, 0, 0)}
    contact = {"activation_distance": 6e-4, "stiffness_scale": 1e8}
    made = watched(scene([ball], [floor(2.0, at=(0, -0.1, 0)), rod], contact=contact, precision="float32", max_outer=2))
    stiffest = 0.0
    for _ in range(2):
        assert "not finite" not in made.step().message
        stiffest = max(stiffest, np.abs(made.work.pairs.diagonal.numpy()).max())
    assert stiffest > np.finfo("float32").max ** (1 / 3)


def test_a_stack_of_boxes_stays_where_it_is():
    """Three boxes on each other, each askew on the one below: smoothed friction lets them creep, far below the speed that counts
    as sticking, 1e-3 m/s. Measured after 4 s: up to 2e-6 m/s along the floor, 2e-6 m/s down, 5e-5 rad/s.
    """
    boxes = [
        solid(
            f"box{k}",
            (0.2, 0.2, 0.2),
            (3, 3, 3),
            at=(0.4 + 0.01 * k, 0.102 + 0.202 * k, 0.013 * k - 0.3),
            rotation=(0, 7 * k, 0),
        )
        for k in range(3)
    ]
    made = pdipc.Simulation(scene(boxes, [floor(2.0)], contact={"friction": 0.5}, damping=2.0), device="cpu")
    surfaces = [slice(body.first, body.last) for body in made.model.assembly.bodies[:3]]

    def poses():
        """Middle of each box, and its turn about y, rad."""
        found = []
        for own in surfaces:
            x, rest = (
                points[own] - points[own].mean(axis=0) for points in (made.positions, made.model.assembly.rest_positions)
            )
            turned = np.arctan2((rest[:, 2] * x[:, 0] - rest[:, 0] * x[:, 2]).sum(), (rest[:, [0, 2]] * x[:, [0, 2]]).sum())
            found.append([*made.positions[own].mean(axis=0), turned])
        return np.array(found)

    for _ in range(400):
        made.step()
    before = poses()
    for _ in range(100):
        assert made.step().converged
    speed = np.abs(poses() - before)  # it was one second
    assert speed[:, [0, 2]].max() < 2e-5
    assert speed[:, 1].max() < 2e-5
    assert speed[:, 3].max() < 5e-4
