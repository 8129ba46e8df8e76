"""How numbers, units, times and metrics are said, on the page and in the terminal alike.

`number` shows significant digits of a bare number. `measure` shows a value with its unit as
engineers write it, `0.0466 mrad` and `47.1 GB`, without exponents.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from numbers import Real
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


_UNITS = {
    "_rad_s2": "rad/s²",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_nm": "N·m",
    "_kg": "kg",
    "_m": "m",
    "_s": "s",
}


def with_unit_apart(key: str) -> str:
    """A key that ends in its unit, as people write it: `velocity_rad_s` → `velocity [rad/s]`."""
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} [{unit}]"
    return key.replace("_", " ")


PREFIXES = {1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}

SMALLER = ("rad", "rad/s", "rad/s²", "m", "m/s", "m/s²", "s", "A", "V", "W", "N", "N·m")
"""Units that are said in thousandths. What is large in them stays so: 1200 N·m is no kN·m here."""

BYTES = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9}
LIMIT_DIGITS = 6

MOST_DIGITS = 9
"""Of a value that is all but its limit; what is nearer is taken for equal."""

LEAST = 1e-3
"""A single value below it, or a pair below a hundred times as much, is said in a smaller unit."""


def measure(value: Any, unit: Any) -> str:
    """A value in the unit that suits it: `0.350 A`, `0.0466 mrad`, `47.1 GB`; UNKNOWN for none."""
    known = _known(value)
    factor, shown = _suiting(abs(known), str(unit or ""), LEAST)
    return _with(_figure(known / factor), shown)


def _known(value: Any) -> float:
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        known = float(value)
    except OverflowError:  # of a whole number
        return math.nan
    return known if abs(known) < 1e300 else math.nan


def _suiting(greatest: float, unit: str, least: float) -> tuple[float, str]:
    """What to divide by, and the unit then."""
    if not math.isfinite(greatest) or not greatest:
        return 1.0, unit
    if unit in BYTES:
        fitting = [name for name, one in BYTES.items() if greatest * BYTES[unit] >= 0.9995 * one]
        shown = fitting[-1] if fitting else "B"
        return BYTES[shown] / BYTES[unit], shown
    if unit not in SMALLER:
        return 1.0, unit
    factor = next((one for one in PREFIXES if greatest >= least * one), 1e-9)
    return factor, PREFIXES[factor] + unit


def _with(figure: str, unit: str) -> str:
    return figure if unit in ("", "1") or figure == UNKNOWN else f"{figure} {unit}"


def _figure(value: float) -> str:
    """Three digits; thousands apart; what would be a row of noughts is less than a thousandth."""
    if not math.isfinite(value) or not value:
        return number(value)
    if abs(value) < 0.9995e-3:
        return "< 0.001" if value > 0 else "> -0.001"
    return number(value) if abs(value) < 999.5 else count(round(value))


def measures(value: Any, limit: Any, unit: Any) -> tuple[str, str]:
    """A value and its limit in one unit, that of the greater: `0.0466 mrad` and `20 mrad`."""
    known, bound = _known(value), _known(limit)
    greater = max((abs(one) for one in (known, bound) if math.isfinite(one)), default=0.0)
    factor, shown = _suiting(greater, str(unit or ""), 100 * LEAST)
    figure = _figure_beside(known / factor, bound / factor)
    return _with(figure, shown), _with(_exact(bound / factor), shown)


def _figure_beside(value: float, bound: float) -> str:
    """As many digits as tell on which side of its limit a value is: 150.4 is beyond 150."""
    figure = _figure(value)
    if not math.isfinite(bound - value) or figure[0] in "<>":
        return figure
    for digits in range(3, MOST_DIGITS):
        if _side(_rounded(value, digits), bound) == _side(value, bound):
            return figure if digits == 3 else _digits(value, digits)
    return figure


def _side(value: float, bound: float) -> int:
    return (value > bound) - (value < bound)


def _rounded(value: float, digits: int) -> float:
    """What is read where a value has so many digits."""
    return float(f"{value:.{_decimals(value, digits)}f}")


def _decimals(value: float, digits: int) -> int:
    """Of what is shown: 99.97 is 100 in three digits, and not 100.0."""
    magnitude = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return max(0, digits - 1 - magnitude)


def _digits(value: float, digits: int) -> str:
    return f"{value:,.{_decimals(value, digits)}f}".replace(",", "\u202f")


def _exact(value: float) -> str:
    """A limit, which somebody set: all its digits up to six, and no noughts at its end."""
    if not math.isfinite(value) or not value:
        return number(value)
    text = _digits(value, LIMIT_DIGITS)
    return text.rstrip("0").rstrip(".") if "." in text else text


def named(key: str, value: Any) -> tuple[str, str]:
    """A key that ends in its unit, and its value: `clearance_m` → `clearance`, `0.0220 m`."""
    name, _, unit = with_unit_apart(key).removesuffix("]").partition(" [")
    return name, measure(value, unit)


def size(n_bytes: float) -> str:
    """`532 B`, `1.20 MB` and the like, in powers of ten."""
    if not math.isfinite(n_bytes):
        return UNKNOWN
    whole = round(n_bytes)
    return measure(whole, "B") if abs(whole) >= 1000 else f"{whole} B"
