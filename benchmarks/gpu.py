"""One command for a machine with a GPU: checks CUDA against the CPU, then times it: `python benchmarks/gpu.py [-o FILE]`.

It needs a checkout and the package's own dependencies; the package need not be installed. It checks that solvers, CCD and whole steps give on CUDA what they give on the CPU, that
two runs give the same bits, and recorded steps those of single launches. Then it times the solvers over sizes (Fig. 8), CCD, the
benchmark scenes stage by stage, the authors' Armadillo (Table 1) where the optional data is there, and says how near the solver's
sweep comes to a measured copy. It ends within nine minutes: what no longer fits is left out, and the JSON says so. Each part is
a process of its own, and the JSON is written row by row: a part that breaks, hangs or spoils the GPU's context costs no other.

Exit code 0: all is well; 1: a check failed or a part broke; 2: no CUDA device. `--device cpu --small` tries the command itself.
"""

import argparse
import datetime
import functools
import json
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse.linalg as spla
import warp as wp

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY / folder) for folder in ("src", ".", "benchmarks")]

import pdipc  # noqa: E402
from pdipc.device.launch import Device  # noqa: E402
from pdipc.device.precision import Real, real  # noqa: E402
from pdipc.drive import Work, step  # noqa: E402
from pdipc.linear import make_solver  # noqa: E402
from pdipc.linear.solvers import SOLVERS  # noqa: E402
from pdipc.reproduce import _common, fig8  # noqa: E402
from pdipc.reproduce.armadillo import authors_scene  # noqa: E402
from pdipc.reproduce.fig7 import Run, loads, table_cloth  # noqa: E402
from tests.contact import hard_queries  # noqa: E402

BUDGET = 9 * 60 - 20  # s, with some left for the end
SIDES = (41, 71, 100, 183, 316, 577)  # cloths of 5K to 1M DOF
SOLVER_TOLERANCE = {"float64": 1e-8, "float32": 2e-3}  # relative distance to the direct solution, converged as far as it goes
STEP_TOLERANCE = 1e-3  # of the scene size, after STEPS steps: a step has converged at 1e-4 of it
STEPS = 12
CHECKED_SCENES = ("box_stack", "cloth_on_sphere", "thin_rod")


class Report:
    """What one part found: rows, and checks with the number measured and what it must not exceed; kept in a file as they come.

    budget: seconds that the part may take.
    """

    def __init__(self, budget: float, path: Path | None = None):
        self.begun, self.budget, self.path = time.perf_counter(), budget, path
        self.checks: list[dict] = []
        self.rows: list[dict] = []

    def left(self) -> float:
        """Seconds of the budget that are left."""
        return self.budget - (time.perf_counter() - self.begun)

    def check(self, name: str, found: float, limit: float) -> None:
        """A number that must not be larger than its limit; not a number fails."""
        passed = bool(found <= limit)
        self.checks.append({"check": name, "found": float(found), "limit": limit, "passed": passed})
        print(f"  {'ok  ' if passed else 'FAIL'} {name}: {found:.3g} (at most {limit:g})", flush=True)
        self._keep()

    def add(self, **row) -> None:
        """A row of the part's table."""
        self.rows.append(row)
        self._keep()

    def attempt(self, name: str, work: Callable[[], object]) -> None:
        """One case of several: what breaks it is noted, fails the report, and leaves the others their turn."""
        try:
            work()
        except Exception as error:
            traceback.print_exc()
            self.add(case=name, broken=f"{type(error).__name__}: {error}")

    def _keep(self) -> None:
        if self.path is not None:
            whole = self.path.with_suffix(".new")
            whole.write_text(json.dumps({"checks": self.checks, "rows": self.rows}))
            whole.replace(self.path)  # at no time is half a file there


def sound(parts: dict[str, dict]) -> bool:
    """Whether every check of every part passed and nothing broke."""
    broken = any("broken" in part or any("broken" in row for row in part["rows"]) for part in parts.values())
    return not broken and all(check["passed"] for part in parts.values() for check in part["checks"])


# --- CUDA gives what the CPU gives ---


