"""What a user may change between steps: where obstacles, pins and bodies go, and the forces on them.

A command is approached, never jumped to: obstacles and what pins hold set out in the next step, with no vertex faster than the speed
given, by the same proven motions as if a script led them; where something is in their way they push it, or wait (`StepResult.lag`).
Commands hold until they are replaced, in place of the script of the scene. The same commands between the same steps give the same
bits, and `checkpoint` and `restore` carry them beside the state.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pdipc.bodies.rigid import torn
from pdipc.device.launch import one_at_a_time
from pdipc.integration.script import Lead
from pdipc.model import Model, State
from pdipc.scene.assembly import AssembledBody, AssembledPin
from pdipc.scene.check import LARGEST, check_placed
from pdipc.scene.motion import rotation_matrix
from pdipc.scene.movers import Mover
from pdipc.work import Work

SPEED = 1.0  # m/s


def _numbers(values: Any, shape: tuple[int, ...], what: str, largest: float = LARGEST) -> np.ndarray:
    """Values as float64 of a shape. Raises ValueError for others, and for what is not finite or too large."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} must be numbers: {error}") from None
    if array.shape != shape:
        raise ValueError(f"{what} have the shape {array.shape}; it must be {shape}")
    wrong = np.argwhere(~(np.abs(array) <= largest))
    if len(wrong):
        place = tuple(wrong[0].tolist())
        raise ValueError(f"{what}{list(place)} is {array[place]}; it must be a number of at most {largest:g}")
    return array


def _speed(speed: float) -> float:
    if not speed > 0.0:
        raise ValueError(f"speed is {speed} m/s; it must be more than 0")
    return float(speed)


def _turn(rotation: Any) -> Rotation:
    """A turn from degrees about the fixed axes x, then y, then z, or from a matrix. Raises ValueError for what is none."""
    if np.shape(rotation) == (3,):
        return Rotation.from_matrix(rotation_matrix(_numbers(rotation, (3,), "rotation", 1e6)))
    matrix = _numbers(rotation, (3, 3), "rotation", 2.0)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6 or np.linalg.det(matrix) < 0.0:
        raise ValueError("rotation is no rotation matrix: its rows must be of length 1, square to each other and right-handed")
    return Rotation.from_matrix(matrix)


