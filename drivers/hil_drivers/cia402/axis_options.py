"""What a station may say about each axis: fields of `AxisProfile` (angles in degrees), gains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hil.arms import ArmDescription
from hil_drivers.cia402 import option_checks as must
from hil_drivers.cia402.profile import COUNTS_PER_REV_S

RANGES: dict[str, must.Range] = {
    "gear_ratio": (0.01, 10_000.0),
    "rated_current_a": (1e-3, 10_000.0),
    "rated_torque_nm": (1e-4, 100_000.0),
    "torque_constant_nm_a": (1e-5, 1000.0),
    "offset_deg": (-1e6, 1e6),
    "quick_stop_rad_s2": (0.1, 10_000.0),
    "stiffness_nm_rad": (0.0, 1e6),
    "damping_nms_rad": (0.0, 1e5),
}
WHOLE: dict[str, must.Range] = {
    "encoder_increments": (1, 2**32 - 1),
    "encoder_revolutions": (1, 2**32 - 1),
}
CHOICES: dict[str, tuple[Any, ...]] = {
    "polarity": tuple(range(0, 0x100, 0x20)),
    "direction": (1, -1),
    "velocity_unit": ("increments/s", *COUNTS_PER_REV_S),
    "torque_of": ("rated-torque", "rated-current"),
    "rated_current_is": ("rms", "peak"),
}
KEYS = (*WHOLE, *RANGES, *CHOICES, "position_unsigned")


def axes_of(value: Any, arm: ArmDescription) -> tuple[Mapping[str, Any], ...]:
    """What the station says of each axis, by the names of `AxisProfile`.

    Args:
        value: The option `axes`: per key one value for all axes, or one for each.
        arm: Says where the middle of each joint's range is.

    Raises:
        SpecError: A key is unknown, or a value cannot be.
    """
    given = must.mapping_of("axes", value)
    must.require_known(given, KEYS, "axes")
    n = arm.n_joints
    columns = {key: must.per_axis(f"axes.{key}", given[key], n) for key in given}
    centres = 0.5 * (arm.q_min + arm.q_max)
    return tuple(
        {**_axis({key: column[i] for key, column in columns.items()}), "centre_rad": float(centre)}
        for i, centre in enumerate(centres)
    )


def _axis(given: Mapping[str, Any]) -> dict[str, Any]:
    axis = {key: _value(key, value) for key, value in given.items()}
    if "offset_deg" in axis:
        axis["offset_rad"] = math.radians(axis.pop("offset_deg"))
    return axis


def _value(key: str, value: Any) -> Any:
    name = f"axes.{key}"
    if key in RANGES:
        return must.number(name, value, RANGES[key])
    if key in WHOLE:
        return must.number(name, value, WHOLE[key], whole=True)
    if key in CHOICES:
        return must.choice(name, value, CHOICES[key])
    return must.truth(name, value)
