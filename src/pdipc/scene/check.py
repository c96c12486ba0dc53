"""What is refused before a simulation begins, with every finding at once."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from pdipc.judge import boxes
from pdipc.judge.witness import find_intersections
from pdipc.scene import meshes, rods
from pdipc.scene.assembly import AssembledBody, Assembly, gather
from pdipc.scene.check_garments import check_garments, cloth_settings
from pdipc.scene.errors import SceneError
from pdipc.scene.finding import Finding
from pdipc.scene.load import RightPart, load_right_part
from pdipc.scene.motion import Trajectory
from pdipc.scene.movers import MOST, most_chords, most_corners, movers_of
from pdipc.scene.quarantine import Quarantine
from pdipc.scene.reach import hints
from pdipc.scene.schema import Cloth, Rigid, Rod, Scene, local_global_settings, uses_newton
from pdipc.scene.separate import separate
from pdipc.scene.worlds import scenes_of

LISTED = 5  # vertices that a finding names
CHUNK = 1 << 14  # primitives whose neighbours are looked for at a time
LARGEST = 1e9  # m, m/s: the cube of a larger coordinate is lost in single precision
SEPARATION_ULPS = 100  # a minimum separation of fewer roundings of a coordinate is no protection
# An activation distance of less than these is no range for forces to grow in. Measured on the bundled stack of boxes, in which nothing
# is faster than 1.4 m/s, in float64: 1.3 m/s with 7e-8 of the scene size, 20 m/s with 3e-8, 350 m/s with 1e-8. In float32, where
# forces are bounded sooner, speeds stay right down to one rounding; ten leave a range at all.
ACTIVATION_PART, ACTIVATION_ULPS = 1e-7, 10
# Vertices of one body that start nearer than this, as a part of the activation distance and in roundings, stay where they are: a step
# may take a part of the gap, and no more. Measured on a sheet over another, of one body: with gaps of 1e-6 of the activation
# distance and below some steps do not converge and vertices hang in the air, with 1e-5 and above all fall.
CLOSEST_PART, CLOSEST_ULPS = 1e-5, 10
REST_SEPARATION, ROD_SEPARATION = 0.2, 0.7  # those of `pdipc.collision.candidates`


def check(scene: Scene | Assembly, precision: str | None = None) -> list[Finding]:
    """Everything about a scene that would be refused; empty where it can be simulated.

    precision: "float32" or "float64" of the simulation; None for what the scene names, float64 where it leaves it open.
    """
    if isinstance(scene, Assembly):
        return _check(scene, precision or "float64")
    return _check_scene(scene, precision, RightPart(scene, [], set(), {}))[0]


def check_file(path: str | Path) -> tuple[list[Finding], list[str]]:
    """What `check` finds in a scene file, also beside keys and values that are wrong in it; and what is left out of its meshes.

    Raises SceneError where the file is missing or not in its format.
    """
    part = load_right_part(path)
    findings, notes = _check_scene(part.scene, None, part) if part.scene is not None else ([], [])
    return [*(_unreadable(problem) for problem in part.problems), *findings], notes


def _check_scene(scene: Scene, precision: str | None, part: RightPart) -> tuple[list[Finding], list[str]]:
    if not isinstance(scene, Scene) or scene.worlds is None:
        return _check_world(scene, precision, part)
    try:
        scenes = {id(each): (number, each) for number, each in reversed([*enumerate(scenes_of(scene))])}  # copies once
    except SceneError as error:
        return [_unreadable(str(error))], []
    found: dict[Finding, list[int]] = {}
    notes: dict[str, None] = {}
    for number, each in sorted(scenes.values(), key=lambda numbered: numbered[0]):
        findings, told = _check_world(each, precision, part)
        notes |= dict.fromkeys(told)
        for finding in findings:
            found.setdefault(finding, []).append(number)
    in_all = [finding for finding, numbers in found.items() if len(numbers) == len(scenes)]
    in_some = [replace(f, where=f"world {', '.join(map(str, k))}: {f.where}") for f, k in found.items() if f not in in_all]
    return in_all + in_some, list(notes)


def _check_world(scene: Scene, precision: str | None, part: RightPart) -> tuple[list[Finding], list[str]]:
    assembly, problems = gather(scene, part.left_out, part.numbers)
    findings = [*_settings(scene), *map(_unreadable, problems)]
    if assembly is None:
        return findings, []
    precision = precision or ("float32" if scene.simulation.precision == "float32" else "float64")
    complete = not (problems or part.problems)
    prepare(scene, assembly, precision)
    found = [*findings, *_turns(scene, assembly), *_check(assembly, precision, complete)]
    return found, assembly.notes if found else [*assembly.notes, *hints(scene, assembly)]


def check_placed(assembly: Assembly, positions: np.ndarray, precision: str, body: int) -> list[Finding]:
    """What keeps a body, by its number, from being where positions (n, 3) m, of all, have it: as at the start of a scene."""
    assembly = replace(assembly, positions=positions)
    label = _label(assembly.bodies[body])
    touching, found = _intersections(assembly, precision)
    found = [*found, *too_close(assembly, touching, precision), *_inside(assembly, touching)]
    return [finding for finding in found if label in finding.where.split(" and ") or label in finding.found]


def _unreadable(problem: str) -> Finding:
    where, _, found = problem.partition(": ")
    return Finding(where, found, readable=False)


def refuse(scene: Scene, assembly: Assembly, precision: str) -> None:
    """Raises SceneError with all findings of `check` where there are any; assembly: that of `scene`, whose defaults are fitted first."""
    prepare(scene, assembly, precision)
    findings = [*_settings(scene), *_turns(scene, assembly), *check(assembly, precision)]
    if findings:
        found = "1 thing" if len(findings) == 1 else f"{len(findings)} things"
        raise SceneError("\n  ".join([f"the scene cannot be simulated, {found} to put right:", *map(str, findings)]))


def prepare(scene: Scene, assembly: Assembly, precision: str) -> None:
    """Completes the assembly of `scene` for `precision`: distances that are left open, and a start without intersections where it is asked for."""
    fit_defaults(scene, assembly, precision)
    if scene.contact.start == "separate" and not any(next(_numbers(assembly, body), None) for body in assembly.bodies):
        done = separate(assembly, scene.contact.start_limit)
        assembly.positions, assembly.separated = done.positions, done.moved
        for pin in assembly.pins:
            pin.points = done.positions[pin.vertices]
        assembly.notes += done.notes()
    if assembly.quarantine:
        quarantine = Quarantine(assembly)
        left = quarantine.left(assembly.positions, (True,) * len(assembly.quarantine))
        assembly.quarantine = [pair for pair, is_left in zip(assembly.quarantine, left, strict=True) if is_left]
        assembly.notes += [
            f'"{a}" and "{b}" '
            + ("start in each other and ignore each other until they part" if is_left else "start apart: no quarantine")
            for is_left, (a, b) in zip(left, quarantine.names((True,) * len(left)), strict=True)
        ]


def fit_defaults(scene: Scene, assembly: Assembly, precision: str) -> None:
    """Raises the minimum separations that the scene leaves open to what `precision` resolves, up to a tenth of the activation distance."""
    least = smallest_separation(assembly, precision)
    if scene.contact.minimum_separation or not assembly.minimum_separation < least <= 0.1 * assembly.activation_distance:
        return
    given = {placed.name for placed in (*scene.bodies, *scene.obstacles) if placed.minimum_separation}
    for body in assembly.bodies:
        if body.name not in given:
            body.half_separation = max(body.half_separation, 0.5 * least)
    assembly.minimum_separation = least


def _settings(scene: Scene) -> Iterator[Finding]:
    """Settings of the solver that do not go together."""
    method, solver, drop = scene.contact.method, scene.simulation.linear_solver, scene.simulation.solver_drop
    sim = scene.simulation
    if sim.tolerance is not None and sim.outer_tolerance is not None:
        yield Finding("simulation.outer_tolerance", "is given beside tolerance, and both say the same", "leave one of them out")
    if sim.nonlinear_solver == "newton":
        for name in local_global_settings(sim):
            yield Finding(f"simulation.{name}", "has no effect with the Newton solver", 'leave it out, or take "local-global"')
    if max(map(abs, sim.gravity)) > LARGEST:
        yield Finding("simulation.gravity", f"is {list(sim.gravity)}", f"at most {LARGEST:g} m/s^2 along each axis")
    if method == "paper" and sim.nonlinear_solver != "auto":
        found = f'is "{sim.nonlinear_solver}", but the paper\'s contact has its own'
        yield Finding("simulation.nonlinear_solver", found, "leave it out")
    newton = method != "paper" and uses_newton(sim)
    for body in scene.bodies:
        if isinstance(body, Rigid):
            if not newton:
                found = (
                    "is rigid, which the paper's contact does not know"
                    if method == "paper"
                    else "is rigid: its parts move as one"
                )
                yield Finding(f'body "{body.name}"', found, 'take the Newton solver, and contact.method = "barrier"')
            for number, pin in enumerate(body.pins):
                if pin.stiffness is None:
                    right = "give it a stiffness, or make the body an obstacle"
                    yield Finding(f'body "{body.name}", pins[{number}]', "holds vertices of a rigid body exactly", right)
        if isinstance(body, Rod) and method == "paper":
            yield Finding(
                f'body "{body.name}"', "is a rod, which the paper's contact does not know", 'take contact.method = "barrier"'
            )
        elif isinstance(body, Rod) and body.material.twist_stiffness and not newton:
            found = f"is {body.material.twist_stiffness:g} N m^2, and no local projection belongs to twist"
            yield Finding(f'body "{body.name}": material.twist_stiffness', found, "set it to 0, or take the Newton solver")
        model = getattr(body.material, "model", "auto")
        if model in ("corotated", "neo_hookean") and not newton:
            found = f'is "{model}", which no local projection belongs to'
            yield Finding(f'body "{body.name}": material.model', found, 'take "arap", or the Newton solver')
        if isinstance(body, Cloth):
            yield from cloth_settings(body, newton)
    aggregates = solver == "a-jacobi" or (solver == "auto" and method == "paper")
    if aggregates and method == "barrier":
        found = f'"{solver}" cannot take the contacts of contact.method = "{method}"'
        yield Finding("simulation.linear_solver", found, "take another solver, such as matrix-powers, or the paper's contact")
    if drop > 0.0 and not aggregates:
        found = f'is {drop:g}, but only a-jacobi has A-products; the solver is "{solver}"'
        yield Finding("simulation.solver_drop", found, "leave it out")


def smallest_separation(assembly: Assembly, precision: str) -> float:
    """The least minimum separation, m, that means something at these coordinates in "float32" or "float64"."""
    return SEPARATION_ULPS * _rounding(assembly, precision)


def smallest_activation(assembly: Assembly, precision: str) -> float:
    """The least activation distance, m, with which the speeds that contact leaves mean something in "float32" or "float64"."""
    return max(ACTIVATION_PART * assembly.body_sizes[1], ACTIVATION_ULPS * _rounding(assembly, precision))


def _rounding(assembly: Assembly, precision: str) -> float:
    """m: from the largest coordinate to the next number."""
    return float(np.spacing(np.abs(assembly.positions).max().astype(precision)))


def _check(assembly: Assembly, precision: str, complete: bool = True) -> list[Finding]:
    """complete: False where bodies are missing, so that the scene size is not known, and no distance that follows from it."""
    numbers = {body.name: list(_numbers(assembly, body)) for body in assembly.bodies}
    findings = [finding for found in numbers.values() for finding in found]
    there = [body for body in assembly.bodies if not numbers[body.name]]
    if all(body.kinematic for body in there):
        return findings
    if findings:  # what has no place has no geometry
        complete = False
        assembly = _without(assembly, {name for name, found in numbers.items() if found})
    for body in there:
        findings += _elements(assembly, body)
    findings += _selections(assembly)
    findings += _motions(assembly)
    findings += check_garments(assembly)
    distances = [*_activation(assembly, precision), *_separation(assembly, precision)] if complete else []
    # what counts is where the simulation begins: rounding can bring two sides of a thin body into one place
    assembly = replace(assembly, positions=assembly.positions.astype(precision).astype(np.float64))
    touching, found = _intersections(assembly, precision)
    findings += [*found, *distances]
    if complete:
        findings += too_close(assembly, touching, precision)
    return findings + list(_inside(assembly, touching))


def _label(body: AssembledBody) -> str:
    return f'{"obstacle" if body.kinematic else "body"} "{body.name}"'


def _at(point: np.ndarray) -> str:
    return f"({point[0]:.4g}, {point[1]:.4g}, {point[2]:.4g})"


def _numbers(assembly: Assembly, body: AssembledBody) -> Iterator[Finding]:
    """What is no number, or too large a one: the first of these."""
    own = slice(body.first, body.last)
    for name, unit in (("rest_positions", "m"), ("positions", "m"), ("velocities", "m/s")):
        values = getattr(assembly, name)[own]
        for wrong, what, right in (
            (~np.isfinite(values), "are not finite", "they must be numbers"),
            (np.abs(values) > LARGEST, f"are beyond {LARGEST:g} {unit}", f"they must be at most {LARGEST:g} {unit}"),
        ):
            bad = np.flatnonzero(wrong.any(axis=1))
            if len(bad):
                found = f"{name} of {len(bad)} vertices {what}, first vertex {bad[0]} = {values[bad[0]].tolist()}"
                yield Finding(_label(body), found, right)
                return


def _without(assembly: Assembly, names: set[str]) -> Assembly:
    """The assembly with nothing of these bodies left but their vertices, all at the origin: so that the others can be judged."""
    bodies, places = [], {name: getattr(assembly, name).copy() for name in ("rest_positions", "positions", "velocities")}
    for body in assembly.bodies:
        if body.name in names:
            body = replace(body, tets=body.tets[:0], triangles=body.triangles[:0], trajectory=None)
            for values in places.values():
                values[body.first : body.last] = 0.0
        bodies.append(body)
    pins = [pin for pin in assembly.pins if pin.body not in names]
    return replace(assembly, bodies=bodies, pins=pins, **places)


def _elements(assembly: Assembly, body: AssembledBody) -> Iterator[Finding]:
    label, first = _label(body), body.first
    if body.kind == "rod":
        yield from _segments(assembly, body)
        return
    kind, elements = ("tets", body.tets) if body.kind == "solid" else ("triangles", body.triangles)
    if body.kind == "solid":
        volumes = meshes.tet_volumes(assembly.rest_positions, elements)
        smallest = meshes.FLAT * meshes.longest_edges(assembly.rest_positions, elements) ** 3
        inverted = np.flatnonzero(volumes < -smallest)
        if len(inverted):
            example = f"tets[{inverted[0]}] = {(elements[inverted[0]] - first).tolist()}"
            found = f"{len(inverted)} of {len(elements)} tets are inverted, first {example}"
            yield Finding(label, found, "every tet needs positive volume: swap two of its vertices")
        flat = np.flatnonzero(np.abs(volumes) <= smallest)
    elif body.kinematic:
        flat = np.zeros(0, dtype=np.int64)  # those without area were left out; those of a cache may have one later
    else:
        flat = np.flatnonzero(meshes.flat_triangles(assembly.rest_positions, elements))
    if len(flat):
        measure = "volume" if body.kind == "solid" else "area"
        example = f"{kind}[{flat[0]}] = {(elements[flat[0]] - first).tolist()}"
        found = f"{len(flat)} of {len(elements)} {kind} have no {measure}, first {example}"
        yield Finding(label, found, "remove them or move their vertices apart")
    _, counts = np.unique(np.sort(elements, axis=1), axis=0, return_counts=True)
    if counts.max() > 1:
        found = f"{np.count_nonzero(counts > 1)} {kind} are there more than once"
        yield Finding(label, found, "each must be there once")
    if body.kinematic:  # only what bends needs to be a manifold
        return
    sides = np.sort(body.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(sides, axis=0, return_counts=True)
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        edge = (edges[crowded[0]] - first).tolist()
        found = f"{len(crowded)} edges of its surface belong to more than two triangles, first {edge}"
        yield Finding(label, found, "the surface must be a manifold: split it there")
    vertices, fans = _fans(body.triangles)
    joints = np.flatnonzero(fans > 1)
    if len(joints):
        listed = [
            f"vertex {vertices[k] - first} at {_at(assembly.positions[vertices[k]])} m joins {fans[k]}" for k in joints[:LISTED]
        ]
        if len(joints) > LISTED:
            listed.append("...")
        found = f"{len(joints)} vertices of its surface join fans of triangles that share no edge there: {', '.join(listed)}"
        yield Finding(
            label, found, "the surface must be a manifold: give each fan a vertex of its own, with a gap between them"
        )
    unused = np.setdiff1d(np.arange(first, first + body.count), elements)
    if len(unused):
        found = f"{len(unused)} vertices belong to no {kind[:-1]}, first vertex {unused[0] - first}"
        yield Finding(label, found, "remove them")


def _segments(assembly: Assembly, body: AssembledBody) -> Iterator[Finding]:
    """Of a rod; what lines there may be is refused where they are read."""
    length = rods.lengths(assembly.rest_positions, body.segments)
    short = np.flatnonzero(length <= meshes.FLAT * length.max())
    if len(short):
        example = f"vertices {(body.segments[short[0]] - body.first).tolist()}"
        yield Finding(_label(body), f"{len(short)} of {len(length)} segments have no length, first {example}", "remove them")
    unused = np.setdiff1d(np.arange(body.first, body.first + body.count), body.segments)
    if len(unused):
        found = f"{len(unused)} vertices belong to no line, first vertex {unused[0] - body.first}"
        yield Finding(_label(body), found, "remove them")


def _fans(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of triangles (m, 3), and how many fans meet in each: triangles around it that are connected by edges."""
    corners = np.arange(triangles.size).reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    sides = triangles.reshape(-1)[corners]
    _, edge = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    # corners of triangles are connected to the ends of edges, and so to the corners at the same vertex across an edge
    ends = triangles.size + 2 * edge.reshape(-1, 1) + np.argsort(sides, axis=1)
    size = 3 * triangles.size
    graph = scipy.sparse.coo_matrix((np.ones(corners.size), (corners.ravel(), ends.ravel())), shape=(size, size))
    _, fan = connected_components(graph, directed=False)
    _, first = np.unique(fan[: triangles.size], return_index=True)
    return np.unique(triangles.reshape(-1)[first], return_counts=True)


