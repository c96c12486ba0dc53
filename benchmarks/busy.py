"""What a busy machine costs: `python benchmarks/busy.py [NAME ...] [--seconds S] [--rounds N]`.

Each scene is simulated quietly, and beside one process a core that does nothing but count, by turns; with one thread, and with one a
core. A competitor on each core takes half of it, so a step that costs its share takes twice as long. Prints a table of median times
and writes benchmarks/results/busy.json with the machine named.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

from simulation import SCENES, H, machine

DEFAULT = ("cloth 50x50", "block 10^3", "block 20^3")


def steps(name: str) -> None:
    """In a process of its own: answers each line with the number of seconds that it names by the median ms of a step so long."""
    import pdipc

    scene = pdipc.Scene(simulation={"time_step": H}, **SCENES[name]())
    simulation = pdipc.Simulation(scene, "cpu")
    for _ in range(60):  # into contact
        simulation.step()
    start = simulation.state.copy()
    for line in sys.stdin:
        until, taken = time.monotonic() + float(line), []
        while time.monotonic() < until:
            simulation.state = start.copy()  # the same few steps, so that all measure the same work
            for _ in range(8):
                began = time.perf_counter()
                simulation.step()
                taken.append(1e3 * (time.perf_counter() - began))
        print(statistics.median(taken), statistics.fmean(taken), flush=True)


@contextmanager
def competitors(count: int):
    """So many processes that count."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        time.sleep(0.2)
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def measure(name: str, threads: int, seconds: float, rounds: int) -> dict:
    command = [sys.executable, __file__, "--steps-of", name]
    environment = {**os.environ, "PDIPC_THREADS": str(threads)}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as process:

        def ask() -> float:
            process.stdin.write(f"{seconds}\n")
            process.stdin.flush()
            return float(process.stdout.readline().split()[1])  # the mean: what a preemption costs is rare and long

        ask()
        quiet, busy = [], []
        for _ in range(rounds):
            quiet.append(ask())
            with competitors(os.cpu_count() or 1):
                busy.append(ask())
        process.stdin.close()
    return {"quiet_ms": statistics.median(quiet), "busy_ms": statistics.median(busy)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=DEFAULT, help=f"of: {', '.join(SCENES)}")
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps-of", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.steps_of:
        return steps(options.steps_of)
    cores = os.cpu_count() or 1
    report = {"machine": machine(), "load_average": os.getloadavg()[0], "scenes": {}}
    print(f"{'':20} {'threads':>7} {'quiet, ms':>10} {'busy, ms':>10} {'times':>6}")
    for name in options.names:
        for threads in sorted({1, cores}):
            found = measure(name, threads, options.seconds, options.rounds)
            report["scenes"][f"{name}, {threads} threads"] = found
            times = found["busy_ms"] / found["quiet_ms"]
            print(f"{name:20} {threads:7} {found['quiet_ms']:10.2f} {found['busy_ms']:10.2f} {times:6.2f}", flush=True)
    path = Path(__file__).parent / "results" / "busy.json"
    path.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
