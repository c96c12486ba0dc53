"""What benchmarks/gpu.py checks: CUDA gives what the CPU gives, twice the same bits, and no intersections.

References are computed by the same functions on the CPU: beforehand by `prepare`, or when they are asked for.
"""

import functools
import os
import time
from collections.abc import Callable
from pathlib import Path

import exact
import hard_queries
import numpy as np
import scipy.sparse.linalg as spla
import warp as wp
import worlds

import pdipc
from pdipc.constraints import (
    Projector,
    curved_bending,
    edge_length,
    point_attachment,
    quadratic_bending,
    tet_strain,
    tet_volume,
    triangle_area,
    triangle_strain,
)
from pdipc.device.launch import Device, Reducer
from pdipc.device.precision import real
from pdipc.drive import Work, step
from pdipc.linear import make_solver
from pdipc.linear.solvers import SOLVERS
from pdipc.reproduce.fig7 import loads, table_cloth
from pdipc.scene.generators import Box, Grid
from pdipc.scene.load import bundled_scenes
from pdipc.scene.worlds import scenes_of

PRECISIONS = ("float32", "float64")
BEGIN, STEPS = 40, 6  # a scene runs on the CPU to where things touch; then CUDA and CPU take these steps from the same state
UNRECORDED = 2  # steps that are also taken launch by launch
STEP_TOLERANCE = 1e-3  # of the scene size, after STEPS steps: a step has converged at 1e-4 of it
# Relative distance of results, |a - b| / |b|; which pairs act may depend on the last bit, and a barrier is stiff.
KERNEL_TOLERANCE = {
    "reductions": {"float32": 2e-5, "float64": 1e-12},
    "projections": {"float32": 2e-5, "float64": 1e-12},
    "contacts": {"float32": 1e-2, "float64": 1e-2},
}
SOLVER_TOLERANCE = {"float32": 2e-3, "float64": 1e-8}  # relative distance to the direct solution, converged as far as it goes
QUERIES = 4_000  # of each family
# Ways of solving that the bundled scenes do not take by themselves, each tried on one of them.
WAYS = {
    "bvh": ("contact", {"broad_phase": "bvh"}),
    "global truncation": ("contact", {"truncation": "global"}),
    "restitution": ("contact", {"restitution": 0.5}),
    "paper": ("contact", {"method": "paper"}),
    **{name: ("simulation", {"linear_solver": name}) for name in SOLVERS if name not in ("pcg", "direct", "a-jacobi")},
}


def precisions(small: bool) -> list[str]:
    return list(PRECISIONS)


# --- whole steps ---


def scene_cases(small: bool) -> list[str]:
    """Every bundled scene in both precisions, then the other ways on a small one."""
    names = ["box_stack"] if small else list(bundled_scenes())
    ways = [f"box_stack, {way}" for way in (["bvh"] if small else WAYS)]
    return [f"{name} {precision}" for name in names for precision in PRECISIONS] + [f"{name} float64" for name in ways]


def scene_of(case: str) -> pdipc.Scene:
    """The scene of a case, with the same linear solver wherever it runs."""
    title, precision = case.rsplit(" ", 1)
    name, _, way = title.partition(", ")
    scene = pdipc.load_scene(name)
    changes = {"simulation": {"precision": precision, "linear_solver": "auto" if way == "paper" else "pcg"}, "contact": {}}
    if way:
        table, keys = WAYS[way]
        changes[table] |= keys
    # validated anew: some settings depend on others
    return pdipc.Scene(**(scene.model_dump() | {key: getattr(scene, key).model_dump() | more for key, more in changes.items()}))


def begin_of(name: str, small: bool) -> dict[str, np.ndarray]:
    """The state of a bundled scene after BEGIN steps on the CPU, rounded so that both precisions begin alike."""
    simulation = pdipc.Simulation(pdipc.load_scene(name), "cpu")
    for _ in range(2 if small else BEGIN):
        simulation.step()
    arrays = simulation.state.arrays()
    return {key: value.astype(np.float32) if value.ndim else value for key, value in arrays.items()}


