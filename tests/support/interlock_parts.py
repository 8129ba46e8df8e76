"""State rows of a robot that stands still and is fine, and what is known of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter

from hil.core.typing import StructArray
from hil.engine.interlocks import Interlock, InterlockContext, interlocks_from_spec
from hil.robot import Status, state_dtype
from hil.spec.interlocks import Interlock as InterlockSpec

N = 6
NAMES = tuple(f"j{i + 1}" for i in range(N))


def rows(count: int = 4, *, moving: bool = False, **values: Any) -> StructArray:
    """`count` rows at 125 Hz; `values` are fields."""
    block = np.zeros(count, state_dtype(N))
    block["device_time"] = np.arange(count) / 125.0
    block["temperature"] = 30.0
    block["status"] = Status.MOVING if moving else Status.HOLDING
    for field, value in values.items():
        block[field] = value
    return block


def with_value(field: str, value: float, row: int = 2, joint: int = 3, **more: Any) -> StructArray:
    """Rows in which one value of one joint is not as the others."""
    block = rows(**more)
    block[field][row, joint] = value
    return block


def spec_of(**entry: Any) -> Any:
    """One entry of `interlocks`, as a spec would hold it."""
    return TypeAdapter(InterlockSpec).validate_python(entry)


def made(context: InterlockContext | None = None, **entry: Any) -> Interlock:
    """The one interlock that an entry asks for."""
    (interlock,) = interlocks_from_spec(
        [spec_of(**entry)], context or InterlockContext(joint_names=NAMES)
    )
    return interlock
