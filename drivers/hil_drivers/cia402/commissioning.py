"""Check and configure the drives before the first cycle, and restore them after the last cycle.

The functions are used in the following order. First, `inspected` reads the objects of every drive
and compares their values with the station and the arm. Nothing is written to a drive before the
check by `inspected` has passed. Second, `configured` writes the settings of each drive and reads
every setting back. Third, `set_mode` and `declare` write objects that are not in the process data:
the mode of operation, and a payload for drives with a payload object (mock drives have such an
object, real drives do not).

Connecting resets a fault that a drive already has (`faults_left`) only if the fault is a monitoring
error (8xxxh: heartbeat or SYNC lost, a following error). A monitoring error results from commands
of an earlier connection, which have ended. All other faults concern currents, voltages,
temperatures or hardware: an operator must check such a fault and reset it with `python -m
hil_drivers.cia402 reset`. For the drives, the end of a connection is also a monitoring error, which
can hide an earlier error. When connecting, the driver therefore considers all errors that a drive
has listed since its last reset.

This module is independent of the type of bus; each bus adds the settings that it requires
(`Acyclic.settings`).
"""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import CommandRefused, FloatArray, RobotConnectionError, RobotFault, SpecError
from hil.robot import Identity
from hil_drivers.arm import ReportedLimits
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.axis import (
    DISABLE_VOLTAGE,
    FAULT_RESET,
    FAULTY,
    LONGEST_RAMP_S,
    POWERED,
    QUICK_STOP,
    mode_text,
    state_of,
)
from hil_drivers.cia402.bus import Acyclic, Setting
from hil_drivers.cia402.objects import NOT_THERE, Aborted, Entry, error_text
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.profile import INT32, PROFILES, WRAP, AxisProfile, Scaling, axis_profile

FOLLOWING_ERROR_MS = 20
"""Time for which the following error is allowed to exceed 6065h: value of 6066h [ms]."""

QUICK_STOP_RAMP, REACT_BY_QUICK_STOP = 2, 3

MODES = {name: mode for mode, name in od.MODE_NAMES.items()}

PROFILE_402 = 402
"""Low word of the device type (1000h) of a CiA 402 drive."""

ASKED = (
    od.DEVICE_TYPE, od.VENDOR, od.PRODUCT, od.REVISION, od.SERIAL,
    od.SUPPORTED_MODES, od.STATUSWORD, od.ERROR_CODE,
    od.ENCODER_INCREMENTS, od.ENCODER_REVOLUTIONS, od.GEAR_MOTOR, od.GEAR_SHAFT,
    od.RATED_CURRENT, od.RATED_TORQUE, od.POLARITY,
    od.POSITION_LIMIT_MIN, od.POSITION_LIMIT_MAX, od.MAX_TORQUE, od.QUICK_STOP_DECELERATION,
)  # fmt: skip

ASKED_TOO = {"el72xx": (od.TORQUE_SCALING, od.TORQUE_CONSTANT)}
"""Objects that are read in addition to `ASKED`, by device profile."""

_SAME, _SAME_GEAR = 0.005, 0.01
"""Relative tolerances between values of station and drive, because type plates are rounded."""


