"""Run folders: what is written is read back, and a kill at any moment loses nothing before the last checkpoint."""

import json

import numpy as np
import pytest

from pdipc.output.results import RunError, RunWriter, open_run
from tests.output import runs


def contents(folder) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_round_trip(tmp_path):
    last = runs.write(tmp_path / "run", steps=5)
    run = open_run(tmp_path / "run")
    start, topology = runs.parts()
    assert run.frame_count == 6
    assert len(run.stats) == 5
    assert [record["outer"] for record in run.stats] == [2, 3, 1, 2, 3]
    np.testing.assert_array_equal(run.times, np.arange(6) * 0.01)
    assert run.positions(0).dtype == np.float64
    np.testing.assert_array_equal(run.positions(0), start.astype(np.float32))
    np.testing.assert_array_equal(run.positions(5), last)
    np.testing.assert_array_equal(run.positions(-1), last)
    np.testing.assert_array_equal(run.triangles, topology["triangles"])
    np.testing.assert_array_equal(run.tets, topology["tets"])
    assert run.body_names == ["ball", "cloth", "floor"]
    assert run.scene == runs.scene()
    assert run.meta["device"] == "cpu"
    assert run.meta["pdipc"]
    with pytest.raises(IndexError, match="6 frames"):
        run.positions(6)


def test_float64_positions_keep_their_bits(tmp_path):
    writer, state = runs.begin(tmp_path / "run")
    positions = state / 3.0 + np.pi * np.ones(3)
    writer.append(1, 0.01, positions.astype(np.float64), {})
    np.testing.assert_array_equal(open_run(tmp_path / "run").positions(1), positions.astype(np.float64))


def test_checkpoints_are_bit_exact_and_two_are_kept(tmp_path):
    writer, _ = runs.begin(tmp_path / "run")
    arrays = {"positions": np.array([[np.nextafter(1.0, 2.0), -0.0, 1e-310]]), "time": np.float64(0.1) * 3, "step": np.int64(3)}
    for step in (1, 2, 3):
        writer.append(step, 0.1 * step, arrays["positions"], {})
        writer.checkpoint(step, arrays)
    assert [path.name for path in sorted((tmp_path / "run/checkpoints").iterdir())] == ["000002.npz", "000003.npz"]
    step, read = writer.latest_checkpoint()
    assert step == 3
    for name, array in arrays.items():
        assert read[name].tobytes() == np.asarray(array).tobytes()


@pytest.mark.parametrize(
    "damage", ["clean", "temporary", "cut line", "cut checkpoint", "frame without line", "empty checkpoint"]
)
def test_resumed_and_uninterrupted_runs_give_the_same_files(tmp_path, damage):
    runs.write(tmp_path / "whole", steps=8)
    folder = tmp_path / "killed"
    writer, state = runs.begin(folder)
    state = runs.advance(writer, state, range(1, 6))  # checkpoints at 2 and 4, frames up to 5
    newest = folder / "checkpoints/000004.npz"
    if damage == "temporary":
        (folder / "frames/000006.npy.tmp").write_bytes(b"\x93NUMPY")
        (folder / "checkpoints/000006.npz.tmp").write_bytes(b"PK")
        (folder / "stats.jsonl.tmp").write_bytes(b"{")
        (folder / "run.vtkhdf.tmp").write_bytes(b"\x89HDF")
    elif damage == "cut line":
        with open(folder / "stats.jsonl", "a") as file:
            file.write('{"step": 6, "ti')
    elif damage == "cut checkpoint":
        newest.write_bytes(newest.read_bytes()[:-200])
    elif damage == "empty checkpoint":
        newest.write_bytes(b"")
    elif damage == "frame without line":
        np.save(folder / "frames/000006.npy", runs.move(state))
        writer.append_segments(6, 0, state, runs.move(state))
    assert open_run(folder).frame_count == 6

    writer = RunWriter.resume(folder)
    step, arrays = writer.latest_checkpoint()
    assert step == (2 if "checkpoint" in damage else 4)
    runs.advance(writer, arrays["positions"], range(step + 1, 9))
    resumed, whole = contents(folder), contents(tmp_path / "whole")
    assert resumed.keys() == whole.keys()
    del resumed["run.vtkhdf"], whole["run.vtkhdf"]  # the same steps, in other places of the file: see test_vtkhdf.py
    assert resumed == whole


def test_flipped_bits_in_a_checkpoint_are_noticed(tmp_path):
    runs.write(tmp_path / "run", steps=4)
    newest = tmp_path / "run/checkpoints/000004.npz"
    data = bytearray(newest.read_bytes())
    data[len(data) // 3] ^= 1
    newest.write_bytes(data)
    assert RunWriter.resume(tmp_path / "run").latest_checkpoint()[0] == 2


def test_a_folder_is_never_overwritten_by_accident(tmp_path):
    runs.write(tmp_path / "run", steps=2)
    before = contents(tmp_path / "run")
    with pytest.raises(RunError, match="--resume"):
        runs.begin(tmp_path / "run")
    assert contents(tmp_path / "run") == before
    runs.begin(tmp_path / "run", overwrite=True)
    assert open_run(tmp_path / "run").frame_count == 1
    assert not (tmp_path / "run/segments").exists()

    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match=r"thesis\.tex"):
        runs.begin(tmp_path / "other", overwrite=True)
    assert (tmp_path / "other/thesis.tex").read_text() == "years of work"


def test_errors_say_what_is_wrong(tmp_path):
    with pytest.raises(RunError, match="does not exist"):
        open_run(tmp_path / "nowhere")
    with pytest.raises(RunError, match=r"no run\.json"):
        open_run(tmp_path)
    runs.write(tmp_path / "run", steps=2)
    for path in (tmp_path / "run/checkpoints").iterdir():
        path.write_bytes(b"")
    with pytest.raises(RunError, match="no valid checkpoint"):
        RunWriter.resume(tmp_path / "run")
    stats = tmp_path / "run/stats.jsonl"
    stats.write_text("nonsense\n" + stats.read_text())
    with pytest.raises(RunError, match=r"stats\.jsonl, line 1"):
        open_run(tmp_path / "run")
    (tmp_path / "run/run.json").write_text(json.dumps({"format": 99}))
    with pytest.raises(RunError, match="format 99"):
        open_run(tmp_path / "run")


def test_statistics_are_plain_json(tmp_path):
    writer, state = runs.begin(tmp_path / "run")
    writer.append(1, 0.01, state, {"residual": np.float32(np.inf), "outer": np.int32(4), "parts": {"ccd": np.float64(0.5)}})
    record = open_run(tmp_path / "run").stats[0]
    assert record["residual"] is None
    assert (record["outer"], record["parts"]) == (4, {"ccd": 0.5})


def test_segments_of_frames_that_count(tmp_path):
    last = runs.write(tmp_path / "run", steps=3)
    found = list(open_run(tmp_path / "run").segments())
    assert [(step, outer) for step, outer, _, _ in found] == [(1, 0), (2, 0), (3, 0)]
    np.testing.assert_array_equal(found[-1][3], last)
    np.testing.assert_array_equal(found[1][2], found[0][3])
