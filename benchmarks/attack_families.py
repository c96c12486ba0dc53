"""Families of scenes for `attack.py` that use what came after contact itself: rods, rigid bodies, deforming obstacles, commands between steps, pins
that begin and end, quarantine, seams, gas, separated starts, runs that are resumed.

A family is f(rng) -> `Case`. act(simulation, rng, step) is called before each step, and may give another simulation to go on with.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

import pdipc

NEWTON = {"nonlinear_solver": "newton"}


@dataclass
class Case:
    """Tables of a scene, and what is done between its steps."""

    bodies: list[dict]
    obstacles: list[dict] = field(default_factory=list)
    simulation: dict = field(default_factory=dict)
    contact: dict = field(default_factory=dict)
    more: dict = field(default_factory=dict)
    act: Callable | None = None


# --- what scenes are made of ---


def sheet(name: str, side: float = 1.0, cells: int = 4, **more) -> dict:
    return {"name": name, "kind": "cloth", "mesh": {"shape": "grid", "size": [side, side], "cells": [cells, cells]}, **more}


def block(name: str, side: float = 0.3, cells: int = 1, young: float = 1e5, **more) -> dict:
    mesh = {"shape": "box", "size": [side] * 3, "cells": [cells] * 3}
    return {"name": name, "kind": "solid", "mesh": mesh, "material": {"young_modulus": young}, **more}


def ball(name: str, radius: float, cells: int = 2, **more) -> dict:
    return {"name": name, "mesh": {"shape": "sphere", "radius": radius, "cells": cells}, **more}


def bar(name: str, length: float = 1.2, width: float = 0.05, **more) -> dict:
    return {"name": name, "mesh": {"shape": "box", "size": [length, width, width], "cells": [1, 1, 1]}, **more}


def loose(name: str, vertices, triangles, **more) -> dict:
    return {"name": name, "mesh": {"vertices": np.asarray(vertices, float), "triangles": np.asarray(triangles)}, **more}


def power(rng, low: float, high: float) -> float:
    return float(10.0 ** rng.uniform(low, high))


def turn(rng, most: float = 180.0) -> list[float]:
    return rng.uniform(-most, most, 3).tolist()


def vector(rng, size: float) -> list[float]:
    v = rng.normal(size=3)
    return (size * v / np.linalg.norm(v)).tolist()


def rope(rng, name: str, mesh: dict, **more) -> dict:
    radius = power(rng, -3, -1.7)
    material = {"radius": radius, "young_modulus": power(rng, 4, 9)}
    if rng.random() < 0.4:
        material["twist_stiffness"] = 0.0
    return {"name": name, "kind": "rod", "mesh": mesh, "material": material, **more}


def hull(rng, name: str, size: float, **more) -> dict:
    """A rigid body: a box, a thin plate, a needle, a ball or a ring."""
    meshes = (
        {"shape": "box", "size": [size] * 3, "cells": [1, 1, 1]},
        {"shape": "box", "size": [size, 0.02 * size, size], "cells": [1, 1, 1]},
        {"shape": "box", "size": [0.01 * size, 2 * size, 0.02 * size], "cells": [1, 2, 1]},
        {"shape": "sphere", "radius": 0.5 * size, "cells": 2},
        {"shape": "torus", "major_radius": 0.5 * size, "minor_radius": 0.12 * size, "cells": [2, 7]},
    )
    return {"name": name, "kind": "rigid", "mesh": meshes[rng.integers(len(meshes))], **more}


def shell(name: str, radius: float, cells: int = 3, **more) -> dict:
    """A closed cloth."""
    return {"name": name, "kind": "cloth", "mesh": {"shape": "sphere", "radius": radius, "cells": cells}, **more}


def animated(rng, name: str, mesh, frames: int, seconds: float, size: float, **more) -> dict:
    """An obstacle of vertices and triangles whose vertices each go their own way; it may turn inside out."""
    vertices, triangles = mesh
    places = [vertices]
    for _ in range(frames - 1):
        q = Rotation.from_rotvec(vector(rng, rng.uniform(0, np.pi))).as_matrix()
        places.append(vertices @ q.T + vector(rng, size) + size * rng.normal(size=vertices.shape) * rng.choice([0, 1]))
    times = np.append(0.0, np.sort(rng.uniform(0.02, 1.0, frames - 1))) * seconds
    cache = {"vertices": np.array(places), "times": times.tolist()}
    return {**loose(name, vertices, triangles), "motion": {"cache": cache}, **more}


def plate(side: float = 0.8):
    s = side / 2
    return np.array([[-s, 0, -s], [s, 0, -s], [-s, 0, s], [s, 0, s]]), np.array([[0, 2, 1], [1, 2, 3]])


def own(simulation, name: str) -> slice:
    body = next(each for each in simulation.model.assembly.bodies if each.name == name)
    return slice(body.first, body.last)


# --- families ---


def ropes(rng):
    """Rods over a bar, through rings, pulled tight in a knot, on a cloth."""
    pull = power(rng, -1, 3)
    shapes = [
        {"shape": "rope", "length": 1.0, "segments": int(rng.integers(4, 14))},
        {"shape": "ring", "radius": 0.15, "segments": 9},
        {"shape": "coil", "radius": 0.1, "height": 0.3, "turns": 2.5, "segments": 24},
        {"shape": "knot", "length": 1.0, "segments": 30},
    ]
    bodies = []
    for k in range(3):
        body = rope(rng, f"rod{k}", shapes[rng.integers(4)], translation=[0, 0.3 * k, 0.05 * k], rotation=turn(rng))
        bodies.append(body | {"velocity": vector(rng, power(rng, -1, 1.5)), "angular_velocity": vector(rng, power(rng, -1, 2))})
    if rng.random() < 0.5:
        ends = [[0, -1], [int(bodies[0]["mesh"]["segments"]) - 1, 1]]
        bodies[0]["pins"] = [{"select": {"vertices": [v]}, "motion": {"velocity": [side * pull, 0, 0]}} for v, side in ends]
    bodies.append(sheet("cloth", 0.8, 3, translation=[0, -0.3, 0], velocity=[0, power(rng, -1, 1), 0]))
    return Case(bodies, [bar("bar", 2.0, 0.03, translation=[0, -0.45, 0.1])], NEWTON, {"friction": float(rng.choice([0, 0.4]))})


def hairs(rng):
    """Rods side by side and across each other at a hair's breadth, all parallel or nearly so."""
    d = power(rng, -4, -2)
    bodies = []
    for k in range(5):
        mesh = {"shape": "rope", "length": 1.0, "segments": int(rng.choice([1, 2, 6]))}
        body = {"name": f"hair{k}", "kind": "rod", "mesh": mesh, "material": {"radius": d, "young_modulus": power(rng, 5, 9)}}
        tilt = float(rng.choice([0.0, 90.0, power(rng, -7, -1)]))
        bodies.append(body | {"translation": [0, 2.2 * d * k, 0], "rotation": [0, tilt * k, 0], "velocity": [0, -3.0 * k, 0]})
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 3.0}, "translation": [0, -2.2 * d, 0]}
    return Case(bodies, [floor], NEWTON, {"activation_distance": d * rng.uniform(0.05, 0.5)})


