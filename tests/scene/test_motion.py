"""Scripted motions against what they say."""

import numpy as np
import pytest

from pdipc.scene.motion import Trajectory, rotation_matrix
from pdipc.scene.schema import Keyframe, Motion

POINT = np.array([[1.0, 0, 0]])


def test_constant_velocity_and_spin_in_a_window():
    motion = Motion(velocity=(0, 0, 3), angular_velocity=(0, 0, np.pi / 2), start=1, end=2)
    path = Trajectory(motion, np.zeros(3))
    assert path.apply(POINT, 0.5) == pytest.approx(POINT)
    assert path.apply(POINT, 1.5) == pytest.approx(np.array([[0.5**0.5, 0.5**0.5, 1.5]]))
    assert path.apply(POINT, 9.0) == pytest.approx(np.array([[0, 1, 3]]), abs=1e-12)


def test_what_does_not_turn_keeps_its_bits_but_for_its_way():
    points, center = np.random.default_rng(5).uniform(-1, 1, (200, 3)), np.array([0.3, -0.7, 0.1])
    still = Trajectory(None, center)
    assert still.is_static and np.array_equal(still.apply(points, 0.37), points)
    sliding = Trajectory(Motion(velocity=(0.25, 0, 0), end=2.0), center)
    assert np.array_equal(sliding.apply(points, 5.0), points + np.array([0.5, 0, 0]))


def test_spin_goes_beyond_a_full_turn_about_a_given_center():
    path = Trajectory(Motion(angular_velocity=(0, 4 * np.pi, 0), center=(2, 0, 0)), np.zeros(3))
    assert path.apply(POINT, 1.0) == pytest.approx(POINT)
    assert path.apply(POINT, 1.25) == pytest.approx(np.array([[3, 0, 0]]))


def test_keyframes_are_met_and_joined_by_straight_lines_and_even_turns():
    up_and_turned = Keyframe(time=3, translation=(0, 4, 0), rotation=(0, 0, 90))
    motion = Motion(keyframes=[Keyframe(time=1), up_and_turned, Keyframe(time=4, rotation=(0, 0, 90))])
    path = Trajectory(motion, np.zeros(3))
    assert path.apply(POINT, 0.0) == pytest.approx(POINT)
    assert path.apply(POINT, 2.0) == pytest.approx(np.array([[0.5**0.5, 2 + 0.5**0.5, 0]]))
    assert path.apply(POINT, 3.0) == pytest.approx(np.array([[0, 5, 0]]))
    assert path.apply(POINT, 3.5) == pytest.approx(np.array([[0, 3, 0]]))
    assert path.apply(POINT, 99.0) == pytest.approx(np.array([[0, 1, 0]]))


@pytest.mark.parametrize("degrees", [90.0, 270.0, 720.0, -540.0])
def test_turns_between_keyframes_are_as_many_as_are_given(degrees):
    motion = Motion(keyframes=[Keyframe(time=0), Keyframe(time=2, rotation=(0, degrees, 0))])
    path = Trajectory(motion, np.zeros(3))
    for part in (0.1, 0.25, 0.5, 0.9):
        angle = np.radians(part * degrees)
        assert path.apply(POINT, 2 * part) == pytest.approx(np.array([[np.cos(angle), 0, -np.sin(angle)]]))


def test_turns_may_be_the_shortest():
    turned = Keyframe(time=1, rotation=(0, 270, 0))
    path = Trajectory(Motion(keyframes=[Keyframe(time=0), turned], turns="shortest"), np.zeros(3))
    assert path.apply(POINT, 0.5) == pytest.approx(np.array([[0.5**0.5, 0, 0.5**0.5]])), "by 90 degrees the other way"
    # evenly about one axis: half of the way is half of the angle, whatever the axis
    end = Keyframe(time=1, rotation=(50, -70, 100))
    path = Trajectory(Motion(keyframes=[Keyframe(time=0), end], turns="shortest"), np.zeros(3))
    half, whole = path.pose(0.5)[0], path.pose(1.0)[0]
    assert half @ half == pytest.approx(whole)


def test_a_single_keyframe_is_a_pose():
    path = Trajectory(Motion(keyframes=[Keyframe(time=5, translation=(1, 2, 3))]), np.zeros(3))
    assert path.apply(POINT, 0.0) == pytest.approx(np.array([[2, 2, 3]]))


def test_smooth_motion_starts_and_ends_at_rest():
    path = Trajectory(Motion(keyframes=[Keyframe(time=0), Keyframe(time=2, translation=(1, 0, 0))], smooth=True), np.zeros(3))
    x = [path.pose(t)[1][0] for t in (0, 1e-4, 1, 2 - 1e-4, 2)]
    assert x == pytest.approx([0, 0.75e-8, 0.5, 1 - 0.75e-8, 1], abs=1e-11)


@pytest.mark.parametrize("time", [0.0, 0.7, 12.3])
def test_poses_are_rigid(time):
    motion = Motion(velocity=(1, 2, 3), angular_velocity=(0.3, -2, 5))
    rotation, _ = Trajectory(motion, np.ones(3)).pose(time)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_rotations_turn_about_x_then_y_then_z():
    assert rotation_matrix((90, 90, 0)) @ [0, 1, 0] == pytest.approx([1, 0, 0])  # y -> z about x, z -> x about y


def test_is_static_knows():
    still = [None, Motion(), Motion(keyframes=[Keyframe(time=0), Keyframe(time=1)])]
    turned = Motion(keyframes=[Keyframe(time=1, rotation=(1, 0, 0))])
    moving = [Motion(velocity=(0, 0, 1)), Motion(angular_velocity=(1, 0, 0)), turned]
    assert [Trajectory(motion, np.zeros(3)).is_static for motion in still + moving] == [True] * 3 + [False] * 3
