"""Values with their units as engineers write them: `0.0466 mrad` and `47.1 GB`, no exponents."""

from __future__ import annotations

import math
from typing import Any

from hil.report.words import UNKNOWN, count, number, with_unit_apart

PREFIXES = {1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}
SMALLER = ("rad", "rad/s", "rad/s²", "m", "m/s", "m/s²", "s", "A", "V", "W", "N", "N·m")
"""Units that are said in thousandths. What is large in them stays so: 1200 N·m is no kN·m here."""

BYTES = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9}
LEAST = 1e-3
"""A single value below it, or a pair below a hundred times as much, is said in a smaller unit."""


def measure(value: Any, unit: Any) -> str:
    """A value in the unit that suits it: `0.350 A`, `0.0466 mrad`, `47.1 GB`; UNKNOWN for none."""
    known = _known(value)
    factor, shown = _suiting(abs(known), str(unit or ""), LEAST)
    return _said(known / factor, shown)


def measures(value: Any, limit: Any, unit: Any) -> tuple[str, str]:
    """A value and its limit in one unit, that of the greater: `0.0466 mrad` and `20 mrad`."""
    known, bound = _known(value), _known(limit)
    greater = max((abs(one) for one in (known, bound) if math.isfinite(one)), default=0.0)
    factor, shown = _suiting(greater, str(unit or ""), 100 * LEAST)
    return _said(known / factor, shown), _said(bound / factor, shown, exact=True)


def named(key: str, value: Any) -> tuple[str, str]:
    """A key that ends in its unit, and its value: `clearance_m` → `clearance`, `0.0220 m`."""
    name, _, unit = with_unit_apart(key).removesuffix("]").partition(" [")
    return name, measure(value, unit)


def size(n_bytes: float) -> str:
    """`532 B`, `1.20 MB` and the like, in powers of ten."""
    return measure(n_bytes, "B") if n_bytes >= 1e3 else f"{n_bytes:.0f} B"


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


def _said(value: float, unit: str, *, exact: bool = False) -> str:
    """A limit is exact: it has more digits, and no noughts at its end."""
    text = _figure(value, 4 if exact else 3)
    if exact and "." in text:
        text = text.rstrip("0").rstrip(".")
    return text if unit in ("", "1") or text == UNKNOWN else f"{text} {unit}"


def _figure(value: float, digits: int) -> str:
    """So many digits; thousands apart; what would be a row of noughts is less than a thousandth."""
    if not math.isfinite(value) or not value:
        return number(value)
    if abs(value) < 0.9995e-3:
        return "< 0.001" if value > 0 else "> -0.001"
    return number(value, digits) if abs(value) < 999.5 else count(round(value))


def _known(value: Any) -> float:
    ok = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    return float(value) if ok else math.nan
