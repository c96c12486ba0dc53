"""What moves as told: obstacles, and the vertices that pins hold exactly; and into how many chords their turns are cut."""

import functools
from dataclasses import dataclass, field

import numpy as np

from pdipc.scene.assembly import AssembledPin, Assembly
from pdipc.scene.motion import Approach, Deforming, Trajectory

CHORD = 0.2  # of the least separation of an obstacle's pairs: how far its chords may be from their arcs (`integration.script`)
MOST = 4096  # chords of a step, and corners


@dataclass
class Mover:
    """Vertices (k,) that a script or a command leads together: an obstacle, or what a pin holds exactly.

    points: (k, 3) m, where they are when their trajectory has not moved them. body: which obstacle, pin: which pin, -1 for none.
    Vertices of pins that follow an obstacle come after its own; glued: these pins.
    deviation: m, of chords. origin: (3,) m, where the mesh's origin is at the start.
    """

    label: str
    vertices: np.ndarray
    points: np.ndarray
    trajectory: Trajectory | Deforming
    body: int
    pin: int
    deviation: float
    origin: np.ndarray
    glued: list[AssembledPin] = field(default_factory=list)

    @property
    def key(self) -> int:
        """What tells it from others: the number of its body, or of its pin, counted down from -1."""
        return self.body if self.body >= 0 else -1 - self.pin

    def place(self, time: float) -> np.ndarray:
        """(k, 3) m: where its script has it at `time`, s."""
        if isinstance(self.trajectory, Deforming):
            return self.with_glued(self.trajectory.apply(None, time))
        return self.trajectory.apply(self.points, time)

    def with_glued(self, vertices: np.ndarray) -> np.ndarray:
        """(k, 3) m: an obstacle that deforms to `vertices` (n, 3), and what is glued to it."""
        return np.concatenate([vertices, *(pin.glue.apply(vertices) for pin in self.glued if pin.glue is not None)])

    @functools.cached_property
    def still(self) -> bool:
        """Whether its script never moves it."""
        return self.trajectory.is_static

    @property
    def rigid(self) -> bool:
        """Whether it is an obstacle that does not deform."""
        return self.body >= 0 and self.trajectory.is_rigid

    def reach(self, path: Trajectory | Approach) -> float:
        """m: of the farthest point from the center of the path's turns."""
        return float(np.linalg.norm(self.points - path.center, axis=1).max(initial=0.0))

    def chords(self, path: Trajectory | Deforming | Approach, first: float, last: float) -> int:
        """How many chords a turn between two times needs, with no break in between (`scene.motion`)."""
        if isinstance(path, Deforming):
            return 1
        angle = (last - first) * path.turning(first, last)
        return max(1, int(np.ceil(angle * np.sqrt(self.reach(path) / (8.0 * self.deviation)))))


def movers_of(assembly: Assembly) -> list[Mover]:
    """The obstacles, then the pins that hold exactly and follow none."""
    thinnest = min(body.half_separation for body in assembly.bodies if not body.kinematic)
    found = []
    for number, body in enumerate(assembly.bodies):
        if body.trajectory is not None:
            glued = [pin for pin in assembly.pins if pin.exact and pin.follow == number]
            own = np.arange(body.first, body.last)
            vertices = np.concatenate([own, *(pin.vertices for pin in glued)])
            points = np.concatenate([assembly.positions[own], *(pin.points for pin in glued)])
            deviation = CHORD * (body.half_separation + thinnest)
            label = f'obstacle "{body.name}"'
            found.append(Mover(label, vertices, points, body.trajectory, number, -1, deviation, body.origin, glued))
    for number, pin in enumerate(assembly.pins):
        if pin.exact and pin.follow < 0:
            deviation = assembly.activation_distance
            found.append(Mover(pin.label, pin.vertices, pin.points, pin.trajectory, -1, number, deviation, np.zeros(3)))
    return found


def most_chords(mover: Mover, h: float) -> float:
    """The most chords that a step of h, s, may need, without a break; what is not finite is refused for other reasons."""
    if not isinstance(mover.trajectory, Trajectory) or not len(mover.vertices):
        return 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        needed = np.ceil(h * mover.trajectory.fastest() * np.sqrt(mover.reach(mover.trajectory) / (8.0 * mover.deviation)))
    return max(1.0, float(needed)) if np.isfinite(mover.points).all() else 1.0


def most_corners(mover: Mover, h: float) -> int:
    """The most corners of its way, keyframes or frames, within any step of h, s."""
    times = np.sort(mover.trajectory.breaks)
    return int((np.searchsorted(times, times + h) - np.arange(len(times))).max(initial=0))
