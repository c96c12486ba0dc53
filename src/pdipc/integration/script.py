"""What follows a script or a command: the way of a step, from waypoint to waypoint, and how far it has come.

Vertices move in straight lines from one outer iteration to the next, and CCD proves these. What turns moves on arcs, so it is led
from waypoint to waypoint, poses on its way that are so near that no chord is further than `deviation` from the arc (`scene.motion`).

**Lemma (arcs).** Let s be the deviation of an obstacle's chords, and e how far its vertices are from its pose at the fraction of the way that
it has come. In a motion by a part f of what is left to the next waypoint e becomes at most (1 - f) e + 4 f (1 - f) s: the first is what a
straight line leaves of e, the second how far a parabola of sagitta s is from its own chord at f. If e <= 4 s that is at most 4 s (1 -
f^2), so e <= 4 s for ever, wherever the obstacle was stopped. With s = CHORD xi, CHORD = 0.2, and CCD keeping the separation xi to the chords, the
true arcs keep a fifth of xi: nothing is passed by what turns, however fast. Rounding: an obstacle's vertices share one fraction, and a
minimum separation is a hundred roundings at least.

Vertices of a pin turn about each other, not past an obstacle's arcs: they are on their own, and their chords may deviate by the
activation distance.

Who waits: a mover that was stopped goes on in every second outer iteration, so that the others make way in between, as long as no pair of it
is squeezed (nor does it set out in a step that starts so), and no body that it would push on is held back (`nonlinear.newton`) or was just stopped as a whole, and for at most TRIES times from
one waypoint to the next; then it is late. Nor does it go on once PATIENCE of all outer iterations that a step may have are over since something came to a
waypoint: the rest is for what is squeezed to come to rest, so that the step converges for where the mover stands. It follows its script from where it was
stopped, by no other way, at CATCH_UP times the script's pace, so that nothing is shot away when the way is free again. Where the script itself has come
back to the pose that it was stopped in, it goes on from there (`returned`): a way that cannot be gone, such as into another obstacle with a cloth in
between, does not hold it for ever.
"""

import functools
import itertools
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from pdipc.device.language import filled, kernel, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.integration import status
from pdipc.scene.assembly import Assembly
from pdipc.scene.motion import Approach, Deforming, Trajectory
from pdipc.scene.movers import MOST, Mover, movers_of

CATCH_UP = 2.0  # times the script's pace
LOOKS = 4  # times in a step at which a late mover looks whether its script has come back
TRIES = 24  # outer iterations in which a mover goes on to one waypoint
PATIENCE, MOST_PATIENCE = 0.7, 70.0  # of the cap of outer iterations, and outer iterations
AHEAD, ARRIVED, WILL = (wp.constant(place) for place in range(3))  # flags, see `Script`


@functools.cache
def ways(real: Real) -> Any:
    """A struct: the waypoints of all movers in a step. Those of mover m are `offset[m]` to `offset[m] + count[m] - 1`."""
    return struct_of(
        "Ways",
        __name__,
        count=wp.array(dtype=wp.int32),
        offset=wp.array(dtype=wp.int32),
        straight=wp.array(dtype=wp.int32),  # whether it goes straight from one to the next, and does not turn
        center=wp.array(dtype=wp.vec3d),  # what it turns about, at the start, m
        turns=wp.array(dtype=wp.mat33d),  # of each waypoint: the turn from the start,
        places=wp.array(dtype=wp.vec3d),  # where the center is, m,
        parts=wp.array(
            dtype=wp.float64
        ),  # or how far along a way that bends: the piece's number and, after the point, how much of it
        bends=wp.array(dtype=wp.int32),  # of each mover: corners of its way
        bend_offset=wp.array(dtype=wp.int32),
        size=wp.array(dtype=wp.int32),  # members
        corners=wp.array(dtype=real.vec3),  # where each member is at each corner, m
        goal=wp.array(dtype=real.vec3),  # of each vertex, m, where the way ends
    )


@functools.cache
def led(real: Real) -> Any:
    """A struct: the vertices as displaced so far, and where those go that follow a script."""
    return struct_of(
        "Led",
        __name__,
        base=wp.array(dtype=real.vec3),  # m, where the step starts
        u=wp.array(dtype=real.vec3),  # m, displacement from there
        free=wp.array(dtype=real.scalar),
        target=wp.array(dtype=real.vec3),  # m
        mover=wp.array(dtype=wp.int32),  # of each vertex, -1 for none
        drive=wp.array(dtype=wp.int32),  # of each mover, whether it goes on in this outer iteration
    )