def rigid_bodies(rng):
    """Rigid bodies of all shapes that spin and fly into each other, a cloth and a soft block."""
    bodies = []
    for k in range(3):
        body = hull(rng, f"rigid{k}", power(rng, -1.3, -0.3), translation=[0.1 * k, 0.7 * k, 0], rotation=turn(rng))
        body |= {"velocity": vector(rng, power(rng, 0, 3)), "angular_velocity": vector(rng, power(rng, 0, 4))}
        body |= {"material": {"shape_stiffness": power(rng, 5, 12), "density": power(rng, 1, 4)}}
        bodies.append(body)
    bodies += [sheet("cloth", translation=[0, -0.5, 0]), block("block", 0.2, translation=[0.2, -0.8, 0])]
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 5.0}, "translation": [0, -1.2, 0]}
    return Case(bodies, [floor], NEWTON, {"restitution": float(rng.choice([0, 1.0])), "friction": float(rng.choice([0, 1.0]))})


def rigid_chain(rng):
    """Linked rigid rings of which one is torn away by springs, in a closing vice."""
    rings = []
    for k in range(3):
        mesh = {"shape": "torus", "major_radius": 0.2, "minor_radius": 0.04, "cells": [2, 6]}
        rings.append(
            {
                "name": f"ring{k}",
                "kind": "rigid",
                "mesh": mesh,
                "translation": [0.29 * k, 0, 0],
                "rotation": [90.0 * (k % 2), 0, 0],
            }
        )
        rings[k] |= {"angular_velocity": vector(rng, power(rng, 0, 3))}
    pin = {
        "select": {"box": [[-1, -1, -1], [-0.12, 1, 1]]},
        "stiffness": power(rng, 3, 7),
        "motion": {"velocity": vector(rng, power(rng, 0, 3))},
    }
    rings[0]["pins"] = [pin]
    vice = [
        bar(f"vice{k}", 2.0, 0.05, translation=[0, side * 0.4, 0]) | {"motion": {"velocity": [0, -side * power(rng, 0, 2), 0]}}
        for k, side in enumerate((-1, 1))
    ]
    return Case(rings, vice, NEWTON)


