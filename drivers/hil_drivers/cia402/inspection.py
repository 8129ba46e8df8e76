"""What a drive says of itself, asked once before it is set up, and what contradicts the station."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from hil.core import SpecError
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.aborts import NOT_THERE, Aborted
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.objects import Entry
from hil_drivers.cia402.profile import INT32, WRAP, AxisProfile, axis_profile

PROFILE_402 = 402
"""Low word of 1000h."""

ASKED = (
    od.DEVICE_TYPE, od.VENDOR, od.PRODUCT, od.REVISION, od.SERIAL,
    od.SUPPORTED_MODES, od.STATUSWORD, od.ERROR_CODE,
    od.ENCODER_INCREMENTS, od.ENCODER_REVOLUTIONS, od.GEAR_MOTOR, od.GEAR_SHAFT,
    od.RATED_CURRENT, od.RATED_TORQUE, od.POLARITY,
    od.POSITION_LIMIT_MIN, od.POSITION_LIMIT_MAX, od.MAX_TORQUE, od.QUICK_STOP_DECELERATION,
)  # fmt: skip
ASKED_TOO = {"el72xx": (od.TORQUE_SCALING, od.TORQUE_CONSTANT)}
"""By device profile."""

MOST_ERRORS = 254
"""1003h has no more; drives keep 8 or 16."""
_SAME, _SAME_GEAR = 0.005, 0.01
"""Numbers of a station and of a drive that differ by less are the same: type plates are rounded."""


def read_if_there(acyclic: Acyclic, axis: int, entry: Entry) -> int | None:
    """An object's value; None where the drive has no such object."""
    try:
        return acyclic.upload(axis, entry)
    except Aborted as error:
        if error.code in NOT_THERE:
            return None
        raise


def objects_of(acyclic: Acyclic, axis: int, profile: str) -> dict[str, int]:
    """All that is asked of a drive, by name."""
    read = {
        entry.name: read_if_there(acyclic, axis, entry)
        for entry in ASKED + ASKED_TOO.get(profile, ())
    }
    return {name: value for name, value in read.items() if value is not None}


def errors_of(acyclic: Acyclic, axis: int) -> list[int]:
    """Codes of a drive's errors: the present one (603Fh), then the newest of its list (1003h)."""
    now = read_if_there(acyclic, axis, od.ERROR_CODE) or 0
    count = min(read_if_there(acyclic, axis, od.ERROR_COUNT) or 0, MOST_ERRORS)
    kept = [
        acyclic.upload(axis, Entry("past error", od.ERROR_COUNT.index, sub, "I")) & 0xFFFF
        for sub in range(1, count + 1)
    ]
    return [now, *kept[kept[:1] == [now] :]] if now else kept


def said_by(objects: Mapping[str, int]) -> dict[str, Any]:
    """Fields of `AxisProfile` in a drive's own words; what is 0 was never set."""
    said: dict[str, Any] = {
        name: objects[name]
        for name in ("encoder_increments", "encoder_revolutions")
        if objects.get(name)
    }
    if objects.get("gear_motor") and objects.get("gear_shaft"):
        said["gear_ratio"] = objects["gear_motor"] / objects["gear_shaft"]
    for name, field in (
        ("rated_current", "rated_current_a"),
        ("rated_torque", "rated_torque_nm"),
        ("torque_constant", "torque_constant_nm_a"),
    ):
        if objects.get(name):
            said[field] = objects[name] / 1000.0
    if "polarity" in objects:
        said["polarity"] = objects["polarity"] & 0xE0
    if "torque_scaling" in objects:
        said["rated_current_is"] = "rms" if objects["torque_scaling"] & 1 else "peak"
    return said


def wrong_kind(objects: Mapping[str, int], modes: Mapping[int, str]) -> Iterator[str]:
    """Why a drive cannot be driven at all.

    Args:
        objects: Of the drive.
        modes: Modes of operation that are needed, with their names.
    """
    kind = objects.get("device_type", 0)
    if kind & 0xFFFF != PROFILE_402:
        yield f"is no CiA 402 drive: {od.DEVICE_TYPE} is {kind:08X}h, its low word should be 0192h"
        return
    able = objects.get("supported_modes", 0)
    lacking = [name for mode, name in modes.items() if not able >> od.MODE_BITS[mode] & 1]
    if lacking:
        yield f"does not know {', '.join(lacking)}: {od.SUPPORTED_MODES} is {able:08X}h"


def contradictions(
    given: Mapping[str, Any], said: Mapping[str, Any], torque_of: str
) -> Iterator[str]:
    """Where station and drive say different things of the same.

    A drive that says 1:1 of its gear was never told of one, and 6076h is not looked at where
    torque goes by the rated current.

    Args:
        given: By the station.
        said: By the drive.
        torque_of: See `AxisProfile`.
    """
    unlike = {name for name in given if name in said and not _same(given[name], said[name])}
    if "gear_ratio" in unlike and said["gear_ratio"] == 1.0:
        unlike.discard("gear_ratio")
    if torque_of == "rated-current":
        unlike.discard("rated_torque_nm")
    for name in sorted(unlike):
        yield f"axes.{name} is {given[name]} in the station, {said[name]} in the drive"


def out_of_range(profile: AxisProfile, q_min: float, q_max: float) -> Iterator[str]:
    """Why the joint's range cannot be counted by the drive."""
    ends = [(q - profile.offset_rad) / profile.rad_per_increment for q in (q_min, q_max)]
    fits = abs(ends[1] - ends[0]) < WRAP
    if not profile.position_unsigned:
        fits = INT32[0] <= min(ends) and max(ends) <= INT32[1]
    if not fits:
        yield (
            f"cannot count from {math.degrees(q_min):.0f} to {math.degrees(q_max):.0f}°: that is "
            f"{min(ends):.0f} to {max(ends):.0f} increments (axes.offset_deg, position_unsigned)"
        )


def profile_of(
    name: str, given: Mapping[str, Any], said: Mapping[str, Any], gear_ratio: float
) -> AxisProfile | str:
    """The axis' profile, or why there is none.

    Args:
        name: Device profile.
        given: By the station.
        said: By the drive.
        gear_ratio: Of the arm as its maker describes it; the drive's has to be the same where the
            station says nothing.
    """
    if "gear_ratio" not in given and (why := _other_gear(said.get("gear_ratio", 1.0), gear_ratio)):
        return why
    try:
        return axis_profile(name, given, said)
    except SpecError as error:
        return f"{error.message}; {error.hint}"


def _other_gear(said: float, arms: float) -> str:
    """Why a drive's gear is not taken; empty when it is that of the arm."""
    if math.isclose(said, arms, rel_tol=_SAME_GEAR):
        return ""
    if said == 1.0:
        return f"says nothing of a gear (6091h), the arm has one of {arms:g}: give axes.gear_ratio"
    return (
        f"says a gear of {said:g} (6091h), the arm has one of {arms:g}: correct the drive, or "
        f"give axes.gear_ratio in the station (here {said:g}) if the drive is right"
    )


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return bool(one == other)
    return math.isclose(one, other, rel_tol=_SAME)
