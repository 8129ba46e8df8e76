"""How the loads of a sweep are weighed: is what hangs at the flange what the spec declares?"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from hil.spec.field_types import IS_NUMBER, NonNegative, Positive, Strict


class Weigh(Strict):
    """Each load is weighed against the first before it is measured; `weigh: false` switches it off.

    The default tolerances are measured ones: docs/explanation/weighing.md.
    """

    poses: Annotated[int, Field(ge=0, le=10), IS_NUMBER] = Field(
        2, description="How many poses, each from both sides; 0 switches weighing off."
    )
    tolerance_kg: Positive = Field(
        0.15, description="How far from the declared mass the weighed one may be, for any load."
    )
    tolerance_percent: NonNegative = Field(
        10.0, description="So much more of the load's mass difference to the first load."
    )
    tolerance_com_m: Positive = Field(
        0.03, description="How far from the declared centre of mass the weighed one may be."
    )


def _off(value: Any) -> Any:
    return None if value is False else value


OptionalWeigh = Annotated[
    Weigh | None, BeforeValidator(_off, json_schema_input_type=Weigh | Literal[False] | None)
]
"""`weigh: false` and `weigh: null` say the same."""
