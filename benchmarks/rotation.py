"""Nearest rotation of a 3x3 matrix: constraints/rotation.py, Warp's svd3 and NumPy's batched SVD: `python benchmarks/rotation.py`.

One thread. Prints ns of CPU time per matrix (median and quartiles over repeats) and the largest error of an entry against a
float64 SVD, and writes benchmarks/results/rotation.json with the machine named.

Where two singular values nearly cancel, the smallest negative for inverted matrices, the nearest rotation turns by much when the
matrix moves by little. `rounded` is how far it goes when each entry moves by a unit roundoff: no method can do much better.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path

os.environ.update({name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")})

import numpy as np
import warp as wp
from simulation import machine

from pdipc.constraints import rotation
from pdipc.device.language import kernel
from pdipc.device.precision import real


def rotations(random: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3, 3): of a random axis and angle."""
    q, r = np.linalg.qr(random.standard_normal((count, 3, 3)))
    q *= np.sign(np.einsum("nii->ni", r))[:, None, :]
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    return q


def inputs(count: int) -> dict[str, np.ndarray]:
    """(count, 3, 3) float64 by name."""
    random = np.random.default_rng(1)
    u, v = rotations(random, count), rotations(random, count)

    def with_singular_values(low: float, high: float, last: tuple[float, float]) -> np.ndarray:
        s = random.uniform(low, high, (count, 3))
        s[:, 2] = random.uniform(*last, count)
        return (u * s[:, None, :]) @ v.transpose(0, 2, 1)

    return {
        "random": random.standard_normal((count, 3, 3)),
        "near rotation": u + 0.05 * random.standard_normal((count, 3, 3)),
        "inverted": with_singular_values(0.8, 1.2, (-0.6, -0.2)),
        "flat": with_singular_values(0.8, 1.2, (0.0, 0.0)),
    }


def by_numpy(matrices: np.ndarray) -> np.ndarray:
    """The nearest rotations by NumPy's SVD, in the precision of the matrices."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    return u @ vt


def warp_kernels(number) -> dict[str, wp.Kernel]:
    mat33 = number.mat33
    module = number.module(__name__)

    def make(name: str, function):
        @kernel(module, name)
        def run(matrices: wp.array(dtype=mat33), out: wp.array(dtype=mat33)):
            i = wp.tid()
            out[i] = function(matrices[i])

        return run

    return {
        "pdipc": make("pdipc_nearest", rotation.nearest_rotation),
        "wp.svd3": make("svd3_nearest", rotation.rotation_by_svd),
    }


def measure(precision: str, count: int, repeats: int) -> list[dict]:
    number = real(precision)
    methods = {}
    for name, run in warp_kernels(number).items():

        def by_warp(matrices: wp.array, out: wp.array, run=run) -> np.ndarray:
            wp.launch(run, count, inputs=[matrices, out], device="cpu")
            return out.numpy()

        methods[name] = by_warp
    rows = []
    for kind, exact in inputs(count).items():
        rounded = exact.astype(number.numpy)
        expected = by_numpy(rounded.astype(np.float64))
        moved = rounded * (1 + number.unit_roundoff * np.random.default_rng(2).choice([-1.0, 1.0], rounded.shape))
        unavoidable = float(np.abs(by_numpy(moved) - expected).max())
        given = wp.array(rounded, dtype=number.mat33, device="cpu")
        out = wp.empty(count, dtype=number.mat33, device="cpu")
        for name in (*methods, "numpy"):
            times = []
            for _ in range(repeats + 1):  # the first one compiles
                start = time.process_time()
                found = by_numpy(rounded) if name == "numpy" else methods[name](given, out)
                times.append(1e9 * (time.process_time() - start) / count)
            low, middle, high = statistics.quantiles(times[1:], n=4)
            error = float(np.abs(found - expected).max())
            row = {"precision": precision, "matrices": kind, "method": name, "ns": middle, "quartiles_ns": [low, high]}
            rows.append({**row, "largest_error": error, "rounded": unavoidable})
            print(
                f"{precision:9} {kind:14} {name:8} {middle:9.1f} ns ({low:.1f} to {high:.1f})  "
                f"error {error:.1e}, rounded {unavoidable:.1e}",
                flush=True,
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="Matrices of a batch.")
    parser.add_argument("--repeats", type=int, default=11)
    options = parser.parse_args()
    rows = [row for precision in ("float32", "float64") for row in measure(precision, options.count, options.repeats)]
    report = {"machine": f"{machine()}, one thread", "load_average": os.getloadavg()[0], "count": options.count, "rows": rows}
    out = Path(__file__).parent / "results" / "rotation.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
