"""The kinds of values specs are made of: numbers that are numbers, names, joint ranges."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError


def mistake(message: str, *at: str | int) -> PydanticCustomError:
    """The error a validator raises for values that are fine alone but not together.

    Args:
        message: What cannot be, in plain words.
        at: Keys from the model that raises down to the value to be mended.
    """
    return PydanticCustomError("mistake", "{message}", {"message": message, "at": list(at)})


def _number(value: Any) -> Any:
    # Pydantic would take "3" for 3 and true for 1; in a file both are slips.
    if isinstance(value, bool | str):
        raise PydanticCustomError("not_a_number", "must be a number")
    return value


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise mistake(f"the range must go from low to high, not from {pair[0]:g} to {pair[1]:g}")
    return pair


IS_NUMBER = BeforeValidator(_number)
"""Goes last in `Annotated`: limits that follow it would be lost to the JSON Schema."""

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
"""`robots:` key of schedules and other files whose runs move robots unattended."""


class Strict(BaseModel):
    """Base of every spec part: immutable, and a key nobody knows is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)