def positions(model, begin: dict[str, np.ndarray], steps: int, recorded: bool, told: list | None = None) -> np.ndarray:
    """Where `steps` steps from a state lead; the results of the steps and their times, s, go to `told`."""
    work, state = Work(model, recorded=recorded), model.state_from(begin)
    for _ in range(steps):
        start = time.perf_counter()
        result = step(model, state, work)
        state = result.state
        if told is not None:
            told.append((result, time.perf_counter() - start))
    return state.positions.numpy().astype(np.float64)


def check_scene(report, place: Device, case: str, carried: Path | None) -> None:
    """From a state in contact: CUDA against the CPU, no intersection, the same bits again, recorded and launch by launch."""
    kept = Kept(carried)
    name = case.partition(" ")[0].rstrip(",")
    scene, begun = scene_of(case), time.perf_counter()
    try:
        model = pdipc.build(scene, place.name)
    except pdipc.SceneError as error:  # it needs an extra
        report.add(skipped=str(error))
        return
    built, told = time.perf_counter() - begun, []
    begin = {key: kept.get(f"begin {name}: {key}", lambda key=key: begin_of(name, False)[key]) for key in STATE}
    size, triangles, obstacle = model.assembly.scene_size, model.triangles, model.assembly.obstacle
    short = positions(model, begin, UNRECORDED, False)
    there = kept.get(f"{case}, {UNRECORDED} steps", lambda: positions(pdipc.build(scene, "cpu"), begin, UNRECORDED, True))
    report.check("launch by launch, CUDA against CPU / size", np.abs(short - there).max() / size, STEP_TOLERANCE)
    report.check("launch by launch, intersections", len(pdipc.find_intersections(short, triangles, obstacle)), 0)
    here = positions(model, begin, STEPS, True, told)
    row = {"build s": built, "first step s": told[0][1], "step ms": 1e3 * min(seconds for _, seconds in told)}
    last = told[-1][0]
    row |= {"stages ms": last.milliseconds, "outer": last.outer, "local_global": last.local_global}
    row |= {"linear_iterations": last.linear_iterations, "barriers": last.barriers, "residual": last.residual}
    row["unconverged"] = sum(not result.converged for result, _ in told)
    report.add(**row)
    speed = f"built {built:.2f} s, first step {row['first step s']:.2f} s, step {row['step ms']:.2f} ms"
    print(f"  {case}: {speed}, {last.barriers} barriers", flush=True)
    there = kept.get(case, lambda: positions(pdipc.build(scene, "cpu"), begin, STEPS, True))
    report.check("CUDA against CPU / size", np.abs(here - there).max() / size, STEP_TOLERANCE)
    report.check("intersections", len(pdipc.find_intersections(here, triangles, obstacle)), 0)
    report.check("bits that differ the second time", np.count_nonzero(here != positions(model, begin, STEPS, True)), 0)
    report.check("bits that differ recorded", np.count_nonzero(short != positions(model, begin, UNRECORDED, True)), 0)


# --- worlds ---


def world_cases(small: bool) -> list[str]:
    return ["2 worlds" if small else "16 worlds"]


def check_worlds(report, place: Device, case: str, carried: Path | None) -> None:
    """Worlds side by side end at the bits that each has alone; and how long both take."""
    count, steps = int(case.split()[0]), 4
    scene, changes = pdipc.Scene(**{**worlds.SCENE, "simulation": {}}), worlds.variants(int(case.split()[0]))
    together = pdipc.Worlds(scene, changes, place.name)
    alone = [pdipc.Simulation(one, place.name) for one in scenes_of(scene, changes)]
    seconds = {}
    for name, advance in (("together", together.step), ("alone", lambda: [simulation.step() for simulation in alone])):
        advance()  # records
        start = time.perf_counter()
        for _ in range(steps):
            advance()
        seconds[name] = (time.perf_counter() - start) / (steps * count)
    differ = sum(np.count_nonzero(a.positions != b.positions) for a, b in zip(together, alone, strict=True))
    report.check("bits that differ from those alone", differ, 0)
    report.add(worlds=count, **{f"ms a step of a world, {name}": 1e3 * each for name, each in seconds.items()})


