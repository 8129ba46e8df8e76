"""Messages between `hil` and a driver process: JSON header and raw arrays, no executable code.

A frame is::

    "hil1" | header length u32 | body length u32 | header (JSON object) | body (array bytes)

The key `arrays` of the frame header lists dtype and shape of the consecutive arrays in the body.
The class `Line` sends and receives frames over a socket; `pack` and `unpack` encode and decode
frames. The other functions of this module convert segments, payloads, errors and robot properties
(`Facts`) to header and arrays, and back. Data from the other process are not trusted: if received
data do not have the message format, the error of `garbage` is raised.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import struct
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from hil.arms import Payload
from hil.core import (
    FloatArray,
    HilError,
    RobotConnectionError,
    RobotError,
    RobotTimeout,
    SpecError,
    StructArray,
    errors,
)
from hil.robot.protocol import (
    Address,
    Capabilities,
    HasAddress,
    HasChecks,
    HasResource,
    HasSpeedScaling,
    HasTopics,
    Identity,
    Limits,
    Robot,
    Segment,
)
from hil.robot.state import Topic

Message: TypeAlias = tuple[dict[str, Any], list[StructArray]]
PREFIX = struct.Struct("<4sII")
MAGIC = b"hil1"
MOST_HEADER = 1 << 20

MOST_BODY = 1 << 28
"""Maximum size of the body of a frame [bytes].

For comparison, a segment of one hour at 500 Hz for seven joints has 2.9e8 bytes, and a dwell of one
day has 1e6 bytes.
"""

_CHUNK = 1 << 18


class Line:
    """One end of a connection that transfers frames; not for concurrent use by several threads.

    Args:
        end: Connected stream socket; the connection owns the socket.

    Attributes:
        torn: Whether the connection is unusable after an incomplete or invalid frame.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._buffer = bytearray()
        self.torn = False

    def send(self, frame: bytes, timeout_s: float | None = None) -> None:
        """Send a packed frame.

        Raises:
            EndOfLine: The other side has closed the connection.
            RobotTimeout: The other side does not receive the frame in time; the connection is then
                unusable.
        """
        self._require_whole()
        # Set until the frame is sent completely, because an interruption leaves half a frame.
        self.torn = True
        try:
            self._end.settimeout(timeout_s)
            self._end.sendall(frame)
        except TimeoutError as error:
            raise RobotTimeout(
                f"the driver process has not taken a message within {timeout_s:g} s",
                hint="the process is overloaded or hangs: stop the robot, then restart",
            ) from error
        except OSError as error:
            self.torn = False  # the other side is gone, so the frames need not stay in sync
            raise EndOfLine(f"the connection is broken: {error}") from error
        self.torn = False

    def receive(self, timeout_s: float | None = None) -> Message:
        """Return the next frame that arrives; no data are lost at a time-out.

        Raises:
            EndOfLine: The other side has closed the connection.
            RobotTimeout: No complete frame has arrived in time.
            RobotConnectionError: The received data are not a frame; the connection is then
                unusable.
        """
        self._require_whole()
        until = None if timeout_s is None else time.monotonic() + timeout_s
        self._fill(PREFIX.size, until)
        magic, head, body = PREFIX.unpack_from(self._buffer)
        if magic != MAGIC or head > MOST_HEADER or body > MOST_BODY:
            self.torn = True
            raise garbage(repr(bytes(self._buffer[:40])))
        begin, end = PREFIX.size + head, PREFIX.size + head + body
        self._fill(end, until)
        text, raw = bytes(self._buffer[PREFIX.size : begin]), self._buffer[begin:end]
        del self._buffer[:end]
        return unpack(text, raw)

    def close(self) -> None:
        """Close the connection.

        Closing the connection notifies the other side and a thread that receives on this end.
        """
        self._end.close()

    def cut(self) -> None:
        """Shut down the connection from any thread; a receiver on this end then returns."""
        try:
            self._end.shutdown(socket.SHUT_RDWR)
        except OSError:  # already shut down by either side
            return

    def _fill(self, size: int, until: float | None) -> None:
        while len(self._buffer) < size:
            left = None if until is None else until - time.monotonic()
            try:
                self._end.settimeout(left if left is None else max(left, 1e-6))
                piece = self._end.recv(_CHUNK)
            except TimeoutError as error:
                raise RobotTimeout(
                    "the driver process does not answer",
                    hint="the driver hangs: make sure that the arm stands still, then restart",
                ) from error
            except OSError as error:
                raise EndOfLine(f"the connection is broken: {error}") from error
            if not piece:
                raise EndOfLine("the connection has ended")
            self._buffer += piece

    def _require_whole(self) -> None:
        if self.torn:
            raise RobotConnectionError(
                "the connection to the driver process is out of step", hint="close the robot"
            )


class EndOfLine(RobotConnectionError):
    """Error for a connection that the other side has closed."""


