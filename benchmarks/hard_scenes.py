"""Hard scenes, in the manner of those that incremental potential contact was shown on: y is up, SI units. `SCENES` has each as a function.

All are built from formulas but those of `DATA_SCENES`, which take meshes from a folder (`hard.py --data`).
"""

from pathlib import Path

import numpy as np

import pdipc
from pdipc.scene.figures import Figure
from pdipc.scene.stuffing import stuffed

RUBBER = {"density": 1000.0, "young_modulus": 1e5, "poisson_ratio": 0.4}
SOFT = {**RUBBER, "young_modulus": 2e4}


def scene(
    title: str, bodies: list[dict], obstacles: list[dict] = (), steps: int = 100, h: float = 0.01, **contact
) -> pdipc.Scene:
    return pdipc.Scene(
        title=title, simulation={"time_step": h, "steps": steps}, contact=contact, bodies=bodies, obstacles=list(obstacles)
    )


def solid(name: str, mesh: dict, material: dict = RUBBER, **more) -> dict:
    return {"name": name, "kind": "solid", "mesh": mesh, "material": material, **more}


def box(size: tuple, cells: tuple) -> dict:
    return {"shape": "box", "size": size, "cells": cells}


def slab(name: str, size: tuple, at: tuple, **more) -> dict:
    return {"name": name, "mesh": box(size, (1, 1, 1)), "translation": at, **more}


def path(*places: tuple, smooth: bool = False) -> dict:
    """Keyframes (time, translation)."""
    return {"keyframes": [{"time": time, "translation": where} for time, where in places], "smooth": smooth}


def turned(name: str, profile: list[tuple], around: int = 24, **more) -> dict:
    """A closed surface of revolution about y: profile (radius, height), counterclockwise in the plane of radius and height."""
    angle = 2.0 * np.pi * np.arange(around) / around
    r, y = np.array(profile).T
    vertices = np.stack([np.outer(r, np.cos(angle)), np.outer(y, np.ones(around)), np.outer(r, np.sin(angle))], axis=-1)
    k, j = (each.ravel() for each in np.meshgrid(np.arange(len(profile)), np.arange(around), indexing="ij"))
    a, b = k * around + j, k * around + (j + 1) % around
    c, d = (k + 1) % len(profile) * around + j, (k + 1) % len(profile) * around + (j + 1) % around
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return {"name": name, "mesh": {"vertices": vertices.reshape(-1, 3), "triangles": triangles}, **more}


def funnel(name: str, wide: float, narrow: float, top: float, neck: float, wall: float = 0.05, **more) -> dict:
    """A cone from radius `wide` at the height `top` to `narrow` at 0, and a tube of length `neck` below."""
    profile = [(wide, top), (narrow, 0.0), (narrow, -neck), (narrow + wall, -neck), (narrow + wall, 0.0), (wide + wall, top)]
    return turned(name, profile, **more)


def twisting(side: float, speed: float, low: tuple, high: tuple, center: tuple) -> dict:
    """A pin of what is in a box, turning about a line along x."""
    motion = {"angular_velocity": (side * speed, 0.0, 0.0), "center": center}
    return {"select": {"box": (low, high)}, "motion": motion}


def mat() -> pdipc.Scene:
    """A mat, twisted through four turns by its ends."""
    pins = [
        twisting(side, 2.0 * np.pi * 0.5, (0.5 * side - 0.01, -1, -1), (0.5 * side + 0.01, 1, 1), (0.5 * side, 0, 0))
        for side in (-1.0, 1.0)
    ]
    body = solid("mat", box((1.0, 0.016, 0.6), (36, 1, 22)), SOFT, pins=pins)
    return scene("A mat is twisted", [body], steps=100, h=0.04)


