"""The viewer without a browser: what it sends to one, and what dragging does."""

import types

import numpy as np
import pytest

import pdipc
from pdipc.output.results import open_run
from tests.output import runs

pytest.importorskip("viser", reason="needs viser (extra: viewer)")

from pdipc import viewer

TALL = 0.3  # m: where bodies start above the floor


def scene(**body) -> pdipc.Scene:
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 4.0}}
    return pdipc.Scene(bodies=[{"name": "body", "translation": [0.0, TALL, 0.0], **body}], obstacles=[floor])


SOLID = {"kind": "solid", "mesh": {"shape": "box", "size": [0.2, 0.2, 0.2], "cells": [2, 2, 2]}}
CLOTH = {"kind": "cloth", "mesh": {"shape": "grid", "size": [0.5, 0.5], "cells": [6, 6]}}


@pytest.fixture
def live(request):
    shown = viewer.Live(scene(**request.param), port=8700)
    yield shown
    shown.close()


@pytest.mark.parametrize("host", ["999.1.1.1", "192.0.2.1"])
def test_a_host_that_is_not_this_machine_is_refused(host):
    with pytest.raises(OSError, match=f'host "{host}" is no address of this machine'):
        viewer.Live(scene(**CLOTH), host=host, port=8700)


@pytest.mark.parametrize("live", [CLOTH], indirect=True)
def test_vertices_are_updated_in_place_and_buttons_obeyed(live):
    meshes, first = list(live.view.meshes), live.simulation.positions
    live.advance()
    moved = live.simulation.positions
    assert moved[0, 1] < first[0, 1]
    assert all(mesh is now for mesh, now in zip(meshes, live.view.meshes, strict=True))
    np.testing.assert_array_equal(meshes[0].vertices, moved[live.view.skins[0].sources].astype(np.float32))
    assert "time 0.010 s" in live.report.content

    live.running.value = False
    live.advance()
    np.testing.assert_array_equal(live.simulation.positions, moved)
    live.engine.ask(live.step)
    live.advance()
    assert live.simulation.steps_done == 2
    live.engine.ask(live.reset)
    live.advance()
    assert "time 0.000 s" in live.report.content
    np.testing.assert_array_equal(meshes[0].vertices, first[live.view.skins[0].sources].astype(np.float32))


@pytest.mark.parametrize("live", [SOLID, CLOTH], indirect=True)
def test_what_is_dragged_follows_the_mouse_until_it_is_let_go(live):
    corner = live.simulation.positions[0]
    goal = corner + np.array([0.1, 0.3, 0.0])
    live.drag(0, "start", corner, corner)
    live.drag(0, "update", corner, goal)
    for _ in range(50):
        live.advance()
        assert len(pdipc.find_intersections(live.simulation.positions, live.simulation.triangles)) == 0
    assert live.held.vertex == 0
    assert np.linalg.norm(live.simulation.positions[0] - goal) < 0.2 * np.linalg.norm(corner - goal)
    live.drag(0, "end", corner, goal)
    mass = live.simulation.model.mass.numpy()

    def upward() -> float:
        return np.average(live.simulation.state.velocities.numpy()[:, 1], weights=mass)

    live.advance()
    before = upward()
    for _ in range(10):
        live.advance()
    assert upward() - before == pytest.approx(-9.81 * 0.1, rel=0.1)  # nothing but gravity is left


@pytest.mark.parametrize("live", [{**CLOTH, "pins": [{"select": {"all": True}}]}], indirect=True)
def test_what_is_held_by_pins_cannot_be_dragged(live):
    start = live.simulation.positions
    live.drag(0, "start", start[0], start[0])
    live.drag(0, "update", start[0], start[0] + 1.0)
    live.advance()
    np.testing.assert_allclose(live.simulation.positions, start, rtol=0, atol=1e-12)


@pytest.mark.parametrize("live", [CLOTH], indirect=True)
def test_an_error_in_a_step_ends_the_loop_and_is_shown(live, monkeypatch):
    def fail(forces=False):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(live.simulation, "step", fail)
    with pytest.raises(RuntimeError, match="out of memory"):
        live.loop()
    assert "out of memory" in live.report.content


def test_playback_follows_the_clock_and_the_slider(tmp_path):
    runs.write(tmp_path / "run", steps=4)
    run = open_run(tmp_path / "run")
    shown = viewer.Playback(run, port=8700)

    def on_page() -> np.ndarray:
        return shown.view.meshes[1].vertices

    def cloth(frame: int) -> np.ndarray:
        return run.positions(frame)[shown.view.skins[1].sources].astype(np.float32)

    try:
        shown.advance(0.0)
        np.testing.assert_array_equal(on_page(), cloth(0))
        shown.advance(0.021)
        assert shown.frame.value == 2
        np.testing.assert_array_equal(on_page(), cloth(2))
        assert "time 0.020 s" in shown.report.content and "smallest gap 1 mm" in shown.report.content
        shown.playing.value = False
        shown.frame.value = 4
        shown.advance(1.0)
        np.testing.assert_array_equal(on_page(), cloth(4))
        shown.playing.value = True
        shown.advance(0.011)  # beyond the end: from the start
        assert shown.frame.value == 0
    finally:
        shown.close()


def test_the_command_serves_until_ctrl_c(monkeypatch, capsys):
    stopped = []

    def interrupted():
        raise KeyboardInterrupt

    view = types.SimpleNamespace(url="http://localhost:1")
    viewer._serve(types.SimpleNamespace(view=view, loop=interrupted, close=lambda: stopped.append(True)))
    assert stopped == [True]
    assert "http://localhost:1" in capsys.readouterr().out