def _selections(assembly: Assembly) -> Iterator[Finding]:
    exact = []
    for pin in assembly.pins:
        if len(pin.vertices) == 0:
            yield _nothing(assembly, pin.where, pin.body)
        elif pin.stiffness is None:
            meanwhile = [other.vertices for other in exact if pin.start < other.end and other.start < pin.end]
            twice = np.intersect1d(pin.vertices, np.concatenate([pin.vertices[:0], *meanwhile]))
            if len(twice):
                found = f"{len(twice)} vertices are held exactly by more than one pin"
                if any(each.start > 0.0 or each.end < np.inf for each in (pin, *exact)):
                    found += " at a time"
                yield Finding(pin.where, found, "give them one pin, or all but one a stiffness")
            exact.append(pin)
    for attachment in assembly.attachments:
        if len(attachment.vertices_a) == 0:
            yield Finding(attachment.where, "attaches no vertex", 'raise "within", or give pairs')
        elif np.any(attachment.vertices_a == attachment.vertices_b):
            yield Finding(attachment.where, "attaches a vertex to itself", "give two different vertices")
    for force in assembly.forces:
        if len(force.vertices) == 0:
            yield _nothing(assembly, force.where, force.body)


def _nothing(assembly: Assembly, where: str, name: str) -> Finding:
    (body,) = (body for body in assembly.bodies if body.name == name)
    points = assembly.positions[body.first : body.last]
    right = f"{_label(body)} reaches from {_at(points.min(axis=0))} to {_at(points.max(axis=0))} m at the start"
    return Finding(where, "selects no vertex", right)


