"""The drives of an arm as they were found and set up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hil.core import FloatArray
from hil_drivers.cia402.profile import WRAP, AxisProfile
from hil_drivers.cia402.scaling import Scaling


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
        """Joint torque to which it limits itself (6072h) [N·m]; NaN if it does not say."""
        most = self.objects.get("max_torque")
        return math.nan if most is None else most * abs(self.profile.nm_per_count)

    @property
    def quick_stop_rad_s2(self) -> float:
        """Deceleration of its quick stop [rad/s²], 6085h or the station's; NaN if none says."""
        if self.profile.quick_stop_rad_s2:
            return self.profile.quick_stop_rad_s2
        ramp = self.objects.get("quick_stop_deceleration")
        return math.nan if ramp is None else ramp * abs(self.profile.rad_s_per_count)

    def quick_stop_s(self, speed_rad_s: float) -> float:
        """How long its quick stop takes from a speed of the joint [s]; NaN if none says."""
        ramp = self.quick_stop_rad_s2
        return speed_rad_s / ramp if ramp else math.inf


@dataclass(frozen=True)
class Commissioned:
    """The drives as they were found and set up.

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
        """(n,) torque limits of the drives at the joints [N·m]; NaN where they do not say."""
        return np.array([drive.max_torque_nm for drive in self.drives])

    @property
    def details(self) -> Mapping[str, str]:
        """What the recording's identity keeps: scaling objects as read, and what follows."""
        names = [n for n in self.drives[0].objects if n not in ("statusword", "error_code")]
        told = {name: _row([d.objects.get(name, "-") for d in self.drives]) for name in names}
        told["gear_ratio"] = _row([d.profile.gear_ratio for d in self.drives])
        told["direction"] = _row([d.profile.direction for d in self.drives])
        told["offset_deg"] = _row([math.degrees(d.profile.offset_rad) for d in self.drives])
        told["torque_resolution_nm"] = _row(self.scaling.torque_resolution)
        told["current_resolution_a"] = _row(self.scaling.current_resolution)
        told["position_resolution_rad"] = _row(self.scaling.position_resolution)
        told["velocity_resolution_rad_s"] = _row(self.scaling.velocity_resolution)
        for name in ("velocity_unit", "torque_of"):
            told[name] = str(getattr(self.drives[0].profile, name))
        if lacking := sorted({entry for each in self.lacking for entry in each}):
            told["drives_lack"] = ", ".join(lacking)
        return told


def _row(values: Sequence[object] | FloatArray) -> str:
    return " ".join(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)
