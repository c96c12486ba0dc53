"""The scenes of simulation.py by pdipc and by Newton's SolverVBD, in one run: `python benchmarks/peers.py [--scene NAME] [--steps N]`.

Same meshes, materials, step of 1/100 s, number of steps, float32; each solver in a process of its own. Newton's Python may be another
one (--newton-python), which needs Newton alone. Prints a table and writes benchmarks/results/peers.json with the machine named.

What differs, and has to be known to read the table:
- Newton stops after --iterations sweeps, pdipc when a step has converged. Newton's own cloth example takes 10 substeps of 4 sweeps a
  frame of 1/60 s; --substeps and --iterations set it. `height` is the mean height of the bodies' vertices at the end, to see
  how far the two agree on the motion.
- Newton's guarantee against penetration is between surfaces of particles; so obstacles enter as particles that are held, or put where
  the script says before each substep. It cuts each motion between two detections to 0.425 of the query radius (margin + gap):
  the gap is therefore made as large as what falls fastest needs in a substep (--gap).
- Warp's CPU launches, and so Newton's steps, run in one thread. pdipc is measured in one thread, too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

H = 0.01
CONTACT_STIFFNESS = 1e4  # N/m: Newton's, of a quadratic penalty that turns into a logarithmic barrier at half the margin
VERTEX_BUFFER, EDGE_BUFFER = 64, 256  # pairs a vertex, an edge; what does not fit is dropped by Newton


# --- the scene as numbers: all that Newton's process needs ---


def scene_of(name: str):
    """A scene of simulation.py in float32, with a minimum separation that float32 resolves at 2 m."""
    from simulation import SCENES

    import pdipc

    tables = SCENES[name]()
    tables["contact"]["minimum_separation"] = 5e-5
    return pdipc.Scene(simulation={"time_step": H, "precision": "float32"}, **tables)


def describe(name: str, steps: int, substeps: int) -> dict[str, np.ndarray]:
    """Meshes, materials and scripted positions of a scene, as flat arrays."""
    from pdipc.model import build
    from pdipc.scene.movers import movers_of

    model = build(scene_of(name), "cpu")
    assembly, bodies = model.assembly, []
    times = H / substeps * np.arange(1, steps * substeps + 1)
    held = assembly.kinematic_vertices
    moves = any(not mover.still for mover in movers_of(assembly))
    arrays = {
        "x": assembly.positions,
        "v": assembly.velocities,
        "triangles": assembly.triangles,
        "scripted": assembly.scripted,
        "obstacle": assembly.obstacle,
        "held": held,
        "targets": np.array([assembly.kinematic_positions(t) for t in times]) if moves else np.zeros((0, len(held), 3)),
        "activation_distance": np.array(assembly.activation_distance),
        "friction": np.array(model.scene.contact.friction),
    }
    for i, body in enumerate(assembly.bodies):
        m = body.material
        bodies.append({"kind": body.kind, "first": body.first, "last": body.last})
        if body.kind == "solid":
            E, nu = m.young_modulus, m.poisson_ratio
            lame = {"k_mu": E / (2 * (1 + nu)), "k_lambda": E * nu / ((1 + nu) * (1 - 2 * nu))}
            bodies[-1] |= {"density": m.density, **lame}
        elif body.kind == "cloth":
            Y, nu = m.membrane_stiffness, m.poisson_ratio
            lame = {"tri_ke": Y / (2 * (1 + nu)), "tri_ka": Y * nu / (1 - nu * nu)}
            bodies[-1] |= {"density": m.areal_density, **lame, "bending_stiffness": m.bending_stiffness}
        arrays[f"elements{i}"] = (body.tets if body.kind == "solid" else body.triangles).reshape(-1)
    return {**arrays, "bodies": np.array(json.dumps(bodies))}


# --- one solver, one process ---


def run_ours(name: str, steps: int, device: str) -> tuple[list[float], list[np.ndarray]]:
    import pdipc

    simulation = pdipc.Simulation(scene_of(name), device)
    simulation.step()  # compiles
    simulation.reset()
    times, frames = [], []
    for _ in range(steps):
        start = time.perf_counter()
        simulation.step()
        times.append(1e3 * (time.perf_counter() - start))
        frames.append(simulation.positions)
    return times, frames


def newton_model(scene: dict[str, np.ndarray], device: str):
    """The scene in Newton's terms. Elements' own indices count from their body's first vertex."""
    import newton
    import warp as wp

    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -9.81, 0.0))
    place = {"pos": wp.vec3(), "rot": wp.quat_identity(), "scale": 1.0, "vel": wp.vec3()}
    for i, body in enumerate(json.loads(str(scene["bodies"]))):
        first, last, kind = body.pop("first"), body.pop("last"), body.pop("kind")
        vertices = [wp.vec3(*p) for p in scene["x"][first:last].tolist()]
        elements = (scene[f"elements{i}"] - first).tolist()
        if kind == "solid":
            builder.add_soft_mesh(vertices=vertices, indices=elements, k_damp=0.0, **place, **body)
            continue
        bending = body.pop("bending_stiffness", 0.0)
        corners = scene["x"][scene[f"elements{i}"].reshape(-1, 3)]
        edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).mean()
        # a hinge of length l between areas A turns by the curvature times 2 (A + A) / (3 l): its energy per angle^2 is 3 D l^2 / (8 A)
        material = body or {"density": 1.0, "tri_ke": 0.0, "tri_ka": 0.0}
        material |= {"tri_kd": 0.0, "edge_ke": 0.75 * bending * edge / area, "edge_kd": 0.0}
        builder.add_cloth_mesh(vertices=vertices, indices=elements, **place, **material)
    held = scene["held"].tolist()
    for vertex in held:
        builder.particle_mass[vertex] = 0.0
        builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
    builder.particle_qd = [wp.vec3(*v) for v in scene["v"].tolist()]
    builder.color(include_bending=True)
    model = builder.finalize(device=device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = CONTACT_STIFFNESS, 0.0, float(scene["friction"])
    return model


def run_newton(scene: dict[str, np.ndarray], steps: int, device: str, iterations: int, substeps: int, gap: float | None):
    import newton
    import warp as wp

    model = newton_model(scene, device)
    held = wp.array(scene["held"], dtype=wp.int32, device=device)
    margin = float(scene["activation_distance"])
    query = margin + gap if gap is not None else max(2 * margin, fastest(scene, steps) * H / substeps / 0.425)
    options = {
        "iterations": iterations,
        "particle_enable_self_contact": True,
        "particle_self_contact_margin": margin,
        "particle_self_contact_gap": query - margin,
        "particle_vertex_contact_buffer_size": VERTEX_BUFFER,
        "particle_edge_contact_buffer_size": EDGE_BUFFER,
    }

    @wp.kernel
    def put(
        vertices: wp.array(dtype=wp.int32), to: wp.array(dtype=wp.vec3), a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3)
    ):
        i = wp.tid()
        a[vertices[i]] = to[i]
        b[vertices[i]] = to[i]

    def run(count: int) -> tuple[list[float], list[np.ndarray]]:
        solver = newton.solvers.SolverVBD(model, **options)
        now, after, control = model.state(), model.state(), model.control()
        targets = [wp.array(each, dtype=wp.vec3, device=device) for each in scene["targets"][: count * substeps]]
        times, frames = [], []
        for step in range(count):
            start = time.perf_counter()
            solver.rebuild_bvh(now)
            for substep in range(step * substeps, (step + 1) * substeps):
                now.clear_forces()
                if targets:
                    wp.launch(put, len(held), inputs=[held, targets[substep], now.particle_q, after.particle_q], device=device)
                solver.step(now, after, control, None, H / substeps)
                now, after = after, now
            wp.synchronize_device(device)
            times.append(1e3 * (time.perf_counter() - start))
            frames.append(now.particle_q.numpy().copy())  # on the CPU a view
        return times, frames

    run(1)  # compiles
    return run(steps)