def deforming_obstacles(rng):
    """A plate whose vertices are animated, with frames far closer than steps or far apart, under cloth, rod and rigid body."""
    seconds = power(rng, -4, 0)
    hand = animated(rng, "hand", plate(), int(rng.integers(2, 9)), seconds, power(rng, -2, 1))
    bodies = [sheet("cloth", 0.7, translation=[0, 0.1, 0]), sheet("under", 0.7, 3, translation=[0, -0.1, 0])]
    bodies += [block("block", 0.2, translation=[0, 0.3, 0]), hull(rng, "rigid", 0.3, translation=[0, 1.0, 0])]
    bodies.append(rope(rng, "rod", {"shape": "rope", "length": 0.8, "segments": 6}, translation=[0, 0.15, 0]))
    return Case(bodies, [hand], NEWTON)


def deforming_and_plain(rng):
    """The same for every solver."""
    case = deforming_obstacles(rng)
    return Case(case.bodies[:3], case.obstacles)


def commanded(rng):
    """Poses, vertices, pins, forces and gravity as a wild hand would give them, changed while something is still under way."""
    pins = [{"select": {"box": [[-0.6, -1, -0.6], [-0.49, 1, 0.6]]}}]
    bodies = [sheet("cloth", translation=[0, 0.1, 0], pins=pins), block("block", 0.25, translation=[0.1, 0.4, 0])]
    obstacles = [bar("bar", translation=[0, -0.1, 0]), loose("sail", *plate(0.5), translation=[0, 0.8, 0])]

    def act(simulation, rng, step):
        speed = power(rng, -1, 4)
        match rng.integers(7):
            case 0 | 1:
                simulation.set_pose("bar", vector(rng, power(rng, -1, 1)), turn(rng), speed)
            case 2:
                simulation.set_vertices("sail", plate(0.5)[0] + rng.normal(size=(4, 3)), speed)
            case 3:
                held = simulation.model.assembly.pins[0].vertices
                simulation.set_pin("cloth", simulation.positions[held] + vector(rng, power(rng, -2, 1)), speed=speed)
            case 4:
                simulation.set_gravity(vector(rng, power(rng, 0, 5)))
            case 5:
                which = own(simulation, "block")
                simulation.set_vertex_force(
                    np.arange(which.start, which.stop), rng.normal(size=(which.stop - which.start, 3)) * power(rng, 0, 6)
                )
            case 6:
                simulation.set_velocities("cloth", rng.normal(size=(25, 3)) * power(rng, 0, 3))

    return Case(bodies, obstacles, act=act)