def pack(header: Mapping[str, Any], arrays: Sequence[StructArray] = ()) -> bytes:
    """Return the bytes of an encoded frame.

    Raises:
        RobotConnectionError: The frame exceeds the maximum size that the other side accepts.
        TypeError, ValueError: The header cannot be converted to JSON.
    """
    whole = [np.asarray(array) for array in arrays]
    described = [[dtype_text(array.dtype), array.shape] for array in whole]
    head = json.dumps({**header, "arrays": described}).encode()
    body = b"".join(array.tobytes() for array in whole)
    if len(head) > MOST_HEADER or len(body) > MOST_BODY:
        raise RobotConnectionError(
            f"a message of {len(head) + len(body)} bytes is too long for the driver process",
            hint="split the motion into shorter ones",
        )
    return PREFIX.pack(MAGIC, len(head), len(body)) + head + body


def unpack(head: bytes, body: bytes | bytearray) -> Message:
    """Return the header and the arrays of a frame; the arrays have their own memory.

    Raises:
        RobotConnectionError: The received data are not a valid frame.
    """
    try:
        header = json.loads(head)
        arrays = _arrays(header.pop("arrays"), memoryview(bytearray(body)))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise garbage(f"{type(error).__name__}: {error}") from error
    return header, arrays


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
    """Return a plain or flat structured dtype as text.

    Raises:
        RobotConnectionError: The dtype is nested or contains Python objects.
    """
    if dtype.names is None:
        text = dtype.str
    else:
        fields = [(name, dtype[name].base.str, dtype[name].shape) for name in dtype.names]
        text = json.dumps(fields)
    if not _reads_back(text, dtype):
        raise RobotConnectionError(
            f"rows of {dtype} cannot be sent from a driver process",
            hint="use a packed record of numbers, see hil.robot.Topic",
        )
    return text


def _reads_back(text: str, dtype: np.dtype[Any]) -> bool:
    try:
        return dtype_of(text) == dtype
    except ValueError:
        return False


@lru_cache(maxsize=64)
def dtype_of(text: str) -> np.dtype[Any]:
    """Return the dtype for a text that `dtype_text` returned.

    Raises:
        ValueError, TypeError: The text was not returned by `dtype_text`.
    """
    if not text.startswith("["):
        return _plain_dtype(text)
    fields = json.loads(text)
    return np.dtype([(name, _plain_dtype(kind), tuple(shape)) for name, kind, shape in fields])


_PLAIN_DTYPE = re.compile(r"[<>|]?[biuf][1248]")


def _plain_dtype(text: str) -> np.dtype[Any]:
    if not _PLAIN_DTYPE.fullmatch(text):
        raise ValueError(f"the dtype {text[:40]!r}")
    return np.dtype(text)


def garbage(what: str) -> RobotConnectionError:
    """Return the error for received data that do not have the message format."""
    return RobotConnectionError(
        f"invalid message of the driver process: {what[:200]}",
        hint="check that the driver does not write to descriptors it did not open",
    )


@contextlib.contextmanager
def understood() -> Iterator[None]:
    """Convert errors about an invalid document in the block into `RobotConnectionError`."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise garbage(f"{type(error).__name__}: {error}") from error


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a driver in a form that JSON supports.

    Raises:
        SpecError: The value of an option has no plain JSON form, for example a date.
    """
    return {name: _plain(value, f"option {name}") for name, value in options.items()}


def _plain(value: Any, where: str) -> Any:
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    raise SpecError(
        f"{where}: {value!r} cannot be sent to a driver process",
        hint="use numbers, text, lists and mappings with text keys; put dates into quotes",
    )


def payload_from(document: Mapping[str, Any]) -> Payload:
    """Return the payload for a document that `dataclasses.asdict` created."""
    return Payload(document["mass"], tuple(document["com"]), tuple(document["inertia"]))


def segment_document(segment: Segment) -> tuple[dict[str, Any], list[FloatArray]]:
    """Return a segment as a header and set-point arrays."""
    document = {
        "index": int(segment.index),
        "kind": segment.kind,
        "speed": float(segment.speed),
        "acceleration": float(segment.acceleration),
    }
    return document, [
        np.asarray(array, np.float64) for array in (segment.q, segment.qd, segment.qdd)
    ]


def segment_from(document: Mapping[str, Any], arrays: Sequence[StructArray]) -> Segment:
    """Return the segment for a header and arrays that `segment_document` created."""
    q, qd, qdd = arrays
    return Segment(q=q, qd=qd, qdd=qdd, **document)


_TOLD_AS_THEY_ARE = (TypeError, ValueError)
"""Exceptions that a driver constructor raises if called with unknown options; they are
transferred unchanged."""

_TRACEBACK_LINES = 6

_MOST_CHARACTERS = 4000
"""Maximum length of an error message in characters, because the answer to a stop request is a
single packet."""


