"""Newton's own cloth and soft-body examples by its SolverVBD and by SolverPDIPC, side by side:
`python benchmarks/newton_examples.py [--examples NAME ...] [--frames N] [--seconds S]`.

Each example is the file that comes with Newton, its sizes cut down by the changes that EXAMPLES lists, alike for both. For pdipc the one
statement that makes the solver is replaced, and the capture of a graph is left out, since a step of pdipc is driven by the host. "1 step" takes one
step a frame of 1/60 s in place of the example's substeps. Each solver runs in a process of its own, on the CPU, until --frames frames or --seconds
of processor time are done.

Prints, and writes to benchmarks/results/newton_examples.json: processor ms a frame (mean, median, worst) and a step (a frame's by its steps: the
median), wall ms a frame, unconverged steps (SolverVBD has no such notion), intersecting frames and the most pairs of triangles that intersect in
one, judged by the witness with obstacles as pdipc sees them; how far the solvers' last common frames are apart; and a picture of both,
docs/newton_NAME.png. Times are without the first frame, which compiles.
"""

import argparse
import ast
import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from pdipc.pictures.render import ANGLE, VIEW
from pdipc.scene.looks import Picture

RESULTS = Path(__file__).parent / "results"
PICTURES = Path(__file__).parents[1] / "docs"
EXAMPLES = {
    "cloth_hanging": ("cloth", [], ["--width", "20", "--height", "10"]),
    "softbody_hanging": ("softbody", [("dim_x = 12", "dim_x = 6"), ("dim_y = 4", "dim_y = 2"), ("dim_z = 4", "dim_z = 2")], []),
    "cloth_poker_cards": (
        "cloth",
        [("self.num_cards = 52", "self.num_cards = 8"), ("self.sphere_start_x = -0.35", "self.sphere_start_x = -0.16")],
        [],
    ),
    "cloth_bending": ("cloth", [("pos=wp.vec3(0.0, 0.0, 10.0)", "pos=wp.vec3(0.0, 0.0, 3.0)")], []),
    "cloth_twist": ("cloth", [], []),
    "softbody_gift": ("multiphysics", [("self.base_height = 20.0", "self.base_height = 2.0")], []),
    "softbody_dropping_to_cloth": ("multiphysics", [("pos=wp.vec3(0.0, 0.0, 2.0)", "pos=wp.vec3(0.0, 0.0, 1.3)")], []),
}
SIDES = ("SolverVBD", "pdipc", "pdipc, 1 step")
AXES = [0, 2, 1]  # pictures have y up, Newton z
FLIP = [1.0, 1.0, -1.0]
SIZE = (960, 600)
FAR = 6.0  # obstacles that are so many times as large as the bodies, such as floors, do not move the camera


# --- one side, one process ---


def source_of(name: str) -> str:
    """The example's file, cut down."""
    folder, changes, _ = EXAMPLES[name]
    spec = importlib.util.find_spec("newton")
    text = (Path(spec.origin).parent / "examples" / folder / f"example_{name}.py").read_text()
    for old, new in changes:
        if old not in text:
            raise SystemExit(f'{name}: "{old}" is not in the example of this version of Newton')
        text = text.replace(old, new)
    return text


def with_pdipc(text: str) -> str:
    """The one change: the statement that makes the solver."""
    lines = text.splitlines()
    (call,) = (
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Call)
        and ast.unparse(node.value.func).endswith("SolverVBD")
    )
    indent = " " * call.col_offset
    lines[call.lineno - 1 : call.end_lineno] = [
        f"{indent}self.solver = __import__('pdipc.newton').newton.SolverPDIPC(self.model)"
    ]
    return "\n".join(lines) + "\n"