def put_anew(rng):
    """Bodies are put elsewhere between steps, most often where they may not be, with remainders and lists of where they were."""
    bodies = [
        sheet("cloth", 0.6, translation=[0, 0.4, 0], velocity=[0, -3, 0]),
        block("block", 0.2, translation=[0.6, 0.4, 0], rotation=turn(rng)),
        hull(rng, "rigid", 0.2, translation=[-0.6, 0.5, 0], angular_velocity=vector(rng, 30)),
    ]

    def act(simulation, rng, step):
        name = str(rng.choice(["cloth", "block", "rigid"]))
        x = simulation.positions[own(simulation, name)]
        q = Rotation.from_rotvec(vector(rng, rng.uniform(0, 3))).as_matrix()
        middle = x.mean(axis=0)
        wanted = (x - middle) @ q.T + middle + vector(rng, power(rng, -3, 0))
        before = simulation.state.positions.numpy().copy()
        try:
            simulation.set_positions(name, wanted)
        except ValueError:
            assert np.array_equal(before, simulation.state.positions.numpy()), "a refused position was taken over"

    return Case(bodies, [ball("ball", 0.25)], NEWTON, act=act)


def pins_come_and_go(rng):
    """Pins that begin and end while what they hold is pressed, some of them on an obstacle that turns or deforms."""
    pins = []
    for x, z in ((-0.3, -0.3), (0.3, -0.3), (-0.3, 0.3), (0.3, 0.3)):
        pin = {"select": {"sphere": [[x, 0.1, z], 0.25]}, "start": float(rng.choice([0.0, rng.uniform(0, 0.06)]))}
        pin["end"] = pin["start"] + rng.uniform(0.005, 0.08)
        match rng.integers(4):
            case 0:
                pin["motion"] = {"velocity": vector(rng, power(rng, -1, 2)), "angular_velocity": vector(rng, power(rng, -1, 2))}
            case 1:
                pin["stiffness"] = power(rng, 1, 6)
            case 2:
                pin["follow"] = "hand"
        pins.append(pin)
    bodies = [
        sheet("cloth", translation=[0, 0.1, 0], velocity=[0, -5, 0], pins=pins),
        block("block", 0.25, translation=[0, 0.4, 0]),
    ]
    if rng.random() < 0.5:
        hand = animated(rng, "hand", plate(0.5), 4, 0.05, power(rng, -2, 0), translation=[0, -0.2, 0])
    else:
        hand = bar("hand", 0.8, translation=[0, -0.2, 0], motion={"angular_velocity": vector(rng, power(rng, 0, 2.5))})
    return Case(bodies, [hand], NEWTON)


def held_by_what_turns(rng):
    """Cloth and rod glued to an obstacle that spins into another obstacle, a body between the two."""
    spin = {"angular_velocity": vector(rng, power(rng, 0, 3)), "velocity": vector(rng, power(rng, -1, 1))}
    hand = bar("hand", 0.8, translation=[0, 0.3, 0], motion=spin)
    cloth = sheet("cloth", 0.6, 4, translation=[0, 0.2, 0])
    cloth["pins"] = [{"select": {"box": [[-0.31, 0, -0.31], [-0.1, 1, 0.31]]}, "follow": "hand"}]
    rod = rope(rng, "rod", {"shape": "rope", "length": 0.7, "segments": 6}, translation=[0, 0.45, 0])
    rod["pins"] = [{"select": {"vertices": [0]}, "follow": "hand"}]
    wall = {"name": "wall", "mesh": {"shape": "box", "size": [0.1, 2, 2], "cells": [1, 1, 1]}, "translation": [0.55, 0.3, 0]}
    return Case([cloth, rod, block("block", 0.2, translation=[0, -0.2, 0])], [hand, wall], NEWTON)


