"""Rigid bodies: what of a closed surface decides how it moves, and four points that move as it does.

Any affine motion of a body is that of four points. With equal masses m / 4 at

    c + R (a . sigma_k),   sigma = (1, 1, 1), (1, -1, -1), (-1, -1, 1), (-1, 1, -1),   a^2 the principal second moments over m,

they have the mass of the body, its centre and its whole tensor of inertia, since the sum of sigma_k is 0 and that of sigma_k sigma_k^T is 4 I. A
point of the body is sum_k w_k of them, w_k = (1 + sigma_k . R^T (x - c) / a) / 4.
"""

from dataclasses import dataclass

import numpy as np

CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1]], dtype=float)
FLATTEST = 1e-6  # the least radius of gyration along an axis, of the largest


@dataclass(frozen=True)
class Inertia:
    """volume: m^3. center: (3,) m. radii: (3,) m, of gyration along the principal axes. axes: (3, 3), these, in columns, right-handed."""

    volume: float
    center: np.ndarray
    radii: np.ndarray
    axes: np.ndarray

    def handles(self) -> np.ndarray:
        """(4, 3) m: the four points; they span a positive volume."""
        return self.center + (self.radii * CORNERS) @ self.axes.T

    def weights(self, points: np.ndarray) -> np.ndarray:
        """(n, 4): of the four points, for points (n, 3) of the body, m."""
        inner = (points - self.center) @ self.axes / self.radii
        return 0.25 * (1.0 + inner @ CORNERS.T)


def inertia(vertices: np.ndarray, triangles: np.ndarray) -> Inertia:
    """Of the inside of a closed surface, of uniform density; the volume is negative where it faces inward.

    Where that is no number, because there is no inside, or numbers are too large, it is that of a ball, for `check` to refuse.
    """
    origin = vertices[triangles].mean(axis=(0, 1))
    a, b, c = np.moveaxis(vertices[triangles] - origin, 1, 0)
    six = np.einsum("ij,ij->i", a, np.cross(b, c))
    volume = six.sum() / 6.0
    total = a + b + c
    center = np.einsum("i,ij->j", six, total) / 24.0 / volume
    square = sum(np.einsum("i,ij,ik->jk", six, p, p) for p in (a, b, c, total)) / 120.0 / volume - np.outer(center, center)
    if not np.isfinite(square).all():
        return Inertia(float(volume), origin, np.ones(3), np.eye(3))
    values, axes = np.linalg.eigh(square)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    radii = np.sqrt(np.maximum(values, 0.0))
    return Inertia(float(volume), origin + center, np.maximum(radii, FLATTEST * radii.max()), axes)