@dataclass(frozen=True)
class Drive:
    """One drive with the objects read from it and its scaling.

    Attributes:
        objects: Values read from the drive, by the names of the objects in
            `hil_drivers.cia402.objects`. Objects that the drive does not have are omitted.
        profile: Scaling of the drive, combined from the station, the drive and the device profile.
    """

    objects: Mapping[str, int]
    profile: AxisProfile

    @property
    def limits_rad(self) -> tuple[float, float]:
        """Lower and upper position limit of the drive (607Dh) [rad]; NaN if not set."""
        low = self.objects.get("position_limit_min", 0)
        high = self.objects.get("position_limit_max", 0)
        if low == high or abs(high - low) >= WRAP - 2:
            return math.nan, math.nan
        if self.profile.position_unsigned:
            ends = sorted((self.profile.position(low), self.profile.position(high)))
            return ends[0], ends[1]
        if low > high:
            return math.nan, math.nan
        scale, offset = self.profile.rad_per_increment, self.profile.offset_rad
        ends = sorted((low * scale + offset, high * scale + offset))
        return ends[0], ends[1]

    @property
    def max_torque_nm(self) -> float:
        """Torque limit of the drive at the joint (6072h) [N·m]; NaN if the drive has no limit."""
        most = self.objects.get("max_torque")
        return math.nan if most is None else most * abs(self.profile.nm_per_count)

    @property
    def quick_stop_rad_s2(self) -> float:
        """Quick-stop deceleration of the joint [rad/s²]: station or 6085h; NaN if unknown."""
        if self.profile.quick_stop_rad_s2:
            return self.profile.quick_stop_rad_s2
        ramp = self.objects.get("quick_stop_deceleration")
        return math.nan if ramp is None else ramp * abs(self.profile.rad_s_per_count)

    def quick_stop_s(self, speed_rad_s: float) -> float:
        """Return the duration of a quick stop that begins at a joint speed [s]; NaN if unknown."""
        ramp = self.quick_stop_rad_s2
        return speed_rad_s / ramp if ramp else math.inf


@dataclass(frozen=True)
class Commissioned:
    """All drives of an arm after they were read and configured.

    Attributes:
        drives: Drives of the arm, in the order of the axes.
        lacking: For each axis, the settings that were not written because the drive has no object
            for them.
    """

    drives: tuple[Drive, ...]
    lacking: tuple[tuple[str, ...], ...]

    @cached_property
    def scaling(self) -> Scaling:
        """Conversion between raw integers and SI units for all axes."""
        return Scaling([drive.profile for drive in self.drives])

    @property
    def q_min(self) -> FloatArray:
        """(n,) lower position limits of the drives [rad]; NaN if a drive has no limits."""
        return np.array([drive.limits_rad[0] for drive in self.drives])

    @property
    def q_max(self) -> FloatArray:
        """(n,) upper position limits of the drives [rad]; NaN if a drive has no limits."""
        return np.array([drive.limits_rad[1] for drive in self.drives])

    @property
    def max_torque(self) -> FloatArray:
        """(n,) torque limits of the drives at the joints [N·m]; NaN if a drive has no limit."""
        return np.array([drive.max_torque_nm for drive in self.drives])

    @property
    def reported_limits(self) -> ReportedLimits:
        """Position and torque limits that the drives themselves enforce."""
        return ReportedLimits(q_min=self.q_min, q_max=self.q_max, effort_max=self.max_torque)

    def identity(self, model: str, faults_reset: Sequence[LeftFault]) -> Identity:
        """Return the identity of the arm: its drives (1018h) and all objects read from the drives.

        Args:
            model: Name of the built-in arm.
            faults_reset: Descriptions of the faults that were reset when connecting.
        """
        details = dict(self.details)
        if faults_reset:
            details["faults_reset"] = "; ".join(map(str, faults_reset))

        def of_each_drive(name: str) -> str:
            return " ".join(f"{drive.objects.get(name, 0):x}" for drive in self.drives)

        return Identity(
            model=model,
            serial=of_each_drive("serial"),
            firmware=of_each_drive("revision"),
            driver="cia402",
            details=details,
        )

    @property
    def details(self) -> Mapping[str, str]:
        """Scaling objects as read from the drives, and the resulting scaling, as text."""
        names = [n for n in self.drives[0].objects if n not in ("statusword", "error_code")]
        details = {name: _row([d.objects.get(name, "-") for d in self.drives]) for name in names}
        details["gear_ratio"] = _row([d.profile.gear_ratio for d in self.drives])
        details["direction"] = _row([d.profile.direction for d in self.drives])
        details["offset_deg"] = _row([math.degrees(d.profile.offset_rad) for d in self.drives])
        details["torque_resolution_nm"] = _row(self.scaling.torque_resolution)
        details["current_resolution_a"] = _row(self.scaling.current_resolution)
        details["position_resolution_rad"] = _row(self.scaling.position_resolution)
        details["velocity_resolution_rad_s"] = _row(self.scaling.velocity_resolution)
        for name in ("velocity_unit", "torque_of"):
            details[name] = str(getattr(self.drives[0].profile, name))
        if lacking := sorted({entry for each in self.lacking for entry in each}):
            details["drives_lack"] = ", ".join(lacking)
        return details


