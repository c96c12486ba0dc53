"""Time of one CCD query, stage by stage and against ipctk, and a long hunt for late answers.

    python benchmarks/ccd.py [--queries FILE] [--repeats N] [--output FILE]
    python benchmarks/ccd.py --record SCENE --steps N --queries FILE
    python benchmarks/ccd.py --nightly N [--seed S]

The first compares on the ground-truth sets of the optional test data, on a made-up step mix (a cloth that moves over another,
all pairs whose swept boxes come within a millimetre), and on FILE: recorded queries, an npz with arrays `vt` and `ee` (n, 8, 3)
and optionally `xi`. One CPU thread, kernels only, all in one run. Writes benchmarks/results/ccd.json.

The second writes such a FILE: all pairs that the last step of a bundled scene's first N asks about.

The third asks N queries of every family in tests/collision/hard_queries.py, both kinds, float64 and float32, with and without a
minimum separation, and has each answer proven by an independent judge (tests/collision/exact.py). It must end with "late: 0".
"""

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "tests"))

from collision import exact, hard_queries  # noqa: E402

from pdipc.collision import ccd, queries  # noqa: E402
from pdipc.device import precision  # noqa: E402
from pdipc.device.launch import Device  # noqa: E402

DATA = Path(os.environ.get("PDIPC_DATA", REPOSITORY.parent / "shared" / "data")) / "ccd"
BACKOFF = 0.1  # as ipctk's AdditiveCCD: 0.9 of the gap is used up
STAGES = {
    "additive": {"rejects": False, "cubic": "off", "steps": "additive"},
    "+ reject": {"cubic": "off", "steps": "additive"},
    "+ cubic filter": {"cubic": "filter", "steps": "additive"},
    "+ cubic head start": {"steps": "additive"},
    "directions, no cubic": {"cubic": "off"},
    "directions + head start (default)": {},
}
CALLS = 1000  # of ipctk, one by one
SLOW_CALLS = 100
LEAST = 20_000  # queries in a timed batch: smaller sets are repeated


def machine() -> str:
    """The processor's name and the number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0] if models else name
    return f"{name}, {len(os.sched_getaffinity(0))} cores"


def step_mix(size: int = 48, seed: int = 0) -> dict[str, np.ndarray]:
    """Pairs of a cloth settling on another: cells of 1 cm, gaps of 0.2 to 3 mm, motions of about 0.5 mm, boxes within 1 mm."""
    rng = np.random.default_rng(seed)
    i, j = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    flat = 0.01 * np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3).astype(float)
    corner = (i * size + j)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + size, corner + 1], 1), np.stack([corner + 1, corner + size, corner + size + 1], 1)]
    )

    def bumps(phase):
        return 0.02 * np.sin(15 * flat[:, 0] + phase) * np.cos(11 * flat[:, 1])

    lower, upper = flat.copy(), flat + np.array([0.0023, 0.0041, 0.0])
    lower[:, 2], upper[:, 2] = bumps(0.0), bumps(0.03) + 0.0035
    upper += 2e-4 * rng.standard_normal(upper.shape)
    start = np.concatenate([lower, upper])
    end = start + 2e-4 * rng.standard_normal(start.shape)
    end[len(lower) :] += [3e-4, 2e-4, -6e-4]
    faces = np.concatenate([faces, faces + len(lower)])
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    vertices = np.arange(len(start))[:, None]

    def pairs(first, second):
        low, high = np.minimum(start, end), np.maximum(start, end)
        boxes = [(low[s].min(axis=1) - 5e-4, high[s].max(axis=1) + 5e-4) for s in (first, second)]
        centres = [0.5 * (a + b) for a, b in boxes]
        radius = sum(np.linalg.norm(b - a, axis=1).max() / 2 for a, b in boxes)
        near = cKDTree(centres[0]).query_ball_tree(cKDTree(centres[1]), radius)
        a, b = np.repeat(np.arange(len(first)), [len(n) for n in near]), np.concatenate([np.array(n, int) for n in near])
        meet = ((boxes[0][0][a] <= boxes[1][1][b]) & (boxes[1][0][b] <= boxes[0][1][a])).all(axis=1)
        shared = (first[a][:, :, None] == second[b][:, None, :]).any(axis=(1, 2))
        keep = meet & ~shared & ((first.shape[1] == 1) | (a < b))
        quads = np.concatenate([first[a[keep]], second[b[keep]]], axis=1)
        return np.concatenate([start[quads], end[quads]], axis=1)

    return {"vertex_triangle": pairs(vertices, faces), "edge_edge": pairs(edges, edges)}


def record(scene_name: str, steps: int, output: Path) -> None:
    """Writes the queries of a scene's step number `steps`: of every outer iteration, a pair at most once an iteration."""
    from pdipc.collision.truncation import Truncation
    from pdipc.drive import Work
    from pdipc.scene.load import load_scene
    from pdipc.simulation import Simulation

    simulation = Simulation(load_scene(scene_name), device="cpu")
    simulation.work = Work(simulation.model, recorded=False)  # so that Python sees every outer iteration
    for _ in range(steps - 1):
        simulation.step()
    found = {"vertex_triangle": [], "edge_edge": []}
    separations = []
    truncate = Truncation.truncate

    def observed(self, candidates, base, u, u_tilde, x):
        start_end = np.stack([x.numpy(), base.numpy() + u_tilde.numpy()])
        for kind, queries_found in found.items():
            listed = getattr(candidates, kind)
            count = int(listed.count.numpy()[0])
            quads = listed.quads.numpy()[:count]
            queries_found.append(start_end[:, quads].transpose(1, 0, 2, 3).reshape(-1, 8, 3))
            separations.append(listed.limits.numpy()[:count, 0])
        return truncate(self, candidates, base, u, u_tilde, x)

    Truncation.truncate = observed
    simulation.step()
    xi = min((s.min() for s in separations if len(s)), default=0.0)
    np.savez(output, vt=np.concatenate(found["vertex_triangle"]), ee=np.concatenate(found["edge_edge"]), xi=xi)
    print({kind: sum(map(len, queries_found)) for kind, queries_found in found.items()}, "xi", xi)


