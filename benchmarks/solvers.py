"""Time of the global solve to a relative error of 1e-3, for every solver and for what a user would take instead.

    python benchmarks/solvers.py [--sizes 10000 30000 100000] [--only NAME ...] [--threads N] [--minutes 11] [-o FILE]

Systems: square cloths and blocks of tetrahedra held at one side, soft and stiff, at a step of 1/100 s. Loads: "rough", a
random force at each vertex, and "smooth", gravity. All start from zero. Times are medians with quartiles; setting up is timed
apart. Beside ours: SciPy's cg with the same preconditioner as our pcg (the diagonal), spsolve, and pyamg where it is installed.
A solver that has not arrived after LIMIT seconds is listed without a time; a direct solution of a large block, whose
factorization takes minutes, is not tried. What no longer fits into --minutes is listed as skipped. After each solver
benchmarks/results/solvers.json is written anew, so that a run that was stopped leaves what it has.
"""

import argparse
import functools
import itertools
import json
import os
import platform
import statistics
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

from pdipc.device.launch import Device  # noqa: E402
from pdipc.device.precision import real  # noqa: E402
from pdipc.linear import System, make_solver  # noqa: E402
from pdipc.linear.paper.powers import MatrixPowers  # noqa: E402
from pdipc.model import DEFAULT_SOLVER  # noqa: E402

GOAL = 1e-3
LIMIT = 2.0
DEFAULT = DEFAULT_SOLVER["cpu"]["barrier"]
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


# What matters most comes first on every system, so that a time limit cuts the rest.
FIRST = ("pcg", "two-level", "scipy cg", "pyamg cg", "direct", "scipy spsolve", "chebyshev", "a-jacobi")
REST = tuple(name for name in OURS if name not in FIRST)


def machine() -> str:
    """The processor's name and the number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0] if models else name
    return f"{name}, {len(os.sched_getaffinity(0))} cores"


CASES = {"soft cloth": 1e4, "stiff cloth": 1e6, "soft tets": 1e5, "stiff tets": 1e7}  # Young's modulus, Pa


def assembled(case: str, size: int) -> tuple[np.ndarray, sp.csr_matrix]:
    """A system of about `size` vertices: which of them are free, and the matrix."""
    if "cloth" in case:
        x, triangles = systems.cloth_grid(round(size**0.5))
        matrix = systems.cloth_matrix(x, triangles, young=CASES[case])
    else:
        x, tets = systems.tet_grid(round(size ** (1 / 3)) - 1, jitter=0.3)
        matrix = systems.tet_matrix(x, tets, young=CASES[case])
    return x[:, 0] > 0.0, matrix


def loads(matrix: sp.csr_matrix, free: np.ndarray) -> dict[str, np.ndarray]:
    """Right-hand sides, (n, 3)."""
    mass = np.asarray(matrix.sum(axis=1)).ravel()  # the rest of A vanishes on translations
    rough = np.random.default_rng(0).standard_normal((len(free), 3)) * matrix.diagonal().mean()
    return {"rough": free[:, None] * rough, "smooth": (free * mass)[:, None] * np.array([0.1, 0.2, -9.81])}


def time_to_goal(run: Callable[[int], np.ndarray], expected: np.ndarray) -> tuple[int, list[float]] | None:
    """Iterations after which `run(iterations)` is within GOAL of `expected`, and times in seconds; None at LIMIT.

    The number of iterations is the least to within a tenth.
    """
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
    return high, repeated(lambda: run(high))


def repeated(call: Callable[[], object]) -> list[float]:
    """Seconds of each of at least 3 and at most 15 calls, in about half a second."""
    times, begun = [], time.perf_counter()
    while len(times) < 3 or (len(times) < 15 and time.perf_counter() - begun < 0.5):
        times.append(timed(call)[0])
    return times


def timed(call: Callable[[], object]) -> tuple[float, object]:
    """Seconds that a call took, and its result."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def ours(solver, system: System, b: np.ndarray) -> Callable[[int], np.ndarray]:
    """What runs a solver of ours for a number of iterations."""
    x = wp.zeros(system.count, dtype=system.real.vec3, device=system.device.warp)
    right = wp.array(b.astype(system.real.numpy), dtype=system.real.vec3, device=system.device.warp)
    graphs = {}

    def run(count: int) -> np.ndarray:
        if count not in graphs:
            solver.max_iterations = count * solver.order if isinstance(solver, MatrixPowers) else count
            graphs[count] = system.device.capture(lambda: solver.solve(x, right))
        x.zero_()
        graphs[count].launch()
        return x.numpy()

    return run


