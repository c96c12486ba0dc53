"""An attack on the guarantee: `python benchmarks/attack.py [--scenes N] [--seed S] [--minutes M] [--family NAME ...]`.

Small scenes of families that are made to break it, with every solver, both methods, both precisions and every culling. Every motion that
an outer iteration commits is judged by brute force over all pairs, in exact arithmetic where rounding leaves a doubt
(tests/collision/exact.py), and every state by the witness; motions must follow one another without a break, what turns must be near its arc, and a run
that is resumed must give the same bits. A breach is printed with the scene's family and number, from which `--family NAME --only NUMBER` makes it again.

It must end with "breaches: 0". Scenes that are refused are counted, not judged. Writes benchmarks/results/attack.json after each number; with
`--log FILE` each outcome is a line of FILE, and a scene of this seed that FILE holds already is not run again.
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
import warnings
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY / "tests"), str(REPOSITORY / "benchmarks")]

import attack_families  # noqa: E402
from attack_families import Case, ball, block, loose, power, sheet, turn, vector  # noqa: E402
from ccd import machine  # noqa: E402
from collision import exact  # noqa: E402

import pdipc  # noqa: E402

STEPS, SECONDS, MOTIONS = 10, 6.0, 60  # of a scene, at most; seconds of work
SOLVERS = ("auto", "pcg", "two-level", "jacobi", "chebyshev", "matrix-powers", "gauss-seidel", "sor", "direct")


# --- families: f(rng) -> (bodies, obstacles, simulation, contact), of which any but the first may be empty; more in attack_families ---


def far_from_origin(rng):
    single = rng.random() < 0.4
    place = np.array(vector(rng, power(rng, 1, 3) if single else power(rng, 2, 8)))
    bodies = [
        sheet("cloth", translation=(place + np.array([0, 0.32, 0])).tolist(), rotation=turn(rng, 10), velocity=vector(rng, 3))
    ]
    d = 2e-2 if single else max(2e-3, 1e-7 * np.linalg.norm(place))
    contact = {"activation_distance": d}
    return bodies, [ball("ball", 0.25, translation=place.tolist())], {"precision": "float32" if single else "float64"}, contact


def millimetres_to_kilometres(rng):
    s = power(rng, -4, 4)
    bodies = [
        block("block", 0.3 * s, translation=[0, 0.3 * s, 0], velocity=vector(rng, 3 * s), rotation=turn(rng)),
        sheet("cloth", s, translation=[0, 0.8 * s, 0], velocity=[0, -10 * s * rng.random(), 0], rotation=turn(rng, 10)),
    ]
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 4 * s}, "translation": [0, -0.05 * s, 0]}
    return bodies, [floor], {"gravity": [0, -9.81 * s, 0]}, {"activation_distance": s * power(rng, -5, -1.5)}


def strip(rng, length: float, width: float, count: int):
    """A ribbon of needles: vertices on two long rails, in a random order along them."""
    x = np.sort(rng.uniform(-length / 2, length / 2, count))
    vertices = np.array([[a, 0, width * (k % 2)] for k, a in enumerate(x)])
    return vertices, np.array([[k, k + 1, k + 2] if k % 2 else [k + 1, k, k + 2] for k in range(count - 2)])


def needles(rng):
    width = power(rng, -5, -1)
    bodies = []
    for k in range(3):
        body = loose(f"ribbon{k}", *strip(rng, 1.0, width, 7), kind="cloth", rotation=turn(rng), velocity=vector(rng, 2))
        bodies.append({**body, "translation": [0, 0.4 * k, 0]})
    obstacle = loose("rail", *strip(rng, 2.0, width, 5), rotation=turn(rng), translation=[0, -0.4, 0])
    return bodies, [obstacle], {"gravity": vector(rng, 20)}, {"activation_distance": power(rng, -4, -2)}


def ridges(rng):
    """Two roofs whose ridges are nearly parallel, one sinking on the other."""
    angle, d = (
        (power(rng, -6.2, -4.5), power(rng, -6.4, -5.5)) if rng.random() < 0.8 else (power(rng, -9, -2), power(rng, -6, -3))
    )
    triangles = [[0, 1, 2], [1, 0, 3]]

    def off():
        return float(rng.uniform(-0.2, 0.2))

    lower = np.array([[-1 + off(), 0, 0], [1 + off(), 0, 0], [off(), -0.5, 0.5], [off(), -0.5, -0.5]])
    a, b = -1 + off(), 1 + off()
    beside = np.array([0, 3 * d, angle * rng.choice([0.0, off()])])  # the ridges cross here, or a little off the middle
    upper = np.array([[a, 0, angle * a], [b, 0, angle * b], [off(), 0.5, 0.5], [off(), 0.5, -0.5]]) + beside
    q = Rotation.from_euler("xyz", turn(rng), degrees=True).as_matrix()
    h = power(rng, -5, -2)
    speed = d * rng.uniform(0.2, 2) / h
    body = loose("upper", upper @ q.T, triangles, kind="cloth", velocity=(q @ [0, -speed, 0]).tolist())
    simulation = {"gravity": [0, 0, 0], "time_step": h, "precision": "float64"}
    return [body], [loose("lower", lower @ q.T, triangles)], simulation, {"activation_distance": d}


def coplanar_stacks(rng):
    """Sheets with the same grid right above each other, pressed by a plate; every edge is parallel to many."""
    gap, count = power(rng, -3, -1.5), int(rng.integers(2, 5))
    turned = [0.0, float(rng.choice([0, 0, 90, 45])), 0.0]
    bodies = [
        sheet(f"sheet{k}", cells=2, translation=[0, k * gap, 0], rotation=turned if k % 2 else [0, 0, 0]) for k in range(count)
    ]
    plate = {"name": "plate", "mesh": {"shape": "plane", "size": 2.0}, "rotation": [180, 0, 0]}
    plate |= {"translation": [0, count * gap, 0], "motion": {"velocity": [0, -gap * power(rng, 0, 3), 0]}}
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 2.0}, "translation": [0, -gap, 0]}
    return bodies, [plate, floor], {}, {"activation_distance": gap * rng.uniform(0.1, 0.9)}


def jumping_keyframes(rng):
    """An obstacle that is somewhere else, turned, from one step to the next."""
    steps = [{"time": 0.0}]
    for k in range(3):
        steps.append({"time": 0.02 * (k + 1), "translation": vector(rng, power(rng, -1, 3)), "rotation": turn(rng, 720)})
    bar = {"name": "bar", "mesh": {"shape": "box", "size": [1.5, 0.05, 0.05], "cells": [1, 1, 1]}, "translation": [0, -0.1, 0]}
    bodies = [sheet("cloth", translation=[0, 0.02, 0]), block("block", translation=[0, 0.4, 0])]
    return bodies, [bar | {"motion": {"keyframes": steps}}], {}, {}


def spinning_obstacles(rng):
    spin = vector(rng, rng.choice([np.pi, 2 * np.pi, power(rng, 0, 3) * 0.01]) / 0.01)
    bar = {
        "name": "bar",
        "mesh": {"shape": "box", "size": [1.2, 0.05, 0.05], "cells": [1, 1, 1]},
        "motion": {"angular_velocity": spin},
    }
    bodies = [sheet("cloth", translation=[0, 0.1, 0]), block("block", translation=[0.3, 0.35, 0])]
    return bodies, [bar], {"time_step": 0.01}, {"friction": 0.5}


def knots(rng):
    """Two linked rings whose far ends are led apart, faster than they can go."""
    rings = []
    for k, side in enumerate((-1.0, 1.0)):
        mesh = {"shape": "torus", "major_radius": 0.3, "minor_radius": 0.06, "cells": [2, 9]}
        rings.append({"name": f"ring{k}", "kind": "solid", "mesh": mesh, "material": {"young_modulus": 1e5}})
        rings[k] |= {"translation": [0.15 * side, 0, 0], "rotation": [90.0 * k, 0, 0]}
    pull = power(rng, 0, 4)
    for ring, side in zip(rings, (-1.0, 1.0), strict=True):
        box = [[-2, -2, -2], [-0.35, 2, 2]] if side < 0 else [[0.35, -2, -2], [2, 2, 2]]
        ring["pins"] = [{"select": {"box": box}, "motion": {"velocity": [side * pull, 0, 0]}}]
    return rings, [], {"gravity": [0, 0, 0]}, {"activation_distance": 5e-3}


def jammed_plates(rng):
    """Plates that close on bodies until they would be in one place."""
    speed = power(rng, 0, 3)
    plates = []
    for k, side in enumerate((-1.0, 1.0)):
        plate = {"name": f"plate{k}", "mesh": {"shape": "box", "size": [1, 0.1, 1], "cells": [1, 1, 1]}}
        plates.append(plate | {"translation": [0, 0.3 * side, 0], "motion": {"velocity": [0, -side * speed, 0]}})
    bodies = [block("block", 0.2, 2, young=power(rng, 3, 7)), sheet("cloth", 0.8, translation=[0, 0.15, 0])]
    return bodies, plates, {}, {"friction": float(rng.choice([0, 0.5]))}


def thick_cloth(rng):
    """A minimum separation near the length of an edge, and gaps that are hardly more."""
    thick = power(rng, -2.5, -0.8)
    bodies = [sheet(f"sheet{k}", translation=[0, 1.02 * k * thick, 0], velocity=[0, -5.0 * k, 0]) for k in range(3)]
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 3.0}, "translation": [0, -1.02 * thick, 0]}
    contact = {"minimum_separation": thick, "activation_distance": thick * power(rng, -2, 0)}
    return bodies, [floor], {}, contact


def tiny_beside_huge(rng):
    tiny = power(rng, -3, -1)
    bodies = [
        block(
            f"crumb{k}",
            tiny,
            translation=[0.7 * tiny * k, tiny * (0.6 + 1.3 * k), 0],
            rotation=turn(rng, 5),
            velocity=vector(rng, 1),
        )
        for k in range(3)
    ]
    huge = power(rng, 1, 4)
    ground = loose("ground", [[-huge, 0, -huge], [huge, 0, -0.9 * huge], [0.1, 0, huge]], [[0, 2, 1]], rotation=turn(rng, 0.1))
    return bodies, [ground], {}, {"activation_distance": tiny * power(rng, -2, -1)}


def slivers(rng):
    """Obstacles of thin triangles that fan out from a point, under a cloth."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
    angles[1::2] = angles[::2][: len(angles[1::2])] + 10.0 ** rng.uniform(-6, -2, len(angles[1::2]))
    rim = np.stack([np.cos(angles), 0.1 * rng.normal(size=9), np.sin(angles)], axis=1)
    fan = [[0, k + 1, k + 2] for k in range(0, 8, 2)]
    vertices = np.concatenate([[[0, 0.1, 0]], rim])
    used = np.unique(fan)
    triangles = np.searchsorted(used, fan)
    bodies = [sheet("cloth", translation=[0, 0.45, 0], velocity=[0, -power(rng, 0, 2), 0], rotation=turn(rng, 20))]
    return bodies, [loose("fan", vertices[used], triangles)], {}, {"activation_distance": power(rng, -4, -2)}


