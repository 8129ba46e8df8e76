"""Unit suffixes of keys (`dwell_s`, `limit_rad`), for explaining and correcting keys."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import NamedTuple


class Unit(NamedTuple):
    """Unit of measurement.

    A value is converted into the reference unit of its dimension by `value * factor + offset`.
    """

    symbol: str
    dimension: str
    factor: float = 1.0
    offset: float = 0.0


_DEG = math.pi / 180

UNITS = {
    "s": Unit("s", "time"),
    "ms": Unit("ms", "time", 1e-3),
    "us": Unit("µs", "time", 1e-6),
    "min": Unit("min", "time", 60.0),
    "h": Unit("h", "time", 3600.0),
    "hz": Unit("Hz", "frequency"),
    "khz": Unit("kHz", "frequency", 1e3),
    "kg": Unit("kg", "mass"),
    "g": Unit("g", "mass", 1e-3),
    "lb": Unit("lb", "mass", 0.45359237),
    "m": Unit("m", "length"),
    "cm": Unit("cm", "length", 1e-2),
    "mm": Unit("mm", "length", 1e-3),
    "in": Unit("in", "length", 0.0254),
    "rad": Unit("rad", "angle"),
    "deg": Unit("°", "angle", _DEG),
    "rad_s": Unit("rad/s", "angular velocity"),
    "deg_s": Unit("°/s", "angular velocity", _DEG),
    "rpm": Unit("rpm", "angular velocity", math.pi / 30),
    "rad_s2": Unit("rad/s²", "angular acceleration"),
    "deg_s2": Unit("°/s²", "angular acceleration", _DEG),
    "rad_s3": Unit("rad/s³", "angular jerk"),
    "deg_s3": Unit("°/s³", "angular jerk", _DEG),
    "m_s2": Unit("m/s²", "acceleration"),
    "kgm2": Unit("kg·m²", "inertia"),
    "c": Unit("°C", "temperature"),
    "k": Unit("K", "temperature", 1.0, -273.15),
    "f": Unit("°F", "temperature", 5 / 9, -160 / 9),
    "nm": Unit("N·m", "torque"),
    "a": Unit("A", "current"),
    "ma": Unit("mA", "current", 1e-3),
    "percent": Unit("%", "share", 1e-2),
    "mb": Unit("MB", "information", 1e6),
    "gb": Unit("GB", "information", 1e9),
}
"""Unit by key suffix; units of the same dimension can be converted into each other."""

_BY_LENGTH = sorted(UNITS, key=len, reverse=True)
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s].{0,15}?)\s*")
_SPELLINGS = {"°": "deg", "°c": "c", "°f": "f", "%": "percent", "µs": "us", "sec": "s", "n·m": "nm"}


def split_unit(key: str) -> tuple[str, str]:
    """Return stem and unit suffix of a key: `mass_kg` → (`mass`, `kg`), `seed` → (`seed`, '')."""
    for suffix in _BY_LENGTH:
        if key.endswith(f"_{suffix}"):
            return key[: -len(suffix) - 1], suffix
    return key, ""


def symbol_of(key: str) -> str:
    """Return the symbol of the unit of a key (`kg·m²`), or an empty string."""
    suffix = split_unit(key)[1]
    return UNITS[suffix].symbol if suffix else ""


def same_quantity(key: str, known: Iterable[str]) -> str | None:
    """Return the known key for the same quantity in a different unit; None if there is no such key.

    For example, `mass_g`, `mass` and `Mass_KG` give `mass_kg`. Known keys without a unit are
    ignored in this search.
    """
    stem = split_unit(key.casefold())[0]
    for option in known:
        option_stem, suffix = split_unit(option)
        if suffix and option_stem == stem:
            return option
    return None


def converted(value: object, from_suffix: str, to_suffix: str) -> str | None:
    """Return a number in a different unit of the same dimension, as text; None if impossible."""
    source, target = UNITS.get(from_suffix), UNITS.get(to_suffix)
    if source is None or target is None or source.dimension != target.dimension:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return f"{(value * source.factor + source.offset - target.offset) / target.factor:.6g}"


def parse_quantity(text: str) -> tuple[float, str] | None:
    """Return number and unit suffix of a text: `95 ms` → (95.0, `ms`); None for other texts."""
    match = _QUANTITY.fullmatch(text[:64])
    if match is None:
        return None
    unit = match[2].casefold().replace("^", "").replace("²", "2").replace("³", "3")
    suffix = "_".join(_SPELLINGS.get(part, part) for part in unit.split("/"))
    return (float(match[1]), suffix) if suffix in UNITS else None
