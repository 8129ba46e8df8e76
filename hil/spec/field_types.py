"""Field types of specs: strict numbers, names and joint ranges."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError


def mistake(message: str, *at: str | int) -> PydanticCustomError:
    """Return the error to raise for values that are valid alone but not together.

    Args:
        message: Description of the problem in plain words.
        at: Keys that lead from the model that raises the error to the invalid value.
    """
    return PydanticCustomError("mistake", "{message}", {"message": message, "at": list(at)})


def _number(value: Any) -> Any:
    # Pydantic would accept "3" as 3 and true as 1; in a file both are errors.
    if isinstance(value, bool | str):
        raise PydanticCustomError("not_a_number", "must be a number")
    return value


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise mistake(f"the range must go from low to high, not from {pair[0]:g} to {pair[1]:g}")
    return pair


IS_NUMBER = BeforeValidator(_number)
"""Validator that accepts only numbers; must be the last entry of `Annotated`.

Limits that follow this validator would be missing in the JSON Schema.
"""

Finite = Annotated[float, Field(allow_inf_nan=False), IS_NUMBER]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), IS_NUMBER]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), IS_NUMBER]
Count = Annotated[int, Field(ge=0), IS_NUMBER]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1), IS_NUMBER]
FormatVersion = Annotated[Literal[1], IS_NUMBER]
Vector3 = tuple[Finite, Finite, Finite]
JointRange = Annotated[tuple[Finite, Finite], AfterValidator(_ascending)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]

RobotAddresses = Annotated[
    dict[Name, str],
    Field(
        description="Address of every real robot that moves, by its name in the station, such as "
        "`{ur5: 192.168.0.5}`; mocks and loopback addresses need no entry."
    ),
]
"""Key `robots` of schedules and other files whose runs move robots without an operator."""


class Strict(BaseModel):
    """Base class of every part of a spec: immutable, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)
