"""The model: what stays constant during a simulation, assembled once from a scene; and the state that a step changes."""

import functools
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
import warp as wp

from pdipc import constraints
from pdipc.bodies import cloth
from pdipc.bodies.elasticity import elasticity, speed_of_sound
from pdipc.collision import faces, surface
from pdipc.collision.candidates import REST_SEPARATION, ROD_SEPARATION
from pdipc.device.launch import Device, one_at_a_time
from pdipc.device.precision import Real, real
from pdipc.device.threads import thread_count_for
from pdipc.integration.loads import ExternalForces
from pdipc.integration.script import Reached
from pdipc.linear.affine import Follower
from pdipc.linear.solver import Solver
from pdipc.linear.solvers import make_solver
from pdipc.linear.system import System
from pdipc.scene.assembly import Assembly, assemble
from pdipc.scene.check import refuse
from pdipc.scene.errors import SceneWarning
from pdipc.scene.reach import bursting, unresolved
from pdipc.scene.schema import Scene, uses_newton
from pdipc.scene.worlds import refuse_worlds

# The coarse system of two-level is solved in one thread: good for a CPU's core, not for a GPU's.
DEFAULT_SOLVER = {"cpu": {"barrier": "two-level", "paper": "a-jacobi"}, "cuda": {"barrier": "pcg", "paper": "a-jacobi"}}

# Of outer iterations. The hardest impacts of random scenes take Newton's method 555; the others creep where they have not converged by then.
MAX_OUTER = {"newton": 1000, "local-global": 100, "printed": 100}

TOLERANCE_SPEED, TOLERANCE_PART = 0.01, 1e-3  # the default: m/s, and the part of the smallest body's size


@dataclass
class State:
    """Positions, velocities and accelerations of all n vertices at one time.

    positions: (n,) vec3, m. velocities: (n,) vec3, m/s. accelerations: (n,) vec3, m/s^2. remainders: (n,) vec3, m, what rounding
    took off the positions when they were stored: motions smaller than that add up. reached: how far obstacles have come, on the host.
    quarantined: which of the assembly's quarantined pairs still ignore each other. time: s. step: steps done.
    """

    positions: wp.array
    velocities: wp.array
    accelerations: wp.array
    remainders: wp.array
    reached: Reached
    quarantined: tuple[bool, ...] = ()
    time: float = 0.0
    step: int = 0

    @one_at_a_time
    def copy(self) -> "State":
        """An independent copy."""
        return replace(
            self,
            positions=wp.clone(self.positions),
            velocities=wp.clone(self.velocities),
            accelerations=wp.clone(self.accelerations),
            remainders=wp.clone(self.remainders),
            reached=self.reached.copy(),
        )

    def __deepcopy__(self, memo: dict) -> "State":
        return self.copy()

    @one_at_a_time
    def arrays(self) -> dict[str, Any]:
        """The state as NumPy arrays, bit for bit: what a checkpoint holds."""
        return {
            "positions": self.positions.numpy().copy(),
            "velocities": self.velocities.numpy().copy(),
            "accelerations": self.accelerations.numpy().copy(),
            "remainders": self.remainders.numpy().copy(),
            **self.reached.arrays(),
            "quarantined": np.array(self.quarantined, dtype=bool),
            "time": np.float64(self.time),
            "step": np.int64(self.step),
        }


@dataclass(frozen=True)
class Settings:
    """How a step is solved: the scene's `simulation` and `contact` tables in metres and seconds."""

    time_step: float  # of one sub-step
    nonlinear_solver: str  # "newton", "local-global" or "printed", the paper's
    tolerance: float  # m: a step has converged when an outer iteration's untruncated motion is smaller
    max_outer: int
    inner_iterations: int
    activation_distance: float
    slip_threshold: float  # m
    per_vertex_truncation: bool
    method: str  # "barrier" or "paper"
    restitution: float | None
    damping: float  # 1/s
    budget_ms: float | None  # of one sub-step
    margin: float  # m: how far a vertex may stray from the motion that candidates were listed for


