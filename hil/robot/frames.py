"""Frames between `hil` and a driver's process: a JSON header and raw arrays, nothing executable.

::

    "hil1" | header length u32 | body length u32 | header (JSON object) | body (array bytes)

The header's `arrays` lists dtype and shape of what the body holds, one after the other.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from hil.core import RobotConnectionError, StructArray

PREFIX = struct.Struct("<4sII")
MAGIC = b"hil1"
MOST_HEADER = 1 << 20
MOST_BODY = 1 << 28
"""Bounds [bytes]; a segment of an hour at 500 Hz for seven joints is 2.9e8, a day's dwell 1e6."""

_PLAIN = re.compile(r"[<>|]?[biuf][1248]")

Message: TypeAlias = tuple[dict[str, Any], list[StructArray]]


def pack(header: Mapping[str, Any], arrays: Sequence[StructArray] = ()) -> bytes:
    """One frame.

    Raises:
        RobotConnectionError: It would be larger than the other side accepts.
        TypeError, ValueError: The header cannot be said in JSON.
    """
    whole = [np.asarray(array) for array in arrays]
    described = [[dtype_text(array.dtype), array.shape] for array in whole]
    head = json.dumps({**header, "arrays": described}).encode()
    body = b"".join(array.tobytes() for array in whole)
    if len(head) > MOST_HEADER or len(body) > MOST_BODY:
        raise RobotConnectionError(
            f"a message of {len(head) + len(body)} bytes is too long for the driver's process",
            hint="split the motion into shorter ones",
        )
    return PREFIX.pack(MAGIC, len(head), len(body)) + head + body


def unpack(head: bytes, body: bytes | bytearray) -> Message:
    """Header and arrays of one frame; the arrays are the caller's own.

    Raises:
        RobotConnectionError: It is no frame of this format.
    """
    try:
        header = json.loads(head)
        arrays = _arrays(header.pop("arrays"), memoryview(bytearray(body)))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise garbage(f"{type(error).__name__}: {error}") from error
    return header, arrays


def garbage(what: str) -> RobotConnectionError:
    """The error for anything that is not what this format says."""
    return RobotConnectionError(
        f"what the driver's process says cannot be understood: {what[:200]}",
        hint="does the driver write to descriptors that are not its own?",
    )


def _arrays(described: Sequence[Any], body: memoryview) -> list[StructArray]:
    out, begin = [], 0
    for text, shape in described:
        dtype = dtype_of(text)
        if not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(f"an array of shape {shape}")
        end = begin + math.prod(shape) * dtype.itemsize
        if end > len(body):
            raise ValueError("arrays that are longer than the frame")
        out.append(np.frombuffer(body[begin:end], dtype).reshape(shape))
        begin = end
    if begin != len(body):
        raise ValueError("bytes that belong to no array")
    return out


@lru_cache(maxsize=64)
def dtype_text(dtype: np.dtype[Any]) -> str:
    """A plain or flat structured dtype, as text.

    Raises:
        RobotConnectionError: It is nested, or holds objects.
    """
    if dtype.names is None:
        text = dtype.str
    else:
        fields = [(name, dtype[name].base.str, dtype[name].shape) for name in dtype.names]
        text = json.dumps(fields)
    if not _is(text, dtype):
        raise RobotConnectionError(
            f"rows of {dtype} cannot be sent from a driver's process",
            hint="use a packed record of numbers, see hil.robot.Topic",
        )
    return text


def _is(text: str, dtype: np.dtype[Any]) -> bool:
    try:
        return dtype_of(text) == dtype
    except ValueError:
        return False


@lru_cache(maxsize=64)
def dtype_of(text: str) -> np.dtype[Any]:
    """What `dtype_text` wrote.

    Raises:
        ValueError, TypeError: It did not.
    """
    if not text.startswith("["):
        return _plain(text)
    fields = json.loads(text)
    return np.dtype([(name, _plain(kind), tuple(shape)) for name, kind, shape in fields])


def _plain(text: str) -> np.dtype[Any]:
    if not _PLAIN.fullmatch(text):
        raise ValueError(f"the dtype {text[:40]!r}")
    return np.dtype(text)