def fast(rng):
    speed = power(rng, 1, 6)
    bodies = [
        sheet("cloth", pins=[{"select": {"box": [[-0.51, -1, -1], [-0.49, 1, 1]]}}]),
        block("bullet", 0.05, translation=[0.1, 0.3, 0.07], velocity=[0, -speed, 0], rotation=turn(rng)),
        block("other", 0.05, translation=[-0.2, -0.3, 0.1], velocity=[0, speed, 0], angular_velocity=vector(rng, 100)),
    ]
    return bodies, [], {}, {}


def pins_led_away(rng):
    """A cloth of which one side is led far away within a few steps."""
    far, single = power(rng, 4, 6.5) if rng.random() < 0.7 else power(rng, 0, 4), rng.random() < 0.5
    pins = []
    for at, place, turned in ((-0.5, [0, 0, 0], [0, 0, 0]), (0.5, vector(rng, far), turn(rng))):
        keys = [{"time": 0.0}, {"time": 0.02, "translation": place, "rotation": turned}]
        pins.append({"select": {"box": [[-0.51, -1, at - 0.01], [0.51, 1, at + 0.01]]}, "motion": {"keyframes": keys}})
    simulation = {"precision": "float32" if single else "float64", "time_step": 0.01, "max_outer": int(rng.choice([5, 20]))}
    return [sheet("cloth", cells=6, pins=pins)], [], simulation, {}


