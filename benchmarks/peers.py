"""The peers' scenes S1 to S4 (peer_scenes.py) by pdipc and by Newton's SolverVBD, in one run:
`python benchmarks/peers.py [--scenes s2_10 ...] [--steps N] [--seconds S] [--sides ...]`.

Same meshes, materials, masses, step of 1/100 s and number of steps; each solver in a process of its own, on the CPU, until --steps steps or
--seconds of processor time are done. Prints a table and writes benchmarks/results/peers.json with the machine named.

What differs, and has to be known to read the table:
- pdipc ends a step when it has converged (tolerance 0.01 m/s), in float64; SolverVBD after --iterations sweeps of each of --substeps substeps, in
  float32, whatever is left then. `height` is the mean height of the bodies' vertices after the last step that all took, to see how far
  they agree on the motion.
- "newton": obstacles are mesh shapes, which particles of RADIUS keep away from by a penalty; self-contact is on. "newton, truncated": with its
  penetration-free truncation against shapes as well (rigid_soft_enable_dat), and contact of whole surfaces.
- Intersections are judged by the witness, obstacles where the script has them; SolverVBD keeps RADIUS between surfaces, so any is a failure of its own.
- Both run in one thread: PDIPC_THREADS=1, as Warp's CPU launches do.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import peer_scenes

RESULTS = Path(__file__).parent / "results" / "peers.json"
SIDES = ("pdipc", "newton", "newton, truncated")
RADIUS = 2e-3  # m, of Newton's particles: the distance that contact forces begin at
GAP = 0.02  # m: how far around surfaces Newton looks for contacts, twice what the fastest body moves in a step
STIFFNESS = {"cloth": 1e4, "solid": 1e6}  # N/m of Newton's contacts: bodies at rest sink by less than RADIUS
VERTEX_BUFFER, EDGE_BUFFER, BODY_BUFFER = 64, 128, 8192  # pairs that Newton has room for; what does not fit it drops


# --- one side, one process: positions (steps + 1, n, 3) of bodies, then obstacles, and what it took ---


class Recorder:
    """Takes steps until there are enough, or their processor time is spent; the first, which compiles, does not count."""

    def __init__(self, steps: int, seconds: float):
        self.steps, self.seconds = steps, seconds
        self.frames: list[np.ndarray] = []
        self.processor: list[float] = []
        self.wall: list[float] = []

    def run(self, step, positions) -> None:
        self.frames.append(positions())
        while len(self.processor) < self.steps and sum(self.processor[1:]) < 1e3 * self.seconds:
            cpu, clock = time.process_time(), time.perf_counter()
            step()
            self.processor.append(1e3 * (time.process_time() - cpu))
            self.wall.append(1e3 * (time.perf_counter() - clock))
            self.frames.append(positions())


def run_ours(name: str, recorder: Recorder) -> int:
    """Returns the number of unconverged steps."""
    import pdipc

    simulation = pdipc.Simulation(peer_scenes.scene(name), "cpu")
    missed = 0

    def step() -> None:
        nonlocal missed
        missed += not simulation.step().converged

    recorder.run(step, lambda: simulation.positions)
    return missed


def newton_model(scene, assembly):
    """The scene in Newton's terms, and the bodies of its obstacles that move."""
    import newton
    import warp as wp

    builder = newton.ModelBuilder(gravity=tuple(scene.simulation.gravity))
    here, kind = wp.quat_identity(), "solid"
    for body, table in zip(assembly.bodies, (*scene.bodies, *scene.obstacles), strict=True):
        x = assembly.rest_positions[body.first : body.last]
        if body.kind == "obstacle":
            moving = table.motion is not None
            number = builder.add_body(is_kinematic=True, mass=1.0) if moving else -1
            config = newton.ModelBuilder.ShapeConfig(ke=STIFFNESS[kind], kd=1e-2, mu=0.0, margin=0.0)
            mesh = newton.Mesh(x.astype(np.float32), (body.triangles - body.first).ravel(), compute_inertia=False)
            builder.add_shape_mesh(number, mesh=mesh, cfg=config)
            continue
        m, kind = body.material, body.kind
        velocity = wp.vec3(*map(float, assembly.velocities[body.first]))
        place = {"pos": wp.vec3(0.0), "rot": here, "scale": 1.0, "vel": velocity, "particle_radius": RADIUS}
        vertices = [wp.vec3(*map(float, p)) for p in x]
        if kind == "solid":
            E, nu = m.young_modulus, m.poisson_ratio
            lame = {"k_mu": E / (2 * (1 + nu)), "k_lambda": E * nu / ((1 + nu) * (1 - 2 * nu)), "k_damp": 0.0}
            indices = (body.tets - body.first).ravel().tolist()
            builder.add_soft_mesh(vertices=vertices, indices=indices, density=m.density, **place, **lame)
        else:
            Y, nu = m.membrane_stiffness, m.poisson_ratio
            corners = x[body.triangles - body.first]
            area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).mean()
            edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean()
            stiff = {"tri_ke": Y / (2 * (1 + nu)), "tri_ka": Y * nu / (1 - nu * nu), "tri_kd": 0.0}
            # a hinge's energy: ke l theta^2 / 2 there, D l^2 theta^2 / (2 A) with A of both triangles here
            stiff |= {"edge_ke": m.bending_stiffness * edge / (2 * area), "edge_kd": 0.0}
            indices = (body.triangles - body.first).ravel().tolist()
            builder.add_cloth_mesh(vertices=vertices, indices=indices, density=m.areal_density, **place, **stiff)
    builder.color(include_bending=kind == "cloth")
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = STIFFNESS[kind], 1e-2, 0.0
    return model


