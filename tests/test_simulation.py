"""Runs into folders: stopped at any moment they go on to the same bits, and only as what they were."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pdipc
from pdipc import simulation as simulations
from pdipc.drive import StepResult, Work
from pdipc.output import results
from pdipc.output.results import RunError, open_run
from tests.physics.scenes import cloth, floor, scene, solid

REPOSITORY = Path(__file__).parents[1]


def small(substeps=3, steps=6, **more):
    sheet = cloth("sheet", [0.3, 0.3], [4, 4], at=(0, 0.11, 0), rotation=(0, 9, 0), friction=0.3)
    block = solid("block", (0.1, 0.1, 0.1), (2, 2, 2), at=(0, 0.051, 0), velocity=[0, -1, 0])
    made = scene([block, sheet], [floor()], **more)
    made.simulation.substeps, made.simulation.steps = substeps, steps
    return made


def contents(folder) -> dict:
    """Everything but how long steps took, and run.vtkhdf, whose bytes may lie elsewhere; of the checkpoints the last."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if name == "stats.jsonl":
            records = [json.loads(line) for line in path.read_text().splitlines()]
            found[name] = [{key: value for key, value in record.items() if key != "milliseconds"} for record in records]
        elif path.is_file() and name not in ("run.lock", "run.vtkhdf") and path.parent.name != "checkpoints":
            found[name] = path.read_bytes()
    last = max((folder / "checkpoints").iterdir())
    return {**found, last.name: last.read_bytes()}


@pytest.mark.parametrize(
    "place", ["in a sub-step", "between sub-steps", "before a frame", "in a frame", "in a checkpoint", "after a step"]
)
def test_a_run_interrupted_anywhere_goes_on_to_the_same_bits(place, tmp_path, monkeypatch):
    pdipc.run_scene(small(), tmp_path / "whole", certify=True)
    calls = 0

    def interrupted(function, at):
        def called(*args, **options):
            nonlocal calls
            calls += 1
            if calls == at and place == "before a frame":
                raise KeyboardInterrupt
            result = function(*args, **options)
            if calls == at:
                raise KeyboardInterrupt
            return result

        return called

    with monkeypatch.context() as patched:
        if place == "in a sub-step":
            patched.setattr(Work, "run", interrupted(Work.run, 35))
        elif place == "between sub-steps":
            patched.setattr(simulations, "stepping", interrupted(simulations.stepping, 8))
        elif place == "before a frame":
            patched.setattr(results.RunWriter, "append", interrupted(results.RunWriter.append, 4))
        elif place == "in a frame":
            patched.setattr(results, "_line", interrupted(results._line, 4))
        elif place == "in a checkpoint":
            patched.setattr(simulations, "CHECKPOINT_SECONDS", 0.0)
            patched.setattr(results, "_write_arrays", interrupted(results._write_arrays, 40))
        progress = interrupted(lambda info: None, 3) if place == "after a step" else None
        with pytest.raises(KeyboardInterrupt):
            pdipc.run_scene(small(), tmp_path / "cut", certify=True, progress=progress)
    assert calls > 0
    assert open_run(tmp_path / "cut").frame_count < 7
    pdipc.run_scene(small(), tmp_path / "cut", certify=True, resume=True)
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")
    times = open_run(tmp_path / "cut").times
    np.testing.assert_allclose(times, 0.01 * np.arange(7), rtol=1e-12)


def test_an_interrupt_after_a_step_loses_nothing(tmp_path):
    def stop(info):
        if info.step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pdipc.run_scene(small(), tmp_path / "run", progress=stop)
    assert (tmp_path / "run/checkpoints/000002.npz").exists()
    resumed = []
    pdipc.run_scene(small(), tmp_path / "run", resume=True, progress=lambda info: resumed.append(info.step))
    assert resumed == [3, 4, 5, 6]


