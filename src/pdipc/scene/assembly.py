"""A scene as arrays: one numbering of all vertices, simulated and kinematic, and what is known about them."""

import itertools
import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from pdipc.scene import generators, meshes, pattern, rigid, rods, seams, sewing
from pdipc.scene.errors import SceneError, SceneWarning
from pdipc.scene.frames import Frames, read_frames, timed
from pdipc.scene.garments import Inside
from pdipc.scene.memory import free_memory, gib
from pdipc.scene.meshes import Mesh
from pdipc.scene.motion import Deforming, Glue, Trajectory, rotation_matrix
from pdipc.scene.schema import (
    Arrays,
    Attachment,
    Body,
    Cloth,
    ClothMaterial,
    Deformation,
    Obstacle,
    Pin,
    Placed,
    Rigid,
    RigidMaterial,
    Rod,
    RodMaterial,
    Scene,
    Selection,
    Solid,
    SolidMaterial,
    Stitch,
    VertexForce,
    Wind,
)
from pdipc.scene.worker import Worker

ACTIVATION_PART = 1e-3  # default activation distance, of the scene size
BYTES_PER_VERTEX, BYTES_PER_BODY = 230, 4000  # of memory to put a scene together, measured
SEPARATION_PART = 0.02  # default minimum separation, of the activation distance


