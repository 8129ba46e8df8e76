"""Scaling of a drive's raw integers to joint quantities: encoder, gear, rated values, signs.

`AxisProfile` describes one axis. The fields of `AxisProfile` have three sources, in order of
increasing priority: the device profile (`PROFILES`) with the peculiarities of a make of drives, the
objects read from the drive, and the option `axes` of the station. `Scaling` combines the profiles
of all axes in arrays and converts whole recordings and prepared motions. The cycles themselves use
the raw integers of the drives.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hil.core import FloatArray, SpecError

TURN = 2.0 * math.pi

WRAP = 1 << 32
"""Number of values of a 32-bit position counter, which overflows from one end to the other."""
_HALF = WRAP >> 1

INT16, INT32 = (-(1 << 15), (1 << 15) - 1), (-(1 << 31), (1 << 31) - 1)
VelocityUnit = Literal["increments/s", "rpm", "0.001 rpm", "0.0001 rpm", "beckhoff"]
TorqueOf = Literal["rated-torque", "rated-current"]
CurrentIs = Literal["rms", "peak"]

COUNTS_PER_REV_S: dict[str, float] = {
    "rpm": 60.0,
    "0.001 rpm": 60_000.0,
    "0.0001 rpm": 600_000.0,
    "beckhoff": 2**32 / 16_000,
}
"""Value of 606Ch and 60FFh at one motor revolution per second, by velocity unit.