@pytest.mark.parametrize("lost", ["all of it", "its last row"])
def test_checkpoints_that_are_no_state_of_the_scene_are_named(lost, tmp_path):
    pdipc.run_scene(small(steps=1), tmp_path / "run")
    for path in (tmp_path / "run/checkpoints").glob("*.npz"):
        with np.load(path) as found:
            arrays = {} if lost == "all of it" else {name: array[:-1] if array.ndim else array for name, array in found.items()}
        np.savez(path, **arrays)
    with pytest.raises(RunError, match=r"000001\.npz holds no state of this scene: .*; delete it, or start again"):
        pdipc.run_scene(small(steps=1), tmp_path / "run", resume=True)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_kills_at_random_moments(tmp_path):
    """A few of what benchmarks/kills.py does by the hundred."""
    command = [sys.executable, str(REPOSITORY / "benchmarks/kills.py"), "--count", "1", "--folder", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_only_the_same_scene_goes_on(tmp_path):
    pdipc.run_scene(small(), tmp_path / "run", steps=2)
    before = contents(tmp_path / "run")
    with pytest.raises(RunError, match=r"another scene \(simulation\.substeps differs\)"):
        pdipc.run_scene(small(substeps=2), tmp_path / "run", resume=True)
    heavier = small()
    heavier.bodies[1].material.areal_density = 0.3
    with pytest.raises(RunError, match=r"another scene \(bodies\[1\]\.material\.areal_density differs\)"):
        pdipc.run_scene(heavier, tmp_path / "run", resume=True)
    meta = json.loads((tmp_path / "run/run.json").read_text())
    (tmp_path / "run/run.json").write_text(json.dumps({**meta, "precision": "float32"}))
    with pytest.raises(RunError, match="was run on float32; going on with precision float64 would not give the same results"):
        pdipc.run_scene(small(), tmp_path / "run", resume=True)
    (tmp_path / "run/run.json").write_text(json.dumps({**meta, "device": "cuda:9"}))
    with pytest.raises((RunError, ValueError), match="cuda:9"):
        pdipc.run_scene(small(), tmp_path / "run", resume=True)
    (tmp_path / "run/run.json").write_text(json.dumps(meta, indent=2) + "\n")
    assert contents(tmp_path / "run") == before
    pdipc.run_scene(small(steps=9), tmp_path / "run", steps=4, resume=True)  # the number of steps may be another
    assert open_run(tmp_path / "run").frame_count == 5


def test_sub_steps_are_merged_by_what_their_fields_are():
    """Counts and times add up, lengths are the worst, verdicts hold for all: whatever fields a step has."""
    fields = {field.name for field in dataclasses.fields(StepResult)}
    plain = {"state": None, "message": "", "milliseconds": {"ccd": 1.0}, "converged": True}
    low = {**{name: 1 for name in fields}, **plain, "residual": 1e-3, "smallest_gap": float("inf")}
    high = {**{name: 2 for name in fields}, **plain, "residual": 2e-3, "smallest_gap": 1e-4}
    high |= {"message": "capped", "converged": False}
    for order in ((low, high), (high, low)):
        merged = simulations._merge([StepResult(**each) for each in order])
        assert (merged.residual, merged.smallest_gap, merged.converged, merged.message) == (2e-3, 1e-4, False, "capped")
        assert (merged.constraints, merged.barriers) == (2, 2)
        assert merged.milliseconds == {"ccd": 2.0}
        counts = fields - {"constraints", "barriers", "residual", "smallest_gap", *plain}
        assert all(getattr(merged, name) == 3 for name in counts)
    record = simulations.stats_of(StepResult(**low))
    assert record.keys() == fields - {"state", "forces"}
    assert record["smallest_gap"] is None


def test_what_a_model_was_made_from_refuses_changes_and_the_scene_takes_them():
    scene = small()
    simulation = pdipc.Simulation(scene, device="cpu")
    made = simulation.model.scene
    assert made == scene and made.model_dump_json() == scene.model_dump_json()
    for table, name in ((made.contact, "friction"), (made.simulation, "time_step"), (made.bodies[0].material, "density")):
        with pytest.raises(pdipc.SceneError, match=f"{name} was read when the model was made"):
            setattr(table, name, 0.5)
    with pytest.raises(dataclasses.FrozenInstanceError):
        simulation.model.settings.tolerance = 1.0  # pyright: ignore[reportAttributeAccessIssue]
    scene.contact.friction = 0.5
    assert pdipc.Simulation(scene, device="cpu").model.scene.contact.friction == 0.5
    again = made.model_copy(deep=True)
    again.contact.friction = 0.5
    assert again == scene
