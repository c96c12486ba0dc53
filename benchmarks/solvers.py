"""Time of the global solve to a relative error of 1e-3, for every solver and for what a user would take instead.

    python benchmarks/solvers.py [--sizes 10000 30000 100000] [--only NAME ...] [--threads N]

Systems: square cloths and blocks of tetrahedra held at one side, soft and stiff, at a step of 1/100 s. Loads: "rough", a
random force at each vertex, and "smooth", gravity. All start from zero. Times are the best of five; setting up is timed apart.
A solver that has not arrived after LIMIT seconds is listed without a time, and so is a direct solution of a large block, whose
factorization takes minutes. Writes benchmarks/results/solvers.json.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import warp as wp

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "tests"))

from linear import systems  # noqa: E402

from pdipc.linear import System, make_solver  # noqa: E402
from pdipc.parallel import Device  # noqa: E402
from pdipc.precision import real  # noqa: E402

GOAL = 1e-3
LIMIT = 1.0
DIRECT_BLOCK = 12_000  # vertices of the largest block of tetrahedra that is factorized
OURS = {
    "pcg": {},
    "two-level": {},
    "chebyshev": {},
    "a-jacobi": {"order": 2},
    "a-jacobi l=3": {"order": 3, "polynomial": "chebyshev", "memory_limit": 2**30},
    "matrix-powers": {"order": 2},
    "jacobi": {},
    "gauss-seidel": {},
    "sor": {},
}


def machine() -> str:
    """The processor's name and the number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0] if models else name
    return f"{name}, {len(os.sched_getaffinity(0))} cores"


def cases(size: int) -> dict[str, tuple[np.ndarray, sp.csr_matrix]]:
    """Systems of about `size` vertices: which of them are free, and the matrix."""
    cloth = systems.cloth_grid(round(size**0.5))
    block = systems.tet_grid(round(size ** (1 / 3)) - 1, jitter=0.3)
    return {
        "soft cloth": (cloth[0][:, 0] > 0.0, systems.cloth_matrix(*cloth, young=1e4)),
        "stiff cloth": (cloth[0][:, 0] > 0.0, systems.cloth_matrix(*cloth, young=1e6)),
        "soft tets": (block[0][:, 0] > 0.0, systems.tet_matrix(*block, young=1e5)),
        "stiff tets": (block[0][:, 0] > 0.0, systems.tet_matrix(*block, young=1e7)),
    }


def loads(matrix: sp.csr_matrix, free: np.ndarray) -> dict[str, np.ndarray]:
    """Right-hand sides, (n, 3)."""
    mass = np.asarray(matrix.sum(axis=1)).ravel()  # the rest of A vanishes on translations
    rough = np.random.default_rng(0).standard_normal((len(free), 3)) * matrix.diagonal().mean()
    return {"rough": free[:, None] * rough, "smooth": (free * mass)[:, None] * np.array([0.1, 0.2, -9.81])}


