"""The floating-point type that a scene computes in, and how functions and kernels are made for it.

Mathematics stands in functions of modules, which hold for both types: their arguments are `Scalar` or `Vec3`, and Warp makes an overload
for the types that a kernel calls one with. A constant has the type of an argument, `type(x)(0.5)`. From Python they are called as they
are: `potential.barrier(d, d_hat)`.

Kernels are made by factories, `kernels(real)`, once for each precision, since an array's type is part of a kernel. Where a function
needs a type of its own, such as a struct with arrays, a factory `functions(real)` makes it.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from pdipc.device.language import func

wp.config.log_level = wp.LOG_WARNING  # no banner; every module that uses Warp imports this one

# What a function of both precisions takes.
Scalar = wp.Float
Vec3, Vec4, Mat33 = wp.types.vector(3, wp.Float), wp.types.vector(4, wp.Float), wp.types.matrix((3, 3), wp.Float)
Vec2, Mat43 = wp.types.vector(2, wp.Float), wp.types.matrix((4, 3), wp.Float)


@func
def unit_roundoff(like: wp.float64):
    """Half the spacing of numbers just above one, in the type of `like`."""
    return wp.float64(wp.static(2.0**-53))


@func
def unit_roundoff(like: wp.float32):  # noqa: F811
    return wp.float32(wp.static(2.0**-24))


@dataclass(frozen=True)
class Real:
    """A floating-point type with the vector and matrix types made of it.

    name: "float32" or "float64". unit_roundoff: half the spacing of numbers just above one.
    """

    name: str
    scalar: Any
    vec2: Any
    vec3: Any
    vec4: Any
    mat22: Any
    mat33: Any
    quat: Any
    numpy: Any
    unit_roundoff: float

    def module(self, name: str) -> wp.Module:
        """The Warp module for the kernels of the Python module `name` in this precision.

        One module for each precision, so that using the second does not recompile the first; no adjoints are compiled.
        """
        module = wp.get_module(f"{name}.{self.name}")
        module.options["enable_backward"] = False
        return module


@functools.cache
def real(name: str) -> Real:
    """The precision called "float32" or "float64". Raises ValueError for any other name."""
    if name not in ("float32", "float64"):
        raise ValueError(f'precision is "{name}"; it must be "float32" or "float64"')
    scalar = getattr(wp, name)
    return Real(
        name=name,
        scalar=scalar,
        vec2=wp.types.vector(2, scalar),
        vec3=wp.types.vector(3, scalar),
        vec4=wp.types.vector(4, scalar),
        mat22=wp.types.matrix((2, 2), scalar),
        mat33=wp.types.matrix((3, 3), scalar),
        quat=wp.types.quaternion(scalar),
        numpy=np.dtype(name),
        unit_roundoff=float(np.finfo(name).eps) / 2.0,
    )