def _motions(assembly: Assembly) -> Iterator[Finding]:
    scripts = [(_label(body), slice(body.first, body.last), body.trajectory) for body in assembly.bodies if body.trajectory]
    for label, vertices, trajectory in scripts + [(pin.where, pin.vertices, pin.trajectory) for pin in assembly.pins]:
        start = assembly.positions[vertices]
        times = trajectory.times
        with np.errstate(over="ignore", invalid="ignore"):
            farthest = max(np.abs(trajectory.apply(start, time)).max(initial=0.0) for time in times)
        if not farthest <= LARGEST:
            yield Finding(label, f"its motion leads {farthest:.3g} m away", f"it must stay within {LARGEST:g} m")
            continue
        jump = np.linalg.norm(trajectory.apply(start, 0.0) - start, axis=1).max(initial=0.0)
        if jump > 1e-9 * assembly.scene_size:
            found = f"its motion begins {jump:.4g} m away from where it stands"
            yield Finding(
                label, found, "poses are relative to the start: place it there and let the first keyframe not move it"
            )


def _turns(scene: Scene, assembly: Assembly) -> Iterator[Finding]:
    """What turns so fast, or so often, that its way cannot be followed."""
    h = scene.simulation.time_step / scene.simulation.substeps
    for mover in movers_of(assembly):
        chords = most_chords(mover, h)
        if not chords <= MOST and np.isfinite(chords):  # what overflows is out of all bounds, which is said of motions
            assert isinstance(mover.trajectory, Trajectory)
            angle = h * mover.trajectory.fastest()
            found = (
                f"turns by up to {angle:.3g} rad in a step of {h:g} s; that no straight piece is further than {mover.deviation:.3g} m from the "
                f"arc takes {chords:.4g} of them"
            )
            right = f"they must be at most {MOST}: take a shorter time_step or more substeps"
            yield Finding(mover.label, found, right + (", or a larger minimum separation" if mover.body >= 0 else ""))
        if (corners := most_corners(mover, h)) > MOST:
            found = f"has {corners} keyframes or frames within a step of {h:g} s, each of which is followed"
            yield Finding(
                mover.label, found, f"they must be at most {MOST}: leave some out, or take a shorter time_step or more substeps"
            )


