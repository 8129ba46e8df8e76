"""Numpy rows that are CDR messages as they lie in memory, and their ROS 2 definitions.

A packed little-endian row behind the four bytes `00 01 00 00` is a valid CDR message as long as
every field lies at a multiple of its own size, which "doubles first, then 32-bit integers, …"
guarantees. So a row goes from the driver to the disk, and back, without being looked at.
(CDR: OMG DDSI-RTPS 2.3 §10, plain XCDR1; ROS 2 message definitions: design.ros2.org.)
"""

from __future__ import annotations

import re
import struct
from typing import Any

import numpy as np

from hil.core import DataError

CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header of plain little-endian CDR."""

ROS_OF_NUMPY = {
    "<f8": "float64", "<i8": "int64", "<u8": "uint64",
    "<f4": "float32", "<i4": "int32", "<u4": "uint32",
    "<i2": "int16", "<u2": "uint16", "|i1": "int8", "|u1": "uint8", "|b1": "bool",
}  # fmt: skip
_NUMPY_OF_ROS = {ros: code for code, ros in ROS_OF_NUMPY.items()}
_FIELD_NAME = re.compile(r"[a-z]([a-z0-9]|_(?!_|$))*")
_CONSTANT = re.compile(r"\w+\s+\w+\s*=")
_SCHEMA_LINE = re.compile(r"(\w+)(?:\[([1-9]\d{0,5})\])?\s+(\w+)")


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