def quarantined(rng):
    """Bodies that start in each other and ignore each other until they part, with others around that they do not ignore."""
    bodies = [
        sheet("cloth", translation=[0, 0.03, 0], velocity=vector(rng, power(rng, 0, 1.5))),
        block("block", 0.3, rotation=turn(rng), velocity=vector(rng, power(rng, -1, 1))),
        hull(rng, "rigid", 0.25, translation=[0.05, 0.02, 0], rotation=turn(rng), velocity=vector(rng, power(rng, 0, 1))),
        sheet("other", 0.9, 3, translation=[0, 0.6, 0], velocity=[0, -4, 0]),
    ]
    pairs = [
        ("cloth", "block"),
        ("cloth", "rigid"),
        ("block", "rigid"),
        ("block", "post"),
        ("rigid", "post"),
        ("cloth", "post"),
    ]
    post = bar("post", 0.9, 0.04, rotation=turn(rng), motion={"velocity": vector(rng, power(rng, -1, 1))})
    floor = {"name": "floor", "mesh": {"shape": "plane", "size": 3.0}, "translation": [0, -0.6, 0]}
    return Case(bodies, [post, floor], NEWTON, {"quarantine": pairs, "activation_distance": 1e-2})


def sewn(rng):
    """Panels that stiff threads draw together through each other's way, of cloth that must not stretch."""
    material = {"strain_limit": power(rng, -2, 0)} if rng.random() < 0.5 else {}
    if rng.random() < 0.4:
        material |= {"membrane_stiffness": 300.0, "weft_stiffness": 30.0}
    bodies = [
        sheet(f"panel{k}", 0.6, 3, translation=[0, 0.12 * k, 0.02 * k], rotation=turn(rng, 8), material=material)
        for k in range(3)
    ]
    bodies.append(block("block", 0.04, translation=[0, 0.06, 0]))
    stitches = []
    for _ in range(3):
        a, b = rng.choice(3, 2, replace=False)
        table = {
            "bodies": (f"panel{a}", f"panel{b}"),
            "pairs": [(int(rng.integers(16)), int(rng.integers(16))) for _ in range(3)],
        }
        stitches.append(
            table
            | {
                "stiffness": power(rng, 2, 8),
                "length": float(rng.choice([0.0, 0.01])),
                "duration": float(rng.choice([0, 0.05])),
            }
        )
    return Case(bodies, [], NEWTON, {"activation_distance": 5e-3}, {"stitches": stitches})


def filled(rng):
    """Closed cloth that a gas blows up, a liquid fills or an underpressure crushes, in a cage of plates, with a rigid body inside."""
    inside = (
        {"pressure": float(rng.choice([-1, 1])) * power(rng, 2, 6)},
        {"gas": power(rng, 4, 7), "exponent": 1.4},
        {"bulk_modulus": power(rng, 3, 7), "volume": power(rng, -3, 0)},
    )[rng.integers(3)]
    bodies = [
        shell("balloon", 0.3, inside=inside, rotation=turn(rng)),
        hull(rng, "rigid", 0.1, translation=[0.5, 0, 0], velocity=[-10, 0, 0]),
    ]
    if rng.random() < 0.5:
        bodies.append(shell("second", 0.3, inside=inside, translation=[0, 0.65, 0], velocity=[0, -power(rng, 0, 2), 0]))
    cage = []
    for k, side in enumerate((-1.0, 1.0)):
        cage.append(
            bar(f"cage{k}", 1.5, 0.1, translation=[0, side * 0.45 + 0.2, 0])
            | {"motion": {"velocity": [0, -side * power(rng, -1, 2), 0]}}
        )
    return Case(bodies, cage if len(bodies) == 2 and rng.random() < 0.7 else [], NEWTON)