def _activation(assembly: Assembly, precision: str) -> Iterator[Finding]:
    least, given = smallest_activation(assembly, precision), assembly.activation_distance
    if given < least:
        found = f"{given:.3g} m is so short a range that rounding decides how strongly surfaces push each other apart"
        right = (
            f"it must be at least {least:.3g} m: {ACTIVATION_PART:g} of the largest body's size of {assembly.body_sizes[1]:.4g} m, and "
            f"{ACTIVATION_ULPS} roundings of {precision} coordinates up to {np.abs(assembly.positions).max():.4g} m"
        )
        yield Finding("contact.activation_distance", found, right)


def _separation(assembly: Assembly, precision: str) -> Iterator[Finding]:
    least = smallest_separation(assembly, precision)
    small = [body for body in assembly.bodies if 2 * body.half_separation < least]
    if small:
        reach = np.abs(assembly.positions).max()
        gap = 2 * small[0].half_separation
        found = f"minimum separation {gap:.3g} m is lost in the rounding of {precision} coordinates up to {reach:.4g} m"
        right = f"it must be at least {least:.3g} m: raise minimum_separation or activation_distance, or move the scene to the origin"
        if precision == "float32":
            right += ", or use float64"
        yield Finding(", ".join(map(_label, small[:5])), found, right)