def error_document(error: BaseException, doing: str) -> dict[str, str]:
    """Return an error as a document: nearest class of `hil.core.errors`, message and hint.

    Args:
        error: Exception raised by a driver.
        doing: Name of the driver method that raised the exception.
    """
    if isinstance(error, HilError):
        # The other side does not know subclasses of the driver, but knows their base classes.
        kind = next(k.__name__ for k in type(error).__mro__ if k.__module__ == errors.__name__)
        return {
            "kind": kind,
            "message": error.message[:_MOST_CHARACTERS],
            "hint": error.hint[:_MOST_CHARACTERS],
        }
    if doing == "open" and isinstance(error, _TOLD_AS_THEY_ARE):
        kind = next(k.__name__ for k in _TOLD_AS_THEY_ARE if isinstance(error, k))
        return {"kind": kind, "message": str(error)[:_MOST_CHARACTERS], "hint": ""}
    lines = "".join(traceback.format_exception(error)).strip().splitlines()[-_TRACEBACK_LINES:]
    message = f"{doing}: unexpected {type(error).__name__}: {error}\n" + "\n".join(lines)
    return {
        "kind": "RobotError",
        "message": message[:_MOST_CHARACTERS],
        "hint": "this is a bug in the driver",
    }


def error_from(document: Mapping[str, Any]) -> Exception:
    """Return the error for a document that `error_document` created.

    An error of an unknown class becomes a `RobotError`.
    """
    name, message, hint = (str(document[key]) for key in ("kind", "message", "hint"))
    for plain in _TOLD_AS_THEY_ARE:
        if name == plain.__name__:
            return plain(message)
    kind = getattr(errors, name, RobotError)
    known = isinstance(kind, type) and issubclass(kind, HilError)
    return (kind if known else RobotError)(message, hint=hint)


@dataclass(frozen=True, slots=True)
class Facts:
    """Properties of a robot, as the driver reports them.

    Attributes:
        capabilities, limits: Capabilities and limits of the robot, known before and after
            connecting.
        topics, resource, address: Values of optional members of the driver; None if the driver
            lacks a member.
        identity: Identity of the robot; None before the robot is connected.
        checks: Whether the driver implements the protocol `HasChecks`.
        speed_scaling: Whether the driver reports the ratio of executed to commanded speed.
    """

    capabilities: Capabilities
    limits: Limits
    topics: tuple[Topic, ...] | None
    resource: str | None
    identity: Identity | None
    checks: bool
    address: Address | None = None
    speed_scaling: bool = False


_ARRAYS = ("q_min", "q_max", "qd_max", "qdd_max", "effort_max")


def facts_document(robot: Robot, *, connected: bool) -> dict[str, Any]:
    """Return the properties of a robot as a JSON document."""
    limits = robot.limits
    return {
        "capabilities": asdict(robot.capabilities),
        "limits": {name: getattr(limits, name).tolist() for name in _ARRAYS}
        | {"payload_max_kg": limits.payload_max_kg},
        "topics": [_topic_document(t) for t in robot.topics]
        if isinstance(robot, HasTopics)
        else None,
        "resource": robot.resource if isinstance(robot, HasResource) else None,
        "identity": asdict(robot.identity) if connected else None,
        "checks": isinstance(robot, HasChecks),
        "address": asdict(robot.address) if isinstance(robot, HasAddress) else None,
        "speed_scaling": isinstance(robot, HasSpeedScaling),
    }


def _topic_document(topic: Topic) -> dict[str, Any]:
    return {
        "name": topic.name,
        "dtype": dtype_text(topic.dtype),
        "rate_hz": topic.rate_hz,
        "clock": topic.clock,
        "units": dict(topic.units),
        "schema_name": topic.schema_name,
        "schema_version": topic.schema_version,
    }


def facts_from(document: Mapping[str, Any]) -> Facts:
    """Return the robot properties for a document that `facts_document` created.

    Raises:
        RobotConnectionError: The document of robot properties is invalid.
    """
    with understood():
        topics, identity = document["topics"], document["identity"]
        address = document["address"]
        return Facts(
            capabilities=_capabilities_from(document["capabilities"]),
            limits=_limits_from(document["limits"]),
            topics=None if topics is None else _topics_from(topics),
            resource=document["resource"],
            identity=None if identity is None else Identity(**identity),
            checks=bool(document["checks"]),
            address=None if address is None else Address(**address),
            speed_scaling=bool(document["speed_scaling"]),
        )


def _capabilities_from(document: Mapping[str, Any]) -> Capabilities:
    tuples = {name: tuple(document[name]) for name in ("joint_names", "drive_gains")}
    return Capabilities(**{**document, **tuples})


def _limits_from(document: Mapping[str, Any]) -> Limits:
    arrays = {name: np.array(document[name], dtype=np.float64) for name in _ARRAYS}
    return Limits(**arrays, payload_max_kg=float(document["payload_max_kg"]))


def _topics_from(documents: Sequence[Mapping[str, Any]]) -> tuple[Topic, ...]:
    return tuple(Topic(**{**each, "dtype": dtype_of(each["dtype"])}) for each in documents)
