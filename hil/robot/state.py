"""The rows of a robot: the base record and further topics, ROS 2 messages as they lie in memory.

`state_dtype` is one numpy dtype from the driver to the disk and back; drivers may record further
`Topic`s. Doubles come first and 32-bit integers last (decision record 0002): a packed little-endian
row behind the four bytes `00 01 00 00` is a valid CDR message as long as every field lies at a
multiple of its own size. So a row goes from the driver to the disk, and back, without being looked
at. (CDR: OMG DDSI-RTPS 2.3 §10, plain XCDR1; ROS 2 message definitions: design.ros2.org.)
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any

import numpy as np

from hil.core import DataError, RecordingError, StructArray

STATE_SCHEMA_VERSION = 1


class Status(IntFlag):
    """Bits of the `status` field."""

    MOVING = 1
    """The commanded motion of the segment is still running."""
    HOLDING = 2
    """The commanded position is constant."""
    FAULT = 4
    """The controller reports a fault; `fault_code` says which."""
    MASKED = 8
    """The sample must not be used for identification (set-point ignored, limit active)."""
    SLOWED = 16
    """The sample belongs to a measurement at another speed than planned; set by the engine."""


def state_dtype(n_joints: int) -> np.dtype[Any]:
    """The dtype of the base robot record for `n_joints` joints.

    Fields (SI units; NaN where the robot cannot provide a quantity):

    ========================= ========= ====================================================
    device_time               s         controller clock; gaps and duplicates are judged on it
    host_time                 s         Unix time of reception (virtual epoch on virtual clocks)
    q, qd                     rad(/s)   measured joint position and velocity, (n,)
    effort                    A or N·m  what the robot measures: see `Capabilities.effort_kind`
    temperature               °C        joint temperature, (n,)
    q_target … qdd_target     rad…      commanded position, velocity, acceleration, (n,)
    effort_target             A or N·m  the controller's own effort command, (n,)
    segment                   –         index of the plan step that was executing, −1 if none
    status, fault_code, mode  –         `Status` bits, driver's fault number, driver's mode
    ========================= ========= ====================================================
    """
    per_joint = (
        "q", "qd", "effort", "temperature",
        "q_target", "qd_target", "qdd_target", "effort_target",
    )  # fmt: skip
    fields: list[Any] = [("device_time", "<f8"), ("host_time", "<f8")]
    fields += [(name, "<f8", (n_joints,)) for name in per_joint]
    fields += [(name, "<i4") for name in ("segment", "status", "fault_code", "mode")]
    return np.dtype(fields)


def n_joints_of(block: StructArray) -> int:
    """Number of joints of a block of state rows."""
    return int(block.dtype["q"].shape[0])


STATE_TOPIC = "/robot/state"

TARGET_TOPIC = "/robot/torque_target"
"""The controller's own torques beside its current commands, where both were logged."""

_MESSAGE_NAME = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")

ROS_OF_NUMPY = {
    "<f8": "float64", "<i8": "int64", "<u8": "uint64",
    "<f4": "float32", "<i4": "int32", "<u4": "uint32",
    "<i2": "int16", "<u2": "uint16", "|i1": "int8", "|u1": "uint8", "|b1": "bool",
}  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """What is recorded under one name, and how to read it years later.

    Attributes:
        name: Topic name, such as `/robot/state` or `/can/raw`.
        dtype: Packed little-endian record; its first fields are `device_time` and `host_time`,
            both float64 [s].
        rate_hz: Nominal sample rate by the device clock [Hz]; gaps are judged against it.
        clock: Which clock `device_time` counts: `controller`, `virtual`, `host`, …
        units: Field name → unit, as text; fields without a unit are left out.
        schema_name: ROS 2 message name, `package/msg/Name`.
        schema_version: Raised when a field changes its meaning; see decision record 0002.

    Raises:
        RecordingError: The dtype is no CDR message, or a name is not one ROS 2 accepts.
    """

    name: str
    dtype: np.dtype[Any]
    rate_hz: float
    clock: str
    units: Mapping[str, str] = field(default_factory=dict)
    schema_name: str = "hil/msg/Record"
    schema_version: int = 1

    def __post_init__(self) -> None:
        if problem := self._problem():
            raise RecordingError(f"topic {self.name}: {problem[0]}", hint=problem[1])

    def _problem(self) -> tuple[str, str] | None:
        if problem := cdr_problem(self.dtype):
            return problem, "order the fields by size: float64 first, then int32, then smaller"
        names = self.dtype.names or ()
        times = [("device_time", "<f8"), ("host_time", "<f8")]
        if [(name, self.dtype[name].str) for name in names[:2]] != times:
            return "the record lacks its times", "begin it with float64 device_time and host_time"
        if not 0 < self.rate_hz < math.inf:
            return f"the rate {self.rate_hz} Hz is no rate", "give the nominal sample rate"
        if not _MESSAGE_NAME.fullmatch(self.schema_name):
            return f"{self.schema_name!r} is no ROS 2 message name", "use package/msg/Name"
        if unknown := set(self.units) - set(names):
            return f"units name unknown fields {sorted(unknown)}", f"it has {', '.join(names)}"
        return None

    @property
    def schema_text(self) -> str:
        """The ROS 2 message definition, one field a line with its unit as a comment."""
        return "".join(self._schema_line(name) for name in self.dtype.names or ())

    def _schema_line(self, name: str) -> str:
        base, shape = self.dtype[name].base, self.dtype[name].shape
        array = f"[{shape[0]}]" if shape else ""
        unit = f"  # {self.units[name]}" if name in self.units else ""
        return f"{ROS_OF_NUMPY[base.str]}{array} {name}{unit}\n"

    @property
    def channel_metadata(self) -> dict[str, str]:
        """What the MCAP channel says about the topic: version, rate, clock, units."""
        return {
            "schema_version": str(self.schema_version),
            "rate_hz": repr(float(self.rate_hz)),
            "clock": self.clock,
            **{f"unit.{name}": unit for name, unit in self.units.items()},
        }

    def blank(self, rows: int) -> StructArray:
        """Rows in which nothing is known yet: NaN in floating-point fields, 0 in integers."""
        block = np.zeros(rows, self.dtype)
        for name in self.dtype.names or ():
            if self.dtype[name].base.kind == "f":
                block[name] = np.nan
        return block


