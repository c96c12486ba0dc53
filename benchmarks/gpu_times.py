"""What benchmarks/gpu.py times."""

import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gpu_checks
import hard_queries
import numpy as np
import peer_scenes
import warp as wp

import pdipc
from pdipc.collision import queries
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.drive import Work, step
from pdipc.reproduce import fig8
from pdipc.reproduce.fig7 import Run, loads, table_cloth
from pdipc.reproduce.table1 import ROWS
from pdipc.scene.load import bundled_scenes

SIDES = (41, 71, 100, 183, 316, 577)  # cloths of 5K to 1M DOF
PROFILED = ("s1_100", "s3_8")
WITNESS_SECONDS = 4.0  # that a case keeps for looking at its states
JUDGED = 4  # states, the last and others spread over the run


def seconds_of(place: Device, action: Callable[[], object], repeats: int = 9) -> float:
    """Median of `repeats` runs after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        wp.synchronize_device(place.warp)
        begin = time.perf_counter()
        action()
        wp.synchronize_device(place.warp)
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


# --- steps ---


def peer_cases(small: bool) -> list[str]:
    return ["s2_2"] if small else list(peer_scenes.SCENES)


def paper_cases(small: bool) -> list[str]:
    """Rows of Table 1 at the paper's size; those that need optional data are skipped where it is not."""
    return [] if small else list(ROWS)


def bundled_cases(small: bool) -> list[str]:
    return ["box_stack"] if small else list(bundled_scenes())


def scene_of(part: str, case: str) -> pdipc.Scene:
    """Raises FileNotFoundError where a paper's scene needs optional data that is not there."""
    if part == "paper scenes":
        return ROWS[case].full()
    return pdipc.load_scene(case) if part == "bundled scenes" else peer_scenes.scene(case)


def time_scene(report, place: Device, case: str, carried: Path | None) -> None:
    """Step times and stages; the witness looks at the last state, and at some before it while there is time."""
    begun = time.perf_counter()
    try:
        scene = scene_of(report.of["part"], case)
        simulation = pdipc.Simulation(scene, place.name)
    except (pdipc.SceneError, FileNotFoundError) as error:  # it needs an extra, or optional data
        report.add(skipped=str(error))
        return
    built = time.perf_counter() - begun
    simulation.step()
    first = time.perf_counter() - begun - built
    simulation.reset()
    results, times, states, asked = [], [], [], scene.simulation.steps
    while not results or (len(results) < asked and report.left() > WITNESS_SECONDS):
        start = time.perf_counter()
        results.append(simulation.step())
        times.append(1e3 * (time.perf_counter() - start))
        states.append(simulation.positions)
    row = {
        "steps": len(results),
        "asked": asked,
        "build s": built,
        "first step s": first,
        "precision": simulation.model.real.name,
    }
    row |= {"median ms": statistics.median(times), "mean ms": statistics.fmean(times)}
    row |= {"p95 ms": float(np.quantile(times, 0.95)), "max ms": max(times)}
    row["stages ms"] = {key: statistics.fmean(r.milliseconds[key] for r in results) for key in results[0].milliseconds}
    for name in ("outer", "local_global", "linear_iterations", "barriers", "truncations"):
        row[name] = statistics.fmean(getattr(r, name) for r in results)
    row |= {"residual m": statistics.median(r.residual for r in results), "unconverged": sum(not r.converged for r in results)}
    row["messages"] = sorted({r.message for r in results if not r.converged})[:3]
    row["DOF"] = 3 * simulation.model.vertex_count
    if place.is_cuda:
        row["memory MB"] = wp.get_mempool_used_mem_high(place.warp) / 1e6
    report.add(**row)
    stages = " ".join(f"{key} {value:.2f}" for key, value in row["stages ms"].items())
    print(
        f"  {case:22} {len(results):4} steps  median {row['median ms']:8.2f}  mean {row['mean ms']:8.2f} ms  [{stages}]  "
        f"p95 {row['p95 ms']:.1f}  unconverged {row['unconverged']}  outer {row['outer']:.1f} l-g {row['local_global']:.1f} "
        f"linear {row['linear_iterations']:.0f}  built {built:.1f} s",
        flush=True,
    )
    count, looked = 0, []
    for k in (np.arange(JUDGED, 0, -1) * len(states)) // JUDGED - 1:
        if k >= 0 and k not in looked and (not looked or report.left() > 0.25 * WITNESS_SECONDS):
            count += len(pdipc.find_intersections(states[k], simulation.triangles, simulation.model.assembly.obstacle))
            looked.append(int(k))
    report.check(f"intersections after steps {', '.join(str(k + 1) for k in looked)}", count, 0)


# --- parts of it ---


def ccd_cases(small: bool) -> list[str]:
    return list(gpu_checks.PRECISIONS)