def scipy_cg(matrix: sp.csr_matrix, b: np.ndarray, preconditioner=None) -> Callable[[int], np.ndarray]:
    """SciPy's conjugate gradients, coordinate by coordinate; Jacobi preconditioner by default."""
    inverse = 1.0 / matrix.diagonal()
    m = preconditioner or spla.LinearOperator(matrix.shape, matvec=lambda r: inverse * r, dtype=np.float64)

    def run(count: int) -> np.ndarray:
        return np.stack([spla.cg(matrix, b[:, c], rtol=0.0, atol=0.0, maxiter=count, M=m)[0] for c in range(3)], axis=1)

    return run


class Table:
    """The rows found so far, and the file that holds them."""

    def __init__(self, path: Path, minutes: float, **header):
        self.path, self.header, self.rows = path, header, []
        self.begun, self.deadline = time.perf_counter(), time.perf_counter() + 60.0 * minutes

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return time.perf_counter() > self.deadline

    def add(self, setup: float, found: tuple[int, list[float]] | None, **where) -> None:
        """One solver on one system and load; `found` as `time_to_goal` returns it."""
        row = {**where, "setup": setup, "iterations": None, "seconds": None}
        reached = "-"
        if found is not None:
            quartiles = statistics.quantiles(found[1], n=4) if len(found[1]) > 1 else 3 * found[1]
            row |= {"iterations": found[0], "seconds": statistics.median(found[1])}
            row |= {"quartiles": [quartiles[0], quartiles[2]], "repeats": len(found[1])}
            reached = (
                f"{1e3 * row['seconds']:9.2f} ms ({1e3 * quartiles[0]:.2f} to {1e3 * quartiles[2]:.2f}) {found[0]:6} iterations"
            )
        print(f"    {row['load']:7}{row['solver']:16}{reached:56}set up in {1e3 * setup:8.1f} ms", flush=True)
        self._keep(row)

    def skip(self, why: str, **where) -> None:
        """A solver that was not measured."""
        print(f"    {where['solver']:23}{why}", flush=True)
        self._keep({**where, "skipped": why})

    def _keep(self, row: dict) -> None:
        self.rows.append(row)
        measured = [row for row in self.rows if row.get("seconds")]
        found = {**self.header, "load_average_now": os.getloadavg()[0], "seconds": time.perf_counter() - self.begun}
        found |= {"growth": growth(measured), "aims": aims(measured), "rows": self.rows}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(found, indent=1) + "\n")


def measure(table: Table, case: str, matrix: sp.csr_matrix, free: np.ndarray, device: Device, only: list[str]) -> None:
    """The solvers named in `only` on one system."""
    n = matrix.shape[0]
    system = System(device, real("float64"), matrix, free)
    interval_time, _ = timed(lambda: system.interval)
    where = {"case": case, "vertices": n, "entries": int(matrix.nnz), "interval": list(system.interval)}
    reference = make_solver("two-level", system, tolerance=1e-13, max_iterations=5000)
    inner = sp.csr_matrix(matrix[free][:, free])
    expected, rights = {}, loads(matrix, free)
    x = wp.zeros(n, dtype=wp.vec3d, device=device.warp)
    for load, b in rights.items():
        x.zero_()
        reference.solve(x, wp.array(b, dtype=wp.vec3d, device=device.warp))
        expected[load] = x.numpy().copy()

    def compare(name: str, make: Callable[[], object], run: Callable[[object, np.ndarray], Callable], part: np.ndarray) -> None:
        """Sets a solver up once and measures it for each load; `part`: the vertices that its solution has."""
        if name not in only:
            return
        if table.late:
            table.skip("no time left", solver=name, **where)
            return
        try:
            setup, solver = timed(make)
        except ValueError as refusal:
            table.skip(str(refusal), solver=name, **where)
            return
        for load, b in rights.items():
            found = time_to_goal(run(solver, b), expected[load][part])
            more = 0.0 if name in ("pcg", "two-level", "gauss-seidel") or "scipy" in name or "amg" in name else interval_time
            table.add(setup + more, found, load=load, solver=name, **where)

    every = np.ones(n, dtype=bool)
    for name, options in OURS.items():
        build = functools.partial(make_solver, name.split()[0], system, tolerance=0.0, max_iterations=65_536, **options)
        compare(name, build, lambda solver, b: ours(solver, system, b), every)
    compare("scipy cg", lambda: None, lambda _, b: scipy_cg(inner, b[free]), free)
    try:
        import pyamg
    except ImportError:
        if "pyamg cg" in only:
            table.skip("pyamg is not installed", solver="pyamg cg", **where)
    else:
        make = lambda: pyamg.smoothed_aggregation_solver(inner).aspreconditioner()  # noqa: E731
        compare("pyamg cg", make, lambda amg, b: scipy_cg(inner, b[free], amg), free)
    for name in ("direct", "scipy spsolve"):
        if name not in only:
            continue
        if table.late or ("tets" in case and n > DIRECT_BLOCK):
            table.skip("no time left" if table.late else "its factorization takes minutes", solver=name, **where)
        elif name == "direct":
            setup, direct = timed(lambda: make_solver("direct", system))
            for load, b in rights.items():
                right = wp.array(b, dtype=wp.vec3d, device=device.warp)
                times = repeated(lambda: direct.solve(x, right))
                table.add(setup, (1, times), load=load, solver=name, **where)
        else:  # it factorizes each time, whatever the load
            seconds = timed(lambda: spla.spsolve(inner.tocsc(), rights["rough"][free]))[0]
            table.add(0.0, (1, [seconds]), load="rough", solver=name, **where)