def spikes(rng):
    """A cone with a sharp tip under a vertex, an edge or the middle of a face, and a cloth that falls on it."""
    height = rng.uniform(0.2, 0.5)
    tip = [float(rng.choice([0, 0.125, 0.1])), height, float(rng.choice([0, 0.125, 0.07]))]
    width = power(rng, -4, -1)
    base = [[width * np.cos(a), 0, width * np.sin(a)] for a in (0, 2, 4)]
    cone = loose("spike", [*base, tip], [[0, 3, 1], [1, 3, 2], [2, 3, 0], [0, 1, 2]])
    bodies = [sheet("cloth", translation=[0, height + 0.02, 0], velocity=[0, -power(rng, 0, 3), 0])]
    return bodies, [cone], {}, {"activation_distance": power(rng, -4, -2)}


def aligned_grids(rng):
    """Vertex above vertex, edge above edge: everything degenerate at once, with round numbers."""
    h = float(rng.choice([0.25, 0.125]))
    bodies = [
        sheet("lower", cells=4, translation=[0, 0, 0]),
        block("upper", 0.5, 2, translation=[0, 0.25 + h, 0], velocity=[0, -16, 0]),
    ]
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 2.0}, "translation": [0, -0.125, 0]}
    return bodies, [floor], {"gravity": [0, -8, 0], "time_step": 0.0078125}, {"activation_distance": 0.015625}


