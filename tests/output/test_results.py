"""Run folders: what is written is read back, and a kill at any moment loses nothing before the last checkpoint."""

import errno
import json
import multiprocessing
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
import zipfile

import numpy as np
import pytest

from pdipc.output import lock, vtkhdf
from pdipc.output.results import RunError, RunWriter, open_run
from tests.output import runs

SPAWN = multiprocessing.get_context("spawn")


def contents(folder) -> dict[str, bytes]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "run.lock"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


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
    writer.close()
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
        np.savez(folder / "segments/000006_0000.npz", start=state, end=runs.move(state))
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


def test_a_run_killed_before_its_first_step_begins_again(tmp_path):
    writer, _ = runs.begin(tmp_path / "run")
    writer.close()
    (tmp_path / "run/checkpoints/000000.npz").unlink()
    with RunWriter.resume(tmp_path / "run") as writer:
        assert writer.latest_checkpoint() is None
        assert writer.frames == []
    assert list((tmp_path / "run/frames").iterdir()) == []


def test_a_folder_killed_while_it_was_made_is_taken(tmp_path):
    runs.write(tmp_path / "run", steps=1)
    (tmp_path / "run/run.json").unlink()  # it comes last
    runs.begin(tmp_path / "run")[0].close()
    assert open_run(tmp_path / "run").frame_count == 1


def test_a_scene_file_of_ones_own_is_not_replaced(tmp_path):
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(RunError, match=r"other files, such as \"scene\.json\""):
        runs.begin(tmp_path, overwrite=True)


# --- one writer ---


def hold(folder, held, done) -> None:
    """Writes a run until told to end."""
    writer, _ = runs.begin(folder)
    held.set()
    done.wait()
    writer.close()


@pytest.mark.parametrize("ends", ["closes", "is killed"])
def test_a_second_writer_is_refused_until_the_first_ends(tmp_path, ends):
    held, done = SPAWN.Event(), SPAWN.Event()
    first = SPAWN.Process(target=hold, args=(tmp_path / "run", held, done))
    first.start()
    try:
        assert held.wait(60.0)
        before = contents(tmp_path / "run")
        holder = f"being written by process {first.pid} on {socket.gethostname()}"
        with pytest.raises(RunError, match=holder):
            RunWriter.resume(tmp_path / "run")
        with pytest.raises(RunError, match=holder):
            runs.begin(tmp_path / "run", overwrite=True)
        assert contents(tmp_path / "run") == before
        assert open_run(tmp_path / "run").frame_count == 1  # reading needs no lock
        if ends == "closes":
            done.set()
        else:
            first.kill()
        first.join()
        RunWriter.resume(tmp_path / "run").close()
    finally:
        first.kill()
        first.join()


def test_a_second_writer_in_the_same_process_is_refused(tmp_path):
    writer, _ = runs.begin(tmp_path / "run")
    with pytest.raises(RunError, match=f"process {os.getpid()}"):
        RunWriter.resume(tmp_path / "run")
    writer.close()
    RunWriter.resume(tmp_path / "run").close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_child_does_not_keep_the_lock(tmp_path):
    writer, _ = runs.begin(tmp_path / "run")
    child = os.fork()
    if child == 0:
        time.sleep(60.0)
        os._exit(0)
    try:
        writer.close()
        RunWriter.resume(tmp_path / "run").close()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


HOST = socket.gethostname()
NOBODY = 2**22 + 1  # above what Linux numbers processes to


@pytest.mark.parametrize(
    ("words", "free"),
    [
        ("", True),
        ("nonsense", True),
        (f"process {NOBODY} on {HOST}", True),
        (f"process {os.getppid()} on {HOST}", False),
        (f"process {NOBODY} on another-{HOST}", False),
    ],
)
def test_disks_without_locks(tmp_path, monkeypatch, words, free):
    fcntl = pytest.importorskip("fcntl")

    def unsupported(*_):
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    (tmp_path / lock.NAME).write_text(words)
    if free:
        lock.Lock(tmp_path).release()
    else:
        with pytest.raises(lock.LockedError, match=r"disk without locks; if that has ended, delete .*run\.lock"):
            lock.Lock(tmp_path)