class Controls:
    """The commands of a `Simulation`."""

    model: Model
    state: State
    work: Work

    # Obstacles and pins.

    @one_at_a_time
    def pose(self, obstacle: str) -> tuple[np.ndarray, np.ndarray]:
        """Where a rigid obstacle is: position (3,) m of its mesh's origin, and rotation (3, 3) of its mesh."""
        mover, body = self._rigid(obstacle)
        turn, place = self.state.reached.pose(mover)
        return place, turn.as_matrix() @ body.orientation

    @one_at_a_time
    def set_pose(self, obstacle: str, position: Any = None, rotation: Any = None, speed: float = SPEED) -> None:
        """Leads a rigid obstacle to a pose: its mesh's origin straight to `position`, turning evenly and the shortest way to `rotation`.

        position: (3,) m, as `translation` in a scene. rotation: (3,) degrees about the fixed axes x, then y, then z, as in a scene, or a matrix
        (3, 3). What is None stays as it is. speed: m/s, that no vertex of it exceeds on the way.

        Raises ValueError where there is no such obstacle, it deforms, or values are none.
        """
        mover, body = self._rigid(obstacle)
        lead = self.work.script.leads.get(mover.key)
        turn, place = self.state.reached.pose(mover) if lead is None or lead.pose is None else lead.pose
        if position is not None:
            place = _numbers(position, (3,), "position")
        if rotation is not None:
            turn = _turn(rotation) * Rotation.from_matrix(body.orientation).inv()
        self.work.lead(mover.key, Lead(_speed(speed), pose=(turn, place)))

    @one_at_a_time
    def set_vertices(self, obstacle: str, vertices: Any, speed: float = SPEED) -> None:
        """Leads the vertices of an obstacle to (n, 3) m, each straight; it deforms from now on. speed: m/s, of the fastest.

        Raises ValueError where there is no such obstacle, or vertices are of another number or no finite numbers.
        """
        mover, body = self._obstacle(obstacle)
        points = _numbers(vertices, (body.last - body.first, 3), f'vertices of obstacle "{obstacle}"')
        self.work.lead(mover.key, Lead(_speed(speed), points=points))

    @one_at_a_time
    def set_pin(self, body: str, points: Any, pin: int = 0, speed: float = SPEED) -> None:
        """Leads what a pin of a body holds to points (k, 3) m, or (3,) where it holds one vertex, each straight; in the order of
        `model.assembly.pins`, which is ascending. Where the pin has a stiffness, these are the points that its springs end at.
        pin: its place among the body's pins. speed: m/s, of the fastest.

        Raises ValueError where there is no such pin, or points are of another number or no finite numbers.
        """
        place, held = self._pin(body, pin)
        if np.shape(points) == (3,) and len(held.vertices) == 1:
            points = [points]
        points = _numbers(points, (len(held.vertices), 3), f"points of {held.where}")
        self.work.lead(-1 - place, Lead(_speed(speed), points=points))

    # Bodies.

    @one_at_a_time
    def set_positions(self, body: str, positions: Any) -> None:
        """Puts a body's vertices at (n, 3) m, as a scene would at its start; velocities stay. What is held exactly must stay.

        This is a new start, not a motion: what lies in between does not matter. Raises ValueError, and changes nothing, where the body
        would then intersect anything, be in something closed, or be nearer to anything than the minimum separation.
        """
        self.set_positions_of({body: positions})

    @one_at_a_time
    def set_positions_of(self, positions: dict[str, Any]) -> None:
        """As `set_positions` for several bodies, by name, at once: what one of them leaves is free for another."""
        assembly, precision = self.model.assembly, self.model.real.name
        still = [pair for pair, is_one in zip(assembly.quarantine, self.state.quarantined, strict=True) if is_one]
        assembly = replace(assembly, quarantine=still)  # what has parted ignores each other no more
        x = self.state.positions.numpy().copy()
        before, put = x.copy(), np.zeros(len(x), dtype=bool)
        for body, wanted in positions.items():
            which = self._body(body)
            own = slice(which.first, which.last)
            x[own], put[own] = _numbers(wanted, (which.last - which.first, 3), f'positions of body "{body}"'), True
            moved = np.abs(x[own] - before[own]).max(axis=1) > 0.0
            if len(stuck := np.flatnonzero(moved & assembly.scripted[own])):
                raise ValueError(
                    f'vertex {stuck[0]} of body "{body}" is held exactly at {before[own][stuck[0]].tolist()} m; it must stay, or be led with '
                    "set_pin"
                )
        if wrong := torn(assembly, x.astype(np.float64)):
            raise ValueError(f"bodies cannot be put there: {wrong}")
        for body in positions:
            if found := check_placed(assembly, x.astype(np.float64), precision, assembly.bodies.index(self._body(body))):
                raise ValueError("\n  ".join([f'body "{body}" cannot be put there:', *map(str, found)]))
        self.state.positions.assign(x)
        for array in (self.state.remainders, self.state.accelerations):
            values = array.numpy().copy()
            values[put] = 0.0
            array.assign(values)

    @one_at_a_time
    def set_velocities(self, body: str, velocities: Any) -> None:
        """Sets the velocities of a body's vertices, (n, 3) m/s or one (3,) for all; what is held exactly keeps its own.

        Raises ValueError where there is no such body, or velocities are of another number or no finite numbers.
        """
        which = self._body(body)
        if np.shape(velocities) == (3,):
            velocities = np.tile(velocities, (which.last - which.first, 1))
        wanted = _numbers(velocities, (which.last - which.first, 3), f'velocities of body "{body}"')
        v, own = self.state.velocities.numpy().copy(), slice(which.first, which.last)
        v[own] = np.where(self.model.free_vertices[own, None], wanted, v[own])
        if len(which.handles):  # whose motion is that of its four points
            v[which.first : which.first + which.count] = which.weights @ v[which.handles]
        self.state.velocities.assign(v)

    # Forces.

    def set_gravity(self, acceleration: Any) -> None:
        """Sets the acceleration of every body, (3,) m/s^2, from the next step on. Raises ValueError for other than three finite numbers."""
        self.work.loads.external.set_gravity(_numbers(acceleration, (3,), "gravity"))

    def set_wind(self, velocity: Any, wind: int = 0) -> None:
        """Sets the velocity of the air, (3,) m/s, of one of the scene's winds from the next step on. wind: its place among them.

        Raises ValueError where the scene has no such wind, or for other than three finite numbers.
        """
        external = self.work.loads.external
        if not 0 <= wind < len(external.winds):
            raise ValueError(f"there is no wind {wind}; the scene has {len(external.winds)}")
        winds = list(external.winds)
        winds[wind] = replace(winds[wind], velocity=_numbers(velocity, (3,), "velocity"))
        external.winds = winds

    def set_vertex_force(self, vertices: Any, forces: Any) -> None:
        """Pulls the given vertices (k,) with forces (k, 3) in newtons from the next step on, in place of earlier ones.

        Raises ValueError for vertices that are not simulated, forces that are no finite numbers, or lengths that differ.
        """
        vertices, forces = np.asarray(vertices), np.asarray(forces, dtype=np.float64)
        if vertices.size and vertices.dtype.kind not in "iu":
            raise ValueError(f"vertices are {vertices.dtype}; they must be whole numbers")
        vertices = vertices.astype(np.int64)
        if vertices.ndim != 1 or forces.shape != (len(vertices), 3):
            raise ValueError(f"{vertices.shape} vertices and {forces.shape} forces; they must be (k,) and (k, 3)")
        scripted = self.model.assembly.scripted
        if len(unknown := vertices[(vertices < 0) | (vertices >= len(scripted))]):
            raise ValueError(f"there is no vertex {unknown[0]}; vertices are 0 to {len(scripted) - 1}")
        if len(held := vertices[scripted[vertices]]):
            raise ValueError(f"vertex {held[0]} follows a script and cannot be pulled")
        if len(wrong := np.flatnonzero(~np.isfinite(forces).all(axis=1))):
            raise ValueError(f"the force on vertex {vertices[wrong[0]]} is {forces[wrong[0]].tolist()}; it must be finite")
        self.work.loads.external.pulled = (vertices, forces)

    # All of it.

    @one_at_a_time
    def checkpoint(self) -> dict[str, Any]:
        """The state and the commands that hold, as arrays by name: what `restore` goes on from, to the same bits."""
        external = self.work.loads.external
        commands = {
            "gravity": external.gravity[0].copy(),
            "winds": np.array([wind.velocity for wind in external.winds]).reshape(-1, 3),
            "pulled_vertices": external.pulled[0].copy(),
            "pulled_forces": external.pulled[1].copy(),
        }
        return {**self.state.arrays(), **commands, **self.work.script.commands()}

    @one_at_a_time
    def restore(self, arrays: dict[str, Any]) -> None:
        """Goes on from what `checkpoint` gave in a simulation of the same scene. Raises ValueError for what another scene's gave."""
        if np.shape(arrays["positions"]) != (self.model.vertex_count, 3) or len(arrays["winds"]) != len(
            self.model.external.winds
        ):
            raise ValueError(
                f"the checkpoint holds {len(arrays['positions'])} vertices; the model has {self.model.vertex_count}"
            )
        self.state = self.model.state_from(arrays)
        self.set_gravity(arrays["gravity"])
        for number, velocity in enumerate(arrays["winds"]):
            self.set_wind(velocity, number)
        self.set_vertex_force(arrays["pulled_vertices"], arrays["pulled_forces"])
        self.work.follow(self.work.script.leads_of(arrays))

    # Names.

    def _named(self, name: str, obstacle: bool) -> AssembledBody:
        bodies = self.model.assembly.bodies
        for body in bodies:
            if body.name == name and body.kinematic == obstacle:
                return body
        kind, others = ("obstacle", "obstacles") if obstacle else ("body", "bodies")
        known = ", ".join(body.name for body in bodies if body.kinematic == obstacle) or "none"
        raise ValueError(f'there is no {kind} "{name}"; {others}: {known}')

    def _body(self, name: str) -> AssembledBody:
        return self._named(name, False)

    def _obstacle(self, name: str) -> tuple[Mover, AssembledBody]:
        body = self._named(name, True)
        place = self.model.assembly.bodies.index(body)
        return next(mover for mover in self.work.script.movers if mover.body == place), body

    def _rigid(self, name: str) -> tuple[Mover, AssembledBody]:
        mover, body = self._obstacle(name)
        lead = self.work.script.leads.get(mover.key)
        if not mover.rigid or (lead is not None and lead.points is not None):
            raise ValueError(f'obstacle "{name}" deforms and has no pose; lead it with set_vertices')
        return mover, body

    def _pin(self, name: str, pin: int) -> tuple[int, AssembledPin]:
        self._body(name)
        own = [(place, each) for place, each in enumerate(self.model.assembly.pins) if each.body == name]
        if not 0 <= pin < len(own):
            raise ValueError(f'body "{name}" has no pin {pin}; it has {len(own)}')
        place, held = own[pin]
        if held.follow >= 0:
            raise ValueError(f'{held.where} moves with "{self.model.assembly.bodies[held.follow].name}"; lead that')
        return place, held
