"""One command for a machine with a GPU: checks CUDA against the CPU, then times it: `python benchmarks/gpu.py [-o FILE]`.

It needs a checkout and the package's own dependencies. It checks that solvers, CCD and whole steps give on CUDA what they give on the CPU, that
two runs give the same bits, and recorded steps those of single launches. Then it times the solvers over sizes (Fig. 8), CCD, the
benchmark scenes stage by stage, the authors' Armadillo (Table 1) where the optional data is there, and says how near the solver's
sweep comes to a measured copy. It ends within nine minutes: what no longer fits is left out, and the JSON says so.

Exit code 0: all is well; 1: a check failed or a part broke; 2: no CUDA device. `--device cpu --small` tries the command itself.
"""

import argparse
import datetime
import json
import platform
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse.linalg as spla
import warp as wp

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "benchmarks")]

import pdipc  # noqa: E402
from pdipc.linear import make_solver  # noqa: E402
from pdipc.linear.solvers import SOLVERS  # noqa: E402
from pdipc.parallel import Device  # noqa: E402
from pdipc.precision import real  # noqa: E402
from pdipc.reproduce import _common, fig8  # noqa: E402
from pdipc.reproduce.armadillo import authors_scene  # noqa: E402
from pdipc.reproduce.fig7 import Run, loads, table_cloth  # noqa: E402
from pdipc.step import Work, step  # noqa: E402
from tests.contact import hard_queries  # noqa: E402

BUDGET = 9 * 60 - 20  # s, with some left for the end
SIDES = (41, 71, 100, 183, 316, 577)  # cloths of 5K to 1M DOF
SOLVER_TOLERANCE = {"float64": 1e-8, "float32": 2e-3}  # relative distance to the direct solution, converged as far as it goes
STEP_TOLERANCE = 1e-3  # of the scene size, after STEPS steps: a step has converged at 1e-4 of it
STEPS = 12
CHECKED_SCENES = ("box_stack", "cloth_on_sphere", "thin_rod")


class Report:
    """What was found: parts by name, each with rows; checks with the number measured and what it must not exceed."""

    def __init__(self, budget: float):
        self.begun, self.budget = time.perf_counter(), budget
        self.checks: list[dict] = []
        self.parts: dict[str, object] = {}

    def left(self) -> float:
        """Seconds of the budget that are left."""
        return self.budget - (time.perf_counter() - self.begun)

    def check(self, name: str, found: float, limit: float) -> None:
        """A number that must not be larger than its limit; not a number fails."""
        passed = bool(found <= limit)
        self.checks.append({"check": name, "found": float(found), "limit": limit, "passed": passed})
        print(f"  {'ok  ' if passed else 'FAIL'} {name}: {found:.3g} (at most {limit:g})", flush=True)

    def part(self, name: str, needs: float, run: Callable[[], object]) -> None:
        """Runs a part that takes about `needs` seconds, if they are left; what breaks it is kept."""
        if self.left() < needs:
            self.parts[name] = {"skipped": f"{self.left():.0f} s were left of {self.budget:.0f}"}
            print(f"{name}: skipped, {self.left():.0f} s left", flush=True)
            return
        print(f"{name}  [{self.left():.0f} s left]", flush=True)
        try:
            self.parts[name] = run()
        except Exception as error:
            self.parts[name] = {"broken": f"{type(error).__name__}: {error}"}
            print(f"  BROKEN {type(error).__name__}: {error}", flush=True)

    @property
    def ok(self) -> bool:
        """Whether every check passed and no part broke."""
        broken = any(isinstance(part, dict) and "broken" in part for part in self.parts.values())
        return not broken and all(check["passed"] for check in self.checks)


# --- CUDA gives what the CPU gives ---


