"""Drives checked and set up before the first cycle, and left in order after the last.

In the order in which it happens: `inspected` reads what every drive says of itself and compares it
with the station and the arm; nothing is written to a drive that is not the expected one.
`configured` writes what a drive must be set to, and reads every setting back. `set_mode` and
`declare` do by object what the process data do not carry: the mode of operation, and a payload for
drives that have an object for it (mock drives mount it, real ones have none).

Faults that a drive is in when it is connected to (`faults_left`) are reset only when they are
errors of monitoring (8xxxh: heartbeat or SYNC lost, a following error). Those say how the drive was
commanded, which is over. All others say something of currents, voltages, temperatures or hardware:
a person has to see to them, and resets them by `python -m hil_drivers.cia402 reset`. The end of a
connection is an error of monitoring of its own, so what a drive has noted since it was last reset
counts as much as its present error.

Nothing here knows the bus; what a bus needs set in every drive, it adds itself
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
"""6066h: for how long a joint may lag by more than 6065h."""

QUICK_STOP_RAMP, REACT_BY_QUICK_STOP = 2, 3

MODES = {name: mode for mode, name in od.MODE_NAMES.items()}

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

_SAME, _SAME_GEAR = 0.005, 0.01
"""Numbers of a station and of a drive that differ by less are the same: type plates are rounded."""


@dataclass(frozen=True)
class Drive:
    """One drive as it is.

    Attributes:
        objects: What it has answered, by the names of `hil_drivers.cia402.objects`; what it does
            not have is left out.
        profile: Its numbers, by station, drive and device profile.
    """

    objects: Mapping[str, int]
    profile: AxisProfile

    @property
    def limits_rad(self) -> tuple[float, float]:
        """Joint angles between which it takes targets (607Dh) [rad]; NaN where it has no limits."""
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
        """Torque limit of the drive at the joint (6072h) [N·m]; NaN if it has none."""
        most = self.objects.get("max_torque")
        return math.nan if most is None else most * abs(self.profile.nm_per_count)

    @property
    def quick_stop_rad_s2(self) -> float:
        """Deceleration of its quick stop [rad/s²], 6085h or the station's; NaN if unknown."""
        if self.profile.quick_stop_rad_s2:
            return self.profile.quick_stop_rad_s2
        ramp = self.objects.get("quick_stop_deceleration")
        return math.nan if ramp is None else ramp * abs(self.profile.rad_s_per_count)

    def quick_stop_s(self, speed_rad_s: float) -> float:
        """Return the duration of its quick stop from a joint speed [s]; NaN if unknown."""
        ramp = self.quick_stop_rad_s2
        return speed_rad_s / ramp if ramp else math.inf


@dataclass(frozen=True)
class Commissioned:
    """The drives of an arm as they were read and set up.

    Attributes:
        drives: In the order of the axes.
        lacking: Per axis, settings for which the drive has no object.
    """

    drives: tuple[Drive, ...]
    lacking: tuple[tuple[str, ...], ...]

    @cached_property
    def scaling(self) -> Scaling:
        """Raw integers of all axes ↔ SI."""
        return Scaling([drive.profile for drive in self.drives])

    @property
    def q_min(self) -> FloatArray:
        """(n,) lower position limits of the drives [rad]; NaN where there is none."""
        return np.array([drive.limits_rad[0] for drive in self.drives])

    @property
    def q_max(self) -> FloatArray:
        """(n,) upper position limits of the drives [rad]; NaN where there is none."""
        return np.array([drive.limits_rad[1] for drive in self.drives])

    @property
    def max_torque(self) -> FloatArray:
        """(n,) torque limits of the drives at the joints [N·m]; NaN where a drive has none."""
        return np.array([drive.max_torque_nm for drive in self.drives])

    @property
    def reported_limits(self) -> ReportedLimits:
        """The limits that the drives keep to by themselves."""
        return ReportedLimits(q_min=self.q_min, q_max=self.q_max, effort_max=self.max_torque)

    def identity(self, model: str, faults_reset: Sequence[LeftFault]) -> Identity:
        """Return the identity of the arm: its drives (1018h), with everything read of them.

        Args:
            model: Built-in arm.
            faults_reset: Faults that were reset when connecting.
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
        """The scaling objects as read, and the scaling that follows from them."""
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
    """All drives as they are, in the order of the axes; they are pre-operational.

    Args:
        acyclic: To the drives.
        options: Of the station.
        arm: Says what the joints are like.

    Raises:
        RobotConnectionError: Drives are not what the station says; one line per contradiction.
        RobotTimeout: A drive does not answer.
    """
    wrong: list[str] = []
    drives: list[Drive] = []
    for axis, given in enumerate(options.axes):
        drive, complaints = _inspected(acyclic, axis, given, options, arm)
        wrong += [f"{acyclic.name_of(axis)} {complaint}" for complaint in complaints]
        drives += [drive] if drive else []
    if wrong:
        raise RobotConnectionError(
            "\n".join(wrong), hint="correct the station, or the drives with their maker's tool"
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
    wrong = [
        f"is not as the station says: {each}" for each in contradictions(given, own, torque_of)
    ]
    profile = profile_of(options.profile, given, own, float(arm.gear_ratio[axis]))
    if isinstance(profile, str):
        return None, [*wrong, profile]
    drive = Drive(objects, profile)
    wrong += out_of_range(profile, float(arm.q_min[axis]), float(arm.q_max[axis]))
    wrong += brakes_too_slowly(drive, float(arm.qd_max[axis]))
    return drive, wrong


def objects_of(acyclic: Acyclic, axis: int, profile: str) -> dict[str, int]:
    """Read the objects of a drive, by name."""
    read = {
        entry.name: read_if_there(acyclic, axis, entry)
        for entry in ASKED + ASKED_TOO.get(profile, ())
    }
    return {name: value for name, value in read.items() if value is not None}


def read_if_there(acyclic: Acyclic, axis: int, entry: Entry) -> int | None:
    """An object's value; None where the drive has no such object."""
    try:
        return acyclic.upload(axis, entry)
    except Aborted as error:
        if error.code in NOT_THERE:
            return None
        raise