@functools.cache
def march(real: Real) -> Any:
    """A struct: how far each mover is on its way; see `Script`."""
    return struct_of(
        "March",
        __name__,
        at=wp.array(dtype=wp.int32),  # number of the waypoint that it goes to, from 1
        left=wp.array(dtype=real.scalar),  # part of the way there that is left
        tries=wp.array(dtype=wp.int32),  # outer iterations that it went on in since the last
        drive=wp.array(dtype=wp.int32),
        crowded=wp.array(dtype=wp.int32),
        behind=wp.array(dtype=wp.int32),  # whether it has not come there
    )


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Ways, March = real.scalar, real.vec3, ways(real), march(real)
    module = real.module(__name__)
    zero = wp.constant(scalar(0.0))

    @kernel(module)
    def begin(first: int, march_out: March):
        m = first + wp.tid()
        march_out.at[m] = 1
        march_out.left[m] = scalar(1.0)
        march_out.tries[m] = 1
        march_out.drive[m] = 1
        march_out.crowded[m] = 0

    @kernel(module)
    def aim(
        first: int,
        members: wp.array(dtype=wp.int32),
        mover: wp.array(dtype=wp.int32),
        points: wp.array(dtype=wp.vec3d),
        at: wp.array(dtype=wp.int32),
        ways: Ways,
        x_start: wp.array(dtype=vec3),
        target_out: wp.array(dtype=vec3),
    ):
        """The waypoint that each member goes to now: on an arc, or on the pieces from corner to corner of a way that bends."""
        k = first + wp.tid()
        i = members[k]
        m = mover[i]
        slot = ways.offset[m] + at[m] - 1
        target_out[i] = ways.goal[i]
        if at[m] < ways.count[m]:
            if ways.straight[m] != 0:
                piece = int(wp.floor(ways.parts[slot]))
                a = x_start[i]
                b = ways.goal[i]
                if piece > 0:
                    a = ways.corners[ways.bend_offset[m] + (piece - 1) * ways.size[m] + k]
                if piece < ways.bends[m]:
                    b = ways.corners[ways.bend_offset[m] + piece * ways.size[m] + k]
                target_out[i] = a + scalar(ways.parts[slot] - wp.float64(piece)) * (b - a)
            else:
                x = ways.turns[slot] * (points[k] - ways.center[m]) + ways.places[slot]
                target_out[i] = vec3(scalar(x[0]), scalar(x[1]), scalar(x[2]))

    @kernel(module)
    def clear(first: int, behind_out: wp.array(dtype=wp.int32)):
        behind_out[first + wp.tid()] = 0

    @kernel(module)
    def compare(
        first: int,
        members: wp.array(dtype=wp.int32),
        mover: wp.array(dtype=wp.int32),
        base: wp.array(dtype=vec3),
        target: wp.array(dtype=vec3),
        u: wp.array(dtype=vec3),
        behind_out: wp.array(dtype=wp.int32),
    ):
        """Whether a mover has not reached its waypoint; whoever writes, writes the same."""
        i = members[first + wp.tid()]
        if wp.length_sq((target[i] - base[i]) - u[i]) > zero:
            behind_out[mover[i]] = 1

    @kernel(module)
    def hold(first: int, crowded: wp.array(dtype=wp.int32), drive_out: wp.array(dtype=wp.int32)):
        m = first + wp.tid()
        if crowded[m] != 0:
            drive_out[m] = 0

    @kernel(module)
    def advance(
        first: int,
        movers: int,
        leaders: wp.array(dtype=wp.int32),
        fraction: wp.array(dtype=scalar),
        progress: wp.array(dtype=wp.int32),
        patience: int,
        count: wp.array(dtype=wp.int32),
        o: March,
        flags_out: wp.array(dtype=wp.int32),
        chords_out: wp.array(dtype=wp.int32),
    ):
        """Who goes on in the next outer iteration, and where to. progress: the `count` of the step; patience: outer iterations."""
        for k in range(3):
            flags_out[k] = 0
        for m in range(movers):
            may = o.crowded[m] == 0 and o.tries[m] < TRIES and progress[status.SINCE] < patience
            goes = int(0)
            under_way = int(1)
            if o.behind[m] == 0:
                o.left[m] = zero
                under_way = 0
                if o.at[m] < count[m]:
                    o.at[m] = o.at[m] + 1
                    o.left[m] = scalar(1.0)
                    o.tries[m] = 0
                    under_way = 1
                    flags_out[ARRIVED] = 1
                    if o.crowded[m] == 0:
                        goes = 1
            elif o.drive[m] != 0:
                o.left[m] = o.left[m] * (scalar(1.0) - fraction[leaders[m]])
            elif may:
                goes = 1
            if under_way != 0:
                flags_out[AHEAD] = 1
                if goes != 0 or may:
                    flags_out[WILL] = 1
            o.drive[m] = goes
            o.tries[m] = o.tries[m] + goes
            o.behind[m] = 0  # for the next time
            chords_out[0] = wp.max(chords_out[0], o.at[m])

    return SimpleNamespace(begin=begin, aim=aim, clear=clear, compare=compare, hold=hold, advance=advance)


