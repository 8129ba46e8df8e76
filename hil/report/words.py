"""How numbers, times and metrics are said, on the page and in the terminal alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import PurePath
from typing import Any

UNKNOWN = "–"
"""What is shown in place of a number that is not known."""

LATE = "more than 1.5 periods after the one before; none is lost"
"""What a late sample is."""

METRIC_WORDS = {
    "rmse_raw": "RMSE raw",
    "rmse_filtered": "RMSE filtered",
    "nrmse": "NRMSE",
    "mep": "MEP",
    "r": "R",
    "gaps_percent": "missing samples",
    "load_error_ratio": "error under a load over that with the first",
    "contradicted_loads": "declared loads contradicted",
}


def number(value: float | None, digits: int = 3) -> str:
    """`value` with `digits` significant digits, never in exponents a reader stumbles over."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    # Of what is shown: 99.97 is 100 in three digits, and not 100.0.
    magnitude = int(f"{value:.{digits - 1}e}".partition("e")[2])
    if -4 <= magnitude < 6:
        return f"{value:.{max(0, digits - 1 - magnitude)}f}"
    return f"{value:.{digits - 1}e}"


def count(value: int) -> str:
    """A whole number with its thousands apart (narrow no-break spaces)."""
    return f"{value:,}".replace(",", "\u202f")


def counted(number: Any, what: str) -> str:
    """`1 gap`, `2 gaps`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def duration(seconds: float | None) -> str:
    """`12.3 s`, `4 min 05 s` or `1 h 19 min`."""
    if seconds is None or not math.isfinite(seconds):
        return UNKNOWN
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def when(text: Any) -> str:
    """An ISO time as people write it, in UTC; the text itself when it is none."""
    try:
        told = datetime.fromisoformat(str(text))
    except ValueError:
        return str(text or "")
    there = told if told.tzinfo is None else told.astimezone(UTC)
    return there.strftime("%d %b %Y, %H:%M UTC")


def listed(names: Sequence[str], most: int = 4) -> str:
    """`a, b, c and 5 more`."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"


def in_words(value: Any) -> str:
    """A value of a JSON document as people write it, such as `torque (stop, 26 N·m)`."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        named = str(value.get("name") or "")
        rest = [f"{k} {in_words(v)}" for k, v in value.items() if k != "name" and v != ""]
        return f"{named} ({', '.join(rest)})" if named else ", ".join(rest)
    if isinstance(value, list):
        # What has commas of its own is kept apart by semicolons.
        apart = "; " if any(isinstance(item, Mapping | list) for item in value) else ", "
        return apart.join(map(in_words, value)) or UNKNOWN
    return UNKNOWN if value is None else str(value)


def quantity(unit: str) -> str:
    """What an effort in this unit is."""
    return "motor current" if unit == "A" else "joint torque"


def joint_title(j: int, name: str) -> str:
    """`J2 shoulder_lift_joint`."""
    return f"J{j + 1} {name}"


def with_unit(value: Any, unit: Any) -> str:
    """A number and its unit; dimensionless ones have the unit `1`, which is not said."""
    said = number(float(value)) if isinstance(value, int | float) else UNKNOWN
    return said if unit in (None, "", "1") else f"{said} {unit}"


def criterion_text(row: Mapping[str, Any]) -> str:
    """A row of a verdict as its criterion: `RMSE raw ≤ 0.02 A`."""
    metric, limit, unit = str(row.get("metric")), row.get("max"), row.get("unit")
    said = f"{limit:g}" if isinstance(limit, int | float) else UNKNOWN
    text = f"{METRIC_WORDS.get(metric, metric)} ≤ {said}"
    return text if unit in (None, "", "1") else f"{text} {unit}"


def short_source(name: str) -> str:
    """A source without the folders it lies in; what follows a `#` or `:` is kept."""
    path, mark, rest = name.partition("#")
    return PurePath(path).name + mark + rest if "/" in path else name


def with_unit_apart(key: str) -> str:
    """A key that ends in its unit, as people write it: `velocity_rad_s` → `velocity [rad/s]`."""
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} [{unit}]"
    return key.replace("_", " ")


_UNITS = {
    "_rad_s2": "rad/s²",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_nm": "N·m",
    "_kg": "kg",
    "_m": "m",
    "_s": "s",
}
