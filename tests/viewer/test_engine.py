"""A live scene's thread and its page: neither changes what is simulated, and what the page asks for is done."""

import time

import numpy as np
import pytest

import pdipc
from pdipc.output.results import open_run
from tests.viewer.test_viewer import CLOTH, scene

pytest.importorskip("viser", reason="needs viser (extra: viewer)")

from pdipc import viewer
from pdipc.pictures.creases import split
from pdipc.scene import generators
from pdipc.viewer.engine import Engine
from pdipc.viewer.stage import BESIDE, compass

LOW = {**CLOTH, "translation": [0.0, 0.02, 0.0]}  # above the floor, which it touches within a few steps


def wait(happened, seconds: float = 60.0) -> None:
    """Until happened() is true; fails where it never is."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def test_energies_and_pressures_change_no_bit():
    plain = pdipc.Simulation(scene(**LOW))
    engine = Engine(scene(**LOW))
    engine.wants_pressure = True
    for _ in range(10):
        plain.step()
        engine.step()
    np.testing.assert_array_equal(plain.positions, engine.newest.positions.astype(np.float64))
    assert engine.newest.pressure.max() > 0.0
    kinetic, elastic, contact, gravity = engine.newest.energies
    assert kinetic > 0.0 and elastic >= 0.0 and contact > 0.0
    mass = plain.model.mass.numpy()
    assert gravity == pytest.approx(9.81 * mass[:49] @ plain.positions[:49, 1], rel=1e-4)
    engine.close()


def test_steps_are_taken_in_another_thread_while_the_page_answers(monkeypatch):
    engine = Engine(scene(**CLOTH))
    whole, began = engine.simulation.step, []

    def slow(forces=False):
        began.append(time.monotonic())
        time.sleep(0.5)
        return whole(forces=forces)

    monkeypatch.setattr(engine.simulation, "step", slow)
    engine.speed = 1e3
    engine.start()
    wait(lambda: began)
    asked = time.monotonic()
    assert engine.newest.step == 0  # answered while the step goes on
    assert len(engine.frames) == 1
    assert time.monotonic() - asked < 0.4
    engine.running = False
    wait(lambda: engine.newest.step >= 1)
    engine.close()
    assert engine.error is None


@pytest.fixture
def file(tmp_path):
    scene(**CLOTH).save(tmp_path / "cloth.toml")
    return tmp_path / "cloth.toml"


def test_a_scene_that_is_saved_again_is_started_again(file):
    live = viewer.Live(pdipc.load_scene(file), port=8710, watched=file)
    try:
        live.advance()
        text = file.read_text()
        file.write_text(text.replace("[6, 6]", "[4, 4]"))
        live._looked = 0.0
        live.refresh()
        live.running.value = False
        live.advance()
        assert live.simulation.steps_done == 0
        assert live.view.meshes[0].vertices.shape == (25, 3)
        file.write_text(text.replace("[6, 6]", "[4, -4]"))  # a mistake: the scene goes on as it was
        live._looked = 0.0
        live.refresh()
        live.advance()
        assert "cells" in live.state.content
        live.step()
        assert live.simulation.steps_done == 1
    finally:
        live.close()


def test_gravity_is_changed_on_the_way():
    live = viewer.Live(scene(**CLOTH), port=8710)
    try:
        live.advance()
        velocity = live.simulation.state.velocities.numpy()[:49, 1].mean()
        live.gravity.value = 3.0
        live.apply()
        assert live.simulation.steps_done == 1
        live.advance()
        assert live.simulation.state.velocities.numpy()[:49, 1].mean() - velocity == pytest.approx(-3.0 * 0.01, rel=1e-3)
    finally:
        live.close()


def test_a_recording_has_all_frames_since_the_start(tmp_path):
    live = viewer.Live(scene(**CLOTH), port=8710)
    try:
        for _ in range(3):
            live.advance()
        live.folder.value = str(tmp_path / "run")
        live.recording.value = True
        live._record()
        live.advance()
        live.recording.value = False
        live._record()
        assert "recorded into" in live.recorded.content
        run = open_run(tmp_path / "run")
        assert run.frame_count == 5
        np.testing.assert_array_equal(run.positions(-1), live.simulation.positions)
        np.testing.assert_array_equal(run.positions(0), pdipc.Simulation(scene(**CLOTH)).positions)
        assert run.stats[-1]["converged"] is True
        live.recording.value = True  # the folder is taken now
        live._record()
        assert "not recorded" in live.recorded.content and live.recording.value is False
    finally:
        live.close()


def test_the_time_line_shows_what_was():
    live = viewer.Live(scene(**CLOTH), port=8710)
    try:
        for _ in range(3):
            live.advance()
        assert live.frame.value == 3
        live.playing.value, live.frame.value = "frame", 1
        live.refresh()
        assert "time 0.010 s" in live.report.content
        live.view.meshes[0].visible = False
        live.playing.value = "newest"
        live.refresh()
        assert "time 0.030 s" in live.report.content
    finally:
        live.close()


def test_pressed_triangles_are_shown_in_colors():
    live = viewer.Live(scene(**LOW), port=8710)
    try:
        live.color.value = "pressure"
        live.engine.wants_pressure = True
        for _ in range(10):
            live.advance()
        colored = sum(len(level.faces) for level in live.view.levels if level.visible)
        left = len(live.view.meshes[0].faces)
        assert colored > 0
        assert colored + left in (72, 73)  # each triangle of the cloth once; a mesh cannot be empty
        live.color.value = "body"
        live._shown = None
        live.refresh()
        assert not any(level.visible for level in live.view.levels)
        assert len(live.view.meshes[0].faces) == 72
    finally:
        live.close()


def test_the_compass_points_up_along_y():
    drawn = compass(np.array([1.0, 0.0, 0.0, 0.0]))  # a camera that looks along z with y down
    assert '<line x1="36" y1="36" x2="36.0" y2="60.0" stroke="#3f9b4f"' in drawn
    drawn = compass(np.array([0.0, 1.0, 0.0, 0.0]))  # turned about x by half a turn: it looks along -z with y up
    assert '<line x1="36" y1="36" x2="36.0" y2="12.0" stroke="#3f9b4f"' in drawn
    assert set(BESIDE) == {"front", "side", "top", "corner"}


@pytest.mark.parametrize(("angle", "vertices"), [(40.0, 54), (100.0, 26), (0.0, 54)])
def test_flat_faces_are_drawn_flat(angle, vertices):
    """A cube of 2^3 cells has 26 vertices on its surface, and 9 on each of its faces."""
    mesh = generators.Box(size=(1.0, 1.0, 1.0), cells=(2, 2, 2)).mesh()
    used, triangles = np.unique(mesh.triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    doubled, drawn = split(mesh.vertices[used], triangles, angle)
    np.testing.assert_array_equal(doubled[drawn], triangles)
    assert len(doubled) == (vertices if angle > 0 else len(doubled))
    normals = np.cross(*(mesh.vertices[used][triangles[:, k]] - mesh.vertices[used][triangles[:, 0]] for k in (1, 2)))
    if vertices == 54:
        for vertex in range(len(doubled)):
            around = normals[(drawn == vertex).any(axis=1)]
            assert np.allclose(around / np.linalg.norm(around, axis=1)[:, None], around[0] / np.linalg.norm(around[0]))
