"""Stable neo-Hookean solids (Smith, de Goes, Kim 2018): finite, and with a force that unfolds them where tets are flat, inverted or a point.

    W = m / 2 (|F|^2 - 3) - m / 2 log((|F|^2 + 1) / 4) - mu (J - 1) + k / 2 (J - 1)^2,     J = det F,

with m = 4/3 mu and k = lambda + 5/6 mu, which for small strains is Hooke's law with mu and lambda. Without the logarithm a body squeezed below
a fortieth of its volume would collapse to a point and stay: F = 0 would be a minimum. No local projection belongs to it, so it needs the Newton
solver.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
from pdipc.device.language import func
from pdipc.device.precision import Mat33, Real, Scalar, Vec3

NAME = "neo_hookean"
CORNERS = tets.CORNERS
PROJECTIVE = False
M, SHIFT = 4.0 / 3.0, 5.0 / 6.0
arguments = tets.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, mu, lame) -> ConstraintSet:
    """Solids of `vertices` (t, 4); mu and lame: Lame's constants, Pa, one or one a tet."""
    return tets.make(NAME, rest_positions, vertices, mu, 1.0, np.asarray(lame) / mu)


@func
def stress(f: Mat33, mu: Scalar, lame: Scalar):
    """Over mu, as all here; lame: lambda / mu."""
    one = type(mu)(1.0)
    c = rotation.cofactor(f)
    j = f[0, 0] * c[0, 0] + f[1, 0] * c[1, 0] + f[2, 0] * c[2, 0]
    spring = type(mu)(M) * mu * (one - one / (wp.ddot(f, f) + one))
    return spring * f + ((lame + type(mu)(SHIFT) * mu) * (j - one) - mu) * c


@func
def principal(s: Vec3, mu: Scalar, lame: Scalar):
    one, m = type(mu)(1.0), type(mu)(M)
    c = type(s)(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    k = lame + type(mu)(SHIFT) * mu
    pressure = k * (s[0] * c[0] - one) - mu
    fade = one / (wp.dot(s, s) + one)
    spring = m * mu * (one - fade)
    both = wp.outer(c, c)
    stretch = k * both + (type(mu)(2.0) * m * mu * fade * fade) * wp.outer(s, s) + type(both)(
        spring, pressure * s[2], pressure * s[1],
        pressure * s[2], spring, pressure * s[0],
        pressure * s[1], pressure * s[0], spring,
    )  # fmt: skip
    side = pressure * s
    each = type(s)(spring, spring, spring)
    return stretch, each + side, each - side


@func
def invariants(f: Mat33, mu: Scalar, lame: Scalar):
    one, m = type(mu)(1.0), type(mu)(M)
    k = lame + type(mu)(SHIFT) * mu
    fade = one / (wp.ddot(f, f) + one)
    return wp.vector(m * mu * (one - fade), type(mu)(2.0) * m * mu * fade * fade, k, k * (wp.determinant(f) - one) - mu)


@func
def density(f: Mat33, mu: Scalar, lame: Scalar):
    """All terms of first order cancel at rest, and are left out where J > 0, since of them rounding of mu would be left: in terms of
    C = F^T F - I, |F|^2 - 3 = tr C and J - 1 = (J^2 - 1) / (J + 1), J^2 - 1 = tr C + (the sum of its principal minors) + det C.
    """
    one, half = type(mu)(1.0), type(mu)(0.5)
    c = wp.transpose(f) * f
    for i in range(3):
        c[i, i] -= one
    trace = wp.trace(c)
    minors = half * (trace * trace - wp.ddot(c, c)) + wp.determinant(c)
    j = wp.determinant(f) - one
    shear = half * trace - j
    if j > -one:
        j = (trace + minors) / (j + type(mu)(2.0))
        shear = (half * trace * j - minors) / (j + type(mu)(2.0))
    # y - log(1 + y), accurately where y is small
    y = type(mu)(0.25) * trace
    w = one + y
    bent = type(mu)(0.0)
    if w != one:
        bent = y * (one - wp.log(w) / (w - one))
    return mu * shear + half * type(mu)(M) * mu * bent + half * (lame + type(mu)(SHIFT) * mu) * j * j


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    # in single precision the terms of the invariants leave more of a rigid rotation than inertia bears; see `tests.linear.test_blocks`
    of_invariants = invariants if real.name == "float64" else None
    return tets.kernels(real, real.module(__name__), stress, principal, density, of_invariants)