def _intersections(assembly: Assembly, precision: str) -> tuple[set[tuple[int, int]], list[Finding]]:
    """Pairs of bodies that intersect, i <= j, and what there is to say."""
    triangles = assembly.triangles
    pairs = find_intersections(assembly.positions, triangles, assembly.obstacle)
    owners = np.sort(assembly.body_of_vertex[triangles[pairs][:, :, 0]], axis=1)
    findings, touching = [], set(assembly.quarantine)
    tried = assembly.separated is not None
    for i, j in np.unique(owners, axis=0):
        if (int(i), int(j)) in assembly.quarantine:
            continue
        own = pairs[np.all(owners == (i, j), axis=1)]
        corners = assembly.positions[triangles[own[0]]]
        where = _label(assembly.bodies[i]) + (f" and {_label(assembly.bodies[j])}" if i != j else "")
        what = "segments and triangles" if "rod" in (assembly.bodies[i].kind, assembly.bodies[j].kind) else "triangles"
        found = f"{len(own)} pairs of {what} intersect at the start, one near {_at(_shared_point(corners))} m, in {precision} coordinates"
        numbers = ", ".join(f"{a} and {b}" for a, b in _within_bodies(assembly, own[:LISTED]))
        found += f" ({what} {numbers}{', ...' if len(own) > LISTED else ''})"
        right = "move them apart" if i != j else "the surface must not pass through itself"
        right += "; raising contact.start_limit may help" if tried else ', or take contact.start = "separate"'
        if i != j:
            right += "; contact.quarantine lets them ignore each other until they part"
        findings.append(Finding(where, found, right))
        touching.add((int(i), int(j)))
    return touching, findings


