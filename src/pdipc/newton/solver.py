"""`SolverPDIPC`: a `newton.solvers.SolverBase` whose soft bodies and cloth never pass through each other or through shapes."""

from typing import TYPE_CHECKING, Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase
from scipy.spatial.transform import Rotation

from pdipc.drive import StepResult
from pdipc.newton import translate
from pdipc.newton.shapes import Unsupported
from pdipc.scene.assembly import SEPARATION_PART, assemble
from pdipc.scene.check import SEPARATION_ULPS, refuse

if TYPE_CHECKING:
    from pdipc.newton.translate import Translation
    from pdipc.scene.schema import Scene
    from pdipc.simulation import Simulation

HERE = 1e-6  # m, and part of a turn: a body that is no further from where it was told to be is there
LOST = 2.0  # units in the last place; sqrt(3) in fact
KEPT = 8  # time steps that simulations are kept for; a program that chooses a new one every step would fill the memory
AT_ONCE = 1e9  # m/s: what leads obstacles and pins arrives within the step, as far as nothing is in the way


class SolverPDIPC(SolverBase):
    """Penetration-free projective dynamics for the particles of a Newton model: soft meshes and cloth, which collide with themselves, each
    other, and shapes.

    Particles without mass, or not active, are held: they go where `state_in` has them, as far as nothing is in the way. Shapes that
    collide with particles are obstacles; those of kinematic bodies follow `state_in.body_q` likewise. Both are led there by motions that
    are proven free of contact, not put there: `result.lag` is how far, in m, the last is behind, and state_out has them where they are.
    They go on to where they were told to be until they are told otherwise. Bodies and joints are not moved in any other way.

    Contacts are found within the step, so that `contacts` may be None, and no CollisionPipeline is needed; friction is that of the model
    (soft_contact_mu, and mu of shapes), the stiffness of contacts (ke, kd) has no meaning here. A step is implicit Euler of any length, so no
    substeps are needed either. It is driven by the host and cannot be captured in a CUDA graph, of which it is made itself.

    model: of one world. simulation, contact: more keys of these tables of a scene (docs/scene_format.md), such as
    simulation={"tolerance": 1e-3}, contact={"activation_distance": 1e-3}. follow_bodies: whether bodies that another solver moves are
    obstacles, too, where state_in has them.

    result: of the last step, None before: whether it converged, and what it took (`pdipc.drive.StepResult`).

    Raises Unsupported, a NotImplementedError, for what a model has and this solver does not simulate; SceneError, with all findings at
    once, where the model's particles intersect each other or shapes, or cannot be simulated for another reason. Warns of damping of elements,
    which is left out.
    """

    def __init__(
        self,
        model: newton.Model,
        *,
        simulation: dict[str, Any] | None = None,
        contact: dict[str, Any] | None = None,
        follow_bodies: bool = False,
    ):
        super().__init__(model)
        self.result: StepResult | None = None
        self._tables = dict(simulation or {}), dict(contact or {})
        self._follow = follow_bodies
        self._simulations: dict[float, Simulation] = {}  # by time step, the last used last
        self._now: Simulation | None = None
        self._told = False  # of rounding
        self._translate()
        translate.warn(self._made.notes)

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None = None,
        contacts: newton.Contacts | None = None,
        dt: float = 0.0,
        *,
        observables: SolverBase.Observables | None = None,
    ) -> None:
        """One step of dt, s, from state_in to state_out, which may be the same. Forces in `particle_f` act, in N.

        Where free particles of state_in are elsewhere than the last step left them, or have other velocities, that is a new start.
        Raises ValueError where such a start intersects, or for activations and observables, which there are none of; RuntimeError while a
        graph is being captured.
        """
        if not dt > 0.0:
            raise ValueError(f"dt is {dt} s; it must be more than 0")
        if self.device.is_capturing:
            raise RuntimeError(
                "a step of SolverPDIPC is driven by the host and cannot be captured: call it without wp.ScopedCapture"
            )
        self.validate_observables(observables, contacts)
        self._refuse_activations(control)
        simulation = self._of(float(dt))
        q, qd = _read(state_in, "particle_q"), _read(state_in, "particle_qd")
        self._adopt(simulation, q, qd)
        self._lead(simulation, q, state_in)
        self._pull(simulation, state_in)
        self.result = simulation.step()
        x, v = simulation.positions, simulation.state.velocities.numpy()
        new_q, new_qd = np.empty_like(q), np.empty_like(qd)
        new_q[self._particles], new_qd[self._particles] = x[: len(self._particles)], v[: len(self._particles)]
        self._tell_of_rounding(x)
        _write(state_out, "particle_q", new_q)
        _write(state_out, "particle_qd", new_qd)
        for name in ("body_qd", "joint_q", "joint_qd"):
            there, here = getattr(state_out, name, None), getattr(state_in, name, None)
            if there is not None and here is not None and there is not here:
                wp.copy(there, here)
        self._q, self._qd = new_q, new_qd
        if self._body_q is not None:
            self._body_q = self._reached(simulation, _read(state_in, "body_q"))
            _write(state_out, "body_q", self._body_q)

    def reset(
        self, state: newton.State, world_mask: wp.array | None = None, flags: newton.StateFlags | int | None = None
    ) -> None:
        """Puts what `flags` names (default: all of particles and bodies) of `state` back to the model's, and forgets the motion so far."""
        mask = self._normalize_reset_world_mask(world_mask)
        model, wanted = self.model, newton.StateFlags
        flags = -1 if flags is None else int(flags)
        chosen = np.ones(model.particle_count, dtype=bool)
        if mask is not None:
            chosen = _numpy(mask)[_read(model, "particle_world")]
        for flag, name in ((wanted.PARTICLE_Q, "particle_q"), (wanted.PARTICLE_QD, "particle_qd")):
            if flags & int(flag):
                values = _read(state, name).copy()
                values[chosen] = _read(model, name)[chosen]
                _write(state, name, values)
        if mask is None or chosen.all():
            for flag, name in ((wanted.BODY_Q, "body_q"), (wanted.BODY_QD, "body_qd")):
                if flags & int(flag) and model.body_count and getattr(state, name) is not None:
                    wp.copy(getattr(state, name), getattr(model, name))
            if self._now is not None:
                self._now.reset()
            self._start()

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """Takes over gravity and friction, masses and materials, and shapes and their bodies where flags name any of these; particles go on where
        they are.

        Raises what the constructor does, and goes on with what was there before.
        """
        wanted, flags = newton.ModelFlags, int(flags)
        shapes = (
            wanted.SHAPE_PROPERTIES | wanted.SHAPE_TYPE_AND_SOURCE | wanted.BODY_PROPERTIES | wanted.BODY_INERTIAL_PROPERTIES
        )
        if not flags & int(shapes | wanted.MODEL_PROPERTIES):
            return
        self._translate(self._q, self._body_q)
        self._simulations, self._now = {}, None

    def rebuild_bvh(self, state: newton.State) -> None:
        """Nothing: SolverVBD has it and programs call it; what finds contacts here is kept up to date within the step."""

    # --- between the two ---

    def _translate(self, q: np.ndarray | None = None, body_q: np.ndarray | None = None) -> None:
        """Makes the scene; q, body_q: where particles and bodies are, None for where the model has them."""
        model = self.model
        q = _read(model, "particle_q").copy() if q is None else q
        body_q = body_q if body_q is not None or not model.body_count else _read(model, "body_q").copy()
        made = translate.translate(model, q, body_q, *self._tables, self._follow)
        scene = made.scene
        self._keep_apart_in_float32(scene, q)
        refuse(scene, assembly := assemble(scene), scene.simulation.precision)
        self._q_start, self._body_q_start = q, body_q
        self._made: Translation = made
        self._particles = np.concatenate([part.particles for part in self._made.parts])
        self._masses = np.zeros(len(assembly.positions))
        self._masses[: len(self._particles)] = self._made.masses
        self._start()

    def _keep_apart_in_float32(self, scene: "Scene", q: np.ndarray) -> None:
        """Newton's states are float32: what is apart must stay so when particles are rounded to that. Raises ValueError where it would not."""
        contact, assembly = scene.contact, assemble(scene)
        least = SEPARATION_ULPS * float(np.spacing(np.abs(q).max(), dtype=np.float32))
        if contact.activation_distance is None:
            contact.activation_distance = max(assembly.activation_distance, 10.0 * least)
        if contact.minimum_separation is None:
            contact.minimum_separation = max(SEPARATION_PART * contact.activation_distance, least)
        elif contact.minimum_separation < least:
            raise ValueError(
                f"contact.minimum_separation is {contact.minimum_separation:g} m, which the float32 of Newton's states does not keep at these "
                f"coordinates; it must be at least {least:.3g} m"
            )

    def _tell_of_rounding(self, x: np.ndarray) -> None:
        """Warns, once, where particles have gone so far that the float32 of Newton's states can take the gap between them: each is rounded by half a
        unit in the last place along each axis, which for two is less than LOST of them.
        """
        separation, farthest = self._made.scene.contact.minimum_separation, float(np.abs(x).max())
        if self._told or separation is None or self._made.scene.simulation.precision == "float32":
            return
        if LOST * np.spacing(np.float32(farthest)) > separation:
            self._told = True
            note = (
                f"particles are up to {farthest:.4g} m from the origin, where states, which are float32, may intersect though particles keep "
                f'{separation:.3g} m; simulate nearer to the origin, or with simulation={{"precision": "float32"}}'
            )
            translate.warn([note])

    def _start(self) -> None:
        """What the last step left, and where bodies were led to: nothing moves yet."""
        self._q, self._qd, self._body_q = self._q_start, np.zeros_like(self._q_start), self._body_q_start

    def _of(self, dt: float) -> "Simulation":
        """The simulation of this time step, which goes on where the last one was."""
        if dt not in self._simulations:
            from pdipc.model import build
            from pdipc.simulation import Simulation

            scene = self._made.scene.model_copy(deep=True)
            scene.simulation.time_step = dt
            self._simulations[dt] = Simulation(build(scene, str(self.device), masses=self._masses))
        simulation = self._simulations[dt] = self._simulations.pop(dt)
        if self._now is not None and self._now is not simulation:
            simulation.restore(self._now.checkpoint())
        self._now = simulation
        if len(self._simulations) > KEPT:
            del self._simulations[next(iter(self._simulations))]
        return simulation

    def _adopt(self, simulation: "Simulation", q: np.ndarray, qd: np.ndarray) -> None:
        """A new start, where free particles are elsewhere than the last step left them, or as fast as it did not leave them."""
        free = simulation.model.free_vertices
        moved, hurried = (np.any(a != b, axis=1) for a, b in ((q, self._q), (qd, self._qd)))
        if not (moved.any() or hurried.any()):
            return
        x, v = simulation.positions, simulation.state.velocities.numpy().astype(np.float64)
        first, places, speeds = 0, {}, {}
        for part in self._made.parts:
            own = slice(first, first + len(part.particles))
            first = own.stop
            here, fast = ((changed[part.particles] & free[own])[:, None] for changed in (moved, hurried))
            if here.any():
                places[part.name] = np.where(here, q[part.particles], x[own])
            if fast.any():
                speeds[part.name] = np.where(fast, qd[part.particles], v[own])
        if places:
            simulation.set_positions_of(places)  # or raises, and nothing has changed
        for name, values in speeds.items():
            simulation.set_velocities(name, values)

    def _lead(self, simulation: "Simulation", q: np.ndarray, state: newton.State) -> None:
        """Held particles and bodies that are elsewhere than they were sent last are sent there."""
        for part in self._made.parts:
            held = part.particles[part.pinned]
            if np.any(q[held] != self._q[held]):
                simulation.set_pin(part.name, q[held].astype(np.float64), speed=AT_ONCE)
        if self._body_q is None:
            return
        body_q = _read(state, "body_q")
        for shape in self._made.shapes:
            if shape.body >= 0 and np.any(body_q[shape.body] != self._body_q[shape.body]):
                if not (np.isfinite(body_q[shape.body]).all() and np.any(body_q[shape.body][3:])):
                    raise ValueError(
                        f"state_in.body_q[{shape.body}] is {body_q[shape.body].tolist()}, which is no place and turn"
                    )
                position, turn = translate.placed(body_q[shape.body])
                simulation.set_pose(shape.name, position, turn.as_matrix(), speed=AT_ONCE)

    def _reached(self, simulation: "Simulation", body_q: np.ndarray) -> np.ndarray:
        """(b, 7) of all bodies: as told, but for those that something keeps from being there."""
        found = body_q.copy()
        for shape in self._made.shapes if self.result is not None and self.result.lag > 0.0 else ():
            if shape.body >= 0:
                position, turn = simulation.pose(shape.name)
                told, told_turn = translate.placed(body_q[shape.body])
                if np.abs(position - told).max() > HERE or np.abs(turn - told_turn.as_matrix()).max() > HERE:
                    found[shape.body] = *position, *Rotation.from_matrix(turn).as_quat()
        return found

    def _pull(self, simulation: "Simulation", state: newton.State) -> None:
        if state.particle_f is None:
            return
        forces = state.particle_f.numpy()[self._particles].astype(np.float64)
        pulled = np.flatnonzero(np.any(forces != 0.0, axis=1) & simulation.model.free_vertices[: len(forces)])
        simulation.set_vertex_force(pulled, forces[pulled])

    def _refuse_activations(self, control: newton.Control | None) -> None:
        for name in ("tri_activations", "tet_activations", "muscle_activations"):
            values = None if control is None else getattr(control, name, None)
            if values is not None and np.any(values.numpy()):
                raise Unsupported(f"control.{name} must be 0: activations are not simulated")


def _read(of: newton.State | newton.Model, name: str) -> np.ndarray:
    """An array that is there, on the host; on the CPU a view."""
    return getattr(of, name).numpy()


def _numpy(array: wp.array) -> np.ndarray:
    return array.numpy()


def _write(to: newton.State, name: str, values: np.ndarray) -> None:
    getattr(to, name).assign(values)
