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
from pdipc.device.precision import Real
from pdipc.device.precision import real as real_of

NAME = "corotated"
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
    one, two = wp.constant(scalar(1.0)), wp.constant(scalar(2.0))
    least = wp.constant(scalar(1.0e-6))
    rot = rotation.functions(real)
    cofactor, nearest_rotation = rot.cofactor, rot.nearest_rotation

    @func
    def stress(f: mat33, mu: scalar, lame: scalar) -> mat33:
        c = cofactor(f)
        j = f[0, 0] * c[0, 0] + f[1, 0] * c[1, 0] + f[2, 0] * c[2, 0]
        return two * mu * (f - nearest_rotation(f)) + lame * (j - one) * c

    @func
    def principal(s: vec3, mu: scalar, lame: scalar):
        c = vec3(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        m = two * mu
        pressure = lame * (s[0] * c[0] - one)
        stretch = mat33(
            m + lame * c[0] * c[0], lame * c[0] * c[1] + pressure * s[2], lame * c[0] * c[2] + pressure * s[1],
            lame * c[0] * c[1] + pressure * s[2], m + lame * c[1] * c[1], lame * c[1] * c[2] + pressure * s[0],
            lame * c[0] * c[2] + pressure * s[1], lame * c[1] * c[2] + pressure * s[0], m + lame * c[2] * c[2],
        )  # fmt: skip
        turned = vec3(
            one - two / wp.max(s[1] + s[2], least),
            one - two / wp.max(s[0] + s[2], least),
            one - two / wp.max(s[0] + s[1], least),
        )
        return stretch, m * turned + pressure * s, vec3(m, m, m) - pressure * s

    @func
    def density(f: mat33, mu: scalar, lame: scalar) -> scalar:
        d = f - nearest_rotation(f)
        j = wp.determinant(f) - one
        return mu * wp.ddot(d, d) + scalar(0.5) * lame * j * j

    return SimpleNamespace(stress=stress, principal=principal, density=density)


@functools.cache
def kernels(real: Real) -> SimpleNamespace:
    wide = functions(real_of("float64"))
    return tets.kernels(real, real.module(__name__), wide.stress, functions(real).principal, wide.density)
