"""What follows a script and is held up: it goes as far as the step allows, and the result says how far behind it is."""

import itertools

import numpy as np
import pytest
from physics.scenes import cloth, floor, scene, solid, watched

import pdipc
from pdipc.integration import status
from pdipc.integration.script import PATIENCE
from pdipc.scene import generators
from pdipc.scene.check import check


def test_closing_boards_arrive():
    boards = [
        {
            "name": name,
            "mesh": {"shape": "box", "size": [1.0, 0.05, 1.0], "cells": [1, 1, 1]},
            "translation": [0.0, side * 0.13, 0.0],
            "motion": {"velocity": [0.0, -side * 1.0, 0.0], "end": 0.05},
        }
        for name, side in (("lower", -1), ("upper", 1))
    ]
    block = {"name": "block", "kind": "solid", "mesh": {"shape": "box", "size": [0.2, 0.2, 0.2], "cells": [3, 3, 3]}}
    simulation = pdipc.Simulation(pdipc.Scene(simulation={"gravity": [0, 0, 0]}, bodies=[block], obstacles=boards), "cpu")
    assembly = simulation.model.assembly
    for _ in range(8):
        result = simulation.step()
        lag = np.abs(simulation.positions[assembly.kinematic_vertices] - assembly.kinematic_positions(simulation.state.time))
        assert result.lag == pytest.approx(lag.max(), abs=1e-9)
        assert len(pdipc.find_intersections(simulation.positions, simulation.triangles, assembly.obstacle)) == 0
    assert lag.max() < 1e-9


@pytest.mark.parametrize("method", ["barrier", "paper"])
@pytest.mark.parametrize("select", [{"nearest": [0.0, 0.02, 0.0]}, {"all": True}], ids=["one vertex", "all"])
def test_a_pin_cannot_lead_a_cloth_through_an_obstacle_or_another_pinned_cloth(select, method):
    """Held vertices stop before the floor's inside, or their edges would end up on both sides of it; so does a cloth held all over."""
    led = [{"select": select, "motion": {"velocity": [0.0, -3.0, 0.0]}}]
    held = [{"select": {"all": True}}]
    sheets = [
        cloth("sheet", (0.4, 0.4), (4, 4), at=(0.0, 0.02, 0.0), pins=led),
        cloth("held", (0.9, 0.9), (2, 2), at=(0.02, 0.01, 0.03), pins=held),
    ]
    for bodies, obstacles in ((sheets[:1], [floor(3.0, at=(0.31, 0.0, 0.17))]), (sheets, [])):
        simulation = watched(scene(bodies, obstacles, contact={"method": method}, max_outer=8))
        results = [simulation.step() for _ in range(3)]
        lowest = 0.0 if obstacles else 0.01
        assert 0.0 < simulation.positions[: 5 * 5, 1].min() - lowest < 1e-3
        assert results[-1].lag > 0.06  # the script says 7 cm below
        behind = f'body "sheet", pins[0] is {results[-1].lag:.3g} m behind its target, where something is in its way'
        assert behind in results[-1].message


def test_who_waits_is_named_and_no_other():
    """Of two presses one comes down on a block that is held; it waits, and goes on when its script is above the block again."""
    block = solid("block", (0.1, 0.1, 0.1), (1, 1, 1), young=1e7, pins=[{"select": {"all": True}}])
    presses = []
    for name, x in (("free", 1.0), ("stopped", 0.0)):
        mesh = {"shape": "box", "size": [0.3, 0.02, 0.3], "cells": [1, 1, 1]}
        keyframes = [{"time": t, "translation": [0.0, y, 0.0]} for t, y in ((0, 0), (0.05, -0.05), (0.1, 0.2))]
        presses.append({"name": name, "mesh": mesh, "translation": [x, 0.08, 0.0], "motion": {"keyframes": keyframes}})
    simulation = watched(scene([block], presses, gravity=[0, 0, 0], max_outer=20))
    messages = []
    for _ in range(10):
        result = simulation.step()
        messages.append(result.message)
        assert ('obstacle "free"' in result.message) is False
        assert (f'obstacle "stopped" is {result.lag:.3g} m behind its target' in result.message) == (result.lag > 0.0)
    assert all("where something is in its way" in message for message in messages[2:6])
    assert result.lag == 0.0 and messages[-1] == ""