# --- no room ---

resource = pytest.importorskip("resource") if os.name != "nt" else None


def write_within(folder, largest: int) -> None:
    """In a process of its own, in which no file grows beyond so many bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
    try:
        runs.write(folder, steps=400)
    except RunError as error:
        print(error)
        sys.stdout.flush()
        os._exit(3)


@pytest.mark.skipif(resource is None, reason="needs limits of files")
@pytest.mark.parametrize("largest", [1 << 14, 3 << 17, 1 << 19, 3 << 18])
def test_limits_of_files_end_a_run_that_goes_on_later(tmp_path, largest):
    """Also where HDF5 meets them: the project's error, nothing else on stderr, and the same files in the end."""
    code = f"from tests.output.test_results import write_within; write_within({str(tmp_path / 'run')!r}, {largest})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (3, "")
    assert "cannot be written: File too large" in done.stdout
    runs.write(tmp_path / "whole", steps=400)
    if (tmp_path / "run/run.json").exists():
        with RunWriter.resume(tmp_path / "run") as writer:
            step, arrays = writer.latest_checkpoint()
            runs.advance(writer, arrays["positions"], range(step + 1, 401))
        resumed, whole = contents(tmp_path / "run"), contents(tmp_path / "whole")
        del resumed["run.vtkhdf"], whole["run.vtkhdf"]
        assert resumed == whole
        assert len(vtkhdf.h5py.File(tmp_path / "run/run.vtkhdf")["VTKHDF/Steps/Values"]) == 401
    else:  # not even the first files fit
        runs.write(tmp_path / "run", steps=1)


@pytest.mark.parametrize("place", ["frames", "stats.jsonl", "checkpoints", "run.vtkhdf", "segments"])
def test_a_full_disk_is_told(tmp_path, monkeypatch, place):
    writer, state = runs.begin(tmp_path / "run")
    full = OSError(errno.ENOSPC, "No space left on device")

    def refuse(*_args, **_options):
        raise full

    if place == "run.vtkhdf":
        monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1 << 30, 1 << 30, 1000))
    elif place == "stats.jsonl":
        monkeypatch.setattr(
            "builtins.open", lambda path, *args, **options: refuse() if "stats" in str(path) else open_(path, *args, **options)
        )
    else:
        monkeypatch.setattr(np, "save" if place == "frames" else "savez", refuse)
    with pytest.raises(RunError, match=r"No space left on device.*make room, then go on with --resume"):
        runs.advance(writer, state, range(1, 3)) if place != "segments" else writer.append_segments(1, 0, state, state)
    monkeypatch.undo()
    writer.close()
    with RunWriter.resume(tmp_path / "run") as writer:
        step, arrays = writer.latest_checkpoint()
        runs.advance(writer, arrays["positions"], range(step + 1, 5))
    runs.write(tmp_path / "whole", steps=4)
    assert {name: data for name, data in contents(tmp_path / "run").items() if name != "run.vtkhdf"} == {
        name: data for name, data in contents(tmp_path / "whole").items() if name != "run.vtkhdf"
    }


open_ = open


def test_what_cannot_be_written_for_another_reason_is_told_too(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"file/run cannot be written: Not a directory$"):
        runs.begin(tmp_path / "file/run")


