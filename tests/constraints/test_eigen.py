"""Eigenvalues of symmetric 3x3 matrices and their positive parts against NumPy."""

import numpy as np
import pytest
import warp as wp

from pdipc.constraints import eigen
from pdipc.device.precision import real


def matrices(rng):
    """Random, with near and equal eigenvalues, singular, negative, badly scaled, and zero."""
    values = [rng.standard_normal(3) for _ in range(40)]
    values += [[1, 1, 1], [1, 1, -2], [1, 1 + 1e-7, 5], [0, 0, 3], [0, 0, 0], [-1, -2, -3], [1e-6, 1, 1e6], [1e12, -1e12, 1]]
    for s in values:
        q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        a = q @ np.diag(np.asarray(s, dtype=float)) @ q.T
        yield 0.5 * (a + a.T)
    yield np.diag([3.0, -1.0, 2.0])


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_against_numpy(precision):
    number = real(precision)
    tolerance = 20 * number.unit_roundoff
    for a in matrices(np.random.default_rng(0)):
        size = np.abs(a).max()
        matrix = number.mat33(*a.astype(number.numpy).ravel())
        values, vectors = eigen.symmetric(matrix)
        values, vectors = np.array(values, dtype=float), np.array(vectors, dtype=float).reshape(3, 3)
        expected, axes = np.linalg.eigh(a)
        np.testing.assert_allclose(np.sort(values), expected, atol=tolerance * size)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=tolerance)
        np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, a, atol=tolerance * size)
        positive = np.array(eigen.positive_part(matrix), dtype=float).reshape(3, 3)
        np.testing.assert_allclose(positive, axes @ np.diag(np.maximum(expected, 0)) @ axes.T, atol=tolerance * size)


def test_a_matrix_that_is_positive_stays_bit_for_bit():
    for a in ([[2.0, 1, 0.5], [1, 3, 0.25], [0.5, 0.25, 1]], [[1.0, 0.9, 0.8], [0.9, 1, 0.9], [0.8, 0.9, 1]]):
        assert np.array_equal(np.array(eigen.positive_part(wp.mat33d(*np.ravel(a)))).reshape(3, 3), a)