@dataclass
class Way:
    """The way of a mover in a step. times: (k,), of its waypoints, ascending in the path's own time; start: where in it the step starts."""

    path: Trajectory | Deforming | Approach | None
    start: float
    times: np.ndarray


@dataclass
class Lead:
    """A command in place of a script. speed: m/s, of its fastest vertex at most.

    points: (k, 3) m, where its vertices are to go; or pose, the turn of an obstacle from its start and the place of its origin, (3,) m.
    """

    speed: float
    points: np.ndarray | None = None
    pose: tuple[Rotation, np.ndarray] | None = None


@dataclass
class Reached:
    """How far movers that are rigid have come; what is late goes on from here.

    times: (bodies,) s, in its script; of bodies, and of what follows none, the time of the state. poses: (bodies, 7), the turn from the start as a
    quaternion x, y, z, w and the place of the origin, m, of what is led by a command; else 0. anchors: (k, 3) m, the points that the springs of
    pins end at, pin by pin, also of those that do not hold now. caught: by which points pins that began later hold, arrays by name (`phases`).
    """

    times: np.ndarray
    poses: np.ndarray
    anchors: np.ndarray
    caught: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def at(cls, time: float, assembly: Assembly) -> "Reached":
        """Everybody in time."""
        bodies = len(assembly.bodies)
        anchors = [assembly.pin_targets(assembly.pins[pin], time) for pin in rows_of_anchors(assembly)]
        return cls(np.full(bodies, time), np.zeros((bodies, 7)), np.concatenate([np.zeros((0, 3)), *anchors]))

    def copy(self) -> "Reached":
        """An independent copy."""
        return Reached(self.times.copy(), self.poses.copy(), self.anchors.copy(), dict(self.caught))

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it by name, as in a checkpoint."""
        own = {f"reached_{name}": getattr(self, name).copy() for name in ("times", "poses", "anchors")}
        return own | {f"caught_{name}": values.copy() for name, values in self.caught.items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> "Reached":
        """What `arrays` gave, from among others."""
        caught = {
            name.removeprefix("caught_"): np.array(values) for name, values in arrays.items() if name.startswith("caught_")
        }
        times, poses, anchors = (np.array(arrays[f"reached_{name}"]) for name in ("times", "poses", "anchors"))
        return cls(times, poses, anchors, caught)

    def pose(self, mover: Mover) -> tuple[Rotation, np.ndarray]:
        """Turn from the start, and place of the origin, (3,) m."""
        row = self.poses[mover.body]
        if row.any():
            return Rotation.from_quat(row[:4]), row[4:].copy()
        path = mover.trajectory
        assert isinstance(path, Trajectory)
        rotation, p = path.pose(self.times[mover.body])
        return Rotation.from_matrix(rotation), rotation @ (mover.origin - path.center) + path.center + p


def rows_of_anchors(assembly: Assembly) -> dict[int, slice]:
    """The pins that hold by springs to points, at some time, in the order of `Projector.anchors`, and their rows in `Reached.anchors`."""
    rows, end = {}, 0
    for number, pin in enumerate(assembly.pins):
        if pin.stiffness is not None and pin.follow < 0:
            rows[number] = slice(end, end + len(pin.vertices))
            end += len(pin.vertices)
    return rows


class Script:
    """The movers of a simulation, and what leads them.

    leads: commands, by the key of a mover, or -1 less the number of a pin that holds by springs. anchors: (k, 3) m, where those end; to_points,
    on_rails: (k,) bool, which hold now along all axes, and along some.

    target: (n,) vec3, m, where each scripted vertex goes in this outer iteration; goal: in this step. mover: (n,) int32, -1 for none.
    drive, crowded: (movers,) int32, who goes on in this outer iteration, and who has a pair that is squeezed. flags: (3,) int32, whether
    anybody is not at its goal, has come to a waypoint in this outer iteration, or is to go on in a later one. chords: (1,) int32.
    moves: whether anything leaves its place. generation: grows when that changes.
    """

    def __init__(self, assembly: Assembly, device: Device, real: Real, h: float, max_outer: int):
        self.assembly, self.device, self.real, self.h, self.kernels = assembly, device, real, h, kernels(real)
        self.movers, self.generation, self.patience = movers_of(assembly), 0, int(min(PATIENCE * max_outer, MOST_PATIENCE))
        self.leads: dict[int, Lead] = {}
        self.soft = rows_of_anchors(assembly)
        self.anchors: np.ndarray | None = None
        held = [np.full(len(assembly.pins[pin].vertices), assembly.pins[pin].active) for pin in self.soft]
        whole = [np.full(len(assembly.pins[pin].vertices), assembly.pins[pin].axes.all()) for pin in self.soft]
        held, whole = (np.concatenate([np.zeros(0, dtype=bool), *parts]) for parts in (held, whole))
        self.to_points, self.on_rails = held & whole, held & ~whole
        self._ways: list[Way] = []
        n, count = len(assembly.positions), max(1, len(self.movers))

        def zeros(dtype, size=count) -> wp.array:
            return wp.zeros(size, dtype=dtype, device=device.warp)

        def upload(values, dtype) -> wp.array:
            return wp.array(values, dtype=dtype, device=device.warp)

        self.goal, self.target = zeros(real.vec3, n), zeros(real.vec3, n)
        self.at, self.tries, self.drive, self.crowded, self.behind = (zeros(wp.int32) for _ in range(5))
        self.left, self.flags, self.chords = zeros(real.scalar), zeros(wp.int32, 3), zeros(wp.int32, 1)
        self.march = filled(march(real), self)
        self.count, self.offset, self.straight, self.bends, self.bend_offset = (zeros(wp.int32) for _ in range(5))
        self.center = zeros(wp.vec3d)
        owner = np.full(n, -1, dtype=np.int32)
        for number, mover in enumerate(self.movers):
            owner[mover.vertices] = number
        members = np.concatenate([np.zeros(0, dtype=np.int32), *(mover.vertices for mover in self.movers)]).astype(np.int32)
        points = np.concatenate([np.zeros((0, 3)), *(mover.points for mover in self.movers)])
        self.member_count = len(members)
        self.mover, self.members = upload(owner, wp.int32), upload(np.append(members, 0).astype(np.int32), wp.int32)
        self.points = upload(np.append(points, np.zeros((1, 3)), axis=0), wp.vec3d)
        self.leaders = upload(np.array([mover.vertices[0] for mover in self.movers] or [0], dtype=np.int32), wp.int32)
        sizes = [len(mover.vertices) for mover in self.movers]
        self.size, self._first = upload(np.array(sizes or [0], dtype=np.int32), wp.int32), np.cumsum([0, *sizes])
        self._where = assembly.positions.copy()  # the goal on the host
        self._uploaded = False
        self.corners = zeros(real.vec3, 1)
        self._room(16)

    def _room(self, size: int) -> None:
        self.turns, self.places, self.parts = (
            wp.zeros(size, dtype=dtype, device=self.device.warp) for dtype in (wp.mat33d, wp.vec3d, wp.float64)
        )
        self.generation += 1

    @property
    def moves(self) -> bool:
        """Whether anything leaves its place."""
        return any(mover.key in self.leads or not mover.still for mover in self.movers)

    def follow(self, leads: dict[int, Lead]) -> None:
        """These commands, and no others: what followed one goes back to its script, also where that never moves it."""
        self.leads, self._uploaded = leads, False

    def commands(self) -> dict[str, np.ndarray]:
        """The commands as arrays by name; see `leads_of`."""
        arrays = {
            "lead_numbers": np.array(list(self.leads), dtype=np.int64),
            "lead_speeds": np.array([lead.speed for lead in self.leads.values()], dtype=np.float64),
        }
        for number, lead in self.leads.items():
            if lead.points is not None:
                arrays[f"lead_{number}_points"] = lead.points
            elif lead.pose is not None:
                arrays[f"lead_{number}_pose"] = np.concatenate([lead.pose[0].as_quat(), lead.pose[1]])
        return arrays

    def leads_of(self, arrays: dict[str, np.ndarray]) -> dict[int, Lead]:
        """The commands that `commands` gave."""
        leads = {}
        for number, speed in zip(arrays["lead_numbers"].tolist(), arrays["lead_speeds"].tolist(), strict=True):
            pose, points = arrays.get(f"lead_{number}_pose"), arrays.get(f"lead_{number}_points")
            leads[number] = Lead(speed, points, None if pose is None else (Rotation.from_quat(pose[:4]), np.array(pose[4:])))
        return leads

    def rigid(self) -> list[np.ndarray]:
        """The vertices of each obstacle that moves without deforming."""
        found = []
        for mover in self.movers:
            lead = self.leads.get(mover.key)
            if mover.rigid and (not mover.still if lead is None else lead.pose is not None):
                found.append(mover.vertices)
        return found

    def keeps_shape(self) -> np.ndarray:
        """(bodies,) bool: who has the shape of the start, now that some obstacles deform as commanded."""
        keeps = self.assembly.keeps_shape
        for mover in self.movers:
            if mover.body >= 0 and mover.key in self.leads and self.leads[mover.key].points is not None:
                keeps[mover.body] = False
        return keeps

    # Before and after a step.

    def plan(self, time: float, reached: Reached, positions: wp.array) -> None:
        """The ways of a step that starts at `time`, s, from positions (n,) vec3."""
        end = time + self.h
        self._plan_anchors(end, reached)
        if self._uploaded and not self.moves:
            return
        self._ways = []
        shared = []  # movers whose scripts are in time go in step with each other
        for number, mover in enumerate(self.movers):
            lead, path = self.leads.get(mover.key), mover.trajectory
            if lead is not None:
                way = self._led(mover, lead, reached, positions)
            elif mover.body >= 0 and isinstance(path, Trajectory) and reached.times[mover.body] < time:
                start = returned(mover, path, float(reached.times[mover.body]), time, self.h)
                last = min(end, start + CATCH_UP * self.h)
                way = Way(path, start, _waypoints([(mover, path)], start, last))
            else:
                way = Way(path, time, np.array([end]))
                shared += [] if mover.still else [number]
            self._ways.append(way)
        if shared:
            times = _waypoints([(m, m.trajectory) for m in map(self.movers.__getitem__, shared)], time, end)
            for number in shared:
                self._ways[number].times = times
        self._upload()

    def _plan_anchors(self, end: float, reached: Reached) -> None:
        if not self.soft:
            return
        self.anchors = np.empty_like(reached.anchors)
        for pin, own in self.soft.items():
            lead = self.leads.get(-1 - pin)
            if lead is None or lead.points is None:
                self.anchors[own] = self.assembly.pin_targets(self.assembly.pins[pin], end)
            elif self.assembly.pins[pin].active:
                self.anchors[own] = _towards(reached.anchors[own], lead.points, lead.speed * self.h)
            else:
                self.anchors[own] = reached.anchors[own]

    def _led(self, mover: Mover, lead: Lead, reached: Reached, positions: wp.array) -> Way:
        """A command's way, as far as its speed takes it in a step."""
        within = lead.speed * self.h
        if lead.pose is not None:
            begin = reached.pose(mover)
            path = Approach(mover.origin, begin, lead.pose)
            length = float(np.linalg.norm(lead.pose[1] - begin[1])) + mover.reach(path) * path.turning(0.0, 1.0)
            times = _waypoints([(mover, path)], 0.0, 1.0 if length <= within else within / length)
            return Way(path, 0.0, times[:MOST])
        assert lead.points is not None
        now = positions.numpy()[mover.vertices].astype(np.float64)
        goal = lead.points if not mover.glued else mover.with_glued(lead.points)
        self._where[mover.vertices] = _towards(now, goal, within)
        return Way(None, 0.0, np.ones(1))

    def _upload(self) -> None:
        counts = [len(way.times) for way in self._ways]
        offsets = np.cumsum([0, *counts])
        if offsets[-1] > len(self.parts):
            self._room(2 * int(offsets[-1]))
        turns, places, parts = np.zeros((offsets[-1], 3, 3)), np.zeros((offsets[-1], 3)), np.zeros(offsets[-1])
        centers, straight = np.zeros((len(counts), 3)), np.ones(len(counts), dtype=np.int32)
        bends, bend_offsets, corners = np.zeros(len(counts)), np.zeros(len(counts)), [np.zeros((0, 3))]
        for number, (mover, way) in enumerate(zip(self.movers, self._ways, strict=True)):
            own = slice(offsets[number], offsets[number] + counts[number])
            if way.path is None:
                continue
            if not isinstance(way.path, Deforming):
                self._where[mover.vertices] = way.path.apply(mover.points, way.times[-1])
                if counts[number] > 1:
                    straight[number], centers[number] = 0, way.path.center
                    poses = [way.path.pose(time) for time in way.times]
                    turns[own], places[own] = [pose[0] for pose in poses], [way.path.center + pose[1] for pose in poses]
                continue
            self._where[mover.vertices] = mover.place(way.times[-1])
            inner = way.path.breaks[(way.start < way.path.breaks) & (way.path.breaks < way.times[-1])]
            parts[own] = np.interp(way.times, [way.start, *inner, way.times[-1]], np.arange(len(inner) + 2.0))
            bends[number], bend_offsets[number] = len(inner), sum(map(len, corners)) - self._first[number]
            corners += [mover.place(time) for time in inner]
        self.goal.assign(self._where.astype(self.real.numpy))
        if counts:
            numbers = (self.count, counts), (self.offset, offsets[:-1]), (self.straight, straight)
            for array, values in (*numbers, (self.bends, bends), (self.bend_offset, bend_offsets)):
                array.assign(np.asarray(values, dtype=np.int32))
            self.center.assign(centers)
            self._upload_corners(np.concatenate(corners))
        if offsets[-1] > len(counts):  # else each goes to its goal at once
            for array, values in ((self.turns, turns), (self.places, places), (self.parts, parts)):
                array[: offsets[-1]].assign(values)
        self._uploaded = True

    def _upload_corners(self, corners: np.ndarray) -> None:
        if len(corners) > len(self.corners):
            self.corners = wp.zeros(2 * len(corners), dtype=self.real.vec3, device=self.device.warp)
            self.generation += 1
        if len(corners):
            self.corners[: len(corners)].assign(corners.astype(self.real.numpy))

    def settle(self, time: float, reached: Reached, lag: float, positions: wp.array) -> tuple[Reached, float, str]:
        """After a step that ended at `time`, s, at positions (n,) vec3: how far everybody is, how far, m, the last is behind its script, and a
        sentence that names it; nothing where all are in time.

        reached: where the step started. lag: m, how far the last is behind the goal of the step.
        """
        now = reached.copy()
        now.times[:] = time
        if self.anchors is not None:
            now.anchors = self.anchors.copy()
        if not self.moves:
            return now, *self._last(time, now, lag, positions)
        arrived = lag == 0.0
        at, left = (None, None) if arrived else (self.at.numpy(), self.left.numpy())
        for number, (mover, way) in enumerate(zip(self.movers, self._ways, strict=True)):
            if way.path is None or not way.path.is_rigid or mover.body < 0:
                continue
            come = float(way.times[-1])
            if at is not None and left is not None:
                ends = np.concatenate([[way.start], way.times])
                come = float(ends[at[number]] - float(left[number]) * (ends[at[number]] - ends[at[number] - 1]))
            if isinstance(way.path, Approach):
                rotation, p = way.path.pose(come)
                now.poses[mover.body] = *Rotation.from_matrix(rotation).as_quat(), *(p + way.path.center)
            elif not mover.still:
                now.times[mover.body] = come
        return now, *self._last(time, now, lag, positions)

    def _last(self, time: float, now: Reached, lag: float, positions: wp.array) -> tuple[float, str]:
        """How far, m, the last is behind its script, and the sentence that names it, or nothing; see `settle`. now: after the step."""
        ways = zip(self.movers, self._ways, strict=True)  # of what never moves the ways are those of an earlier step
        late = [not mover.still and isinstance(way.path, Trajectory) and way.times[-1] < time for mover, way in ways]
        if not (lag > 0.0 or any(late)):
            return 0.0, ""
        x, away = positions.numpy(), []
        for mover, is_late in zip(self.movers, late, strict=True):
            goal = mover.place(time) if is_late else self._where[mover.vertices]
            away.append(float(np.linalg.norm(goal.astype(x.dtype) - x[mover.vertices], axis=1).max(initial=0.0)))
        last = int(np.argmax(away))
        lag = max(lag, away[last])
        follows = late[last] and now.times[self.movers[last].body] == self._ways[last].times[-1]
        why = f"and makes it up at {CATCH_UP:g} times its pace" if follows else "where something is in its way"
        return lag, f"{self.movers[last].label} is {lag:.3g} m behind its target, {why}"

    # Within a step, in launches only.

    def begin(self, x_start: wp.array) -> None:
        """Everybody goes to the first waypoint."""
        movers = len(self.movers)
        if movers:
            self.device.launch_serial(self.kernels.clear, [self.chords])
            self.device.launch(self.kernels.begin, movers, [self.march])
            self._aim(x_start)

    def hold(self) -> None:
        """Whoever would close a pair that is squeezed where the step starts does not set out: it would squeeze it further with each step."""
        self.device.launch(self.kernels.hold, len(self.movers), [self.crowded, self.drive])

    def led(self, x_start: wp.array, u: wp.array, free: wp.array) -> Any:
        """All vertices as kernels take them, displaced by u from x_start; free: (n,) 1 or 0."""
        made = led(self.real)()
        made.base, made.u, made.free = x_start, u, free
        made.target, made.mover, made.drive = self.target, self.mover, self.drive
        return made

    def _aim(self, x_start: wp.array) -> None:
        inputs = [self.members, self.mover, self.points, self.at, filled(ways(self.real), self), x_start, self.target]
        self.device.launch(self.kernels.aim, self.member_count, inputs)

    def advance(self, x_start: wp.array, u: wp.array, fraction: wp.array, progress: wp.array) -> None:
        """After a motion to x_start + u was made, of which each vertex kept `fraction`: who goes on, and where to. progress: the step's `count`."""
        if not self.movers:
            return
        k, device = self.kernels, self.device
        device.launch(k.compare, self.member_count, [self.members, self.mover, x_start, self.target, u, self.behind])
        limits = [fraction, progress, self.patience, self.count]
        device.launch_serial(k.advance, [len(self.movers), self.leaders, *limits, self.march, self.flags, self.chords])
        self._aim(x_start)


