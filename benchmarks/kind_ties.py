"""More random scenes of every kind of body, in which they are tied, sewn, led and pressed: families for `kind_scenes.draw`. y is up, SI units."""

from typing import Any

import numpy as np
from kind_parts import Parts, bent, between, cord, floor, sewn, thing, woven
from numpy.random import Generator


def hung(rng: Generator, size: float) -> Parts:
    """A rigid plank hangs on a cloth that is led to and fro by its upper edge, a rigid ball on a rod on the plank; things are thrown at them."""
    width, cells = 0.5 * size, int(rng.integers(6, 11))
    material = sewn(rng, size) | {"membrane_stiffness": between(rng, 200.0, 5e3)}
    way, speed = 0.2 * size, float(np.sqrt(size))
    shaken = [
        {"time": 0.0},
        {"time": 0.12, "translation": [way, 0.0, 0.0]},
        {"time": 0.3, "translation": [-way, 0.0, 0.5 * way]},
    ]
    above = [[-9.0 * size, 0.49 * size, -9.0 * size], [9.0 * size, 9.0 * size, 9.0 * size]]
    upper = {"select": {"box": above}, "motion": {"keyframes": shaken, "smooth": bool(rng.random() < 0.5)}}
    sheet = {"name": "sheet", "kind": "cloth", "mesh": {"shape": "grid", "size": [width, 0.5 * size], "cells": [cells, cells]}}
    sheet |= {"rotation": [90.0, 0.0, 0.0], "translation": [0.0, 0.25 * size, 0.0], "material": material, "pins": [upper]}
    thick = 0.03 * size
    plank = {
        "name": "plank",
        "kind": "rigid",
        "mesh": {"shape": "box", "size": [width, thick, 2.0 * thick], "cells": [2 * cells, 1, 2]},
    }
    plank |= {"translation": [0.0, -0.5 * thick - 0.006 * size, 0.0], "material": {"density": between(rng, 200.0, 4000.0)}}
    rope = {"name": "rope", "kind": "rod", "mesh": {"shape": "rope", "length": 0.25 * size, "segments": 10}}
    low = -thick - 0.016 * size - 0.125 * size
    rope |= {
        "rotation": [0.0, 0.0, 90.0],
        "translation": [0.0, low, 0.0],
        "material": cord(rng, 0.5 * size) | {"radius": 0.006 * size},
    }
    ball = {"name": "ball", "kind": "rigid", "mesh": {"shape": "sphere", "radius": 0.06 * size, "cells": 6}}
    ball |= {"translation": [0.0, low - 0.135 * size - 0.06 * size, 0.0], "material": {"density": between(rng, 500.0, 8000.0)}}
    ties = [
        {"bodies": ("sheet", "plank"), "within": 0.02 * size, "stiffness": between(rng, 500.0, 2e4)},
        {"bodies": ("rope", "plank"), "within": 0.02 * size, "stiffness": between(rng, 500.0, 2e4)},
        {"bodies": ("rope", "ball"), "within": 0.02 * size, "stiffness": between(rng, 500.0, 2e4)},
    ]
    thrown = thing(
        rng, "thrown", str(rng.choice(("rigid", "pillow", "solid", "rod"))), 0.6 * size, (0.0, 0.1 * size, -0.6 * size)
    )
    thrown["velocity"] = [0.0, speed, 5.0 * speed]
    return {"bodies": [sheet, plank, rope, ball, thrown], "attachments": ties}