def query_sets(recorded: list[Path]) -> dict[str, tuple[str, np.ndarray, float]]:
    """Name -> (kind, points, minimum separation)."""
    sets = {f"step mix, {kind}": (kind, points, 1e-5) for kind, points in step_mix().items()}
    for path in recorded:
        file = np.load(path)
        for key, kind in (("vt", "vertex_triangle"), ("ee", "edge_edge")):
            sets[f"{path.stem}, {kind}"] = (kind, file[key], float(file.get("xi", 0.0)))
    if not DATA.exists():
        print("the optional test data is not there: no ground-truth sets")
        return sets
    for kind, ending in (("vertex_triangle", "vf"), ("edge_edge", "ee")):
        rest = []
        for file in sorted(DATA.glob(f"*_{ending}.npz")):
            name, points = file.stem[:-3], np.load(file)["x"]
            if name in ("rod-twist", "n-body-simulation"):
                sets[f"{name}, {kind}"] = (kind, points, 0.0)
            else:
                rest.append(points)
        sets[f"other ground truth, {kind}"] = (kind, np.concatenate(rest), 0.0)
    return sets


def stage_kernel(stage: str, kind: str, precision_name: str):
    """The kernel of the public query, for one of the stages."""
    real = precision.real(precision_name)
    scalar, vec3 = real.scalar, real.vec3
    time_of = getattr(ccd.variant(real, **STAGES[stage]), kind)

    @wp.kernel(module=real.module(f"{__name__}.{stage}.{kind}"))
    def kernel(
        first: int,
        points: wp.array(dtype=vec3, ndim=2),
        xi: scalar,
        backoff: scalar,
        reach: scalar,
        time_out: wp.array(dtype=scalar),
    ):
        i = first + wp.tid()
        time_out[i] = time_of(
            points[i, 0], points[i, 1], points[i, 2], points[i, 3],
            points[i, 4], points[i, 5], points[i, 6], points[i, 7],
            xi, backoff, reach,
        )  # fmt: skip

    return kernel


def spread(seconds: list[float], n: int) -> dict[str, float]:
    """Nanoseconds a query: median, least, largest."""
    ns = np.array(seconds) / n * 1e9
    return {"median": float(np.median(ns)), "min": float(ns.min()), "max": float(ns.max())}


