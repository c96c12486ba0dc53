"""Runs that are stopped at random moments: `python benchmarks/kills.py [KIND ...] [--count N] [--seed S]`.

KIND: INT (Ctrl-C, also twice), TERM, KILL: a signal at a random moment, up to three times a run, then --resume to the end.
writers: two, three or four processes resume the same folder at once. limits: no file may grow beyond a random size; then --resume
without. Each run must end with the bits of one that nothing stopped: frames, times, statistics, checkpoints, recorded motions.

Runs are forks of one process that has compiled and imported everything, so that each takes a fraction of a second; on Linux and macOS.
Exit code 1 where one differs. Writes benchmarks/results/kills.json.
"""

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ccd import machine

import pdipc
import pdipc.simulation
from pdipc.cli import app
from pdipc.output.results import open_run

KINDS = ("INT", "TERM", "KILL", "writers", "limits")
REFUSED = 2  # exit code of a run that cannot be
CHECKPOINT_SECONDS = 0.03  # so that a run of a second has many


def scene(substeps: int) -> pdipc.Scene:
    """A block and a cloth that meet; a second of work."""
    bodies = [
        {"name": "block", "kind": "solid", "mesh": {"shape": "box", "size": [0.1] * 3, "cells": [2, 2, 2]}},
        {"name": "sheet", "kind": "cloth", "mesh": {"shape": "grid", "size": [0.3, 0.3], "cells": [5, 5]}},
    ]
    bodies[0] |= {"translation": [0, 0.06, 0], "velocity": [0, -1, 0]}
    bodies[1] |= {"translation": [0, 0.12, 0], "rotation": [0, 9, 0]}
    simulation = {"steps": 24, "substeps": substeps}
    return pdipc.Scene(simulation=simulation, bodies=bodies, obstacles=[{"name": "floor", "mesh": {"shape": "plane"}}])


