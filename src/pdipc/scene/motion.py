"""Where scripted points are at a time: rigid motions relative to the start."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pdipc.scene.schema import Motion


def rotation_matrix(degrees: Sequence[float]) -> np.ndarray:
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

    @property
    def is_static(self) -> bool:
        """Whether nothing ever moves away from the start."""
        m = self.motion
        moved = any(any(k.translation) or any(k.rotation) for k in m.keyframes)
        return not (moved or any(m.velocity) or any(m.angular_velocity))

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
        return (points - self.center) @ rotation.T + (self.center + p)