def check_solvers(report: Report, place: Device, side: int) -> None:
    """Every solver against SciPy's direct solution of a cloth."""
    for precision, limit in SOLVER_TOLERANCE.items():
        system, mass, _ = table_cloth(side, place, real(precision))
        b = loads(system, mass)["sharp force"]
        free, expected = system.free, np.zeros_like(b)
        expected[free] = spla.spsolve(system.matrix[free][:, free].tocsc(), b[free])
        for name in SOLVERS:
            options = {"weight": 0.5} if name == "jacobi" else {}
            tolerance = 1e-11 if precision == "float64" else 1e-6
            solver = make_solver(name, system, tolerance=tolerance, max_iterations=40_000, **options)
            x = wp.zeros(system.count, dtype=system.real.vec3, device=place.warp)
            solver.solve(x, wp.array(b.astype(system.real.numpy), dtype=system.real.vec3, device=place.warp))
            error = np.linalg.norm(x.numpy() - expected) / np.linalg.norm(expected)
            report.check(f"solver {name}, {precision}, error", error, limit)


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
            scene = pdipc.load_scene(name)
            scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"precision": precision})})
            paths = {}
            for label, device, recorded in (("cpu", "cpu", True), ("here", place.name, True), ("again", place.name, True)):
                paths[label] = _positions(scene, device, steps, recorded)
            paths["launched"] = _positions(scene, place.name, steps, recorded=False)
            model = pdipc.build(scene, "cpu")
            size = model.assembly.scene_size
            label = f"{name}, {precision}, {steps} steps:"
            report.check(f"{label} CUDA against CPU / size", np.abs(paths["here"] - paths["cpu"]).max() / size, STEP_TOLERANCE)
            found = pdipc.find_intersections(paths["here"], model.triangles, model.assembly.obstacle)
            report.check(f"{label} intersections", len(found), 0)
            report.check(f"{label} bits that differ the second time", np.count_nonzero(paths["here"] != paths["again"]), 0)
            report.check(f"{label} bits that differ unrecorded", np.count_nonzero(paths["here"] != paths["launched"]), 0)


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


def time_solvers(report: Report, place: Device, sides: tuple[int, ...]) -> list[dict]:
    """Fig. 8, and the bandwidth that a sweep of each solver reaches: bytes of the matrix and of the vectors that it must touch."""
    precision = real("float32" if place.is_cuda else "float64")
    copied, rows = copy_bandwidth(place, 2**28 if place.is_cuda else 2**24), []
    print(f"  copy: {copied:.0f} GB/s")
    for side in sides:
        if report.left() < 60:
            rows.append({"dof": 3 * side * side, "skipped": "no time left"})
            continue
        for dof, label, terms, relative, memory in fig8.measure(side, place, precision):
            rows.append({"dof": dof, "variant": label, "terms/s": terms, "relative to Jacobi": relative, "bytes": memory})
            print(f"  {dof:9,} DOF  {label:34} {terms:12.0f} terms/s  {relative:5.2f} of Jacobi", flush=True)
        system, mass, _ = table_cloth(side, place, precision)
        b = loads(system, mass)["gravity"]
        word = np.dtype(precision.numpy).itemsize
        for name in ("chebyshev", "pcg"):
            seconds = Run(system, b, name, {}).per_iteration()[1]
            entries, vertices = system.rows.entries, system.count
            # columns and values once; x, b, the last x and the new x; for PCG also the two vectors more that it keeps
            touched = entries * (4 + word) + vertices * 3 * word * (4 if name == "chebyshev" else 8)
            speed = touched / seconds / 1e9
            row = {"dof": 3 * vertices, "sweep of": name, "us": 1e6 * seconds, "GB/s": speed, "of copy": speed / copied}
            rows.append(row)
            print(
                f"  {row['dof']:9,} DOF  {name:34} {row['us']:9.1f} us  {speed:7.1f} GB/s, {speed / copied:.2f} of a copy",
                flush=True,
            )
    return [{"copy GB/s": copied}, *rows]


