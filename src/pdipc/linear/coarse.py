"""Conjugate gradients with a two-level preconditioner, for stiff and for large meshes.

    M^-1 = D^-1 + Z C^-1 Z^T,     C = Z^T A Z + diag(sum over the group of the trace of the contact blocks)

D is the 3x3 block diagonal with the contacts, as in pcg.py. Each column of Z is one on a group of neighbouring vertices and
zero elsewhere (Nicolaides 1987): C moves groups as a whole, which is what takes Jacobi many iterations. C stays one scalar
matrix for the three coordinates, because the trace dominates the contact block; without it the coarse correction would push
through contacts and cost iterations instead of saving them. C is small and banded: it is factorized anew when the contacts
change, in one thread.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse import csgraph

from pdipc.device import language
from pdipc.device.language import kernel
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear import partition, pcg
from pdipc.linear.solver import Contact
from pdipc.linear.system import System

GROUP = 64  # vertices of a group
MAX_GROUPS = 2048  # larger meshes get larger groups

# C = L L^T by rows. Row i of the lower triangle is stored from its first entry that is not zero up to the diagonal, and L
# has the same profile. `row - low` makes the column the index.
_FACTORIZE = """
    for (int i = 0; i < count; ++i) {
        const int low = i + 1 - (starts.data[i + 1] - starts.data[i]);
        double* li = factor_out.data + starts.data[i] - low;
        for (int j = low; j <= i; ++j) {
            const int low_j = j + 1 - (starts.data[j + 1] - starts.data[j]);
            const double* lj = factor_out.data + starts.data[j] - low_j;
            double part[4] = {0.0, 0.0, 0.0, 0.0};
            int k = low > low_j ? low : low_j;
            for (; k + 3 < j; k += 4) {
                for (int c = 0; c < 4; ++c) { part[c] += li[k + c] * lj[k + c]; }
            }
            for (; k < j; ++k) { part[0] += li[k] * lj[k]; }
            const double rest = entries.data[starts.data[i] - low + j] - ((part[0] + part[1]) + (part[2] + part[3]));
            li[j] = j < i ? rest / lj[j] : sqrt(rest + added.data[i]);
        }
    }
"""

_SOLVE = """
    double* v = (double*)z.data;
    for (int i = 0; i < count; ++i) {
        const int low = i + 1 - (starts.data[i + 1] - starts.data[i]);
        const double* li = factor.data + starts.data[i] - low;
        double even[4], odd[4] = {0.0, 0.0, 0.0, 0.0};
        for (int c = 0; c < 4; ++c) { even[c] = v[4 * i + c]; }
        int j = low;
        for (; j + 1 < i; j += 2) {
            for (int c = 0; c < 4; ++c) { even[c] -= li[j] * v[4 * j + c]; }
            for (int c = 0; c < 4; ++c) { odd[c] -= li[j + 1] * v[4 * j + 4 + c]; }
        }
        for (; j < i; ++j) {
            for (int c = 0; c < 4; ++c) { even[c] -= li[j] * v[4 * j + c]; }
        }
        for (int c = 0; c < 4; ++c) { v[4 * i + c] = (even[c] + odd[c]) / li[i]; }
    }
    for (int i = count - 1; i >= 0; --i) {
        const int low = i + 1 - (starts.data[i + 1] - starts.data[i]);
        const double* li = factor.data + starts.data[i] - low;
        double own[4];
        for (int c = 0; c < 4; ++c) { own[c] = v[4 * i + c] / li[i]; v[4 * i + c] = own[c]; }
        for (int j = low; j < i; ++j) {
            for (int c = 0; c < 4; ++c) { v[4 * j + c] -= li[j] * own[c]; }
        }
    }
