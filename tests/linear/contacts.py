"""Random contacts for the solver tests: K = A (x) I3 + sum of H (a (x) n)(a (x) n)^T."""

import numpy as np
import scipy.sparse as sp
import warp as wp

from pdipc.device.launch import Device
from pdipc.device.precision import Real


class CoupledContact:
    """Pairs of four random vertices each, with the weights and normals of contacts.

    hessian: (3n, 3n) scipy matrix. blocks: (n, 3, 3) sum of |a| s H n n^T, which dominates it.
    """

    scalar = None

    def __init__(self, device: Device, real: Real, count: int, free: np.ndarray, pairs: int, stiffness: float, seed: int = 0):
        rng = np.random.default_rng(seed)
        vertices = np.stack([rng.choice(count, 4, replace=False) for _ in range(pairs)])
        inside = rng.dirichlet(np.ones(3), pairs)
        weights = np.concatenate([np.ones((pairs, 1)), -inside], axis=1)
        normals = rng.standard_normal((pairs, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        h = stiffness * 10.0 ** rng.uniform(-1, 2, pairs)
        reach = np.sum(np.abs(weights) * free[vertices], axis=1)
        gradient = np.einsum("ka,kd->kad", weights, normals).reshape(pairs, 12)
        columns = (3 * vertices[:, :, None] + np.arange(3)).reshape(pairs, 12)
        g = sp.csr_matrix((gradient.ravel(), columns.ravel(), 12 * np.arange(pairs + 1)), shape=(pairs, 3 * count))
        self.hessian = sp.csr_matrix(g.T @ sp.diags_array(h) @ g)
        self.blocks = np.zeros((count, 3, 3))
        for a in range(4):
            size = np.abs(weights[:, a]) * reach * h * free[vertices[:, a]]
            np.add.at(self.blocks, vertices[:, a], np.einsum("k,ki,kj->kij", size, normals, normals))
        self.diagonal = wp.array(self.blocks.astype(real.numpy), dtype=real.mat33, device=device.warp)
        self.device, self.count = device, count
        blocked = sp.csr_matrix(self.hessian.tobsr((3, 3)).tocsr())
        self._matrix = [wp.array(a.astype(np.int32), device=device.warp) for a in (blocked.indptr, blocked.indices)]
        self._matrix.append(wp.array(blocked.data.astype(real.numpy), device=device.warp))
        self._kernel = _apply_kernel(real)

    def apply(self, p: wp.array, y: wp.array) -> None:
        self.device.launch(self._kernel, self.count, [*self._matrix, p, y], grain=64)


class ScalarContact:
    """The paper's contacts: additions to the diagonal of some vertices."""

    diagonal = None
    apply = None

    def __init__(self, device: Device, real: Real, count: int, vertices: np.ndarray, stiffness: float):
        self.values = np.zeros(count)
        self.values[vertices] = stiffness * 10.0 ** np.random.default_rng(1).uniform(-1, 2, len(vertices))
        self.hessian = sp.kron(sp.diags_array(self.values), sp.eye_array(3)).tocsr()
        self.scalar = wp.array(self.values.astype(real.numpy), device=device.warp)


_kernels = {}


def _apply_kernel(real: Real) -> wp.Kernel:
    if real.name in _kernels:
        return _kernels[real.name]
    scalar, vec3 = real.scalar, real.vec3

    @wp.kernel(module=real.module(__name__), enable_backward=False)
    def apply(
        first: int,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
        p: wp.array(dtype=vec3),
        y: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        total = y[i]
        for c in range(3):
            for e in range(offsets[3 * i + c], offsets[3 * i + c + 1]):
                total[c] += values[e] * p[columns[e] // 3][columns[e] % 3]
        y[i] = total

    _kernels[real.name] = apply
    return apply
