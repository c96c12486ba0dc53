"""What all tables of a scene share: strict numbers, no unknown keys, and SceneError for what is wrong."""

from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from pdipc.scene.errors import SceneError
from pdipc.scene.explain import explain


def _refuse_text(value: Any) -> Any:
    if isinstance(value, bool | np.bool_ | str | bytes):
        raise ValueError("must be a number")
    if isinstance(value, int) and abs(value) > 10**300:
        raise ValueError("must be a number that 64 bits hold")
    return value


Real = Annotated[float, BeforeValidator(_refuse_text)]  # true and "1" are no numbers
Whole = Annotated[int, BeforeValidator(_refuse_text)]
Number = Annotated[Real, Field(allow_inf_nan=False)]
Positive = Annotated[Real, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[Real, Field(ge=0, allow_inf_nan=False)]
Index = Annotated[Whole, Field(ge=0)]
Vector = tuple[Number, Number, Number]


SETTLED = "_settled"  # of a table's __dict__ beside its fields, so that neither comparing nor writing sees it

_T = TypeVar("_T")


class _Model(type(BaseModel)):
    """Makes tables in Python raise what files raise."""

    def __call__(cls: type[_T], *args: Any, **tables: Any) -> _T:  # tables may be dictionaries; what comes out has its type
        try:
            return super().__call__(*args, **tables)
        except ValidationError as error:
            assert issubclass(cls, BaseModel)
            raise SceneError("\n  ".join(explain(error, tables, cls))) from error


class Table(BaseModel, metaclass=_Model):
    """What all tables share: unknown keys are refused, also on assignment from Python. Raises SceneError."""

    model_config = ConfigDict(extra="forbid", validate_assignment=True, arbitrary_types_allowed=True)

    def __setattr__(self, name: str, value: Any) -> None:
        if SETTLED in self.__dict__:
            raise SceneError(
                f"{name} was read when the model was made, and a change would do nothing; change the scene and make a new simulation"
            )
        try:
            super().__setattr__(name, value)
        except ValidationError as error:
            raise SceneError("\n  ".join(explain(error, {name: value}, type(self)))) from error

    def settled(self) -> Self:
        """A copy, down to its last table, that refuses changes: what a model was made from. Arrays are shared."""
        copy = self.model_copy()
        vars(copy).update({name: _settled(value) for name, value in self}, **{SETTLED: True})
        return copy

    def __copy__(self) -> Self:
        copy = super().__copy__()
        vars(copy).pop(SETTLED, None)
        return copy

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        copy = super().__deepcopy__(memo)
        vars(copy).pop(SETTLED, None)
        return copy


def _settled(value: Any) -> Any:
    if isinstance(value, Table):
        return value.settled()
    if isinstance(value, list):
        return [_settled(each) for each in value]
    return value
