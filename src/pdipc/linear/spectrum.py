"""The spectral interval of D^-1 A."""

import numpy as np
import scipy.sparse as sp

INFLATION = 0.03


def interval(matrix: sp.csr_matrix, free: np.ndarray) -> tuple[float, float]:
    index = np.flatnonzero(free)
    if index.size == 0:
        return 1.0, 1.0
    block = matrix[index][:, index]
    scale = 1.0 / np.sqrt(block.diagonal())
    scaled = sp.csr_matrix(sp.diags_array(scale) @ block @ sp.diags_array(scale))
    start = np.random.default_rng(0).standard_normal(index.size)
    ritz = _lanczos(scaled, start, min(60, index.size))
    return max(ritz[0] * (1.0 - INFLATION), 1e-12), ritz[-1] * (1.0 + INFLATION)


def _lanczos(matrix: sp.csr_matrix, start: np.ndarray, steps: int) -> np.ndarray:
    alpha, beta = [], []
    v = start / np.linalg.norm(start)
    before = np.zeros_like(v)
    b = 0.0
    for _ in range(steps):
        w = matrix @ v - b * before
        a = w @ v
        w -= a * v
        alpha.append(a)
        b = np.linalg.norm(w)
        if b < 1e-12:
            break
        beta.append(b)
        before, v = v, w / b
    return np.linalg.eigvalsh(np.diag(alpha) + np.diag(beta[: len(alpha) - 1], 1) + np.diag(beta[: len(alpha) - 1], -1))