def state_topic(n_joints: int, rate_hz: float, *, clock: str, effort_unit: str) -> Topic:
    """The base robot record of an arm with `n_joints` joints.

    Args:
        n_joints: Number of joints n.
        rate_hz: Rate of the state samples [Hz].
        clock: Which clock `device_time` counts.
        effort_unit: `A` or `N·m`, for `effort` and `effort_target`.
    """
    units = {
        "device_time": "s", "host_time": "s (Unix time)",
        "q": "rad", "qd": "rad/s", "effort": effort_unit, "temperature": "°C",
        "q_target": "rad", "qd_target": "rad/s", "qdd_target": "rad/s^2",
        "effort_target": effort_unit,
    }  # fmt: skip
    return Topic(
        name=STATE_TOPIC,
        dtype=state_dtype(n_joints),
        rate_hz=rate_hz,
        clock=clock,
        units=units,
        schema_name=f"hil/msg/State{n_joints}",
        schema_version=STATE_SCHEMA_VERSION,
    )


def torque_target_topic(n_joints: int, rate_hz: float, *, clock: str) -> Topic:
    """What a controller that commands currents takes for its torques, row by row of the state.

    Args:
        n_joints: Number of joints n.
        rate_hz: Rate of the samples [Hz].
        clock: Which clock `device_time` counts.
    """
    fields: list[Any] = [("device_time", "<f8"), ("host_time", "<f8")]
    return Topic(
        name=TARGET_TOPIC,
        dtype=np.dtype([*fields, ("torque_target", "<f8", (n_joints,))]),
        rate_hz=rate_hz,
        clock=clock,
        units={"device_time": "s", "host_time": "s (Unix time)", "torque_target": "N·m"},
        schema_name=f"hil/msg/TorqueTarget{n_joints}",
    )


CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header of plain little-endian CDR."""

_NUMPY_OF_ROS = {ros: code for code, ros in ROS_OF_NUMPY.items()}
_FIELD_NAME = re.compile(r"[a-z]([a-z0-9]|_(?!_|$))*")


def cdr_problem(dtype: np.dtype[Any]) -> str | None:
    """Why a packed row of `dtype` is not a CDR message, or None when it is (XCDR1 alignment)."""
    if dtype.names is None or dtype.fields is None:
        return "the dtype has no fields"
    end = 0
    for name in dtype.names:
        item, offset = dtype.fields[name][:2]
        if not _FIELD_NAME.fullmatch(name):
            return f"{name!r} is no ROS 2 field name"
        if item.base.str not in ROS_OF_NUMPY or len(item.shape) > 1:
            return f"field {name!r} is {item}, which no fixed-size ROS 2 field can hold"
        if offset != end:
            return f"there are padding bytes before field {name!r}"
        if offset % item.base.itemsize:
            return f"field {name!r} at byte {offset} is not aligned to {item.base.itemsize} bytes"
        end = offset + item.itemsize
    return "there are padding bytes at the end" if end != dtype.itemsize else None


_CONSTANT = re.compile(r"\w+\s+\w+\s*=")
_SCHEMA_LINE = re.compile(r"(\w+)(?:\[([1-9]\d{0,5})\])?\s+(\w+)")


def dtype_of_schema(text: str) -> np.dtype[Any]:
    """The dtype whose rows are the messages of a ROS 2 message definition.

    Raises:
        DataError: Its messages differ in size (strings, sequences), are nested, or are padded.
    """
    fields: list[Any] = []
    for line in text.splitlines():
        declaration = line.partition("#")[0].strip()
        if not declaration or _CONSTANT.match(declaration):
            continue
        match = _SCHEMA_LINE.fullmatch(declaration)
        if match is None or match[1] not in _NUMPY_OF_ROS:
            raise DataError(f"the field {declaration!r} has no fixed size")
        code = _NUMPY_OF_ROS[match[1]]
        fields.append((match[3], code, (int(match[2]),)) if match[2] else (match[3], code))
    try:
        dtype = np.dtype(fields)
    except ValueError as error:
        raise DataError(f"the message definition is unusable: {error}") from None
    if problem := cdr_problem(dtype):
        raise DataError(f"its messages are no packed rows: {problem}")
    return dtype


def cdr_string(text: str) -> bytes:
    """A CDR string, padded so that another 4-byte field may follow it."""
    raw = text.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw + b"\0" * (-len(raw) % 4)
