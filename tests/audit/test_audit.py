"""The audit of a run folder, as `pdipc audit` prints it, against mechanics."""

import re

import numpy as np
import pytest
from physics.scenes import floor, scene, solid
from typer.testing import CliRunner

import pdipc
from pdipc.audit import audit, barrier_forces, replay, vertex_forces
from pdipc.cli import app

G, H, MASS = 9.81, 0.01, 8.0


@pytest.fixture(scope="module")
def thrown(tmp_path_factory):
    """A block of 8 kg thrown through the air, turning."""
    body = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 1, 0), velocity=(1, 2, 0), angular_velocity=(0, 0, 2))
    folder = tmp_path_factory.mktemp("runs") / "thrown"
    pdipc.run_scene(scene([body], time_step=H, outer_tolerance=1e-7), folder, steps=6, device="cpu")
    return pdipc.open_run(folder)


def test_momenta_of_free_flight(thrown):
    found = [audit(*state) for state in replay(thrown)]
    k = np.arange(7)[:, None]
    momentum = MASS * (np.array([1.0, 2.0, 0.0]) + k * H * np.array([0.0, -G, 0.0]))
    np.testing.assert_allclose([each.linear_momentum for each in found], momentum, atol=1e-5)
    # only the weight has a torque about the origin, -m g x; implicit Euler takes it at the start of a step, where x = j h
    turning = np.array([each.angular_momentum[2] for each in found])
    expected = [-MASS * G * H * H * k * (k - 1) / 2 for k in range(7)]
    np.testing.assert_allclose(turning - turning[0], expected, atol=1e-3)
    assert np.abs(np.diff([each.total for each in found])).max() < 0.06 * found[0].kinetic
    assert all(np.abs(barrier_forces(*state)).max() == 0.0 for state in replay(thrown))


def test_frames_of_a_replay_can_be_chosen(thrown):
    times = [state.time for _, state, _ in replay(thrown, [3, -1])]
    assert times == [thrown.times[3], thrown.times[6]]


@pytest.fixture(scope="module")
def resting(tmp_path_factory):
    """Two blocks of 8 kg at rest on each other on a floor."""
    blocks = [solid(name, (0.2, 0.2, 0.2), (2, 2, 2), at=(0, y, 0)) for name, y in (("low", 0.1013), ("high", 0.3026))]
    made = scene(blocks, [floor()], contact={"activation_distance": 2e-3, "friction": 0.3}, damping=8.0, time_step=0.02)
    folder = tmp_path_factory.mktemp("runs") / "resting"
    pdipc.run_scene(made, folder, steps=80, device="cpu", forces=True)
    return pdipc.open_run(folder)


def test_bodies_at_rest_carry_what_lies_on_them(resting):
    forces = resting.forces(-1)
    upward = {name: forces.on(name).total[1] for name in resting.body_names}
    assert upward["high"] == pytest.approx(MASS * G, rel=0.01)
    assert upward["low"] == pytest.approx(MASS * G, rel=0.01)  # what the floor gives, less what the block above takes
    assert upward["floor"] == pytest.approx(-2 * MASS * G, rel=0.01)
    positions = resting.positions(-1)
    pressure = forces.pressures(positions, resting.triangles)
    assert pressure.min() == 0.0  # at the sides
    under = (positions[:, 1] < 5e-3) & (resting.topology["body_of_vertex"] == 0)
    # nine vertices share the face; each pressure is that of its own part of it
    assert 0.3 < np.median(pressure[under]) / (2 * MASS * G / 0.04) < 2.0


def test_forces_at_vertices_are_those_recorded_and_else_the_barriers(resting):
    ((normal, friction),) = vertex_forces(resting, [-1])
    ((model, state, work),) = replay(resting, [-1])
    np.testing.assert_allclose(normal, barrier_forces(model, state, work), atol=1e-9 * MASS * G)
    assert np.abs(friction.sum(axis=0)).max() < 1e-9 * MASS * G
    assert np.abs(friction).max() < 0.3 * np.abs(normal).max()
    start, unknown = next(vertex_forces(resting, [0]))
    assert start.shape == normal.shape and np.isnan(unknown).all()


def test_forces_of_the_papers_targets_are_not_made_up():
    """They belong to a step: of a state alone they are unknown, and are refused."""
    block = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 0.1013, 0))
    made = pdipc.Simulation(scene([block], [floor()], contact={"method": "paper"}), "cpu")
    made.step()
    with pytest.raises(ValueError, match="belong to a step, not to a state: run with --forces"):
        barrier_forces(made.model, made.state, made.work)


def test_command_prints_plots_and_writes_forces(resting, tmp_path):
    pytest.importorskip("matplotlib", reason="needs matplotlib (extra: pictures)")
    picture, numbers = tmp_path / "audit.png", tmp_path / "forces.npz"
    command = ["audit", str(resting.folder), "--every", "40", "-o", str(picture), "--forces", str(numbers)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.stderr
    assert re.search(r'on "floor" by "low": normal \(\S+ -15[67]\S* \S+\), friction \(.*\), torque \(.*\)', result.stdout)
    lines = [line.split() for line in result.stdout.splitlines()]
    rows = [list(map(float, line)) for line in lines if line[0] in ("0", "40", "80")]
    assert [row[0] for row in rows] == [0, 40, 80]
    for row in rows:
        assert row[5] == pytest.approx(sum(row[1:5]), rel=1e-3)
    assert rows[-1][4] == pytest.approx(2 * MASS * G * 0.2, rel=0.02)  # gravity: 16 kg, 0.2 m up
    assert picture.stat().st_size > 10_000
    with np.load(numbers) as arrays:
        assert arrays["normal"].shape == arrays["friction"].shape == (3, resting.positions(0).shape[0], 3)
        floor_share = arrays["normal"][-1][resting.topology["body_of_vertex"] == 2].sum(axis=0)
        assert floor_share[1] == pytest.approx(-2 * MASS * G, rel=0.01)


def test_a_run_prints_its_audit_if_asked(tmp_path):
    result = CliRunner().invoke(app, ["run", "box_stack", "--steps", "2", "--audit", "-o", str(tmp_path / "run")])
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    begin = next(k for k, line in enumerate(lines) if line.split()[:2] == ["step", "kinetic"])
    assert [line.split()[0] for line in lines[begin + 1 : begin + 4]] == ["0", "1", "2"]
    assert "forces of contact in step 2" in lines[begin + 4]


def test_pictures_of_pressure(resting, tmp_path):
    pytest.importorskip("pyvista", reason="needs pyvista (extra: pictures)")
    imageio = pytest.importorskip("imageio.v3", reason="needs imageio (extra: pictures)")
    by = {}
    for color in ("body", "pressure"):
        out = tmp_path / f"{color}.png"
        options = ["--color", color, "--size", "160x100", "--view", "1,0.2,0.3"]
        assert CliRunner().invoke(app, ["render", str(resting.folder), "-o", str(out), *options]).exit_code == 0
        by[color] = imageio.imread(out)[..., :3].astype(int)
    yellow = (by["pressure"][..., :2].min(axis=-1) - by["pressure"][..., 2]) > 60  # the loaded edges
    assert yellow.any()
    assert not np.array_equal(by["body"], by["pressure"])
