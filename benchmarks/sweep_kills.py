"""A sweep of 24 runs on two workers of this machine, one of which is killed on the way, beside the same sweep in one process:
`python benchmarks/sweep_kills.py`.

The kill hits a run in its middle, between a quarter and three quarters of its steps. Prints, and writes to
benchmarks/results/sweep_kills.json, whether the two tables are the same file, the last step of the killed run when it was killed, the step from
which it went on, and the processor time and wall time of each.
"""

import csv
import json
import os
import re
import signal
import tempfile
import threading
import time
from pathlib import Path

import dask
from distributed import LocalCluster

from pdipc import sweeps
from pdipc.sweeps.cluster import SUCCESSOR_SECONDS

RESULTS = Path(__file__).parent / "results" / "sweep_kills.json"
SCENE = """
[simulation]
steps = 24
precision = "float64"
[[bodies]]
name = "ball"
kind = "solid"
mesh = { shape = "sphere", radius = 0.1, cells = 3 }
translation = [0.0, 0.15, 0.0]
velocity = [0.5, 0.0, 0.0]
[[bodies]]
name = "sheet"
kind = "cloth"
mesh = { shape = "grid", size = [0.4, 0.4], cells = [6, 6] }
translation = [0.05, 0.3, 0.0]
[[obstacles]]
name = "floor"
mesh = { shape = "plane", size = 4.0 }
"""
SETTINGS = {
    "contact.friction": [0.0, 0.1, 0.3, 0.5],
    "bodies.ball.material.young_modulus": [1e4, 1e5, 1e6],
    "bodies.sheet.material.bending_stiffness": [1e-6, 1e-4],
}
STEPS = 24  # of SCENE
CHECKPOINT_SECONDS = 0.1  # in the workers: runs are short


def often() -> None:
    """On a worker: checkpoints while these short runs are under way."""
    from pdipc import simulation

    simulation.CHECKPOINT_SECONDS = CHECKPOINT_SECONDS


def frames_of(run: Path) -> int:
    """The last step of which a run has a frame; -1 before there is any."""
    return max((int(path.stem) for path in (run / "frames").glob("*.npy")), default=-1)


def kill_one(folder: Path, killed: list[tuple[str, int]]) -> None:
    """Ends, once a third of the runs are whole, the process of a run that is in its middle. The process is halted first, so that the run is no
    further when it ends than when it was looked at.
    """
    while not killed:
        whole = list(folder.glob(f"*/frames/{STEPS:06d}.npy"))
        for lock in folder.glob("*/run.lock") if len(whole) >= 8 else ():
            words = re.match(r"process (\d+) on", lock.read_text())
            if not words or not STEPS // 4 <= frames_of(lock.parent) < STEPS // 2:
                continue
            os.kill(int(words[1]), signal.SIGSTOP)
            if lock.exists() and STEPS // 4 <= (step := frames_of(lock.parent)) <= 3 * STEPS // 4:
                os.kill(int(words[1]), signal.SIGKILL)
                killed.append((lock.parent.name, step))
                return
            os.kill(int(words[1]), signal.SIGCONT)
        time.sleep(0.005)


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        scene, serial, swept = Path(place) / "scene.toml", Path(place) / "serial", Path(place) / "swept"
        scene.write_text(SCENE)
        cases = sweeps.combinations(scene, SETTINGS)
        begun, processor = time.perf_counter(), time.process_time()
        for case in cases:
            outcome = sweeps.run_case(case, str(serial))
            assert outcome == 0, outcome
        sweeps.write_table(serial, cases, {})
        alone = time.perf_counter() - begun, time.process_time() - processor
        killed: list[tuple[str, int]] = []
        with (
            dask.config.set({"distributed.deploy.lost-worker-timeout": SUCCESSOR_SECONDS}),
            LocalCluster(n_workers=2, threads_per_worker=1, memory_limit=0, dashboard_address=None) as cluster,
        ):
            from distributed import Client

            with Client(cluster) as client:
                client.run(often)
                killer = threading.Thread(target=kill_one, args=(swept, killed), daemon=True)
                killer.start()
                begun = time.perf_counter()
                failures = sweeps.run_sweep(scene, SETTINGS, swept, scheduler=cluster.scheduler_address)
                together = time.perf_counter() - begun
        with open(swept / "times.csv", newline="") as file:
            resumed = {row["run"]: int(row["resumed_at_step"]) for row in csv.DictReader(file)}
        report = {
            "cores": os.cpu_count(),
            "date": time.strftime("%Y-%m-%d"),
            "load": os.getloadavg()[0],
            "runs": len(cases),
            "failures": failures,
            "steps": STEPS,
            "killed": [name for name, _ in killed],
            "killed_at_step": [step for _, step in killed],
            "resumed_at_step": [resumed[name] for name, _ in killed],
            "same_table": (serial / "table.csv").read_bytes() == (swept / "table.csv").read_bytes(),
            "serial_wall_s": alone[0],
            "serial_processor_s": alone[1],
            "two_workers_wall_s": together,
        }
    assert killed, "no run was seen in its middle"
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report))


if __name__ == "__main__":
    main()
