"""Stable neo-Hookean solids (Smith, de Goes, Kim 2018): finite and with a force that unfolds them where tets are flat or inverted.

    W = mu / 2 (|F|^2 - 3) - mu (J - 1) + (lambda + mu) / 2 (J - 1)^2,     J = det F

Without the logarithm of the original, whose part is to keep rest at rest: here the middle term does. For small strains it is
Hooke's law with mu and lambda. No local projection belongs to it, so it needs the Newton solver.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from pdipc.constraints import rotation, tets
from pdipc.constraints.base import ConstraintSet
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
    """stress, principal and density, over mu; the argument `lame` is lambda / mu."""
    scalar, vec3, mat33 = real.scalar, real.vec3, real.mat33
    one = wp.constant(scalar(1.0))
    cofactor = rotation.functions(real).cofactor

    @wp.func
    def stress(f: mat33, mu: scalar, lame: scalar) -> mat33:
        c = cofactor(f)
        j = f[0, 0] * c[0, 0] + f[1, 0] * c[1, 0] + f[2, 0] * c[2, 0]
        return mu * f + ((lame + mu) * (j - one) - mu) * c

    @wp.func
    def principal(s: vec3, mu: scalar, lame: scalar):
        c = vec3(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        k = lame + mu
        pressure = k * (s[0] * c[0] - one) - mu
        stretch = mat33(
            mu + k * c[0] * c[0], k * c[0] * c[1] + pressure * s[2], k * c[0] * c[2] + pressure * s[1],
            k * c[0] * c[1] + pressure * s[2], mu + k * c[1] * c[1], k * c[1] * c[2] + pressure * s[0],
            k * c[0] * c[2] + pressure * s[1], k * c[1] * c[2] + pressure * s[0], mu + k * c[2] * c[2],
        )  # fmt: skip
        side = pressure * s
        m = vec3(mu, mu, mu)
        return stretch, m + side, m - side

    @wp.func
    def density(f: mat33, mu: scalar, lame: scalar) -> scalar:
        """Where J > 0, mu / 2 (|F|^2 - 3) - mu (J - 1) without the cancellation that would leave rounding of mu: in terms of
        C = F^T F - I, |F|^2 - 3 = tr C and J - 1 = (J^2 - 1) / (J + 1), J^2 - 1 = tr C + (the sum of its principal minors) + det C.
        """
        half = scalar(0.5)
        c = wp.transpose(f) * f - wp.identity(n=3, dtype=scalar)
        trace = wp.trace(c)
        minors = half * (trace * trace - wp.ddot(c, c)) + wp.determinant(c)
        j = wp.determinant(f) - one
        shear = half * trace - j
        if j > -one:
            j = (trace + minors) / (j + scalar(2.0))
            shear = (half * trace * j - minors) / (j + scalar(2.0))
        return mu * shear + half * (lame + mu) * j * j

    return SimpleNamespace(stress=stress, principal=principal, density=density)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    wide = functions(real_of("float64"))
    return tets.kernels(real, real.module(__name__), wide.stress, functions(real).principal, wide.density)
