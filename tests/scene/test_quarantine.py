"""Bodies in quarantine ignore each other until they part, and then keep apart as all others do; every result says so."""

import numpy as np
import pytest
from physics.scenes import floor, scene, solid
from typer.testing import CliRunner

import pdipc
from pdipc.cli import app
from pdipc.scene.assembly import assemble
from pdipc.scene.errors import SceneWarning
from pdipc.scene.quarantine import Quarantine

SIDE, SPEED, H = 0.2, 1.0, 0.01


def parting(**more):
    """Two blocks that start in each other by 15 mm, part at 1 m/s, turn back by a pull, and meet; beside them a third, on the floor."""
    blocks = [
        solid("left", (SIDE,) * 3, (2,) * 3, at=(0, 1, 0)),
        solid("right", (SIDE,) * 3, (2,) * 3, at=(SIDE - 0.015, 1.01, 0.01), velocity=(SPEED, 0, 0)),
        solid("third", (SIDE,) * 3, (2,) * 3, at=(2, 0.12, 0)),
    ]
    back = {"kind": "vertices", "body": "right", "select": {"all": True}, "force": [-8 * 20.0, 0, 0]}
    contact = {"quarantine": [["right", "left"]], "activation_distance": 2e-3, **more}
    settings = {"simulation": {"time_step": H, "steps": 18, "gravity": [0, 0, 0], "precision": "float64"}, "contact": contact}
    return pdipc.Scene(bodies=blocks, obstacles=[floor()], forces=[back], **settings)


def test_a_pair_is_ignored_until_it_parts_and_then_keeps_apart():
    with pytest.warns(SceneWarning, match='"left" and "right" start in each other and ignore each other until they part'):
        simulation = pdipc.Simulation(parting(), "cpu")
    intersecting, ignored, barriers = [], [], []
    for _ in range(18):
        result = simulation.step()
        assert result.converged
        pairs = pdipc.find_intersections(simulation.positions, simulation.triangles, simulation.model.assembly.obstacle)
        intersecting.append(len(pairs) > 0)
        ignored.append(result.quarantined == (("left", "right"),))
        barriers.append(result.barriers)
        if not ignored[-1]:
            assert result.quarantined == () and not intersecting[-1]
    parted = ignored.index(False)
    assert 0 < parted < 8 and not any(ignored[parted:])
    assert intersecting[0] and not any(intersecting[parted - 1 :])
    # nothing pushed while they were in each other: the right one moved as the pull alone has it
    assert max(barriers[: parted - 1]) == 0
    # turned back, it meets the left one, which is pushed, and does not enter it
    assert max(barriers[parted:]) > 0
    left = simulation.state.velocities.numpy()[:27].mean(axis=0)
    assert left[0] < -0.1


@pytest.mark.filterwarnings("ignore::pdipc.scene.errors.SceneWarning")
def test_what_starts_apart_is_not_quarantined():
    made = parting(quarantine=[["left", "third"], ["left", "right"]])
    with pytest.warns(SceneWarning, match='"left" and "third" start apart: no quarantine'):
        simulation = pdipc.Simulation(made, "cpu")
    assert len(simulation.state.quarantined) == 1


def test_others_are_still_refused():
    made = parting(quarantine=[["left", "third"]])
    assert any('body "left" and body "right"' in str(finding) for finding in pdipc.check_scene(made))
    assert pdipc.check_scene(parting()) == []


@pytest.mark.parametrize(
    ("pair", "told"),
    [
        (["left", "nobody"], r'contact.quarantine\[0\]: there is no body "nobody"'),
        (["left", "left"], "cannot ignore itself"),
        (["floor", "floor"], "cannot ignore itself"),
    ],
)
def test_wrong_pairs_are_refused(pair, told):
    with pytest.raises(pdipc.SceneError, match=told):
        assemble(parting(quarantine=[pair]))


def test_parted_means_outside_and_further_than_the_separation():
    """Against what is known of two blocks: inside, cutting, touching, near, apart."""
    big = solid("big", (1.0,) * 3, (2,) * 3)
    small = solid("small", (0.2,) * 3, (2,) * 3)
    assembly = assemble(scene([big, small], contact={"quarantine": [["big", "small"]], "minimum_separation": 1e-3}))
    quarantine, own = Quarantine(assembly), slice(assembly.bodies[1].first, assembly.bodies[1].last)
    for at, expected in ((0.0, False), (0.5, False), (0.6, False), (0.6011, False), (0.6013, True), (2.0, True)):
        x = assembly.positions.copy()
        x[own, 0] += at
        assert quarantine.parted(x, 0, 1) is expected, at


@pytest.mark.filterwarnings("ignore::pdipc.scene.errors.SceneWarning")
def test_runs_say_so_and_go_on_after_a_stop(tmp_path):
    for name, stops in (("whole", (10,)), ("cut", (2, 7, 10))):
        for k, last in enumerate(stops):
            pdipc.run_scene(parting(), tmp_path / name, steps=last, device="cpu", certify=True, resume=k > 0)
    whole, cut = (pdipc.open_run(tmp_path / name) for name in ("whole", "cut"))
    assert all(np.array_equal(whole.positions(frame), cut.positions(frame)) for frame in range(11))
    assert [whole.quarantined(frame) for frame in (0, 1, 10)] == [[(0, 1)], [(0, 1)], []]
    told = CliRunner().invoke(app, ["check", str(tmp_path / "whole")])
    assert told.exit_code == 0, told.stdout
    assert "except of bodies in quarantine: in" in told.stdout and '("left" and "right")' in told.stdout
    pytest.importorskip("ipctk", reason="needs ipctk (extra: witness)")
    certificate = CliRunner().invoke(app, ["certify", str(tmp_path / "whole")])
    assert certificate.exit_code == 0, certificate.stdout
    assert "quarantined" in certificate.stdout and "not judged, not certified" in certificate.stdout


@pytest.mark.filterwarnings("ignore::pdipc.scene.errors.SceneWarning")
def test_what_has_parted_cannot_be_put_into_each_other_again():
    simulation = pdipc.Simulation(parting(), "cpu")
    start = simulation.positions[:27]
    while simulation.state.quarantined[0]:
        simulation.set_positions("left", start)  # as long as they ignore each other it may
        simulation.step()
    before = simulation.positions
    with pytest.raises(ValueError, match=r'"left" and body "right": .* intersect'):
        simulation.set_positions("left", start + np.array([0.3, 0, 0]))
    assert np.array_equal(simulation.positions, before)
