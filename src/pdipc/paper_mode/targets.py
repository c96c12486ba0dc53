"""The paper's own barrier constraints: `contact.method = "paper"` (Section 4.1, Eq. 6).

A pair nearer than d_hat pulls each of its vertices to the place where it would be at the end of the step, had it collided:

    y = x + (t_1 - t_I) (I - (1 + eps) n n^T) x_dot                                          (Eq. 6)

where x is the truncated position, the paper's x + (t_I - t_0) x_dot, and (t_1 - t_I) x_dot the motion that truncation cut off. Of
a pair's relative approach each vertex takes a part by its inverse mass, so that momentum is conserved. What the pair adds to the
system is a scalar on the diagonal: the vertices are not coupled. It is constant during the inner loop.

The paper leaves open, and here is chosen:
1. In the first outer iteration no t_I exists. Pairs that are active already collide at once: t_I = t_0, x_dot that of the predictor.
2. Only approaching pairs are reflected, else bodies that part would be turned back.
3. The weight: kappa b(d) / d_hat^2, which grows without bound, plus the least mass of the pair over h^2, so that it is felt at all.
4. Friction: the paper names none, and this mode has none.
"""

import functools
from types import SimpleNamespace

import warp as wp

from pdipc.barrier import potential as barrier
from pdipc.barrier.pairs import FrozenPairs, frozen
from pdipc.collision.candidates import Candidates
from pdipc.device.language import kernel
from pdipc.device.launch import Device, Span
from pdipc.device.precision import Real
from pdipc.linear.contact_rows import first_entry

