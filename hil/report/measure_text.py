"""Values with their units as engineers write them: `0.0466 mrad` and `47.1 GB`, no exponents."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

from hil.report.words import UNKNOWN, count, number, with_unit_apart

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


def measures(value: Any, limit: Any, unit: Any) -> tuple[str, str]:
    """A value and its limit in one unit, that of the greater: `0.0466 mrad` and `20 mrad`."""
    known, bound = _known(value), _known(limit)
    greater = max((abs(one) for one in (known, bound) if math.isfinite(one)), default=0.0)
    factor, shown = _suiting(greater, str(unit or ""), 100 * LEAST)
    figure = _figure_beside(known / factor, bound / factor)
    return _with(figure, shown), _with(_exact(bound / factor), shown)


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


def _figure_beside(value: float, bound: float) -> str:
    """As many digits as tell on which side of its limit a value is: 150.4 is beyond 150."""
    figure = _figure(value)
    if not math.isfinite(bound - value) or figure[0] in "<>":
        return figure
    for digits in range(3, MOST_DIGITS):
        if _side(_rounded(value, digits), bound) == _side(value, bound):
            return figure if digits == 3 else _digits(value, digits)
    return figure


def _exact(value: float) -> str:
    """A limit, which somebody set: all its digits up to six, and no noughts at its end."""
    if not math.isfinite(value) or not value:
        return number(value)
    text = _digits(value, LIMIT_DIGITS)
    return text.rstrip("0").rstrip(".") if "." in text else text


def _digits(value: float, digits: int) -> str:
    return f"{value:,.{_decimals(value, digits)}f}".replace(",", "\u202f")


def _rounded(value: float, digits: int) -> float:
    """What is read where a value has so many digits."""
    return float(f"{value:.{_decimals(value, digits)}f}")


def _decimals(value: float, digits: int) -> int:
    """Of what is shown: 99.97 is 100 in three digits, and not 100.0."""
    magnitude = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return max(0, digits - 1 - magnitude)


def _side(value: float, bound: float) -> int:
    return (value > bound) - (value < bound)


def _known(value: Any) -> float:
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        known = float(value)
    except OverflowError:  # of a whole number
        return math.nan
    return known if abs(known) < 1e300 else math.nan