def check_solvers(report: Report, place: Device, side: int) -> None:
    """Every solver against SciPy's direct solution of a cloth."""
    for precision, limit in SOLVER_TOLERANCE.items():
        system, mass, _ = table_cloth(side, place, real(precision))
        b = loads(system, mass)["sharp force"]
        free, expected = system.free, np.zeros_like(b)
        expected[free] = spla.spsolve(system.matrix[free][:, free].tocsc(), b[free])
        right = wp.array(b.astype(system.real.numpy), dtype=system.real.vec3, device=place.warp)
        for name in SOLVERS:

            def one(name=name, precision=precision, limit=limit, system=system, right=right, expected=expected) -> None:
                options = {"weight": 0.5} if name == "jacobi" else {}
                tolerance = 1e-11 if precision == "float64" else 1e-6
                solver = make_solver(name, system, tolerance=tolerance, max_iterations=40_000, **options)
                x = wp.zeros(system.count, dtype=system.real.vec3, device=place.warp)
                if solver.recordable and place.records_loops:
                    place.capture(lambda: solver.solve(x, right), solver).launch()
                else:
                    solver.solve(x, right)
                error = np.linalg.norm(x.numpy() - expected) / np.linalg.norm(expected)
                report.check(f"solver {name}, {precision}, error", error, limit)

            report.attempt(f"solver {name}, {precision}", one)


def check_ccd(report: Report, place: Device, count: int) -> None:
    """Times of impact of random and hard queries against the CPU's in double precision, which the tests prove to be early."""
    rng = np.random.default_rng(0)
    families = (hard_queries.random, hard_queries.small_motions, hard_queries.flat_sheets, hard_queries.parallel_edges)
    for kind in ("vertex_triangle", "edge_edge"):
        points = np.concatenate([family(rng, count) for family in families]).astype(np.float32).astype(np.float64)
        exact = pdipc.time_of_impact(points, kind, device="cpu")
        for precision in ("float64", "float32"):
            here = pdipc.time_of_impact(points, kind, precision=precision, device=place.name)
            same = pdipc.time_of_impact(points, kind, precision=precision, device="cpu")
            both = np.isfinite(here) & np.isfinite(same)
            report.check(
                f"CCD {kind}, {precision}, hit on one side only", np.mean(np.isfinite(here) != np.isfinite(same)), 1e-4
            )
            apart = np.abs(here[both] - same[both]).max(initial=0.0)
            report.check(f"CCD {kind}, {precision}, times apart", apart, 1e-3)
            # float32 may keep less of the gap than float64 does, but both keep some: a miss that the other stops late is a fault
            missed = np.isinf(here) & (exact < 0.9)
            report.check(f"CCD {kind}, {precision}, hits before 0.9 missed", np.count_nonzero(missed), 0)


def check_steps(report: Report, place: Device, names: tuple[str, ...], steps: int) -> None:
    """Bundled scenes: CUDA against the CPU, no intersection, the same bits again, recorded and launch by launch."""
    for name in names:
        for precision in SOLVER_TOLERANCE:
            label = f"{name}, {precision}, {steps} steps:"
            if report.left() < 15:
                report.add(case=label, skipped="no time left")
                continue
            report.attempt(label, functools.partial(check_scene, report, place, name, precision, steps, label))


def check_scene(report: Report, place: Device, name: str, precision: str, steps: int, label: str) -> None:
    """One scene of check_steps in one precision."""
    scene = pdipc.load_scene(name)
    # the same solver on both sides, whatever is the default of each
    tables = {"precision": precision, "linear_solver": "pcg"}
    scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update=tables)})
    model = pdipc.build(scene, "cpu")
    there = _positions(scene, "cpu", steps, recorded=True)
    here = _positions(scene, place.name, steps, recorded=True)
    report.check(f"{label} CUDA against CPU / size", np.abs(here - there).max() / model.assembly.scene_size, STEP_TOLERANCE)
    found = pdipc.find_intersections(here, model.triangles, model.assembly.obstacle)
    report.check(f"{label} intersections", len(found), 0)
    for recorded, told in ((True, "the second time"), (False, "unrecorded")):
        again = _positions(scene, place.name, steps, recorded)
        report.check(f"{label} bits that differ {told}", np.count_nonzero(here != again), 0)