def time_ccd(place: Device, count: int) -> list[dict]:
    """Nanoseconds a query, kernel and transfers, and of the kernel alone by the difference of two sizes."""
    rng, rows = np.random.default_rng(1), []
    for kind in ("vertex_triangle", "edge_edge"):
        for label, family in (("near misses", hard_queries.small_motions), ("random", hard_queries.random)):
            for precision in ("float32", "float64"):
                points = family(rng, count).astype(precision)
                seconds = _seconds(
                    place, lambda p=points, k=kind, w=precision: pdipc.time_of_impact(p, k, precision=w, device=place.name), 5
                )
                rows.append(
                    {
                        "kind": kind,
                        "queries": label,
                        "precision": precision,
                        "ns a query, with transfers": 1e9 * seconds / count,
                    }
                )
                print(
                    f"  {kind:16} {label:12} {precision}  {1e9 * seconds / count:8.1f} ns a query, with transfers", flush=True
                )
    return rows


def time_scene(report: Report, place: Device, scene: pdipc.Scene, name: str, steps: int, seconds: float) -> dict:
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
        return {"scene": name, "skipped": "no time left"}
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
    told = " ".join(f"{key} {value:.2f}" for key, value in stages.items())
    print(
        f"  {name:26} {len(results):4} steps  median {row['median ms']:8.2f}  mean {row['mean ms']:8.2f} ms  [{told}]",
        flush=True,
    )
    return row


def time_scenes(report: Report, place: Device, names: list[str], steps: int) -> list[dict]:
    """The scenes of benchmarks/simulation.py."""
    from simulation import SCENES, H

    rows = []
    for name in names:
        scene = pdipc.Scene(simulation={"time_step": H, "steps": steps}, **SCENES[name]())
        rows.append(time_scene(report, place, scene, name, steps, 25.0))
    return rows


def time_armadillo(report: Report, place: Device, steps: int) -> dict:
    """Table 1's row; the paper has 43.1 ms a step and 19.4 to 112 FPS on an RTX 3090."""
    path = _common.data("paper_armadillo/placed.npz")
    if path is None:
        return {"skipped": "the optional data is not there"}
    return time_scene(report, place, authors_scene(path), "paper_armadillo", steps, 120.0)


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
    options = parser.parse_args(arguments)
    wp.init()
    if options.device is None and not wp.is_cuda_available():
        print("no CUDA device was found; to try this command without one: --device cpu --small", file=sys.stderr)
        return 2
    place, small = Device(options.device or "cuda:0"), options.small
    report, machine = Report(BUDGET), describe(place)
    print(", ".join(str(value) for value in machine.values()))
    report.part("solvers against a direct solution", 20, lambda: check_solvers(report, place, 10 if small else 24))
    report.part("CCD against the CPU", 20, lambda: check_ccd(report, place, 200 if small else 100_000))
    scenes = CHECKED_SCENES[:1] if small else CHECKED_SCENES
    report.part("steps against the CPU", 60, lambda: check_steps(report, place, scenes, 2 if small else STEPS))
    report.part("Table 1, Armadillo", 60, lambda: time_armadillo(report, place, 2 if small else 200))
    names = (
        ["block 10^3"]
        if small
        else ["block 10^3", "block 20^3", "squeezed block 10^3", "cloth 50x50", "cloth 100x100", "cloth 200x200"]
    )
    report.part("benchmark scenes", 60, lambda: time_scenes(report, place, names, 3 if small else 100))
    report.part("solvers over sizes (Fig. 8)", 60, lambda: time_solvers(report, place, (12,) if small else SIDES))
    report.part("CCD", 10, lambda: time_ccd(place, 1000 if small else 1_000_000))
    slug = re.sub(r"[^a-z0-9]+", "-", place.warp.name.lower()).strip("-")
    out = options.output or REPOSITORY / "benchmarks" / "results" / f"gpu-{slug}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    seconds = time.perf_counter() - report.begun
    found = {
        "machine": machine,
        "small": small,
        "seconds": seconds,
        "ok": report.ok,
        "checks": report.checks,
        "parts": report.parts,
    }
    out.write_text(json.dumps(found, indent=1))
    failed = [check["check"] for check in report.checks if not check["passed"]]
    print(f"{len(report.checks)} checks, {len(failed)} failed; {seconds:.0f} s; {out}")
    return 0 if report.ok else 1


if __name__ == "__main__":
    sys.exit(main())