@dataclass
class AssembledBody:
    """One body or obstacle; its vertices are first, ..., last - 1 of the whole.

    tets: (t, 4) int32 and triangles: (m, 3) int32, indices into all vertices; a solid's triangles are its boundary, outward; a rod's
    are its segments (a, b, b). joints: (j, 2) int32, segments of a rod that follow each other. ghosts: (s,) int32, the points that mark
    how its segments are twisted, the last of its vertices; none where it twists freely. handles: (4,) int32, the points that a rigid body
    moves as, the last of its vertices, weights (k, 4) of these for the others, and its volume, m^3.
    material: None for an obstacle. half_separation: its part of a pair's minimum separation, m. friction: coefficient.
    trajectory: how an obstacle moves; None for bodies. inside: what a closed cloth holds. pattern: (m, 3, 3) m, the corners of each
    triangle of a cloth that is cut from flat panels, as they are there.
    origin (3,) m and orientation (3, 3): where its mesh's origin and axes are at the start.
    """

    name: str
    kind: Literal["solid", "cloth", "rod", "rigid", "obstacle"]
    first: int
    last: int
    tets: np.ndarray
    triangles: np.ndarray
    material: SolidMaterial | ClothMaterial | RodMaterial | RigidMaterial | None
    half_separation: float
    friction: float
    trajectory: Trajectory | Deforming | None = None
    inside: Inside | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    orientation: np.ndarray = field(default_factory=lambda: np.eye(3))
    joints: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int32))
    ghosts: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    handles: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    volume: float = 0.0
    pattern: np.ndarray | None = None

    @property
    def elastic_shape(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Points (3 m, 3) m and triangles (m, 3) of a cloth's own rest shape; None where that is its mesh's."""
        if self.pattern is None:
            return None
        return self.pattern.reshape(-1, 3), np.arange(3 * len(self.pattern), dtype=np.int32).reshape(-1, 3)

    @property
    def kinematic(self) -> bool:
        """Whether all its vertices follow a script."""
        return self.kind == "obstacle"

    @property
    def count(self) -> int:
        """Vertices of its mesh: those that a scene can name."""
        return self.last - self.first - len(self.ghosts) - len(self.handles)

    @property
    def segments(self) -> np.ndarray:
        """(s, 2) int32: of a rod."""
        return self.triangles[:, :2] if self.kind == "rod" else self.triangles[:0, :2]


@dataclass
class AssembledPin:
    """Held vertices (k,) int32, by points (k, 3) m, where the trajectory has not moved them. stiffness: N/m a vertex, or None: held exactly.

    where: the pin and its selection, for messages. axes: (3,) bool, along which it holds. start, end: s, end may be inf; active: whether
    it holds now. follow: the number of the body whose surface it moves with, -1 for none; held exactly, its points are those at the
    obstacle's start, and glue says how they move with one that deforms. elements: (k, 4) int32, weights: (k, 3), of springs to a surface.
    """

    where: str
    body: str
    vertices: np.ndarray
    points: np.ndarray
    trajectory: Trajectory
    stiffness: float | None
    axes: np.ndarray = field(default_factory=lambda: np.ones(3, dtype=bool))
    start: float = 0.0
    end: float = np.inf
    active: bool = True
    follow: int = -1
    glue: Glue | None = None
    elements: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), dtype=np.int32))
    weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def label(self) -> str:
        """The pin without its selection, such as body "sheet", pins[0]."""
        return self.where.rpartition(".select = ")[0]

    @property
    def exact(self) -> bool:
        """Whether it holds vertices exactly, now."""
        return self.active and self.stiffness is None and len(self.vertices) > 0

    @property
    def anchored(self) -> bool:
        """Whether it holds vertices by springs to points, now."""
        return self.active and self.stiffness is not None and self.follow < 0 and len(self.vertices) > 0


@dataclass
class AssembledAttachment:
    """Springs between vertices_a (k,) and vertices_b (k,) int32 of stiffness N/m and rest_lengths (k,) m; where, for messages."""

    where: str
    vertices_a: np.ndarray
    vertices_b: np.ndarray
    stiffness: float
    rest_lengths: np.ndarray


@dataclass
class AssembledStitch:
    """Threads from the vertices elements[:, 0] to points of the triangles elements[:, 1:], (k, 4) int32, of weights (k, 3).

    stiffness: N/m. distances: (k,) m at the start. length: m, what they shrink to from `start` s on within `duration` s. where: for messages.
    """

    where: str
    elements: np.ndarray
    weights: np.ndarray
    stiffness: float
    distances: np.ndarray
    length: float
    start: float
    duration: float

    def lengths(self, time: float) -> np.ndarray:
        """(k,) m at `time` s; inf before the start."""
        if time < self.start:
            return np.full(len(self.elements), np.inf)
        part = 1.0 if self.duration == 0.0 else min(1.0, (time - self.start) / self.duration)
        return self.length + (1.0 - part) * np.maximum(0.0, self.distances - self.length)


@dataclass
class AssembledWind:
    """Wind on triangles (m, 3) int32, from start to end, s (end may be inf); see `schema.Wind` for its force."""

    triangles: np.ndarray
    velocity: np.ndarray
    air_density: float
    drag: float
    start: float
    end: float


@dataclass
class AssembledForce:
    """The force (3,) N on each of vertices (k,) int32, from start to end, s (end may be inf); where, for messages."""

    where: str
    body: str
    vertices: np.ndarray
    force: np.ndarray
    start: float
    end: float


@dataclass
class Assembly:
    """A scene as arrays of float64 and int32, in SI units. Bodies come first, obstacles after them.

    positions: (n, 3) at the start, m. rest_positions: (n, 3) at rest, placed where the body starts, m.
    velocities: (n, 3) at the start, m/s; zero for what is kinematic. body_of_vertex: (n,) int32, index into `bodies`.
    scene_size: L, the diagonal of the bounding box of all deformable bodies at the start, m.
    body_sizes: diagonals of the smallest and the largest deformable body's own bounding box at the start, m. What a scene leaves open
    follows from these, not from L: a distant partner changes nothing.
    activation_distance: d_hat, m; 1e-3 of the largest body unless the scene says otherwise.
    minimum_separation: xi of a pair whose bodies do not say otherwise, m; 0.02 d_hat unless the scene says otherwise.
    notes: what was left out of files, or converted, a line each.
    separated: where the start was separated, how far the farthest vertex of each body that was moved went, m, by name; see `pdipc.scene.separate`.
    masses: (n,) kg, where vertices have masses of their own in place of those that densities give.
    quarantine: pairs of bodies, by their numbers, that ignore each other until they have parted; see `pdipc.scene.quarantine`.
    """

    positions: np.ndarray
    rest_positions: np.ndarray
    velocities: np.ndarray
    bodies: list[AssembledBody]
    body_of_vertex: np.ndarray
    scene_size: float
    body_sizes: tuple[float, float]
    activation_distance: float
    minimum_separation: float
    pins: list[AssembledPin] = field(default_factory=list)
    attachments: list[AssembledAttachment] = field(default_factory=list)
    stitches: list[AssembledStitch] = field(default_factory=list)
    winds: list[AssembledWind] = field(default_factory=list)
    forces: list[AssembledForce] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    separated: dict[str, float] | None = None
    masses: np.ndarray | None = None
    quarantine: list[tuple[int, int]] = field(default_factory=list)

    @property
    def triangles(self) -> np.ndarray:
        """(m, 3) int32: the surfaces of all bodies and obstacles."""
        return np.concatenate([body.triangles for body in self.bodies])

    @property
    def tets(self) -> np.ndarray:
        """(t, 4) int32: those of all solids."""
        return np.concatenate([body.tets for body in self.bodies])

    @property
    def scripted(self) -> np.ndarray:
        """(n,) bool: vertices of obstacles and those that pins hold exactly."""
        mask = np.zeros(len(self.positions), dtype=bool)
        for body in self.bodies:
            mask[body.first : body.last] = body.kinematic
        for pin in self.pins:
            if pin.exact:
                mask[pin.vertices] = True
        return mask

    @property
    def obstacle(self) -> np.ndarray:
        """(n,) bool: vertices of obstacles, which may pass through each other."""
        return np.array([body.kinematic for body in self.bodies])[self.body_of_vertex]

    @property
    def keeps_shape(self) -> np.ndarray:
        """(bodies,) bool: rigid bodies, and obstacles that no cache deforms."""
        return np.array([b.kind == "rigid" or (b.trajectory is not None and b.trajectory.is_rigid) for b in self.bodies])

    @property
    def kinematic_vertices(self) -> np.ndarray:
        """(k,) int32, ascending: the numbers of the scripted vertices."""
        return np.flatnonzero(self.scripted).astype(np.int32)

    def kinematic_positions(self, time: float) -> np.ndarray:
        """(k, 3) m: where `kinematic_vertices` are at `time` s."""
        positions = self.positions.copy()
        for body in self.bodies:
            if body.trajectory is not None:
                own = slice(body.first, body.last)
                positions[own] = body.trajectory.apply(self.positions[own], time)
        for pin in self.pins:
            if pin.exact:
                positions[pin.vertices] = self.pin_targets(pin, time)
        return positions[self.kinematic_vertices]

    def topology(self) -> dict[str, np.ndarray]:
        """What a result needs to be read without the scene, by name: tets (t, 4), body_of_vertex (n,), scripted (n,) bool,
        body_names and body_kinds as text, body_radii (bodies,) m, 0 for all but rods.
        """
        return {
            "tets": self.tets,
            "body_of_vertex": self.body_of_vertex,
            "scripted": self.scripted,
            "body_names": np.array([body.name for body in self.bodies]),
            "body_kinds": np.array([body.kind for body in self.bodies]),
            "body_radii": np.array([getattr(body.material, "radius", 0.0) for body in self.bodies]),
        }

    def pin_targets(self, pin: AssembledPin, time: float) -> np.ndarray:
        """(k, 3) m: where the points that hold a pin's vertices are at `time` s."""
        path = pin.trajectory if pin.follow < 0 else self.bodies[pin.follow].trajectory
        assert path is not None
        if isinstance(path, Deforming) and pin.glue is not None:
            return pin.glue.apply(path.apply(None, time))
        return path.apply(pin.points, time)

    def glued(self, pin: AssembledPin, x: np.ndarray) -> Glue:
        """How a pin's vertices move with the surface that it follows, from where both are at positions x (n, 3) m."""
        body = self.bodies[pin.follow]
        elements, weights = _onto(x, self.bodies[self.body_of_vertex[pin.vertices[0]]], body, pin.vertices)
        return Glue.at(x[pin.vertices], x[body.first : body.last], elements[:, 1:] - body.first, weights)


def load_mesh(placed: Placed, worker: Worker | None = None) -> tuple[Mesh, np.ndarray]:
    """The mesh of a body or obstacle in its own coordinates, and its vertices at the start (n, 3), not yet placed.

    worker: reads files that other packages parse; None starts one where it is needed.
    Raises SceneError where it cannot be read, is of the wrong kind, or needs more memory than there is.
    """
    where = f'{"obstacle" if isinstance(placed, Obstacle) else "body"} "{placed.name}"'
    source, start = placed.mesh, None
    try:
        if isinstance(source, str):
            mesh = meshes.read_lines(source, worker) if isinstance(placed, Rod) else meshes.read(source, worker)
        elif isinstance(source, Arrays):
            if isinstance(placed, Rod):
                lines = np.zeros((0, 2)) if source.lines is None else source.lines
                mesh = meshes.lines_from_arrays(source.vertices, lines, "mesh", drop_unused=False)
            else:
                mesh = meshes.from_arrays(source.vertices, source.tets, source.triangles, "mesh", drop_unused=False)
            start = source.start
        else:
            if isinstance(placed, Rod) != isinstance(source, generators.LINES):
                right = ", ".join(f'"{shape.model_fields["shape"].default}"' for shape in generators.LINES)
                raise SceneError(f'{where}: the shape "{source.shape}" does not fit; shapes of lines are for rods: {right}')
            _need(source.bytes(), where, f"{source.cell_count()} cells", "fewer cells")
            mesh = source.mesh()
    except SceneError as error:
        said = str(error)
        raise SceneError(said if said.startswith(where) else f"{where}: {said}") from error
    if isinstance(placed, Rod):
        mesh.lines, mesh.joints = rods.in_order(mesh.lines, where)
        mesh.triangles = mesh.lines[:, [0, 1, 1]]
        for points in (mesh.vertices, mesh.vertices if start is None else start):
            short = np.flatnonzero(rods.lengths(points, mesh.lines) == 0.0)
            if len(short):
                raise SceneError(f"{where}: the line {mesh.lines[short[0]].tolist()} has no length; its ends must be apart")
    elif not isinstance(placed, Solid):
        if len(mesh.tets):
            mesh, start = mesh.surface(), None if start is None else start[np.unique(mesh.triangles)]
    elif not len(mesh.tets):
        if not placed.tetrahedralize:
            raise SceneError(
                f"{where}: a solid needs tetrahedra, its mesh has triangles only; give a tetrahedral mesh, or set "
                "tetrahedralize = true"
            )
        mesh = meshes.tetrahedralize(mesh, where)
    if isinstance(placed, Obstacle):
        mesh = meshes.without_useless(mesh, where)
    if isinstance(placed, Rigid):
        _solid_inside(mesh, start, where)
    return mesh, mesh.vertices if start is None else start


def _solid_inside(mesh: Mesh, start: np.ndarray | None, where: str) -> None:
    """Raises SceneError where the surface of a rigid body has no inside, or starts in another shape."""
    if start is not None and not np.array_equal(start, mesh.vertices):
        raise SceneError(f"{where}: a rigid body keeps its shape; leave out start, and place it")
    if not meshes.is_closed(mesh.triangles):
        sides = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        rim = int(np.count_nonzero(np.unique(sides, axis=0, return_counts=True)[1] == 1))
        found = f"{rim} edges of its surface belong to one triangle only" if rim else "its triangles face both ways"
        raise SceneError(f"{where}: {found}; the surface of a rigid body must be closed, and face outward")
    if not np.isfinite(mesh.vertices).all():
        return  # the check says so
    volume = rigid.inertia(mesh.vertices, mesh.triangles).volume
    size = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    if not volume > meshes.FLAT * size**3:
        raise SceneError(f"{where}: its surface holds {volume:.4g} m^3; it must face outward around an inside")


def load_deforming(placed: Obstacle, deformation: Deformation, worker: Worker | None = None) -> tuple[Mesh, Frames]:
    """The mesh of an obstacle with a cache, with all vertices of its file, and the cache, not yet placed.

    Raises SceneError where they cannot be read or do not go together.
    """
    where = f'obstacle "{placed.name}"'
    source, cache = placed.mesh, deformation.cache
    try:
        if isinstance(cache, str):
            frames, contents = read_frames(cache, deformation.frame_rate, worker)
        else:
            frames, contents = timed(cache.vertices, np.array(cache.times), deformation.frame_rate, "cache"), None
        if isinstance(source, str):
            path = meshes.locate(source)
            if contents is None or source != cache:
                contents = meshes.contents(path, worker, frames=True)
            mesh = meshes.guarded(path, lambda: meshes.from_contents(contents, f'mesh file "{path}"', whole=True))
        elif isinstance(source, Arrays):
            mesh = meshes.from_arrays(source.vertices, source.tets, source.triangles, "mesh", drop_unused=False)
        else:
            _need(source.bytes(), where, f"{source.cell_count()} cells", "fewer cells")
            mesh = source.mesh()
        found, needed = frames.points.shape[1], len(mesh.vertices)
        if found != needed:
            raise SceneError(f"the cache has frames of {found} vertices; its mesh has {needed}, and each of them needs a place")
    except SceneError as error:
        said = str(error)
        raise SceneError(said if said.startswith(where) else f"{where}: {said}") from error
    first = Mesh(frames.points[0].astype(np.float64), mesh.triangles, notes=mesh.notes)
    return meshes.without_useless(first, where, frames.points[1:]), frames


AnyPlaced = Solid | Cloth | Rod | Rigid | Obstacle
Read = tuple[AnyPlaced, Mesh, np.ndarray, Frames | None]  # a table, its mesh, where its vertices start, and its cache


def _read_all(scene: Scene, problems: list[str], notes: list[str], unread: set[str]) -> list[Read]:
    """All bodies and obstacles that can be had; adds the others to `problems` and `unread`."""
    found = []
    with Worker() as worker:
        for placed in (*scene.bodies, *scene.obstacles):
            where = f'{"obstacle" if isinstance(placed, Obstacle) else "body"} "{placed.name}"'
            try:
                frames = None
                if isinstance(placed, Obstacle) and isinstance(placed.motion, Deformation):
                    mesh, frames = load_deforming(placed, placed.motion, worker)
                    start = mesh.vertices
                else:
                    mesh, start = load_mesh(placed, worker)
                if isinstance(placed, Obstacle) and placed.inward:
                    mesh.triangles = mesh.triangles[:, ::-1]
                count = math.prod(placed.copies.counts) if isinstance(placed, Body) and placed.copies else 1
                size = count * (BYTES_PER_BODY + BYTES_PER_VERTEX * len(start))
                what = f"{count} copies of {len(start)} vertices" if count > 1 else f"{len(start)} vertices"
                _need(size, where, what, "fewer copies" if count > 1 else "a coarser mesh")
            except SceneError as error:
                problems.append(str(error))
                unread.add(placed.name)
                continue
            notes += [f"{where}: {note}" for note in mesh.notes]
            found.append((placed, mesh, start, frames))
    return found


def _need(size: int, where: str, what: str, right: str) -> None:
    """Raises SceneError where `size` bytes are more than there are."""
    free = free_memory()
    if size > free:
        raise SceneError(f"{where}: {what} need at least {gib(size)} of memory, and {gib(free)} are free; take {right}")


def assemble(scene: Scene) -> Assembly:
    """Reads the meshes of `scene`, places them, and numbers everything.

    Raises SceneError with all meshes that cannot be read, and all names and indices that are unknown. What is wrong with the
    geometry is for `pdipc.scene.check` to find. Warns (SceneWarning) of what was left out of files.
    """
    assembly, problems = gather(scene)
    if assembly is None or problems:
        listed = [f"the scene cannot be put together, {len(problems)} things to put right:", *problems]
        raise SceneError(problems[0] if len(problems) == 1 else "\n  ".join(listed))
    for note in assembly.notes:
        warnings.warn(note, SceneWarning, stacklevel=2)
    return assembly


_Part = tuple[AssembledBody, AnyPlaced, Mesh, np.ndarray, np.ndarray]  # body, table, mesh, start, velocities


@np.errstate(over="ignore", invalid="ignore")  # what overflows is found by the check
def gather(
    scene: Scene, left_out: Iterable[str] = (), numbers: dict[str, list[int]] | None = None
) -> tuple[Assembly | None, list[str]]:
    """What `assemble` makes, of all that can be read and is known, and a line for each thing that is not.

    left_out: names of bodies that the file has and `scene` lacks. numbers: the places in the file of the scene's attachments and
    forces, where these are others; see `pdipc.scene.load.RightPart`.
    None where not a single body can be read. Raises TypeError for what is no `Scene`.
    """
    if not isinstance(scene, Scene):
        raise TypeError(
            f"a scene is a pdipc.Scene, not a {type(scene).__name__}: use pdipc.Scene(**tables) or pdipc.load_scene(path)"
        )
    problems: list[str] = []
    notes: list[str] = []
    unread = set(left_out)  # what refers to these is not judged
    parts = _parts(scene, problems, notes, unread)
    if all(body.kinematic for body, *_ in parts):
        return None, problems
    assembly = _laid_out(scene, parts, notes)
    numbers = numbers or {}
    for number, attachment in zip(numbers.get("attachments", itertools.count()), scene.attachments, strict=False):
        with _noting(problems):
            if _known(attachment.bodies, unread):
                _attach(assembly, attachment, f"attachments[{number}]")
    for number, table in zip(numbers.get("stitches", itertools.count()), scene.stitches, strict=False):
        with _noting(problems):
            if _known(table.bodies, unread):
                _stitch(assembly, table, f"stitches[{number}]")
    for number, pair in enumerate(scene.contact.quarantine):
        with _noting(problems):
            if _known(pair, unread):
                assembly.quarantine.append(_quarantined(assembly, pair, f"contact.quarantine[{number}]"))
    for body, placed, *_ in parts:
        for number, pin in enumerate(placed.pins if isinstance(placed, Body) else []):
            with _noting(problems):
                _pin(assembly, body, pin, f'body "{body.name}", pins[{number}]', unread)
    assembly.velocities[assembly.kinematic_vertices] = 0.0
    for number, force in zip(numbers.get("forces", itertools.count()), scene.forces, strict=False):
        with _noting(problems):
            if _known((force.bodies or []) if isinstance(force, Wind) else [force.body], unread):
                _force(assembly, force, f"forces[{number}]")
    return assembly, problems


def _parts(scene: Scene, problems: list[str], notes: list[str], unread: set[str]) -> list[_Part]:
    """The bodies and obstacles that can be read, copies one by one, with their vertices numbered through."""
    parts: list[_Part] = []
    first = 0
    for placed, mesh, start, frames in _read_all(scene, problems, notes, unread):
        matrix = rotation_matrix(placed.rotation) * np.broadcast_to(placed.scale, 3)
        rest, start = mesh.vertices @ matrix.T + placed.translation, start @ matrix.T + placed.translation
        deforming = None
        if frames is not None:
            assert isinstance(placed, Obstacle) and isinstance(placed.motion, Deformation)  # what else has none
            deforming = Deforming(frames, placed.motion.start, matrix, placed.translation)
            rest = start = deforming.apply(None, 0.0)
        center = meshes.center_of_mass(replace(mesh, vertices=start)) if isinstance(placed, Body) else np.zeros(3)
        ghosts = np.zeros(0, dtype=np.int32)
        if isinstance(placed, Rod) and placed.material.twist_stiffness:
            marks = rods.ghost_points(rest, start, mesh.lines, mesh.joints, placed.material.radius)
            ghosts = np.arange(len(rest), len(rest) + len(marks[0]), dtype=np.int32)
            rest, start = np.concatenate([rest, marks[0]]), np.concatenate([start, marks[1]])
        cut = None
        if isinstance(placed, Cloth) and placed.rest is not None:
            with _noting(problems):
                cut = pattern.corners_at_rest(placed, len(mesh.triangles))
        if isinstance(placed, Cloth) and (placed.weld or placed.open_seams):
            with _noting(problems):
                mesh, rest, start, cut = _seamed(placed, mesh, rest, start, cut, notes)
        solid = None
        if isinstance(placed, Rigid):
            solid = rigid.inertia(rest, mesh.triangles)
            center = solid.center
            rest = np.concatenate([rest, solid.handles()])
            start = rest
        count = len(rest)
        for name, offset in _copies(placed):
            body = AssembledBody(
                name,
                "obstacle" if isinstance(placed, Obstacle) else placed.kind,
                first,
                first + len(rest),
                mesh.tets + first,
                mesh.triangles + first,
                None if isinstance(placed, Obstacle) else placed.material,
                half_separation=0.0,
                friction=scene.contact.friction if placed.friction is None else placed.friction,
                trajectory=deforming,
                inside=placed.inside if isinstance(placed, Cloth) else None,
                origin=np.array(placed.translation) + offset,
                orientation=rotation_matrix(placed.rotation),
                joints=mesh.joints,
                ghosts=ghosts + first,
                pattern=cut,
                handles=np.arange(first + count - 4, first + count, dtype=np.int32) if solid else ghosts[:0],
                weights=solid.weights(rest[:-4]) if solid else np.zeros((0, 4)),
                volume=solid.volume if solid else 0.0,
            )
            velocities = np.zeros_like(rest)
            if isinstance(placed, Body):
                velocities = np.array(placed.velocity) + np.cross(placed.angular_velocity, start - center)
            parts.append((body, placed, Mesh(rest + offset, mesh.triangles, mesh.tets), start + offset, velocities))
            first = body.last
    return parts


def _laid_out(scene: Scene, parts: list[_Part], notes: list[str]) -> Assembly:
    """All parts together, with the distances that follow from their sizes; nothing is joined or held yet."""
    bodies = [part[0] for part in parts]
    positions = np.concatenate([part[3] for part in parts])
    deformable = positions[: max(body.last for body in bodies if not body.kinematic)]
    scene_size = float(np.linalg.norm(np.ptp(deformable, axis=0)))
    sizes = [float(np.linalg.norm(np.ptp(positions[b.first : b.last], axis=0))) for b in bodies if not b.kinematic]
    activation_distance = scene.contact.activation_distance or ACTIVATION_PART * max(sizes)
    minimum_separation = scene.contact.minimum_separation or SEPARATION_PART * activation_distance
    assembly = Assembly(
        positions,
        np.concatenate([part[2].vertices for part in parts]),
        np.concatenate([part[4] for part in parts]),
        bodies,
        np.repeat(np.arange(len(bodies), dtype=np.int32), [body.last - body.first for body in bodies]),
        scene_size,
        (min(sizes), max(sizes)),
        activation_distance,
        minimum_separation,
        notes=notes,
    )
    for body, placed, _, start, _ in parts:
        body.half_separation = 0.5 * (placed.minimum_separation or minimum_separation)
        if isinstance(placed, Rod) and not placed.minimum_separation:
            body.half_separation = placed.material.radius
        if isinstance(placed, Obstacle) and not isinstance(placed.motion, Deformation):
            body.trajectory = Trajectory(placed.motion, _middle(start))
    return assembly


@contextmanager
def _noting(problems: list[str]) -> Iterator[None]:
    try:
        yield
    except SceneError as error:
        problems.append(str(error))


def _known(names: Iterable[str], unread: set[str]) -> bool:
    """Whether none of the bodies, or copies of bodies, is among the unread."""
    return not any(name in unread or name.rpartition("[")[0] in unread for name in names)


def _seamed(
    placed: Cloth, mesh: Mesh, rest: np.ndarray, start: np.ndarray, cut: np.ndarray | None, notes: list[str]
) -> tuple[Mesh, np.ndarray, np.ndarray, np.ndarray]:
    """Mesh, rest and start of a cloth whose seams are welded or opened, and its pattern: what it was before, where it had none."""
    where = f'body "{placed.name}"'
    cut = rest[mesh.triangles] if cut is None else cut
    if placed.open_seams:
        moved = seams.opened(start, mesh.triangles, placed.open_seams)
        far = np.linalg.norm(moved - start, axis=1)
        notes.append(f"{where}: {np.count_nonzero(far)} vertices on open edges were drawn back, by {far.max():.3g} m at most")
        return mesh, moved, moved, cut
    assert placed.weld is not None
    number, triangles = seams.weld(start, mesh.triangles, placed.weld, f"{where}, weld")
    count = np.bincount(number)
    notes.append(f"{where}: {len(start) - len(count)} vertices on open edges were welded to others")
    together = [
        np.stack([np.bincount(number, weights=points[:, axis]) for axis in range(3)], axis=1) / count[:, None]
        for points in (rest, start)
    ]
    return replace(mesh, vertices=together[0], triangles=triangles), together[0], together[1], cut


def _copies(placed: Placed) -> list[tuple[str, np.ndarray]]:
    copies = placed.copies if isinstance(placed, Body) else None
    if copies is None:
        return [(placed.name, np.zeros(3))]
    z, y, x = np.indices(copies.counts[::-1]).reshape(3, -1)
    return [(f"{placed.name}[{i}]", offset) for i, offset in enumerate(np.column_stack([x, y, z]) * copies.spacing)]


def _middle(points: np.ndarray) -> np.ndarray:
    return 0.5 * (points.min(axis=0) + points.max(axis=0)) if len(points) else np.zeros(3)


def _body(assembly: Assembly, name: str, where: str) -> AssembledBody:
    for body in assembly.bodies:
        if body.name == name:
            return body
    raise SceneError(f'{where}: there is no body "{name}"; there are: {", ".join(body.name for body in assembly.bodies)}')


def _pushed(assembly: Assembly, name: str, where: str) -> AssembledBody:
    body = _body(assembly, name, where)
    if body.kinematic:
        raise SceneError(f"{where}: {_label(body)} feels no force; it must be a body")
    return body


def _select(assembly: Assembly, body: AssembledBody, select: Selection, where: str) -> np.ndarray:
    """(k,) int32, ascending; may be empty: the check reports that."""
    points = assembly.positions[body.first : body.first + body.count]
    if select.vertices is not None:
        _in_range(body, select.vertices, where)
        chosen = np.unique(np.array(select.vertices, dtype=np.int32))
    elif select.box is not None:
        chosen = np.flatnonzero(np.all((points >= select.box[0]) & (points <= select.box[1]), axis=1))
    elif select.sphere is not None:
        chosen = np.flatnonzero(np.linalg.norm(points - select.sphere[0], axis=1) <= select.sphere[1])
    elif select.seam:
        chosen = _seam(assembly, body)
    elif select.nearest is not None:
        chosen = np.array([np.argmin(np.linalg.norm(points - select.nearest, axis=1))])
    else:
        chosen = np.arange(len(points))
    return (chosen + body.first).astype(np.int32)


def _with_ghosts(body: AssembledBody, vertices: np.ndarray) -> np.ndarray:
    """The vertices, and the ghost points of segments that have both ends among them: who holds a segment holds its twist."""
    if not len(body.ghosts):
        return vertices
    return np.concatenate([vertices, body.ghosts[np.isin(body.segments, vertices).all(axis=1)]])


def _in_range(body: AssembledBody, vertices: list[int], where: str) -> None:
    count = body.count
    beyond = [vertex for vertex in vertices if not 0 <= vertex < count]
    if beyond:
        raise SceneError(f"{where}: vertex {beyond[0]} is out of range; {_label(body)} has the vertices 0 to {count - 1}")


def _quarantined(assembly: Assembly, names: tuple[str, str], where: str) -> tuple[int, int]:
    bodies = [_body(assembly, name, where) for name in names]
    if bodies[0] is bodies[1]:
        raise SceneError(f"{where}: {_label(bodies[0])} cannot ignore itself; name two bodies")
    if all(body.kinematic for body in bodies):
        raise SceneError(f"{where}: obstacles ignore each other always; name at least one body")
    a, b = sorted(assembly.bodies.index(body) for body in bodies)
    return a, b


def _label(body: AssembledBody) -> str:
    return f'{"obstacle" if body.kinematic else "body"} "{body.name}"'


def _attach(assembly: Assembly, table: Attachment, where: str) -> None:
    a, b = (_body(assembly, name, where) for name in table.bodies)
    if table.pairs is not None:
        for side, body in enumerate((a, b)):
            _in_range(body, [pair[side] for pair in table.pairs], where)
        pairs = np.array(table.pairs, dtype=np.int32).reshape(-1, 2)
    else:
        if not all(np.isfinite(assembly.positions[body.first : body.last]).all() for body in (a, b)):
            return  # the check says so
        near = cKDTree(assembly.positions[b.first : b.first + b.count])
        assert table.within is not None  # the table has pairs or this
        found = near.query(assembly.positions[a.first : a.first + a.count], distance_upper_bound=table.within)
        distance, nearest = (np.asarray(each) for each in found)
        chosen = np.flatnonzero(np.isfinite(distance))
        pairs = np.column_stack([chosen, nearest[chosen]])
    vertices_a, vertices_b = (pairs[:, 0] + a.first).astype(np.int32), (pairs[:, 1] + b.first).astype(np.int32)
    lengths = np.linalg.norm(assembly.positions[vertices_a] - assembly.positions[vertices_b], axis=1)
    if table.rest_length is not None:
        lengths = np.full(len(pairs), table.rest_length)
    assembly.attachments.append(AssembledAttachment(where, vertices_a, vertices_b, table.stiffness, lengths))


def _stitch(assembly: Assembly, table: Stitch, where: str) -> None:
    a, b = (_body(assembly, name, where) for name in table.bodies)
    if not all(np.isfinite(assembly.positions[body.first : body.last]).all() for body in (a, b)):
        return  # the check says so
    if b.kind == "rod":
        raise SceneError(f"{where}: {_label(b)} has no triangles to sew to; name the rod first, or take an attachment")
    if table.within is None:
        listed = table.points if table.points is not None else [(v, [w], [1.0]) for v, w in table.pairs or []]
        _in_range(a, [vertex for vertex, _, _ in listed], where)
        _in_range(b, [vertex for _, corners, _ in listed for vertex in corners], where)
        elements, weights = sewing.named(b, [(v + a.first, [c + b.first for c in on], w) for v, on, w in listed], where)
    else:
        if table.select is not None:
            chosen = _select(assembly, a, table.select, where)
        else:  # a rod has no rim
            chosen = np.unique(a.triangles) if a.kind == "rod" else sewing.rim_vertices(a.triangles)
        elements, weights = sewing.nearest(assembly.positions, a, b, chosen, table.within, table.onto == "surface")
    x = assembly.positions[elements]
    distances = np.linalg.norm(np.einsum("ek,ekd->ed", weights, x[:, 1:]) - x[:, 0], axis=1)
    stiffness = table.stiffness or max(getattr(body.material, "membrane_stiffness", None) or 0.0 for body in (a, b)) or 1000.0
    length = table.length
    if length is None:
        length = a.half_separation + b.half_separation + assembly.activation_distance
    assembly.stitches.append(
        AssembledStitch(where, elements, weights, stiffness, distances, length, table.start, table.duration)
    )


def _pin(assembly: Assembly, body: AssembledBody, table: Pin, where: str, unread: set[str]) -> None:
    vertices = _select(assembly, body, table.select, where)
    center = _middle(assembly.positions[vertices])
    vertices = _with_ghosts(body, vertices)
    points = assembly.positions[vertices]
    pin = AssembledPin(
        f"{where}.select = {table.select}",
        body.name,
        vertices,
        points,
        Trajectory(table.motion, center),
        table.stiffness,
        np.array([axis in table.axes for axis in "xyz"]),
        table.start,
        np.inf if table.end is None else table.end,
        table.start == 0.0,
    )
    if table.follow is not None:
        if not _known([table.follow], unread):
            return
        surface = _body(assembly, table.follow, f"{where}.follow")
        if surface is body:
            raise SceneError(f"{where}.follow: {_label(body)} cannot follow itself; name another body or an obstacle")
        if not len(surface.triangles):
            raise SceneError(f"{where}.follow: {_label(surface)} has no surface; name a solid, a cloth or an obstacle")
        if table.stiffness is None and not surface.kinematic:
            raise SceneError(
                f"{where}.follow: {_label(surface)} is simulated, and what is held exactly follows obstacles only; give the pin a stiffness"
            )
        pin.follow = assembly.bodies.index(surface)
        if not np.isfinite(points).all() or not np.isfinite(assembly.positions[surface.first : surface.last]).all():
            return  # the check says so
        if table.stiffness is not None:
            pin.elements, pin.weights = _onto(assembly.positions, body, surface, vertices)
        elif len(vertices):
            pin.glue = assembly.glued(pin, assembly.positions)
    assembly.pins.append(pin)


def _onto(x: np.ndarray, body: AssembledBody, surface: AssembledBody, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest points of a surface to vertices (k,) of a body at positions x (n, 3) m, as `sewing.nearest`."""
    distances = np.asarray(cKDTree(x[np.unique(surface.triangles)]).query(x[vertices])[0])
    return sewing.nearest(x, body, surface, vertices, (1.0 + 1e-6) * distances.max(initial=0.0) + 1e-12, True)


def _seam(assembly: Assembly, body: AssembledBody) -> np.ndarray:
    """(k,) vertices of a body, counted within it, that something joins to anything."""
    joined = [np.concatenate([a.vertices_a, a.vertices_b]) for a in assembly.attachments]
    for each in assembly.stitches:
        joined += [each.elements[:, 0], each.elements[:, 1:][each.weights > 0.0]]
    vertices = np.unique(np.concatenate([np.zeros(0, dtype=np.int32), *joined]))
    return vertices[(vertices >= body.first) & (vertices < body.last)] - body.first


def _force(assembly: Assembly, table: Wind | VertexForce, where: str) -> None:
    end = np.inf if table.end is None else table.end
    if isinstance(table, Wind):
        felt = [body.name for body in assembly.bodies if body.kind in ("solid", "cloth")]
        names = felt if table.bodies is None else table.bodies
        other = [name for name in names if _body(assembly, name, where).kind in ("rod", "rigid")]
        if other:
            raise SceneError(f'{where}: wind does not blow on rods and rigid bodies, such as "{other[0]}"; leave it out')
        if len(set(names)) < len(names):
            raise SceneError(f"{where}: names a body more than once: {', '.join(names)}")
        none = np.zeros((0, 3), dtype=np.int32)
        triangles = np.concatenate([none, *(_pushed(assembly, name, where).triangles for name in names)])
        wind = AssembledWind(triangles, np.array(table.velocity), table.air_density, table.drag, table.start, end)
        assembly.winds.append(wind)
    else:
        vertices = _select(assembly, _pushed(assembly, table.body, where), table.select, where)
        share = np.array(table.force) / max(1, len(vertices))
        where += f".select = {table.select}"
        assembly.forces.append(AssembledForce(where, table.body, vertices, share, table.start, end))