def whirling_bodies(rng):
    bodies = [
        block("a", 0.3, rotation=turn(rng), angular_velocity=vector(rng, power(rng, 1, 4))),
        sheet("b", 0.6, translation=[0.4, 0.3, 0], angular_velocity=vector(rng, power(rng, 0, 3)), rotation=turn(rng)),
        sheet("c", 0.6, 3, translation=[-0.5, 0, 0.3], velocity=[5, 0, 0], rotation=turn(rng)),
    ]
    return bodies, [], {}, {"restitution": float(rng.choice([0, 0.7]))}


FAMILIES = (
    far_from_origin,
    millimetres_to_kilometres,
    needles,
    ridges,
    coplanar_stacks,
    jumping_keyframes,
    spinning_obstacles,
    knots,
    jammed_plates,
    thick_cloth,
    tiny_beside_huge,
    slivers,
    fast,
    pins_led_away,
    spikes,
    aligned_grids,
    whirling_bodies,
    *attack_families.FAMILIES,
)


def make(family, number: int, seed: int) -> tuple[pdipc.Scene, Case, np.random.Generator, str]:
    """Scene `number` of a family, what is done between its steps, with which numbers, and its settings in words."""
    rng = np.random.default_rng([seed, FAMILIES.index(family), number])
    made = family(rng)
    case = made if isinstance(made, Case) else Case(*made)
    newton = case.simulation.get("nonlinear_solver") == "newton"  # kinds of bodies that no other method knows
    method = "barrier" if newton else str(rng.choice(["barrier"] * 4 + ["paper"]))
    common = {
        "precision": str(rng.choice(["float64", "float32"])),
        "max_outer": int(rng.choice([1, 2, 5, 12])),
        "time_step": float(rng.choice([0.001, 0.01, 0.04])),
    }
    if newton or (method == "barrier" and rng.random() < 0.6):
        common |= {"nonlinear_solver": "newton"}
    else:
        common |= {"linear_solver": "a-jacobi" if method == "paper" and rng.random() < 0.5 else str(rng.choice(SOLVERS))}
        common |= {"inner_iterations": int(rng.choice([2, 10, 30]))}
    kept = {
        "method": method,
        "broad_phase": str(rng.choice(["patches", "bvh"])),
        "truncation": str(rng.choice(["auto", "per_vertex", "global"])),
    }
    simulation, contact = common | case.simulation, kept | case.contact
    words = " ".join(f"{key}={value}" for key, value in (simulation | contact).items())
    tables = {"bodies": case.bodies, "obstacles": case.obstacles, "simulation": simulation, "contact": contact}
    return pdipc.Scene(**tables, **case.more), case, rng, words


