"""Culling: patches (Section 7.2) against trees over primitives and IPC Toolkit's: `python benchmarks/culling.py [--small]`.

A cloth above a ball (sparse) and a pile of wavy sheets (rich), both trembling, and the pile turning about the vertical by up to
five edges (fast); 10K to 200K triangles. Vertex-triangle and edge-edge pairs that boxes leave, ours as they move along, IPC Toolkit's swept;
and, of ours, what the sieve leaves of them (collision/sieve.py), which is what a step uses. Median of several runs, after a first
one that builds what is kept between steps. Writes benchmarks/results/culling.json.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path

import ipctk
import numpy as np
import warp as wp

from pdipc.collision import broad_phase, sieve, surface
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.scene.generators import Grid, Sphere

REPEATS = 7


def sparse(triangles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat cloth over a ball: positions, triangles, body of each vertex."""
    side = round((0.9 * triangles / 2) ** 0.5)
    cloth, ball = Grid(size=(1, 1), cells=(side, side)).mesh(), Sphere(radius=0.3, cells=max(2, side // 8)).mesh()
    x = np.concatenate([cloth.vertices + np.array([0, 0.4, 0]), ball.vertices])
    body = np.repeat([0, 1], [len(cloth.vertices), len(ball.vertices)])
    return x, np.concatenate([cloth.triangles, ball.triangles + len(cloth.vertices)]), body


def rich(triangles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ten wavy sheets, each a third of an edge above the last."""
    side = round((triangles / 20) ** 0.5)
    sheet = Grid(size=(1, 1), cells=(side, side)).mesh()
    wave = 0.05 * np.sin(12 * sheet.vertices[:, 0]) * np.cos(9 * sheet.vertices[:, 2])
    parts = [sheet.vertices + np.stack([0 * wave, wave + k / (3 * side), 0 * wave], axis=1) for k in range(10)]
    n = len(sheet.vertices)
    return np.concatenate(parts), np.concatenate([sheet.triangles + k * n for k in range(10)]), np.repeat(np.arange(10), n)


def timed(action) -> list[float]:
    """Milliseconds of REPEATS runs after one that is not counted."""
    action()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        action()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def measure(frame: str, triangles: int) -> list[dict]:
    x0, faces, body = {"sparse": sparse, "rich": rich, "fast": rich}[frame](triangles)
    edge = 1.0 / round((triangles / (2 if frame == "sparse" else 20)) ** 0.5)
    x1 = x0 + 0.1 * edge * np.random.default_rng(0).standard_normal(x0.shape)
    if frame == "fast":
        x1 += 5 * edge / 0.7 * np.stack([x0[:, 2], 0 * x0[:, 0], -x0[:, 0]], axis=1)
    reach = np.full(len(x0), 0.05 * edge)
    rows = []

    def add(method: str, times: list[float], pairs: int, build_ms: float, **more) -> None:
        row = {"frame": frame, "triangles": len(faces), "method": method, "median_ms": statistics.median(times)}
        row |= {"spread_ms": max(times) - min(times), "build_ms": build_ms, "pairs": pairs, **more}
        rows.append(row)
        print(f"{frame:7} {len(faces):7} {method:28} {row['median_ms']:9.2f} ms  {pairs:9} pairs", flush=True)

    for threads in (1, None):
        device, number = Device("cpu", threads), real("float64")
        skin = surface.build(device, faces, x0, body, np.zeros(len(x0), bool))
        arrays = [wp.array(v, dtype=number.vec3, device="cpu") for v in (x0, x1)] + [wp.array(reach, dtype=wp.float64)]
        near = sieve.functions(number).Sieve()
        near.begin, near.end, near.reach = arrays
        for method in ("patches", "bvh"):
            start = time.perf_counter()
            search = broad_phase.BroadPhase(device, number, skin, method)
            build_ms = 1e3 * (time.perf_counter() - start)
            search.restructure(arrays[0], arrays[2])
            for label, used in (("boxes", sieve.everything(number)), ("sieve", near)):
                inputs = [*arrays, used]
                while True:
                    search.find(*inputs)
                    if not search.grow():
                        break
                graph = device.capture(lambda search=search, inputs=inputs: search.find(*inputs), search)
                count = sum(int(found.count.numpy()[0]) for found in search.lists)
                more = search.searcher.statistics() if method == "patches" else {}
                add(f"{method}, {label}, {device.threads} threads", timed(graph.launch), count, build_ms, **more)
    mesh = ipctk.CollisionMesh(x0, ipctk.edges(faces), faces.astype(np.int32))
    for name in ("BVH", "LBVH", "SweepAndPrune", "SpatialHash", "HashGrid"):
        if not hasattr(ipctk, name) or (name in ("SpatialHash", "HashGrid") and triangles > 60_000):
            continue

        def run(name=name) -> ipctk.Candidates:
            candidates = ipctk.Candidates()
            candidates.build(mesh, x0, x1, float(reach[0]), getattr(ipctk, name)())
            return candidates

        add(f"IPC Toolkit {name}", timed(run), len(run()), 0.0)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="1K triangles only, and no file is written")
    options = parser.parse_args()
    sizes = (1000,) if options.small else (10_000, 30_000, 100_000, 200_000)
    rows = [row for frame in ("sparse", "rich", "fast") for size in sizes for row in measure(frame, size)]
    exponents = {}
    for frame in ("sparse", "rich", "fast"):
        for method in dict.fromkeys(row["method"] for row in rows):
            own = [row for row in rows if row["method"] == method and row["frame"] == frame]
            if len(own) > 1:
                sizes_, times = np.log([row["triangles"] for row in own]), np.log([row["median_ms"] for row in own])
                exponents[f"{frame}, {method}"] = float(np.polyfit(sizes_, times, 1)[0])
    for name, exponent in exponents.items():
        print(f"{name:36} time ~ triangles^{exponent:.2f}")
    if not options.small:
        cpu = next(
            (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
            "unknown",
        )
        report = {"machine": f"{cpu}, {os.cpu_count()} cores", "load_average": os.getloadavg()[0], "exponents": exponents}
        out = Path(__file__).parent / "results" / "culling.json"
        out.write_text(json.dumps(report | {"rows": rows}, indent=1))


if __name__ == "__main__":
    main()
