"""Warp's decorators, `func`, `func_native`, `struct` and `kernel`, what a type checker is told of them, and structs of a precision.

What Warp compiles looks like Python and is not: annotations are values, made for a precision; overloads and operators are Warp's own. A type
checker leaves out functions with `typing.no_type_check`, and so it is told that these decorators are that. All around them it checks.
Native functions are written `@language.func_native(...)`: Warp looks for an attribute of that name.
"""

from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import warp as wp

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import no_type_check
    from typing import no_type_check as func

    Class = TypeVar("Class", bound=type)
    Function: TypeAlias = Callable[..., Any]
    Kernel: TypeAlias = Callable[..., Any]

    def kernel(module: wp.Module, name: str | None = None):
        return no_type_check

    def func_native(snippet: str):
        return no_type_check

    def struct(cls: Class) -> Class: ...

else:
    Function, Kernel = wp.Function, wp.Kernel
    func, func_native, struct = wp.func, wp.func_native, wp.struct

    def kernel(module, name=None):
        """Decorator: a kernel in a module.

        name: for kernels that one function makes several of, since recorded graphs find kernels by name.
        """

        def make(function):
            if name is not None:
                function.__qualname__ = name
            return wp.kernel(function, module=module)

        return make


def struct_of(name: str, module: str, **fields: Any) -> Any:
    """A struct whose arrays are of a precision: their types are values, which a class could not say. module: `__name__` where it is made."""
    return wp.struct(type(name, (), {"__module__": module, "__annotations__": fields}))


def filled(struct: Any, source: object) -> Any:
    """A struct's fields from the attributes of `source` that have their names. Arrays that are replaced need a new one."""
    made = struct()
    for name in struct.vars:
        setattr(made, name, getattr(source, name))
    return made