def body_that_closes(apart, times):
    """Two slabs that are one obstacle, named body, whose cache has them at the heights +-apart, m; they pass through each other where it is negative."""
    slab = generators.Box(size=(0.1, 0.02, 0.1), cells=(2, 1, 2)).mesh().surface()
    frames = np.array([np.concatenate([slab.vertices + np.array([0, s * y, 0]) for s in (-1, 1)]) for y in apart])
    mesh = {"vertices": frames[0], "triangles": np.concatenate([slab.triangles, slab.triangles + len(slab.vertices)])}
    return {"name": "body", "mesh": mesh, "motion": {"cache": {"vertices": frames, "times": times}}}, len(slab.vertices)


@pytest.mark.parametrize("nonlinear", ["newton", "local-global"])
def test_a_cloth_between_two_parts_of_one_obstacle_that_close_through_each_other(nonlinear):
    """As an arm that an animation puts through the chest: the body waits for the cloth, says so, and goes on when its frames open again."""
    body, size = body_that_closes([0.06, -0.02, -0.02, 0.06], [0.0, 0.08, 0.12, 0.2])
    sheet = cloth("sheet", (0.2, 0.2), (6, 6), at=(0.01, 0.0, 0.01), rotation=(0, 20, 0))
    contact = {"activation_distance": 2e-3, "minimum_separation": 4e-4}
    made = scene([sheet], [body], contact=contact, gravity=[0, 0, 0], nonlinear_solver=nonlinear, max_outer=40)
    simulation, lags = watched(made), []
    for _ in range(22):
        result = simulation.step()
        lags.append(result.lag)
        low, high = simulation.positions[49 : 49 + size, 1].max(), simulation.positions[49 + size :, 1].min()
        assert result.smallest_gap > 0.0 and high > low, (
            "they have not passed each other, nor come nearer to the cloth than they may"
        )
        assert result.converged or nonlinear == "local-global"
        told = f'obstacle "body" is {result.lag:.3g} m behind its target, where something is in its way'
        assert (told in result.message) == (result.lag > 0.0)
    assert lags[8] == pytest.approx(0.03, abs=1e-3), "each slab is told to be 3 cm past the cloth"
    assert lags[3] == 0.0 and min(lags[4:15]) > 0.0 and max(lags[15:]) == 0.0
    assert simulation.positions[49 + size :, 1].max() == pytest.approx(0.07) and simulation.observe.checked > 22


def test_a_cloth_hangs_from_a_moving_obstacle_by_springs():
    """Attachments may end at an obstacle, which then moves the body."""
    cloth = {"name": "c", "kind": "cloth", "mesh": {"shape": "grid", "cells": [4, 4], "size": [0.4, 0.4]}}
    bar = {
        "name": "o",
        "mesh": {"shape": "plane", "size": 0.4},
        "translation": [0, 0.3, 0],
        "motion": {"velocity": [0.5, 0, 0]},
    }
    springs = {"bodies": ["c", "o"], "pairs": [[0, 0], [4, 1], [20, 2], [24, 3]], "stiffness": 1000.0}
    sim = pdipc.Simulation(pdipc.Scene(bodies=[cloth], obstacles=[bar], attachments=[springs]), "cpu")
    assert all(sim.step().converged for _ in range(40))
    assert 0.1 < sim.positions[:25, 0].mean() < 0.25, "it follows the bar, which has gone 0.2 m"
    assert -0.2 < sim.positions[:25, 1].mean() < 0.0, "and hangs below it"


@pytest.mark.parametrize("method", ["newton", "local-global"])
def test_frames_within_a_step_are_followed(method):
    """A plate that is below the cloth at each step and above it in between does not pass it, but pushes it and is late."""
    low, high = (np.array([[-1, y, -1], [1, y, -1], [-1, y, 1], [1, y, 1.0]]) for y in (-0.05, 0.05))
    cache = {"vertices": np.array([low, high, low, high, low]), "times": [0.0, 0.005, 0.01, 0.015, 0.02]}
    plate = {"name": "plate", "mesh": {"vertices": low, "triangles": [[0, 2, 1], [1, 2, 3]]}, "motion": {"cache": cache}}
    sheet = cloth("sheet", [0.4, 0.4], [2, 2])
    made = scene([sheet], [plate], contact={"activation_distance": 2e-3}, nonlinear_solver=method, gravity=[0, 0, 0])
    simulation, highest = pdipc.Simulation(made, "cpu"), []
    simulation.observe = lambda x, x_end: highest.append(x_end.numpy()[:, 1])
    for _ in range(2):
        assert simulation.step().chords == 2
    heights = np.array(highest)
    assert heights[:, 9:].max() > 0.04 and np.all(heights[:, :9].min(axis=1) > heights[:, 9:].max(axis=1))
    assert np.allclose(simulation.positions[9:], low)