# --- damage ---


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("run.json", "[]", r"run\.json holds \[\]; it must hold a table"),
        ("run.json", "{", r"run\.json cannot be read"),
        ("run.json", "[" * 100000, r"run\.json cannot be read"),
        ("run.json", '{"format": ' + "9" * 5000 + "}", r"run\.json cannot be read"),
        ("run.json", b"\xff\xfe", r"run\.json cannot be read"),
        ("scene.json", "null", r"scene\.json holds None"),
        ("stats.jsonl", "3\n", r"stats\.jsonl, line 1 holds 3; it must hold a table"),
        ("stats.jsonl", '{"step": 0}\n', r"line 1: time is None; it must be a number of seconds"),
        ("stats.jsonl", '{"step": true, "time": 0}\n', r"line 1: step is True; it must be a whole number"),
        ("stats.jsonl", '{"step": 0, "time": 0}\n{"step": 0, "time": 1}\n', r"line 2: step is 0; .* rises from line to line"),
        ("stats.jsonl", '{"step": 0, "time": 0}\n{"step": 1, "time": NaN}\n', r"line 2: time is nan"),
        (
            "stats.jsonl",
            '{"step": 0, "time": 0, "smallest_gap": "wide"}\n',
            r"smallest_gap is 'wide'; it must be a number or null",
        ),
        ("stats.jsonl", '{"step": 0, "time": 0, "milliseconds": {"ccd": "long"}}\n', r"milliseconds is .*a table of numbers"),
        ("stats.jsonl", '{"step": 0, "time": 0, "converged": 1}\n', r"converged is 1; it must be true or false"),
        ("stats.jsonl", "[" * 100000 + "\n", r"stats\.jsonl, line 1"),
        ("stats.jsonl", b"\xff\n", r"stats\.jsonl cannot be read"),
        ("topology.npz", "PK", r"topology\.npz cannot be read"),
    ],
)
def test_damaged_files_are_named(tmp_path, name, text, said):
    runs.write(tmp_path / "run", steps=2)
    (tmp_path / "run" / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(RunError, match=said):
        open_run(tmp_path / "run")
    with pytest.raises(RunError, match=said):
        RunWriter.resume(tmp_path / "run")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tets": None}, 'lacks the array "tets"'),
        ({"triangles": np.zeros((2, 4), int)}, r"triangles holds int64 of shape \(2, 4\); it must be \(triangles, 3\)"),
        ({"triangles": np.full((2, 3), 10**6)}, "triangles names number 1000000 of"),
        ({"scripted": np.zeros(3, bool)}, "scripted holds bool"),
        ({"body_names": np.array([1.0, 2.0, 3.0])}, "body_names holds float64"),
        ({"body_of_vertex": np.array([], dtype=int)}, "scripted holds bool"),
    ],
)
def test_damaged_topologies_are_named(tmp_path, change, said):
    runs.write(tmp_path / "run", steps=1)
    path = tmp_path / "run/topology.npz"
    with np.load(path) as arrays:
        found = {**arrays, **change}
    np.savez(path, **{name: array for name, array in found.items() if array is not None})
    with pytest.raises(RunError, match=f"topology.npz.*{said}"):
        open_run(tmp_path / "run")


def test_damaged_frames_are_named(tmp_path):
    runs.write(tmp_path / "run", steps=1)
    whole = open_run(tmp_path / "run").positions(1)
    for array, said in (
        (np.zeros((2, 3)), r"float64 of shape \(2, 3\)"),
        (np.array(["a"]), "must hold floating-point"),
        (np.where(np.arange(len(whole))[:, None] == 5, np.nan, whole), r"000001\.npy: vertex 5 is at \[nan, nan, nan\]"),
    ):
        np.save(tmp_path / "run/frames/000001.npy", array)
        with pytest.raises(RunError, match=said):
            open_run(tmp_path / "run").positions(1)


def of_huge_arrays(path, name) -> None:
    """An archive of an array that says it has 22 TiB."""
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3)}\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head)


def with_bits(path, flag: int = 0, packed: int | None = None) -> None:
    """An archive of which the first member says that it is encrypted, flag 1, or packed in a way of another number."""
    data = bytearray(path.read_bytes())
    central = data.find(b"PK\x01\x02")
    for at in (6, central + 8):
        data[at] |= flag
        data[at + 2] = data[at + 2] if packed is None else packed
    path.write_bytes(data)


ODD = {
    "encrypted": lambda path, name: with_bits(path, flag=1),
    "packed in another way": lambda path, name: with_bits(path, packed=99),
    "of huge arrays": of_huge_arrays,
    "another kind of file": lambda path, name: path.write_bytes((path.parent.parent / "frames/000001.npy").read_bytes()),
    "a folder": lambda path, name: (path.unlink(), path.mkdir()),
    "a link to itself": lambda path, name: (path.unlink(), path.symlink_to(path.name)),
    "a pipe": lambda path, name: (path.unlink(), os.mkfifo(path)),
}