INNER_RATE = 1.0e-2  # eps_inner: the inner loop ends when E + Psi + B changes by less than this part
OUTER_SQUARED = 1.0e-4  # eps_outer, m^2: the outer loop ends when the squared norm of the truncated step is below it


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Frozen = real.scalar, real.vec3, frozen(real)
    module = real.module(__name__)

    @kernel(module)
    def remember(
        first: int,
        x: wp.array(dtype=vec3),
        x_tilde: wp.array(dtype=vec3),
        fraction: wp.array(dtype=scalar),
        motion_out: wp.array(dtype=vec3),
    ):
        """The motion that truncation cut off: (t_1 - t_I) x_dot."""
        i = first + wp.tid()
        motion_out[i] = (scalar(1.0) - fraction[i]) * (x_tilde[i] - x[i])

    @kernel(module)
    def project(
        span: Span,
        pairs: Frozen,
        mass: wp.array(dtype=scalar),
        free: wp.array(dtype=scalar),
        motion: wp.array(dtype=vec3),
        restitution: scalar,
        h: scalar,
        pull_out: wp.array(dtype=scalar),
        impulse_out: wp.array(dtype=scalar),
    ):
        """Of each pair: its weight, N/m, and the impulse times h that reflects its approach, kg m."""
        worker = span.first + wp.tid()
        for b in range(worker * span.block, pairs.count[0], span.step * span.block):
            for k in range(b, wp.min(b + span.block, pairs.count[0])):
                q = pairs.quads[k]
                a = pairs.weights[k]
                approach = scalar(0.0)
                response = scalar(0.0)
                lightest = scalar(wp.inf)
                for s in range(4):
                    approach += a[s] * wp.dot(pairs.normals[k], motion[q[s]])
                    if free[q[s]] > scalar(0.0):
                        response += a[s] * a[s] / mass[q[s]]
                        lightest = wp.min(lightest, mass[q[s]])
                impulse = scalar(0.0)
                if approach < scalar(0.0) and response > scalar(0.0):
                    impulse = -(scalar(1.0) + restitution) * approach / response
                impulse_out[k] = impulse
                steep = barrier.barrier(pairs.gaps[k], pairs.activation[k]) / (pairs.activation[k] * pairs.activation[k])
                pull_out[k] = scalar(0.0)
                if response > scalar(0.0):
                    pull_out[k] = pairs.stiffness[k] * steep + lightest / (h * h)

    @kernel(module)
    def gather(
        first: int,
        pairs: Frozen,
        pull: wp.array(dtype=scalar),
        impulse: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar),
        free: wp.array(dtype=scalar),
        motion: wp.array(dtype=vec3),
        scalar_out: wp.array(dtype=scalar),
        drag_out: wp.array(dtype=vec3),
        offset_out: wp.array(dtype=scalar),
    ):
        """Of each vertex, over its pairs: sum of w, of w (y - x), and of w |y - x|^2 / 2."""
        v = first + wp.tid()
        total = scalar(0.0)
        drag = vec3()
        offset = scalar(0.0)
        if free[v] > scalar(0.0):
            for i in range(first_entry(v, pairs.ends), pairs.ends[v]):
                k = pairs.entries[i] // 4
                a = pairs.weights[k][pairs.entries[i] % 4]
                w = pull[k] * wp.abs(a)
                y = motion[v] + (a * impulse[k] / mass[v]) * pairs.normals[k]
                total += w
                drag += w * y
                offset += scalar(0.5) * w * wp.length_sq(y)
        scalar_out[v] = total
        drag_out[v] = drag
        offset_out[v] = offset

    @kernel(module)
    def linearize(
        first: int,
        x: wp.array(dtype=vec3),
        x_tilde: wp.array(dtype=vec3),
        total: wp.array(dtype=scalar),
        drag: wp.array(dtype=vec3),
        rhs: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        rhs[i] = rhs[i] + drag[i] - total[i] * (x_tilde[i] - x[i])

    @kernel(module)
    def vertex_energy(
        first: int,
        x: wp.array(dtype=vec3),
        x_tilde: wp.array(dtype=vec3),
        total: wp.array(dtype=scalar),
        drag: wp.array(dtype=vec3),
        offset: wp.array(dtype=scalar),
        energy_out: wp.array(dtype=scalar),
    ):
        i = first + wp.tid()
        u = x_tilde[i] - x[i]
        energy_out[i] = scalar(0.5) * total[i] * wp.length_sq(u) - wp.dot(drag[i], u) + offset[i]

    return SimpleNamespace(remember=remember, project=project, gather=gather, linearize=linearize, vertex_energy=vertex_energy)


class PaperPairs(FrozenPairs):
    """Barrier constraints by Eq. (6). scalar: (n,) what they add to the diagonal, kg/s^2; see `FrozenPairs`.

    mass: (n,) kg. restitution: eps in [0, 1]. h: s.
    """

    diagonal = apply = None  # `scalar` is the whole contribution

    def __init__(
        self,
        device: Device,
        real: Real,
        kappa: wp.array,
        friction: wp.array,
        free: wp.array,
        slip_threshold: float,
        *,
        mass: wp.array,
        restitution: float,
        h: float,
    ):
        super().__init__(device, real, kappa, friction, free, slip_threshold)
        n = len(kappa)
        self.mass, self.restitution, self.h, self.own = mass, real.scalar(restitution), real.scalar(h), kernels(real)
        self.motion, self.drag = (wp.zeros(n, dtype=real.vec3, device=device.warp) for _ in range(2))
        self.scalar, self.offset, self.still = (wp.zeros(n, dtype=real.scalar, device=device.warp) for _ in range(3))

    def _allocate(self, capacity: int) -> None:
        super()._allocate(capacity)
        self.pull, self.impulse = (wp.zeros(capacity, dtype=self.real.scalar, device=self.device.warp) for _ in range(2))

    def expect(self, x: wp.array, x_tilde: wp.array, fraction: wp.array | None = None) -> None:
        """Keeps what is left of the motion x -> x~ of which each vertex made `fraction`; absent: nothing was made. Recordable."""
        fraction = self.still if fraction is None else fraction
        self.device.launch(self.own.remember, len(x), [x, x_tilde, fraction, self.motion])

    def freeze(
        self, candidates: Candidates, x: wp.array, ahead: wp.array | None = None, driven: wp.array | None = None
    ) -> None:
        super().freeze(candidates, x, ahead, driven)
        k = self.own
        inputs = [self.frozen, self.mass, self.free, self.motion, self.restitution, self.h, self.pull, self.impulse]
        self.device.launch_list(k.project, self.capacity, inputs)
        inputs = [self.frozen, self.pull, self.impulse, self.mass, self.free, self.motion]
        self.device.launch(k.gather, len(x), [*inputs, self.scalar, self.drag, self.offset])

    def linearize(self, x: wp.array, x_tilde: wp.array, x_start: wp.array, rhs: wp.array) -> None:
        """Adds w (y - x~) to rhs. Recordable."""
        self.device.launch(self.own.linearize, len(x), [x, x_tilde, self.scalar, self.drag, rhs])

    def vertex_energy(self, x: wp.array, x_tilde: wp.array, energy_out: wp.array) -> None:
        """(n,) J: sum of w |x~ - y|^2 / 2 over the pairs of each vertex. Recordable."""
        inputs = [x, x_tilde, self.scalar, self.drag, self.offset]
        self.device.launch(self.own.vertex_energy, len(x), [*inputs, energy_out])