def run_newton(name: str, side: str, recorder: Recorder, iterations: int, substeps: int) -> None:
    import newton
    import warp as wp

    from pdipc.scene.assembly import assemble

    wp.set_device("cpu")
    scene = peer_scenes.scene(name)
    assembly = assemble(scene)
    model = newton_model(scene, assembly)
    truncated = side.endswith("truncated")
    whole = {"enable_rigid_soft_full_surface_contact": True} if truncated else {}
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=GAP, **whole)
    options = {
        "iterations": iterations,
        "particle_enable_self_contact": True,
        "particle_self_contact_margin": RADIUS,
        "particle_self_contact_gap": 4 * RADIUS,
        "particle_enable_tile_solve": False,
        "particle_vertex_contact_buffer_size": VERTEX_BUFFER,
        "particle_edge_contact_buffer_size": EDGE_BUFFER,
    }
    if truncated:
        options |= {
            "rigid_soft_enable_dat": True,
            "collision_pipeline": pipeline,
            "rigid_body_particle_contact_buffer_size": BODY_BUFFER,
        }
    solver = newton.solvers.SolverVBD(model, **options)
    states, control = [model.state(), model.state()], model.control()
    contacts = None if truncated else pipeline.contacts()
    moving = [body for body in assembly.bodies if body.kind == "obstacle" and not body.trajectory.is_static]
    count, h, taken = model.particle_count, peer_scenes.H, 0

    def substep() -> None:
        states[0].clear_forces()
        if not truncated:
            pipeline.collide(states[0], contacts)
        solver.step(states[0], states[1], control, contacts, h / substeps)
        states.reverse()

    def once() -> None:
        for _ in range(substeps):
            substep()

    graph = None
    if not moving and substeps % 2 == 0:  # as Newton's examples do: recorded, then replayed
        with wp.ScopedCapture(device="cpu") as capture:
            once()
        graph = capture.graph

    def step() -> None:
        nonlocal taken
        if graph is not None:
            wp.capture_launch(graph)
            taken += 1
            return
        for k in range(substeps):
            time_at = (taken + (k + 1) / substeps) * h
            for state in states if moving else ():
                q = state.body_q.numpy()
                for number, body in enumerate(moving):
                    q[number, :3] = body.trajectory.pose(time_at)[1]
                state.body_q.assign(q)
            substep()
        taken += 1

    def positions() -> np.ndarray:
        x = assembly.positions.copy()
        x[:count] = states[0].particle_q.numpy()
        for body in moving:
            own = slice(body.first, body.last)
            x[own] = body.trajectory.apply(assembly.positions[own], taken * h)
        return x

    recorder.run(step, positions)


# --- the comparison ---


def inverted(x: np.ndarray, tets: np.ndarray) -> int:
    """Tets of negative volume."""
    a, b, c, d = np.moveaxis(x[tets], 1, 0)
    return int((np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) <= 0).sum())


