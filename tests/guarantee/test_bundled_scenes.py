"""Every bundled scene, its first steps: no intersection at any outer iteration, and a number that mechanics gives."""

import numpy as np
import pytest
from physics.scenes import Witness

import pdipc
from pdipc.audit import audit
from pdipc.reproduce.table1 import ROWS
from pdipc.scene.load import bundled_scenes

STEPS = 8
PASSIVE = {"cloth_on_sphere", "box_stack", "thin_rod", "tori_in_bowl", "bear_on_stairs"}  # nothing scripted does work on these
OTHERS = {row.bundled for row in ROWS.values()}  # those of Table 1 have tests of their own: test_paper_scenes
NEEDS_USD = {"bear_on_stairs"}
ALLOWED_GAIN = 0.002  # of the energy that gravity and motion bring in; implicit Euler itself only loses


@pytest.mark.parametrize("name", sorted(bundled_scenes().keys() - OTHERS))
def test_first_steps(name):
    if name in NEEDS_USD:
        pytest.importorskip("pxr", reason="needs usd-core (extra: usd)")
    scene = pdipc.load_scene(name)
    scene.simulation.max_outer = 12
    simulation = pdipc.Simulation(scene, device="cpu")
    simulation.observe = Witness(simulation)
    model = simulation.model
    before = audit(model, simulation.state, simulation.work)
    start = simulation.positions.copy()
    for _ in range(STEPS):
        simulation.step()
    after = audit(model, simulation.state, simulation.work)
    assert simulation.observe.checked >= STEPS
    if name in PASSIVE:
        scale = abs(before.kinetic) + abs(after.kinetic) + abs(after.gravity - before.gravity)
        assert after.total <= before.total + ALLOWED_GAIN * scale
    held = model.assembly.kinematic_vertices
    lag = np.abs(simulation.positions[held] - model.assembly.kinematic_positions(simulation.state.time)).max()
    assert lag < 0.05 * model.assembly.scene_size  # what is scripted is where the script says, or catching up
    assert np.abs(simulation.positions - start).max() > 0.0
