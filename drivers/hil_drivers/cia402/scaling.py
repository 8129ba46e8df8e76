"""Raw integers of all axes ↔ SI: arrays of any number of rows for records, rows for the cycles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.core import FloatArray
from hil_drivers.cia402.profile import INT16, INT32, WRAP, AxisProfile

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
        torque_resolution: Joint torque of one count of 6077h [N·m], (n,): nothing finer is told.
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
        """Joint torque per ampere of what `current` gives [N·m/A]."""
        return tuple(axis.drive_gain for axis in self.axes)

    def position(self, raw: Any) -> FloatArray:
        """Joint angles [rad] of 6064h, signed or unsigned: those nearest to the joints' middles."""
        half = WRAP >> 1
        away = (np.asarray(raw, dtype=np.int64) - self._centre + half) % WRAP - half
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
        half = WRAP >> 1
        wrapped: IntArray = (counts + half) % WRAP - half
        return np.where(self._unsigned, wrapped, np.clip(counts, *INT32))

    def raw_velocity(self, qd: Any) -> IntArray:
        """60FFh for joint velocities [rad/s]."""
        return _rounded(_floats(qd) / self._velocity, INT32)

    def raw_torque(self, nm: Any) -> IntArray:
        """6071h or 60B2h for joint torques [N·m]."""
        return _rounded(_floats(nm) / self._torque, INT16)

    def raw_current(self, amperes: Any) -> IntArray:
        """6078h for motor currents [A]."""
        return _rounded(_floats(amperes) / self._current, INT16)


def _floats(values: Any) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _rounded(counts: FloatArray, ends: tuple[int, int]) -> IntArray:
    return np.clip(np.rint(counts), *ends).astype(np.int64)