def test_more_frames_in_a_step_than_can_be_followed_are_refused():
    vertices, triangles = np.array([[-1, 0, -1], [1, 0, -1], [-1, 0, 1.0]]), [[0, 2, 1]]
    cache = {"vertices": np.tile(vertices, (9000, 1, 1)), "times": (np.arange(9000) * 1e-6).tolist()}
    plate = {"name": "plate", "mesh": {"vertices": vertices, "triangles": triangles}, "motion": {"cache": cache}}
    made = scene([cloth("sheet", [0.4, 0.4], [2, 2], at=(0, 1, 0))], [plate], time_step=0.005)
    (finding,) = check(made)
    assert "has 5001 keyframes or frames within a step" in str(finding)


def test_what_is_stopped_pushes_for_a_part_of_the_step_and_leaves_the_rest_to_what_it_pushed():
    """Six plates close on two balls and a cloth further than these can give: the last outer iterations of a step are for them alone."""
    plates = []
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        size, at, velocity = [0.3] * 3, [0.0] * 3, [0.0] * 3
        size[axis], at[axis], velocity[axis] = 0.02, 0.085 * side, -side
        mesh = {"shape": "box", "size": size, "cells": [1, 1, 1]}
        plates.append({"name": f"plate {axis} {side:+.0f}", "mesh": mesh, "translation": at, "motion": {"velocity": velocity}})
    material = {"young_modulus": 1e5, "poisson_ratio": 0.4}
    balls = [
        {"name": name, "kind": "solid", "mesh": {"shape": "sphere", "radius": 0.03, "cells": 4}, "material": material}
        | {"translation": at}
        for name, at in (("left", [-0.034, 0.001, 0.002]), ("right", [0.034, -0.002, 0.001]))
    ]
    bodies = [*balls, cloth("sheet", (0.12, 0.12), (8, 8), at=(0.0, 0.04, 0.0))]
    cap = 30
    simulation = pdipc.Simulation(scene(bodies, plates, gravity=[0, 0, 0], time_step=0.02, max_outer=cap), "cpu")
    work = simulation.work
    work.recorded = False
    accept, moving = work.method.accept, []

    def noted():
        accept()
        moving.append((int(work.count.numpy()[status.SINCE]), bool(work.count.numpy()[status.MOVING])))

    work.method.accept = noted
    for _ in range(4):
        result = simulation.step()
        assert (
            len(pdipc.find_intersections(simulation.positions, simulation.triangles, simulation.model.assembly.obstacle)) == 0
        )
    assert result.lag > 0.01
    assert max(since for since, _ in moving) > PATIENCE * cap + 1, "else this shows nothing"
    assert any(moves for _, moves in moving)
    assert not any(moves for since, moves in moving if since > PATIENCE * cap + 1)


def test_a_platform_lifts_what_is_heavy_on_a_light_cloth():
    """540 kg of steel on 50 g of cloth: gaps under it are a few ten-thousandths of d_hat, by its weight and not because there is no way."""
    sheet = cloth("sheet", (0.5, 0.5), (10, 10), at=(0.01, 0.03, 0.0), material={"areal_density": 0.2})
    mesh = {"shape": "box", "size": [0.3, 0.3, 0.3], "cells": [2, 2, 2]}
    load = {"name": "load", "kind": "rigid", "mesh": mesh, "translation": [0.0, 0.185, 0.0], "material": {"density": 20000.0}}
    slab = {"name": "platform", "mesh": {"shape": "box", "size": [0.8, 0.05, 0.8], "cells": [1, 1, 1]}}
    slab["motion"] = {
        "keyframes": [{"time": t, "translation": [0.0, y, 0.0]} for t, y in ((0, 0), (0.15, 0), (0.35, 0.1), (0.5, 0.1))]
    }
    simulation = pdipc.Simulation(scene([sheet, load], [slab]), "cpu")
    assembly = simulation.model.assembly
    (box,) = (body for body in assembly.bodies if body.name == "load")
    heights = []
    for _ in range(45):
        result = simulation.step()
        heights.append(simulation.positions[box.first : box.last, 1].mean())
    assert result.lag == 0.0
    assert heights[-1] - heights[14] == pytest.approx(0.1, abs=2e-3)
    assert len(pdipc.find_intersections(simulation.positions, simulation.triangles, assembly.obstacle)) == 0