@dataclass(frozen=True)
class Model:
    """What stays constant: topology, masses, constraints, the global matrix and its solver, the contact surface.

    Arrays over all n vertices, simulated and kinematic: mass (n,) kg, 0 where kinematic; free (n,) 1 or 0;
    half_separation (n,) m, a vertex's part of a pair's minimum separation, and rest_separation (n,), see `Candidates`; friction (n,); kappa (n,) N/m, barrier stiffness;
    body_mass (n,) kg, that of a vertex's body, 0 where kinematic; rigidity (n,), how far
    its body is stopped as a whole within a step (barrier/restitution.py), 1 where kinematic.
    solver: of the local-global method, else None. free_vertices: (n,) bool; held: (n,) kg/s^2, what a common motion of all costs each:
    mass over h^2, damping, attachments to points. external: what the scene says; each simulation has a copy. triangles: (m, 3) int32, all surfaces.
    followers: of rigid bodies, whose vertices move as four points do.
    """

    scene: Scene
    assembly: Assembly
    settings: Settings
    device: Device
    real: Real
    substeps: int
    mass: wp.array
    free: wp.array
    half_separation: wp.array
    rest_separation: wp.array
    friction: wp.array
    kappa: wp.array
    body_mass: wp.array
    rigidity: wp.array
    projector: constraints.Projector
    solver: Solver | None
    free_vertices: np.ndarray
    held: np.ndarray
    surface: surface.Surface
    external: ExternalForces
    triangles: np.ndarray
    followers: list[Follower]

    @property
    def has_friction(self) -> bool:
        """Whether any pair of bodies rubs."""
        return bool((self.friction.numpy() > 0.0).any())

    @property
    def recordable(self) -> bool:
        """Whether a step can be one graph."""
        return self.solver is None or self.solver.recordable

    @property
    def vertex_count(self) -> int:
        """Simulated and kinematic vertices together."""
        return len(self.mass)

    @one_at_a_time
    def initial_state(self) -> State:
        """The scene's start: time 0, with its initial velocities."""
        a = self.assembly
        zero = np.zeros_like(a.positions)
        rounded = a.positions.astype(self.real.numpy).astype(np.float64)
        # without what rounding takes off, steel in float32 would start under stress and then turn as if it were heavier
        left = np.where(self.free_vertices[:, None], a.positions - rounded, 0.0)
        start = {"positions": a.positions, "velocities": a.velocities, "accelerations": zero, "remainders": left, "time": 0.0}
        return self.state_from(start)

    @one_at_a_time
    def state_from(self, arrays: dict[str, Any]) -> State:
        """A state from NumPy arrays such as `State.arrays()` gives."""

        def upload(name: str) -> wp.array:
            return wp.array(np.asarray(arrays[name]), dtype=self.real.vec3, device=self.device.warp)

        arrays = {"remainders": np.zeros_like(arrays["positions"]), **arrays}  # files of earlier versions have none
        time = float(arrays["time"])
        reached = Reached.from_arrays(arrays) if "reached_times" in arrays else Reached.at(time, self.assembly)
        quarantined = tuple(
            bool(is_one) for is_one in arrays.get("quarantined", np.ones(len(self.assembly.quarantine), dtype=bool))
        )
        return State(
            positions=upload("positions"),
            velocities=upload("velocities"),
            accelerations=upload("accelerations"),
            remainders=upload("remainders"),
            reached=reached,
            quarantined=quarantined,
            time=time,
            step=int(arrays.get("step", 0)),
        )

    def set_time(self, time: float) -> None:
        """Uploads what a script says of `time`, s: how long threads are, and what closed sheets hold."""
        if self.projector.threads is not None:
            self.projector.threads.assign(cloth.thread_lengths(self.assembly, time))
        if self.projector.cavities is not None:
            self.projector.cavities.laws.assign(self._fillings.laws(time))

    @functools.cached_property
    def _fillings(self) -> cloth.Fillings:
        return cloth.Fillings(self.assembly)

    def kinematic_targets(self, time: float) -> np.ndarray:
        """(n, 3) m: where the kinematic vertices are at `time`; the start for all others."""
        targets = self.assembly.positions.copy()
        targets[self.assembly.kinematic_vertices] = self.assembly.kinematic_positions(time)
        return targets


