"""Corotated elasticity: W = mu |F - R|^2 + lambda / 2 (J - 1)^2, R the nearest rotation and J = det F.

Hooke's law in the axes that turn with the element: the strain energy is that of `tet_strain`, and the volume's is smooth where tets are flat
or inverted. No local projection belongs to the latter, so it needs the Newton solver.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func
from pdipc.device.precision import Mat33, Real, Scalar, Vec3

NAME = "corotated"
CORNERS = tets.CORNERS
PROJECTIVE = False
arguments = tets.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, mu, lame) -> ConstraintSet:
    """Solids of `vertices` (t, 4); mu and lame: Lame's constants, Pa, one or one a tet."""
    return tets.make(NAME, rest_positions, vertices, mu, 1.0, np.asarray(lame) / mu)


@func
def stress(f: Mat33, mu: Scalar, lame: Scalar):
    """Over mu, as all here; lame: lambda / mu."""
    c = rotation.cofactor(f)
    j = f[0, 0] * c[0, 0] + f[1, 0] * c[1, 0] + f[2, 0] * c[2, 0]
    return type(mu)(2.0) * mu * (f - rotation.nearest_rotation(f)) + lame * (j - type(mu)(1.0)) * c


@func
def principal(s: Vec3, mu: Scalar, lame: Scalar):
    one, two, least = type(mu)(1.0), type(mu)(2.0), type(mu)(1.0e-6)
    c = type(s)(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    m = two * mu
    pressure = lame * (s[0] * c[0] - one)
    both = wp.outer(c, c)
    stretch = type(both)(
        m + lame * c[0] * c[0], lame * c[0] * c[1] + pressure * s[2], lame * c[0] * c[2] + pressure * s[1],
        lame * c[0] * c[1] + pressure * s[2], m + lame * c[1] * c[1], lame * c[1] * c[2] + pressure * s[0],
        lame * c[0] * c[2] + pressure * s[1], lame * c[1] * c[2] + pressure * s[0], m + lame * c[2] * c[2],
    )  # fmt: skip
    turned = type(s)(
        one - two / wp.max(s[1] + s[2], least),
        one - two / wp.max(s[0] + s[2], least),
        one - two / wp.max(s[0] + s[1], least),
    )
    return stretch, m * turned + pressure * s, type(s)(m, m, m) - pressure * s


@func
def density(f: Mat33, mu: Scalar, lame: Scalar):
    d = f - rotation.nearest_rotation(f)
    j = wp.determinant(f) - type(mu)(1.0)
    return mu * wp.ddot(d, d) + type(mu)(0.5) * lame * j * j


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    return tets.kernels(real, real.module(__name__), stress, principal, density)