def _row(values: Sequence[object] | FloatArray) -> str:
    return " ".join(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)


def inspected(acyclic: Acyclic, options: Options, arm: ArmDescription) -> list[Drive]:
    """Read and check all drives; return the drives in the order of the axes.

    The drives must be in the NMT state pre-operational.

    Args:
        acyclic: Access to the objects of the drives.
        options: Options of the station.
        arm: Description of the joints.

    Raises:
        RobotConnectionError: The drives do not match the station; the message has one line per
            contradiction.
        RobotTimeout: A drive does not answer a request.
    """
    wrong: list[str] = []
    drives: list[Drive] = []
    for axis, given in enumerate(options.axes):
        drive, complaints = _inspected(acyclic, axis, given, options, arm)
        wrong += [f"{acyclic.name_of(axis)} {complaint}" for complaint in complaints]
        drives += [drive] if drive else []
    if wrong:
        raise RobotConnectionError(
            "\n".join(wrong),
            hint="correct the station, or the drives with the manufacturer's tool",
        )
    return drives


def _inspected(
    acyclic: Acyclic, axis: int, given: Mapping[str, object], options: Options, arm: ArmDescription
) -> tuple[Drive | None, list[str]]:
    objects = objects_of(acyclic, axis, options.profile)
    modes = {MODES[options.trajectory_mode]: options.trajectory_mode}
    if wrong := list(wrong_kind(objects, modes)):
        return None, wrong
    own = profile_fields(objects)
    torque_of = {**PROFILES[options.profile], **given}.get("torque_of", "")
    wrong = [f"contradicts the station: {each}" for each in contradictions(given, own, torque_of)]
    profile = profile_of(options.profile, given, own, float(arm.gear_ratio[axis]))
    if isinstance(profile, str):
        return None, [*wrong, profile]
    drive = Drive(objects, profile)
    wrong += out_of_range(profile, float(arm.q_min[axis]), float(arm.q_max[axis]))
    wrong += brakes_too_slowly(drive, float(arm.qd_max[axis]))
    return drive, wrong


def objects_of(acyclic: Acyclic, axis: int, profile: str) -> dict[str, int]:
    """Read the objects of a drive; return the values by the name of the object."""
    read = {
        entry.name: read_if_there(acyclic, axis, entry)
        for entry in ASKED + ASKED_TOO.get(profile, ())
    }
    return {name: value for name, value in read.items() if value is not None}


def read_if_there(acyclic: Acyclic, axis: int, entry: Entry) -> int | None:
    """Return the value of an object; None if the drive has no such object."""
    try:
        return acyclic.upload(axis, entry)
    except Aborted as error:
        if error.code in NOT_THERE:
            return None
        raise


def profile_fields(objects: Mapping[str, int]) -> dict[str, Any]:
    """Return the fields of `AxisProfile` that a drive's objects contain; 0 counts as not set."""
    values: dict[str, Any] = {
        name: objects[name]
        for name in ("encoder_increments", "encoder_revolutions")
        if objects.get(name)
    }
    if objects.get("gear_motor") and objects.get("gear_shaft"):
        values["gear_ratio"] = objects["gear_motor"] / objects["gear_shaft"]
    for name, field in (
        ("rated_current", "rated_current_a"),
        ("rated_torque", "rated_torque_nm"),
        ("torque_constant", "torque_constant_nm_a"),
    ):
        if objects.get(name):
            values[field] = objects[name] / 1000.0
    if "polarity" in objects:
        values["polarity"] = objects["polarity"] & 0xE0
    if "torque_scaling" in objects:
        values["rated_current_is"] = "rms" if objects["torque_scaling"] & 1 else "peak"
    return values