# --- kernels ---


def check_kernels(report, place: Device, case: str, carried: Path | None) -> None:
    """Reductions, scans, projections, culling, truncation and barriers, each against the CPU's results in the same precision."""
    kept = Kept(carried)
    for name, results in KERNELS.items():
        here = results(place, case)
        for key, found in here.items():
            expected = kept.get(f"{name} {case}: {key}", lambda results=results, key=key: results(Device("cpu"), case)[key])
            if found.shape != expected.shape:
                report.check(f"{name}, {key}: {found.shape} instead of {expected.shape}", np.inf, 0)
            elif found.dtype.kind == "i" and found.size > 1:
                report.check(f"{name}, {key}: numbers that differ", np.count_nonzero(found != expected), 0)
            else:
                scale = float(np.linalg.norm(expected)) or 1.0
                apart = float(np.linalg.norm(found.astype(np.float64) - expected)) / scale
                report.check(f"{name}, {key}", apart, KERNEL_TOLERANCE[name][case])


def reductions(place: Device, precision: str) -> dict[str, np.ndarray]:
    number, rng, found = real(precision), np.random.default_rng(0), {}
    for n in (1, 511, 100_003):
        values, out = rng.uniform(0.0, 1.0, n).astype(number.numpy), wp.zeros(2, dtype=number.scalar, device=place.warp)
        given, reducer = wp.array(values, device=place.warp), Reducer(place, number, n)
        reducer.sum(given, out, 0)
        reducer.max(given, out, 1)
        found[f"sum and largest of {n}"] = out.numpy()
        counts = wp.array(rng.integers(0, 100, n).astype(np.int32), device=place.warp)
        ends = wp.zeros_like(counts)
        place.scan(counts, ends)
        found[f"scan of {n}"] = ends.numpy()
    return found


