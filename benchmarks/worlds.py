"""Worlds side by side against the same worlds one after another: `python benchmarks/worlds.py [--worlds N ...] [--steps K] [--rounds R]`.

A robot's finger pushes a soft cube over a floor, each world with a friction and a stiffness of its own. Three ways take turns within a
round: side by side; one after another with one thread; one after another with all threads. Prints steps a second of all worlds, CPU time
a step and memory a world, asks that all three end at the same bits, and writes benchmarks/results/worlds.json with the machine named.
"""

import argparse
import hashlib
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

from simulation import machine

SCENE = {
    "simulation": {"time_step": 0.01, "device": "cpu"},
    "bodies": [
        {
            "name": "cube",
            "kind": "solid",
            "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [4, 4, 4]},
            "translation": [0.0, 0.0505, 0.0],
        }
    ],
    "obstacles": [
        {"name": "floor", "mesh": {"shape": "plane", "size": 4.0}},
        {"name": "finger", "mesh": {"shape": "box", "size": [0.02, 0.04, 0.06]}, "translation": [-0.07, 0.05, 0.0]},
    ],
}
WAYS = {"side by side": None, "one after another, 1 thread": "1", "one after another, all threads": None}


def variants(count: int) -> list[dict]:
    return [
        {"contact.friction": 0.1 + 0.5 * k / count, "bodies.cube.material.young_modulus": 1e5 * (1 + k % 4)}
        for k in range(count)
    ]


def run(way: str, count: int, steps: int) -> dict:
    """In a process of its own."""
    import pdipc
    from pdipc.scene.worlds import scenes_of

    scene, began = pdipc.Scene(**SCENE), time.perf_counter()
    pdipc.Simulation(scene).step()  # loads kernels
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    together = way == "side by side"
    worlds = pdipc.Worlds(scene, variants(count)) if together else [*map(pdipc.Simulation, scenes_of(scene, variants(count)))]

    def advance(k: int) -> None:
        for world in worlds:
            world.set_pose("finger", position=[-0.07 + 0.003 * k, 0.05, 0.0])
        for _ in [worlds.step()] if together else [world.step() for world in worlds]:
            pass

    advance(0)  # records
    built, memory = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    began, cpu = time.perf_counter(), time.process_time()
    for k in range(1, steps + 1):
        advance(k)
    wall, cpu = time.perf_counter() - began, time.process_time() - cpu
    bits = hashlib.sha256(b"".join(world.positions.tobytes() for world in worlds)).hexdigest()
    return {
        "steps_a_second": count * steps / wall,
        "cpu_ms_a_step": 1e3 * cpu / (count * steps),
        "built_s_a_world": built / count,
        "mb_a_world": memory / 1024 / count,
        "bits": bits,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print(json.dumps(run(options.only, options.worlds[0], options.steps)))
        return
    rows = []
    print(f"{'worlds':>6} {'way':32} {'steps/s':>8} {'CPU ms':>7} {'build s':>8} {'MB':>6}  load", flush=True)
    for count in options.worlds:
        found: dict[str, list[dict]] = {way: [] for way in WAYS}
        for _ in range(options.rounds):
            for way, threads in WAYS.items():
                command = [sys.executable, __file__, "--only", way, "--worlds", str(count), "--steps", str(options.steps)]
                environment = os.environ | ({"PDIPC_THREADS": threads} if threads else {})
                told = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
                found[way].append(json.loads(told.splitlines()[-1]))
        if len({each["bits"] for runs in found.values() for each in runs}) != 1:
            raise SystemExit("the ways end at different bits")
        for way, runs in found.items():
            row = {name: statistics.median(each[name] for each in runs) for name in runs[0] if name != "bits"}
            rows.append({"worlds": count, "way": way, **row, "load": os.getloadavg()[0]})
            print(
                f"{count:6} {way:32} {row['steps_a_second']:8.0f} {row['cpu_ms_a_step']:7.2f} {row['built_s_a_world']:8.3f} "
                f"{row['mb_a_world']:6.1f}  {os.getloadavg()[0]:.1f}",
                flush=True,
            )
    path = Path(__file__).parent / "results" / "worlds.json"
    path.write_text(json.dumps({"machine": machine(), "steps": options.steps, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
