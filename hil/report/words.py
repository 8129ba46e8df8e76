"""Text formatting of numbers, units, times and metrics for page and terminal.

The function `number` formats a number with a certain number of significant digits. The function
`measure` formats a value with its unit and a suitable prefix instead of an exponent, as in `0.0466
mrad` and `47.1 GB`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from numbers import Real
from pathlib import PurePath
from typing import Any

UNKNOWN = "–"
"""Text that is displayed for an unknown number."""

LATE = "more than 1.5 periods after the one before; none is lost"
"""Text that explains the term “late sample”."""

METRIC_WORDS = {
    "rmse_raw": "RMSE raw",
    "rmse_filtered": "RMSE filtered",
    "nrmse": "NRMSE",
    "mep": "MEP",
    "r": "R",
    "gaps_percent": "missing samples",
    "load_error_ratio": "error under a load relative to the first load",
    "contradicted_loads": "declared loads contradicted",
}


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with `digits` significant digits.

    Exponents are used only for magnitudes below 0.0001 and from 1,000,000 on.
    """
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    # Use the magnitude of the rounded number: with three digits, 99.97 becomes 100, not 100.0.
    magnitude = int(f"{value:.{digits - 1}e}".partition("e")[2])
    if -4 <= magnitude < 6:
        return f"{value:.{max(0, digits - 1 - magnitude)}f}"
    return f"{value:.{digits - 1}e}"


def count(value: int) -> str:
    """Return an integer with narrow no-break spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def counted(number: Any, what: str) -> str:
    """Return a count with its noun, as in `1 gap` and `2 gaps`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def duration(seconds: float | None) -> str:
    """Return a duration as text, such as `12.3 s`, `4 min 05 s` or `1 h 19 min`."""
    if seconds is None or not math.isfinite(seconds):
        return UNKNOWN
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def when(text: Any) -> str:
    """Return an ISO time as readable text in UTC; an invalid time is returned unchanged."""
    try:
        told = datetime.fromisoformat(str(text))
    except ValueError:
        return str(text or "")
    there = told if told.tzinfo is None else told.astimezone(UTC)
    return there.strftime("%d %b %Y, %H:%M UTC")


def listed(names: Sequence[str], most: int = 4) -> str:
    """Return a list of names as text, such as `a, b, c and 5 more`."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"


def in_words(value: Any) -> str:
    """Return a value of a JSON document as readable text, such as `torque (stop, 26 N·m)`."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        named = str(value.get("name") or "")
        rest = [f"{k} {in_words(v)}" for k, v in value.items() if k != "name" and v != ""]
        return f"{named} ({', '.join(rest)})" if named else ", ".join(rest)
    if isinstance(value, list):
        # Items that contain commas are separated by semicolons.
        apart = "; " if any(isinstance(item, Mapping | list) for item in value) else ", "
        return apart.join(map(in_words, value)) or UNKNOWN
    return UNKNOWN if value is None else str(value)


def quantity(unit: str) -> str:
    """Return the name of the quantity that a unit of effort measures."""
    return "motor current" if unit == "A" else "joint torque"


def joint_title(j: int, name: str) -> str:
    """Return the title of a joint, such as `J2 shoulder_lift_joint`."""
    return f"J{j + 1} {name}"


def with_unit(value: Any, unit: Any) -> str:
    """Return a number with its unit as text; the unit `1` of a dimensionless number is omitted."""
    said = number(float(value)) if isinstance(value, int | float) else UNKNOWN
    return said if unit in (None, "", "1") else f"{said} {unit}"


def criterion_text(row: Mapping[str, Any]) -> str:
    """Return the criterion of a verdict row as text, such as `RMSE raw ≤ 0.02 A`."""
    metric, limit, unit = str(row.get("metric")), row.get("max"), row.get("unit")
    said = f"{limit:g}" if isinstance(limit, int | float) else UNKNOWN
    text = f"{METRIC_WORDS.get(metric, metric)} ≤ {said}"
    return text if unit in (None, "", "1") else f"{text} {unit}"


def short_source(name: str) -> str:
    """Return the name of a data source without its folders; text after a `#` or `:` is retained."""
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
    """Return a key with its unit in brackets: `velocity_rad_s` → `velocity [rad/s]`."""
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} [{unit}]"
    return key.replace("_", " ")