def projections(place: Device, precision: str) -> dict[str, np.ndarray]:
    """Forces and energies of each kind of constraint on meshes that are bent and stretched."""
    number, rng, found = real(precision), np.random.default_rng(1), {}
    cloth, solid = Grid(cells=(30, 40)).mesh(), Box(cells=(6, 7, 8)).mesh()
    x, t, y, q = cloth.vertices, cloth.triangles, solid.vertices, solid.tets
    edges = np.unique(np.sort(t[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    kinds = {
        "tet strain": (y, tet_strain.rest(y, q, 1e5)),
        "tet volume": (y, tet_volume.rest(y, q, 1e5)),
        "triangle strain": (x, triangle_strain.rest(x, t, 100.0)),
        "triangle area": (x, triangle_area.rest(x, t, 100.0)),
        "edge length": (x, edge_length.rest(x, edges, 10.0)),
        "quadratic bending": (x, quadratic_bending.rest(x, t, 1e-2)),
        "curved bending": (x, curved_bending.rest(x, t, 1e-2)),
        "point attachment": (x, point_attachment.rest(x[:50], np.arange(50), 10.0)),
    }
    for name, (rest, constraints) in kinds.items():
        bent = rest @ np.array([[1.1, 0.2, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.2, 1.2]]) + rng.normal(0.0, 5e-3, rest.shape)
        projector = Projector(place, number, len(rest), [constraints])
        at = wp.array(bent.astype(number.numpy), dtype=number.vec3, device=place.warp)
        force, still = wp.zeros_like(at), wp.zeros_like(at)
        energy = wp.zeros(1, dtype=number.scalar, device=place.warp)
        projector.add_forces(at, still, force, still)
        projector.energy(at, still, energy, 0)
        found |= {f"forces of {name}": force.numpy(), f"energy of {name}": energy.numpy()}
    return found


def contacts(place: Device, precision: str) -> dict[str, np.ndarray]:
    """What culling, truncation and barriers find for boxes that are pushed into each other and the floor."""
    found = {}
    for method in ("patches", "bvh"):
        scene = pdipc.load_scene("box_stack")
        tables = {"simulation": {"precision": precision}, "contact": {"broad_phase": method}}
        scene = pdipc.Scene(
            **(scene.model_dump() | {key: getattr(scene, key).model_dump() | more for key, more in tables.items()})
        )
        model = pdipc.build(scene, place.name)
        work, start = Work(model), model.assembly.positions
        squeezed = start + 0.002 * np.sin(40.0 * start[:, [1, 2, 0]])
        squeezed[:, 1] -= 0.03 * (model.assembly.body_of_vertex + 1)
        squeezed[model.assembly.kinematic_vertices] = start[model.assembly.kinematic_vertices]
        x, x_end = (
            wp.array(each.astype(model.real.numpy), dtype=model.real.vec3, device=place.warp) for each in (start, squeezed)
        )
        while True:
            work.candidates.cover(x, x_end)
            still, motion = (
                wp.zeros_like(x),
                wp.array((squeezed - start).astype(model.real.numpy), dtype=model.real.vec3, device=place.warp),
            )
            work.truncation.truncate(work.candidates, x, still, motion, x)
            if not work.grow():
                break
            work.candidates.invalidate()
        for pairs in work.candidates.lists:
            found[f"{pairs.kind} pairs by {method}"] = pairs.count.numpy()[:1].copy()  # on the CPU a view
        found[f"passes by {method}"] = work.truncation.passes.numpy().copy()
        found[f"truncated by {method}"] = work.truncation.x_end.numpy().copy()
        work.list_pairs(work.truncation.x_end)
        found[f"barriers by {method}"] = work.pairs.count.numpy()[:1].copy()  # on the CPU a view
        found[f"barrier forces by {method}"] = work.pairs.forces(work.truncation.x_end).numpy().copy()
    return found


KERNELS: dict[str, Callable[[Device, str], dict[str, np.ndarray]]] = {
    "reductions": reductions,
    "projections": projections,
    "contacts": contacts,
}


def ccd_queries(kind: str, precision: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    families = (hard_queries.random, hard_queries.small_motions, hard_queries.flat_sheets, hard_queries.parallel_edges)
    return np.concatenate([family(rng, QUERIES) for family in families]).astype(np.float32).astype(precision)


def ccd_times(points: np.ndarray, kind: str, precision: str, device: str) -> np.ndarray:
    return pdipc.time_of_impact(points, kind, precision=precision, device=device)


def check_ccd(report, place: Device, case: str, carried: Path | None) -> None:
    """Times of impact of random and hard queries: each is proven, in exact arithmetic where rounded does not do, to be early.

    With the CPU's they agree but for queries so hard that rounding decides whether a proof is found: CUDA fuses multiplications and
    additions, the CPU does not.
    """
    kept = Kept(carried)
    for kind in ("vertex_triangle", "edge_edge"):
        points = kept.get(f"ccd queries {case}", lambda: ccd_queries(kind, case))
        here = ccd_times(points, kind, case, place.name)
        same = kept.get(f"ccd {kind} {case}", functools.partial(ccd_times, points, kind, case, "cpu"))
        both = np.isfinite(here) & np.isfinite(same)
        report.check(f"{kind}, hit on one side only", np.mean(np.isfinite(here) != np.isfinite(same)), 1e-3)
        report.check(f"{kind}, times apart", np.abs(here[both] - same[both]).max(initial=0.0), 1e-3)
        moving = np.flatnonzero(here > 0.0)
        apart = exact.stays_apart(points[moving], kind, np.minimum(here[moving], 1.0))
        report.check(f"{kind}, times of {len(moving)} that are not proven early", np.count_nonzero(~apart), 0)


def solver_cases(small: bool) -> list[str]:
    return [f"{name} {precision}" for name in SOLVERS for precision in PRECISIONS][: 2 if small else None]


def check_solver(report, place: Device, case: str, carried: Path | None) -> None:
    """A solver against SciPy's direct solution of a cloth."""
    name, precision = case.split()
    system, mass, _ = table_cloth(24, place, real(precision))
    b = loads(system, mass)["sharp force"]
    free, expected = system.free, np.zeros_like(b)
    expected[free] = spla.spsolve(system.matrix[free][:, free].tocsc(), b[free])
    right = wp.array(b.astype(system.real.numpy), dtype=system.real.vec3, device=place.warp)
    options = {"weight": 0.5} if name == "jacobi" else {}
    tolerance = 1e-11 if precision == "float64" else 1e-6
    solver = make_solver(name, system, tolerance=tolerance, max_iterations=40_000, **options)
    x = wp.zeros(system.count, dtype=system.real.vec3, device=place.warp)
    if solver.recordable and place.records_loops:
        place.capture(lambda: solver.solve(x, right), solver).launch()
    else:
        solver.solve(x, right)
    error = np.linalg.norm(x.numpy() - expected) / np.linalg.norm(expected)
    report.check("relative error", error, SOLVER_TOLERANCE[precision])


# --- what is carried ---

STATE = ("positions", "velocities", "accelerations", "time", "step")


class Kept:
    """References by name: from `FOLDER/references.npz`, or computed where they are not there."""

    def __init__(self, folder: Path | None):
        path = folder / "references.npz" if folder else None
        self.arrays = np.load(path) if path is not None and path.exists() else {}

    def get(self, name: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
        return self.arrays[name] if name in self.arrays else np.asarray(compute())


def chosen(parts: str, case: str) -> bool:
    """Whether the name of a case contains one of the parts, "this|that"."""
    return any(part in case for part in parts.split("|"))


def prepare(folder: Path, arch: int | None, small: bool, parts: str) -> None:
    """Writes the references of all cases that `chosen` takes, and compiles the kernels for a CUDA architecture.

    States that were written before are begun from again: they need not come from the same code.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "references.npz"
    found: dict[str, np.ndarray] = dict(np.load(path)) if path.exists() else {}
    for case in scene_cases(small):
        if not chosen(parts, case):
            continue
        start, name = time.perf_counter(), case.partition(" ")[0].rstrip(",")
        try:
            if f"begin {name}: {STATE[0]}" not in found:
                found |= {f"begin {name}: {key}": value for key, value in begin_of(name, small).items()}
            begin = {key: found[f"begin {name}: {key}"] for key in STATE}
            model = pdipc.build(scene_of(case), "cpu")
            found[f"{case}, {UNRECORDED} steps"] = positions(model, begin, UNRECORDED, True).astype(np.float32)
            found[case] = positions(model, begin, STEPS, True).astype(np.float32)
            np.savez(path, **found)
            print(f"{case}: {time.perf_counter() - start:.1f} s", flush=True)
        except pdipc.SceneError as error:
            print(f"{case}: left out: {error}", flush=True)
    for precision in PRECISIONS:
        found[f"ccd queries {precision}"] = ccd_queries("", precision).astype(np.float32)
        for kind in ("vertex_triangle", "edge_edge"):
            found[f"ccd {kind} {precision}"] = ccd_times(found[f"ccd queries {precision}"], kind, precision, "cpu")
        for name, results in KERNELS.items():
            found |= {f"{name} {precision}: {key}": value for key, value in results(Device("cpu"), precision).items()}
    np.savez(path, **found)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    if arch:
        compile_kernels(folder / "kernels", arch)


def compile_kernels(folder: Path, arch: int, precisions_of: tuple[str, ...] = PRECISIONS) -> None:
    """Every kernel of the package, to machine code for `arch`, into a cache that WARP_CACHE_PATH may name on another machine."""
    from tests.factories import LINEAR, STEP, modules

    cache, start, total = folder.resolve() / wp.config.version, time.perf_counter(), 0
    found = {}
    for precision in precisions_of:
        for make in (*STEP.values(), *LINEAR.values()):
            found |= {module.name: module for module in modules(make(real(precision)))}
    for module in found.values():
        place = cache / module.get_module_identifier()
        if not place.exists():
            wp.compile_aot_module(module, arch=arch, use_ptx=False, module_dir=place)
            for source in place.glob("*.cu"):
                source.unlink()
            print(f"{place.name}: {time.perf_counter() - start:.0f} s", flush=True)
        total += sum(os.path.getsize(each) for each in place.iterdir())
    print(f"{cache}: {len(found)} modules, {total / 1e6:.1f} MB, {time.perf_counter() - start:.0f} s")