def rods() -> pdipc.Scene:
    """Four rods side by side, twisted through four turns by their ends."""
    bodies = []
    for k in range(4):
        y, z = 0.06 * (k % 2) - 0.03, 0.06 * (k // 2) - 0.03
        pins = [
            twisting(side, 2.0 * np.pi * 0.5, (0.5 * side - 0.01, -1, -1), (0.5 * side + 0.01, 1, 1), (0.5 * side, 0, 0))
            for side in (-1.0, 1.0)
        ]
        bodies.append(solid(f"rod{k}", box((1.0, 0.04, 0.04), (36, 2, 2)), RUBBER, translation=(0.0, y, z), pins=pins))
    return scene("Four rods are twisted about each other", bodies, steps=100, h=0.04)


def squeezed_out() -> pdipc.Scene:
    """Two balls are pressed through a funnel of less than half of their width, and out between two plates."""
    bodies = [
        solid(f"ball{k}", {"shape": "sphere", "radius": 0.25, "cells": 8}, SOFT, translation=(0.0, 0.42 + 0.56 * k, 0.0))
        for k in range(2)
    ]
    obstacles = [
        funnel("funnel", 0.3, 0.12, 0.25, 0.25, look={"opacity": 0.3}),
        turned("tube", [(0.31, 1.8), (0.31, 0.28), (0.36, 0.28), (0.36, 1.8)], look={"opacity": 0.3}),
        {
            "name": "piston",
            "mesh": {"shape": "cylinder", "radius": 0.27, "length": 0.1, "cells": [8, 1]},
            "translation": (0.0, 1.35, 0.0),
            "motion": path((0.0, (0, 0, 0)), (2.0, (0, -1.08, 0))),
        },
        slab("floor", (2.0, 0.05, 2.0), (0.0, -0.4, 0.0)),
        turned("plate", [(0.19, -0.24), (0.19, -0.29), (0.9, -0.29), (0.9, -0.24)], look={"opacity": 0.3}),
    ]
    return scene("Balls are squeezed through a funnel and out between plates", bodies, obstacles, 110, 0.02, friction=0.1)


def six_plates(side: float, least: float, seconds: float) -> list[dict]:
    """Plates around a cube, that close to the part `least` of its side, and open again; they pass through each other."""
    plates = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            size, at = np.full(3, 1.1 * side), np.zeros(3)
            size[axis], at[axis] = 0.1 * side, sign * 0.55 * side
            way = np.zeros(3)
            way[axis] = -sign * 0.5 * side * (1.0 - least)
            motion = path((0.0, (0, 0, 0)), (seconds, tuple(way)), (2.0 * seconds, (0, 0, 0)))
            plates.append(slab("xyz"[axis] + "-+"[sign > 0], tuple(size), tuple(at), motion=motion, look={"opacity": 0.15}))
    return plates


def compactor() -> pdipc.Scene:
    """A block, a ball, a ring and a mat in a box whose sides close to a tenth, and open again."""
    bodies = [
        solid("block", box((0.25, 0.25, 0.25), (4, 4, 4)), SOFT, translation=(0.2, 0.2, 0.15), rotation=(20, 30, 0)),
        solid("ball", {"shape": "sphere", "radius": 0.16, "cells": 6}, SOFT, translation=(-0.22, 0.1, -0.2)),
        solid(
            "ring",
            {"shape": "torus", "major_radius": 0.18, "minor_radius": 0.06, "cells": [3, 20]},
            SOFT,
            translation=(-0.1, -0.2, 0.2),
            rotation=(30, 0, 20),
        ),
        solid("mat", box((0.6, 0.03, 0.6), (12, 1, 12)), SOFT, translation=(0.0, -0.4, 0.0)),
    ]
    return scene("A compactor of six plates, and back", bodies, six_plates(1.0, 0.1, 1.0), 100, 0.02)


def rollers() -> pdipc.Scene:
    """A soft animal is drawn between two rollers that turn against each other."""
    body = solid("dinosaur", {"shape": "figure", "name": "dinosaur", "size": 1.0, "cells": 22}, SOFT, translation=(0, 0.9, 0))
    obstacles = []
    for side in (-1.0, 1.0):
        drum = {"shape": "cylinder", "radius": 0.3, "length": 1.6, "cells": [10, 2]}
        motion = {"angular_velocity": (0.0, 0.0, -side * 4.0)}
        more = {"rotation": (90, 0, 0), "translation": (side * 0.36, 0.0, 0.0), "motion": motion, "look": {"opacity": 0.4}}
        obstacles.append({"name": f"roller{'-+'[side > 0]}", "mesh": drum, **more})
    obstacles.append(slab("floor", (3.0, 0.1, 3.0), (0.0, -0.8, 0.0)))
    return scene("A soft body on counter-rotating rollers", [body], obstacles, 75, 0.02, friction=0.5)


def ball_on_mat() -> pdipc.Scene:
    """A ball of 20 times the density falls on a thin mat that is held at two edges."""
    pins = [{"select": {"box": ((0.5 * side - 0.01, -1, -1), (0.5 * side + 0.01, 1, 1))}} for side in (-1.0, 1.0)]
    ball = {
        "name": "ball",
        "kind": "rigid",
        "mesh": {"shape": "sphere", "radius": 0.15, "cells": 6},
        "translation": (0.05, 0.4, 0.02),
    }
    thin = solid("mat", box((1.0, 0.01, 1.0), (24, 1, 24)), {**RUBBER, "young_modulus": 4e5}, pins=pins)
    return scene("A heavy ball on a thin held mat", [thin, {**ball, "material": {"density": 5000.0}}], steps=60, h=0.02)


def cloths_in_funnel() -> pdipc.Scene:
    """Five cloths, one above the other, are pressed into a funnel by a ball."""
    cloths = [
        {
            "name": f"cloth{k}",
            "kind": "cloth",
            "mesh": {"shape": "grid", "size": (0.9, 0.9), "cells": (16, 16)},
            "translation": (0.01 * k, 0.31 + 0.02 * k, 0.0),
            "rotation": (0.0, 18.0 * k, 0.0),
            "material": {"areal_density": 0.2, "membrane_stiffness": 200.0, "bending_stiffness": 1e-4},
        }
        for k in range(5)
    ]
    pusher = {"name": "pusher", "mesh": {"shape": "sphere", "radius": 0.1, "cells": 8}, "translation": (0.0, 0.55, 0.0)}
    pusher["motion"] = path((0.0, (0, 0, 0)), (0.2, (0, 0, 0)), (1.2, (0, -0.6, 0)))
    return scene(
        "Stacked cloths pressed into a funnel", cloths, [funnel("funnel", 0.5, 0.16, 0.3, 0.5), pusher], 65, 0.02, friction=0.1
    )


def table_cloth() -> pdipc.Scene:
    """A cloth is pulled from under a plate, a cup and a jug."""
    cloth = {
        "name": "cloth",
        "kind": "cloth",
        "mesh": {"shape": "grid", "size": (1.2, 0.8), "cells": (36, 24)},
        "translation": (0.15, 0.503, 0.0),
        "material": {"areal_density": 0.2, "membrane_stiffness": 1000.0, "bending_stiffness": 1e-4},
        "pins": [
            {
                "select": {"box": ((0.74, 0, -1), (0.76, 1, 1))},
                "motion": {"velocity": (3.0, -0.6, 0.0), "start": 0.3, "end": 0.7},
            }
        ],
    }

    def dish(name: str, radius: float, height: float, x: float, z: float) -> dict:
        mesh = {"shape": "cylinder", "radius": radius, "length": height, "cells": [6, 1]}
        return {
            "name": name,
            "kind": "rigid",
            "mesh": mesh,
            "translation": (x, 0.51 + 0.5 * height, z),
            "material": {"density": 2000.0},
        }

    dishes = [dish("plate", 0.12, 0.02, -0.2, 0.1), dish("cup", 0.04, 0.09, 0.05, -0.15), dish("jug", 0.06, 0.2, 0.15, 0.15)]
    table = [slab("table", (1.0, 0.06, 0.7), (0.0, 0.47, 0.0)), {"name": "floor", "mesh": {"shape": "plane", "size": 8.0}}]
    return scene("A table cloth pulled from under dishes", [cloth, *dishes], table, 110, 0.01, friction=0.2)


def folded() -> pdipc.Scene:
    """A stiff sheet lies on the ground; one edge is led over to the other side, and pressed down."""
    lead = path((0.0, (0, 0, 0)), (0.5, (-0.4, 0.45, 0)), (1.0, (-0.9, 0.35, 0)), (1.5, (-0.95, 0.03, 0)))
    sheet = {
        "name": "sheet",
        "kind": "cloth",
        "mesh": {"shape": "grid", "size": (1.0, 0.7), "cells": (36, 24)},
        "translation": (0.0, 0.002, 0.0),
        "material": {"areal_density": 0.5, "membrane_stiffness": 2e4, "bending_stiffness": 0.02},
        "pins": [{"select": {"box": ((0.49, -1, -1), (0.51, 1, 1))}, "motion": lead}],
    }
    ground = {"name": "floor", "mesh": {"shape": "plane", "size": 4.0}}
    return scene("A stiff sheet folded by a led edge", [sheet], [ground], 80, 0.02, friction=0.4)


def cards() -> pdipc.Scene:
    """A deck of twenty cards on a table is hit by a ball from the side."""
    deck = [
        {
            "name": f"card{k}",
            "kind": "cloth",
            "mesh": {"shape": "grid", "size": (0.088, 0.063), "cells": (8, 6)},
            "translation": (0.0, 0.0005 + 0.0006 * k, 0.0),
            "material": {"areal_density": 0.3, "membrane_stiffness": 5e4, "bending_stiffness": 2e-3},
            "minimum_separation": 2e-4,
        }
        for k in range(20)
    ]
    ball = {
        "name": "ball",
        "kind": "rigid",
        "mesh": {"shape": "sphere", "radius": 0.02, "cells": 6},
        "translation": (-0.08, 0.0205, 0.005),
        "velocity": (3.0, -0.5, 0.0),
        "material": {"density": 3000.0},
    }
    table = {"name": "table", "mesh": {"shape": "plane", "size": 2.0}}
    return scene("A deck of cards hit by a ball", [*deck, ball], [table], 60, 0.004, friction=0.2, activation_distance=2e-4)


def hand() -> Figure:
    """0.2 m long, fingers towards +y, flat in z."""
    fingers = [(-0.036, 0.085, 0.0085), (-0.012, 0.095, 0.009), (0.012, 0.09, 0.009), (0.036, 0.075, 0.008)]
    parts = [((x, 0.0, 0.0), (1.3 * x, tip, 0.0), 0.013, radius) for x, tip, radius in fingers]
    parts += [((x, -0.07, 0.0), (x, 0.0, 0.0), 0.02, 0.018) for x in (-0.026, 0.0, 0.026)]
    parts.append(((0.03, -0.06, 0.0), (0.078, 0.005, 0.0), 0.016, 0.01))
    return Figure(parts, blend=0.006)


def glove() -> pdipc.Scene:
    """A hollow glove, open at the wrist, is grasped by two pads that close until they would overlap: they have to wait."""
    whole = stuffed(hand().level, *hand().box(), 0.008)
    low = whole.vertices[:, 1].min() + 0.012
    kept = whole.triangles[(whole.vertices[whole.triangles, 1] > low).all(axis=1)]
    used, triangles = np.unique(kept, return_inverse=True)
    mesh = {"vertices": whole.vertices[used], "triangles": triangles.reshape(-1, 3)}
    body = {
        "name": "glove",
        "kind": "cloth",
        "mesh": mesh,
        "translation": (0.0, 0.11, 0.0),
        "material": {"areal_density": 0.5, "membrane_stiffness": 500.0, "bending_stiffness": 1e-4, "bending": "curved"},
    }
    pads = []
    for side in (-1.0, 1.0):
        reach = -side * 0.062  # 2 mm past the middle
        motion = path((0.0, (0, 0, 0)), (0.5, (0, 0, reach)))
        pads.append(slab(f"pad{'-+'[side > 0]}", (0.06, 0.06, 0.04), (0.0, 0.1, side * 0.08), motion=motion))
    ground = {"name": "floor", "mesh": {"shape": "plane", "size": 1.0}}
    return scene("A hollow glove grasped until the pads would overlap", [body], [*pads, ground], 60, 0.01, friction=0.5)


def tets(file: Path, size: float) -> dict:
    """A mesh of the data, its largest extent made `size`, centred at the origin."""
    data = np.load(file)
    low, high = data["V"].min(axis=0), data["V"].max(axis=0)
    return {"vertices": size / (high - low).max() * (data["V"] - 0.5 * (low + high)), "tets": data["T"]}


def compactor_data(data: Path) -> pdipc.Scene:
    """An Armadillo and a rabbit in the compactor."""
    bodies = [
        solid("armadillo", tets(data / "meshes/tet/armadillo_4k.npz", 0.7), SOFT, translation=(-0.1, 0.0, -0.15)),
        solid("rod", tets(data / "meshes/tet/rod_2k.npz", 0.8), SOFT, translation=(0.0, 0.1, 0.4)),
    ]
    return scene("An Armadillo and a rod in a compactor, and back", bodies, six_plates(1.0, 0.1, 1.0), 100, 0.02)


SCENES = {
    "mat": mat,
    "rods": rods,
    "funnel": squeezed_out,
    "compactor": compactor,
    "rollers": rollers,
    "ball_on_mat": ball_on_mat,
    "cloths": cloths_in_funnel,
    "table_cloth": table_cloth,
    "folded": folded,
    "cards": cards,
    "glove": glove,
}
DATA_SCENES = {"compactor_data": compactor_data}
SHOWN = {
    "mat": 70,
    "rods": 70,
    "funnel": 70,
    "compactor": 45,
    "rollers": 38,
    "ball_on_mat": 20,
    "cloths": 55,
    "table_cloth": 50,
    "folded": 65,
    "cards": 30,
    "glove": 48,
    "compactor_data": 45,
}  # a frame of each to draw
