"""Where scripted points are at a time: rigid motions relative to the start, and obstacles that deform.

**Lemma (chords).** A point x(t) that is followed in a straight line from x(a) to x(b) is nowhere further from it, at the same fraction of the
time, than (b - a)^2 / 8 sup |x''|, the error of linear interpolation. A pose moves its center in straight lines between its breaks, and
turns with |R''| <= w^2: for a constant spin w is its rate; for angles about three axes that each grow evenly the sum of their rates, since
every derivative of a product of turns takes one factor of a rate. So with n chords over a time T without a break, a point at the
distance r of the center stays within r (w T / n)^2 / 8 of its arc. Easing only changes the pace on the way, by a factor of 1.5 at most.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pdipc.scene.frames import Frames
from pdipc.scene.schema import Motion

SMOOTHEST = 1.5  # the largest slope of 3 s^2 - 2 s^3


def rotation_matrix(degrees: Sequence[float] | np.ndarray) -> np.ndarray:
    """(3, 3): turns about the fixed axes x, then y, then z."""
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


class Trajectory:
    """A rigid motion: a point x0 of the start is at x(t) = R(t) (x0 - center) + center + p(t).

    Poses are absolute functions of time: whoever lags behind makes it up in the next step.
    """

    def __init__(self, motion: Motion | None, center: np.ndarray):
        """center: (3,) m, what rotations turn about unless `motion` says otherwise."""
        self.motion = motion or Motion()
        self.center = np.asarray(center if self.motion.center is None else self.motion.center, dtype=np.float64)
        self._times = np.array([keyframe.time for keyframe in self.motion.keyframes])
        self._translations = np.array([keyframe.translation for keyframe in self.motion.keyframes])
        self._angles = np.array([keyframe.rotation for keyframe in self.motion.keyframes])
        shortest = self.motion.turns == "shortest" and len(self._angles) > 1
        self._turn = Slerp(self._times, Rotation.from_euler("xyz", self._angles, degrees=True)) if shortest else None

    is_rigid = True

    @property
    def times(self) -> list[float]:
        """s: when it is furthest away, as far as that is known: at its keyframes, or where it ends, or a second after its start."""
        m = self.motion
        return [k.time for k in m.keyframes] or [m.start + 1.0 if m.end is None else m.end]

    @property
    def is_static(self) -> bool:
        """Whether nothing ever moves away from the start."""
        m = self.motion
        moved = any(any(k.translation) or any(k.rotation) for k in m.keyframes)
        return not (moved or any(m.velocity) or any(m.angular_velocity))

    @property
    def breaks(self) -> np.ndarray:
        """(k,) s: when its velocity or its spin changes."""
        m = self.motion
        return self._times if m.keyframes else np.array([time for time in (m.start, m.end) if time is not None])

    def turning(self, first: float, last: float) -> float:
        """rad/s: the w of the lemma between two times, s, with no break in between."""
        m, middle = self.motion, 0.5 * (first + last)
        if not m.keyframes:
            inside = m.start <= middle and (m.end is None or middle <= m.end)
            return float(np.linalg.norm(m.angular_velocity)) if inside else 0.0
        after = int(np.searchsorted(self._times, middle))
        if after in (0, len(self._times)):
            return 0.0
        begin, end = self._angles[after - 1 : after + 1]
        if self._turn is None:
            angle = float(np.radians(np.abs(end - begin)).sum())
        else:
            angle = float((self._turn(self._times[after - 1]).inv() * self._turn(self._times[after])).magnitude())
        return (SMOOTHEST if m.smooth else 1.0) * angle / (self._times[after] - self._times[after - 1])

    def fastest(self) -> float:
        """rad/s: the largest of `turning`, at any time."""
        edges = np.concatenate([[-1.0], self.breaks, self.breaks[-1:] + 1.0])
        return max(self.turning(a, b) for a, b in itertools.pairwise(np.unique(edges)))

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """R (3, 3) and p (3,) m at `time` s."""
        m = self.motion
        if not m.keyframes:
            passed = max(0.0, (time if m.end is None else min(time, m.end)) - m.start)
            return Rotation.from_rotvec(passed * np.array(m.angular_velocity)).as_matrix(), passed * np.array(m.velocity)
        time = float(np.clip(time, self._times[0], self._times[-1]))
        if m.smooth and len(self._times) > 1:
            after = int(np.clip(np.searchsorted(self._times, time), 1, len(self._times) - 1))
            first, last = self._times[after - 1 : after + 1]
            part = (time - first) / (last - first)
            time = float(np.clip(first + (last - first) * part * part * (3 - 2 * part), first, last))
        p, angles = (
            np.array([np.interp(time, self._times, column) for column in table.T])
            for table in (self._translations, self._angles)
        )
        return rotation_matrix(angles) if self._turn is None else self._turn(time).as_matrix(), p

    def apply(self, points: np.ndarray, time: float) -> np.ndarray:
        """(n, 3) points of the start, m, at `time` s."""
        rotation, p = self.pose(time)
        if np.array_equal(rotation, np.eye(3)):  # what stands still does to the bit
            return points + p
        return (points - self.center) @ rotation.T + (self.center + p)


class Deforming:
    """All vertices of an obstacle over time: on straight lines from frame to frame, then placed as the obstacle is."""

    is_rigid = False

    @property
    def times(self) -> list[float]:
        """s: when its frames are there; it is nowhere further away in between."""
        return (self.frames.times + self.begin).tolist()

    def __init__(self, frames: Frames, begin: float, matrix: np.ndarray, translation: Sequence[float]):
        """begin: when the first frame is there, s. A vertex of the cache is at matrix (3, 3) vertex + translation (3,), m."""
        self.frames, self.begin, self.matrix, self.translation = frames, begin, matrix, translation

    @property
    def breaks(self) -> np.ndarray:
        """(k,) s: when its vertices change their directions: at its frames."""
        return self.frames.times + self.begin

    @property
    def is_static(self) -> bool:
        """Whether all frames are alike."""
        points = self.frames.points
        return all(np.array_equal(points[0], frame) for frame in points[1:])

    def apply(self, points: np.ndarray | None, time: float) -> np.ndarray:
        """(n, 3) vertices, m, at `time` s. points: (n, 3) of the start, which says nothing more."""
        times = self.frames.times
        time = float(np.clip(time - self.begin, 0.0, times[-1]))
        after = int(np.clip(np.searchsorted(times, time), 1, max(1, len(times) - 1)))
        first, last = self.frames.points[after - 1].astype(np.float64), self.frames.points[min(after, len(times) - 1)]
        part = (time - times[after - 1]) / (times[after] - times[after - 1]) if len(times) > 1 else 0.0
        return (first + part * (last - first)) @ self.matrix.T + self.translation


def pulled_back(x: np.ndarray, rotation: np.ndarray, place: np.ndarray, center: np.ndarray) -> np.ndarray:
    """(k, 3) m: the points of the start that a pose has at x (k, 3); place: where the pose has `center`, both (3,) m."""
    return (x - place) @ rotation + center


@dataclass(frozen=True)
class Glue:
    """Points that move with a surface: from the point of weights (k, 3) of the triangles (k, 3), vertices of the surface, by offsets
    (k, 3) m along the first edge, across it, and along the normal.
    """

    triangles: np.ndarray
    weights: np.ndarray
    offsets: np.ndarray

    @classmethod
    def at(cls, x: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, weights: np.ndarray) -> "Glue":
        """x: (k, 3) m, where the points are while the vertices (n, 3) of the surface are there."""
        away = x - np.einsum("ek,ekd->ed", weights, vertices[triangles])
        return cls(triangles, weights, np.einsum("eij,ej->ei", _frames(vertices[triangles]), away))

    def apply(self, vertices: np.ndarray) -> np.ndarray:
        """(k, 3) m: where the points are when the vertices (n, 3) are there."""
        corners = vertices[self.triangles]
        return np.einsum("ek,ekd->ed", self.weights, corners) + np.einsum("eij,ei->ej", _frames(corners), self.offsets)


def _frames(corners: np.ndarray) -> np.ndarray:
    """(k, 3, 3): of triangles (k, 3, 3), the direction of the first edge, the one across it and the normal as rows."""
    along = corners[:, 1] - corners[:, 0]
    normal = np.cross(along, corners[:, 2] - corners[:, 0])
    along, normal = (v / np.maximum(np.linalg.norm(v, axis=1), 1e-300)[:, None] for v in (along, normal))
    return np.stack([along, np.cross(normal, along), normal], axis=1)


class Approach:
    """The way from one pose to another: the origin goes straight, the turn is the shortest and even. Its time runs from 0 to 1."""

    is_rigid = True
    breaks = np.zeros(0)

    def __init__(self, origin: np.ndarray, begin: tuple[Rotation, np.ndarray], end: tuple[Rotation, np.ndarray]):
        """origin: (3,) m, at the start. begin, end: turns about it from the start, and where it is, (3,) m."""
        self.center, self.begin, self.end = origin, begin, end
        self.turn = begin[0].inv() * end[0]

    def turning(self, first: float, last: float) -> float:
        """rad on the whole way."""
        return float(self.turn.magnitude())

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """R (3, 3) and p (3,) m, as `Trajectory.pose`."""
        if time == 1.0:
            return self.end[0].as_matrix(), self.end[1] - self.center
        rotation = self.begin[0] * Rotation.from_rotvec(time * self.turn.as_rotvec())
        return rotation.as_matrix(), self.begin[1] + time * (self.end[1] - self.begin[1]) - self.center

    apply = Trajectory.apply
