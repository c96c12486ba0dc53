"""A-Jacobi: several sweeps of Jacobi's iteration aggregated into one (Section 5.2 and Appendix A).

With G = D^-1 B, the iteration matrix of weighted Jacobi is R = (1 - w) I + w G, and an iteration of order l is

    y = p(G) x + q(G) D^-1 b,   q(t) = (1 - p(t)) / (1 - t)                         (Eqs. 10, 11)

with p(G) = R^l, the paper's choice, or p(G) = T_l(R/rho)/T_l(1/rho), the Chebyshev polynomial, which reduces the error most.
Entry (i, j) of p(G) = sum_k c_k G^k is a sum over the paths i, s, ..., j of up to l edges,

    c_k (B_is ... B_tj)  D_ii^-1 D_ss^-1 ... D_tt^-1                                (Eqs. 13, 14)

where the first factor, the A-product, never changes, and the diagonal changes with the contacts: `update` computes the
A-coefficients, the entries of p(G), once for each new diagonal. q(G) D^-1 b is formed once a solve.

This differs from the paper in:
1. D <- D/w gives the matrix a diagonal that changes with contacts, too; expanding R^l in powers of G keeps A-products constant.
2. Chebyshev's iteration over aggregated steps is given the interval of p(G): [0, rho^2] for l = 2, not [-rho^2, rho^2].
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from numpy.polynomial import Chebyshev as ChebyshevSeries
from numpy.polynomial import Polynomial

from pdipc.device import language
from pdipc.device.language import kernel, struct_of
from pdipc.device.precision import Real
from pdipc.linear import kernels as shared
from pdipc.linear import partition
from pdipc.linear import rows as sparse_rows
from pdipc.linear.paper import jacobi
from pdipc.linear.solver import Contact, Solver
from pdipc.linear.system import System

SEGMENTS = 4  # threads that share a row on CUDA (Appendix A)
GROUP = 64  # vertices of a block of threads on CUDA
STAGE = 1024  # coefficients that a block of threads fetches to fast memory at a time
SHARED_BYTES = 44 * 1024  # fast memory of a block of threads, with some left for sums
CHECK = 2  # iterations between two looks at the residual; even


def aggregate(kind: str, order: int, weight: float, rho: float) -> tuple[np.ndarray, float, float]:
    """Coefficients c_0 ... c_order of p(G), and the interval that p maps the spectrum of R to, for R in [-rho, rho]."""
    r = Polynomial([1.0 - weight, weight])
    if kind == "power":
        p, low, high = r**order, (0.0 if order % 2 == 0 else -(rho**order)), rho**order
    elif kind == "chebyshev":
        series = ChebyshevSeries.basis(order)
        scale = float(series(1.0 / rho))
        p, low, high = series.convert(kind=Polynomial)(r / rho) / scale, -1.0 / scale, 1.0 / scale
    else:
        raise ValueError(f'polynomial is "{kind}"; it must be "power" or "chebyshev"')
    return p.coef, low, high


class AProducts:
    """The A-products of all paths of up to `order` edges, grouped by the pair of vertices that they join.

    b: (n, n) the off-diagonal part B on the free vertices. coefficients: c_0 ... c_order, multiplied in.
    split: two matrices (stretch, bend) whose sum is B: products with more than one factor of bend are left out (Eq. 16).
    drop, inverse: products that, scaled by the diagonal's `inverse`, are below `drop` of the largest in their row are left out.
    memory_limit: bytes; more raises ValueError.

    rows, columns: (m,) the entries of p(G), row by row. starts: (m + 1,) first path of each entry.
    products: (paths,). between: (paths, order - 1) intermediate vertices, n where the path has fewer.
    dropped: largest row sum of |scaled products| left out, relative to that of all: zero where nothing was.
    """

    def __init__(
        self,
        b: sp.csr_matrix,
        coefficients: np.ndarray,
        inverse: np.ndarray,
        split: tuple[sp.csr_matrix, sp.csr_matrix] | None,
        drop: float,
        memory_limit: float,
    ):
        n, order = b.shape[0], len(coefficients) - 1
        # Each value is a pair: products of stretch alone, and products with one factor of bend.
        stretch = b.data if split is None else np.asarray(split[0][b.nonzero()]).ravel()
        bend = np.zeros(b.nnz) if split is None else np.asarray(split[1][b.nonzero()]).ravel()
        degree = np.diff(b.indptr)
        start = np.flatnonzero(inverse > 0.0)
        head, tail = start, start
        between = np.full((len(start), max(0, order - 1)), n, dtype=np.int32)
        value, with_bend, exact = np.ones(len(start)), np.zeros(len(start)), np.ones(len(start))
        found: list[tuple[np.ndarray, ...]] = [(head, tail, between, coefficients[0] * value, coefficients[0] * exact)]
        for k in range(1, order + 1):
            count = degree[tail]
            paths = int(count.sum())
            needed = paths * (self.bytes_per_path(order) + 40)
            if needed > memory_limit:
                raise ValueError(
                    f"the {paths:,} A-products of order {k} need about {needed / 2**30:.1f} GiB, more than the limit of"
                    f' {memory_limit / 2**30:.1f} GiB; take a lower order or the solver "matrix-powers"'
                )
            edge = np.repeat(b.indptr[tail] - (np.cumsum(count) - count), count) + np.arange(paths)
            last = np.repeat(tail, count)
            between = np.repeat(between, count, axis=0)
            if k > 1:
                between[:, k - 2] = last
            head, tail = np.repeat(head, count), b.indices[edge]
            value, with_bend = np.repeat(value, count), np.repeat(with_bend, count)
            with_bend = with_bend * stretch[edge] + value * bend[edge]
            value = value * stretch[edge]
            exact = np.repeat(exact, count) * b.data[edge]
            found.append((head, tail, between, coefficients[k] * (value + with_bend), coefficients[k] * exact))
        head, tail, between, product, exact = (np.concatenate(part) for part in zip(*found, strict=True))
        keep, self.dropped = product != 0.0, 0.0
        if split is not None or drop > 0.0:
            scale = np.append(inverse, 1.0)
            factor = np.where(np.arange(len(head)) < len(start), 1.0, scale[head]) * np.prod(scale[between], axis=1)
            size, largest = np.abs(product * factor), np.zeros(n)
            np.maximum.at(largest, head, size)
            keep &= size >= drop * largest[head]
            lost = np.bincount(head, np.where(keep, np.abs(exact - product), np.abs(exact)) * factor, n)
            self.dropped = float(np.max(lost / np.maximum(np.bincount(head, np.abs(exact) * factor, n), 1e-300)))
        path = np.flatnonzero(keep)[np.argsort(head[keep].astype(np.int64) * n + tail[keep], kind="stable")]
        key = head[path].astype(np.int64) * n + tail[path]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        self.rows, self.columns = np.divmod(key[first], n)
        self.starts = np.append(first, len(path))
        self.products, self.between = product[path], between[path]
        self.constant = path < len(start)  # the path without an edge, which no diagonal scales
        self.paths = len(path)

    @staticmethod
    def bytes_per_path(order: int) -> int:
        return 8 + 4 * max(0, order - 1)


class AJacobi(Solver):
    """A-Jacobi of any order. Only for contacts that add scalars to the diagonal, as the paper's do.

    order: sweeps in one iteration. accelerated: with Chebyshev's iteration over the aggregated steps.
    polynomial: "power" (the paper's) or "chebyshev".
    weight: w of weighted Jacobi, by default 2/(lo + hi); 1 is plain Jacobi.
    split, drop, memory_limit: see AProducts; with split or drop the solution is changed: see `dropped`.
    grouped: vertices in groups whose neighbourhood is read into fast memory, rows shared by several threads; for CUDA.

    The residual norm is that of the step, sqrt(d . D d) with d = y - x, and the one before the last step.
    """

    # Arguments: the variants of Section 5 that benchmarks compare, each with its default.
    def __init__(
        self,
        system: System,
        tolerance: float,
        max_iterations: int,
        order: int = 2,
        accelerated: bool = True,
        polynomial: str = "power",
        weight: float | None = None,
        split: tuple[sp.csr_matrix, sp.csr_matrix] | None = None,
        drop: float = 0.0,
        memory_limit: float = 2.0 * 2**30,
        grouped: bool | None = None,
    ):
        super().__init__(system, tolerance, max_iterations)
        if order < 1:
            raise ValueError(f"order is {order}; it must be at least 1")
        self.order, self.grouped = order, self.device.is_cuda if grouped is None else grouped
        inner_weight, rho = jacobi.weight_and_radius(system, weight)
        if rho >= 1.0 and (accelerated or polynomial != "power"):
            raise ValueError(f"weight {inner_weight:g} makes Jacobi's iteration diverge (spectral radius {rho:.3f})")
        coefficients, low, high = aggregate(polynomial, order, inner_weight, rho)
        # A second weight centres the interval of p(G) before Chebyshev is applied to it.
        outer = 2.0 / (2.0 - low - high) if accelerated else 1.0
        quotient = _quotient(coefficients)
        coefficients = outer * coefficients
        coefficients[0] += 1.0 - outer
        factors = np.ones(max_iterations + CHECK)
        if accelerated:
            factors = jacobi.chebyshev_factors((high - low) / (2.0 - low - high), len(factors))
        self._factors = wp.array(factors.astype(self.real.numpy), device=self.device.warp)
        self._quotient = [self.real.scalar(outer * d) for d in quotient]

        free = sp.diags_array(system.free.astype(np.float64))
        b = sp.csr_matrix(free @ (sp.diags_array(system.matrix.diagonal()) - system.matrix) @ free)
        b.eliminate_zeros()
        b.sort_indices()
        inverse = np.where(system.free, 1.0 / np.where(system.free, system.matrix.diagonal(), 1.0), 0.0)
        if split is not None:
            split = (sp.csr_matrix(-split[0]), sp.csr_matrix(-split[1]))
        self.products = AProducts(b, coefficients, inverse, split, drop, memory_limit)
        self.dropped = self.products.dropped
        self._upload(system)
        self._x, self._before, self._constant, self._v = (self.zeros(self.real.vec3) for _ in range(4))
        self._kernels = kernels(self.real)

    @property
    def bytes(self) -> int:
        """Memory of A-products, A-coefficients and their indices on the device."""
        p, size = self.products, self.real.numpy.itemsize
        return p.paths * (size + 4 * (self.order - 1)) + len(p.rows) * (size + 12)

    def _upload(self, system: System) -> None:
        """A-products, and room for the coefficients: by rows, or with `grouped` group by group."""
        p, device = self.products, self.device.warp
        if self.grouped:
            positions, self._values = self._plan(system)
        else:
            offsets = np.searchsorted(p.rows, np.arange(system.count + 1))
            entries = sp.csr_matrix((np.zeros(len(p.rows)), p.columns, offsets), shape=(system.count, system.count))
            self.coefficients = sparse_rows.Rows(self.device, self.real, entries)
            positions, self._values = self.coefficients.positions, self.coefficients.values

        def integers(values: np.ndarray) -> wp.array:
            return wp.array(np.resize(values, max(1, values.size)).astype(np.int32), device=device)

        # A path without an edge is marked by a negative row.
        row = np.where(p.constant[p.starts[:-1]], -1 - p.rows, p.rows)
        self._paths = [integers(row), integers(positions), integers(p.starts), integers(p.between.ravel())]
        self._paths += [max(0, self.order - 1), wp.array(p.products.astype(self.real.numpy), device=device)]

    def _plan(self, system: System) -> tuple[np.ndarray, wp.array]:
        """Groups of vertices, what each reads, its rows one after the other with columns numbered within what it reads.

        Returns where each entry of p(G) goes, and room for the entries.
        """
        p, limit = self.products, capacity_on_cuda(self.real)
        pattern = sp.csr_matrix((np.ones(len(p.rows)), (p.rows, p.columns)), shape=(system.count, system.count))
        size = GROUP
        while True:
            label = partition.groups(system.matrix, system.free, size)
            starts, vertices, ring = partition.neighbourhoods(pattern, label, 1)
            largest = int(np.diff(starts).max(initial=1))
            if largest <= limit or size == 1:
                break
            size = max(1, size // 2)
        if largest > limit:
            raise ValueError(
                f"a row of order {self.order} has {largest} coefficients; {limit} fit into fast memory: lower the order"
            )
        self.groups = len(starts) - 1
        owner = np.repeat(np.arange(self.groups), np.diff(starts))
        key = owner.astype(np.int64) * system.count + vertices
        order = np.argsort(key)
        wanted = label[p.rows].astype(np.int64) * system.count + p.columns
        columns = order[np.searchsorted(key[order], wanted)] - starts[label[p.rows]]
        first_rows = np.searchsorted(owner[ring == 0], np.arange(self.groups + 1))
        rank = np.zeros(system.count, dtype=np.int64)
        rank[vertices[ring == 0]] = np.arange(np.count_nonzero(ring == 0))
        positions = np.empty(len(p.rows), dtype=np.int64)
        positions[np.argsort(rank[p.rows], kind="stable")] = np.arange(len(p.rows))
        lengths = np.bincount(rank[p.rows], minlength=first_rows[-1])
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        placed = np.zeros(max(1, len(columns)), dtype=np.int32)
        placed[positions] = columns
        self._neighbourhoods = made = neighbourhoods_of(self.real)()
        arrays = {"starts": starts, "vertices": vertices, "first_rows": first_rows, "columns": placed, "offsets": offsets}
        for name, values in arrays.items():
            values = np.resize(values, max(1, values.size)).astype(np.int32)
            setattr(made, name, wp.array(values, device=self.device.warp))
        made.coefficients = self.zeros(self.real.scalar, len(placed))
        self._group_partial = self.zeros(self.real.scalar, max(1, self.groups))
        self._group_kernels = group_kernels(self.real, limit)
        return positions, made.coefficients

    def prepare(self, contact: Contact | None) -> None:
        """Launches the inverse of the diagonal, and with it the A-coefficients (Eq. 14)."""
        if contact is not None and (contact.diagonal is not None or contact.apply is not None):
            raise ValueError('a-jacobi takes scalar contacts only (contact = "paper"); "matrix-powers" takes 3x3 blocks')
        super().prepare(contact)
        inputs = [self.inverse, self.system.count, *self._paths, self._values]
        self.device.launch(self._kernels.update, len(self.products.rows), inputs, grain=16)

    def solve(
        self,
        x: wp.array,
        b: wp.array,
        contact: Contact | None = None,
        prepared: bool = False,
    ) -> None:
        sums, status_kernels = self.sums, jacobi.kernels(self.real)
        if not prepared:
            self.prepare(contact)
        self._form_constant(x, b)
        self.copy(self._x, x)
        self.copy(self._before, x)
        status = self.status
        self._sweep(self._x, self._before, -1)
        sums.conclude(status_kernels.begin, [*self._sum, status])

        def iterate() -> None:
            self._sweep(self._x, self._before, 0)
            self._sweep(self._before, self._x, 1)
            sums.conclude(status_kernels.check, [*self._sum, CHECK, CHECK, status])

        self.device.loop(self.condition, iterate)
        self.copy(x, self._x)

    @property
    def _sum(self) -> list[Any]:
        return [self._group_partial, self.groups] if self.grouped else [self.partial, self.sums.slots]

    def _form_constant(self, x: wp.array, b: wp.array) -> None:
        """Launches q(G) D^-1 b by Horner's rule, with the part of the matrix on prescribed vertices taken to the right."""
        k, count, matrix = self._kernels, self.system.count, self.system.rows.operand
        self.device.launch(k.prescribed, count, [self.inverse, x, self._v], grain=8)
        self.device.launch(k.right_side, count, [matrix, self.inverse, b, self._v, self._before], grain=32)
        source, target = self._v, self._constant
        self.device.launch(k.scale, count, [self.inverse, self._before, self._quotient[-1], source], grain=8)
        for d in reversed(self._quotient[:-1]):
            self.device.launch(k.horner, count, [matrix, self.inverse, self._before, d, source, target], grain=32)
            source, target = target, source
        if source is not self._constant:
            self.copy(self._constant, source)

    def _sweep(self, source: wp.array, target: wp.array, step: int) -> None:
        o = aggregated(self.real)()
        o.diagonal, o.constant = self.total, self._constant
        state = [o, jacobi.course_of(self, self._factors), step, source, target]
        if self.grouped:
            inputs = [self._neighbourhoods, *state, self._group_partial]
            self.sums.launch_groups(self._group_kernels.grouped_sweep, self.groups, inputs)
        else:
            self.sums.launch(self._kernels.sweep, [self.coefficients.operand, *state, self.partial])


def _quotient(coefficients: np.ndarray) -> np.ndarray:
    """Coefficients of q(t) = (1 - p(t)) / (1 - t): d_k = 1 - (c_0 + ... + c_k) since p(1) = 1."""
    return (1.0 - np.cumsum(coefficients))[:-1]


@functools.cache
def aggregated(real: Real) -> Any:
    """A struct: what an aggregated step has beside p(G)."""
    constant = wp.array(dtype=real.vec3)  # q(G) D^-1 b, m
    return struct_of("Aggregated", __name__, diagonal=wp.array(dtype=real.scalar), constant=constant)


@functools.cache
def neighbourhoods_of(real: Real) -> Any:
    """A struct: groups of vertices, what each reads, and its rows of p(G), as `AJacobi._plan` lays them out."""
    integers = {name: wp.array(dtype=wp.int32) for name in ("starts", "vertices", "first_rows", "columns", "offsets")}
    return struct_of("Neighbourhoods", __name__, **integers, coefficients=wp.array(dtype=real.scalar))


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    """Kernels over vertices and over entries."""
    scalar, vec3, Entries = real.scalar, real.vec3, sparse_rows.entries(real)
    Course, Aggregated = jacobi.course(real), aggregated(real)
    module = real.module(__name__)
    f, omega_of_step = shared.functions(real), jacobi.omega_of(real)

    @kernel(module)
    def update(
        first: int,
        inverse: wp.array(dtype=scalar),
        count: int,
        row: wp.array(dtype=wp.int32),
        position: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        between: wp.array(dtype=wp.int32),
        width: int,
        products: wp.array(dtype=scalar),
        coefficients_out: wp.array(dtype=scalar),
    ):
        """A-coefficient = D_ii^-1 sum over paths of A-product D_ss^-1 ... (Eq. 14); a negative row starts with a constant."""
        e = first + wp.tid()
        low = starts[e]
        i = row[e]
        constant = scalar(0.0)
        if i < 0:
            constant = products[low]
            low += 1
            i = -1 - i
        total = scalar(0.0)
        for path in range(low, starts[e + 1]):
            term = products[path]
            for k in range(width):
                s = between[path * width + k]
                if s < count:
                    term *= inverse[s]
            total += term
        coefficients_out[position[e]] = constant + inverse[i] * total

    @kernel(module)
    def prescribed(first: int, inverse: wp.array(dtype=scalar), x: wp.array(dtype=vec3), x_out: wp.array(dtype=vec3)):
        """x on the prescribed vertices, zero on the free ones."""
        i = first + wp.tid()
        if inverse[i] == scalar(0.0):
            x_out[i] = x[i]
        else:
            x_out[i] = vec3(scalar(0.0), scalar(0.0), scalar(0.0))

    @kernel(module)
    def right_side(
        first: int,
        rows: Entries,
        inverse: wp.array(dtype=scalar),
        b: wp.array(dtype=vec3),
        x: wp.array(dtype=vec3),
        d_out: wp.array(dtype=vec3),
    ):
        """D^-1 (b - A x), with x zero on free vertices."""
        i = first + wp.tid()
        d_out[i] = inverse[i] * (b[i] - f.row_product(i, rows, x))

    @kernel(module)
    def scale(
        first: int, inverse: wp.array(dtype=scalar), d: wp.array(dtype=vec3), factor: scalar, v_out: wp.array(dtype=vec3)
    ):
        """v = factor d on the free vertices, zero elsewhere."""
        i = first + wp.tid()
        v_out[i] = wp.where(inverse[i] > scalar(0.0), factor, scalar(0.0)) * d[i]

    @kernel(module)
    def horner(
        first: int,
        rows: Entries,
        inverse: wp.array(dtype=scalar),
        d: wp.array(dtype=vec3),
        factor: scalar,
        v: wp.array(dtype=vec3),
        v_out: wp.array(dtype=vec3),
    ):
        """v_out = factor d + G v."""
        i = first + wp.tid()
        v_out[i] = factor * d[i] - inverse[i] * f.row_product(i, rows, v)

    @kernel(module)
    def sweep(
        first: int,
        share: int,
        count: int,
        coefficients: Entries,
        o: Aggregated,
        course: Course,
        step: int,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """One aggregated step; `before` as in Jacobi's sweep. Step -1: only the norm of the step."""
        worker = first + wp.tid()
        omega = omega_of_step(course, step)
        gamma = scalar(0.0)
        for i in range(worker * share, wp.min((worker + 1) * share, count)):
            if o.diagonal[i] > scalar(0.0):
                y = o.constant[i] + f.row_product(i, coefficients, x)
                d = y - x[i]
                gamma += o.diagonal[i] * wp.dot(d, d)
                last = before[i]
                before[i] = last + omega * (y - last)
        f.store_sum(gamma, worker, partial_out)

    return SimpleNamespace(update=update, prescribed=prescribed, right_side=right_side, scale=scale, horner=horner, sweep=sweep)


# The group's neighbourhood and, stretch by stretch, its coefficients are fetched to fast memory by all threads together; SEGMENTS
# threads share a row and add their parts up (Appendix A, Fig. 17). All threads of the block pass every barrier and every shuffle.
_GROUPED_SWEEP = """
#if defined(__CUDA_ARCH__)
#define MEET __syncthreads()
    __shared__ SCALAR cache[3 * CAPACITY];
    __shared__ SCALAR staged[STAGE];
    __shared__ int staged_column[STAGE];
    const int segments = SEGMENTS;
#else
#define MEET
    SCALAR cache[3 * CAPACITY], staged[STAGE];
    int staged_column[STAGE];
    const int segments = 1;
#endif
    const int base = groups.starts.data[group];
    const int count = groups.starts.data[group + 1] - base;
    const int* vertex = groups.vertices.data + base;
    for (int k = lane; k < count; k += lanes) {
        const auto& p = x.data[vertex[k]];
        cache[3 * k] = p.c[0]; cache[3 * k + 1] = p.c[1]; cache[3 * k + 2] = p.c[2];
    }
    const int* offset = groups.offsets.data + groups.first_rows.data[group];
    const int rows = groups.first_rows.data[group + 1] - groups.first_rows.data[group];
    const int segment = lane % segments, at_once = lanes / segments;
    SCALAR gamma = 0;
    for (int first = 0; first < rows; first += at_once) {
        const int row = first + lane / segments;
        const int end = offset[first + at_once < rows ? first + at_once : rows];
        const int low = row < rows ? offset[row] : end, high = row < rows ? offset[row + 1] : end;
        SCALAR y[3] = {0, 0, 0};
        for (int begin = offset[first]; begin < end; begin += STAGE) {
            const int stop = begin + STAGE < end ? begin + STAGE : end;
            MEET;  // the last stretch was used, or the neighbourhood is complete
            for (int e = begin + lane; e < stop; e += lanes) {
                staged[e - begin] = groups.coefficients.data[e];
                staged_column[e - begin] = groups.columns.data[e];
            }
            MEET;
            int e = low > begin ? low : begin;
            e += (segment + segments - (e - low) % segments) % segments;
            for (; e < (high < stop ? high : stop); e += segments) {
                const SCALAR value = staged[e - begin];
                const SCALAR* other = cache + 3 * staged_column[e - begin];
                y[0] += value * other[0]; y[1] += value * other[1]; y[2] += value * other[2];
            }
        }
#if defined(__CUDA_ARCH__)
        for (int c = 0; c < 3; ++c) {
            for (int part = SEGMENTS / 2; part > 0; part /= 2) { y[c] += __shfl_down_sync(0xffffffffu, y[c], part, SEGMENTS); }
        }
#endif
        if (row < rows && segment == 0) {
            const int v = vertex[row];
            SCALAR square = 0;
            for (int c = 0; c < 3; ++c) {
                y[c] += o.constant.data[v].c[c];
                const SCALAR d = y[c] - cache[3 * row + c];
                square += d * d;
                SCALAR& last = before.data[v].c[c];
                last += omega * (y[c] - last);
            }
            gamma += o.diagonal.data[v] * square;
        }
    }
    return gamma;
#undef MEET
"""


def capacity_on_cuda(real: Real) -> int:
    """Vertices of the largest neighbourhood that fits into fast memory beside the staged coefficients."""
    size = real.numpy.itemsize
    return (SHARED_BYTES - STAGE * (size + 4)) // (3 * size)


@functools.cache
def group_kernels(real: Real, capacity: int) -> SimpleNamespace:
    """The kernel for groups that read up to `capacity` vertices."""
    scalar, vec3 = real.scalar, real.vec3
    Course, Aggregated, Neighbourhoods = jacobi.course(real), aggregated(real), neighbourhoods_of(real)
    module = real.module(f"{__name__}.{capacity}")
    f, omega_of_step = shared.functions(real), jacobi.omega_of(real)
    source = (
        _GROUPED_SWEEP.replace("SCALAR", f"wp::{real.name}").replace("CAPACITY", str(capacity)).replace("STAGE", str(STAGE))
    )

    @language.func_native(source.replace("SEGMENTS", str(SEGMENTS)))
    def group_step(
        group: int,
        lane: int,
        lanes: int,
        groups: Neighbourhoods,
        o: Aggregated,
        omega: scalar,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
    ) -> scalar: ...

    @kernel(module)
    def grouped_sweep(
        first: int,
        groups: Neighbourhoods,
        o: Aggregated,
        course: Course,
        step: int,
        x: wp.array(dtype=vec3),
        before: wp.array(dtype=vec3),
        partial_out: wp.array(dtype=scalar),
    ):
        """As `sweep`, for one group of vertices."""
        worker = first + wp.tid()
        omega = omega_of_step(course, step)
        lanes = wp.block_dim()
        group = worker // lanes
        lane = worker % lanes
        gamma = group_step(group, lane, lanes, groups, o, omega, x, before)
        f.store_sum(gamma, worker, partial_out)

    return SimpleNamespace(grouped_sweep=grouped_sweep)