def time_ccd(report, place: Device, case: str, carried: Path | None) -> None:
    """Nanoseconds a query: of the kernel alone, and with transfers and checks."""
    rng, number, count = np.random.default_rng(1), real(case), 2_000_000 if place.is_cuda else 2000
    for kind in queries.KINDS:
        for label, family in (("near misses", hard_queries.small_motions), ("random", hard_queries.random)):
            points = np.tile(family(rng, count // 8), (8, 1, 1)).astype(number.numpy)
            given = wp.array(points, dtype=number.vec3, ndim=2, device=place.warp)
            out = wp.zeros(len(points), dtype=number.scalar, device=place.warp)
            inputs = [given, number.scalar(0.0), number.scalar(queries.BACKOFF), number.scalar(np.inf), out]
            kernel = getattr(queries.kernels(number), kind)
            alone = 1e9 * seconds_of(place, lambda k=kernel, i=inputs: place.launch(k, len(points), i, grain=64)) / len(points)
            whole = (
                1e9
                * seconds_of(place, lambda p=points, k=kind: pdipc.time_of_impact(p, k, precision=case, device=place.name), 1)
                / len(points)
            )
            report.add(
                **{"kind": kind, "queries": label, "count": len(points), "ns a query": alone, "ns, with transfers": whole}
            )
            print(f"  {kind:16} {label:12} {case}  {alone:8.3f} ns a query, {whole:8.1f} with transfers", flush=True)


def sweep_cases(small: bool) -> list[str]:
    return ["copy", *(f"{side}" for side in ((12,) if small else SIDES))]


def time_sweeps(report, place: Device, case: str, carried: Path | None) -> None:
    """A copy's bandwidth and an empty launch; then Fig. 8, and the bandwidth that a sweep of each solver reaches: bytes of the matrix and of
    the vectors that it must touch."""
    if case == "copy":
        time_machine(report, place)
        return
    precision, side = real("float32" if place.is_cuda else "float64"), int(case)
    system, mass, _ = table_cloth(side, place, precision)
    b = loads(system, mass)["gravity"]
    word = np.dtype(precision.numpy).itemsize
    for name in ("chebyshev", "pcg", "two-level"):
        if name == "two-level" and place.is_cuda and side > 100:
            continue  # its coarse system takes one thread
        seconds = Run(system, b, name, {}).per_iteration()[1]
        entries, vertices = system.rows.entries, system.count
        # columns and values once; x, b, the last x and the new x; for PCG also the vectors more that it keeps
        touched = entries * (4 + word) + vertices * 3 * word * (4 if name == "chebyshev" else 8)
        report.add(**{"DOF": 3 * vertices, "sweep of": name, "us": 1e6 * seconds, "GB/s": touched / seconds / 1e9})
        print(f"  {3 * vertices:9,} DOF  {name:34} {1e6 * seconds:9.1f} us  {touched / seconds / 1e9:7.1f} GB/s", flush=True)
    for dof, label, terms, relative, memory in fig8.measure(side, place, precision):
        report.add(**{"DOF": dof, "variant": label, "terms/s": terms, "relative to Jacobi": relative, "bytes": memory})
        print(f"  {dof:9,} DOF  {label:34} {terms:12.0f} terms/s  {relative:5.2f} of Jacobi", flush=True)


@wp.kernel(enable_backward=False)
def nothing(values: wp.array(dtype=wp.int32)):
    if values[0] < 0:
        values[0] = 0


@wp.kernel(enable_backward=False)
def count_down(values: wp.array(dtype=wp.int32)):
    values[0] = values[0] - 1


def time_machine(report, place: Device) -> None:
    """What the model of docs is made of: a large copy, a launch from Python, a launch and a turn of a loop inside a graph."""
    size = 2**30 if place.is_cuda else 2**24
    a, b = (wp.zeros(size // 4, dtype=wp.float32, device=place.warp) for _ in range(2))
    row = {"copy GB/s": 2 * size / seconds_of(place, lambda: wp.copy(b, a)) / 1e9}
    values, many = wp.ones(1, dtype=wp.int32, device=place.warp), 2000

    def launches() -> None:
        for _ in range(many):
            wp.launch(nothing, 1, [values], device=place.warp)

    def turns() -> None:
        place.loop(values, lambda: wp.launch(count_down, 1, [values], device=place.warp))

    row["us a launch"] = 1e6 * seconds_of(place, launches, 3) / many
    if place.is_cuda:
        graph = place.capture(launches)
        row["us a launch in a graph"] = 1e6 * seconds_of(place, graph.launch) / many
        loop = place.capture(turns)
        row["us a turn of a loop in a graph"] = 1e6 * seconds_of(place, lambda: (values.fill_(many), loop.launch())) / many
    report.add(**row)
    print("  " + ", ".join(f"{key} {value:.2f}" for key, value in row.items()), flush=True)


def profile_cases(small: bool) -> list[str]:
    return ["s2_2"] if small else list(PROFILED)


def profile(report, place: Device, case: str, carried: Path | None) -> None:
    """Which kernels take the time of a step in contact, launched one by one, by CUDA's own events."""
    if not place.is_cuda:
        report.add(skipped="only CUDA times kernels")
        return
    simulation = pdipc.Simulation(peer_scenes.scene(case), place.name)
    while simulation.steps_done < 60 and report.left() > 8:
        simulation.step()
    work, state = Work(simulation.model, recorded=False), simulation.state
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    result = step(simulation.model, state, work)
    events = wp.timing_end()
    total: dict[str, list[float]] = {}
    for event in events:
        total.setdefault(event.name.removeprefix("forward kernel "), []).append(event.elapsed)
    whole = sum(map(sum, total.values()))
    report.add(
        launches=len(events), **{"kernels ms": whole, "outer": result.outer, "linear_iterations": result.linear_iterations}
    )
    print(
        f"  {case}: {len(events)} launches, {whole:.2f} ms in kernels, {result.outer} outer, {result.linear_iterations} linear"
    )
    for name, times in sorted(total.items(), key=lambda item: -sum(item[1]))[:25]:
        report.add(kernel=name, launches=len(times), ms=sum(times), **{"us each": 1e3 * statistics.median(times)})
        print(f"    {sum(times):8.3f} ms  {len(times):6} x {1e3 * statistics.median(times):8.2f} us  {name}", flush=True)