def patchwork(rng: Generator, size: float) -> Parts:
    """A sheet of panels of one mesh whose edges coincide, welded, or opened and sewn to no gap; held by two corners, hit by a thing."""
    cells, side = int(rng.integers(3, 7)), 0.4 * size
    line = np.linspace(0.0, side, cells + 1)
    u, v = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
    i, j = (each.ravel() for each in np.indices((cells, cells)))
    a = i * (cells + 1) + j
    corners = a, a + 1, a + cells + 1, a + cells + 2
    cut = np.concatenate([np.stack([corners[k] for k in tri], 1) for tri in ((0, 1, 3), (0, 3, 2))])
    vertices, triangles = [], []
    for k in range(4):
        low = np.array([(k % 2) * side, (k // 2) * side])
        wave = 0.02 * size * np.sin(np.pi * (u + low[0]) / side) * np.sin(np.pi * (v + low[1]) / side)
        vertices.append(np.stack([u + low[0] - side, wave, v + low[1] - side], 1))
        triangles.append(cut + k * len(u))
    mesh = {"vertices": np.concatenate(vertices), "triangles": np.concatenate(triangles)}
    material = sewn(rng, size)
    material.pop("warp", None)
    sheet = {
        "name": "sheet",
        "kind": "cloth",
        "mesh": mesh,
        "material": material
        | ({"warp": [1.0, 0.1, 0.3]} if "weft_stiffness" in material or "weft_bending_stiffness" in material else {}),
    }
    held = [{"select": {"nearest": [sign * side, 0.0, -side]}} for sign in (-1.0, 1.0)]
    held[0]["end"] = float(rng.uniform(0.1, 0.3))
    parts: Parts = {}
    if rng.random() < 0.5:
        sheet["weld"] = 1e-3 * size
    else:
        sheet["open_seams"] = 0.015 * size
        seam = {"bodies": ["sheet", "sheet"], "within": 0.03 * size, "duration": float(rng.uniform(0.0, 0.2))}
        parts["stitches"] = [seam if rng.random() < 0.5 else seam | {"length": 0.0}]
    below = {
        "name": "ball",
        "mesh": {"shape": "sphere", "radius": 0.2 * size, "cells": 8},
        "translation": [0.0, -0.25 * size, 0.0],
    }
    hit = thing(rng, "hit", str(rng.choice(("rigid", "pillow", "solid", "rod"))), 0.6 * size, (0.0, 0.4 * size, 0.0))
    hit["velocity"] = [0.0, -3.0 * float(np.sqrt(size)), 0.0]
    return {"bodies": [sheet | {"pins": held}, hit], "obstacles": [below, floor(size, -0.6 * size)], **parts}


def applied(rng: Generator, size: float) -> Parts:
    """A patch of cloth and a cord are sewn onto something soft, with threads of no length; it falls on the floor."""
    kind = str(rng.choice(("solid", "pillow", "cloth", "rigid")))
    base = thing(rng, "base", kind, size, (0.0, 0.3 * size, 0.0))
    base |= {"rotation": [0.0] * 3, "angular_velocity": [0.0] * 3}
    top = {"solid": 0.1, "pillow": 0.03, "cloth": 0.0, "rigid": 0.05}[kind] * size
    if kind == "rigid":
        base["mesh"] = {"shape": "box", "size": [0.4 * size, 0.1 * size, 0.4 * size], "cells": [2, 1, 2]}
    mesh = {"shape": "grid", "size": [0.2 * size] * 2, "cells": [int(rng.integers(3, 8))] * 2}
    above = [0.0, 0.3 * size + top + float(rng.uniform(0.01, 0.04)) * size, 0.0]
    patch = {
        "name": "patch",
        "kind": "cloth",
        "mesh": mesh,
        "translation": above,
        "rotation": [0.0, float(rng.uniform(0, 90)), 0.0],
    }
    patch |= {"material": sewn(rng, size), "velocity": base["velocity"]}
    rope = {"shape": "rope", "length": 0.2 * size, "segments": int(rng.integers(8, 16))}
    material = cord(rng, 0.5 * size) | {"radius": 0.004 * size, "young_modulus": between(rng, 1e5, 1e7)}
    lace = {
        "name": "lace",
        "kind": "rod",
        "mesh": rope,
        "translation": [0.0, above[1] + 0.03 * size, 0.0],
        "material": material,
    }
    lace |= {"velocity": base["velocity"]}
    threads = {"within": 0.2 * size, "onto": "surface", "stiffness": between(rng, 50.0, 2e3)}
    ends = {"vertices": [0, rope["segments"] // 2, rope["segments"]]}
    stitches = [
        {"bodies": ["patch", "base"], **threads, "length": 0.0, "duration": float(rng.choice([0.0, 0.1]))},
        {"bodies": ["lace", "patch"], **threads, "select": ends, "length": 0.0, "duration": float(rng.choice([0.0, 0.2]))},
    ]
    return {"bodies": [base, patch, lace], "obstacles": [floor(size)], "stitches": stitches}


def tied(rng: Generator, size: float) -> Parts:
    """A rod that goes around a thing is drawn tight by its ends."""
    kind = str(rng.choice(("solid", "pillow", "rigid")))
    around = thing(rng, "around", kind, size, (0.0, 0.0, 0.0)) | {
        "rotation": [0.0] * 3,
        "velocity": [0.0] * 3,
        "angular_velocity": [0.0] * 3,
    }
    cylinder = {"shape": "cylinder", "radius": 0.15 * size, "length": 0.4 * size, "cells": [6, 4]}
    if kind == "solid":
        around["mesh"] = cylinder
        around["material"]["young_modulus"] = between(rng, 2e4, 1e6)
    elif kind == "rigid":
        around["mesh"] = cylinder
    else:
        around["mesh"] = {"shape": "sphere", "radius": 0.16 * size, "cells": 8}
        around["inside"] = {"gas": 101325.0}
    turns, segments = float(rng.choice([1.0, 1.5, 2.5])), int(rng.integers(60, 100))
    radius = size * float(rng.uniform(0.004, 0.01))
    material = bent(rng, {"radius": radius, "young_modulus": between(rng, 1e6, 1e8), "density": 800.0}, 0.003, 0.1, (0.0, 1.0))
    angle = np.linspace(0.0, 2.0 * np.pi * turns, segments + 1)
    rise = 0.06 * size * (angle / angle[-1] - 0.5) * max(1.0, turns)
    circle = 0.19 * size * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], 1)
    circle[:, 1] = rise
    out = np.array([0.0, 0.0, 0.2 * size])  # both ends run off along the tangent
    tails = (
        circle[0] - out * np.linspace(1.0, 0.1, 8)[:, None],
        circle[-1] + out * np.sign(np.cos(angle[-1])) * np.linspace(0.1, 1.0, 8)[:, None],
    )
    points = np.concatenate([tails[0], circle, tails[1]])
    lines = np.stack([np.arange(len(points) - 1), np.arange(1, len(points))], 1)
    speed, last = 0.3 * size, len(points) - 1
    side = float(np.sign(np.cos(angle[-1])))
    ends = [
        {"select": {"vertices": [0, 1]}, "motion": {"velocity": [0.0, 0.0, -speed], "end": 0.5}},
        {"select": {"vertices": [last - 1, last]}, "motion": {"velocity": [0.0, 0.0, side * speed], "end": 0.5}},
    ]
    if rng.random() < 0.3:
        ends[1]["stiffness"] = between(rng, 100.0, 2e3)
    rope = {"name": "rope", "kind": "rod", "mesh": {"vertices": points, "lines": lines}, "material": material, "pins": ends}
    return {"bodies": [around, rope | {"friction": float(rng.choice([0.0, 0.2, 0.5]))}]}


def curtain(rng: Generator, size: float) -> Parts:
    """A curtain is drawn along its rail, by what leads one end of it; on the other side it is held by springs, or a rope; things lean on it."""
    cells, material = int(rng.integers(8, 13)), woven(rng, size) | {"membrane_stiffness": between(rng, 100.0, 5e3)}
    side = 0.7 * size
    line = np.linspace(-0.5 * side, 0.5 * side, 5)
    drawn = {"motion": {"keyframes": [{"time": 0.05}, {"time": 0.35, "translation": [-0.55 * side, 0.0, 0.0]}]}}
    pins: list[dict[str, Any]] = [{"select": {"nearest": [line[-1], 0.5 * side, 0.0]}, **drawn}]
    pins.append({"select": {"nearest": [line[0], 0.5 * side, 0.0]}})
    if rng.random() < 0.5:
        pins[1]["end"] = 0.3
    on_rail = {"stiffness": between(rng, 200.0, 5e3), "axes": "yz"}
    pins += [{"select": {"nearest": [float(x), 0.5 * side, 0.0]}, **on_rail} for x in line[1:-1]]
    sheet = {"name": "curtain", "kind": "cloth", "mesh": {"shape": "grid", "size": [side, side], "cells": [cells, cells]}}
    sheet |= {"rotation": [90.0, 0.0, 0.0], "material": material, "pins": pins, "friction": 0.3}
    bodies = [sheet]
    for k, kind in enumerate(rng.choice(("rigid", "rod", "solid", "pillow"), 2)):
        away = 0.35 * size * (1 - 2 * k)
        body = thing(rng, f"beside{k}_{kind}", str(kind), 0.6 * size, (float(rng.uniform(-0.1, 0.1)) * size, -0.1 * size, away))
        body["velocity"] = [0.0, 1.0 * float(np.sqrt(size)), -3.0 * np.sign(away) * float(np.sqrt(size))]
        bodies.append(body)
    gust = {"kind": "wind", "velocity": [0.0, 0.0, float(rng.uniform(-5.0, 5.0))], "bodies": ["curtain"]}
    return {"bodies": bodies, "obstacles": [floor(size, -0.8 * size)], "forces": [gust]}


def trampoline(rng: Generator, size: float) -> Parts:
    """A sheet with a limit of its stretch is held along its rim; heavy things fall on it."""
    cells, side = int(rng.integers(8, 13)), 0.8 * size
    material = woven(rng, size) | {
        "strain_limit": float(rng.uniform(0.02, 0.25)),
        "membrane_stiffness": between(rng, 20.0, 2e3),
    }
    mesh = {"shape": "grid", "size": [side, side], "cells": [cells, cells]}
    edge = 0.49 * side
    far = 9.0 * size
    boxes = [[[edge, -far, -far], [far, far, far]], [[-far, -far, -far], [-edge, far, far]]]
    sheet = {"name": "sheet", "kind": "cloth", "mesh": mesh, "material": material}
    sheet["pins"] = [{"select": {"box": box}} for box in boxes]
    if rng.random() < 0.5:
        sheet["pins"][0]["motion"] = {"keyframes": [{"time": 0.1}, {"time": 0.3, "translation": [-0.1 * side, 0.0, 0.0]}]}
    bodies = [sheet]
    for k, kind in enumerate(rng.choice(("rigid", "rigid", "solid", "pillow", "rod"), 2)):
        body = thing(rng, f"fallen{k}_{kind}", str(kind), 0.6 * size, (0.0, (0.3 + 0.5 * k) * size, 0.0))
        bodies.append(body | {"velocity": [0.0, -2.0 * (1 + k) * float(np.sqrt(size)), 0.0]})
    return {"bodies": bodies, "obstacles": [floor(size, -0.7 * size)]}


def pressed(rng: Generator, size: float) -> Parts:
    """A plate comes down on a pillow, a solid, a coil or a heap, presses it, turns, and goes up again."""
    kind = str(rng.choice(("pillow", "solid", "rod", "cloth")))
    count = int(rng.integers(1, 3))
    below = thing(rng, "below", kind, size, (0.0, 0.12 * size, 0.0)) | {"rotation": [0.0] * 3, "velocity": [0.0] * 3}
    if kind == "rod":
        coil = {"shape": "coil", "radius": 0.12 * size, "height": 0.15 * size, "turns": 3, "segments": 50}
        below |= {"mesh": coil, "material": bent(rng, cord(rng, size) | {"radius": 0.012 * size}, 0.01, 1.0, (0.0, 1.0))}
    if kind == "pillow":
        below["inside"] = [
            {"pressure": min(between(rng, 5.0, 500.0) * size, below["material"]["membrane_stiffness"] / size)},
            {"gas": 101325.0, "volume": 0.02 * size**3, "rise": 0.05},
        ][rng.integers(2)]
    apart = 0.27 * size
    below["copies"] = {"counts": [1, count, 1], "spacing": [0.0, apart, 0.0]}
    high = (0.28 * size + apart * (count - 1)) + 0.03 * size
    left = float(rng.uniform(0.3, 0.6)) * 0.2 * size * count
    down = [0.0, left - high, 0.0]
    keys = [
        {"time": 0.0},
        {"time": 0.25, "translation": down},
        {"time": 0.35, "translation": down, "rotation": [0.0, 15.0, 0.0]},
    ]
    keys.append({"time": 0.5, "rotation": [0.0, 15.0, 0.0]})
    plate = {"name": "plate", "mesh": {"shape": "box", "size": [1.5 * size, 0.05 * size, 1.5 * size], "cells": [2, 1, 2]}}
    plate |= {"translation": [0.0, high + 0.025 * size, 0.0], "motion": {"keyframes": keys, "smooth": bool(rng.random() < 0.5)}}
    return {"bodies": [below], "obstacles": [floor(size), plate]}


def worn(rng: Generator, size: float) -> Parts:
    """A cape hangs by springs on a body that tumbles, a lace with its end on the cape; buttons are tied to it."""
    kind = str(rng.choice(("solid", "rigid", "pillow")))
    body = thing(rng, "wearer", kind, size, (0.0, 0.0, 0.0)) | {"rotation": [0.0] * 3}
    box = {"shape": "box", "size": [0.3 * size, 0.2 * size, 0.25 * size], "cells": [4, 3, 3]}
    body["mesh"] = box
    if kind == "rigid":
        body["angular_velocity"] = rng.normal(0.0, 3.0, 3).tolist()
    if kind == "pillow":
        body["inside"] = {"gas": 101325.0, "volume": 0.018 * size**3, "rise": 0.1}
    reach = 0.4 * size
    mesh = {"shape": "grid", "size": [0.25 * size, reach], "cells": [6, 9]}
    material = sewn(rng, size)
    sheet = {"name": "cape", "kind": "cloth", "mesh": mesh, "material": material, "velocity": body["velocity"]}
    start = [0.0, 0.112 * size, 0.5 * reach]
    grip = [[-9.0 * size, -9.0 * size, -9.0 * size], [9.0 * size, 9.0 * size, 0.1 * size]]
    sheet |= {
        "translation": start,
        "pins": [{"select": {"box": grip}, "follow": "wearer", "stiffness": between(rng, 100.0, 5e3)}],
    }
    button = {
        "name": "button",
        "kind": "rigid",
        "mesh": {"shape": "cylinder", "radius": 0.03 * size, "length": 0.02 * size, "cells": [4, 1]},
    }
    button |= {"translation": [0.0, 0.13 * size, 0.9 * reach], "material": {"density": between(rng, 500.0, 5000.0)}}
    lace = {"name": "lace", "kind": "rod", "mesh": {"shape": "rope", "length": 0.3 * size, "segments": 14}}
    lace |= {"rotation": [0.0, 90.0, 0.0], "translation": [0.06 * size, 0.112 * size, reach + 0.17 * size]}
    lace["material"] = cord(rng, 0.5 * size) | {"radius": 0.004 * size, "young_modulus": between(rng, 1e5, 1e7)}
    sewn_on = {"bodies": ("button", "cape"), "within": 0.035 * size, "stiffness": between(rng, 2.0, 100.0)}
    ties = [
        sewn_on if rng.random() < 0.5 else sewn_on | {"rest_length": 0.01 * size},
        {"bodies": ("lace", "cape"), "within": 0.05 * size, "stiffness": between(rng, 100.0, 5e3)},
    ]
    return {"bodies": [body, sheet, button, lace], "attachments": ties, "obstacles": [floor(size, -0.4 * size)]}


FAMILIES = (hung, patchwork, applied, tied, curtain, trampoline, pressed, worn)
