"""Six drives checked and set up before the first cycle: every setting is read back."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from hil.arms import ArmDescription
from hil.core import CommandRefused, RobotConnectionError
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.drives import Commissioned, Drive
from hil_drivers.cia402.inspection import (
    contradictions,
    objects_of,
    out_of_range,
    profile_of,
    read_if_there,
    said_by,
    wrong_kind,
)
from hil_drivers.cia402.mapping import SYNC_COB_ID
from hil_drivers.cia402.objects import Entry
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.profile import PROFILES, AxisProfile
from hil_drivers.cia402.rest_watch import LONGEST_RAMP_S

MASTER_SILENCE_MS = 250
"""1016h: silence of ours after which a drive stops by itself."""
FOLLOWING_ERROR_MS = 20
"""6066h: for how long a joint may lag by more than 6065h."""

QUICK_STOP_RAMP, REACT_BY_QUICK_STOP = 2, 3
MODES = {name: mode for mode, name in od.MODE_NAMES.items()}


class Named(Acyclic, Protocol):
    """What is asked of the way to the drives."""

    def name_of(self, axis: int) -> str:
        """An axis for messages."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One object that a drive is to have at some value.

    Attributes:
        entry: Which.
        value: What it is to be.
        needed: Whether a drive without it is refused.
    """

    entry: Entry
    value: int
    needed: bool = True


def commission(acyclic: Named, options: Options, arm: ArmDescription) -> Commissioned:
    """Check and set up all drives; they are pre-operational before and after.

    Args:
        acyclic: To the drives.
        options: Of the station.
        arm: Says what the joints are like.

    Raises:
        RobotConnectionError: Drives are not what the station says; one line per contradiction.
        CommandRefused: A drive does not take a setting, or reads back something else.
        RobotTimeout: A drive does not answer.
    """
    return configured(acyclic, options, inspected(acyclic, options, arm))


def configured(acyclic: Named, options: Options, drives: list[Drive]) -> Commissioned:
    """Set up drives that were `inspected`; raises as `commission`."""
    lacking = [
        set_up(acyclic, axis, settings_of(options, drive.profile))
        for axis, drive in enumerate(drives)
    ]
    if options.torque_limit_percent is not None:
        drives = [
            Drive({**drive.objects, "max_torque": _limit(options)}, drive.profile)
            for drive in drives
        ]
    return Commissioned(tuple(drives), tuple(lacking))


def inspected(acyclic: Named, options: Options, arm: ArmDescription) -> list[Drive]:
    """All drives as they are, in the order of the axes; raises as `commission`."""
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


def settings_of(options: Options, profile: AxisProfile) -> list[Setting]:
    """What one drive is set to, in this order: it watches our heartbeat last."""
    lag = math.radians(options.following_error_deg) / abs(profile.rad_per_increment)
    settings = [
        Setting(od.SYNC_COB_ID, SYNC_COB_ID, needed=False),
        Setting(od.CYCLE_PERIOD, options.period_us, needed=False),
        Setting(od.INTERPOLATION_INDEX, -3),
        Setting(od.INTERPOLATION_VALUE, round(options.period_us / 1000)),
        Setting(od.QUICK_STOP_OPTION, QUICK_STOP_RAMP),
        Setting(od.FAULT_REACTION_OPTION, QUICK_STOP_RAMP, needed=False),
        Setting(od.ABORT_CONNECTION_OPTION, REACT_BY_QUICK_STOP, needed=False),
        Setting(od.FOLLOWING_ERROR_WINDOW, round(lag)),
        Setting(od.FOLLOWING_ERROR_TIMEOUT, FOLLOWING_ERROR_MS, needed=False),
        Setting(od.CONSUMER_HEARTBEAT, options.master_id << 16 | MASTER_SILENCE_MS),
    ]
    if options.torque_limit_percent is not None:
        settings.insert(0, Setting(od.MAX_TORQUE, _limit(options)))
    return settings


def set_up(acyclic: Named, axis: int, settings: Sequence[Setting]) -> tuple[str, ...]:
    """Make one drive's objects what they are to be; written only where they are not.

    Returns:
        Objects that it does not have and that it can do without.
    """
    return tuple(str(s.entry) for s in settings if not _settled(acyclic, axis, s))


def _settled(acyclic: Named, axis: int, setting: Setting) -> bool:
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


def _inspected(
    acyclic: Named, axis: int, given: Mapping[str, object], options: Options, arm: ArmDescription
) -> tuple[Drive | None, list[str]]:
    objects = objects_of(acyclic, axis, options.profile)
    modes = {MODES[options.trajectory_mode]: options.trajectory_mode}
    if wrong := list(wrong_kind(objects, modes)):
        return None, wrong
    said = said_by(objects)
    torque_of = {**PROFILES[options.profile], **given}.get("torque_of", "")
    wrong = [
        f"is not as the station says: {each}" for each in contradictions(given, said, torque_of)
    ]
    profile = profile_of(options.profile, given, said, float(arm.gear_ratio[axis]))
    if isinstance(profile, str):
        return None, [*wrong, profile]
    drive = Drive(objects, profile)
    wrong += out_of_range(profile, float(arm.q_min[axis]), float(arm.q_max[axis]))
    wrong += brakes_too_slowly(drive, float(arm.qd_max[axis]))
    return drive, wrong


def brakes_too_slowly(drive: Drive, qd_max: float) -> Iterator[str]:
    """Why the quick stop of a drive is none; a drive that does not say is not judged.

    Args:
        drive: As it is.
        qd_max: Highest speed of its joint [rad/s].
    """
    takes_s, ramp = drive.quick_stop_s(qd_max), drive.quick_stop_rad_s2
    if not takes_s > LONGEST_RAMP_S:
        return
    least = math.ceil(qd_max / LONGEST_RAMP_S / abs(drive.profile.rad_s_per_count))
    told = drive.objects.get("quick_stop_deceleration")
    yield (
        f"brakes too slowly in a quick stop: {od.QUICK_STOP_DECELERATION} is {told}, that is "
        f"{ramp:.3g} rad/s² and takes {takes_s:.3g} s from {qd_max:.2f} rad/s; at least {least} "
        f"({qd_max / LONGEST_RAMP_S:.3g} rad/s², {LONGEST_RAMP_S:g} s) is needed. If its unit is "
        "another one, give axes.quick_stop_rad_s2"
    )


def _limit(options: Options) -> int:
    assert options.torque_limit_percent is not None
    return round(10 * options.torque_limit_percent)