"""


class TwoLevel(pcg.Pcg):
    """Preconditioned conjugate gradients with a coarse correction.

    group: vertices of a group, by default GROUP, more where there would be more than MAX_GROUPS of them.
    """

    moves_bodies = True

    def __init__(self, system: System, tolerance: float, max_iterations: int, group: int | None = None):
        super().__init__(system, tolerance, max_iterations)
        label = partition.groups(system.matrix, system.free, group or max(GROUP, int(system.free.sum()) // MAX_GROUPS))
        self.groups = int(label.max(initial=-1)) + 1
        inside = np.flatnonzero(label >= 0)
        z = sp.csr_matrix((np.ones(len(inside)), (inside, label[inside])), shape=(system.count, max(1, self.groups)))
        coarse = sp.csr_matrix(z.T @ system.matrix @ z)
        order = csgraph.reverse_cuthill_mckee(coarse, symmetric_mode=True)
        rank = np.argsort(order)
        label = np.where(label >= 0, rank[label], -1)
        profile = _profile(sp.csr_matrix(coarse[order][:, order]))
        members = np.argsort(label, kind="stable")[np.count_nonzero(label < 0) :]
        starts = np.searchsorted(label[members], np.arange(self.groups + 1))

        device, real = self.device.warp, self.real
        self._label = wp.array(label.astype(np.int32), device=device)
        self._members = wp.array(np.resize(members, max(1, len(members))).astype(np.int32), device=device)
        self._member_starts = wp.array(starts.astype(np.int32), device=device)
        self._profile_starts = wp.array(profile[0].astype(np.int32), device=device)
        self._entries = wp.array(profile[1], dtype=wp.float64, device=device)
        self._factor = wp.zeros_like(self._entries)
        self._added = self.zeros(wp.float64, max(1, self.groups))
        self._z = self.zeros(wp.vec4d, max(1, self.groups))
        self._coarse = kernels(real)

    def prepare(self, contact: Contact | None) -> None:
        super().prepare(contact)
        scalar = contact.scalar if contact is not None else None
        block = contact.diagonal if contact is not None else None
        inputs = [self._member_starts, self._members, scalar, block, self._added]
        self.device.launch(self._coarse.add_contacts, self.groups, inputs, grain=GROUP)
        inputs = [self.groups, self._profile_starts, self._entries, self._added, self._factor]
        self.device.launch_serial(self._coarse.factorize, inputs)

    def _precondition(self, equation: Any) -> None:
        inputs = [self._member_starts, self._members, self.r, self._z]
        self.device.launch(self._coarse.restrict, self.groups, inputs, grain=GROUP)
        self.device.launch_serial(self._coarse.solve, [self.groups, self._profile_starts, self._factor, self._z])
        self.sums.launch(self._coarse.correct, [equation, self._label, self._z, self.vectors, self.partial])

    def _update(self, equation: Any, x: wp.array, coupled: int) -> None:
        self.sums.launch(self._coarse.advance, [self._numbers, coupled, self.vectors, x])
        self._precondition(equation)


def _profile(matrix: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """The lower triangle row by row from the first entry that is not zero: starts and entries."""
    count = matrix.shape[0]
    lower = sp.tril(matrix).tocoo()
    low = np.arange(count)
    np.minimum.at(low, lower.row, lower.col)
    starts = np.concatenate([[0], np.cumsum(np.arange(count) - low + 1)])
    entries = np.zeros(starts[-1])
    entries[starts[lower.row] + lower.col - low[lower.row]] = lower.data
    return starts, entries


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """Kernels over the groups, and the small system."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    Equation, Vectors = shared.equation(real), pcg.vectors(real)
    module = real.module(__name__)
    f = shared.functions(real)
    advance_vertices = pcg.functions(real).advance
    alpha_slot, beta_slot = pcg.ALPHA, pcg.BETA

    @language.func_native(_FACTORIZE)
    def factorize_rows(
        count: int,
        starts: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.float64),
        added: wp.array(dtype=wp.float64),
        factor_out: wp.array(dtype=wp.float64),
    ): ...

    @language.func_native(_SOLVE)
    def solve_rows(
        count: int, starts: wp.array(dtype=wp.int32), factor: wp.array(dtype=wp.float64), z: wp.array(dtype=wp.vec4d)
    ): ...

    @kernel(module)
    def add_contacts(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        contact_scalar: wp.array(dtype=scalar),
        contact_block: wp.array(dtype=mat33),
        added_out: wp.array(dtype=wp.float64),
    ):
        """What contacts add to the diagonal of C."""
        g = first + wp.tid()
        total = wp.float64(0.0)
        for k in range(starts[g], starts[g + 1]):
            if contact_scalar:
                total += wp.float64(contact_scalar[members[k]])
            if contact_block:
                total += wp.float64(wp.trace(contact_block[members[k]]))
        added_out[g] = total

    @kernel(module)
    def factorize(
        first: int,
        count: int,
        starts: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.float64),
        added: wp.array(dtype=wp.float64),
        factor_out: wp.array(dtype=wp.float64),
    ):
        factorize_rows(count, starts, entries, added, factor_out)

    @kernel(module)
    def solve(
        first: int,
        count: int,
        starts: wp.array(dtype=wp.int32),
        factor: wp.array(dtype=wp.float64),
        z: wp.array(dtype=wp.vec4d),
    ):
        """z = C^-1 z."""
        solve_rows(count, starts, factor, z)

    @kernel(module)
    def restrict(
        first: int,
        starts: wp.array(dtype=wp.int32),
        members: wp.array(dtype=wp.int32),
        r: wp.array(dtype=vec3),
        z_out: wp.array(dtype=wp.vec4d),
    ):
        """z = Z^T r."""
        g = first + wp.tid()
        total = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        for k in range(starts[g], starts[g + 1]):
            total += r[members[k]]
        z_out[g] = wp.vec4d(wp.float64(total[0]), wp.float64(total[1]), wp.float64(total[2]), wp.float64(0.0))

    @kernel(module)
    def advance(
        first: int,
        share: int,
        count: int,
        numbers: wp.array(dtype=scalar),
        coupled: int,
        v: Vectors,
        x: wp.array(dtype=vec3),
    ):
        """All vectors one step on (as in pcg.py); w is left zero where contacts will add to it."""
        low = (first + wp.tid()) * share
        high = wp.min(low + share, count)
        advance_vertices(low, high, numbers[alpha_slot], numbers[beta_slot], v, x)
        if coupled != 0:
            for i in range(low, high):
                v.w[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    @kernel(module)
    def correct(
        first: int,
        share: int,
        count: int,
        k: Equation,
        label: wp.array(dtype=wp.int32),
        z: wp.array(dtype=wp.vec4d),
        v: Vectors,
        partial_out: wp.array(dtype=scalar),
    ):
        """u = D^-1 r + Z z, gamma = r . u."""
        worker = first + wp.tid()
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            g = label[i]
            if g >= 0:
                shift = z[g]
                residual = v.r[i]
                corrected = f.precondition(i, k, residual)
                corrected += vec3(scalar(shift[0]), scalar(shift[1]), scalar(shift[2]))
                v.u[i] = corrected
                gamma += wp.dot(residual, corrected)
        f.store_sum(gamma, worker, partial_out)

    return SimpleNamespace(
        add_contacts=add_contacts, factorize=factorize, solve=solve, restrict=restrict, advance=advance, correct=correct
    )
