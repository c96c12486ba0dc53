"""The coarse part of the Newton solver's preconditioner: groups of neighbouring vertices that move rigidly.

    M^-1 = D^-1 + Z C^-1 Z^T,     C = Z^T K Z

Z has six columns a group: translations, and rotations about the group's centre at the present shape. What is soft under the Newton
matrix and slow for its diagonal are just these motions; a rigid one costs no elastic energy, however stiff the body is. C is renewed with
K: elastic blocks and contacts are gathered group by group, so nothing depends on the order of threads.

C is factorized by rows within a profile. It is dense where there are few groups, so that contacts may couple any two. Where there are
many it is the profile of the elastic matrix, and a contact that falls outside is bounded by its diagonal: for a pair of groups with the
vectors a and b, (a + b)(a + b)^T <= 2 a a^T + 2 b b^T.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse import csgraph

from pdipc.device import language
from pdipc.device.language import filled, func, kernel, struct_of
from pdipc.device.launch import Device
from pdipc.device.precision import Real
from pdipc.linear import partition
from pdipc.linear.affine import Follower
from pdipc.linear.blocks import BlockMatrix, rows_of

GROUP = 64  # vertices of a group
DENSE = 48  # groups up to which C is dense
MOST = 128  # groups; larger meshes get larger ones
MODES = 6
LOST = 1.0e-13  # of its diagonal entry: a pivot below is what rounding has left of nothing

# C = L L^T. Row i of the lower triangle lies at i * size and begins at the column low[i / 6] * 6. A pivot that rounding has lost
# belongs to a motion that the group does not have, such as turning vertices on a line about it: it is made infinite.
_FACTORIZE = """
    const int size = 6 * groups;
    double* l = c.data;
    for (int i = 0; i < size; ++i) {
        const int low = low_of.data[i / 6] * 6;
        double* li = l + (size_t)i * size;
        const double own = li[i];
        for (int j = low; j <= i; ++j) {
            const double* lj = l + (size_t)j * size;
            const int low_j = low_of.data[j / 6] * 6;
            double part[4] = {0.0, 0.0, 0.0, 0.0};
            int k = low > low_j ? low : low_j;
            for (; k + 3 < j; k += 4) {
                for (int m = 0; m < 4; ++m) { part[m] += li[k + m] * lj[k + m]; }
            }
            for (; k < j; ++k) { part[0] += li[k] * lj[k]; }
            const double rest = li[j] - ((part[0] + part[1]) + (part[2] + part[3]));
            if (j < i) { li[j] = rest * inverse.data[j]; }
            else {
                const bool lost = !(rest > LOST * own);
                inverse.data[i] = lost ? 0.0 : 1.0 / sqrt(rest);
                li[i] = lost ? 0.0 : sqrt(rest);
            }
        }
    }
"""

_SOLVE = """
    const int size = 6 * groups;
    const double* l = c.data;
    double* v = (double*)z.data;
    for (int i = 0; i < size; ++i) {
        const int low = low_of.data[i / 6] * 6;
        const double* li = l + (size_t)i * size;
        double part[4] = {0.0, 0.0, 0.0, 0.0};
        int k = low;
        for (; k + 3 < i; k += 4) {
            for (int m = 0; m < 4; ++m) { part[m] += li[k + m] * v[k + m]; }
        }
        for (; k < i; ++k) { part[0] += li[k] * v[k]; }
        v[i] = (v[i] - ((part[0] + part[1]) + (part[2] + part[3]))) * inverse.data[i];
    }
    for (int i = size - 1; i >= 0; --i) {
        const int low = low_of.data[i / 6] * 6;
        const double* li = l + (size_t)i * size;
        const double own = v[i] * inverse.data[i];
        v[i] = own;
        for (int k = low; k < i; ++k) { v[k] -= li[k] * own; }
    }