def wrong_kind(objects: Mapping[str, int], modes: Mapping[int, str]) -> Iterator[str]:
    """Yield why a drive is unusable: not a CiA 402 drive, or without a required mode.

    Args:
        objects: Values of the drive's objects by name.
        modes: Required modes of operation, with their names.
    """
    kind = objects.get("device_type", 0)
    if kind & 0xFFFF != PROFILE_402:
        yield (
            f"is not a CiA 402 drive: {od.DEVICE_TYPE} is {kind:08X}h, its low word must be 0192h"
        )
        return
    able = objects.get("supported_modes", 0)
    lacking = [name for mode, name in modes.items() if not able >> od.MODE_BITS[mode] & 1]
    if lacking:
        yield f"does not support {', '.join(lacking)}: {od.SUPPORTED_MODES} is {able:08X}h"


def contradictions(
    given: Mapping[str, Any], reported: Mapping[str, Any], torque_of: str
) -> Iterator[str]:
    """Yield the contradictions between the values of the station and those of the drive.

    A gear ratio of 1:1 in the drive counts as not configured. The rated torque (6076h) is not
    compared if torque is scaled by the rated current.

    Args:
        given: Fields of `AxisProfile` in the station.
        reported: Fields of `AxisProfile` in the drive.
        torque_of: Reference of the torque scaling; see `AxisProfile`.
    """
    unlike = {name for name in given if name in reported and not _same(given[name], reported[name])}
    if "gear_ratio" in unlike and reported["gear_ratio"] == 1.0:
        unlike.discard("gear_ratio")
    if torque_of == "rated-current":
        unlike.discard("rated_torque_nm")
    for name in sorted(unlike):
        yield f"axes.{name} is {given[name]} in the station, {reported[name]} in the drive"


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return bool(one == other)
    return math.isclose(one, other, rel_tol=_SAME)


def profile_of(
    name: str, given: Mapping[str, Any], reported: Mapping[str, Any], gear_ratio: float
) -> AxisProfile | str:
    """Return the scaling of an axis, or a text why its drive is rejected.

    Args:
        name: Name of the device profile.
        given: Fields of `AxisProfile` in the station.
        reported: Fields of `AxisProfile` in the drive.
        gear_ratio: Gear ratio according to the arm's manufacturer; the drive must have the same
            ratio if the station contains no gear ratio.
    """
    if "gear_ratio" not in given and (
        why := _other_gear(reported.get("gear_ratio", 1.0), gear_ratio)
    ):
        return why
    try:
        return axis_profile(name, given, reported)
    except SpecError as error:
        return f"{error.message}; {error.hint}"


def _other_gear(own: float, arms: float) -> str:
    """Return why the gear ratio of a drive is rejected; empty if the arm has the same ratio."""
    if math.isclose(own, arms, rel_tol=_SAME_GEAR):
        return ""
    if own == 1.0:
        return (
            f"reports no gear ratio (6091h), the gear ratio of the arm is {arms:g}: set "
            "axes.gear_ratio in the station"
        )
    return (
        f"reports a gear ratio of {own:g} (6091h), the gear ratio of the arm is {arms:g}: correct "
        f"the drive, or set axes.gear_ratio in the station (here {own:g}) if the drive is right"
    )


def out_of_range(profile: AxisProfile, q_min: float, q_max: float) -> Iterator[str]:
    """Yield the reason if the position counter of the drive does not cover the joint's range."""
    ends = [(q - profile.offset_rad) / profile.rad_per_increment for q in (q_min, q_max)]
    fits = abs(ends[1] - ends[0]) < WRAP
    if not profile.position_unsigned:
        fits = INT32[0] <= min(ends) and max(ends) <= INT32[1]
    if not fits:
        yield (
            f"cannot represent {math.degrees(q_min):.0f} to {math.degrees(q_max):.0f}°: these are "
            f"{min(ends):.0f} to {max(ends):.0f} increments (axes.offset_deg, position_unsigned)"
        )


