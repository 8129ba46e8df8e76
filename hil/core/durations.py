"""Conversion of durations in the notation of schedules: `7d`, `90min`, `1h30min`."""

from __future__ import annotations

import re
from datetime import timedelta
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema
from pydantic_core import PydanticCustomError

SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
PATTERN = r"^(\d+(\.\d+)?(s|min|h|d|w))+$"
_PART = re.compile(r"(\d+(?:\.\d+)?)(s|min|h|d|w)")
_MOST = timedelta(days=36_500)


def duration_of(text: str) -> timedelta:
    """Return the duration that a text such as `90min` describes.

    Raises:
        ValueError: The text is not a duration, or the duration exceeds 100 years.
    """
    if not re.match(PATTERN, text):
        raise ValueError(f"must be a duration such as 7d, 12w, 8h or 90min, not {text!r}")
    seconds = sum(float(number) * SECONDS[unit] for number, unit in _PART.findall(text))
    if seconds > _MOST.total_seconds():
        raise ValueError(f"must be at most 100 years, not {text!r}")
    return timedelta(seconds=seconds)


def duration_text(duration: timedelta) -> str:
    """Return the text for a duration in whole seconds; inverse of `duration_of`."""
    left, parts = round(duration.total_seconds()), []
    for unit in ("w", "d", "h", "min", "s"):
        count, left = divmod(left, int(SECONDS[unit]))
        parts += [f"{count}{unit}"] if count else []
    return "".join(parts) or "0s"


def _from_yaml(value: Any) -> Any:
    if isinstance(value, timedelta):
        return value
    try:
        return duration_of(value if isinstance(value, str) else str(value))
    except ValueError as error:
        raise PydanticCustomError("mistake", "{message}", {"message": str(error), "at": []}) from (
            error
        )


Duration = Annotated[
    timedelta,
    BeforeValidator(_from_yaml),
    PlainSerializer(duration_text),
    WithJsonSchema({"type": "string", "pattern": PATTERN, "examples": ["7d", "90min"]}),
]
