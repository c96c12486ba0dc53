"""A Newton model as a scene: which particles belong to which body, materials, pins, and shapes as obstacles.

Newton's materials are per element and depend on the mesh; those of a scene are per body and do not. So elements of a body must agree, and

- tets: k_mu and k_lambda are Lame's constants, the energy stable neo-Hookean in both;
- membranes: tri_ke and tri_ka are those of the plane, mu' and lambda': Y = 2 mu' (1 + nu), nu = lambda' / (lambda' + 2 mu');
- hinges: Newton's energy is ke l theta^2 / 2 for an edge of length l, a scene's D l^2 theta^2 / (2 A) for small angles, with A the area of
  both triangles: D = ke A / l, of which a body gets the mean over its hinges.
"""

import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from pdipc.newton.shapes import Unsupported, triangles_of
from pdipc.scene.meshes import boundary
from pdipc.scene.schema import Scene

if TYPE_CHECKING:
    import newton

SAME = 1e-4  # elements of a body whose materials differ by less than this part are of one material
REST = 1e-3  # likewise for the rest shapes of elements and that of the model's particles
FLAT = 1e-3  # rad: below it, a sheet is flat at rest
PLANE = 10.0  # half the edge of the square that stands for a plane without end, in diagonals of all particles, and at least so many m


@dataclass
class Part:
    """A body of the scene. particles: (n,) of the model, in the order of the body's vertices; pinned: (k,) its vertices that are held."""

    name: str
    particles: np.ndarray
    pinned: np.ndarray


@dataclass
class Shape:
    """An obstacle of the scene: a shape of the world, or all shapes of a body, in the body's frame. body: of the model, or -1."""

    name: str
    body: int


@dataclass
class Translation:
    """scene: of the model. masses: (n,) kg of all vertices that are simulated, in the scene's order. notes: what was left out."""

    scene: Scene
    parts: list[Part]
    shapes: list[Shape]
    masses: np.ndarray
    notes: list[str] = field(default_factory=list)


def numbers(array: Any, width: int | None = None) -> np.ndarray:
    """An array of a model in float64 or int64, (n,) or (n, width); empty for None."""
    if array is None:
        return np.zeros((0,) if width is None else (0, width))
    values = array.numpy()
    values = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
    return values if width is None else values.reshape(-1, width)


def translate(
    model: "newton.Model",
    start: np.ndarray,
    body_q: np.ndarray | None,
    simulation: dict[str, Any],
    contact: dict[str, Any],
    follow_bodies: bool,
) -> Translation:
    """The model as a scene. start: (n, 3) m of its particles, body_q: (b, 7) of its bodies, at the start. Raises Unsupported for what a
    scene does not have.
    """
    _refuse(model, follow_bodies)
    q, tets, triangles = numbers(model.particle_q, 3), numbers(model.tet_indices, 4), numbers(model.tri_indices, 3)
    tets, triangles = tets.astype(np.int64), triangles.astype(np.int64)
    parts, bodies, notes = [], [], _damping(model)
    for particles in _components(model.particle_count, tets, triangles):
        member = np.zeros(model.particle_count, dtype=bool)
        member[particles] = True
        own_tets, own_triangles = (np.flatnonzero(member[elements[:, 0]]) for elements in (tets, triangles))
        number = np.cumsum(member) - 1  # of a particle, among those of the body
        mesh: dict[str, Any] = {"vertices": q[particles], "start": start[particles].astype(np.float64)}
        kind = "solid" if len(own_tets) else "cloth"
        name = f"{kind}_{len(parts)}"
        if kind == "solid":
            mesh["tets"] = number[tets[own_tets]]
            material = _solid(model, q, own_tets, own_triangles, name)
        else:
            mesh["triangles"] = number[triangles[own_triangles]]
            material = _cloth(model, q, own_triangles, member, name)
        held = _held(model)[particles]
        vertices = np.flatnonzero(held)
        pins = [{"select": {"vertices": vertices.tolist()}}] if len(vertices) else []
        bodies.append(
            {"name": name, "kind": kind, "mesh": mesh, "material": material, "pins": pins, "friction": model.soft_contact_mu}
        )
        parts.append(Part(name, particles, vertices))
    shapes, obstacles = _shapes(model, start, body_q)
    ours = {"time_step": 0.01, "steps": 0, "gravity": gravity(model), "device": str(model.device)}
    for key in ours:
        if key in simulation:
            raise ValueError(f"simulation.{key} comes from Newton's model and step(); leave it out")
    scene = Scene(
        simulation={"precision": "float64", **simulation, **ours}, contact=contact, bodies=bodies, obstacles=obstacles
    )
    masses = np.concatenate([numbers(model.particle_mass)[part.particles] for part in parts])
    return Translation(scene, parts, shapes, masses, notes)