def fastest(scene: dict[str, np.ndarray], steps: int) -> float:
    """m/s: of a body that falls through all of the height that it has below it, or as long as the run lasts."""
    free = ~scene["scripted"]
    start = np.abs(scene["v"]).max()
    drop = max(0.0, scene["x"][free, 1].min() - scene["x"][~free, 1].min())
    return min(np.sqrt(start**2 + 2 * 9.81 * drop), start + 9.81 * H * steps)


# --- the comparison ---


def measure(label: str, name: str, options: argparse.Namespace, folder: Path, scene: dict[str, np.ndarray]) -> dict:
    """Runs one solver in its own process, and counts what intersects."""
    from simulation import spread

    import pdipc

    threads = {"1 thread": "1"}.get(label.partition(", ")[2])
    python = options.newton_python if label.startswith("newton") else sys.executable
    own = ["--iterations", str(options.iterations), "--substeps", str(options.substeps)]
    own += [] if options.gap is None else ["--gap", str(options.gap)]
    side = ["--side", label.partition(",")[0], "--folder", str(folder), "--device", options.device]
    command = [python, __file__, "--scene", name, "--steps", str(options.steps), *side, *own]
    environment = {**os.environ, **({"PDIPC_THREADS": threads} if threads else {})}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{label} failed on {name}:\n{done.stderr[-3000:]}")
    with np.load(folder / "out.npz") as out:
        times, frames = out["times"].tolist(), out["frames"].astype(np.float64)
    finite = [bool(np.isfinite(frame).all()) for frame in frames]
    pairs = [
        len(pdipc.find_intersections(frame, scene["triangles"], scene["obstacle"])) if good else -1
        for frame, good in zip(frames, finite, strict=True)
    ]
    return {
        "scene": name,
        "solver": label,
        "steps": len(times),
        **spread(times),
        "intersections_final": pairs[-1],
        "intersections_worst": max(pairs),
        "frames_with_intersections": sum(count != 0 for count in pairs),
        "finite": all(finite),
        "height": float(frames[-1][~scene["scripted"], 1].mean()),
    }