def _towards(now: np.ndarray, goal: np.ndarray, within: float) -> np.ndarray:
    """(k, 3) m: goal, or as far from `now` on the straight ways there as takes nobody further than `within`, m."""
    length = float(np.linalg.norm(goal - now, axis=1).max(initial=0.0))
    return goal if length <= within else now + within / length * (goal - now)


def returned(mover: Mover, path: Trajectory, stopped: float, now: float, h: float) -> float:
    """The last time, s, in the step of h that ends at `now`, at which a script's pose is the one at `stopped`, s, but for the deviation of chords; else
    `stopped`. What came before was looked at in the steps before.
    """
    turn, place = path.pose(stopped)
    from scipy.optimize import minimize_scalar  # a tenth of what the first step waits for, and seldom needed

    reach = mover.reach(path)

    def away(time: float) -> float:
        """m: as far as any vertex is from its place then, or further."""
        rotation, p = path.pose(time)
        return float(np.linalg.norm(p - place) + reach * np.linalg.norm(rotation - turn))

    times = np.linspace(max(stopped, now - h), now, LOOKS + 1)
    far = np.array([away(time) for time in times])
    low = np.flatnonzero((far[1:] <= far[:-1]) & (far[1:] <= np.append(far[2:], np.inf))) + 1
    for k in low[::-1]:
        a, b = times[k - 1], times[min(k + 1, len(times) - 1)]
        nearest = float(minimize_scalar(away, bounds=(float(a), float(b)), method="bounded", options={"xatol": 1e-9 * h}).x)
        for time in (float(times[k]), nearest):
            if away(time) <= mover.deviation:
                return time
    return stopped


def _waypoints(paths: list, first: float, last: float) -> np.ndarray:
    """(k,) times, ascending to `last`, between which each of the paths, with its mover, is straight, or turns by no more than it may."""
    least = 1e-9 * (last - first)
    breaks = np.concatenate([path.breaks for _, path in paths])
    breaks = breaks[(first + least < breaks) & (breaks < last - least)]
    times = []
    for a, b in itertools.pairwise(np.unique([first, *breaks, last])):
        count = max([1, *(mover.chords(path, a, b) for mover, path in paths)])
        times += [*(a + (b - a) * np.arange(1, count) / count), b]
    return np.array(times or [last])
