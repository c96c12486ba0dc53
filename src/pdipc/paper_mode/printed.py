"""Lines 5 to 12 and 16 of Algorithm 1 as printed: targets of Eq. (6), plain local-global iterations, and the paper's test."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.barrier.pairs import Exerted
from pdipc.device.language import kernel
from pdipc.device.precision import Real
from pdipc.integration import status
from pdipc.integration.script import AHEAD, ARRIVED, WILL
from pdipc.nonlinear.local_global import Iterations
from pdipc.paper_mode.energy_rate import EnergyRate
from pdipc.paper_mode.reactions import reactions
from pdipc.paper_mode.targets import OUTER_SQUARED, PaperPairs


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Progress = real.scalar, real.vec3, status.progress(real)
    module = real.module(__name__)

    @kernel(module)
    def measure_squared(first: int, u: wp.array(dtype=vec3), u_end: wp.array(dtype=vec3), moved_out: wp.array(dtype=scalar)):
        i = first + wp.tid()
        moved_out[i] = wp.length_sq(u_end[i] - u[i])

    @kernel(module)
    def decide(
        first: int,
        pairs: wp.array(dtype=wp.int32),
        passes: wp.array(dtype=wp.int32),
        overflow: wp.array(dtype=wp.int32),
        script: wp.array(dtype=wp.int32),
        committed: wp.array(dtype=scalar),
        max_outer: int,
        budget_ms: wp.float64,
        progress: Progress,
    ):
        """Line 16 as printed: it looks at the truncated motion, which becomes small because t_I does, converged or not."""
        code = int(status.RUNNING)
        residual = progress.numbers[status.MOVED]
        if overflow[0] != 0:
            code = status.OVERFLOW
        elif residual >= scalar(wp.inf):
            code = status.NOT_FINITE
            progress.count[status.OUTER] = progress.count[status.OUTER] + 1
        else:
            progress.count[status.OUTER] = progress.count[status.OUTER] + 1
            progress.count[status.SINCE] = progress.count[status.SINCE] + 1
            progress.count[status.BARRIERS] = pairs[0]
            if script[ARRIVED] != 0:
                progress.count[status.SINCE] = 0
            if passes[0] > 0:
                progress.count[status.TRUNCATIONS] = progress.count[status.TRUNCATIONS] + 1
            progress.numbers[status.MOVED] = wp.sqrt(committed[0])
            small = progress.numbers[status.MOVED] <= wp.sqrt(scalar(OUTER_SQUARED))
            if small and script[AHEAD] == 0:
                code = status.CONVERGED
            elif small and script[WILL] == 0:
                code = status.LAGGING
            elif budget_ms > wp.float64(0.0) and progress.clock[status.LAST] - progress.clock[status.STARTED] > budget_ms:
                code = status.OUT_OF_TIME
            elif progress.count[status.SINCE] >= max_outer:
                code = status.CAPPED
        progress.count[status.STATUS] = code
        progress.going[0] = 0
        if code == status.RUNNING:
            progress.going[0] = 1

    return SimpleNamespace(measure_squared=measure_squared, decide=decide)


class Printed(Iterations):
    """See `nonlinear.Method`. The paper starts its solves from rest, and its diagonal changes with the barriers only (Section 5)."""

    def _make(self) -> None:
        model, settings, w = self.model, self.model.settings, self.work
        surfaces = (model.device, model.real, model.kappa, model.friction, model.free, settings.slip_threshold)
        rebound = {"mass": model.mass, "restitution": settings.restitution or 0.0, "h": settings.time_step}
        self.pairs = PaperPairs(*surfaces, **rebound)
        self.loop = EnergyRate(model.device, model.real, model.projector, self.pairs, w.x_start, w.u, w.z, model.mass)
        self.own = kernels(model.real)
        self.committed = wp.zeros(1, dtype=model.real.scalar, device=model.device.warp)

    def freeze(self) -> None:
        """Line 5."""
        super().freeze()
        self.model.solver.prepare(self.pairs)

    def solve_linear(self, increment: wp.array, rhs: wp.array) -> None:
        """Line 10."""
        self.model.solver.solve(increment, rhs, self.pairs, prepared=True)

    def exerted(self) -> tuple[Exerted, Exerted]:
        """See `nonlinear.Method`: what contact did to each body, by Newton's second law, all of it as if along the normals; see `reactions`."""
        w, model = self.work, self.model
        self.device.launch(self.kernels.inertia, model.vertex_count, [w.u, w.inertial(), self.force, self.increment])
        model.projector.add_forces(w.x_start, w.u, self.rhs, self.force)
        missing = -self.rhs.numpy().astype(np.float64) * model.free_vertices[:, None]
        pushed = [self.pairs.listed(self.pairs.quads, self.pairs.weights, self.pairs.pull)]  # those that pushed last
        self.pairs.freeze(w.candidates, w.x)
        pushed.append(self.pairs.listed(self.pairs.quads, self.pairs.weights, self.pairs.pull))  # those that it came to
        quads, weights, pull = (np.concatenate(parts) for parts in zip(*pushed, strict=True))
        parts = np.abs(weights) * pull[:, None]
        forces = reactions(missing, quads, parts, model.assembly.body_of_vertex, model.free_vertices)
        return Exerted(quads, forces), Exerted(quads[:0], forces[:0])

    def accept(self) -> None:
        """Line 16."""
        w, t, n = self.work, self.work.truncation, self.model.vertex_count
        self.pairs.expect(w.u, w.u_tilde, t.fraction)
        self.device.launch(self.own.measure_squared, n, [w.u, t.u_end, self.moved])
        self.largest.sum(self.moved, self.committed)
        motion = [t.u_end, t.x_end, w.u, w.x]
        self.device.launch(self.kernels.commit, n, [w.candidates.overflow, self.numbers, *motion])
        w.script.advance(w.x_start, w.u, t.fraction, w.count)
        self._lead()
        self.largest.max(self.lags, self.numbers, status.LAG)
        s = self.model.settings
        states = [self.pairs.count, t.passes, w.candidates.overflow, w.script.flags, self.committed]
        self.device.launch_serial(self.own.decide, [*states, s.max_outer, s.budget_ms or 0.0, w.progress()])