def brakes_too_slowly(drive: Drive, qd_max: float) -> Iterator[str]:
    """Yield the reason if a drive's quick stop takes too long; nothing if its ramp is unknown.

    Args:
        drive: Drive after its objects were read.
        qd_max: Maximum speed of the drive's joint [rad/s].
    """
    takes_s, ramp = drive.quick_stop_s(qd_max), drive.quick_stop_rad_s2
    if not takes_s > LONGEST_RAMP_S:
        return
    least = math.ceil(qd_max / LONGEST_RAMP_S / abs(drive.profile.rad_s_per_count))
    raw = drive.objects.get("quick_stop_deceleration")
    yield (
        f"brakes too slowly in a quick stop: {od.QUICK_STOP_DECELERATION} is {raw}, which is "
        f"{ramp:.3g} rad/s² and takes {takes_s:.3g} s from {qd_max:.2f} rad/s; at least {least} "
        f"({qd_max / LONGEST_RAMP_S:.3g} rad/s², {LONGEST_RAMP_S:g} s) is required. If the drive "
        "uses a different unit, set axes.quick_stop_rad_s2"
    )


def configured(acyclic: Acyclic, options: Options, drives: list[Drive]) -> Commissioned:
    """Configure the drives returned by `inspected`, and read back every setting.

    Raises:
        CommandRefused: A drive does not accept a setting, or reads back a different value.
        RobotTimeout: A drive does not answer.
    """
    lacking = [
        set_up(acyclic, axis, acyclic.settings(options, settings_of(options, drive.profile)))
        for axis, drive in enumerate(drives)
    ]
    if options.torque_limit_percent is not None:
        drives = [
            Drive({**drive.objects, "max_torque": _limit(options)}, drive.profile)
            for drive in drives
        ]
    return Commissioned(tuple(drives), tuple(lacking))


def _limit(options: Options) -> int:
    assert options.torque_limit_percent is not None
    return round(10 * options.torque_limit_percent)


def settings_of(options: Options, profile: AxisProfile) -> list[Setting]:
    """Return the settings of one drive that every type of bus needs, in the order of writing."""
    lag = math.radians(options.following_error_deg) / abs(profile.rad_per_increment)
    settings = [
        Setting(od.INTERPOLATION_INDEX, -3),
        Setting(od.INTERPOLATION_VALUE, round(options.period_us / 1000)),
        Setting(od.QUICK_STOP_OPTION, QUICK_STOP_RAMP),
        Setting(od.FAULT_REACTION_OPTION, QUICK_STOP_RAMP, needed=False),
        Setting(od.ABORT_CONNECTION_OPTION, REACT_BY_QUICK_STOP, needed=False),
        Setting(od.FOLLOWING_ERROR_WINDOW, round(lag)),
        Setting(od.FOLLOWING_ERROR_TIMEOUT, FOLLOWING_ERROR_MS, needed=False),
    ]
    if options.torque_limit_percent is not None:
        settings.insert(0, Setting(od.MAX_TORQUE, _limit(options)))
    return settings


def set_up(acyclic: Acyclic, axis: int, settings: Sequence[Setting]) -> tuple[str, ...]:
    """Write the settings of one drive that differ from its values, and read back the settings.

    Returns:
        Names of the optional settings for which the drive has no object.
    """
    return tuple(str(s.entry) for s in settings if not _settled(acyclic, axis, s))