def run_side(name: str, side: str, frames: int, seconds: float, out: Path) -> None:
    import newton
    import newton.examples
    import newton.viewer
    import warp as wp

    from pdipc.newton import translate
    from pdipc.scene.assembly import assemble

    wp.set_device("cpu")
    ours = side != "SolverVBD"
    text = with_pdipc(source_of(name)) if ours else source_of(name)
    file = out.with_suffix(".py")
    file.write_text(text)  # Warp reads the source of kernels
    spec = importlib.util.spec_from_file_location(f"example_{name}", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    if ours:
        module.Example.capture = lambda self: setattr(self, "graph", None)
    make = getattr(module.Example, "create_parser", newton.examples.create_parser)
    arguments = make().parse_args(EXAMPLES[name][2])
    warnings.filterwarnings("ignore", message="SolverPDIPC: damping")  # told in docs/newton.md
    example = module.Example(newton.viewer.ViewerNull(num_frames=10**9), arguments)
    if side.endswith("1 step"):
        example.sim_substeps, example.sim_dt = 1, example.frame_dt
    steps = {"taken": 0, "unconverged": 0}
    if ours:
        step = example.solver.step

        def counted(*given, **options):
            step(*given, **options)
            steps["taken"] += 1
            steps["unconverged"] += not example.solver.result.converged

        example.solver.step = counted
    model = example.model
    body_q = model.body_q.numpy() if model.body_count else None
    made = translate.translate(model, model.particle_q.numpy(), body_q, {}, {}, True)
    assembly = assemble(made.scene)
    particles = np.concatenate([part.particles for part in made.parts])
    obstacles = list(zip(made.shapes, assembly.bodies[len(made.parts) :], made.scene.obstacles, strict=True))

    def positions() -> np.ndarray:
        x = assembly.positions.copy()
        x[: len(particles)] = example.state_0.particle_q.numpy()[particles]
        now = example.state_0.body_q.numpy().astype(np.float64) if model.body_count else None
        for shape, body, table in obstacles:
            if shape.body >= 0:
                place, turn = translate.placed(now[shape.body])
                x[body.first : body.last] = turn.apply(table.mesh.vertices) + place
        return x

    found, processor, wall, lag = [positions()], [], [], 0.0
    while len(found) <= frames and (len(found) < 3 or sum(processor[1:]) < 1e3 * seconds):  # the first frame compiles
        cpu, clock = time.process_time(), time.perf_counter()
        example.step()
        processor.append(1e3 * (time.process_time() - cpu))
        wall.append(1e3 * (time.perf_counter() - clock))
        found.append(positions())
        if ours:
            lag = max(lag, example.solver.result.lag)
    topology = {"triangles": assembly.triangles, "obstacle": assembly.obstacle, **assembly.topology()}
    steps["of_a_frame"] = example.sim_substeps
    told = json.dumps({**steps, "lag_m": lag, "scene": json.loads(made.scene.model_dump_json()), "frame_dt": example.frame_dt})
    np.savez(out, frames=np.array(found), processor=processor, wall=wall, told=told, **topology)


# --- the comparison ---


def measure(name: str, side: str, frames: int, seconds: float, folder: Path) -> tuple[dict, dict]:
    import pdipc

    out = folder / f"{name}_{SIDES.index(side)}.npz"
    command = [sys.executable, __file__, "--side", side, "--examples", name, "--frames", str(frames), "--seconds", str(seconds)]
    done = subprocess.run([*command, "--out", str(out)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}, {side} failed:\n{done.stderr[-4000:]}")
    with np.load(out) as file:
        data = {key: file[key] for key in file.files}
    told = json.loads(str(data["told"]))
    finite = [bool(np.isfinite(x).all()) for x in data["frames"]]
    pairs = [
        len(pdipc.find_intersections(x, data["triangles"], data["obstacle"])) if good else -1
        for x, good in zip(data["frames"], finite, strict=True)
    ]
    later = slice(1, None)
    row = {
        "example": name,
        "solver": side,
        "particles": int((~data["obstacle"]).sum()),
        "frames": len(data["frames"]) - 1,
        "steps_of_a_frame": told["of_a_frame"],
        "processor_ms_a_frame": float(np.mean(data["processor"][later])),
        "median_processor_ms_a_frame": float(np.median(data["processor"][later])),
        "worst_processor_ms_a_frame": float(np.max(data["processor"][later])),
        "median_processor_ms_a_step": float(np.median(data["processor"][later])) / told["of_a_frame"],
        "wall_ms_a_frame": float(np.mean(data["wall"][later])),
        "steps": told["taken"] or None,
        "unconverged_steps": told["unconverged"] if told["taken"] else None,
        "lag_m": told["lag_m"] if told["taken"] else None,
        "intersecting_frames": sum(count != 0 for count in pairs),
        "most_pairs": max(pairs),
        "finite": all(finite),
    }
    return row, data


def write_run(data: dict, frame: int, folder: Path) -> None:
    """One frame as a run folder, y up, to draw."""
    from pdipc.output.results import RunWriter

    told = json.loads(str(data["told"]))
    topology = {key: data[key] for key in ("triangles", "tets", "body_of_vertex", "scripted", "body_names", "body_kinds")}
    with RunWriter.create(folder, json.dumps(told["scene"]), topology, {"precision": "float64"}) as writer:
        writer.append(0, 0.0, data["frames"][frame][:, AXES] * FLIP, {})


def camera_of(sides: dict[str, dict], frame: int) -> Picture:
    """One place to look from that shows the bodies of all sides, and what is no larger than FAR of them of obstacles."""
    data = next(iter(sides.values()))
    x = np.concatenate([data["frames"][frame] for data in sides.values()])[:, AXES] * FLIP
    of_vertex = np.tile(data["body_of_vertex"], len(sides))
    obstacle = np.tile(data["obstacle"], len(sides))
    size = np.linalg.norm(np.ptp(x[~obstacle], axis=0))
    near = [x[~obstacle]]
    near += [
        own for k in np.unique(of_vertex[obstacle]) if np.linalg.norm(np.ptp(own := x[of_vertex == k], axis=0)) < FAR * size
    ]
    seen = np.concatenate(near)
    target = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    view = np.array(VIEW) / np.linalg.norm(VIEW)
    right = np.cross([0.0, 1.0, 0.0], view)
    right /= np.linalg.norm(right)
    slope, away = 0.9 * np.tan(np.radians(ANGLE / 2)), seen - target
    across = np.maximum(np.abs(away @ np.cross(view, right)), np.abs(away @ right) * SIZE[1] / SIZE[0])
    position = target + (across / slope + away @ view).max() * view
    return Picture(size=SIZE, position=tuple(position.tolist()), target=tuple(target.tolist()))


def draw(name: str, sides: dict[str, dict], frame: int, folder: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from pdipc.output.results import open_run
    from pdipc.pictures.render import render

    figure, places = plt.subplots(1, len(sides), figsize=(4.8 * len(sides), 3.5))
    looks = camera_of(sides, frame)
    for place, (side, data) in zip(places, sides.items(), strict=True):
        own = folder / f"{name}_{SIDES.index(side)}"
        write_run(data, frame, own)
        picture = own.with_suffix(".png")
        render(open_run(own), 0, picture, looks)
        place.imshow(plt.imread(picture))
        place.set_title(f"{name}, frame {frame}: {side}")
        place.axis("off")
    figure.tight_layout()
    path = PICTURES / f"newton_{name}.png"
    figure.savefig(path, dpi=100)
    plt.close(figure)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", nargs="+", choices=tuple(EXAMPLES), default=list(EXAMPLES))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=60.0, help="Processor time of a solver on an example.")
    parser.add_argument("--side", choices=SIDES, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.side:
        run_side(options.examples[0], options.side, options.frames, options.seconds, options.out)
        return
    os.environ.setdefault("PDIPC_THREADS", "1")  # as many as Warp's launches take on the CPU
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "newton_examples.json"
    info = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    machine = {
        "machine": next((line.split(":")[1].strip() for line in info if "model name" in line), platform.processor()),
        "cores": os.cpu_count(),
        "threads": os.environ["PDIPC_THREADS"],
        "date": time.strftime("%Y-%m-%d"),
        "commit": subprocess.run(
            ["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=RESULTS.parent
        ).stdout.strip(),
    }
    rows: list[dict] = []
    for name in options.examples:
        with tempfile.TemporaryDirectory() as place:
            sides = {}
            for side in SIDES:
                row, sides[side] = measure(name, side, options.frames, options.seconds, Path(place))
                row["load"] = os.getloadavg()[0]
                rows.append(row)
                print(json.dumps(row), flush=True)
            common = min(len(data["frames"]) for data in sides.values()) - 1
            x = {side: data["frames"][common] for side, data in sides.items()}
            for row in rows[-len(SIDES) :]:
                apart = x[row["solver"]] - x["SolverVBD"]
                row["mean_distance_to_vbd_m"] = float(np.linalg.norm(apart[: row["particles"]], axis=1).mean())
                row["common_frames"] = common
            print(draw(name, sides, common, Path(place)))
        path.write_text(json.dumps({**machine, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
