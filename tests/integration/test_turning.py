"""What turns is followed along its arcs, however fast: whatever is in its way is pushed or holds it up, and is never passed."""

import numpy as np
import pytest
from physics.scenes import cloth, scene, solid

import pdipc
from pdipc.device.launch import Device
from pdipc.judge.certify import certify
from pdipc.scene.motion import Trajectory
from pdipc.scene.movers import CHORD, MOST
from pdipc.scene.schema import Keyframe, Motion

H, SEPARATION, LENGTH = 0.01, 8e-3, 0.4
CONTACT = {"minimum_separation": SEPARATION, "activation_distance": 8e-3}


def bar(turns, **more):
    """A bar about the z axis that makes so many turns in a step."""
    motion = {"angular_velocity": [0.0, 0.0, 2 * np.pi * turns / H]}
    return {"name": "bar", "mesh": {"shape": "box", "size": [LENGTH, 0.03, 0.03], "cells": [2, 1, 1]}, "motion": motion, **more}


def fitted(points, start):
    """The rigid pose of `start` that is nearest to points (n, 3), by Kabsch 1976."""
    a, b = start - start.mean(axis=0), points - points.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = (u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    return a @ rotation.T + points.mean(axis=0)


class Arcs:
    """Judges every committed motion along the true arcs of a bar that turns about z through its middle: a rigid bar at each part of the way, all else straight."""

    def __init__(self, simulation):
        assembly = simulation.model.assembly
        (self.bar,) = (slice(b.first, b.last) for b in assembly.bodies if b.kinematic)
        self.start, self.triangles, self.obstacle = assembly.positions[self.bar], simulation.triangles, assembly.obstacle
        self.free = ~assembly.scripted
        self.rest = assembly.positions[self.free]
        self.turned = self.furthest = self.pushed = 0.0

    def __call__(self, x, x_end):
        x, x_end = x.numpy(), x_end.numpy()
        self.pushed = max(self.pushed, np.linalg.norm(x_end[self.free] - self.rest, axis=1).max(initial=0.0))
        begin, end = (fitted(each[self.bar], self.start) for each in (x, x_end))
        self.furthest = max(self.furthest, np.linalg.norm(end - x_end[self.bar], axis=1).max())
        middle, motion = begin.mean(axis=0), (end - begin).mean(axis=0)
        arm, arm_end = begin[0] - middle, end[0] - middle - motion
        angle = np.arctan2(np.cross(arm, arm_end)[2], (arm[:2] * arm_end[:2]).sum())
        self.turned += angle
        for part in (0.5, 1.0):
            moved = x + part * (x_end - x)
            c, s = np.cos(part * angle), np.sin(part * angle)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            moved[self.bar] = (begin - middle) @ turn.T + middle + part * motion
            found = pdipc.find_intersections(moved, self.triangles, self.obstacle)
            assert not len(found), f"triangles {found[:3].tolist()} meet on the arc"


def judged(bodies, obstacle, **more):
    simulation = pdipc.Simulation(scene(bodies, [obstacle], contact=CONTACT, gravity=[0, 0, 0], time_step=H, **more), "cpu")
    simulation.observe = Arcs(simulation)
    return simulation


@pytest.mark.parametrize("turns", [0.5, -1.0])
def test_a_turning_bar_carries_a_cloth_along(turns):
    """The cloth stands in the way of the bar's end; on chords of half and whole turns the bar would not touch it at all."""
    sheet = cloth("sheet", (0.06, 0.1), (2, 2), at=(0.15, np.sign(turns) * 0.05, 0.0))
    simulation = judged([sheet], bar(turns))
    result = simulation.step()
    arcs, chords = simulation.observe, result.chords
    needed = np.ceil(2 * np.pi * abs(turns) * np.sqrt(np.linalg.norm(arcs.start[0]) / (8 * CHORD * SEPARATION)))
    assert arcs.furthest <= 4 * CHORD * SEPARATION
    if result.lag == 0.0:
        assert chords == needed
        assert arcs.turned == pytest.approx(2 * np.pi * turns, rel=1e-6), "every turn is made"
    else:
        assert needed / 10 < chords <= needed
        assert "behind its target" in result.message
        assert simulation.state.reached.times[1] == pytest.approx(arcs.turned / (2 * np.pi * turns) * H, abs=1e-6)
    assert arcs.pushed > 0.06, "it gives way"


def test_a_bar_that_is_held_up_waits_and_goes_on_by_the_same_way():
    """A solid that is held stands in the way: the bar comes up to it, turn after turn, from the same side."""
    block = solid("block", (0.06, 0.06, 0.06), (1, 1, 1), at=(0.0, 0.15, 0.0), pins=[{"select": {"all": True}}])
    simulation = judged([block], bar(1.0), max_outer=20)
    for _ in range(3):
        result = simulation.step()
        assert result.lag > 0.02
        assert np.pi / 4 < simulation.observe.turned < np.pi / 2
    assert simulation.observe.furthest <= 4 * CHORD * SEPARATION
    kept = simulation.state.arrays()
    again = judged([block], bar(1.0), max_outer=20)
    again.state = again.model.state_from(kept)
    simulation.step(), again.step()
    assert np.array_equal(simulation.positions, again.positions), "what a checkpoint holds is all that there is"


@pytest.mark.parametrize("method", [{"nonlinear_solver": "local-global"}, {"method": "paper"}], ids=["local-global", "paper"])
def test_other_solvers_follow_arcs_too(method):
    contact = {**CONTACT, **{key: value for key, value in method.items() if key == "method"}}
    sheet = cloth("sheet", (0.06, 0.1), (2, 2), at=(0.15, 0.05, 0.0))
    more = {key: value for key, value in method.items() if key != "method"}
    simulation = pdipc.Simulation(
        scene([sheet], [bar(0.5)], contact=contact, gravity=[0, 0, 0], time_step=H, max_outer=10, **more), "cpu"
    )
    simulation.observe = Arcs(simulation)
    result = simulation.step()
    assert result.chords > 8 or result.lag > 0.0
    assert simulation.observe.furthest <= 4 * CHORD * SEPARATION
    assert simulation.observe.pushed > 0.02, "it gives way"


@pytest.mark.parametrize(
    "motion",
    [
        Motion(angular_velocity=(3.0, -40.0, 9.0), velocity=(1.0, 2.0, 3.0)),
        Motion(keyframes=[Keyframe(time=0), Keyframe(time=0.02, rotation=(90, 200, -300), translation=(1, 0, 0))]),
        Motion(keyframes=[Keyframe(time=0), Keyframe(time=0.02, rotation=(90, 200, -300))], smooth=True),
        Motion(keyframes=[Keyframe(time=0), Keyframe(time=0.02, rotation=(90, 100, -30))], turns="shortest"),
    ],
    ids=["spin", "angles", "smooth", "shortest"],
)
def test_no_chord_is_further_from_its_arc_than_the_lemma_says(motion):
    """Brute force over poses; with half as many chords the bound is not far away."""
    path, rng = Trajectory(motion, np.zeros(3)), np.random.default_rng(1)
    points = rng.standard_normal((20, 3))
    reach = np.linalg.norm(points, axis=1).max()
    for begin in rng.uniform(0.0, 0.018, 20):
        end = begin + 1e-3
        bound = reach * (path.turning(begin, end) * (end - begin)) ** 2 / 8
        first, last = path.apply(points, begin), path.apply(points, end)
        arc = np.array([path.apply(points, begin + part * (end - begin)) for part in np.linspace(0.0, 1.0, 21)])
        chord = first + np.linspace(0.0, 1.0, 201)[:, None, None] * (last - first)
        nearest = np.linalg.norm(arc[:, None] - chord, axis=3).max(axis=2).min(axis=1)
        assert nearest.max() <= bound + 1e-15
        assert nearest.max() > 0.02 * bound or motion.smooth


def test_a_corner_of_a_motion_within_a_step_is_not_cut():
    """Out and back within one step: what is in the way gives way, and springs back after, as its inertia says."""
    keys = [{"time": 0.0}, {"time": 0.004, "translation": [0.0, 0.1, 0.0]}, {"time": 0.01}]
    sheet = cloth("sheet", (0.1, 0.1), (2, 2), at=(0.0, 0.05, 0.0))
    simulation = judged([sheet], bar(0.0, motion={"keyframes": keys}))
    result = simulation.step()
    assert result.chords == 2
    assert result.lag == 0.0
    assert simulation.observe.pushed > 0.06
    assert simulation.positions[:9, 1] == pytest.approx(0.05, abs=1e-3)


def test_what_turns_too_fast_is_refused_before_anything_is_launched():
    sheet = cloth("sheet", (0.06, 0.1), (2, 2), at=(0.15, 0.05, 0.0))
    contact = {"activation_distance": 1e-4, "minimum_separation": 2e-6}
    made = scene([sheet], [bar(6.0)], contact=contact, time_step=H)
    (found,) = pdipc.check_scene(made)
    assert 'obstacle "bar": turns by up to 37.7 rad in a step' in str(found)
    assert f"at most {MOST}: take a shorter time_step or more substeps, or a larger minimum separation" in str(found)
    made.simulation.substeps = 6
    assert pdipc.check_scene(made) == []


def test_certificates_hold_along_the_chords(tmp_path):
    """The judge replays every chord of a run, among them those on which the bar carries the cloth."""
    pytest.importorskip("ipctk")
    sheet = cloth("sheet", (0.06, 0.1), (1, 1), at=(0.15, 0.05, 0.0))
    made = scene([sheet], [bar(0.2)], contact=CONTACT, gravity=[0, 0, 0], time_step=H, steps=2)
    pdipc.run_scene(made, tmp_path / "run", certify=True)
    run = pdipc.open_run(tmp_path / "run")
    certificate = certify(run)
    assert certificate.hits == []
    assert certificate.segments >= sum(record["chords"] for record in run.stats) > 8
    assert certificate.smallest_gap > 0.0


def test_chords_and_commands_give_the_same_bits_for_any_number_of_threads():
    ends = []
    for threads in (1, 3):
        sheet = cloth("sheet", (0.06, 0.1), (3, 3), at=(0.15, 0.05, 0.0))
        made = scene([sheet], [bar(0.1), {**bar(0.0), "name": "tool", "translation": [0.0, 0.3, 0.0]}], contact=CONTACT)
        simulation = pdipc.Simulation(pdipc.build(made, Device("cpu", threads=threads)))
        simulation.set_pose("tool", position=(0.0, 0.2, 0.0), rotation=(0.0, 0.0, 40.0))
        for _ in range(2):
            simulation.step()
        ends.append(simulation.checkpoint())
    assert all(np.array_equal(ends[0][name], ends[1][name]) for name in ends[0])