@one_at_a_time
def build(scene: Scene, device: str | Device | None = None, masses: np.ndarray | None = None) -> Model:
    """Assembles a scene on a device: "cpu", "cuda:0", or None for the scene's choice, else CUDA where there is one.

    masses: (n,) kg of all vertices in place of those that the densities give.

    Raises SceneError for what `pdipc.check_scene` finds, before anything is launched.
    """
    assembly = assemble(scene)
    refuse_worlds(scene, "a model")
    assembly.masses = masses
    sim = scene.simulation
    device = device if isinstance(device, Device) else Device(device or sim.device, thread_count_for(len(assembly.positions)))
    too_stiff = unresolved(scene, assembly)
    precision = real(_precision(sim.precision, device.is_cuda, too_stiff))
    told = len(assembly.notes)
    refuse(scene, assembly, precision.name)
    for note in [*assembly.notes[told:], *bursting(assembly), *(too_stiff if precision.name == "float32" else [])]:
        warnings.warn(note, SceneWarning, stacklevel=2)
    return _made(scene.settled(), assembly, device, precision)


def _precision(wanted: str, on_cuda: bool, too_stiff: list[str]) -> str:
    """What the scene wants, else float64 on CPUs and wherever float32 does not resolve a body, and float32 on CUDA."""
    if wanted != "auto":
        return wanted
    return "float32" if on_cuda and not too_stiff else "float64"


def reassembled(model: Model, assembly: Assembly) -> Model:
    """The model of another assembly of the same scene, such as one whose pins hold other vertices."""
    return _made(model.scene, assembly, model.device, model.real)


def _made(scene: Scene, assembly: Assembly, device: Device, precision: Real) -> Model:
    settings = _settings(scene, assembly)
    sim, h, n = scene.simulation, settings.time_step, len(assembly.positions)
    free = np.ones(n, dtype=bool)
    free[assembly.kinematic_vertices] = False
    sets, mass = elasticity(assembly, settings.nonlinear_solver == "newton")
    mass = np.where(free, mass if assembly.masses is None else assembly.masses, 0.0)
    inertia = mass * (1.0 / (h * h) + sim.damping / h)
    held = inertia.copy()
    for s in sets:
        if s.kind == "point_attachment":
            np.add.at(held, s.vertices[:, 0], s.weight)
    solver = None
    if settings.nonlinear_solver != "newton":
        matrix = constraints.stiffness_matrix(n, sets) + scipy.sparse.diags_array(inertia)
        solver = _linear_solver(scene, System(device, precision, matrix, free))

    def upload(values: np.ndarray) -> wp.array:
        return wp.array(np.asarray(values, dtype=precision.numpy), device=device.warp)

    return Model(
        scene=scene,
        assembly=assembly,
        settings=settings,
        device=device,
        real=precision,
        substeps=sim.substeps,
        mass=upload(mass),
        free=upload(free),
        **{name: upload(values) for name, values in _per_vertex(scene, assembly, mass, free, h).items()},
        projector=constraints.Projector(device, precision, n, sets),
        solver=solver,
        free_vertices=free,
        held=held,
        surface=_surface(assembly, device),
        external=ExternalForces(assembly, np.array(sim.gravity), mass, h),
        triangles=assembly.triangles,
        followers=[
            Follower(b.handles, np.arange(b.first, b.first + b.count), b.weights) for b in assembly.bodies if len(b.handles)
        ],
    )