def _shared_point(corners: np.ndarray) -> np.ndarray:
    """(3,) about where two triangles (2, 3, 3) meet: the middle of what their boxes share."""
    low, high = corners.min(axis=1).max(axis=0), corners.max(axis=1).min(axis=0)
    return 0.5 * (low + high)


def _within_bodies(assembly: Assembly, triangles: np.ndarray) -> np.ndarray:
    """Numbers (k, 2) of triangles, counted within the body of each."""
    firsts = np.cumsum([0] + [len(body.triangles) for body in assembly.bodies])
    return triangles - firsts[assembly.body_of_vertex[assembly.triangles[triangles][:, :, 0]]]


def too_close(assembly: Assembly, touching: set[tuple[int, int]], precision: str) -> Iterator[Finding]:
    """Pairs of bodies, or parts of one body, that come as near as their minimum separation; touching: pairs of bodies to leave out."""
    found = [_near_others(assembly), _near_itself(assembly, precision)]
    distances, limits, pairs, places = (np.concatenate(parts) for parts in zip(*found, strict=True))
    for i, j in np.unique(pairs, axis=0):
        if (int(i), int(j)) in touching:
            continue
        own = np.flatnonzero(np.all(pairs == (i, j), axis=1))
        nearest = own[np.argmin(distances[own])]
        example = f"the nearest {distances[nearest]:.3g} m apart near {_at(places[nearest])} m"
        found = f"{len(own)} pairs of vertices, edges or triangles start too close, {example}"
        if i != j:
            right = f"their gap must be more than the minimum separation of {limits[nearest]:.3g} m"
        else:
            right = f"their gap must be more than {limits[nearest]:.3g} m: the minimum separation, or less where they are near at rest"
        names = dict.fromkeys(_label(assembly.bodies[k]) for k in (i, j))
        yield Finding(" and ".join(names), found, right)


Near = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # distances, limits (k,) m, bodies (k, 2), places (k, 3) m