def profile_fields(objects: Mapping[str, int]) -> dict[str, Any]:
    """Return fields of `AxisProfile` from a drive's objects; a value of 0 was never set."""
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
    """Return contradictions between station and drive.

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


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return bool(one == other)
    return math.isclose(one, other, rel_tol=_SAME)


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


def brakes_too_slowly(drive: Drive, qd_max: float) -> Iterator[str]:
    """Return why a drive's quick stop is too slow; empty if it is not, or if its ramp is unknown.

    Args:
        drive: As it is.
        qd_max: Highest speed of its joint [rad/s].
    """
    takes_s, ramp = drive.quick_stop_s(qd_max), drive.quick_stop_rad_s2
    if not takes_s > LONGEST_RAMP_S:
        return
    least = math.ceil(qd_max / LONGEST_RAMP_S / abs(drive.profile.rad_s_per_count))
    raw = drive.objects.get("quick_stop_deceleration")
    yield (
        f"brakes too slowly in a quick stop: {od.QUICK_STOP_DECELERATION} is {raw}, that is "
        f"{ramp:.3g} rad/s² and takes {takes_s:.3g} s from {qd_max:.2f} rad/s; at least {least} "
        f"({qd_max / LONGEST_RAMP_S:.3g} rad/s², {LONGEST_RAMP_S:g} s) is needed. If its unit is "
        "another one, give axes.quick_stop_rad_s2"
    )


def configured(acyclic: Acyclic, options: Options, drives: list[Drive]) -> Commissioned:
    """Set up drives that were `inspected`, and read back every setting.

    Raises:
        CommandRefused: A drive does not take a setting, or reads back something else.
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
    """Return the settings of one drive on any bus, in the order of writing."""
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
    """Write the settings of one drive that it does not have already, and read them back.

    Returns:
        Objects that it does not have and that it can do without.
    """
    return tuple(str(s.entry) for s in settings if not _settled(acyclic, axis, s))


def _settled(acyclic: Acyclic, axis: int, setting: Setting) -> bool:
    """Whether the drive has the object at all."""
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
            hint="the drive limits or rounds it: see what its manual says of this object",
        )
    return True


SHOWN_WITHIN_S = 2.0

LOOK_S = 0.01