def put_apart(rng):
    """Starts that intersect and are separated first: cloth through blocks, rods through cloth, rigid bodies in each other."""
    bodies = [
        sheet("cloth", 0.8, 5, translation=[0, 0.03, 0], rotation=turn(rng, 15)),
        block("block", 0.3, translation=[0, 0.12, 0], rotation=turn(rng)),
        rope(rng, "rod", {"shape": "rope", "length": 1.0, "segments": 8}, translation=[0, 0.0, 0.1], rotation=turn(rng, 25)),
        hull(rng, "rigid", 0.2, translation=[0.25, 0.05, 0], rotation=turn(rng)),
    ]
    chosen = [bodies[k] for k in np.sort(rng.choice(4, int(rng.integers(2, 4)), replace=False))]
    post = bar("post", 1.2, 0.03, translation=[-0.2, 0, 0.1], rotation=turn(rng))
    contact = {"start": "separate", "start_limit": 0.5, "activation_distance": 5e-3}
    return Case(chosen, [post] if rng.random() < 0.5 else [], NEWTON, contact)


def resumed(rng):
    """A run that is stopped after every other step and goes on in a simulation made anew; it must give the same bits."""
    case = (ropes, rigid_bodies, deforming_obstacles, commanded, pins_come_and_go, quarantined, filled)[rng.integers(7)](rng)
    before = case.act

    def act(simulation, rng, step):
        if before is not None:
            before(simulation, rng, step)
        if step % 2 == 1:
            again = pdipc.Simulation(simulation.model.scene, "cpu")
            again.restore(simulation.checkpoint())
            simulation.step()
            return again
        return None

    return Case(case.bodies, case.obstacles, case.simulation, case.contact, case.more, act)


def instants(rng):
    """Steps of nanoseconds, or of a second."""
    h = power(rng, -9, -4) if rng.random() < 0.7 else power(rng, -1, 0)
    speed = min(1e8, power(rng, -4, 0) / h)
    bodies = [
        sheet("cloth", translation=[0, 0.02, 0], velocity=[0, -speed, 0]),
        block("block", 0.2, translation=[0.1, 0.3, 0], velocity=[0, -2 * speed, 0], rotation=turn(rng)),
        hull(rng, "rigid", 0.2, translation=[-0.2, 0.35, 0], angular_velocity=vector(rng, min(1e7, 1 / h))),
    ]
    floor = bar("floor", 2.0, 0.02, translation=[0, -0.02, 0], motion={"angular_velocity": vector(rng, rng.uniform(0, 2) / h)})
    return Case(bodies, [floor], NEWTON | {"time_step": h}, {"activation_distance": power(rng, -4, -2)})


def huge(rng):
    """Bodies of a thousand kilometres, and places where coordinates have few digits left."""
    s = power(rng, 5, 8.5)
    bodies = [
        sheet("cloth", translation=[0, 0.02 * s, 0], velocity=vector(rng, min(1e9, s)), scale=s),
        hull(rng, "rigid", 0.3, translation=[0, 0.5 * s, 0], rotation=turn(rng), velocity=[0, -min(1e9, 10 * s), 0], scale=s),
        rope(rng, "rod", {"shape": "rope", "length": 0.9, "segments": 5}, translation=[0, -0.1 * s, 0], scale=s),
    ]
    bodies[2]["material"] |= {"radius": min(1e3, 1e-3 * s)}
    floor = {
        "name": "floor",
        "mesh": {"shape": "plane", "size": 3},
        "translation": [0, -0.3 * s, 0],
        "rotation": turn(rng, 5),
        "scale": s,
    }
    return Case(bodies, [floor], NEWTON | {"gravity": vector(rng, s)}, {"activation_distance": 1e-3 * s})