def growth(rows: list[dict]) -> dict[str, float]:
    """Exponent of the time's growth with the number of vertices, for each case, load and solver measured at several sizes."""
    exponents = {}
    for key in sorted({(row["case"], row["load"], row["solver"]) for row in rows}):
        points = [(r["vertices"], r["seconds"]) for r in rows if (r["case"], r["load"], r["solver"]) == key]
        if len(points) > 1:
            exponents[" / ".join(key)] = float(np.polyfit(*np.log(np.array(points)).T, 1)[0])
    return exponents


def aims(rows: list[dict]) -> list[dict]:
    """For each case, size and load: SciPy's cg over our pcg (aim: 3), and the default over the fastest of all (aim: 1.2)."""
    found = []
    for key in sorted({(row["case"], row["vertices"], row["load"]) for row in rows}):
        times = {r["solver"]: r["seconds"] for r in rows if (r["case"], r["vertices"], r["load"]) == key}
        entry = dict(zip(("case", "vertices", "load"), key, strict=True))
        if {"pcg", "scipy cg"} <= times.keys():
            entry["scipy cg / pcg"] = times["scipy cg"] / times["pcg"]
        if DEFAULT in times:
            fastest = min(times, key=times.__getitem__)
            entry |= {"default / fastest": times[DEFAULT] / times[fastest], "fastest": fastest}
        found.append(entry)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[10_000, 30_000, 100_000])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--only", nargs="+", choices=FIRST + REST, metavar="NAME", help=", ".join(FIRST + REST))
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--minutes", type=float, default=11.0, help="no solver is begun later than this")
    parser.add_argument("-o", "--output", type=Path, default=REPOSITORY / "benchmarks" / "results" / "solvers.json")
    arguments = parser.parse_args()
    device = Device("cpu", arguments.threads)
    header = {"machine": machine(), "threads": device.threads, "load_average": os.getloadavg()[0], "goal": GOAL}
    table = Table(arguments.output, arguments.minutes, **header)
    for group, size, case in itertools.product((FIRST, REST), arguments.sizes, arguments.cases):
        wanted = [name for name in group if not arguments.only or name in arguments.only]
        if table.late:
            for name in wanted:
                table.skip("no time left", solver=name, case=case, size=size)
        elif wanted:
            free, matrix = assembled(case, size)
            print(f"{case}, {matrix.shape[0]} vertices", flush=True)
            measure(table, case, matrix, free, device, wanted)
    for entry in aims([row for row in table.rows if row.get("seconds")]):
        told = ", ".join(f"{key} {value:.2f}" if isinstance(value, float) else f"{key} {value}" for key, value in entry.items())
        print(told)
    print(f"{time.perf_counter() - table.begun:.0f} s; {arguments.output}")


if __name__ == "__main__":
    main()