def time_to_goal(run: Callable[[int], np.ndarray], expected: np.ndarray) -> tuple[int, float] | None:
    """Iterations after which `run(iterations)` is within GOAL of `expected`, and its time in seconds; None at LIMIT."""
    norm = np.linalg.norm(expected)

    def arrived(count: int) -> bool:
        return bool(np.linalg.norm(run(count) - expected) <= GOAL * norm)

    low, high = 0, 1
    while True:
        begin = time.perf_counter()
        if arrived(high):
            break
        if time.perf_counter() - begin > LIMIT / 2 or high > 30_000:
            return None
        low, high = high, 2 * high
    while high - low > max(1, high // 10):
        middle = (low + high) // 2
        low, high = (low, middle) if arrived(middle) else (middle, high)
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        run(high)
        times.append(time.perf_counter() - begin)
    return high, min(times)


def ours(name: str, options: dict, system: System, b: np.ndarray) -> tuple[float, Callable[[int], np.ndarray]]:
    """Time to set up a solver, and what runs it for a number of iterations."""
    begin = time.perf_counter()
    solver = make_solver(name.split()[0], system, tolerance=0.0, max_iterations=65_536, **options)
    setup = time.perf_counter() - begin
    x = wp.zeros(system.count, dtype=system.real.vec3, device=system.device.warp)
    right = wp.array(b.astype(system.real.numpy), dtype=system.real.vec3, device=system.device.warp)
    graphs = {}

    def run(count: int) -> np.ndarray:
        if count not in graphs:
            solver.limits[1] = count * getattr(solver, "order", 1) if name == "matrix-powers" else count
            graphs[count] = system.device.capture(lambda: solver.solve(x, right))
        x.zero_()
        graphs[count].launch()
        return x.numpy()

    return setup, run


def scipy_cg(matrix: sp.csr_matrix, b: np.ndarray, preconditioner=None) -> Callable[[int], np.ndarray]:
    """SciPy's conjugate gradients, coordinate by coordinate; Jacobi preconditioner by default."""
    inverse = 1.0 / matrix.diagonal()
    m = preconditioner or spla.LinearOperator(matrix.shape, matvec=lambda r: inverse * r, dtype=np.float64)

    def run(count: int) -> np.ndarray:
        return np.stack([spla.cg(matrix, b[:, c], rtol=0.0, atol=0.0, maxiter=count, M=m)[0] for c in range(3)], axis=1)

    return run


def timed(call: Callable[[], object]) -> tuple[float, object]:
    """Seconds that a call took, and its result."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def measure(case: str, matrix: sp.csr_matrix, free: np.ndarray, device: Device, only: list[str] | None) -> list[dict]:
    """All solvers on one system."""
    rows = []
    n = matrix.shape[0]
    system = System(device, real("float64"), matrix, free)
    interval_time, (low, high) = timed(lambda: system.interval)
    reference = make_solver("two-level", system, tolerance=1e-13, max_iterations=5000)
    inner = sp.csr_matrix(matrix[free][:, free])
    factorizable = "cloth" in case or n <= DIRECT_BLOCK
    spsolve_time = None
    for load, b in loads(matrix, free).items():
        right = wp.array(b, dtype=wp.vec3d, device=device.warp)
        x = wp.zeros(n, dtype=wp.vec3d, device=device.warp)
        reference.solve(x, right)
        expected = x.numpy()

        def add(name: str, setup: float, found: tuple[int, float] | None) -> None:
            iterations, seconds = found or (None, None)
            rows.append({"load": load, "solver": name, "setup": setup, "iterations": iterations, "seconds": seconds})
            reached = "-" if found is None else f"{1e3 * found[1]:9.2f} ms {found[0]:6} iterations"
            print(f"    {load:7}{name:20}{reached:32}set up in {1e3 * setup:8.1f} ms", flush=True)

        for name, options in OURS.items():
            if only and name not in only:
                continue
            try:
                setup, run = ours(name, options, system, b)
            except ValueError as refusal:
                print(f"    {load:7}{name:20}{refusal}")
                continue
            if name not in ("pcg", "two-level", "gauss-seidel"):
                setup += interval_time
            add(name, setup, time_to_goal(run, expected))
        if only:
            continue
        add("scipy cg", 0.0, time_to_goal(scipy_cg(inner, b[free]), expected[free]))
        if factorizable:
            if spsolve_time is None:
                spsolve_time = timed(lambda: spla.spsolve(inner.tocsc(), b[free]))[0]
            add("scipy spsolve", 0.0, (1, spsolve_time))
            setup, direct = timed(lambda: make_solver("direct", system))
            add("direct", setup, (1, min(timed(lambda: direct.solve(x, right))[0] for _ in range(5))))
        try:
            import pyamg
        except ImportError:
            continue
        setup, amg = timed(lambda: pyamg.smoothed_aggregation_solver(inner))
        add("pyamg cg", setup, time_to_goal(scipy_cg(inner, b[free], amg.aspreconditioner()), expected[free]))
    for row in rows:
        row.update(vertices=n, entries=int(matrix.nnz), interval=[low, high])
    return rows


def growth(rows: list[dict]) -> dict[str, float]:
    """Exponent of the time's growth with the number of vertices, for each case, load and solver measured at several sizes."""
    exponents = {}
    for key in sorted({(row["case"], row["load"], row["solver"]) for row in rows}):
        points = [(r["vertices"], r["seconds"]) for r in rows if (r["case"], r["load"], r["solver"]) == key and r["seconds"]]
        if len(points) > 1:
            exponents[" / ".join(key)] = float(np.polyfit(*np.log(np.array(points)).T, 1)[0])
    return exponents


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[10_000, 30_000, 100_000])
    parser.add_argument("--cases", nargs="+", default=None)
    parser.add_argument("--only", nargs="+", default=None)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("-o", "--output", type=Path, default=REPOSITORY / "benchmarks" / "results" / "solvers.json")
    arguments = parser.parse_args()
    device = Device("cpu", arguments.threads)
    rows = []
    for size in arguments.sizes:
        for name, (free, matrix) in cases(size).items():
            if arguments.cases and name not in arguments.cases:
                continue
            print(f"{name}, {matrix.shape[0]} vertices", flush=True)
            rows += [{"case": name, **row} for row in measure(name, matrix, free, device, arguments.only)]
    result = {"machine": machine(), "threads": device.threads, "goal": GOAL, "rows": rows, "growth": growth(rows)}
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