def _near_others(assembly: Assembly) -> Near:
    """Pairs of primitives of two bodies that are no further apart than their minimum separation."""
    x, owner = assembly.positions, assembly.body_of_vertex
    reach = np.array([body.half_separation for body in assembly.bodies])
    kinematic = np.array([body.kinematic for body in assembly.bodies])
    low = np.array([x[body.first : body.last].min(axis=0) for body in assembly.bodies]) - reach[:, None]
    high = np.array([x[body.first : body.last].max(axis=0) for body in assembly.bodies]) + reach[:, None]

    def near(primitives: np.ndarray) -> np.ndarray:
        """The primitives whose boxes reach into another body's box."""
        corners, margin = x[primitives], reach[owner[primitives[:, 0]]][:, None]
        met = boxes.overlapping(corners.min(axis=1) - margin, corners.max(axis=1) + margin, low, high)
        return primitives[np.unique(met[owner[primitives[met[:, 0], 0]] != met[:, 1], 0])]

    def apart(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return (owner[i] != owner[j]) & ~(kinematic[owner[i]] & kinematic[owner[j]])

    def limit(a: np.ndarray, b: np.ndarray, _) -> np.ndarray:
        return reach[owner[a]] + reach[owner[b]]

    primitives = [near(kind) for kind in _primitives(assembly.triangles)]
    return _nearer(assembly, primitives, reach[owner], apart, limit)


def _near_itself(assembly: Assembly, precision: str) -> Near:
    """Pairs of primitives of one body that are no further apart than their minimum separation.

    It is smaller for a pair that is close in the rest shape, by the rule of `pdipc.collision.candidates.limits`. What is closer than
    rounding, or than a small part of the activation distance, could not move at all, and is found as well.
    """
    x, owner = assembly.positions, assembly.body_of_vertex
    least = max(CLOSEST_PART * assembly.activation_distance, CLOSEST_ULPS * _rounding(assembly, precision))
    reach, rod = np.zeros(len(x)), np.array([body.kind == "rod" for body in assembly.bodies])
    for body in assembly.bodies:
        own = slice(body.first, body.last)
        at_rest = np.array_equal(x[own], assembly.rest_positions[own].astype(precision).astype(np.float64))
        reach[own] = 0.5 * least if at_rest else max(body.half_separation, 0.5 * least)

    def limit(a: np.ndarray, b: np.ndarray, at_rest: np.ndarray) -> np.ndarray:
        part = np.where(rod[owner[a]], ROD_SEPARATION, REST_SEPARATION)
        return np.maximum(np.minimum(reach[a] + reach[b], part * at_rest), least)

    surface = np.concatenate([body.triangles for body in assembly.bodies if not body.kinematic])
    return _nearer(assembly, _primitives(surface), reach, lambda a, b: owner[a] == owner[b], limit)


def _primitives(triangles: np.ndarray) -> list[np.ndarray]:
    """Vertices (s, 1), edges (k, 2) and triangles (m, 3)."""
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    edges = edges[edges[:, 0] < edges[:, 1]]  # a segment of a rod (a, b, b) has one
    return [np.unique(triangles)[:, None], edges, triangles]


def _nearer(assembly: Assembly, primitives: list[np.ndarray], reach: np.ndarray, wanted: Callable, limit: Callable) -> Near:
    """Pairs of a vertex and a triangle, and of two edges, that share no vertex and are no further apart than their limit.

    reach: (n,) m, at least half of any limit at a vertex. wanted(i, j): whether vertices i (k,) and j (k,) are a pair's.
    limit(i, j, d): m, from vertices of a pair and its distance at rest.
    """
    x, rest = assembly.positions, assembly.rest_positions
    points, edges, triangles = primitives
    found: list[Near] = []
    for first, second, distance in ((points, triangles, _vertex_triangle), (edges, edges, edge_edge_distances)):
        bounds = [(x[kind] - reach[kind][..., None], x[kind] + reach[kind][..., None]) for kind in (first, second)]
        (low_a, high_a), (low_b, high_b) = ((low.min(axis=1), high.max(axis=1)) for low, high in bounds)
        for begin in range(0, len(first), CHUNK):
            part = slice(begin, begin + CHUNK)
            a, b = boxes.overlapping(low_a[part], high_a[part], low_b, high_b).T
            a += begin
            if first is second:
                a, b = a[a < b], b[a < b]
            kept = wanted(first[a, 0], second[b, 0]) & np.all(first[a][:, :, None] != second[b][:, None], axis=(1, 2))
            i, j = first[a[kept]], second[b[kept]]
            distances = distance(x[i], x[j])
            limits = limit(i[:, 0], j[:, 0], distance(rest[i], rest[j]))
            close = distances <= limits
            i, j = i[close], j[close]
            owners = np.sort(assembly.body_of_vertex[np.column_stack([i[:, 0], j[:, 0]])], axis=1)
            found.append((distances[close], limits[close], owners, _place(x[i], x[j]) if first is second else x[i][:, 0]))
    nothing = (np.zeros(0), np.zeros(0), np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)))
    distances, limits, owners, places = (np.concatenate(column) for column in zip(nothing, *found, strict=True))
    return distances, limits, owners, places