# --- the judge ---


class Judge:
    """Sees every motion that is committed; `breaches` says what went wrong."""

    def __init__(self, simulation: pdipc.Simulation):
        self.watch(simulation)
        triangles, assembly = simulation.triangles, simulation.model.assembly
        self.obstacle, self.owner, self.last, self.breaches = (
            assembly.obstacle,
            assembly.body_of_vertex,
            simulation.positions,
            [],
        )
        self.motions = self.pairs = 0
        edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        edges = edges[edges[:, 0] < edges[:, 1]]
        vertices = np.unique(triangles)
        faces = triangles[triangles[:, 1] != triangles[:, 2]]  # a rod's segment (a, b, b) is an edge
        vertex, face = np.divmod(np.arange(len(vertices) * len(faces)), len(faces))
        self.kinds = {
            "vertex_triangle": (vertices[:, None], faces, vertex, face),
            "edge_edge": (edges, edges, *np.triu_indices(len(edges), 1)),
        }
        for kind, (a, b, i, j) in self.kinds.items():
            shared = (a[i][:, :, None] == b[j][:, None, :]).any(axis=(1, 2))
            kept = ~shared & ~(self.obstacle[a[i, 0]] & self.obstacle[b[j, 0]])
            self.kinds[kind] = a, b, i[kept], j[kept]

    def watch(self, simulation: pdipc.Simulation) -> None:
        """Goes on with this simulation."""
        self.simulation = simulation
        simulation.observe = self

    def excused(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(k,) bool: which pairs of vertices are of bodies that ignore each other now."""
        pairs = np.array(self.simulation.model.assembly.quarantine).reshape(-1, 2)[
            np.array(self.simulation.state.quarantined, dtype=bool)
        ]
        owners = np.sort(self.owner[np.column_stack([first, second])], axis=1)
        return (owners[:, None] == pairs).all(axis=2).any(axis=1)

    def __call__(self, begin, end) -> None:
        x, y = begin.numpy().astype(float), end.numpy().astype(float)
        self.motions += 1
        if not np.array_equal(x, self.last):
            self.breaches.append(f"motion {self.motions} does not begin where the last one ended")
        self.last = y
        if not np.isfinite(y).all():
            self.breaches.append(f"motion {self.motions} ends at what is not finite")
            return
        for kind, (a, b, i, j) in self.kinds.items():
            bounds = [
                (low[i], high[i], other_low[j], other_high[j]) for low, high, other_low, other_high in _bounds(x, y, a, b)
            ]
            apart = np.zeros(
                len(i), dtype=bool
            )  # on the same side along an axis at both ends, and so in between; nothing rounds here
            for axis in range(3):
                apart |= np.all([low[:, axis] > other[:, axis] for low, _, _, other in bounds], axis=0)
                apart |= np.all([high[:, axis] < other[:, axis] for _, high, other, _ in bounds], axis=0)
            chosen = np.column_stack([a[i[~apart]], b[j[~apart]]])
            chosen = chosen[~self.excused(chosen[:, 0], chosen[:, 3])]
            self.pairs += len(chosen)
            if len(chosen):
                points = np.concatenate([x[chosen], y[chosen]], axis=1)
                apart = exact.stays_apart(points, kind, np.ones(len(chosen)))
                for quad in chosen[~apart][:3]:
                    self.breaches.append(f"motion {self.motions}: {kind} {quad.tolist()} meets")

    def after(self, step: int) -> None:
        """Judges the state after a step: intersections, and whether what turns is on its arc (the lemma of `integration.script`)."""
        simulation, x = self.simulation, self.simulation.positions
        if not np.array_equal(x, self.last):
            self.breaches.append(f"step {step} does not end where its last motion ended")
        meets = pdipc.find_intersections(x, simulation.triangles, self.obstacle)
        corners = simulation.triangles[meets][:, :, 0]
        meets = meets[~self.excused(corners[:, 0], corners[:, 1])]
        if len(meets):
            self.breaches.append(f"step {step}: triangles {meets[0].tolist()} intersect, of {len(meets)} pairs")
        script = simulation.work.script
        for mover in script.movers:
            lead = script.leads.get(mover.key)
            if mover.rigid and (lead is None or lead.pose is not None):
                turned, place = simulation.state.reached.pose(mover)
                away = turned.apply(mover.points - mover.origin) + place - x[mover.vertices]
                number = np.finfo(simulation.model.real.numpy)
                least = 100.0 * float(number.eps) * (np.abs(x[mover.vertices]).max() + np.ptp(mover.points, axis=0).max())
                own = np.linalg.norm(away, axis=1)[: np.count_nonzero(self.owner == mover.body)]
                if own.max() > 4.0 * mover.deviation + least:
                    self.breaches.append(f"step {step}: {mover.label} is {own.max():.3g} m off its arc")


def _bounds(x: np.ndarray, y: np.ndarray, a: np.ndarray, b: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """The boxes of primitives a and b at x and at y: least and greatest of each."""
    return [(p[a].min(axis=1), p[a].max(axis=1), p[b].min(axis=1), p[b].max(axis=1)) for p in (x, y)]


def attack(family, number: int, seed: int) -> dict:
    """Runs one scene; what came of it."""
    scene, case, rng, words = make(family, number, seed)
    outcome = {"family": family.__name__, "number": number, "settings": words, "refused": "", "breaches": [], "steps": 0}
    outcome |= {"motions": 0, "pairs": 0, "seconds": 0.0}
    begun, spent = time.perf_counter(), time.process_time()
    try:
        simulation = pdipc.Simulation(scene, "cpu")
    except pdipc.SceneError as error:
        return outcome | {"refused": str(error)}
    judge = Judge(simulation)
    for step in range(STEPS):
        if case.act is not None:
            begin = simulation.positions
            other = case.act(simulation, rng, step)
            if other is not None:  # as `attack_families.resumed` does
                whole, simulation = simulation.positions, other
                judge.watch(simulation)
                judge.last = simulation.positions
                judge.after(step)
                simulation.step()
                if not np.array_equal(simulation.positions, whole):
                    judge.breaches.append(f"step {step}: what goes on from a checkpoint gives other bits")
                judge.after(step)
            elif not np.array_equal(begin, simulation.positions):
                judge.last = simulation.positions  # a new start
                judge.after(step)
        simulation.step()
        outcome["steps"] += 1
        judge.after(outcome["steps"])
        if judge.breaches or judge.motions >= MOTIONS or time.process_time() - spent > SECONDS:
            break
    seconds = time.perf_counter() - begun
    return outcome | {"breaches": judge.breaches, "motions": judge.motions, "pairs": judge.pairs, "seconds": seconds}


def outcome_of(name: str, number: int, seed: int) -> dict:
    """`attack`, or what went wrong with it."""
    warnings.simplefilter("ignore")
    try:
        return attack(next(family for family in FAMILIES if family.__name__ == name), number, seed)
    except Exception as error:
        return {"family": name, "number": number, "error": f"{type(error).__name__}: {error}"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000, help="scenes that are run, not counting refused ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=90.0)
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time")
    parser.add_argument("--family", action="append", choices=[family.__name__ for family in FAMILIES])
    parser.add_argument("--only", type=int, help="this number of each family alone")
    parser.add_argument("--log", type=Path, help="outcomes, a line each; what it holds is not run again")
    parser.add_argument("--output", type=Path, default=REPOSITORY / "benchmarks" / "results" / "attack.json")
    options = parser.parse_args()
    names = [family.__name__ for family in FAMILIES if not options.family or family.__name__ in options.family]
    if options.only is not None:
        outcomes = [outcome_of(name, options.only, options.seed) for name in names]
        print(*map(json.dumps, outcomes), sep="\n")
        return int(any(map(wrong, outcomes)))
    git = ["git", "rev-parse", "HEAD"]
    commit = subprocess.run(git, cwd=REPOSITORY, capture_output=True, text=True, check=False).stdout.strip()
    outcomes, number, begun = [], 0, time.perf_counter()
    known = read_log(options.log, options.seed)
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        while (result := summary(outcomes))["scenes"] < options.scenes and time.perf_counter() - begun < 60 * options.minutes:
            new = [name for name in names if (name, number) not in known]
            for outcome in pool.map(outcome_of, new, [number] * len(new), [options.seed] * len(new)):
                known[outcome["family"], number] = outcome
                if wrong(outcome):
                    print("WRONG", json.dumps(outcome), flush=True)
                if options.log:
                    with options.log.open("a") as log:
                        log.write(json.dumps(outcome | {"seed": options.seed, "commit": commit}) + "\n")
            outcomes += [known[name, number] for name in names]
            number += 1
            result = {"machine": machine(), "load": os.getloadavg()[1], "commit": commit, "seed": options.seed} | summary(
                outcomes
            )
            options.output.write_text(json.dumps(result, indent=1) + "\n")
            seconds = time.perf_counter() - begun
            print(f"{result['scenes']} scenes in {seconds:.0f} s, breaches: {result['breaches']}", flush=True)
    for name, row in result["families"].items():
        print(f"{name:26}", "  ".join(f"{value:,} {key}" for key, value in row.items()))
    return int(any(map(wrong, outcomes)))


def wrong(outcome: dict) -> bool:
    return bool("error" in outcome or outcome["breaches"])


def read_log(path: Path | None, seed: int) -> dict[tuple[str, int], dict]:
    """(family, number) -> outcome: what an earlier run of this seed wrote."""
    lines = path.read_text().splitlines() if path and path.exists() else []
    outcomes = [outcome for outcome in map(json.loads, lines) if outcome["seed"] == seed]
    return {(outcome["family"], outcome["number"]): outcome for outcome in outcomes}


def summary(outcomes: list[dict]) -> dict:
    """Counts, all together and by family, and what went wrong."""
    rows = defaultdict(lambda: {"scenes": 0, "refused": 0, "steps": 0, "motions": 0, "pairs": 0, "breaches": 0, "errors": 0})
    for outcome in outcomes:
        row = rows[outcome["family"]]
        if "error" in outcome:
            row["errors"] += 1
        elif outcome["refused"]:
            row["refused"] += 1
        else:
            row["scenes"] += 1
            for key in ("steps", "motions", "pairs"):
                row[key] += outcome[key]
            row["breaches"] += bool(outcome["breaches"])
    keys = ("scenes", "refused", "steps", "motions", "pairs", "breaches", "errors")
    total = {key: sum(row[key] for row in rows.values()) for key in keys}
    seconds = sum(outcome.get("seconds", 0.0) for outcome in outcomes)
    return {"seconds": round(seconds), **total, "families": dict(rows), "wrong": list(filter(wrong, outcomes))[:50]}


if __name__ == "__main__":
    sys.exit(main())
