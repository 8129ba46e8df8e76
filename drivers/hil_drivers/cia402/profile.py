"""What a drive's raw integers mean at its joint: encoder, gear, rated values, signs.

`AxisProfile` is one axis. Its fields come from three places, the later winning: the device profile
(`PROFILES`, what a make of drives does differently), the drive's own objects, the station's `axes`.
`Scaling` is all axes as arrays: it converts whole recordings and prepared motions. The cycles
themselves stay in integers.
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
"""Positions have 32 bits; a counter that runs over goes on at the other end."""
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
"""What 606Ch and 60FFh read at one motor revolution per second; increments/s go by 608Fh.

`beckhoff` is 2^32 / 16 000 ≈ 268 435 (EL72xx, EP7414; infosys.beckhoff.com "Scaling of actual
values and setpoints"), `0.0001 rpm` the default of AX8000 (3005h:02)."""

POSITION_BIT, VELOCITY_BIT, TORQUE_BIT = 0x80, 0x40, 0x20
"""607Eh: the drive counts against its motor; CiA 402 leaves bit 5 to vendors."""


@dataclass(frozen=True)
class AxisProfile:
    """How the numbers of one drive relate to its joint.

    Attributes:
        encoder_increments, encoder_revolutions: 608Fh: increments per so many motor revolutions.
        gear_ratio: Motor revolutions per joint revolution.
        rated_current_a: 6075h [A]; ‰ of it are the unit of 6078h.
        rated_torque_nm: 6076h [N·m] at the motor.
        polarity: 607Eh as the drive has it.
        direction: −1 where the joint turns against the motor (mounted, belted or wired so).
        offset_rad: Angle of the joint where the drive's position is 0 [rad].
        centre_rad: Middle of the joint's range: of all angles that a wrapped position can mean,
            the nearest to it is meant [rad].
        position_unsigned: The drive counts from 0 to 2^32 − 1: targets beyond an end wrap, as its
            own counter does; else they stop at the ends of 32 bits with sign.
        velocity_unit: Of 606Ch and 60FFh.
        torque_of: What 6071h, 6077h and 60B2h are ‰ of.
        torque_constant_nm_a: Of the motor [N·m/A]; for `rated-current`.
        rated_current_is: A `peak` value is divided by √2 before it meets the torque constant
            (EL72xx with 2002h:54 = 0), an `rms` one is not (2002h:54 = 1).
        quick_stop_rad_s2: Deceleration of the quick stop at the joint where 6085h is in a unit of
            its own [rad/s²]; 0: by 6085h, in counts of velocity per second.
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
        """Increments of one motor revolution."""
        return self.encoder_increments / self.encoder_revolutions

    @cached_property
    def rad_per_increment(self) -> float:
        """Joint angle of one increment, with the sign of position [rad]."""
        return self._sign(POSITION_BIT) * TURN / (self.increments_per_rev * self.gear_ratio)

    @cached_property
    def rad_s_per_count(self) -> float:
        """Joint velocity of one count of 606Ch, with its sign [rad/s]."""
        counts = COUNTS_PER_REV_S.get(self.velocity_unit, self.increments_per_rev)
        return self._sign(VELOCITY_BIT) * TURN / (counts * self.gear_ratio)

    @cached_property
    def nm_per_count(self) -> float:
        """Joint torque of one count of 6077h, with its sign [N·m]; no losses in the gear."""
        return self._sign(TORQUE_BIT) * self.motor_rated_nm * self.gear_ratio / 1000.0

    @cached_property
    def a_per_count(self) -> float:
        """Motor current of one count of 6078h, with the sign of torque [A]."""
        return self._sign(TORQUE_BIT) * self.rated_current_a / 1000.0

    @property
    def motor_rated_nm(self) -> float:
        """Motor torque at 1000 ‰ [N·m]."""
        if self.torque_of == "rated-torque":
            return self.rated_torque_nm
        return self.effective_rated_a * self.torque_constant_nm_a

    @property
    def effective_rated_a(self) -> float:
        """Rated current as the torque constant takes it [A]."""
        peak = self.rated_current_is == "peak"
        return self.rated_current_a / math.sqrt(2.0) if peak else self.rated_current_a

    @property
    def drive_gain(self) -> float:
        """Joint torque per ampere of `current` [N·m/A]."""
        return self.motor_rated_nm * self.gear_ratio / self.rated_current_a

    @cached_property
    def centre_counts(self) -> int:
        """Position in increments, unwrapped, in the middle of the joint's range."""
        return round((self.centre_rad - self.offset_rad) / self.rad_per_increment)

    def position(self, raw: int) -> float:
        """Joint angle [rad] of 6064h, signed or unsigned: the one nearest to `centre_rad`."""
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
"""What a device profile says where neither the station's `axes` nor the drive do."""


def wrapped(value: int) -> int:
    """Return a value as 32 bits with sign: as a counter wraps, and the shorter way round."""
    return (value + _HALF) % WRAP - _HALF


def axis_profile(name: str, given: Mapping[str, Any], found: Mapping[str, Any]) -> AxisProfile:
    """Return the profile of one axis.

    Args:
        name: A key of `PROFILES`.
        given: Fields of `AxisProfile` as the station says them; they win.
        found: Fields as the drive says them; they win over those of the device profile.

    Raises:
        SpecError: Something is still missing.
    """
    merged = {**PROFILES[name], **found, **given}
    needed = ["encoder_increments", "gear_ratio", "rated_current_a"]
    current = merged.get("torque_of") == "rated-current"
    needed.append("torque_constant_nm_a" if current else "rated_torque_nm")
    merged.setdefault("rated_torque_nm", 0.0)
    if missing := [field for field in needed if not merged.get(field)]:
        raise SpecError(
            f"profile {name}: neither the station nor the drive says {', '.join(missing)}",
            hint=f"give axes.{missing[0]} in the station, from the drive's documentation",
        )
    known = {field.name for field in fields(AxisProfile)}
    return AxisProfile(**{key: value for key, value in merged.items() if key in known})


IntArray = NDArray[np.int64]


class Scaling:
    """The profiles of all axes, as arrays.

    Every method takes (N, n) or (n,) and gives the same shape. Raw values that come out of SI are
    rounded, and stop at the ends of their type; positions of unsigned counters wrap.

    Args:
        axes: One profile per axis, n of them.

    Attributes:
        axes: The same.
        position_resolution: Joint angle of one increment [rad], (n,).
        velocity_resolution: Joint velocity of one count of 606Ch [rad/s], (n,).
        torque_resolution: Joint torque of one count of 6077h [N·m], (n,): the finest step.
        current_resolution: Current of one count of 6078h [A], (n,).
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
        """Joint torque per ampere of `current` [N·m/A]."""
        return tuple(axis.drive_gain for axis in self.axes)

    def position(self, raw: Any) -> FloatArray:
        """Joint angles [rad] of 6064h, signed or unsigned: those nearest to the joints' middles."""
        away = (np.asarray(raw, dtype=np.int64) - self._centre + _HALF) % WRAP - _HALF
        return (self._centre + away) * self._position + self._offset

    def velocity(self, raw: Any) -> FloatArray:
        """Joint velocities [rad/s] of 606Ch."""
        return _floats(raw) * self._velocity

    def torque(self, raw: Any) -> FloatArray:
        """Joint torques [N·m] of 6077h, 6071h or 60B2h."""
        return _floats(raw) * self._torque

    def current(self, raw: Any) -> FloatArray:
        """Motor currents [A] of 6078h."""
        return _floats(raw) * self._current

    def raw_position(self, q: Any) -> IntArray:
        """607Ah for joint angles [rad], as 32 bits with sign."""
        counts = np.rint((_floats(q) - self._offset) / self._position)
        # Beyond 2^62 the cast would be undefined; there the end of the type is right anyway.
        counts = np.clip(counts, -(2.0**62), 2.0**62).astype(np.int64)
        around: IntArray = (counts + _HALF) % WRAP - _HALF
        return np.where(self._unsigned, around, np.clip(counts, *INT32))

    def raw_velocity(self, qd: Any) -> IntArray:
        """60FFh for joint velocities [rad/s]."""
        return _rounded(_floats(qd) / self._velocity, INT32)

    def raw_torque(self, nm: Any) -> IntArray:
        """6071h or 60B2h for joint torques [N·m]."""
        return _rounded(_floats(nm) / self._torque, INT16)


def _floats(values: Any) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _rounded(counts: FloatArray, ends: tuple[int, int]) -> IntArray:
    return np.clip(np.rint(counts), *ends).astype(np.int64)