def _place(e: np.ndarray, f: np.ndarray) -> np.ndarray:
    """(n, 3) points of segments e that are nearest to segments f, both (n, 2, 3): ends, feet of the ends of f, or the crossing."""
    u, v, w = e[:, 1] - e[:, 0], f[:, 1] - f[:, 0], e[:, 0] - f[:, 0]
    uu, uv, vv, uw, vw = (np.einsum("ij,ij->i", a, b) for a, b in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    square = uu * vv - uv * uv
    crossing = (uv * vw - vv * uw) / np.where(square > 0, square, 1.0)
    feet = [np.einsum("ij,ij->i", f[:, k] - e[:, 0], u) / np.where(uu > 0, uu, 1.0) for k in (0, 1)]
    parts = np.clip(np.column_stack([np.zeros(len(e)), np.ones(len(e)), *feet, crossing]), 0.0, 1.0)
    points = e[:, :1] + parts[..., None] * u[:, None]
    distances = [point_segment_distances(points[:, k], f[:, 0], f[:, 1]) for k in range(parts.shape[1])]
    return points[np.arange(len(e)), np.argmin(distances, axis=0)] if len(e) else np.zeros((0, 3))


def _vertex_triangle(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return vertex_triangle_distances(points[:, 0], triangles)


def _inside(assembly: Assembly, touching: set[tuple[int, int]]) -> Iterator[Finding]:
    """Bodies that start inside another; a closed obstacle that faces inward (of negative volume) is a container."""
    x = assembly.positions
    parts = [_components(body) for body in assembly.bodies]
    for i, outer in enumerate(assembly.bodies):
        corners = x[outer.triangles]
        if (
            not meshes.is_closed(outer.triangles)
            or np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) <= 0
        ):
            continue
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        for j, inner in enumerate(assembly.bodies):
            if i == j or (min(i, j), max(i, j)) in touching or (outer.kinematic and inner.kinematic):
                continue
            for vertex in parts[j]:
                if np.all(low < x[vertex]) and np.all(x[vertex] < high) and winding_number(x[vertex], corners) > 0.5:
                    found = f"starts inside {_label(outer)}, at {_at(x[vertex])} m"
                    right = (
                        "; an obstacle that is to hold bodies must be open, or face inward (inward = true)"
                        if outer.kinematic
                        else ""
                    )
                    yield Finding(_label(inner), found, "move it out" + right)
                    break


def _components(body: AssembledBody) -> np.ndarray:
    """One vertex of each connected part of a body's surface."""
    count = body.last - body.first
    edges = (body.triangles[:, [[0, 1], [1, 2]]].reshape(-1, 2) - body.first).T
    graph = scipy.sparse.coo_matrix((np.ones(edges.shape[1]), edges), shape=(count, count))
    used = np.unique(body.triangles) - body.first
    _, label = connected_components(graph, directed=False)
    return used[np.unique(label[used], return_index=True)[1]] + body.first


def winding_number(point: np.ndarray, corners: np.ndarray) -> float:
    """How often the surface of triangles (m, 3, 3) goes around `point` (3,): 1 inside a closed outward one, 0 outside.

    Solid angles after van Oosterom and Strackee 1983.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a)))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    return float(np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi))


def point_segment_distances(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) distances of points p from segments a b, all (n, 3), m."""
    d = b - a
    length = np.einsum("ij,ij->i", d, d)
    s = np.clip(np.einsum("ij,ij->i", p - a, d) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    return np.linalg.norm(p - a - s[:, None] * d, axis=1)


def vertex_triangle_distances(p: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) distances of points p (n, 3) from triangles (n, 3, 3), m."""
    corners = [triangles[:, k] for k in range(3)]
    distance = np.min([point_segment_distances(p, corners[k], corners[k - 2]) for k in range(3)], axis=0)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    inside = np.ones(len(p), dtype=bool)
    for k in range(3):
        a, b = corners[k], corners[k - 2]
        inside &= np.einsum("ij,ij->i", np.cross(b - a, p - a), normal) > 0
    length = np.linalg.norm(normal, axis=1)
    above = np.abs(np.einsum("ij,ij->i", p - corners[0], normal)) / np.where(length > 0, length, 1.0)
    return np.where(inside, above, distance)


def edge_edge_distances(e: np.ndarray, f: np.ndarray) -> np.ndarray:
    """(n,) distances of segments e and f, both (n, 2, 3), m."""
    distance = np.min(
        [point_segment_distances(e[:, k], f[:, 0], f[:, 1]) for k in (0, 1)]
        + [point_segment_distances(f[:, k], e[:, 0], e[:, 1]) for k in (0, 1)],
        axis=0,
    )
    u, v, w = e[:, 1] - e[:, 0], f[:, 1] - f[:, 0], e[:, 0] - f[:, 0]
    uu, uv, vv, uw, vw = (np.einsum("ij,ij->i", a, b) for a, b in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    normal = np.cross(u, v)
    square = np.einsum("ij,ij->i", normal, normal)
    skew = square > 1e-24 * uu * vv
    square = np.where(skew, square, 1.0)
    s, t = (uv * vw - vv * uw) / square, (uu * vw - uv * uw) / square
    across = np.abs(np.einsum("ij,ij->i", w, normal)) / np.sqrt(square)
    inside = skew & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    return np.where(inside, np.minimum(across, distance), distance)
