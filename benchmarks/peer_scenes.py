"""The four scenes that peers are measured on: z is up, SI units, steps of 1/100 s, 100 of them.

S1 a cloth falls on a sphere, S2 a block on a floor, S3 two blocks over a thin rod, S4 plates close on a block. `scene("s1_50")`: with 50 x 50
vertices, or so many cells along an edge of a block.
"""

import itertools

import numpy as np
import trimesh

import pdipc

STEPS, H = 100, 0.01
SCENES = ("s1_50", "s1_100", "s1_200", "s2_10", "s2_20", "s3_8", "s4_10")
SOFT = {"density": 1000.0, "young_modulus": 1e5, "poisson_ratio": 0.4}
CLOTH = {"areal_density": 0.2, "membrane_stiffness": 200.0, "poisson_ratio": 0.3, "bending_stiffness": 2e-5}


def sheet(n: int, height: float) -> dict:
    """n x n vertices on [0, 1]^2, cells cut along alternating diagonals."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(0.0, 1.0, n)] * 2, indexing="ij"))
    i, j = (each.ravel() for each in np.meshgrid(*[np.arange(n - 1)] * 2, indexing="ij"))
    a = i * n + j
    b, c, d = a + n, a + n + 1, a + 1
    even = (i + j) % 2 == 0
    triangles = np.concatenate([np.where(even, [a, b, c], [a, b, d]).T, np.where(even, [a, c, d], [b, c, d]).T])
    return {"vertices": np.column_stack([x, y, np.full(n * n, height)]), "triangles": triangles.astype(np.int32)}


def block(n: int, origin: tuple[float, float, float]) -> dict:
    """A unit cube of n^3 cells, each cut into six tets along the same diagonal."""
    vertices = np.indices([n + 1] * 3).reshape(3, -1).T / n + np.array(origin)
    cell = np.indices([n] * 3).reshape(3, -1).T
    strides = np.array([(n + 1) ** 2, n + 1, 1])
    tets = []
    for path in itertools.permutations(np.eye(3, dtype=np.int64)):
        corners = np.cumsum([np.zeros(3, dtype=np.int64), *path], axis=0)
        if np.linalg.det(np.array(path)) < 0:
            corners = corners[[0, 1, 3, 2]]
        tets.append((cell[:, None] + corners) @ strides)
    return {"vertices": vertices, "tets": np.concatenate(tets).astype(np.int32)}


def surface(mesh: trimesh.Trimesh) -> dict:
    return {"vertices": np.asarray(mesh.vertices), "triangles": np.asarray(mesh.faces, dtype=np.int32)}


def slab(center: tuple[float, float, float], half: tuple[float, float, float]) -> dict:
    mesh = trimesh.creation.box(2.0 * np.array(half))
    mesh.apply_translation(center)
    return surface(mesh)


def rod(radius: float, low: float, high: float, y: float, around: int = 12, along: int = 16) -> dict:
    """A closed cylinder along x at height 0."""
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = np.column_stack([y + radius * np.cos(angle), radius * np.sin(angle)])
    x = np.linspace(low, high, along + 1)
    vertices = np.column_stack([np.repeat(x, around), np.tile(ring, (along + 1, 1))])
    vertices = np.vstack([vertices, [[low, y, 0.0], [high, y, 0.0]]])
    a = np.arange(around * along)
    b = a - a % around + (a + 1) % around
    side = np.concatenate([np.stack([a, b, b + around], axis=1), np.stack([a, b + around, a + around], axis=1)])
    k, end = np.arange(around), around * along
    following = (k + 1) % around
    first = np.stack([np.full(around, len(vertices) - 2), following, k], axis=1)
    last = np.stack([np.full(around, len(vertices) - 1), end + k, end + following], axis=1)
    return {"vertices": vertices, "triangles": np.concatenate([side, first, last]).astype(np.int32)}


def solid(name: str, mesh: dict, **more) -> dict:
    return {"name": name, "kind": "solid", "mesh": mesh, "material": SOFT, **more}


FLOOR = {"name": "floor", "mesh": slab((0.5, 0.5, -0.1), (3.0, 3.0, 0.1))}


def s1(n: int) -> dict:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    ball.apply_translation((0.5, 0.5, 0.0))
    cloth = {"name": "cloth", "kind": "cloth", "mesh": sheet(n, 0.35), "material": CLOTH}
    return {"bodies": [cloth], "obstacles": [{"name": "sphere", "mesh": surface(ball)}]}


def s2(n: int) -> dict:
    return {"bodies": [solid("block", block(n, (0.0, 0.0, 0.1)))], "obstacles": [FLOOR]}


def s3(n: int) -> dict:
    first = solid("first", block(n, (0.0, 0.0, 0.05)), velocity=[0, 0, -2])
    second = solid("second", block(n, (0.03, 0.05, 1.1)), velocity=[0, 0, -2])
    beam = {"name": "rod", "mesh": rod(0.02, -0.5, 1.5, 0.5 + 0.3 / n)}  # not under a row of vertices
    return {"bodies": [first, second], "obstacles": [beam]}


def s4(n: int) -> dict:
    """Each plate moves 0.37 m within 0.8 s, 0.35 of them against the block."""
    speed, half = 0.37 / 0.8, (1.2, 1.2, 0.05)
    lower = {"name": "lower", "mesh": slab((0.5, 0.5, -0.07), half), "motion": {"velocity": [0, 0, speed], "end": 0.8}}
    upper = {"name": "upper", "mesh": slab((0.5, 0.5, 1.07), half), "motion": {"velocity": [0, 0, -speed], "end": 0.8}}
    return {"bodies": [solid("block", block(n, (0.0, 0.0, 0.0)))], "obstacles": [lower, upper]}


def scene(name: str, **simulation) -> pdipc.Scene:
    """The scene called `name`; more keys for its simulation table, such as precision="float32"."""
    kind, size = name.split("_")
    tables = {"s1": s1, "s2": s2, "s3": s3, "s4": s4}[kind](int(size))
    gravity = [0.0, 0.0, 0.0 if kind == "s4" else -9.81]
    simulation = {"time_step": H, "steps": STEPS, "gravity": gravity, **simulation}
    return pdipc.Scene(simulation=simulation, contact={"activation_distance": 1e-3, "friction": 0.0}, **tables)