def ours(stage: str, kind: str, points: np.ndarray, xi: float, precision_name: str, repeats: int):
    """(nanoseconds a query, times)."""
    device, real = Device("cpu", threads=1), precision.real(precision_name)
    n = len(points)
    points = np.tile(points, (max(1, LEAST // n), 1, 1))
    x = wp.array(points.astype(real.numpy), dtype=real.vec3, ndim=2, device="cpu")
    times = wp.zeros(len(points), dtype=real.scalar, device="cpu")
    inputs = [x, real.scalar(xi), real.scalar(BACKOFF), real.scalar(np.inf), times]
    kernel = stage_kernel(stage, kind, precision_name)
    device.launch(kernel, len(points), inputs)
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        device.launch(kernel, len(points), inputs)
        seconds.append(time.perf_counter() - begin)
    return spread(seconds, len(points)), times.numpy()[:n]


def ipctk_calls(ccd_method, kind: str, points: np.ndarray, xi: float, limit: int):
    """(nanoseconds a query, hit or not, times), each a call from Python."""
    function = ccd_method.point_triangle_ccd if kind == "vertex_triangle" else ccd_method.edge_edge_ccd
    pick = np.random.default_rng(0).permutation(len(points))[:limit]
    arguments = [tuple(np.ascontiguousarray(v) for v in query) for query in points[pick]]
    seconds, answers = [], []
    for _ in range(3):
        begin = time.perf_counter()
        answers = [function(*query, xi) for query in arguments]
        seconds.append(time.perf_counter() - begin)
    return spread(seconds, len(pick)), pick, np.array([a[0] for a in answers]), np.array([a[1] for a in answers])


def ipctk_batch(ccd_method, kind: str, points: np.ndarray, xi: float):
    """Nanoseconds a query for misses, all in one call into ipctk."""
    import ipctk

    points = np.tile(points, (max(1, LEAST // len(points)), 1, 1))
    n = len(points)
    corners = np.arange(4 * n).reshape(n, 4)
    start, end = (np.asfortranarray(points[:, rows].reshape(-1, 3)) for rows in (slice(0, 4), slice(4, 8)))
    candidates = ipctk.Candidates()
    if kind == "vertex_triangle":
        faces = corners[:, 1:].astype(np.int32)
        mesh = ipctk.CollisionMesh(start, ipctk.edges(faces), faces)
        candidates.fv_candidates = [ipctk.FaceVertexCandidate(i, 4 * i) for i in range(n)]
    else:
        edges = corners.reshape(-1, 2).astype(np.int32)
        mesh = ipctk.CollisionMesh(start, edges)
        candidates.ee_candidates = [ipctk.EdgeEdgeCandidate(2 * i, 2 * i + 1) for i in range(n)]
    seconds = []
    for _ in range(5):
        begin = time.perf_counter()
        step = candidates.compute_collision_free_stepsize(mesh, start, end, xi, ccd_method)
        seconds.append(time.perf_counter() - begin)
    assert step == 1.0, "the batch is of misses only"
    return spread(seconds, n)


def compare(kind: str, points: np.ndarray, xi: float, repeats: int) -> dict:
    """All stages and ipctk on one set."""
    import ipctk

    ipctk.set_num_threads(1)
    ipctk.set_logger_level(ipctk.LoggerLevel.error)
    row = {"kind": kind, "queries": len(points), "xi": xi, "stages": {}}
    for stage in STAGES:
        row["stages"][stage], times = ours(stage, kind, points, xi, "float64", repeats)
        row["stages"][stage]["stopped"] = int((times <= 1).sum())
    row["float32"], _ = ours("directions + head start (default)", kind, points, xi, "float32", repeats)
    row["proven misses"] = int(exact.stays_apart(points[times > 1], kind, np.ones(int((times > 1).sum())), xi).sum())
    for name, method, limit in (
        ("AdditiveCCD", ipctk.AdditiveCCD(), CALLS),
        ("TightInclusionCCD", ipctk.TightInclusionCCD(), SLOW_CALLS),
    ):
        row[f"{name}, a call each"], pick, hit, _ = ipctk_calls(method, kind, points, xi, limit)
        row[f"{name} stopped"] = f"{int(hit.sum())} of {len(pick)}; here {int((times[pick] <= 1).sum())}"
        free = pick[~hit & (times[pick] > 1)]
        if len(free) >= 20:
            row[f"{name}, misses in a batch"] = ipctk_batch(method, kind, points[free], xi)
            row[f"misses of {name}"], _ = ours("directions + head start (default)", kind, points[free], xi, "float64", 30)
    return row


def show(name: str, row: dict) -> None:
    def figures(f):
        return f"{f['median']:9.0f} ns  ({f['min']:.0f} to {f['max']:.0f})"

    print(f"\n{name}: {row['queries']} queries, xi = {row['xi']:g}")
    for stage, f in row["stages"].items():
        print(f"  {stage:36s}{figures(f)}  stopped {f['stopped']}")
    print(f"  {'default in float32':36s}{figures(row['float32'])}")
    for other in ("AdditiveCCD", "TightInclusionCCD"):
        calls, stopped = f"{other}, a call each", row[f"{other} stopped"]
        print(f"  {'ipctk ' + calls:36s}{figures(row[calls])}  stopped {stopped}")
        if f"{other}, misses in a batch" in row:
            print(f"  {'ipctk ' + other + ', misses in a batch':36s}{figures(row[other + ', misses in a batch'])}")
            print(f"  {'  the same misses here':36s}{figures(row['misses of ' + other])}")


def verdicts() -> dict[str, dict[str, int]]:
    """On the ground truth: hits that are missed, and misses that are stopped, by the public query and by ipctk."""
    import ipctk

    ipctk.set_logger_level(ipctk.LoggerLevel.error)
    names = ("pdipc float64", "pdipc float32", "AdditiveCCD", "TightInclusionCCD")
    count = {name: {"hits missed": 0, "misses stopped": 0} for name in names}
    total = {"hits": 0, "misses": 0}
    for file in sorted(DATA.glob("*.npz")) if DATA.exists() else []:
        kind = "vertex_triangle" if file.stem.endswith("vf") else "edge_edge"
        content = np.load(file)
        points, hit = content["x"], content["hit"].copy()
        if file.stem == "fast-root-counterexample_ee":
            hit[:] = False  # its edges pass 5e-7 apart: tests/collision/test_time_of_impact.py
        total["hits"] += int(hit.sum())
        total["misses"] += int((~hit).sum())
        answers = {
            f"pdipc {p}": np.isfinite(queries.time_of_impact(points, kind, precision=p, device="cpu"))
            for p in ("float64", "float32")
        }
        for name in ("AdditiveCCD", "TightInclusionCCD"):
            method = getattr(ipctk, name)()
            function = method.point_triangle_ccd if kind == "vertex_triangle" else method.edge_edge_ccd
            # every miss, and a hundred hits a file
            asked = ~hit | (np.cumsum(hit) <= 100)
            answers[name] = hit.copy()
            answers[name][asked] = [function(*query)[0] for query in points[asked]]
        for name, stopped in answers.items():
            count[name]["hits missed"] += int((hit & ~stopped).sum())
            count[name]["misses stopped"] += int((~hit & stopped).sum())
    return {"total": total, **count}


def nightly(n: int, seed: int) -> int:
    """Asks at least n queries; prints and returns how many answers could not be proven."""
    families = hard_queries.FAMILIES
    chunk = 20_000
    asked = late = stopped = 0
    begin = time.perf_counter()
    for turn in range(1_000_000):
        if asked >= n:
            break
        for family in families:
            rng = np.random.default_rng([seed, turn, families.index(family)])
            points = family(rng, chunk)
            if turn % 2:
                points *= 10.0 ** rng.uniform(-4, 3)
            for precision_name in ("float64", "float32"):
                rounded = points.astype(precision_name).astype(float)
                for kind in queries.KINDS:
                    size = float(np.abs(rounded[:, :, None] - rounded[:, :1, None]).max())
                    xi = float(np.float32(rng.choice([0.0, 1e-5, 1e-2]) * min(size, 1.0)))
                    times = queries.time_of_impact(rounded, kind, minimum_separation=xi, precision=precision_name, device="cpu")
                    moved = np.flatnonzero(times > 0)
                    proven = exact.stays_apart(rounded[moved], kind, np.minimum(times[moved], 1.0), xi)
                    asked, stopped = asked + chunk, stopped + int(np.isfinite(times).sum())
                    for i in moved[~proven]:
                        late += 1
                        print(f"LATE: {family.__name__} {kind} {precision_name} xi {xi!r} time {times[i]!r}")
                        print(rounded[i].tolist())
        elapsed = time.perf_counter() - begin
        print(f"queries: {asked}  stopped: {stopped}  late: {late}  seed: {seed}  minutes: {elapsed / 60:.1f}", flush=True)
    return late


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--queries",
        type=Path,
        action="append",
        default=[],
        help="recorded queries of a real step (npz with vt and ee); may be repeated",
    )
    parser.add_argument("--record", metavar="SCENE", help="write --queries from a step of this scene instead")
    parser.add_argument("--steps", type=int, default=100, help="which step that is")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--output", type=Path, default=REPOSITORY / "benchmarks" / "results" / "ccd.json")
    parser.add_argument("--nightly", type=int, metavar="N", help="hunt for late answers in N queries instead")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.record:
        record(arguments.record, arguments.steps, arguments.queries[0])
        return
    if arguments.nightly:
        sys.exit(1 if nightly(arguments.nightly, arguments.seed) else 0)
    result = {"machine": machine(), "threads": 1, "backoff": BACKOFF, "sets": {}}
    print(result["machine"])
    for name, (kind, points, xi) in query_sets(arguments.queries).items():
        result["sets"][name] = row = compare(kind, points, xi, arguments.repeats)
        show(name, row)
    result["ground truth"] = verdicts()
    print("\nground truth")
    for name, counts in result["ground truth"].items():
        print(f"  {name:20s}{counts}")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