def has_newton(python: str) -> bool:
    return subprocess.run([python, "-c", "import newton"], capture_output=True).returncode == 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scene", action="append", help="A scene of simulation.py; may be repeated. Default: all but the largest."
    )
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--newton-python", default=sys.executable, metavar="PATH", help="Interpreter that has Newton.")
    parser.add_argument("--iterations", type=int, default=10, help="Newton's sweeps a substep.")
    parser.add_argument("--substeps", type=int, default=4, help="Newton's substeps in 1/100 s.")
    parser.add_argument("--gap", type=float, help="m: Newton's detection beyond the margin; default: what the fall needs.")
    parser.add_argument("--side", choices=("pdipc", "newton"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.side:
        if options.side == "pdipc":
            times, frames = run_ours(options.scene[0], options.steps, options.device)
        else:
            with np.load(options.folder / "scene.npz") as file:
                scene = {key: file[key] for key in file.files}
            peer = (options.iterations, options.substeps, options.gap)
            times, frames = run_newton(scene, options.steps, options.device, *peer)
        np.savez(options.folder / "out.npz", times=times, frames=np.array(frames, dtype=np.float32))
        return

    from simulation import SCENES, machine

    if unknown := [name for name in options.scene or [] if name not in SCENES]:
        parser.error(f"--scene {unknown[0]}: there are: {', '.join(SCENES)}")
    labels = ["pdipc", "pdipc, 1 thread"] if options.device == "cpu" else ["pdipc"]
    if has_newton(options.newton_python):
        labels.append("newton")
    else:
        print(f'{options.newton_python} has no Newton: pdipc alone is measured ("pip install newton", or --newton-python PATH)')
    settings = {"iterations": options.iterations, "substeps": options.substeps, "gap": options.gap}
    settings |= {"contact_stiffness": CONTACT_STIFFNESS, "buffers": [VERTEX_BUFFER, EDGE_BUFFER]}
    rows = []
    report = {
        "machine": machine(),
        "device": options.device,
        "load_average": os.getloadavg()[0],
        "newton": settings,
        "rows": rows,
    }
    out = Path(__file__).parent / "results" / "peers.json"
    out.parent.mkdir(exist_ok=True)
    print(
        f"{'scene':24} {'solver':16} {'median ms':>10} {'quartiles':>18} {'mean ms':>10} {'final':>6} {'worst':>6} {'height':>8}"
    )
    for name in options.scene or [name for name in SCENES if name != "cloth 200x200"]:
        scene = describe(name, options.steps, options.substeps)
        for label in labels:
            with tempfile.TemporaryDirectory() as folder:
                np.savez(Path(folder) / "scene.npz", **scene)
                row = measure(label, name, options, Path(folder), scene)
            rows.append(row)
            low, high = row["quartiles_ms"]
            print(
                f"{name:24} {label:16} {row['median_ms']:10.1f} {f'{low:.1f} to {high:.1f}':>18} {row['mean_ms']:10.1f} "
                f"{row['intersections_final']:6} {row['intersections_worst']:6} {row['height']:8.4f}",
                flush=True,
            )
            out.write_text(json.dumps(report, indent=1))  # what was measured stays, whatever happens to the rest


if __name__ == "__main__":
    main()
