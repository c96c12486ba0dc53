"""External forces f_ext of Eq. (1), as accelerations: gravity, wind on surfaces, forces on vertices.

Drag is taken at the start of a step, and would throw a light surface past the air where wind is strong or the step long. A
triangle's drag is g (u.n) n with g = air_density / 2 drag |u.n| area, u the air's velocity past it. With F the sum of the thirds
of it at a vertex, and G that of g, the vertex accelerates by

    a = F / max(m, m / 2 + h G).

Up to h G = m / 2 that is F / m. There the speed past a free plate that the wind meets head-on, |u| (1 - h G / m) after a step, would
begin to fall with growing |u|; beyond, it tends to a limit, and never changes sign. No step takes the velocities of any surface
further from that of the air, in the norm of max(m, m / 2 + h G): drag is linear in u with the matrix of g n n^T of the mean of
three corners, summed over triangles, which as a diagonal matrix G bounds. F / (m + h G) would be exact for the free plate, but
weaken the drag on a sail that is held in any wind.
"""

import copy
import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.device.language import kernel
from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.scene.assembly import AssembledForce, AssembledWind, Assembly


def wind_drag(wind: AssembledWind, positions: np.ndarray, velocities: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Drag on each triangle, g (u.n) n with g = air_density / 2 drag |u.n| area and u the air's velocity past it, a third to
    each of its vertices: F (n, 3) N and G (n,) kg/s.
    """
    force, rate = np.zeros_like(positions), np.zeros(len(positions))
    if not wind.start <= time < wind.end:
        return force, rate
    corners = positions[wind.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(double_area, 1e-300)[:, None]
    past = wind.velocity - velocities[wind.triangles].mean(axis=1)
    across = np.einsum("ij,ij->i", past, normal)
    third = 0.25 * wind.air_density * wind.drag * np.abs(across) * double_area / 3.0
    for corner in range(3):
        np.add.at(force, wind.triangles[:, corner], (third * across)[:, None] * normal)
        np.add.at(rate, wind.triangles[:, corner], third)
    return force, rate


def vertex_force(force: AssembledForce, count: int, time: float) -> np.ndarray:
    """(n, 3) N: the same force on each chosen vertex within its window of time."""
    total = np.zeros((count, 3))
    if force.start <= time < force.end:
        total[force.vertices] += force.force
    return total


class ExternalForces:
    """All external forces of an assembly. gravity: (3,) m/s^2; mass: (n,) kg, 0 for kinematic vertices; h: length of a step, s.

    winds: those of the assembly, whose velocities may be others. pulled: vertices (k,) and forces (k, 3) N that a user applies by hand.
    To change one between steps, replace it: what is replaced is uploaded.
    """

    def __init__(self, assembly: Assembly, gravity: np.ndarray, mass: np.ndarray, h: float):
        self.assembly, self.mass, self.h = assembly, mass, h
        self.set_gravity(gravity)
        self.winds = assembly.winds
        self.pulled: tuple[np.ndarray, np.ndarray] = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))

    def set_gravity(self, acceleration: np.ndarray) -> None:
        """acceleration: (3,) m/s^2, of every body."""
        self.gravity = np.tile(np.asarray(acceleration, dtype=np.float64), (len(self.mass), 1))

    def acting(self, time: float) -> list[int]:
        """Which of the forces on vertices act at `time`."""
        return [k for k, force in enumerate(self.assembly.forces) if force.start <= time < force.end]

    def steady(self, time: float) -> np.ndarray:
        """(n, 3) m/s^2 without wind: what does not depend on where the vertices are."""
        force = np.zeros_like(self.gravity)
        for each in self.assembly.forces:
            force += vertex_force(each, len(force), time)
        vertices, pull = self.pulled
        np.add.at(force, vertices, pull)
        for body in self.assembly.bodies:
            if len(body.handles):  # what pulls at a rigid body pulls at the points that it moves as
                own = slice(body.first, body.first + body.count)
                force[body.handles] += body.weights.T @ force[own]
                force[own] = 0.0
        return self.gravity + force / self.inertia[:, None]

    def accelerations(self, time: float, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """(n, 3) m/s^2 for a step from the given state, time in s."""
        force, rate = np.zeros_like(self.gravity), np.zeros(len(self.mass))
        for wind in self.winds:
            each, its_rate = wind_drag(wind, positions, velocities, time)
            force += each
            rate += its_rate
        return self.steady(time) + force / np.maximum(self.inertia, 0.5 * self.inertia + self.h * rate)[:, None]

    @property
    def inertia(self) -> np.ndarray:
        """(n,) kg: mass, and inf for kinematic vertices, which no force moves."""
        return np.where(self.mass > 0.0, self.mass, np.inf)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """`wind_drag`, gathered by vertex so that sums keep their order."""
    scalar, vec3 = real.scalar, real.vec3
    module = real.module(__name__)

    @kernel(module)
    def drag(
        first: int,
        time: wp.float64,
        triangles: wp.array(dtype=wp.vec3i),
        windows: wp.array(dtype=wp.vec2d),
        air: wp.array(dtype=vec3),
        factor: wp.array(dtype=scalar),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        force_out: wp.array(dtype=vec3),
        rate_out: wp.array(dtype=scalar),
    ):
        """A third of the drag on each triangle: its rate g = factor |u.n| (double area), and g (u.n) n."""
        t = first + wp.tid()
        force = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        rate = scalar(0.0)
        if windows[t][0] <= time and time < windows[t][1]:
            q = triangles[t]
            normal = wp.cross(x[q[1]] - x[q[0]], x[q[2]] - x[q[0]])
            double_area = wp.length(normal)
            if double_area > scalar(0.0):
                normal = normal / double_area
                past = air[t] - (v[q[0]] + v[q[1]] + v[q[2]]) / scalar(3.0)
                across = wp.dot(past, normal)
                rate = factor[t] * wp.abs(across) * double_area
                force = rate * across * normal
        force_out[t] = force
        rate_out[t] = rate

    @kernel(module)
    def gather(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        third: wp.array(dtype=vec3),
        rate: wp.array(dtype=scalar),
        inertia: wp.array(dtype=scalar),
        h: scalar,
        steady: wp.array(dtype=vec3),
        acceleration_out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        force = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        total_rate = scalar(0.0)
        for k in range(starts[i], starts[i + 1]):
            force += third[members[k]]
            total_rate += rate[members[k]]
        acceleration_out[i] = steady[i] + force / wp.max(inertia[i], scalar(0.5) * inertia[i] + h * total_rate)

    return SimpleNamespace(drag=drag, gather=gather)


class Loads:
    """External accelerations on the device: wind is computed there, the rest uploaded when a force begins, ends or is replaced.

    acceleration: (n,) vec3, m/s^2, after `update`.
    """

    def __init__(self, device: Device, real: Real, external: ExternalForces):
        self.device, self.real, self._kernels = device, real, kernels(real)
        self._scene = external
        self.external = copy.copy(external)  # what a user changes here is not changed for others
        n, winds = len(external.mass), external.winds
        self.acceleration = wp.zeros(n, dtype=real.vec3, device=device.warp)
        self._uploaded: tuple | None = None
        self._blows = winds
        self._count = sum(len(wind.triangles) for wind in winds)
        self._steady = self.acceleration
        if not self._count:
            return

        def upload(values: np.ndarray, dtype) -> wp.array:
            return wp.array(values, dtype=dtype, device=device.warp)

        self._sizes = sizes = [len(wind.triangles) for wind in winds]
        triangles = np.concatenate([wind.triangles for wind in winds]).astype(np.int32)
        windows = np.repeat([[wind.start, wind.end] for wind in winds], sizes, axis=0)
        air = np.repeat([wind.velocity for wind in winds], sizes, axis=0)
        factor = np.repeat([0.25 * wind.air_density * wind.drag / 3.0 for wind in winds], sizes)
        corner = triangles.ravel()
        order = np.argsort(corner, kind="stable")
        starts = np.searchsorted(corner[order], np.arange(n + 1))
        self._steady = wp.zeros_like(self.acceleration)
        self._drag = [wp.zeros(self._count, dtype=dtype, device=device.warp) for dtype in (real.vec3, real.scalar)]
        self._triangles = [upload(triangles, wp.vec3i), upload(windows, wp.vec2d), upload(air.astype(real.numpy), real.vec3)]
        self._triangles.append(upload(factor.astype(real.numpy), real.scalar))
        self._incident = [upload(starts.astype(np.int32), wp.int32), upload((order // 3).astype(np.int32), wp.int32)]
        self._inertia = upload(external.inertia.astype(real.numpy), real.scalar)

    def take_over(self, other: "Loads") -> None:
        """What a user changed there holds here, too."""
        for name in ("gravity", "winds", "pulled"):
            setattr(self.external, name, getattr(other.external, name))

    def reset(self) -> None:
        """Back to what the scene says."""
        self.external = copy.copy(self._scene)

    def update(self, time: float, x: wp.array, v: wp.array) -> None:
        """Launches the accelerations at positions x and velocities v, (n,) vec3, at `time`, s."""
        external = self.external
        acting = external.acting(time)
        last = self._uploaded
        if last is None or last[0] != acting or last[1] is not external.pulled or last[2] is not external.gravity:
            self._steady.assign(external.steady(time).astype(self.real.numpy))
            self._uploaded = acting, external.pulled, external.gravity
        if self._blows is not external.winds:
            air = np.repeat([wind.velocity for wind in external.winds], self._sizes, axis=0)
            self._triangles[2].assign(air.astype(self.real.numpy))
            self._blows = external.winds
        if self._count:
            inputs = [wp.float64(time), *self._triangles, x, v, *self._drag]
            self.device.launch(self._kernels.drag, self._count, inputs, grain=16)
            h = self.real.scalar(external.h)
            inputs = [*self._incident, *self._drag, self._inertia, h, self._steady, self.acceleration]
            self.device.launch(self._kernels.gather, len(x), inputs, grain=8)