def set_mode(
    acyclic: Acyclic, axes: Sequence[int], mode: int, within_s: float = SHOWN_WITHIN_S
) -> None:
    """Write 6060h of all axes, and wait until 6061h of each shows it; none is enabled.

    A drive that was left in another mode would take our positions for nothing, or its old torque
    target for a command.

    Args:
        acyclic: To the drives.
        axes: From 0.
        mode: Of operation.
        within_s: How long a drive may take to show it [s].

    Raises:
        CommandRefused: A drive does not take or show it; with axis.
        RobotTimeout: A drive does not answer.
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
                    hint="see what the drive's manual says of its modes, or use mapping: position",
                )
            time.sleep(LOOK_S)


NAMES = ("payload_mass", "payload_x", "payload_y", "payload_z")


def declare(acyclic: Acyclic, index: int, payload: Payload) -> Payload:
    """Write a load and read it back; the drive has no object for its inertia.

    Args:
        acyclic: The drives.
        index: The object.
        payload: The mounted load.

    Raises:
        CommandRefused: The drive does not take it.
        RobotTimeout: It does not answer.
    """
    entries = [Entry(name, index, sub, "I") for sub, name in enumerate(NAMES, 1)]
    for entry, value in zip(entries, (payload.mass, *payload.com), strict=True):
        acyclic.download(0, entry, _bits(value))
    mass, *com = (_value(acyclic.upload(0, entry)) for entry in entries)
    return replace(payload, mass=mass, com=(com[0], com[1], com[2]))


def _bits(value: float) -> int:
    """REAL32 as the integer that SDO carries."""
    return int.from_bytes(struct.pack("<f", value), "little")


def _value(bits: int) -> float:
    (value,) = struct.unpack("<f", bits.to_bytes(4, "little"))
    return float(value)


MONITORING = 0x8000

_CLASS = 0xF000

MOST_ERRORS = 254
"""1003h has no more; drives keep 8 or 16."""

HINT = (
    "see to its cause, then reset it, by the drive's own tool or: "
    "python -m hil_drivers.cia402 reset STATION ROBOT (which also empties its list of errors)"
)


@dataclass(frozen=True, slots=True)
class LeftFault:
    """A fault that a drive was in at connecting.

    Attributes:
        axis: From 0.
        name: For messages.
        codes: The present one, then older ones.
    """

    axis: int
    name: str
    codes: tuple[int, ...]

    @property
    def is_monitoring(self) -> bool:
        """Whether it may be reset by connecting."""
        return bool(self.codes) and all(code & _CLASS == MONITORING for code in self.codes)

    def __str__(self) -> str:
        newest = [error_text(code) for code in self.codes[:1]] or ["no error code"]
        older = [f"{code:04X}h" for code in dict.fromkeys(self.codes[1:])]
        return f"{self.name} is in fault: {newest[0]}" + (
            f", before {', '.join(older)}" * bool(older)
        )


def faults_left(acyclic: Acyclic) -> list[LeftFault]:
    """Return the faults of all axes, with their errors; raises as SDO requests do."""
    faulty = [axis for axis in range(acyclic.n) if _is_faulty(acyclic, axis)]
    return [LeftFault(a, acyclic.name_of(a), tuple(errors_of(acyclic, a))) for a in faulty]


def _is_faulty(acyclic: Acyclic, axis: int) -> bool:
    return state_of(acyclic.upload(axis, od.STATUSWORD)) in FAULTY


def errors_of(acyclic: Acyclic, axis: int) -> list[int]:
    """Codes of a drive's errors: the present one (603Fh), then the newest of its list (1003h)."""
    now = read_if_there(acyclic, axis, od.ERROR_CODE) or 0
    count = min(read_if_there(acyclic, axis, od.ERROR_COUNT) or 0, MOST_ERRORS)
    listed = [
        acyclic.upload(axis, Entry("past error", od.ERROR_COUNT.index, sub, "I")) & 0xFFFF
        for sub in range(1, count + 1)
    ]
    return [now, *listed[listed[:1] == [now] :]] if now else listed


def require_resettable(faults: list[LeftFault]) -> None:
    """Raise if a fault is one of the hardware.

    Raises:
        RobotFault: With all of them.
    """
    if grave := [str(fault) for fault in faults if not fault.is_monitoring]:
        raise RobotFault("; ".join(grave), hint=HINT)


def reset(acyclic: Acyclic, fault: LeftFault) -> bool:
    """Reset a fault that a person has seen to, by SDO; whether it is gone.

    Its list of errors (1003h) is emptied then: what comes is judged without what was seen.

    Raises:
        CommandRefused, RobotTimeout: The drive does not take it.
    """
    for controlword in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):  # the rising edge counts
        acyclic.download(fault.axis, od.CONTROLWORD, controlword)
    if _is_faulty(acyclic, fault.axis):
        return False
    with contextlib.suppress(Aborted):  # not all drives have a list, or let it be emptied
        acyclic.download(fault.axis, od.ERROR_COUNT, 0)
    return True


WITHIN_S = 0.1
"""How long the answers of all drives together are waited for [s]."""


def stop_by_objects(acyclic: Acyclic) -> None:
    """Quick stop by SDO, for drives that process data do not reach; does not wait, never raises.

    A drive that has started anew or was taken out of operation has no RPDOs; it answers SDO.
    """
    acyclic.download_each(od.CONTROLWORD, QUICK_STOP, range(acyclic.n))


def part(acyclic: Acyclic) -> None:
    """Leave drives that were driven: `unwatch` them, stop the others; never raises."""
    acyclic.download_each(od.CONTROLWORD, QUICK_STOP, unwatch(acyclic))


def unwatch(acyclic: Acyclic) -> list[int]:
    """Have drives that carry no current not mind when we leave; never raises.

    Else they would be in fault for that (on CAN 8130h), and an error that an operator has to see
    would not be the present one any more. Drives that may still move have to notice that we are
    gone.

    Returns:
        Axes that are not known to carry no current.
    """
    words = acyclic.upload_each(od.STATUSWORD, range(acyclic.n), WITHIN_S)
    off = [axis for axis, word in words.items() if state_of(word) not in POWERED]
    acyclic.unwatch(off, WITHIN_S)
    return [axis for axis in range(acyclic.n) if axis not in off]
