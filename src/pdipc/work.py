"""The buffers of a step, allocated once for a model, and the recorded step."""

import warnings
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import warp as wp

from pdipc.barrier.pairs import ActivePairs, FrozenPairs
from pdipc.barrier.restitution import ELASTIC_END, ELASTIC_START, Restitution
from pdipc.collision.broad_phase import BroadPhase
from pdipc.collision.candidates import Candidates
from pdipc.collision.truncation import Truncation
from pdipc.device import system
from pdipc.device.launch import Graph, one_at_a_time
from pdipc.integration import inertia, status
from pdipc.integration.loads import Loads
from pdipc.integration.script import Lead, Script
from pdipc.model import Model, State
from pdipc.nonlinear import Method
from pdipc.nonlinear.local_global import LocalGlobal
from pdipc.nonlinear.newton import Newton
from pdipc.paper_mode.printed import Printed
from pdipc.scene.quarantine import Quarantine

METHODS = {"newton": Newton, "local-global": LocalGlobal, "printed": Printed}


class Work:
    """What a step works with. Arrays over all n vertices, on the device:

    x_start, rest, v_start, a_start: where the step starts, m, m/s, m/s^2; rest is what rounding took off x_start. begin: all of it as
    kernels take it.
    script: where kinematic vertices go. loads: external accelerations. z: the inertial displacement of line 1, m.
    u, x: the feasible iterate as displacement from x_start, with rest, and as position x = x_start + u, m. u_tilde, x_tilde: where the
    outer iteration wants to go. v, a: the result.

    count, going, clock: see `integration.status`. method: how the step is solved. generation: changes when arrays were replaced.
    recorded: whether steps run as recorded graphs; without, each kernel is launched from Python, with the same bits. So it
    is for a solver that the host drives, and, with a warning, on a CUDA driver that has no loops in graphs.
    """

    @one_at_a_time
    def __init__(self, model: Model, recorded: bool = True):
        device, real, n = model.device, model.real, model.vertex_count
        vec3, settings = real.vec3, model.settings
        self.model, self.device, self.kernels = model, device, inertia.kernels(real)
        self.recorded = recorded and model.recordable and device.records_loops
        if recorded and not device.records_loops:
            warnings.warn(f"the driver of {device.name} has no loops in graphs: each kernel is launched alone", stacklevel=2)

        def zeros(dtype, count=n):
            return wp.zeros(count, dtype=dtype, device=device.warp)

        self.x_start, self.rest, self.v_start, self.a_start = zeros(vec3), zeros(vec3), zeros(vec3), zeros(vec3)
        self.x, self.v, self.a, self.rest_end = model.initial_state().positions, zeros(vec3), zeros(vec3), zeros(vec3)
        self.u, self.u_tilde, self.x_tilde, self.z = zeros(vec3), zeros(vec3), zeros(vec3), zeros(vec3)
        self.script = Script(model.assembly, device, real, settings.time_step, settings.max_outer)
        self.loads = Loads(device, real, model.external)
        self.count, self.going, self.foreign = zeros(wp.int32, status.COUNTS), zeros(wp.int32, 1), zeros(wp.int32, 1)
        self.clock = zeros(wp.float64, len(status.STAGES) + 2)
        self.begin = inertia.start(real)()
        self.begin.x, self.begin.rest, self.begin.v, self.begin.a = self.x_start, self.rest, self.v_start, self.a_start
        self.report = zeros(wp.float64, inertia.SIZE)
        self.h = real.scalar(settings.time_step)
        self.candidates = Candidates(
            device,
            real,
            model.surface,
            BroadPhase(device, real, model.surface, model.scene.contact.broad_phase),
            model.assembly.rest_positions,
            model.half_separation,
            settings.activation_distance,
            settings.margin,
            model.rest_separation,
            len(model.assembly.quarantine),
        )
        self.candidates.flatten(self.script.keeps_shape())
        self.quarantine = Quarantine(model.assembly)
        self.truncation = Truncation(device, real, n, settings.per_vertex_truncation, [b.all for b in model.followers])
        self.truncation.keep_rigid(self.script.rigid())
        self.method: Method = METHODS[settings.nonlinear_solver](self)
        self.restitution = None
        if settings.restitution is not None and isinstance(self.method.pairs, ActivePairs):
            masses = (model.mass, model.free, model.body_mass, model.rigidity)
            self.restitution = Restitution(device, real, self.method.pairs, *masses, settings.restitution, settings.time_step)
        self._graphs: dict[str, Graph] = {}
        self._graphs_of = (-1, -1, -1)

    @property
    def pairs(self) -> FrozenPairs:
        """The barriers that were listed last."""
        return self.method.pairs

    def set_scripted(self, state: State) -> None:
        """Where kinematic vertices go in a step from `state`, only uploaded where they move, and the external accelerations."""
        self.script.plan(state.time, state.reached, state.positions)
        projector, script = self.model.projector, self.script
        if script.anchors is not None:
            for points, own in ((projector.anchors, script.to_points), (projector.rails, script.on_rails)):
                if points is not None:
                    points.assign(script.anchors[own])
        self.model.set_time(state.time + self.model.settings.time_step)
        self.loads.update(state.time, state.positions, state.velocities)

    def ignore(self, quarantined: tuple[bool, ...]) -> None:
        """Which of the quarantined pairs of bodies ignore each other from now on."""
        if quarantined:
            pairs = np.array(self.quarantine.pairs, dtype=np.int32)
            self.candidates.ignore(np.where(np.array(quarantined)[:, None], pairs, -1))

    def lead(self, key: int, lead: Lead) -> None:
        """What has this key in `Script.leads` follows a command from the next step on."""
        self.follow({**self.script.leads, key: lead})

    def follow(self, leads: dict[int, Lead]) -> None:
        """These commands, and no others, from the next step on."""
        before = self.script.moves, [vertices[0] for vertices in self.script.rigid()]
        self.script.follow(leads)
        if before != (self.script.moves, [vertices[0] for vertices in self.script.rigid()]):
            self.truncation.keep_rigid(self.script.rigid())
            self.script.generation += 1
        self.candidates.flatten(self.script.keeps_shape())

    def run(self, part: Callable[["Work"], None]) -> Generator[Graph, None, None]:
        """Yields the graph of `part` of Algorithm 1, recorded first where it is new or arrays were replaced; what is not recorded is run."""
        if not self.recorded:
            part(self)
            return
        generation = (self.candidates.generation, self.method.generation, self.script.generation)
        if self._graphs_of != generation:
            self._graphs, self._graphs_of = {}, generation
        name = part.__name__
        if name not in self._graphs:
            self._graphs[name] = self.device.capture(lambda: part(self), self)
        yield self._graphs[name]

    def grow(self) -> bool:
        """Makes room where a list was full; returns whether one was."""
        grown = [self.candidates.grow(), self.method.grow()]
        self.candidates.overflow.zero_()
        return any(grown)

    def list_pairs(self, x: wp.array) -> None:
        """Freezes the pairs that are active at x, outside of a step."""
        while True:
            self.candidates.cover(x, x)
            self.pairs.freeze(self.candidates, x)
            if not self.grow():
                return

    # What methods hand to kernels.

    def progress(self) -> Any:
        """How the step stands."""
        made = status.progress(self.model.real)()
        made.count, made.numbers, made.clock, made.going = self.count, self.method.numbers, self.clock, self.going
        return made

    def inertial(self) -> Any:
        """What the potential of inertia and damping takes."""
        model, real, made = self.model, self.model.real, inertia.inertial(self.model.real)()
        made.rest, made.z, made.mass, made.free = self.rest, self.z, model.mass, model.free
        made.h, made.damping = self.h, real.scalar(model.settings.damping)
        return made

    def led(self) -> Any:
        """The vertices as displaced so far, and where those go that follow a script."""
        return self.script.led(self.x_start, self.u, self.model.free)

    # What Algorithm 1 is made of, in launches only.

    def start_clock(self) -> None:
        """Times and counts of the step begin."""
        device, k = self.device, self.kernels
        device.launch_serial(k.start_clock, [*system.clock_call(), self.clock])
        device.launch_serial(k.begin, [self.progress(), self.method.inner, self.method.iterations])

    def mark(self, stage: str) -> None:
        """The time since the last mark belongs to `stage`."""
        self.device.launch_serial(self.kernels.mark, [status.STAGES.index(stage), *system.clock_call(), self.clock])

    def predict(self) -> None:
        """Lines 1 and 2: z and x~, as displacements."""
        self.device.copy(self.x, self.x_start)
        self.script.begin(self.x_start)
        inputs = [self.begin, self.loads.acceleration, self.script.target, self.model.free, self.h]
        self.device.launch(self.kernels.predict, self.model.vertex_count, [*inputs, self.u, self.z, self.u_tilde])

    def rebound(self) -> None:
        """With restitution, velocities are those that bodies part with; the motion behind them is made in `restitution.u_now`."""
        r = self.restitution
        if r is None:
            return
        r.aim(self.rest, self.u, self.v_start)

        def correct() -> None:
            self.method.correct(r)
            for u, place in ((self.rest, ELASTIC_START), (self.u, ELASTIC_END)):
                self.model.projector.energy(self.x_start, u, r.sums, place)
            r.limit(self.rest, self.u, self.v_start, self.loads.acceleration)

        self.device.when(r.needed, correct)
        self.mark("solver")

    def part(self) -> None:
        """Line 18."""
        moved = self.u if self.restitution is None else self.restitution.u_now
        inputs = [self.begin, self.u, moved, self.x, self.model.free, self.h]
        self.device.launch(self.kernels.finish, self.model.vertex_count, [*inputs, self.rest_end, self.v, self.a])

    def write_report(self) -> None:
        """What the host reads when the step is over."""
        m = self.method
        numbers = [self.progress(), m.inner, m.iterations, m.pairs.closest, self.foreign, self.script.chords]
        self.device.launch_serial(self.kernels.report, [*numbers, self.report])