def thrown_far(rng):
    """What flies off by orders of magnitude within a step, meets something on the way, and goes on among few digits."""
    far = power(rng, 2, 9)
    bodies = [
        sheet("cloth", velocity=(np.array([0, far, 0]) + vector(rng, 1)).tolist()),
        sheet("wall", 2.0, 3, translation=[0, 0.2, 0], pins=[{"select": {"box": [[-1.01, -1, -1.01], [-0.9, 1, 1.01]]}}]),
        rope(
            rng,
            "rod",
            {"shape": "ring", "radius": 0.08, "segments": 8},
            translation=[0, 0.1, 0],
            velocity=[0, far * rng.random(), 0],
        ),
        hull(rng, "rigid", 0.3, translation=[0.1, 0.6, 0], velocity=vector(rng, far)),
    ]

    def act(simulation, rng, step):
        simulation.set_gravity(vector(rng, power(rng, 0, 9)))

    return Case(bodies, [], NEWTON, act=act)


def obstacles_led(rng):
    """Obstacles that turn under commands given anew each step, faster than they can be followed, with bodies in the way."""
    bodies = [
        sheet("cloth", translation=[0, 0.15, 0]),
        block("block", 0.2, translation=[0.35, 0.3, 0]),
        hull(rng, "rigid", 0.2, translation=[-0.3, 0.5, 0]),
    ]
    obstacles = [
        bar("bar"),
        bar("spinner", 0.8, translation=[0, -0.3, 0], motion={"angular_velocity": vector(rng, power(rng, 1, 3))}),
    ]

    def act(simulation, rng, step):
        if step == 4:
            simulation.reset()
        name = str(rng.choice(["bar", "spinner"]))
        position = vector(rng, 0.3) if rng.random() < 0.5 else None
        simulation.set_pose(name, position, turn(rng), speed=power(rng, 0, 2.5))

    contact = {"minimum_separation": 5e-3, "activation_distance": 5e-3}
    return Case(bodies, obstacles, NEWTON, contact, act=act)


def all_at_once(rng):
    """A rod, a rigid body, a closed cloth with gas, a sewn cloth and a soft block under an animated and a spinning obstacle."""
    bodies = [
        sheet("cloth", 0.8, 3, translation=[0, 0.1, 0], material={"strain_limit": 0.2}),
        rope(rng, "rod", {"shape": "rope", "length": 0.8, "segments": 6}, translation=[0, 0.16, 0]),
        hull(rng, "rigid", 0.2, translation=[0.15, 0.45, 0], velocity=vector(rng, 10)),
        shell("balloon", 0.15, 2, inside={"gas": 2e5}, translation=[-0.2, 0.5, 0]),
        block("block", 0.15, translation=[0, 0.9, 0], velocity=[0, -20, 0]),
    ]
    more = {
        "stitches": [{"bodies": ("cloth", "cloth"), "pairs": [(0, 15), (3, 12)], "stiffness": power(rng, 2, 6)}],
        "attachments": [{"bodies": ("rod", "rigid"), "pairs": [(0, 0)], "stiffness": power(rng, 2, 7), "rest_length": 0.0}],
        "forces": [{"kind": "wind", "velocity": vector(rng, power(rng, 0, 2)), "bodies": ["cloth"]}],
    }
    obstacles = [animated(rng, "hand", plate(0.6), 3, 0.05, 0.2, translation=[0, -0.05, 0])]
    obstacles.append(
        bar(
            "bar",
            1.0,
            translation=[0, 1.3, 0],
            motion={"angular_velocity": vector(rng, power(rng, 0, 2)), "velocity": [0, -5, 0]},
        )
    )
    return Case(bodies, obstacles, NEWTON, {"friction": 0.3, "restitution": float(rng.choice([0, 0.8]))}, more)


FAMILIES = (
    ropes,
    hairs,
    rigid_bodies,
    rigid_chain,
    deforming_obstacles,
    deforming_and_plain,
    commanded,
    put_anew,
    pins_come_and_go,
    held_by_what_turns,
    quarantined,
    sewn,
    filled,
    put_apart,
    resumed,
    instants,
    huge,
    thrown_far,
    obstacles_led,
    all_at_once,
)