"""


@functools.cache
def layout_of(real: Real) -> Any:
    """A struct: the groups as kernels that add to C read them."""
    return struct_of(
        "Layout",
        __name__,
        groups=int,
        starts=wp.array(dtype=wp.int32),  # of each group, in
        members=wp.array(dtype=wp.int32),  # vertices
        label=wp.array(dtype=wp.int32),
        low=wp.array(dtype=wp.int32),  # of each group, the first that its row of C has
        arms=wp.array(dtype=real.vec3),
    )


class RigidModes:
    """label: (n,) each vertex's group, -1 where not free. arms: (n,) position in the group from its centre over its radius, so that the
    motion (t, r) of a group moves vertex i by t + r x arm_i. z: (groups,) the six numbers of each group. layout: the groups as kernels take
    them, of the type `layout_of`. bodies: those that move as four points do.
    """

    wide = False  # how the work is cut: see `wide_modes`

    def __init__(
        self,
        device: Device,
        real: Real,
        matrix: BlockMatrix,
        free: np.ndarray,
        group: int | None = None,
        bodies: Sequence[Follower] = (),
    ):
        self.device, self.real, self.matrix = device, real, matrix
        free = free.copy()
        for body in bodies:  # each a group of its own
            free[body.vertices] = free[body.handles] = False
        total = int(free.sum())
        pattern = matrix.pattern + sp.eye_array(matrix.count)
        label = partition.groups(sp.csr_matrix(pattern), free, group or max(GROUP, total // MOST))
        self.groups = int(label.max(initial=-1)) + 1
        for body in bodies:
            label[body.vertices] = label[body.handles] = self.groups
            self.groups += 1
        inside = np.flatnonzero(label >= 0)
        z = sp.csr_matrix((np.ones(len(inside)), (inside, label[inside])), shape=(matrix.count, max(1, self.groups)))
        coarse = sp.csr_matrix(z.T @ pattern @ z)
        order = csgraph.reverse_cuthill_mckee(coarse, symmetric_mode=True)
        label = np.where(label >= 0, np.argsort(order)[label], -1)
        lower = sp.tril(sp.csr_matrix(coarse[order][:, order])).tocoo()
        low = np.arange(max(1, self.groups))
        np.minimum.at(low, lower.row, lower.col)
        if self.groups <= DENSE or device.wide:
            low[:] = 0
        members = np.argsort(label, kind="stable")[np.count_nonzero(label < 0) :]
        starts = np.searchsorted(label[members], np.arange(self.groups + 1))

        def upload(values: np.ndarray) -> wp.array:
            return wp.array(np.append(values, 0).astype(np.int32), dtype=wp.int32, device=device.warp)

        def zeros(dtype, count: int) -> wp.array:
            return wp.zeros(max(1, count), dtype=dtype, device=device.warp)

        size = MODES * self.groups
        self.label, self.members, self.starts, self.low = upload(label), upload(members), upload(starts), upload(low)
        self.arms = zeros(real.vec3, matrix.count)
        self.c, self.inverse = zeros(wp.float64, size * size), zeros(wp.float64, size)
        self.z = zeros(wp.types.vector(MODES, wp.float64), self.groups)
        self.layout = filled(layout_of(real), self)
        self._kernels = kernels(real)

    def prepare(self, x: wp.array, contacts: list) -> None:
        """Launches the factorization of C at the positions x. contacts: what adds to K, each with `couple(self)`."""
        k, device, m = self._kernels, self.device, self.matrix
        device.launch(k.center, self.groups, [self.starts, self.members, x, self.arms], grain=GROUP)
        device.launch(k.gather, self.groups, [self.layout, m.rows, self.c], grain=16 * GROUP)
        for contact in contacts:
            contact.couple(self)
        device.launch_serial(k.factorize, [self.groups, self.low, self.c, self.inverse])

    def restrict(self, r: wp.array) -> None:
        """Launches z = C^-1 Z^T r."""
        k = self._kernels
        self.device.launch(k.restrict, self.groups, [self.starts, self.members, self.arms, r, self.z], grain=GROUP)
        self.device.launch_serial(k.solve, [self.groups, self.low, self.c, self.inverse, self.z])


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """What gathers into C. A group's row of 6x6 blocks is written by its own worker only."""
    vec3, mat33 = real.vec3, real.mat33
    wide, wide33 = wp.float64, wp.mat33d
    vec6 = wp.types.vector(MODES, wide)

    @func
    def widened(a: mat33) -> wide33:
        return wide33(
            wide(a[0, 0]), wide(a[0, 1]), wide(a[0, 2]),
            wide(a[1, 0]), wide(a[1, 1]), wide(a[1, 2]),
            wide(a[2, 0]), wide(a[2, 1]), wide(a[2, 2]),
        )  # fmt: skip

    @func
    def skew(a: vec3) -> wide33:
        zero = wide(0.0)
        x = wide(a[0])
        y = wide(a[1])
        z = wide(a[2])
        return wide33(zero, -z, y, z, zero, -x, -y, x, zero)

    @func
    def mode(arm: vec3, direction: vec3) -> vec6:
        """Z_i^T direction: what a force along it does to the six motions."""
        a = wp.vec3d(wp.float64(arm[0]), wp.float64(arm[1]), wp.float64(arm[2]))
        d = wp.vec3d(wp.float64(direction[0]), wp.float64(direction[1]), wp.float64(direction[2]))
        t = wp.cross(a, d)
        return vec6(d[0], d[1], d[2], t[0], t[1], t[2])

    @func
    def add_outer(c: wp.array(dtype=wp.float64), size: int, g: int, h: int, scale: wp.float64, a: vec6, b: vec6):
        """C_gh += scale a b^T."""
        for i in range(MODES):
            at = (MODES * g + i) * size + MODES * h
            own = scale * a[i]
            for j in range(MODES):
                c[at + j] = c[at + j] + own * b[j]

    return SimpleNamespace(widened=widened, skew=skew, mode=mode, add_outer=add_outer, vec6=vec6)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    scalar, vec3, Layout, BlockRows = real.scalar, real.vec3, layout_of(real), rows_of(real)
    module = real.module(__name__)
    f = functions(real)
    vec6 = f.vec6
    wide, wide33 = wp.float64, wp.mat33d

    @language.func_native(_FACTORIZE.replace("LOST", repr(LOST)))
    def factorize_rows(
        groups: int, low_of: wp.array(dtype=wp.int32), c: wp.array(dtype=wp.float64), inverse: wp.array(dtype=wp.float64)
    ): ...

    @language.func_native(_SOLVE)
    def solve_rows(
        groups: int,
        low_of: wp.array(dtype=wp.int32),
        c: wp.array(dtype=wp.float64),
        inverse: wp.array(dtype=wp.float64),
        z: wp.array(dtype=vec6),
    ): ...

    @kernel(module)
    def center(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        arms_out: wp.array(dtype=vec3),
    ):
        g = first + wp.tid()
        origin = x[members[starts[g]]]
        middle = vec3()
        for k in range(starts[g], starts[g + 1]):
            middle += x[members[k]] - origin
        middle = middle / scalar(starts[g + 1] - starts[g])
        square = scalar(0.0)
        for k in range(starts[g], starts[g + 1]):
            arm = (x[members[k]] - origin) - middle
            arms_out[members[k]] = arm
            square += wp.length_sq(arm)
        if square > scalar(0.0):
            scale = scalar(1.0) / wp.sqrt(square / scalar(starts[g + 1] - starts[g]))
            for k in range(starts[g], starts[g + 1]):
                arms_out[members[k]] = scale * arms_out[members[k]]

    @func
    def add_block(c: wp.array(dtype=wide), size: int, g: int, h: int, tt: wide33, tr: wide33, rt: wide33, rr: wide33):
        for i in range(3):
            at = (MODES * g + i) * size + MODES * h
            below = at + 3 * size
            for j in range(3):
                c[at + j] = c[at + j] + tt[i, j]
                c[at + 3 + j] = c[at + 3 + j] + tr[i, j]
                c[below + j] = c[below + j] + rt[i, j]
                c[below + 3 + j] = c[below + 3 + j] + rr[i, j]

    @kernel(module)
    def gather(first: int, o: Layout, matrix: BlockRows, c: wp.array(dtype=wide)):
        """The rows of C of a group: sum over its vertices i of Z_i^T (held_i Z_i + sum_j K_ij (Z_j - Z_i)), the lower triangle."""
        g = first + wp.tid()
        size = MODES * o.groups
        for i in range(MODES):
            for j in range(MODES * o.low[g], MODES * (g + 1)):
                c[(MODES * g + i) * size + j] = wide(0.0)
        tt = wide33()
        tr = wide33()
        rt = wide33()
        rr = wide33()
        identity = wide33(wp.identity(n=3, dtype=wide))
        for m in range(o.starts[g], o.starts[g + 1]):
            i = o.members[m]
            # Z_i = [I, -[arm]x]; its transpose is [I; [arm]x]
            own = f.skew(o.arms[i])
            mass = wide(matrix.held[i])
            tt += mass * identity
            tr -= mass * own
            rt += mass * own
            rr -= mass * (own * own)
            for e in range(matrix.offsets[i], matrix.offsets[i + 1]):
                j = matrix.columns[e]
                h = o.label[j]
                k = f.widened(matrix.values[e])
                if h == g:
                    # translations cancel, rotations leave the difference of the arms
                    turned = k * (own - f.skew(o.arms[j]))
                    tr += turned
                    rr += own * turned
                else:
                    turned = k * own
                    lever = own * k
                    tt -= k
                    tr += turned
                    rt -= lever
                    rr += own * turned
                    if h >= o.low[g] and h < g:
                        far = f.skew(o.arms[j])
                        kf = k * far
                        add_block(c, size, g, h, k, -kf, lever, -(own * kf))
        add_block(c, size, g, g, tt, tr, rt, rr)

    @kernel(module)
    def factorize(
        first: int, groups: int, low: wp.array(dtype=wp.int32), c: wp.array(dtype=wide), inverse: wp.array(dtype=wide)
    ):
        factorize_rows(groups, low, c, inverse)

    @kernel(module)
    def restrict(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        arms: wp.array(dtype=vec3),
        r: wp.array(dtype=vec3),
        z_out: wp.array(dtype=vec6),
    ):
        g = first + wp.tid()
        total = vec6()
        for k in range(starts[g], starts[g + 1]):
            i = members[k]
            total += f.mode(arms[i], r[i])
        z_out[g] = total

    @kernel(module)
    def solve(
        first: int,
        groups: int,
        low: wp.array(dtype=wp.int32),
        c: wp.array(dtype=wide),
        inverse: wp.array(dtype=wide),
        z: wp.array(dtype=vec6),
    ):
        solve_rows(groups, low, c, inverse, z)

    return SimpleNamespace(center=center, gather=gather, factorize=factorize, restrict=restrict, solve=solve)