def measure(name: str, side: str, options: argparse.Namespace, folder: Path) -> tuple[dict, np.ndarray]:
    """A row, and the mean height of bodies after each step, m: one solver on one scene, in a process of its own."""
    import pdipc
    from pdipc.scene.assembly import assemble

    out = folder / "out.npz"
    command = [sys.executable, __file__, "--side", side, "--scenes", name, "--out", str(out)]
    for key in ("steps", "seconds", "iterations", "substeps"):
        command += [f"--{key}", str(getattr(options, key))]
    done = subprocess.run(command, env={**os.environ, "PDIPC_THREADS": "1"}, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{side} failed on {name}:\n{done.stderr[-3000:]}")
    assembly = assemble(peer_scenes.scene(name))
    with np.load(out) as file:
        frames, processor, wall = file["frames"], file["processor"][1:], file["wall"][1:]
        missed, memory = int(file["missed"]), float(file["memory"])
    finite = np.isfinite(frames).all(axis=(1, 2))
    pairs = [
        len(pdipc.find_intersections(x, assembly.triangles, assembly.obstacle)) if good else -1
        for x, good in zip(frames, finite, strict=True)
    ]
    row = {
        "scene": name,
        "solver": side,
        "steps": len(frames) - 1,
        "median_processor_ms": float(np.median(processor)),
        "worst_processor_ms": float(processor.max()),
        "total_processor_s": float(processor.sum() / 1e3),
        "median_wall_ms": float(np.median(wall)),
        "unconverged": missed if side == "pdipc" else None,
        "intersecting_frames": sum(count != 0 for count in pairs),
        "most_pairs": max(pairs),
        "inverted_tets": max(inverted(x, assembly.tets) for x in frames[finite]) if len(assembly.tets) else 0,
        "finite": bool(finite.all()),
        "peak_memory_mb": memory,
        "load": os.getloadavg()[0],
    }
    return row, frames[:, ~assembly.obstacle, 2].mean(axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=peer_scenes.SCENES, default=["s2_10", "s4_10", "s3_8", "s1_50"])
    parser.add_argument("--sides", nargs="+", choices=SIDES, default=list(SIDES))
    parser.add_argument("--steps", type=int, default=peer_scenes.STEPS)
    parser.add_argument("--seconds", type=float, default=600.0, help="Processor time of a solver on a scene.")
    parser.add_argument("--iterations", type=int, default=10, help="Newton's sweeps a substep.")
    parser.add_argument("--substeps", type=int, default=4, help="Newton's substeps of a step.")
    parser.add_argument("--side", choices=SIDES, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.side:
        recorder, missed = Recorder(options.steps, options.seconds), 0
        if options.side == "pdipc":
            missed = run_ours(options.scenes[0], recorder)
        else:
            run_newton(options.scenes[0], options.side, recorder, options.iterations, options.substeps)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        times = {"processor": recorder.processor, "wall": recorder.wall}
        np.savez(options.out, frames=np.array(recorder.frames), missed=missed, memory=memory, **times)
        return
    info = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    report = {
        "machine": next((line.split(":")[1].strip() for line in info if "model name" in line), platform.processor()),
        "cores": os.cpu_count(),
        "date": time.strftime("%Y-%m-%d"),
        "commit": subprocess.run(
            ["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent
        ).stdout.strip(),
        "newton": {"iterations": options.iterations, "substeps": options.substeps, "radius": RADIUS, "stiffness": STIFFNESS},
        "rows": [],
    }
    print(
        f"{'scene':6} {'solver':18} {'steps':>5} {'median ms':>10} {'worst ms':>9} {'unconv':>6} {'inters':>6} {'inverted':>8} {'height':>8}"
    )
    options.output.parent.mkdir(exist_ok=True)
    for name in options.scenes:
        with tempfile.TemporaryDirectory() as folder:
            measured = [measure(name, side, options, Path(folder)) for side in options.sides]
        common = min(row["steps"] for row, _ in measured)
        for row, heights in measured:
            row |= {"common_step": common, "height_m": float(heights[common])}
            report["rows"].append(row)
            missed = "" if row["unconverged"] is None else row["unconverged"]
            print(
                f"{name:6} {row['solver']:18} {row['steps']:5} {row['median_processor_ms']:10.1f} {row['worst_processor_ms']:9.1f} "
                f"{missed:>6} {row['intersecting_frames']:6} {row['inverted_tets']:8} {row['height_m']:8.4f} after {common}",
                flush=True,
            )
        options.output.write_text(json.dumps(report, indent=1) + "\n")  # what was measured stays, whatever happens to the rest


if __name__ == "__main__":
    main()