@pytest.mark.skipif(os.name == "nt", reason="pipes and links of other systems")
@pytest.mark.parametrize("odd", ODD)
def test_files_that_are_something_else_are_named(tmp_path, odd):
    """Whatever reading them raises, or however long it would wait."""
    folder = tmp_path / "run"
    writer, state = runs.begin(folder)
    with writer:
        runs.advance(writer, state, range(1, 5))
    run = open_run(folder)
    ODD[odd](folder / "segments/000004_0000.npz", "start")
    with pytest.raises(RunError, match=r"000004_0000\.npz cannot be read: .{5}") as caught:
        list(run.segments())
    assert len(str(caught.value)) < len(str(folder)) + 400
    ODD[odd](folder / "checkpoints/000004.npz", "positions")
    with RunWriter.resume(folder) as writer:
        assert writer.latest_checkpoint()[0] == 2, "the one before is whole"
    if odd != "another kind of file":
        ODD[odd](folder / "topology.npz", "triangles")
        with pytest.raises(RunError, match=r"topology\.npz cannot be read: .{5}"):
            open_run(folder)


def test_frames_that_are_something_else_are_named(tmp_path):
    runs.write(tmp_path / "run", steps=1)
    path = tmp_path / "run/frames/000001.npy"
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3)}\n"
    for data, said in (
        (b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head, "it needs more memory than there is"),
        ((tmp_path / "run/topology.npz").read_bytes(), "it holds several arrays"),
        (
            b"\x93NUMPY\x01\x00" + struct.pack("<H", 8001) + b"(" * 4000 + b")" * 4000 + b"\n",
            "Cannot parse header|too many nested",
        ),
    ):
        path.write_bytes(data)
        with pytest.raises(RunError, match=rf"000001\.npy cannot be read: ({said})") as caught:
            open_run(tmp_path / "run").positions(1)
        assert len(str(caught.value)) < len(str(tmp_path)) + 400


@pytest.mark.skipif(os.name == "nt", reason="names of other systems")
def test_folders_that_cannot_be_are_refused(tmp_path):
    long = tmp_path / ("y" * 5000)
    with pytest.raises(RunError, match=r"y\.\.\. cannot be written: File name too long"):
        runs.begin(long)
    with pytest.raises(RunError, match=r"cannot be read: .*File name too long"):
        open_run(long)
    os.mkfifo(tmp_path / "run.lock")
    with pytest.raises(RunError, match=r"run\.lock cannot be written: it is no regular file"):
        runs.begin(tmp_path)


def test_frames_without_a_line_and_lines_without_a_frame(tmp_path):
    folder = tmp_path / "run"
    writer, state = runs.begin(folder)
    with writer:
        for step in range(1, 4):
            writer.append(step, step * 0.01, state, {})
        writer.checkpoint(3, {"positions": state})
    lines = (folder / "stats.jsonl").read_text().splitlines(keepends=True)
    (folder / "stats.jsonl").write_text("".join(lines[:2] + lines[3:]))
    for read in (open_run, RunWriter.resume):
        with pytest.raises(RunError, match=r"stats\.jsonl has no line for 000002\.npy"):
            read(folder)
    (folder / "stats.jsonl").write_text("".join(lines))
    (folder / "frames/000002.npy").unlink()
    with pytest.raises(RunError, match=r"000002\.npy cannot be read"):
        open_run(folder).positions(2)
    with pytest.raises(RunError, match=r"000002\.npy is not there"):
        RunWriter.resume(folder)


def test_more_than_a_million_steps(tmp_path):
    """Names with seven digits come after those with six."""
    writer, state = runs.begin(tmp_path / "run")
    with writer:
        for step in (999_998, 999_999, 1_000_000, 1_000_001):
            writer.append(step, step * 0.01, state, {})
            writer.append_segments(step, 0, state, state)
            writer.checkpoint(step, {"positions": state})
        assert writer.latest_checkpoint()[0] == 1_000_001
    assert [step for step, *_ in open_run(tmp_path / "run").segments()] == [999_998, 999_999, 1_000_000, 1_000_001]
    assert len(list((tmp_path / "run/checkpoints").iterdir())) == 2