def _settled(acyclic: Acyclic, axis: int, setting: Setting) -> bool:
    """Apply one setting; return whether the drive has the object of the setting."""
    entry, value = setting.entry, setting.value
    if not setting.needed and read_if_there(acyclic, axis, entry) is None:
        return False
    if acyclic.upload(axis, entry) == value:
        return True
    acyclic.download(axis, entry, value)
    now = acyclic.upload(axis, entry)
    if now != value:
        raise CommandRefused(
            f"{acyclic.name_of(axis)}: {entry} reads {now} after {value} was written",
            hint="the drive limits or rounds this value: see this object in its manual",
        )
    return True


SHOWN_WITHIN_S = 2.0

LOOK_S = 0.01


def set_mode(
    acyclic: Acyclic, axes: Sequence[int], mode: int, within_s: float = SHOWN_WITHIN_S
) -> None:
    """Write the mode of operation (6060h) of all axes and wait until 6061h shows it.

    No axis must be enabled when the mode is written. A drive in the wrong mode would ignore the
    position set-points, or use an old torque target as a command.

    Args:
        acyclic: Access to the objects of the drives.
        axes: Numbers of the axes, from 0.
        mode: Mode of operation to be written to 6060h.
        within_s: Longest time for a drive to show the mode [s].

    Raises:
        CommandRefused: A drive does not accept or show the mode; the message contains the axis.
        RobotTimeout: A drive does not answer a request.
    """
    for axis in axes:
        acyclic.download(axis, od.MODE, mode)
    until = time.monotonic() + within_s
    for axis in axes:
        while (shown := acyclic.upload(axis, od.MODE_DISPLAY)) != mode:
            if time.monotonic() > until:
                raise CommandRefused(
                    f"{acyclic.name_of(axis)}: mode {mode_text(mode)} was written to 6060h, 6061h "
                    f"shows {mode_text(shown)} after {within_s:g} s",
                    hint="see the modes in the drive's manual, or use mapping: position",
                )
            time.sleep(LOOK_S)


NAMES = ("payload_mass", "payload_x", "payload_y", "payload_z")


def declare(acyclic: Acyclic, index: int, payload: Payload) -> Payload:
    """Write mass and centre of mass of a payload to the drive; return the values read back.

    Args:
        acyclic: Access to the objects of the drives.
        index: Index of the payload object.
        payload: Mounted payload.

    Raises:
        CommandRefused: The drive does not accept the payload.
        RobotTimeout: The drive does not answer a request.
    """
    entries = [Entry(name, index, sub, "I") for sub, name in enumerate(NAMES, 1)]
    for entry, value in zip(entries, (payload.mass, *payload.com), strict=True):
        acyclic.download(0, entry, _bits(value))
    mass, *com = (_value(acyclic.upload(0, entry)) for entry in entries)
    return replace(payload, mass=mass, com=(com[0], com[1], com[2]))


def _bits(value: float) -> int:
    """Return a number as the integer by which an SDO transfers its REAL32 value."""
    return int.from_bytes(struct.pack("<f", value), "little")


def _value(bits: int) -> float:
    (value,) = struct.unpack("<f", bits.to_bytes(4, "little"))
    return float(value)


MONITORING = 0x8000

_CLASS = 0xF000

MOST_ERRORS = 254
"""Maximum number of entries that are read from the error list (1003h); drives store 8 or 16."""

HINT = (
    "remove the cause, then reset the fault with the manufacturer's tool or with: "
    "python -m hil_drivers.cia402 reset STATION ROBOT (which also empties the drive's error list)"
)


@dataclass(frozen=True, slots=True)
class LeftFault:
    """Fault that a drive already had when it was connected.

    Attributes:
        axis: Number of the axis, from 0.
        name: Name of the drive in messages.
        codes: Error codes of the drive: the present code first, then older codes.
    """

    axis: int
    name: str
    codes: tuple[int, ...]

    @property
    def is_monitoring(self) -> bool:
        """Whether the fault is a monitoring error, which is reset when the arm is connected."""
        return bool(self.codes) and all(code & _CLASS == MONITORING for code in self.codes)

    def __str__(self) -> str:
        newest = [error_text(code) for code in self.codes[:1]] or ["no error code"]
        older = [f"{code:04X}h" for code in dict.fromkeys(self.codes[1:])]
        return f"{self.name} is in fault: {newest[0]}" + (
            f", earlier {', '.join(older)}" * bool(older)
        )


