"""Record of a cycle, and its conversion to rows of a recording.

`cycle_dtype` returns the layout of the record that each cycle stores, with the bytes as they were
on the bus. `StateRows` converts records to the base robot record; `raw_rows` converts records to a
topic with every integer. A state row pairs the measurement at SYNC k with the set-point due at SYNC
k. At SYNC k−1, drives apply the set-point sent in cycle k−2, and reach this set-point at SYNC k
(60C2h is one period).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as MappingOf
from typing import Any, Literal

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray, StructArray
from hil.robot import Status, Topic, state_dtype
from hil_drivers.cia402.axis import FOLLOWS_COMMAND, INTERNAL_LIMIT
from hil_drivers.cia402.mapping import LATENCY, MOST_BYTES, Mapping
from hil_drivers.cia402.objects import CSP, CST, VELOCITY, Entry
from hil_drivers.cia402.profile import Scaling

LATE = 1 << 30
"""Flag of a cycle whose SYNC was late.

The flag 1 << axis means that not all answers of the axis arrived, and that the bytes of the axis
are from an earlier cycle.
"""

STALLED = 1 << 29
"""Flag of a real-time cycle whose SYNC was more than 1.5 periods after the previous SYNC."""

INCOMPLETE = STALLED - 1
"""Mask of all flags 1 << axis, which mark axes with missing answers."""


def cycle_dtype(mapping: Mapping, n: int) -> np.dtype[Any]:
    """Return the dtype of the record of one cycle, with the bytes as they were on the bus.

    Fields: `cycle` (number of the cycle, from 0), `host_time` (Unix time at which its SYNC was
    sent), `segment` and `status` (announced by the master in the cycle), `fault_code` (EMCY code of
    the first faulty axis, 0 without a fault), `flags` (`INCOMPLETE`, `STALLED`, `LATE`), then the
    eight bytes of each PDO: `rpdo` (R, n, 8) as sent after this SYNC and `tpdo` (T, n, 8) as
    answered to it, and `temperature` (n,) [°C], the newest temperatures known at the SYNC, NaN
    before the first ones.
    """
    return np.dtype(
        [
            ("cycle", "<i8"),
            ("host_time", "<f8"),
            ("temperature", "<f8", (n,)),
            ("segment", "<i4"),
            ("status", "<i4"),
            ("fault_code", "<i4"),
            ("flags", "<i4"),
            ("rpdo", "u1", (len(mapping.rpdos), n, MOST_BYTES)),
            ("tpdo", "u1", (len(mapping.tpdos), n, MOST_BYTES)),
        ]
    )


TOPIC = "/cia402/raw"

_HISTORY = LATENCY + 1
_ENABLED_MASK, _ENABLED = 0x6F, 0x27
_FAULT_MASK, _FAULTY = 0x4F, (0x08, 0x0F)
_FAULT_BITS = int(Status.FAULT | Status.MASKED)
_SUSPECT = INTERNAL_LIMIT | FOLLOWS_COMMAND
_HEAD = (("cycle", "<i4"), ("segment", "<i4"), ("status", "<i4"), ("fault_code", "<i4"))


def raw_topic(mapping: Mapping, n: int, rate_hz: float) -> Topic:
    """Return the topic that contains all integers of the commands and of the drives' answers.

    Each row contains the commands that were sent in the cycle, together with `segment` and
    `status`.

    Args:
        mapping: Mapping of the process data.
        n: Number of axes.
        rate_hz: Cycle rate in device time [Hz].
    """
    entries = sorted(mapping.entries, key=lambda entry: -entry.size)
    fields: list[Any] = [("device_time", "<f8"), ("host_time", "<f8"), *_HEAD, ("flags", "<i4")]
    fields += [(entry.name, _numpy_code(mapping, entry), (n,)) for entry in entries]
    units = {"device_time": "s", "host_time": "s (Unix time)"}
    return Topic(
        name=TOPIC,
        dtype=np.dtype(fields),
        rate_hz=rate_hz,
        clock="controller",
        units=units | {entry.name: entry.unit for entry in entries if entry.unit},
        schema_name=f"hil/msg/Cia402Raw{n}",
    )


def raw_rows(cycles: StructArray, mapping: Mapping, topic: Topic, period_s: float) -> StructArray:
    """Convert cycle records to rows of `raw_topic`, one row per cycle."""
    rows = topic.blank(len(cycles))
    rows["device_time"], rows["host_time"] = cycles["cycle"] * period_s, cycles["host_time"]
    for name in ("cycle", "segment", "status", "fault_code", "flags"):
        rows[name] = cycles[name]
    for name, values in raw_values(cycles, mapping).items():
        rows[name] = values
    return rows


def raw_values(cycles: StructArray, mapping: Mapping) -> dict[str, IntArray]:
    """Return the raw values of all mapped objects: an (N, n) array for each object name."""
    values: dict[str, IntArray] = {}
    for side, pdos in (("rpdo", mapping.rpdos), ("tpdo", mapping.tpdos)):
        for at, pdo in enumerate(pdos):
            records = np.ascontiguousarray(cycles[side][:, at]).view(pdo.dtype)[..., 0]
            values |= {entry.name: records[entry.name] for entry in pdo.entries}
    return values


class StateRows:
    """Converter from cycle records to state rows, independent of the sizes of the blocks.

    The converter stores the last cycles, because a state row pairs a measurement with a set-point
    that was sent cycles earlier. Velocities and accelerations of the set-points are differences of
    the positions, as computed by the drives. If the mapping has no velocity, the velocity is
    computed from the positions of the last complete cycle and the present cycle. The computed
    velocity lags by half a cycle and has the resolution of the encoder. If the mapping contains no
    torque or current, the field `effort` is NaN.

    Args:
        mapping: Mapping of the process data.
        scaling: Conversion between raw integers and SI units.
        period_s: Device time of a cycle [s].
        effort: Quantity in the field `effort` of the base record.
    """

    def __init__(
        self,
        mapping: Mapping,
        scaling: Scaling,
        period_s: float,
        effort: Literal["torque", "current"] = "torque",
    ) -> None:
        self._mapping, self._scaling = mapping, scaling
        self._period_s, self._effort = period_s, effort
        self._carries_velocity = VELOCITY in mapping.entries
        self._before: StructArray | None = None
        self._last: StructArray | None = None

    def rows(self, cycles: StructArray) -> StructArray:
        """Return the state rows of the next cycles, except cycles with a missing answer."""
        if not len(cycles):
            return np.zeros(0, state_dtype(self._scaling.n))
        before = np.repeat(cycles[:1], _HISTORY) if self._before is None else self._before
        all_of_them = np.concatenate([before, cycles])
        self._before = all_of_them[-_HISTORY:]
        rows = self._measured(cycles)
        self._commanded(rows, all_of_them)
        complete = np.asarray(rows[(cycles["flags"] & INCOMPLETE) == 0])
        if not self._carries_velocity:
            self._differentiate(complete)
        return complete

    def _measured(self, cycles: StructArray) -> StructArray:
        """Return state rows that contain only the quantities measured at the SYNC."""
        rows = np.zeros(len(cycles), state_dtype(self._scaling.n))
        values, scaling = raw_values(cycles, self._mapping), self._scaling
        rows["device_time"] = cycles["cycle"] * self._period_s
        rows["host_time"], rows["temperature"] = cycles["host_time"], cycles["temperature"]
        rows["q"] = scaling.position(values["position"])
        rows["qd"] = _scaled(values, "velocity", scaling.velocity)
        in_si = scaling.current if self._effort == "current" else scaling.torque
        rows["effort"] = _scaled(values, self._effort, in_si)
        rows["mode"] = _common(values["mode_display"]) if "mode_display" in values else CSP
        rows["fault_code"] = cycles["fault_code"]
        rows["status"] = _by_statusword(values["statusword"], _sure(rows["mode"]))
        rows["status"] |= np.where(cycles["fault_code"] != 0, _FAULT_BITS, 0)
        return rows

    def _differentiate(self, rows: StructArray) -> None:
        """Fill in the velocities from position differences; the first velocity is 0."""
        if not len(rows):
            return
        before = rows[:1] if self._last is None else self._last
        rows_too = np.concatenate([before, rows])
        lasted_s = np.diff(rows_too["device_time"])[:, None]
        rows["qd"] = np.diff(rows_too["q"], axis=0) / np.maximum(lasted_s, self._period_s)
        self._last = rows[-1:].copy()

    def _commanded(self, rows: StructArray, cycles: StructArray) -> None:
        """Fill in the set-points that were sent `LATENCY` cycles earlier.

        The set-point of the next cycle is already known, because the master has sent that set-point
        in the meantime. Velocities and accelerations of the set-points are therefore central
        differences, without a delay of half a cycle.
        """
        n = len(rows)
        values = raw_values(cycles, self._mapping)
        q = self._scaling.position(values["target_position"])
        after, now, before = q[2 : n + 2], q[1 : n + 1], q[:n]
        rows["q_target"] = now
        rows["qd_target"] = (after - before) / (2 * self._period_s)
        rows["qdd_target"] = (after - 2 * now + before) / self._period_s**2
        rows["effort_target"] = self._effort_target(values, n, rows["mode"])
        rows["segment"] = cycles["segment"][1 : n + 1]
        announced = cycles["status"][1 : n + 1]
        rows["status"] |= announced | _around_stalls(cycles["flags"])

    def _effort_target(
        self, values: MappingOf[str, IntArray], n: int, mode: IntArray
    ) -> FloatArray:
        """Return the torque set-points; NaN in CSP and CSV, whose torques the drives compute."""
        if self._effort == "current" or "target_torque" not in values:
            return np.full((n, self._scaling.n), np.nan)
        torque = self._scaling.torque(values["target_torque"][1 : n + 1])
        return np.where((mode == CST)[:, None], torque, np.nan)


def _numpy_code(mapping: Mapping, entry: Entry) -> str:
    (pdo,) = (pdo for pdo in mapping.pdos if entry in pdo.entries)
    return pdo.dtype[entry.name].str


def _scaled(
    values: MappingOf[str, IntArray], name: str, in_si: Callable[[IntArray], FloatArray]
) -> FloatArray:
    """Return (N, n) values of an object in SI units; a single NaN if the object is not mapped."""
    return in_si(values[name]) if name in values else np.asarray(np.nan)


def _common(modes: IntArray) -> IntArray:
    """Return the common mode of all axes in each of N cycles, 0 if the modes differ."""
    same = (modes == modes[:, :1]).all(axis=1)
    return np.asarray(np.where(same, modes[:, 0], 0))


def _around_stalls(flags: IntArray) -> IntArray:
    """Return the status `MASKED` for N cycles: set for a late SYNC and `LATENCY` further cycles.

    Args:
        flags: (`_HISTORY` + N,) flags of the cycles, including the previous `_HISTORY` cycles.
    """
    late = (flags & STALLED) != 0
    n = len(late) - _HISTORY
    near = np.any([late[_HISTORY - k : _HISTORY - k + n] for k in range(LATENCY + 1)], axis=0)
    return np.where(near, int(Status.MASKED), 0)


def _sure(mode: IntArray) -> BoolArray:
    """Return for N cycles whether statusword bits have the meaning of CSP, CSV and CST."""
    return np.asarray((mode >= CSP) & (mode <= CST))


def _by_statusword(statusword: IntArray, sure: BoolArray) -> IntArray:
    """Return the status bits `FAULT` and `MASKED` of N cycles for the (N, n) statuswords."""
    faulty = np.isin(statusword & _FAULT_MASK, _FAULTY).any(axis=1)
    enabled = (statusword & _ENABLED_MASK) == _ENABLED
    follows = (statusword & _SUSPECT) == FOLLOWS_COMMAND
    usable = (enabled & follows).all(axis=1) & sure
    masked = np.where(usable & ~faulty, 0, int(Status.MASKED))
    return np.asarray(np.where(faulty, int(Status.FAULT), 0) | masked)
