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
from pdipc.device.precision import Real
from pdipc.device.precision import real as real_of

NAME = "neo_hookean"
CORNERS = tets.CORNERS
PROJECTIVE = False
arguments = tets.arguments


def rest(rest_positions: np.ndarray, vertices: np.ndarray, mu, lame) -> ConstraintSet:
    """Solids of `vertices` (t, 4); mu and lame: Lame's constants, Pa, one or one a tet."""
    return tets.make(NAME, rest_positions, vertices, mu, 1.0, np.asarray(lame) / mu)


@functools.cache
def functions(real: Real) -> SimpleNamespace:
    """stress, principal, invariants and density, over mu; the argument `lame` is lambda / mu."""
    scalar, vec3, vec4, mat33 = real.scalar, real.vec3, real.vec4, real.mat33
    one, half = wp.constant(scalar(1.0)), wp.constant(scalar(0.5))
    m, shift = wp.constant(scalar(4.0 / 3.0)), wp.constant(scalar(5.0 / 6.0))
    cofactor = rotation.functions(real).cofactor

    @func
    def stress(f: mat33, mu: scalar, lame: scalar) -> mat33:
        c = cofactor(f)
        j = f[0, 0] * c[0, 0] + f[1, 0] * c[1, 0] + f[2, 0] * c[2, 0]
        spring = m * mu * (one - one / (wp.ddot(f, f) + one))
        return spring * f + ((lame + shift * mu) * (j - one) - mu) * c

    @func
    def principal(s: vec3, mu: scalar, lame: scalar):
        c = vec3(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        k = lame + shift * mu
        pressure = k * (s[0] * c[0] - one) - mu
        fade = one / (wp.dot(s, s) + one)
        spring = m * mu * (one - fade)
        stretch = k * wp.outer(c, c) + (scalar(2.0) * m * mu * fade * fade) * wp.outer(s, s) + mat33(
            spring, pressure * s[2], pressure * s[1],
            pressure * s[2], spring, pressure * s[0],
            pressure * s[1], pressure * s[0], spring,
        )  # fmt: skip
        side = pressure * s
        each = vec3(spring, spring, spring)
        return stretch, each + side, each - side

    @func
    def invariants(f: mat33, mu: scalar, lame: scalar) -> vec4:
        k = lame + shift * mu
        fade = one / (wp.ddot(f, f) + one)
        return vec4(m * mu * (one - fade), scalar(2.0) * m * mu * fade * fade, k, k * (wp.determinant(f) - one) - mu)

    @func
    def density(f: mat33, mu: scalar, lame: scalar) -> scalar:
        """All terms of first order cancel at rest, and are left out where J > 0, since of them rounding of mu would be left: in terms of
        C = F^T F - I, |F|^2 - 3 = tr C and J - 1 = (J^2 - 1) / (J + 1), J^2 - 1 = tr C + (the sum of its principal minors) + det C.
        """
        c = wp.transpose(f) * f - wp.identity(n=3, dtype=scalar)
        trace = wp.trace(c)
        minors = half * (trace * trace - wp.ddot(c, c)) + wp.determinant(c)
        j = wp.determinant(f) - one
        shear = half * trace - j
        if j > -one:
            j = (trace + minors) / (j + scalar(2.0))
            shear = (half * trace * j - minors) / (j + scalar(2.0))
        # y - log(1 + y), accurately where y is small
        y = scalar(0.25) * trace
        w = one + y
        bent = scalar(0.0)
        if w != one:
            bent = y * (one - wp.log(w) / (w - one))
        return mu * shear + half * m * mu * bent + half * (lame + shift * mu) * j * j

    return SimpleNamespace(stress=stress, principal=principal, invariants=invariants, density=density)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    wide, own = functions(real_of("float64")), functions(real)
    # in single precision the terms of the invariants leave more of a rigid rotation than inertia bears; see `tests.linear.test_blocks`
    invariants = own.invariants if real.name == "float64" else None
    return tets.kernels(real, real.module(__name__), wide.stress, own.principal, wide.density, invariants)