def _positions(scene: pdipc.Scene, device: str, steps: int, recorded: bool) -> np.ndarray:
    model = pdipc.build(scene, device)
    work, state = Work(model, recorded=recorded), model.initial_state()
    for _ in range(steps):
        state = step(model, state, work).state
    return state.positions.numpy().astype(np.float64)


# --- times ---


def copy_bandwidth(place: Device, size: int) -> float:
    """GB/s, read and written, of copying `size` bytes on the device."""
    a, b = (wp.zeros(size // 4, dtype=wp.float32, device=place.warp) for _ in range(2))
    return 2 * size / _seconds(place, lambda: wp.copy(b, a)) / 1e9


def _seconds(place: Device, action: Callable[[], object], repeats: int = 9) -> float:
    """Median of `repeats` runs after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        wp.synchronize_device(place.warp)
        begin = time.perf_counter()
        action()
        wp.synchronize_device(place.warp)
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def time_solvers(report: Report, place: Device, sides: tuple[int, ...]) -> None:
    """Fig. 8, and the bandwidth that a sweep of each solver reaches: bytes of the matrix and of the vectors that it must touch."""
    precision = real("float32" if place.is_cuda else "float64")
    copied = copy_bandwidth(place, 2**28 if place.is_cuda else 2**24)
    report.add(**{"copy GB/s": copied})
    print(f"  copy: {copied:.0f} GB/s")
    for side in sides:
        dof = 3 * side * side
        if report.left() < 20 + 1.5e-4 * dof:  # setting up takes this long on the host
            report.add(dof=dof, skipped="no time left")
            continue
        report.attempt(f"{dof} DOF, sweeps", functools.partial(_time_sweeps, report, place, precision, side, copied))
        report.attempt(f"{dof} DOF, Fig. 8", functools.partial(_time_series, report, place, precision, side))


def _time_series(report: Report, place: Device, precision: Real, side: int) -> None:
    for dof, label, terms, relative, memory in fig8.measure(side, place, precision):
        report.add(**{"dof": dof, "variant": label, "terms/s": terms, "relative to Jacobi": relative, "bytes": memory})
        print(f"  {dof:9,} DOF  {label:34} {terms:12.0f} terms/s  {relative:5.2f} of Jacobi", flush=True)


def _time_sweeps(report: Report, place: Device, precision: Real, side: int, copied: float) -> None:
    system, mass, _ = table_cloth(side, place, precision)
    b = loads(system, mass)["gravity"]
    word = np.dtype(precision.numpy).itemsize
    for name in ("chebyshev", "pcg"):
        seconds = Run(system, b, name, {}).per_iteration()[1]
        entries, vertices = system.rows.entries, system.count
        # columns and values once; x, b, the last x and the new x; for PCG also the two vectors more that it keeps
        touched = entries * (4 + word) + vertices * 3 * word * (4 if name == "chebyshev" else 8)
        speed = touched / seconds / 1e9
        us = 1e6 * seconds
        report.add(**{"dof": 3 * vertices, "sweep of": name, "us": us, "GB/s": speed, "of copy": speed / copied})
        told = f"{us:9.1f} us  {speed:7.1f} GB/s, {speed / copied:.2f} of a copy"
        print(f"  {3 * vertices:9,} DOF  {name:34} {told}", flush=True)


def time_ccd(report: Report, place: Device, count: int) -> None:
    """Nanoseconds a query, with transfers."""
    rng = np.random.default_rng(1)
    for kind in ("vertex_triangle", "edge_edge"):
        for label, family in (("near misses", hard_queries.small_motions), ("random", hard_queries.random)):
            for precision in ("float32", "float64"):
                points = family(rng, count).astype(precision)
                query = functools.partial(pdipc.time_of_impact, points, kind, precision=precision, device=place.name)
                ns = 1e9 * _seconds(place, query, 5) / count
                row = {"kind": kind, "queries": label, "precision": precision, "ns a query, with transfers": ns}
                report.add(**row)
                print(f"  {kind:16} {label:12} {precision}  {ns:8.1f} ns a query, with transfers", flush=True)


def time_scene(report: Report, place: Device, scene: pdipc.Scene, name: str, steps: int, seconds: float) -> None:
    """Step times and stages; the witness looks at the last state."""
    simulation = pdipc.Simulation(scene, place.name)
    simulation.step()
    simulation.reset()
    results, times, begun = [], [], time.perf_counter()
    while len(results) < steps and time.perf_counter() - begun < min(seconds, report.left() - 15):
        start = time.perf_counter()
        results.append(simulation.step())
        times.append(1e3 * (time.perf_counter() - start))
    if not results:
        report.add(scene=name, skipped="no time left")
        return
    found = pdipc.find_intersections(simulation.positions, simulation.triangles, simulation.model.assembly.obstacle)
    report.check(f"{name}: intersections after {len(results)} steps", len(found), 0)
    stages = {key: statistics.fmean(r.milliseconds[key] for r in results) for key in results[0].milliseconds}
    row = {
        "scene": name,
        "steps": len(results),
        "asked": steps,
        "median ms": statistics.median(times),
        "mean ms": statistics.fmean(times),
        "max ms": max(times),
        "stages ms": stages,
        "outer": statistics.fmean(r.outer for r in results),
        "local_global": statistics.fmean(r.local_global for r in results),
        "linear_iterations": statistics.fmean(r.linear_iterations for r in results),
        "barriers": statistics.fmean(r.barriers for r in results),
        "unconverged": sum(not r.converged for r in results),
    }
    report.add(**row)
    told = " ".join(f"{key} {value:.2f}" for key, value in stages.items())
    print(
        f"  {name:26} {len(results):4} steps  median {row['median ms']:8.2f}  mean {row['mean ms']:8.2f} ms  [{told}]",
        flush=True,
    )


def time_scenes(report: Report, place: Device, names: tuple[str, ...], steps: int) -> None:
    """The scenes of benchmarks/simulation.py."""
    from simulation import SCENES, H

    for name in names:
        scene = pdipc.Scene(simulation={"time_step": H, "steps": steps}, **SCENES[name]())
        report.attempt(name, functools.partial(time_scene, report, place, scene, name, steps, 25.0))


def time_armadillo(report: Report, place: Device, steps: int) -> None:
    """Table 1's row; the paper has 43.1 ms a step and 19.4 to 112 FPS on an RTX 3090."""
    path = _common.data("paper_armadillo/placed.npz")
    if path is None:
        report.add(scene="paper_armadillo", skipped="the optional data is not there")
    else:
        time_scene(report, place, authors_scene(path), "paper_armadillo", steps, 90.0)


BENCHMARK_SCENES = ("block 10^3", "block 20^3", "squeezed block 10^3", "cloth 50x50", "cloth 100x100", "cloth 200x200")
# Name, the most seconds it may take, and what it does: whole and with --small.
PARTS: dict[str, tuple[float, Callable[[Report, Device], None], Callable[[Report, Device], None]]] = {
    "solvers against a direct solution": (100, lambda r, d: check_solvers(r, d, 24), lambda r, d: check_solvers(r, d, 10)),
    "CCD against the CPU": (60, lambda r, d: check_ccd(r, d, 100_000), lambda r, d: check_ccd(r, d, 200)),
    "steps against the CPU": (
        150,
        lambda r, d: check_steps(r, d, CHECKED_SCENES, STEPS),
        lambda r, d: check_steps(r, d, CHECKED_SCENES[:1], 2),
    ),
    "Table 1, Armadillo": (120, lambda r, d: time_armadillo(r, d, 200), lambda r, d: time_armadillo(r, d, 2)),
    "benchmark scenes": (
        180,
        lambda r, d: time_scenes(r, d, BENCHMARK_SCENES, 100),
        lambda r, d: time_scenes(r, d, BENCHMARK_SCENES[:1], 3),
    ),
    "solvers over sizes (Fig. 8)": (240, lambda r, d: time_solvers(r, d, SIDES), lambda r, d: time_solvers(r, d, (12,))),
    "CCD": (40, lambda r, d: time_ccd(r, d, 1_000_000), lambda r, d: time_ccd(r, d, 1000)),
}


def run_part(name: str, device: str, small: bool, seconds: float, path: Path) -> int:
    """One part, in this process."""
    report = Report(seconds, path)
    PARTS[name][2 if small else 1](report, Device(device))
    report._keep()
    return 0


def start_part(name: str, device: str, small: bool, seconds: float, path: Path) -> dict:
    """One part in a process of its own, which is ended when its time is over; what it found up to its end."""
    command = [sys.executable, __file__, "--part", name, "--device", device, "--seconds", str(seconds), "-o", str(path)]
    error = None
    try:
        code = subprocess.run([*command, *(["--small"] if small else [])], timeout=seconds + 10).returncode
        error = f"its process ended with code {code}" if code else None
    except subprocess.TimeoutExpired:
        error = f"it did not end within {seconds + 10:.0f} s"
    found = json.loads(path.read_text()) if path.exists() else {"checks": [], "rows": []}
    if error:
        print(f"  BROKEN {name}: {error}", flush=True)
        found["broken"] = error
    return found


def describe(place: Device) -> dict:
    """The machine and what ran on it."""
    found = {"device": place.warp.name, "host": platform.platform(), "warp": wp.config.version, "numpy": np.__version__}
    found["date"] = datetime.date.today().isoformat()
    if place.is_cuda:
        query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
        try:
            found["nvidia-smi"] = subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError) as error:
            found["nvidia-smi"] = f"did not answer: {error}"
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", help='absent: the first CUDA device; "cpu" only tries the command')
    parser.add_argument("--small", action="store_true", help="few and small cases, within a minute")
    parser.add_argument("-o", "--output", type=Path, help="absent: benchmarks/results/gpu-<machine>.json")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"some parts: {', '.join(PARTS)}")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=BUDGET, help=f"absent: {BUDGET}")
    options = parser.parse_args(arguments)
    wp.init()
    if options.device is None and not wp.is_cuda_available():
        print("no CUDA device was found; to try this command without one: --device cpu --small", file=sys.stderr)
        return 2
    device = options.device or "cuda:0"
    if options.part:
        return run_part(options.part, device, options.small, options.seconds, options.output)
    begun, place = time.perf_counter(), Device(device)
    machine = describe(place)
    print(", ".join(str(value) for value in machine.values()), flush=True)
    slug = re.sub(r"[^a-z0-9]+", "-", place.warp.name.lower()).strip("-")
    out = options.output or REPOSITORY / "benchmarks" / "results" / f"gpu-{slug}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    parts: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(options.only or PARTS):
            left = options.seconds - (time.perf_counter() - begun)
            print(f"{name}  [{left:.0f} s left]", flush=True)
            if left < 30:
                parts[name] = {"checks": [], "rows": [], "skipped": f"{left:.0f} s were left of {options.seconds:.0f}"}
            else:
                seconds = min(PARTS[name][0], left - 15)
                parts[name] = start_part(name, device, options.small, seconds, Path(folder) / f"{number}.json")
            seconds = time.perf_counter() - begun
            found = {"machine": machine, "small": options.small, "seconds": seconds, "ok": sound(parts), "parts": parts}
            out.write_text(json.dumps(found, indent=1))
    checks = [check for part in parts.values() for check in part["checks"]]
    failed = sum(not check["passed"] for check in checks)
    broken = [name for name, part in parts.items() if "broken" in part or any("broken" in row for row in part["rows"])]
    told = f"; broken: {', '.join(broken)}" if broken else ""
    print(f"{len(checks)} checks, {failed} failed{told}; {time.perf_counter() - begun:.0f} s; {out}")
    return 0 if sound(parts) else 1


if __name__ == "__main__":
    sys.exit(main())