def faults_left(acyclic: Acyclic) -> list[LeftFault]:
    """Return the faults of all axes with their error codes; raise like any SDO request."""
    faulty = [axis for axis in range(acyclic.n) if _is_faulty(acyclic, axis)]
    return [LeftFault(a, acyclic.name_of(a), tuple(errors_of(acyclic, a))) for a in faulty]


def _is_faulty(acyclic: Acyclic, axis: int) -> bool:
    return state_of(acyclic.upload(axis, od.STATUSWORD)) in FAULTY


def errors_of(acyclic: Acyclic, axis: int) -> list[int]:
    """Return the error codes of a drive: present error (603Fh), then its error list (1003h)."""
    now = read_if_there(acyclic, axis, od.ERROR_CODE) or 0
    count = min(read_if_there(acyclic, axis, od.ERROR_COUNT) or 0, MOST_ERRORS)
    listed = [
        acyclic.upload(axis, Entry("past error", od.ERROR_COUNT.index, sub, "I")) & 0xFFFF
        for sub in range(1, count + 1)
    ]
    return [now, *listed[listed[:1] == [now] :]] if now else listed


def require_resettable(faults: list[LeftFault]) -> None:
    """Raise if one of the faults is not a monitoring error.

    Raises:
        RobotFault: A fault is not a monitoring error; the message contains all such faults.
    """
    if grave := [str(fault) for fault in faults if not fault.is_monitoring]:
        raise RobotFault("; ".join(grave), hint=HINT)


def reset(acyclic: Acyclic, fault: LeftFault) -> bool:
    """Reset the fault of a drive by SDO; return whether the drive left the fault state.

    An operator must have checked the cause of the fault. The error list (1003h) of the drive is
    cleared, so that later checks ignore the errors that the operator has handled.

    Raises:
        CommandRefused: The drive does not accept the reset.
        RobotTimeout: The drive does not answer a request.
    """
    for controlword in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):  # reset needs a rising edge
        acyclic.download(fault.axis, od.CONTROLWORD, controlword)
    if _is_faulty(acyclic, fault.axis):
        return False
    with contextlib.suppress(Aborted):  # some drives have no list, or cannot clear it
        acyclic.download(fault.axis, od.ERROR_COUNT, 0)
    return True


WITHIN_S = 0.1
"""Longest wait for the answers of all drives together [s]."""


def stop_by_objects(acyclic: Acyclic) -> None:
    """Send a quick stop to all axes by SDO, without waiting; never raise.

    A drive that has restarted or left the operational state has no RPDOs, but it answers SDO
    requests.
    """
    acyclic.download_each(od.CONTROLWORD, QUICK_STOP, range(acyclic.n))


def part(acyclic: Acyclic) -> None:
    """Stop all powered drives and call `unwatch` for all other drives; never raise."""
    acyclic.download_each(od.CONTROLWORD, QUICK_STOP, unwatch(acyclic))


def unwatch(acyclic: Acyclic) -> list[int]:
    """End the monitoring of this master in all drives that carry no current; never raise.

    If a drive monitored the master, the end of the connection would be a new fault of this drive
    (on CAN 8130h) and replace an error that an operator must check. Drives that can still move
    continue to monitor the master, because these drives must stop if the master disappears.

    Returns:
        Numbers of the axes that possibly carry current.
    """
    words = acyclic.upload_each(od.STATUSWORD, range(acyclic.n), WITHIN_S)
    off = [axis for axis, word in words.items() if state_of(word) not in POWERED]
    acyclic.unwatch(off, WITHIN_S)
    return [axis for axis in range(acyclic.n) if axis not in off]