PREFIXES = {1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}

SMALLER = ("rad", "rad/s", "rad/s²", "m", "m/s", "m/s²", "s", "A", "V", "W", "N", "N·m")
"""Units that get a prefix for small values; large values have no prefix, as in 1200 N·m."""

BYTES = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9}
LIMIT_DIGITS = 6

MOST_DIGITS = 9
"""Maximum number of digits that are used to distinguish a value from its limit.

If a value is so close to its limit that more digits would be needed, the two are shown as equal.
"""

LEAST = 1e-3
"""Value, in the displayed unit, below which a smaller unit is chosen.

For a pair of value and limit, the larger of the two numbers is compared with 100 times this
threshold.
"""


def measure(value: Any, unit: Any) -> str:
    """Return a value with a suitable unit, such as `0.350 A`, `0.0466 mrad` or `47.1 GB`.

    A missing value yields the text UNKNOWN.
    """
    known = _known(value)
    factor, shown = _suiting(abs(known), str(unit or ""), LEAST)
    return _with(_figure(known / factor), shown)


def _known(value: Any) -> float:
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        known = float(value)
    except OverflowError:  # an integer that is too large for a float
        return math.nan
    return known if abs(known) < 1e300 else math.nan


def _suiting(greatest: float, unit: str, least: float) -> tuple[float, str]:
    """Return the divisor that converts a value to a suitable unit, and this unit."""
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
    """Return a number as text with three digits and separated thousands.

    A positive number below 0.001 is shown as `< 0.001`, a negative number above -0.001 as `>
    -0.001`.
    """
    if not math.isfinite(value) or not value:
        return number(value)
    if abs(value) < 0.9995e-3:
        return "< 0.001" if value > 0 else "> -0.001"
    return number(value) if abs(value) < 999.5 else count(round(value))


def measures(value: Any, limit: Any, unit: Any) -> tuple[str, str]:
    """Return a value and its limit in a common unit, such as `0.0466 mrad` and `20 mrad`.

    The common unit suits the larger of the two numbers.
    """
    known, bound = _known(value), _known(limit)
    greater = max((abs(one) for one in (known, bound) if math.isfinite(one)), default=0.0)
    factor, shown = _suiting(greater, str(unit or ""), 100 * LEAST)
    figure = _figure_beside(known / factor, bound / factor)
    return _with(figure, shown), _with(_exact(bound / factor), shown)


def _figure_beside(value: float, bound: float) -> str:
    """Return a number with enough digits to show on which side of its limit the number is.

    For example, the value 150.4 is shown with four digits if its limit is 150.
    """
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
    """Return the number that results from displaying a number with `digits` digits."""
    return float(f"{value:.{_decimals(value, digits)}f}")


def _decimals(value: float, digits: int) -> int:
    """Return the number of decimals that correspond to `digits` significant digits.

    The decimals are those of the rounded number: with three digits, 99.97 becomes 100 and not
    100.0.
    """
    magnitude = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return max(0, digits - 1 - magnitude)


def _digits(value: float, digits: int) -> str:
    return f"{value:,.{_decimals(value, digits)}f}".replace(",", "\u202f")


def _exact(value: float) -> str:
    """Return a limit as text with up to six digits and without trailing zeros."""
    if not math.isfinite(value) or not value:
        return number(value)
    text = _digits(value, LIMIT_DIGITS)
    return text.rstrip("0").rstrip(".") if "." in text else text


def named(key: str, value: Any) -> tuple[str, str]:
    """Return the name and the formatted value of a key whose name ends in its unit.

    For example, the key `clearance_m` yields `clearance` and `0.0220 m`.
    """
    name, _, unit = with_unit_apart(key).removesuffix("]").partition(" [")
    return name, measure(value, unit)


def size(n_bytes: float) -> str:
    """Return a number of bytes as text, such as `532 B` or `1.20 MB`, with decimal prefixes."""
    if not math.isfinite(n_bytes):
        return UNKNOWN
    whole = round(n_bytes)
    return measure(whole, "B") if abs(whole) >= 1000 else f"{whole} B"