For the unit `increments/s`, the value follows from 608Fh instead. The unit `beckhoff` has the value
2^32 / 16 000 ≈ 268 435 (EL72xx, EP7414; infosys.beckhoff.com "Scaling of actual values and
setpoints"). The unit `0.0001 rpm` is the default of AX8000 (3005h:02).
"""

POSITION_BIT, VELOCITY_BIT, TORQUE_BIT = 0x80, 0x40, 0x20
"""Polarity bits (607Eh) that reverse the signs of a drive; bit 5 is vendor-specific."""


@dataclass(frozen=True)
class AxisProfile:
    """Relation between the raw numbers of one drive and its joint.

    Attributes:
        encoder_increments: Number of encoder increments (608Fh:01) in `encoder_revolutions`.
        encoder_revolutions: Number of motor revolutions (608Fh:02) in which the encoder counts
            `encoder_increments`.
        gear_ratio: Number of motor revolutions per joint revolution.
        rated_current_a: Rated current (6075h) [A]; 6078h is in ‰ of the rated current.
        rated_torque_nm: Rated torque at the motor (6076h) [N·m].
        polarity: Value of the object polarity (607Eh), whose bits reverse signs of the drive.
        direction: −1 if the joint turns against the motor because of mounting, belt or wiring.
        offset_rad: Joint angle at drive position 0 [rad].
        centre_rad: Middle of the joint's range [rad]; a wrapped position is converted to the
            nearest possible angle.
        position_unsigned: Whether the drive counts from 0 to 2^32 − 1. Targets of an unsigned drive
            wrap like the counter; targets of all other drives are limited to the range of signed
            32-bit integers.
        velocity_unit: Unit of 606Ch and 60FFh.
        torque_of: Quantity to which the ‰ values in 6071h, 6077h and 60B2h refer: rated torque or
            rated current.
        torque_constant_nm_a: Torque constant of the motor [N·m/A]; used if `torque_of` is
            `rated-current`.
        rated_current_is: Kind of the rated current, `peak` or `rms`. A `peak` value is divided by
            √2 before the multiplication by the torque constant (EL72xx with 2002h:54 = 0). An `rms`
            value is not divided (2002h:54 = 1).
        quick_stop_rad_s2: Quick-stop deceleration at the joint [rad/s²], for drives whose 6085h has
            a vendor-specific unit; 0 if 6085h is in counts of velocity per second.
    """

    encoder_increments: int
    gear_ratio: float
    rated_current_a: float
    rated_torque_nm: float
    encoder_revolutions: int = 1
    polarity: int = 0
    direction: int = 1
    offset_rad: float = 0.0
    centre_rad: float = 0.0
    position_unsigned: bool = False
    velocity_unit: VelocityUnit = "increments/s"
    torque_of: TorqueOf = "rated-torque"
    torque_constant_nm_a: float = 0.0
    rated_current_is: CurrentIs = "rms"
    quick_stop_rad_s2: float = 0.0

    @property
    def increments_per_rev(self) -> float:
        """Number of encoder increments per motor revolution."""
        return self.encoder_increments / self.encoder_revolutions

    @cached_property
    def rad_per_increment(self) -> float:
        """Joint angle of one increment [rad], with the sign of position."""
        return self._sign(POSITION_BIT) * TURN / (self.increments_per_rev * self.gear_ratio)

    @cached_property
    def rad_s_per_count(self) -> float:
        """Joint velocity of one count of 606Ch [rad/s], with the sign of velocity."""
        counts = COUNTS_PER_REV_S.get(self.velocity_unit, self.increments_per_rev)
        return self._sign(VELOCITY_BIT) * TURN / (counts * self.gear_ratio)

    @cached_property
    def nm_per_count(self) -> float:
        """Joint torque of one count of 6077h [N·m], signed like torque, without gear losses."""
        return self._sign(TORQUE_BIT) * self.motor_rated_nm * self.gear_ratio / 1000.0

    @cached_property
    def a_per_count(self) -> float:
        """Motor current of one count of 6078h [A], with the sign of torque."""
        return self._sign(TORQUE_BIT) * self.rated_current_a / 1000.0

    @property
    def motor_rated_nm(self) -> float:
        """Motor torque at 1000 ‰ [N·m]."""
        if self.torque_of == "rated-torque":
            return self.rated_torque_nm
        return self.effective_rated_a * self.torque_constant_nm_a

    @property
    def effective_rated_a(self) -> float:
        """Rated current in the unit of the torque constant [A]."""
        peak = self.rated_current_is == "peak"
        return self.rated_current_a / math.sqrt(2.0) if peak else self.rated_current_a

    @property
    def drive_gain(self) -> float:
        """Drive gain: joint torque per ampere of motor current [N·m/A]."""
        return self.motor_rated_nm * self.gear_ratio / self.rated_current_a

    @cached_property
    def centre_counts(self) -> int:
        """Unwrapped position in the middle of the joint's range [increments]."""
        return round((self.centre_rad - self.offset_rad) / self.rad_per_increment)

    def position(self, raw: int) -> float:
        """Return the joint angle [rad] nearest to `centre_rad` for a raw position (6064h).

        The raw position can be a signed or an unsigned integer.
        """
        centre = self.centre_counts
        return (centre + wrapped(raw - centre)) * self.rad_per_increment + self.offset_rad

    def _sign(self, bit: int) -> int:
        return -self.direction if self.polarity & bit else self.direction


PROFILES: dict[str, dict[str, Any]] = {
    "generic": {},
    "el72xx": {
        "position_unsigned": True,
        "velocity_unit": "beckhoff",
        "torque_of": "rated-current",
        "rated_current_is": "peak",
    },
}
"""Device profiles: values used if neither the station's `axes` nor the drive contains them."""


def wrapped(value: int) -> int:
    """Return a value wrapped to a signed 32-bit integer: the shorter position difference."""
    return (value + _HALF) % WRAP - _HALF


def axis_profile(name: str, given: Mapping[str, Any], reported: Mapping[str, Any]) -> AxisProfile:
    """Return the profile of one axis.

    Args:
        name: Name of the device profile, a key of `PROFILES`.
        given: Fields of `AxisProfile` from the station, which have the highest priority.
        reported: Fields of `AxisProfile` from the drive, which have priority over the device
            profile.

    Raises:
        SpecError: A required field is missing in the station, in the drive and in the device
            profile.
    """
    merged = {**PROFILES[name], **reported, **given}
    needed = ["encoder_increments", "gear_ratio", "rated_current_a"]
    current = merged.get("torque_of") == "rated-current"
    needed.append("torque_constant_nm_a" if current else "rated_torque_nm")
    merged.setdefault("rated_torque_nm", 0.0)
    if missing := [field for field in needed if not merged.get(field)]:
        raise SpecError(
            f"profile {name}: neither the station nor the drive defines {', '.join(missing)}",
            hint=f"set axes.{missing[0]} in the station, from the drive's documentation",
        )
    known = {field.name for field in fields(AxisProfile)}
    return AxisProfile(**{key: value for key, value in merged.items() if key in known})


IntArray = NDArray[np.int64]


class Scaling:
    """Scaling of all axes in arrays, computed from the profiles of the axes.

    Every method takes an array of shape (N, n) or (n,) and returns an array of the same shape.
    Values converted from SI units are rounded and limited to the range of their integer type; only
    positions of unsigned counters wrap.

    Args:
        axes: Profiles of the n axes.

    Attributes:
        axes: Profiles of the n axes.
        position_resolution: (n,) joint angle of one increment [rad].
        velocity_resolution: (n,) joint velocity of one count of 606Ch [rad/s].
        torque_resolution: (n,) joint torque of one count of 6077h [N·m].
        current_resolution: (n,) motor current of one count of 6078h [A].
    """

    def __init__(self, axes: Sequence[AxisProfile]) -> None:
        self.axes = tuple(axes)
        self._position: FloatArray = np.array([axis.rad_per_increment for axis in axes])
        self._velocity: FloatArray = np.array([axis.rad_s_per_count for axis in axes])
        self._torque: FloatArray = np.array([axis.nm_per_count for axis in axes])
        self._current: FloatArray = np.array([axis.a_per_count for axis in axes])
        self._offset: FloatArray = np.array([axis.offset_rad for axis in axes])
        self._centre: IntArray = np.array([axis.centre_counts for axis in axes], dtype=np.int64)
        self.position_resolution: FloatArray = np.abs(self._position)
        self.velocity_resolution: FloatArray = np.abs(self._velocity)
        self.torque_resolution: FloatArray = np.abs(self._torque)
        self.current_resolution: FloatArray = np.abs(self._current)
        self._unsigned = np.array([axis.position_unsigned for axis in axes])

    @property
    def n(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def drive_gains(self) -> tuple[float, ...]:
        """Drive gains of all axes: joint torque per ampere of motor current [N·m/A]."""
        return tuple(axis.drive_gain for axis in self.axes)

    def position(self, raw: Any) -> FloatArray:
        """Return the joint angles [rad], nearest to `centre_rad`, for raw positions (6064h)."""
        away = (np.asarray(raw, dtype=np.int64) - self._centre + _HALF) % WRAP - _HALF
        return (self._centre + away) * self._position + self._offset

    def velocity(self, raw: Any) -> FloatArray:
        """Return joint velocities [rad/s] for raw velocities (606Ch)."""
        return _floats(raw) * self._velocity

    def torque(self, raw: Any) -> FloatArray:
        """Return joint torques [N·m] for raw torques (6077h, 6071h or 60B2h)."""
        return _floats(raw) * self._torque

    def current(self, raw: Any) -> FloatArray:
        """Return motor currents [A] for raw currents (6078h)."""
        return _floats(raw) * self._current

    def raw_position(self, q: Any) -> IntArray:
        """Return target positions (607Ah), as signed 32-bit integers, for joint angles [rad]."""
        counts = np.rint((_floats(q) - self._offset) / self._position)
        # The cast is undefined beyond 2^62; larger values are limited to the type's range below.
        counts = np.clip(counts, -(2.0**62), 2.0**62).astype(np.int64)
        around: IntArray = (counts + _HALF) % WRAP - _HALF
        return np.where(self._unsigned, around, np.clip(counts, *INT32))

    def raw_velocity(self, qd: Any) -> IntArray:
        """Return target velocities (60FFh) for joint velocities [rad/s]."""
        return _rounded(_floats(qd) / self._velocity, INT32)

    def raw_torque(self, nm: Any) -> IntArray:
        """Return raw torques (6071h or 60B2h) for joint torques [N·m]."""
        return _rounded(_floats(nm) / self._torque, INT16)


def _floats(values: Any) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _rounded(counts: FloatArray, ends: tuple[int, int]) -> IntArray:
    return np.clip(np.rint(counts), *ends).astype(np.int64)
