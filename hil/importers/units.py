"""Units a file's columns may be in, and the SI unit each quantity is kept in."""

from __future__ import annotations

from hil.core import UNITS, Unit

QUANTITY_DIMENSIONS = {
    "t": ("time",),
    "q": ("angle",),
    "qd": ("angular velocity",),
    "effort": ("current", "torque"),
    "temperature": ("temperature",),
    "q_target": ("angle",),
    "qd_target": ("angular velocity",),
    "qdd_target": ("angular acceleration",),
    "effort_target": ("current", "torque"),
    "torque_target": ("torque",),
}
"""Which dimensions each quantity of a recording may have."""

SI_SYMBOL = {
    "time": "s",
    "angle": "rad",
    "angular velocity": "rad/s",
    "angular acceleration": "rad/s²",
    "current": "A",
    "torque": "N·m",
    "temperature": "°C",
}

_MORE = {
    "ns": Unit("ns", "time", 1e-9),
    "rev": Unit("rev", "angle", 6.283185307179586),
    "mrad": Unit("mrad", "angle", 1e-3),
    "mnm": Unit("mN·m", "torque", 1e-3),
    "knm": Unit("kN·m", "torque", 1e3),
}
_SPELLINGS = {"°": "deg", "°c": "c", "°f": "f", "µs": "us", "sec": "s", "amp": "a"}


def unit_named(text: str) -> Unit | None:
    """The unit people write as `deg/s`, `deg_s`, `N·m`, `Nm`, `mA`, `rad/s²` …, or None."""
    plain = text.strip().casefold().replace("·", "").replace("*", "").replace("^", "")
    plain = plain.replace("²", "2")
    suffix = "_".join(_SPELLINGS.get(part, part) for part in plain.split("/"))
    return _MORE.get(suffix) or UNITS.get(suffix)


def units_of(dimensions: tuple[str, ...]) -> list[str]:
    """Symbols of the units that measure any of these dimensions."""
    known = {**UNITS, **_MORE}.values()
    return [unit.symbol for unit in known if unit.dimension in dimensions]
