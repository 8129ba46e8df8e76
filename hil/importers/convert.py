"""From the file's numbers to SI, and from there to the rows of the base robot record."""

from __future__ import annotations

import numpy as np

from hil.arms import arm_names, load_arm
from hil.core import DataError, FloatArray
from hil.importers.checks import check_jumps, check_time, check_values
from hil.importers.import_map import ImportMap, Quantity
from hil.importers.raw import Raw
from hil.importers.units import SI_SYMBOL, unit_named

RANGE_MARGIN = 1.1


def convert(raw: Raw, layout: ImportMap) -> Raw:
    """The same rows in SI units, with everything that makes no sense blamed."""
    time = layout.columns.t
    t = (
        raw.columns["t"] * _factor(time.unit)[0]
        if time.rate_hz is None
        else (np.arange(len(raw)) / time.rate_hz)
    )
    out = Raw({"t": t}, raw.lines, raw.place, dict(raw.problems))
    check_values(out, "t", t, np.array([np.inf]), "s")
    for name, quantity in layout.quantities().items():
        if name in raw.columns:
            out.columns[name] = _to_si(out, name, quantity, raw.columns[name])
    _check_range(out, layout.robot)
    check_time(out, t)
    fastest = layout.columns.qd and layout.columns.qd.limit
    if fastest and layout.columns.qd is not None:
        limit = np.array(fastest) * _factor(layout.columns.qd.unit)[0]
        check_jumps(out, t, out.columns["q"], limit)
    return out


def _check_range(out: Raw, robot: str) -> None:
    """Positions far outside a known arm's range are degrees that were declared as radians."""
    if robot not in arm_names() or "q" not in out.columns:
        return
    arm = load_arm(robot)
    reach = RANGE_MARGIN * np.maximum(np.abs(arm.q_min), np.abs(arm.q_max))
    if out.columns["q"].shape[1] == arm.n_joints:
        check_values(out, "q", out.columns["q"], reach, f"rad, more than a {robot} can turn")


def _to_si(out: Raw, name: str, quantity: Quantity, values: FloatArray) -> FloatArray:
    factor, offset = _factor(quantity.unit)
    scaled = values * np.array(quantity.scale) + np.array(quantity.offset)
    limit = np.array(quantity.limit or (np.inf,))
    check_values(out, name, scaled, limit, quantity.unit)
    if quantity.matrix is not None:
        scaled = scaled @ np.array(quantity.matrix).T
    si: FloatArray = scaled * factor + offset
    unit = unit_named(quantity.unit)
    check_values(out, name, si, np.array([np.inf]), SI_SYMBOL[unit.dimension] if unit else "")
    return si


def _factor(text: str) -> tuple[float, float]:
    unit = unit_named(text)
    if unit is None:
        raise DataError(f"{text!r} is no unit", hint="see the units in docs/reference/maps.md")
    return unit.factor, unit.offset