def gravity(model: "newton.Model") -> list[float]:
    """(3,) m/s^2 of the one world. Raises Unsupported where worlds differ."""
    all_worlds = numbers(model.gravity, 3)
    if np.any(all_worlds != all_worlds[0]):
        raise Unsupported("the model's worlds have different gravity; one is simulated")
    return all_worlds[0].tolist()


def _held(model: "newton.Model") -> np.ndarray:
    """(n,) bool: particles without mass, and those that are not active."""
    import newton

    active = numbers(model.particle_flags).astype(np.int64) & int(newton.ParticleFlags.ACTIVE)
    return (numbers(model.particle_mass) == 0.0) | (active == 0)


def _refuse(model: "newton.Model", follow_bodies: bool) -> None:
    import newton

    if not model.particle_count:
        raise Unsupported("the model has no particles: SolverPDIPC simulates soft meshes and cloth")
    worlds = np.unique(numbers(model.particle_world))
    if len(worlds) > 1:
        raise Unsupported(f"the model's particles are in {len(worlds)} worlds; one is simulated")
    for name, what in (
        ("spring_count", "springs"),
        ("muscle_count", "muscles"),
        ("tendon_count", "tendons"),
        ("attachment_particle_body_count", "attachments of particles to bodies"),
        ("curve_count", "curves"),
    ):
        if count := getattr(model, name, 0):
            raise Unsupported(f"the model has {count} {what}, which SolverPDIPC does not simulate")
    flags, inverse = numbers(model.body_flags).astype(np.int64), numbers(model.body_inv_mass)
    moving = np.flatnonzero((inverse > 0.0) & ((flags & int(newton.BodyFlags.KINEMATIC)) == 0))
    if len(moving) and not follow_bodies:
        raise Unsupported(
            f'body {moving[0]} ("{model.body_label[moving[0]]}") is dynamic; make it kinematic (is_kinematic=True), or, where another solver '
            "moves it, pass follow_bodies=True: its shapes then are where state_in has them, and feel nothing"
        )


def _damping(model: "newton.Model") -> list[str]:
    """What is left out: damping of elements."""
    found = []
    for name, array, width, column in (
        ("tri_kd", model.tri_materials, 5, 2),
        ("edge_kd", model.edge_bending_properties, 2, 1),
        ("k_damp", model.tet_materials, 3, 2),
    ):
        values = numbers(array, width)[:, column]
        if np.any(values):
            found.append(f"{name} up to {values.max():g}")
    return (
        [f"damping of elements is left out ({', '.join(found)}); simulation={{'damping': ...}} damps by mass"] if found else []
    )


