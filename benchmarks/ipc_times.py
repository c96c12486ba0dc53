"""Times the IPC baseline: seconds a step on this machine, written to results/ipc.json.

    python benchmarks/ipc_times.py [SCENE ...] [--steps N]

Scenes: block10 (a soft block of 10^3 cells dropped on a floor), three (three spheres falling into a box), armadillo_9k and
armadillo_55k (flattened between two boards; of the optional test data). One line a step; medians in the file, with the
machine's load.
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from pathlib import Path

import numpy as np

from pdipc.baselines import common, contact, energies, ipc

H, TOLERANCE = 0.01, 1e-5  # s; tolerance in scene sizes, as the simulator's default
DATA = Path(os.environ.get("PDIPC_DATA", Path(__file__).parents[2] / "shared" / "data"))


def problem(bodies, obstacles, *, young=1e5, poisson=0.3, density=1000.0, activation=1e-3, velocity=(0.0, 0.0, 0.0)):
    """An `ipc.Problem` of soft bodies [(positions, tets)] and obstacles [(positions, triangles)], and its first state.

    activation: d_hat, of the size of the bodies' bounding box.
    """
    positions, tets, triangles, body = [], [], [], []
    count = 0
    for k, (x, t) in enumerate(bodies):
        tets.append(t + count)
        triangles.append(common.boundary(t) + count)
        positions.append(x)
        body.append(np.full(len(x), k))
        count += len(x)
    free = count
    for x, t in obstacles:
        triangles.append(t + count)
        positions.append(x)
        body.append(np.full(len(x), len(bodies) + len(body)))
        count += len(x)
    rest, tets = np.concatenate(positions), np.concatenate(tets)
    size = float(np.linalg.norm(np.ptp(rest[:free], axis=0)))
    kinematic = np.arange(count) >= free
    volumes = energies.tet_volumes(rest, tets)
    masses = common.lumped_tet_masses(count, tets, volumes, density)
    mu = young / (2 * (1 + poisson))
    surface = contact.Surface(rest, np.concatenate(triangles), kinematic)
    d_hat = activation * size
    touching = contact.DistanceBarrier(
        surface,
        rest,
        stiffness=np.where(kinematic, 0.0, masses[:free].mean() / H**2),
        activation=d_hat,
        separation=0.02 * d_hat,
        body=np.concatenate(body),
    )
    terms = [energies.tet_strain(rest, tets, 2 * mu * volumes)]
    velocities = np.where(kinematic[:, None], 0.0, np.asarray(velocity))
    return ipc.Problem(masses, terms, H, kinematic, touching), ipc.State(rest.copy(), velocities), size


def block10():
    """A block of 20 cm and 10^3 cells, 1 cm above a floor."""
    return *problem([common.box((0.2,) * 3, (10,) * 3, (0, 0.11, 0))], [common.sheet((2, 2), (1, 1))]), None


def three():
    """Three spheres of 20 cm fall into an open box of 26 cm."""
    bodies = []
    for k, (dx, dz) in enumerate(((0.01, 0.0), (-0.015, 0.01), (0.01, -0.01))):
        x, t = common.box((0.2,) * 3, (6,) * 3)
        reach = np.abs(x).max(axis=1)
        length = np.linalg.norm(x, axis=1)
        x *= np.where(length > 0, reach / np.maximum(length, 1e-12), 0.0)[:, None]
        bodies.append((x + np.array([dx, 0.12 + 0.22 * k, dz]), t))
    floor, faces = common.sheet((0.26, 0.26), (1, 1))
    walls = [(floor, faces)]
    for angle in range(4):
        c, s = np.cos(0.5 * np.pi * angle), np.sin(0.5 * np.pi * angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        wall = floor[:, [1, 0, 2]] * (1, 3, 1) + (-0.1301, 0.391, 0)
        walls.append((wall @ turn.T, faces))
    return *problem(bodies, walls), None


def flatten(name, seconds=1.0, final=0.3):
    """An Armadillo of unit height between two boards that close to 30 % of its thickness within a second, without gravity."""
    path = DATA / "meshes" / "tet" / f"{name}.npz"
    if not path.is_file():
        sys.exit(f"{path} is missing: this scene needs the optional test data")
    mesh = np.load(path)
    x, tets = mesh["V"].astype(float), mesh["T"]
    x = (x - 0.5 * (x.min(axis=0) + x.max(axis=0))) / np.ptp(x, axis=0).max()
    if np.median(energies.tet_volumes(x, tets)) < 0:
        tets = tets[:, [0, 2, 1, 3]]
    low, high = x[:, 2].min() - 0.005, x[:, 2].max() + 0.005
    board, faces = common.sheet((2, 2), (1, 1))
    board = board[:, [0, 2, 1]]
    boards = [(board + np.array([0, 0, z]), faces) for z in (low, high)]
    made, state, size = problem([(x, tets)], boards, young=5e4)
    made.gravity = (0.0, 0.0, 0.0)
    start = state.positions

    def targets(time):
        moved = start.copy()
        part = (1 - final) * min(time / seconds, 1.0)
        moved[made.kinematic, 2] *= 1 - part
        return moved

    return made, state, size, targets


SCENES = {
    "block10": block10,
    "three": three,
    "armadillo_9k": lambda: flatten("armadillo_9k"),
    "armadillo_55k": lambda: flatten("armadillo_55k"),
}


def run(name: str, steps: int) -> dict:
    """Runs a scene; returns its numbers."""
    made, state, size, targets = SCENES[name]()
    infos, contacts, load = [], [], []
    for k in range(steps):
        target = None if targets is None else targets((k + 1) * H)
        state, info = ipc.step(made, state, targets=target, tolerance=TOLERANCE * size)
        if made.contact.surface.intersects(state.positions):
            sys.exit(f"{name}: step {k} intersects")
        contacts.append(len(made.contact.pairs(state.positions).quads))
        infos.append(info)
        load.append(os.getloadavg()[0])
        print(
            f"{name} {k + 1}/{steps}: {info.seconds:.2f} s (solver {info.solve_seconds:.2f} s), {info.iterations} iterations, "
            f"{contacts[-1]} barriers, gap {info.smallest_gap:.2e} m, lag {info.lag:.1e} m, converged {info.converged}",
            flush=True,
        )
    seconds = [info.seconds for info in infos]
    return {
        "vertices": len(made.free),
        "tets": len(made.terms[0].vertices),
        "steps": steps,
        "seconds_per_step_median": statistics.median(seconds),
        "seconds_per_step_mean": statistics.fmean(seconds),
        "seconds_per_step_max": max(seconds),
        "solver_share": sum(info.solve_seconds for info in infos) / sum(seconds),
        "newton_iterations_mean": statistics.fmean(info.iterations for info in infos),
        "barriers_max": max(contacts),
        "unconverged_steps": sum(not info.converged for info in infos),
        "largest_lag_m": max(info.lag for info in infos),
        "intersections": 0,
        "load_average": statistics.fmean(load),  # above the number of cores, other work slowed this down
    }


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--steps", type=int, default=50)
    arguments = parser.parse_args()
    if unknown := set(arguments.scenes) - set(SCENES):
        parser.error(f"no scene {sorted(unknown)}; there are {', '.join(SCENES)}")
    path = Path(__file__).parent / "results" / "ipc.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    for name in arguments.scenes or ("block10", "three", "armadillo_9k"):
        numbers = run(name, arguments.steps)
        numbers |= {"machine": f"{processor()}, {os.cpu_count()} cores", "linear_solver": common.Cholesky.name}
        results[name] = numbers | {"date": time.strftime("%Y-%m-%d")}
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
