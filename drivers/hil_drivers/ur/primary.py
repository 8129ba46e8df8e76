"""Client of the primary interface of a UR controller, which reports the configured joint limits.

The format of the packets is described in Universal Robots, "Primary and Secondary Interfaces":
robot state (packet type 16), configuration data. All numbers in the packets are big-endian. No test
on a physical arm has shown whether the interface also reports a joint range that is narrowed in the
safety settings.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator

import numpy as np

from hil.core import RobotConnectionError
from hil_drivers.arm import ReportedLimits

PRIMARY_PORT = 30001

PRIMARY_S = 2.0
"""Time limit for the connection and the first robot state together [s]; ten states arrive per
second.
"""

MOST_BYTES = 1 << 18
"""Maximum number of bytes read before the configuration data must have arrived."""

LARGEST_PACKET = 1 << 16
ROBOT_STATE, CONFIGURATION = 16, 6
N = 6


def reported_limits(address: str) -> ReportedLimits:
    """Read the joint limits of a controller without sending a command.

    Args:
        address: Address of the controller.

    Raises:
        RobotConnectionError: The controller sends no limits in time, or sends invalid limits.
    """
    until = time.monotonic() + PRIMARY_S
    peer = f"{address}:{PRIMARY_PORT}"
    try:
        with socket.create_connection((address, PRIMARY_PORT), PRIMARY_S) as line:
            return _first_limits(line, until, peer)
    except OSError as error:
        raise _problem(peer, f"cannot be reached: {error.strerror or error}") from error


def _first_limits(line: socket.socket, until: float, peer: str) -> ReportedLimits:
    for kind, content in _packets(line, until, peer):
        if kind != ROBOT_STATE:
            continue
        try:
            limits = limits_in(content)
        except ValueError as error:
            raise _problem(peer, f"sent invalid data: {error}") from error
        if limits is not None:
            return limits
    raise _problem(peer, "has not sent its joint limits in time")


_PACKET, _PART = struct.Struct(">iB"), struct.Struct(">IB")


def _packets(line: socket.socket, until: float, peer: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of packets until `MOST_BYTES` were read or time `until` is over."""
    data, taken = b"", 0
    while taken < MOST_BYTES and (left := until - time.monotonic()) > 0:
        line.settimeout(left)
        try:
            more = line.recv(1 << 14)
        except TimeoutError:
            return
        if not more:
            raise _problem(peer, "closed the connection")
        data, taken = data + more, taken + len(more)
        while len(data) >= _PACKET.size:
            size, kind = _PACKET.unpack_from(data)
            if not _PACKET.size <= size <= LARGEST_PACKET:
                raise _problem(peer, f"sent an invalid packet: {data[:8].hex(' ')}")
            if len(data) < size:
                break
            yield kind, data[_PACKET.size : size]
            data = data[size:]


def _problem(peer: str, what: str) -> RobotConnectionError:
    return RobotConnectionError(
        f"the primary interface at {peer} {what}",
        hint="check that port 30001 is open in the controller's security settings",
    )


def limits_in(state: bytes) -> ReportedLimits | None:
    """Return the joint limits in the content of one robot state; None if the state has no limits.

    Raises:
        ValueError: The content is not a robot state, or the limits are invalid.
    """
    at = 0
    while at < len(state):
        if len(state) - at < _PART.size:
            raise ValueError("a part of a robot state is truncated")
        size, kind = _PART.unpack_from(state, at)
        if not _PART.size <= size <= len(state) - at:
            raise ValueError(f"a part of a robot state has the invalid length {size} bytes")
        if kind == CONFIGURATION:
            return _limits_of(state[at + _PART.size : at + size])
        at += size
    return None


_LIMITS = struct.Struct(">24d")


def _limits_of(content: bytes) -> ReportedLimits:
    if len(content) < _LIMITS.size:
        raise ValueError(f"the configuration data has only {len(content)} bytes")
    numbers = np.array(_LIMITS.unpack_from(content)).reshape(2, N, 2)
    (q_min, q_max), (qd_max, qdd_max) = numbers.transpose(0, 2, 1)
    limits = ReportedLimits(q_min, q_max, qd_max, qdd_max)
    valid = np.isfinite(numbers).all() and (q_min < q_max).all() and (numbers[1] > 0).all()
    if not valid:
        raise ValueError(f"impossible joint limits {numbers.round(3).tolist()}")
    return limits