def _components(count: int, tets: np.ndarray, triangles: np.ndarray) -> list[np.ndarray]:
    """Particles (n,) of each body, ascending. Raises Unsupported for particles that no element has."""
    pairs = (
        np.concatenate([tets[:, [0, 0, 0]].ravel(), triangles[:, [0, 0]].ravel()]),
        np.concatenate([tets[:, 1:].ravel(), triangles[:, 1:].ravel()]),
    )
    used = np.zeros(count, dtype=bool)
    used[tets], used[triangles] = True, True
    if not used.all():
        raise Unsupported(
            f"particle {int(np.argmin(used))} belongs to no tet and no triangle; loose particles are not simulated"
        )
    graph = scipy.sparse.coo_array((np.ones(len(pairs[0])), pairs), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    return [np.flatnonzero(labels == label) for label in labels[np.sort(first)]]


def _one(values: np.ndarray, what: str, where: str) -> float:
    """The value that all elements of a body share. Raises Unsupported where they do not."""
    low, high = float(values.min()), float(values.max())
    if high - low > SAME * max(abs(low), abs(high)):
        raise Unsupported(f"{where}: {what} varies from {low:g} to {high:g}; a body is of one material")
    return float(values.mean())


def _solid(model: "newton.Model", q: np.ndarray, tets: np.ndarray, triangles: np.ndarray, where: str) -> dict[str, Any]:
    corners = numbers(model.tet_indices, 4).astype(np.int64)[tets]
    edges = np.swapaxes(q[corners[:, 1:]] - q[corners[:, :1]], 1, 2)
    _same_rest(np.linalg.inv(numbers(model.tet_poses, 9)[tets].reshape(-1, 3, 3)), edges, where)
    skin = numbers(model.tri_indices, 3).astype(np.int64)[triangles]
    known = {tuple(face) for face in np.sort(boundary(corners), axis=1).tolist()}
    loose = [face for face in np.sort(skin, axis=1).tolist() if tuple(face) not in known]
    if loose:
        raise Unsupported(
            f"{where}: triangle {loose[0]} is not on the surface of its tets; cloth that is sewn to a solid is not simulated"
        )
    if len(triangles) and np.any(numbers(model.tri_materials, 5)[triangles][:, [0, 1]]):
        raise Unsupported(f"{where}: its surface has a stiffness of its own (tri_ke, tri_ka); it must be 0")
    member = np.zeros(model.particle_count, dtype=bool)
    member[corners] = True
    if np.any(_hinges(model, member)[1]):
        raise Unsupported(f"{where}: its surface resists bending (edge_ke); it must be 0")
    _no_activation(model.tet_activations, tets, where)
    mu, lame = (_one(numbers(model.tet_materials, 3)[tets][:, k], name, where) for k, name in enumerate(("k_mu", "k_lambda")))
    if not mu > 0.0 or lame < 0.0:
        raise Unsupported(f"{where}: k_mu = {mu:g} and k_lambda = {lame:g}; they must be more than 0, and at least 0")
    return {
        "young_modulus": mu * (3.0 * lame + 2.0 * mu) / (lame + mu),
        "poisson_ratio": lame / (2.0 * (lame + mu)),
        "density": 1000.0,  # the model's particles have masses of their own
        "model": "neo_hookean",
    }


def _cloth(model: "newton.Model", q: np.ndarray, triangles: np.ndarray, member: np.ndarray, where: str) -> dict[str, Any]:
    corners = numbers(model.tri_indices, 3).astype(np.int64)[triangles]
    edges = np.swapaxes(q[corners[:, 1:]] - q[corners[:, :1]], 1, 2)
    _same_rest(np.linalg.inv(numbers(model.tri_poses, 4)[triangles].reshape(-1, 2, 2)), edges, where)
    _no_activation(model.tri_activations, triangles, where)
    table = numbers(model.tri_materials, 5)[triangles]
    if np.any(table[:, 3:]):
        raise Unsupported(f"{where}: tri_drag and tri_lift must be 0; wind is not simulated")
    mu, lame = (_one(table[:, k], name, where) for k, name in enumerate(("tri_ke", "tri_ka")))
    if not mu > 0.0 or lame < 0.0:
        raise Unsupported(f"{where}: tri_ke = {mu:g} and tri_ka = {lame:g}; they must be more than 0, and at least 0")
    poisson = lame / (lame + 2.0 * mu)
    if poisson > 0.499:
        raise Unsupported(
            f"{where}: tri_ka = {lame:g} is more than 1.99 tri_ke = {mu:g}: its Poisson's ratio would be {poisson:.3g}"
        )
    hinges, stiffness, angles = _hinges(model, member)
    bending = 0.0
    if np.any(stiffness):
        opposite, e = q[hinges[:, :2]], q[hinges[:, 3]] - q[hinges[:, 2]]
        areas = 0.5 * np.linalg.norm(np.cross(opposite - q[hinges[:, 2]][:, None], e[:, None]), axis=2).sum(axis=1)
        bending = float(np.mean(stiffness * areas / np.linalg.norm(e, axis=1)))
    return {
        "membrane_stiffness": 2.0 * mu * (1.0 + poisson),
        "poisson_ratio": poisson,
        "bending_stiffness": bending,
        "bending": "curved" if np.any(np.abs(angles) > FLAT) else "quadratic",
        "areal_density": 0.2,  # the model's particles have masses of their own
    }


def _hinges(model: "newton.Model", member: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the edges with two triangles among the particles `member`: (h, 4) particles, opposite ones first; stiffness and rest angle (h,)."""
    edges = numbers(model.edge_indices, 4).astype(np.int64)
    own = np.asarray((edges[:, :2] >= 0).all(axis=1))
    own[own] = member[edges[own, 2]]
    return edges[own], numbers(model.edge_bending_properties, 2)[own][:, 0], numbers(model.edge_rest_angle)[own]


def _same_rest(poses: np.ndarray, edges: np.ndarray, where: str) -> None:
    """Raises Unsupported where the rest shapes of elements (m, k, k) are not those that the model's particles have (m, 3, k)."""
    rest, now = np.swapaxes(poses, 1, 2) @ poses, np.swapaxes(edges, 1, 2) @ edges
    size = np.trace(rest, axis1=1, axis2=2)[:, None, None]
    if not np.all(np.abs(rest - now) <= REST * size):
        raise Unsupported(
            f"{where}: model.particle_q is not at the rest shape of its elements; leave the model's particles at rest, and put state.particle_q "
            "where the motion begins"
        )


def _no_activation(activations: Any, own: np.ndarray, where: str) -> None:
    if activations is not None and np.any(numbers(activations)[own]):
        raise Unsupported(f"{where}: activations are not simulated; they must be 0")


def _shapes(model: "newton.Model", q: np.ndarray, body_q: np.ndarray | None) -> tuple[list[Shape], list[dict[str, Any]]]:
    """The shapes that collide with particles, where bodies are. Raises Unsupported where shapes of a body rub or keep apart differently."""
    import newton

    size = PLANE * max(1.0, float(np.linalg.norm(np.ptp(q, axis=0))))
    flags, of_body = numbers(model.shape_flags).astype(np.int64), numbers(model.shape_body).astype(np.int64)
    kinds, scales, places = numbers(model.shape_type), numbers(model.shape_scale, 3), numbers(model.shape_transform, 7)
    colliding = np.flatnonzero(flags & int(newton.ShapeFlags.COLLIDE_PARTICLES))
    world = [[number] for number in colliding[of_body[colliding] < 0]]
    bodies = [colliding[of_body[colliding] == body].tolist() for body in range(model.body_count)]
    shapes, obstacles = [], []
    for members in (*world, *filter(None, bodies)):
        body = int(of_body[members[0]])
        name = f"shape_{members[0]}" if body < 0 else f"body_{body}"
        vertices, triangles, count = [], [], 0
        for number in members:
            where = f'shape {number} ("{model.shape_label[number]}")'
            kind = newton.GeoType(int(kinds[number])).name
            x, faces = triangles_of(kind, scales[number], model.shape_source[number], size, where)
            vertices.append(Rotation.from_quat(places[number, 3:]).apply(x) + places[number, :3])
            triangles.append(faces + count)
            count += len(x)
        friction, margin = (
            _one(numbers(array)[members], what, f"the shapes of body {body}")
            for array, what in ((model.shape_material_mu, "mu"), (model.shape_margin, "margin"))
        )
        position, turn = (np.zeros(3), Rotation.identity()) if body < 0 or body_q is None else placed(body_q[body])
        obstacle = {
            "name": name,
            "mesh": {"vertices": np.concatenate(vertices), "triangles": np.concatenate(triangles)},
            "translation": position.tolist(),
            "rotation": turn.as_euler("xyz", degrees=True).tolist(),
            "friction": friction,
        }
        if margin > 0.0:
            obstacle["minimum_separation"] = 2.0 * margin  # a pair keeps the mean of its two
        shapes.append(Shape(name, body))
        obstacles.append(obstacle)
    return shapes, obstacles


def placed(transform: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Position (3,) m and turn of a transform (7,)."""
    transform = np.asarray(transform, dtype=np.float64)
    return transform[:3], Rotation.from_quat(transform[3:])


def warn(notes: list[str]) -> None:
    """Says what was left out."""
    for note in notes:
        warnings.warn(f"SolverPDIPC: {note}", UserWarning, stacklevel=4)
