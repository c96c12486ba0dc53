"""Sweeps: every combination once, whatever happens to the workers, and a table with the bits of a serial one."""

import csv
import functools
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pdipc import sweeps
from pdipc.cli import app
from pdipc.output.results import RunError, RunWriter, open_run
from pdipc.scene.errors import SceneError

distributed = pytest.importorskip("distributed")

PAGE = Path(__file__).parents[2] / "docs" / "sweeps.md"
SCENE = """
[simulation]
steps = 8
precision = "float64"
[[bodies]]
name = "block"
kind = "solid"
mesh = { shape = "box", size = [0.1, 0.1, 0.1], cells = [1, 1, 1] }
translation = [0.0, 0.0505, 0.0]
velocity = [0.5, 0.0, 0.0]
[[obstacles]]
name = "floor"
mesh = { shape = "plane", size = 4.0 }
"""
SETTINGS = {"contact.friction": [0.0, 0.5], "bodies.block.material.young_modulus": [1e4, 1e5]}
# A checkpoint after every step, and steps that take a while, so that there is a step to be killed in.
SLOWLY = """
import time
def dask_setup(server):
    if type(server).__name__ != "Worker":  # its nanny loads this, too
        return
    from pdipc import simulation
    simulation.CHECKPOINT_SECONDS = 0.0
    told = simulation.stats_of
    def slowly(result):
        time.sleep(0.03)
        return told(result)
    simulation.stats_of = slowly
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def inside():
    """The address of a cluster within this process."""
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def serially(scene, settings, folder) -> bytes:
    cases = sweeps.combinations(scene, settings)
    for case in cases:
        sweeps.run_case(case, str(folder))
    sweeps.write_table(folder, cases, {})
    return (folder / "table.csv").read_bytes()


def rows(folder, name="table.csv") -> list[dict]:
    with open(folder / name, newline="") as file:
        return list(csv.DictReader(file))


class Cluster:
    """A scheduler and two workers with nannies, each a process of this machine."""

    def __init__(self, folder):
        self.file, preload = folder / "scheduler.json", folder / "slowly.py"
        preload.write_text(SLOWLY)
        common = ["--scheduler-file", str(self.file), "--no-dashboard"]
        self.processes = []
        self._start("dask_scheduler", *common, "--port", "0", "--host", "127.0.0.1")
        while not self.file.exists():
            time.sleep(0.05)
        for _ in range(2):
            self._start("dask_worker", *common, "--nthreads", "1", "--preload", str(preload), "--local-directory", str(folder))
        self.address = json.loads(self.file.read_text())["address"]

    def _start(self, module, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{module}", *arguments]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.processes.append(subprocess.Popen(command, env={**os.environ, "PDIPC_THREADS": "1"}, **quiet))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.processes):
            process.terminate()
        for process in self.processes:
            process.wait(timeout=120)


def kill_workers(folder, killed: list, deaths: int):
    """Ends so many times, once a run has three frames, the process that writes it, which run.lock names, at once."""
    while len(killed) < deaths:
        for lock in folder.glob("*/run.lock"):
            words = re.match(r"process (\d+) on", lock.read_text())
            alive = words and int(words[1]) not in [process for process, _ in killed]
            if words and alive and 3 < len(list(lock.parent.glob("frames/*.npy"))) < 8:
                os.kill(int(words[1]), signal.SIGKILL)
                killed.append((int(words[1]), lock.parent.name))
                break
        time.sleep(0.02)


def test_killed_workers_are_replaced_and_their_runs_go_on(scene, tmp_path):
    expected = serially(scene, SETTINGS, tmp_path / "serial")
    killed: list = []
    (tmp_path / "cluster").mkdir()
    with Cluster(tmp_path / "cluster") as cluster:
        killer = threading.Thread(target=kill_workers, args=(tmp_path / "swept", killed, 2), daemon=True)
        killer.start()
        failures = sweeps.run_sweep(scene, SETTINGS, tmp_path / "swept", scheduler=cluster.address)
        killer.join(timeout=120)
        with distributed.Client(cluster.address) as client:
            client.wait_for_workers(2, timeout=120)  # the dead ones have successors
            processes = set(client.run(os.getpid).values())
    assert failures == {} and len(killed) == 2
    assert not processes & {process for process, _ in killed}
    assert (tmp_path / "swept" / "table.csv").read_bytes() == expected
    resumed = {row["run"]: int(row["resumed_at_step"]) for row in rows(tmp_path / "swept", "times.csv")}
    whose = {run for _, run in killed}
    assert all(resumed[run] >= 2 for run in whose), "they went on from a checkpoint"
    assert not any(step for name, step in resumed.items() if name not in whose)
    table = rows(tmp_path / "swept")
    assert [row["run"] for row in table] == ["0000", "0001", "0002", "0003"]
    assert len({row["positions_sha256"] for row in table}) == 4
    # friction of 0.5 takes 4.9 m/s^2 from 0.5 m/s within 0.08 s; without any the block goes on
    smooth, rough = (float(row["block.x_m"]) for row in (table[1], table[3]))
    assert smooth == pytest.approx(0.5 * 0.08, rel=0.02) and rough < 0.7 * smooth


def test_the_only_worker_may_die_and_its_successor_be_slow(scene, tmp_path):
    """Dask gives up a worker of this machine whose successor is not there in time; then no one would be left."""
    import dask

    scene.write_text(SCENE.replace("steps = 8", "steps = 300"))
    settings, killed = {"contact.friction": [0.0]}, []

    def kill():
        while not killed:
            for lock in (tmp_path / "swept").glob("*/run.lock"):
                words = re.match(r"process (\d+) on", lock.read_text())
                if words and (lock.parent / "frames" / "000010.npy").exists():
                    os.kill(int(words[1]), signal.SIGKILL)
                    killed.append(int(words[1]))
            time.sleep(0.005)

    threading.Thread(target=kill, daemon=True).start()
    with dask.config.set({"distributed.deploy.lost-worker-timeout": 0.1}):
        assert sweeps.run_sweep(scene, settings, tmp_path / "swept", workers=1) == {}
    assert len(killed) == 1
    assert (tmp_path / "swept" / "table.csv").read_bytes() == serially(scene, settings, tmp_path / "serial")


def test_a_run_goes_on_from_its_last_checkpoint_and_says_which(scene, tmp_path, monkeypatch):
    """Of five steps that are there when it was stopped, those after the checkpoint are taken again."""
    from pdipc import simulation

    (case,) = sweeps.combinations(scene, {"contact.friction": [0.0]})
    own, told, seconds = tmp_path / case.folder, simulation.stats_of, [10.0]

    def until_the_sixth(result):
        seconds.append(0.0 if len(seconds) == 3 else 10.0)
        monkeypatch.setattr(simulation, "CHECKPOINT_SECONDS", seconds[-1])
        if len(seconds) == 7:
            raise RuntimeError("stopped")
        return told(result)

    monkeypatch.setattr(simulation, "stats_of", until_the_sixth)
    assert sweeps.run_case(case, str(tmp_path)) == "stopped"
    assert open_run(own).records[-1]["step"] == 5
    monkeypatch.setattr(simulation, "stats_of", told)
    assert sweeps.run_case(case, str(tmp_path)) == 3
    assert open_run(own).records[-1]["step"] == 8


def test_what_cannot_be_simulated_is_refused_before_anything_runs(scene, tmp_path, inside):
    settings = {"bodies.block.translation": [[0, 0.0505, 0], [0, 0.02, 0], [0, 0.01, 0]]}
    with pytest.raises(SceneError) as caught:
        sweeps.run_sweep(scene, settings, tmp_path / "swept", scheduler=inside)
    said = str(caught.value)
    assert "2 of 3 combinations cannot be simulated" in said
    assert "bodies.block.translation = [0, 0.02, 0]: the scene cannot be simulated" in said and "floor" in said
    assert not (tmp_path / "swept").exists(), "another sweep may have the name"


def test_a_sweep_that_was_stopped_is_finished(scene, tmp_path, inside):
    """One run is whole, one half done, one not begun; only a resume of the very same sweep goes on."""
    settings = {"contact.friction": [0.0, 0.2, 0.4]}
    expected = serially(scene, settings, tmp_path / "serial")
    folder = tmp_path / "swept"
    sweeps.run_sweep(scene, settings, folder, scheduler=inside)
    shutil.rmtree(folder / "0002")
    (folder / "table.csv").unlink()
    half = open_run(folder / "0001")
    (folder / "0001" / "stats.jsonl").write_text("".join(json.dumps(record) + "\n" for record in half.records[:4]))
    whole = (folder / "0000" / "stats.jsonl").stat().st_mtime_ns
    with pytest.raises(RunError, match="holds a sweep already"):
        sweeps.run_sweep(scene, settings, folder, scheduler=inside)
    with pytest.raises(RunError, match="of another scene or by other values"):
        sweeps.run_sweep(scene, {"contact.friction": [0.0, 0.2, 0.5]}, folder, scheduler=inside, resume=True)
    assert sweeps.run_sweep(scene, settings, folder, scheduler=inside, resume=True) == {}
    assert (folder / "table.csv").read_bytes() == expected
    assert (folder / "0000" / "stats.jsonl").stat().st_mtime_ns == whole, "what was done is not done again"


def test_a_run_that_fails_is_in_the_table_and_does_not_stop_the_others(scene, tmp_path, inside, monkeypatch):
    create = RunWriter.create

    def full(folder, *arguments, **options):
        if Path(folder).name == "0001":
            raise RunError("no room")
        return create(folder, *arguments, **options)

    monkeypatch.setattr(RunWriter, "create", full)
    failures = sweeps.run_sweep(scene, {"contact.friction": [0.0, 0.2]}, tmp_path / "swept", scheduler=inside)
    assert failures == {1: "no room"}
    table = rows(tmp_path / "swept")
    assert [(row["steps"], row["error"]) for row in table] == [("8", ""), ("", "no room")]


def test_a_run_that_another_process_writes_is_waited_for(scene, tmp_path):
    (case,) = sweeps.combinations(scene, {"contact.friction": [0.0]})
    begun = tmp_path / case.folder
    sweeps.run_case(case, str(tmp_path))
    done = open_run(begun).records
    writer = RunWriter.resume(begun)
    threading.Timer(0.3, writer.close).start()
    start = time.monotonic()
    assert sweeps.run_case(case, str(tmp_path)) == 8
    assert time.monotonic() - start > 0.25 and open_run(begun).records == done


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--set", "contact.friction"], "KEY=VALUE"),
        (["--set", "contact.friction=0.1", "--set", "contact.friction=0.2"], "there twice"),
        (["--set", "contact.friction=rough"], "must be a number"),
        (["--set", "bodies.cube.friction=0.1"], 'bodies has no "cube"; there are: block'),
        (["--set", "contact.friction=0.1", "--scheduler", "tcp://127.0.0.1:1", "--workers", "2"], "--workers"),
        (["--set", "contact.friction=0.1", "--resume"], "holds no sweep"),
    ],
)
def test_errors_are_one_message(scene, tmp_path, arguments, said):
    result = CliRunner().invoke(app, ["sweep", str(scene), "-o", str(tmp_path / "out"), *arguments])
    assert result.exit_code == 2 and said in result.stderr and "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_of_other_files_is_left_alone(scene, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match="holds other files"):
        sweeps.run_sweep(scene, {"contact.friction": [0.1]}, tmp_path, overwrite=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_page(tmp_path, monkeypatch):
    """Its scene and its command, on two processes of this machine, make the table that it shows."""
    text = PAGE.read_text()
    (toml,) = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    command, *_ = re.findall(r"^pdipc (sweep .*)$", text, flags=re.MULTILINE)
    (shown,) = re.findall(r"```csv\n(.*?)```", text, flags=re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("slide.toml").write_text(toml)
    result = CliRunner().invoke(app, shlex.split(command))
    assert result.exit_code == 0, result.stderr
    made = Path(result.stdout.strip())
    columns = shown.splitlines()[0].split(",")
    table = [[row[column] for column in columns] for row in rows(made.parent)]
    for line, row in zip(shown.splitlines()[1:], table, strict=True):
        for cell, value in zip(line.split(","), row, strict=True):
            assert cell == value or float(cell) == pytest.approx(float(value), rel=0.05)


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGINT to send")
def test_an_interrupt_stops_a_sweep_and_resume_finishes_it(scene, tmp_path):
    """Ctrl-C while runs are under way on processes of this machine: one message, no table; then the table of a serial sweep."""
    scene.write_text(SCENE.replace("steps = 8", "steps = 300"))
    settings = {"contact.friction": [0.0, 0.5]}
    command = [sys.executable, "-m", "pdipc", "sweep", str(scene), "--set", "contact.friction=0.0,0.5", "--workers", "2"]
    command += ["-o", str(tmp_path / "swept")]
    heard = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # what a shell starts in the background ignores it
    environment = {**os.environ, "PDIPC_THREADS": "1"}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, preexec_fn=heard)
    while process.poll() is None and not list(tmp_path.glob("swept/*/frames/000020.npy")):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == 130 and "with --resume" in said and "Traceback" not in said
    assert not (tmp_path / "swept" / "table.csv").exists()
    assert subprocess.run([*command, "--resume"], capture_output=True, timeout=300).returncode == 0
    assert (tmp_path / "swept" / "table.csv").read_bytes() == serially(scene, settings, tmp_path / "serial")
