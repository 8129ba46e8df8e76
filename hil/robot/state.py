"""State rows of a robot: the base record and further topics, in the format of ROS 2 messages.

The numpy dtype `state_dtype` is used from the driver to the disk and back; drivers can record
further topics (`Topic`). In a state row, doubles come first and 32-bit integers last (decision
record 0002): a packed little-endian row after the four bytes `00 01 00 00` is a valid CDR message
if every field is at a multiple of its own size. A row therefore passes from the driver to the disk
and back without conversion. (CDR: OMG DDSI-RTPS 2.3 §10, plain XCDR1; ROS 2 message definitions:
design.ros2.org.)
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
    """Bits of the field `status` of a state row."""

    MOVING = 1
    """Bit that is set while the commanded motion of the segment is still running."""
    HOLDING = 2
    """Bit that is set while the commanded position is constant."""
    FAULT = 4
    """Bit that is set if the controller reports a fault, see `fault_code`."""
    MASKED = 8
    """Bit that is set if the sample must not be used for identification (set-point ignored,
    limit active)."""
    SLOWED = 16
    """Bit that the engine sets if the measurement was made at a different speed than planned."""


def state_dtype(n_joints: int) -> np.dtype[Any]:
    """Return the dtype of the base robot record for `n_joints` joints.

    Fields of the base robot record (SI units; NaN if the robot cannot provide a quantity):

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
    """Return the number of joints of a block of state rows."""
    return int(block.dtype["q"].shape[0])


STATE_TOPIC = "/robot/state"

TARGET_TOPIC = "/robot/torque_target"
"""Name of the topic of the torque set-points of a controller, if they are logged in addition to
current set-points."""

_MESSAGE_NAME = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")

ROS_OF_NUMPY = {
    "<f8": "float64", "<i8": "int64", "<u8": "uint64",
    "<f4": "float32", "<i4": "int32", "<u4": "uint32",
    "<i2": "int16", "<u2": "uint16", "|i1": "int8", "|u1": "uint8", "|b1": "bool",
}  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """Definition of a recorded topic, sufficient to read the recording years later.

    Attributes:
        name: Topic name, such as `/robot/state` or `/can/raw`.
        dtype: Dtype of the packed little-endian rows; the first fields are `device_time` and
            `host_time`, both float64 [s].
        rate_hz: Nominal sample rate by the device clock [Hz], with which gaps are detected.
        clock: Clock that determines `device_time`: `controller`, `virtual`, `host`, ….
        units: Unit of each field, as text by field name; fields without a unit are omitted.
        schema_name: Name of the ROS 2 message, `package/msg/Name`.
        schema_version: Version of the message, increased if a field changes its meaning; see
            decision record 0002.

    Raises:
        RecordingError: The dtype is not a valid CDR message, or a name is not allowed in ROS 2.
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
            return problem, "sort the fields by size: float64 first, then int32, then smaller"
        names = self.dtype.names or ()
        times = [("device_time", "<f8"), ("host_time", "<f8")]
        if [(name, self.dtype[name].str) for name in names[:2]] != times:
            return "the record lacks time stamps", "begin with float64 device_time and host_time"
        if not 0 < self.rate_hz < math.inf:
            return f"invalid rate: {self.rate_hz} Hz", "pass the nominal sample rate in Hz"
        if not _MESSAGE_NAME.fullmatch(self.schema_name):
            return f"{self.schema_name!r} is not a ROS 2 message name", "use package/msg/Name"
        if unknown := set(self.units) - set(names):
            return f"units for unknown fields {sorted(unknown)}", f"fields: {', '.join(names)}"
        return None

    @property
    def schema_text(self) -> str:
        """ROS 2 message definition of the topic, one field per line with its unit as a comment."""
        return "".join(self._schema_line(name) for name in self.dtype.names or ())

    def _schema_line(self, name: str) -> str:
        base, shape = self.dtype[name].base, self.dtype[name].shape
        array = f"[{shape[0]}]" if shape else ""
        unit = f"  # {self.units[name]}" if name in self.units else ""
        return f"{ROS_OF_NUMPY[base.str]}{array} {name}{unit}\n"

    @property
    def channel_metadata(self) -> dict[str, str]:
        """Metadata of the MCAP channel of the topic: version, rate, clock, units."""
        return {
            "schema_version": str(self.schema_version),
            "rate_hz": repr(float(self.rate_hz)),
            "clock": self.clock,
            **{f"unit.{name}": unit for name, unit in self.units.items()},
        }

    def blank(self, rows: int) -> StructArray:
        """Return rows without known values: NaN in floating-point fields, 0 in integer fields."""
        block = np.zeros(rows, self.dtype)
        for name in self.dtype.names or ():
            if self.dtype[name].base.kind == "f":
                block[name] = np.nan
        return block


def state_topic(n_joints: int, rate_hz: float, *, clock: str, effort_unit: str) -> Topic:
    """Return the topic of the base robot record of an arm with `n_joints` joints.

    Args:
        n_joints: Number of joints n.
        rate_hz: Rate of the state samples [Hz].
        clock: Clock that determines `device_time`.
        effort_unit: Unit of `effort` and `effort_target`: `A` or `N·m`.
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
    """Return the topic of the torque set-points of a current-commanding controller.

    The torque topic has one row per state row.

    Args:
        n_joints: Number of joints n.
        rate_hz: Rate of the samples [Hz].
        clock: Clock that determines `device_time`.
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
"""Encapsulation header that precedes plain little-endian CDR data."""

_NUMPY_OF_ROS = {ros: code for code, ros in ROS_OF_NUMPY.items()}
_FIELD_NAME = re.compile(r"[a-z]([a-z0-9]|_(?!_|$))*")


def cdr_problem(dtype: np.dtype[Any]) -> str | None:
    """Return why a packed row of `dtype` is not a CDR message (XCDR1); None if it is valid."""
    if dtype.names is None or dtype.fields is None:
        return "the dtype has no fields"
    end = 0
    for name in dtype.names:
        item, offset = dtype.fields[name][:2]
        if not _FIELD_NAME.fullmatch(name):
            return f"{name!r} is not a ROS 2 field name"
        if item.base.str not in ROS_OF_NUMPY or len(item.shape) > 1:
            return f"field {name!r} is {item}, which is not a fixed-size ROS 2 field"
        if offset != end:
            return f"there are padding bytes before field {name!r}"
        if offset % item.base.itemsize:
            return f"field {name!r} at byte {offset} is not aligned to {item.base.itemsize} bytes"
        end = offset + item.itemsize
    return "there are padding bytes at the end" if end != dtype.itemsize else None


_CONSTANT = re.compile(r"\w+\s+\w+\s*=")
_SCHEMA_LINE = re.compile(r"(\w+)(?:\[([1-9]\d{0,5})\])?\s+(\w+)")


def dtype_of_schema(text: str) -> np.dtype[Any]:
    """Return the dtype whose rows are the messages of a ROS 2 message definition.

    Raises:
        DataError: The messages have no fixed size (strings, sequences), are nested, or are padded.
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
        raise DataError(f"its messages are not packed rows: {problem}")
    return dtype


def cdr_string(text: str) -> bytes:
    """Return an encoded CDR string, padded so that a further 4-byte field can follow."""
    raw = text.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw + b"\0" * (-len(raw) % 4)