def _settings(scene: Scene, assembly: Assembly) -> Settings:
    sim, contact = scene.simulation, scene.contact
    h = sim.time_step / sim.substeps
    truncation = contact.truncation
    if truncation == "auto":
        truncation = "global" if contact.method == "paper" else "per_vertex"
    solver = _nonlinear_solver(scene)
    return Settings(
        time_step=h,
        nonlinear_solver=solver,
        tolerance=_tolerance(sim, assembly),
        max_outer=sim.max_outer or MAX_OUTER[solver],
        inner_iterations=sim.inner_iterations,
        activation_distance=assembly.activation_distance,
        slip_threshold=contact.friction_velocity * h,
        per_vertex_truncation=truncation == "per_vertex",
        method=contact.method,
        restitution=contact.restitution,
        damping=sim.damping,
        budget_ms=None if sim.budget_ms is None else sim.budget_ms / sim.substeps,
        margin=assembly.activation_distance,
    )


def _linear_solver(scene: Scene, system: System) -> Solver:
    """Of the constant matrix: the one that the scene names, else what fits the device and the mode."""
    sim, name = scene.simulation, scene.simulation.linear_solver
    if name == "auto":
        name = DEFAULT_SOLVER["cuda" if system.device.is_cuda else "cpu"][scene.contact.method]
    options: dict[str, float] = {"order": sim.solver_order} if name in ("a-jacobi", "matrix-powers") else {}
    if name == "a-jacobi":
        options["drop"] = sim.solver_drop
    return make_solver(name, system, tolerance=sim.linear_tolerance, max_iterations=sim.linear_iterations, **options)


def _per_vertex(scene: Scene, assembly: Assembly, mass: np.ndarray, free: np.ndarray, h: float) -> dict[str, np.ndarray]:
    """What `Model` has for every vertex of its body, by name."""
    n = len(mass)
    found = {
        "friction": np.zeros(n),
        "half_separation": np.zeros(n),
        "rest_separation": np.full(n, REST_SEPARATION),
        "kappa": np.zeros(n),
        "body_mass": np.zeros(n),
        "rigidity": np.ones(n),
    }
    for body in assembly.bodies:
        own = slice(body.first, body.last)
        found["friction"][own] = body.friction
        found["half_separation"][own] = body.half_separation
        if body.kind == "rod":
            found["rest_separation"][own] = ROD_SEPARATION
        if body.material is not None:
            typical = mass[own].sum() / body.count if len(body.handles) else mass[own].mean()
            found["kappa"][own] = scene.contact.stiffness_scale * typical / (h * h)
            found["body_mass"][own] = mass[own].sum()
            crossing = np.ptp(assembly.rest_positions[own], axis=0).max() / speed_of_sound(body)
            found["rigidity"][own] = h**2 / (h**2 + crossing**2)
    found["kappa"][~free] = found["body_mass"][~free] = 0.0
    return found


def _surface(assembly: Assembly, device: Device) -> surface.Surface:
    keeps_shape = assembly.keeps_shape[assembly.body_of_vertex]
    tolerance = faces.FLAT * assembly.activation_distance
    face = faces.flat_faces(assembly.positions, assembly.triangles, keeps_shape, tolerance)
    return surface.build(device, assembly.triangles, assembly.rest_positions, assembly.body_of_vertex, assembly.obstacle, face)


def _nonlinear_solver(scene: Scene) -> str:
    """The method of a step: what the scene says, else what fits its settings."""
    sim = scene.simulation
    if scene.contact.method == "paper":
        return "printed"
    return "newton" if uses_newton(sim) else "local-global"


def _tolerance(sim, assembly: Assembly) -> float:
    """m, of one sub-step."""
    h = sim.time_step / sim.substeps
    if sim.tolerance is not None:
        return sim.tolerance * h
    smallest, largest = assembly.body_sizes
    if sim.outer_tolerance is not None:
        return sim.outer_tolerance * largest
    return min(TOLERANCE_SPEED * h, TOLERANCE_PART * smallest)