def start(arguments: list[str], log: Path, largest_file: int | None = None) -> int:
    """`pdipc ...` in a fork; its process number."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until the child has come to where an interrupt ends it alone
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        return child
    code = 70
    try:
        sink = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        pdipc.simulation.CHECKPOINT_SECONDS = CHECKPOINT_SECONDS
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        app(arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    except KeyboardInterrupt:  # before the command line has begun
        code = 128 + signal.SIGINT
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        try:
            # A second one here would leave by the parent's way, and clear its folder. One that came before raises here.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def wait(child: int) -> int:
    """Exit code; minus the signal where one ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def contents(folder: Path) -> dict:
    """All but how long steps took, who wrote, and run.vtkhdf, which is derived and judged by itself."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if name == "stats.jsonl":
            lines = [json.loads(line) for line in path.read_text().splitlines()]
            found[name] = [{key: value for key, value in line.items() if key != "milliseconds"} for line in lines]
        elif name.startswith("checkpoints/"):
            continue  # which of them are kept depends on the clock; the last is compared below
        elif path.is_file() and name not in ("run.lock", "run.vtkhdf"):
            found[name] = path.read_bytes()
    found["last checkpoint"] = max((folder / "checkpoints").glob("*.npz")).read_bytes()
    return found


def judge(folder: Path, expected: dict) -> str:
    """What differs, in words; nothing where all is right."""
    import h5py
    import numpy as np

    found = contents(folder)
    wrong = [name for name in sorted({*found, *expected}) if found.get(name) != expected.get(name)]
    run = open_run(folder)
    with h5py.File(folder / "run.vtkhdf") as file:
        points = file["VTKHDF/Points"][:].reshape(run.frame_count, -1, 3)
        if not all(np.array_equal(points[frame], run.positions(frame)) for frame in range(run.frame_count)):
            wrong.append("run.vtkhdf")
    return ", ".join(wrong[:5])


def stopped(kind: str, go: list[str], resume: list[str], log: Path, seconds: float, chance: random.Random) -> str:
    """One run that signals stop up to three times; what went wrong, in words."""
    command, number = go, getattr(signal, f"SIG{kind}")
    for _ in range(chance.randint(1, 3)):
        child = start(command, log)
        time.sleep(chance.uniform(0.0, 1.1 * seconds))
        for _ in range(2 if kind == "INT" and chance.random() < 0.5 else 1):
            os.kill(child, number)
            time.sleep(chance.uniform(0.0, 0.02))
        code = wait(child)
        if code not in (0, 128 + number, -number):
            return f"exit code {code}"
        # a kill before the folder was made leaves none, or one that a second try takes
        command = resume if (Path(go[3]) / "run.json").exists() else go
    code = wait(start(command, log))
    return "" if code == 0 else f"exit code {code} in the end"


def crowded(go: list[str], resume: list[str], log: Path, seconds: float, chance: random.Random) -> str:
    """Several writers at once, after a kill."""
    child = start(go, log)
    time.sleep(chance.uniform(0.3, 0.8) * seconds)
    os.kill(child, signal.SIGKILL)
    wait(child)
    if not (Path(go[3]) / "run.json").exists():
        resume = go
    children = []
    for _ in range(chance.randint(2, 4)):
        children.append(start(resume, log))
        time.sleep(chance.choice([0.0, 0.0, chance.uniform(0.0, 0.3 * seconds)]))
    codes = [wait(child) for child in children]
    if 0 not in codes or not set(codes) <= {0, REFUSED}:
        return f"exit codes {codes}"
    return ""


def limited(go: list[str], resume: list[str], log: Path, chance: random.Random) -> str:
    """A limit on files, the log of what it says among them, ends the run with the project's message; without it, the run goes on."""
    code = wait(start(go, log, largest_file=int(10 ** chance.uniform(3.0, 5.8))))
    said = log.read_text()
    if (
        code not in (0, REFUSED)
        or (code == REFUSED and "cannot be written" not in said)
        or "Traceback" in said
        or "ignored" in said
    ):
        return f"exit code {code}: {said[-300:]}"
    code = wait(start(resume if (Path(go[3]) / "run.json").exists() else go, log))
    return "" if code == 0 else f"exit code {code} in the end"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", choices=[[], *KINDS], default=[], metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path(__file__).resolve().parent / "results" / "kills.json")
    parser.add_argument("--folder", type=Path, help="Where runs are written; default: a temporary one.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        sys.exit(attack(Path(folder), options.kinds or KINDS, options.count, options.seed, options.output))


def attack(folder: Path, kinds: list[str], count: int, seed: int, output: Path) -> int:
    substeps = (1, 3)
    scenes, expected, seconds = {}, {}, {}
    for number in substeps:
        scenes[number] = folder / f"scene{number}.json"
        scenes[number].write_text(scene(number).model_dump_json())
        whole = folder / f"whole{number}"
        for _ in range(2):  # the first compiles
            began = time.monotonic()
            command = ["run", str(scenes[number]), "-o", str(whole), "--certify", "--overwrite"]
            code = wait(start(command, folder / "whole.log"))
            assert code == 0, (folder / "whole.log").read_text()
            seconds[number] = time.monotonic() - began
        expected[number] = contents(whole)
        assert open_run(whole).frame_count == 25
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    result = {"machine": machine(), "commit": commit, "seed": seed, "kinds": {}}
    for kind in kinds:
        chance = random.Random(f"{seed} {kind}")
        began, wrong = time.monotonic(), 0
        for i in range(count):
            number = chance.choice(substeps)
            run, log = folder / "run", folder / "run.log"
            go = ["run", str(scenes[number]), "-o", str(run), "--certify"]
            resume = [*go, "--resume"]
            if kind == "writers":
                said = crowded(go, resume, log, seconds[number], chance)
            elif kind == "limits":
                said = limited(go, resume, log, chance)
            else:
                said = stopped(kind, go, resume, log, seconds[number], chance)
            differs = said or judge(run, expected[number])
            if differs:
                wrong += 1
                print(
                    f"{kind}, run {i} of seed {seed}: {differs}\n{log.read_text()[-2000:] if log.exists() else ''}", flush=True
                )
            shutil.rmtree(run, ignore_errors=True)
            log.unlink(missing_ok=True)
        took = round(time.monotonic() - began)
        result["kinds"][kind] = {"runs": count, "differ": wrong, "seconds": took, "load": os.getloadavg()[1]}
        output.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{kind:8} {count} runs, {wrong} differ from one that nothing stopped; {took} s", flush=True)
    return int(any(row["differ"] for row in result["kinds"].values()))


if __name__ == "__main__":
    main()
