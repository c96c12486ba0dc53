"""What the proofs of culling cost: `python benchmarks/proofs.py [--steps N]`.

Scenes of simulation.py are simulated twice, a step of the one after a step of the other: as they are, and with what the lemmas of `collision/sieve.py`
and `collision/candidates.py` take off for rounding taken out of the kernels. CPU time of the whole process on one thread, so that a busy machine does
not count. Both must come to the same positions, or the comparison says nothing. Writes benchmarks/results/proofs.json.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ["PDIPC_THREADS"] = "1"
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY / "tests"), str(REPOSITORY / "benchmarks")]

import numpy as np  # noqa: E402
import simulation as scenes  # noqa: E402
from ccd import machine  # noqa: E402

import pdipc  # noqa: E402
from pdipc.collision import candidates, sieve  # noqa: E402

SCENES = {
    "cloth 50x50": lambda: scenes.cloth_on_sphere(50),
    "block 10^3": lambda: scenes.block_on_floor(10),
    "squeezed block": lambda: scenes.squeezed_block(8),
}
BARE = {
    (sieve, "SLACK"): 0.0,
    (sieve, "ENOUGH"): 1.0,
    (sieve, "SMALLEST"): 0.0,
    (sieve, "LEAST"): 0.0,
    (candidates, "ROUNDING"): 0.0,
}


def forget() -> None:
    """Kernels are made anew, with the constants of now."""
    for module in [module for name, module in sys.modules.items() if name.startswith("pdipc.")]:
        for made in vars(module).values():
            if hasattr(made, "cache_clear"):
                made.cache_clear()


def simulations(tables: dict) -> tuple[pdipc.Simulation, pdipc.Simulation]:
    """As it is, and bare; each has taken a step, so that all is compiled and recorded."""
    forget()
    proven = pdipc.Simulation(pdipc.Scene(**tables), "cpu")
    proven.step()
    kept = {key: getattr(*key) for key in BARE}
    try:
        for key, value in BARE.items():
            setattr(*key, value)
        forget()
        bare = pdipc.Simulation(pdipc.Scene(**tables), "cpu")
        bare.step()
    finally:
        for key, value in kept.items():
            setattr(*key, value)
        forget()
    return proven, bare


def measure(tables: dict, steps: int) -> dict:
    both = simulations(tables)
    spent, contacts = np.zeros((steps, 2)), 0
    for step in range(steps):
        for k in (0, 1) if step % 2 else (1, 0):
            begun = time.process_time()
            contacts = max(contacts, both[k].step().barriers)
            spent[step, k] = time.process_time() - begun
    ratios = spent[:, 0] / spent[:, 1]
    rng = np.random.default_rng(0)
    chosen = rng.integers(steps, size=(2000, steps))
    resampled = spent[chosen, 0].sum(axis=1) / spent[chosen, 1].sum(axis=1)
    return {
        "steps": steps,
        "contacts, at most": contacts,
        "ms a step": round(1e3 * spent[:, 0].mean(), 3),
        "ms a step, bare": round(1e3 * spent[:, 1].mean(), 3),
        "cost, %": round(100 * (spent[:, 0].sum() / spent[:, 1].sum() - 1), 2),
        "95 % of it, %": [round(100 * (value - 1), 2) for value in np.percentile(resampled, [2.5, 97.5])],
        "median of steps, %": round(100 * (np.median(ratios) - 1), 2),
        "same bits": bool(np.array_equal(both[0].positions, both[1].positions)),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--scene", action="append", choices=SCENES)
    parser.add_argument("--output", type=Path, default=REPOSITORY / "benchmarks" / "results" / "proofs.json")
    options = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    ).stdout.strip()
    rows = {}
    for name in options.scene or SCENES:
        rows[name] = measure(SCENES[name](), options.steps)
        print(name, json.dumps(rows[name]), flush=True)
        result = {"machine": machine(), "load": os.getloadavg()[1], "commit": commit, "scenes": rows}
        options.output.write_text(json.dumps(result, indent=1) + "\n")
    return int(not all(row["same bits"] for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
