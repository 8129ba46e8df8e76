"""The primary interface of a controller: the joint limits that it is configured with.

Source: Universal Robots, "Primary and Secondary Interfaces": robot state (16), configuration data.
Everything is big-endian. It was not compared with a physical arm whether a joint range narrowed in
the safety settings is told here too.
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
"""How long connecting and the first robot state may take together; ten come a second [s]."""

MOST_BYTES = 1 << 18
"""Of everything that is read before the configuration must have come."""

LARGEST_PACKET = 1 << 16
ROBOT_STATE, CONFIGURATION = 16, 6
N = 6


def reported_limits(address: str) -> ReportedLimits:
    """Ask a controller for its joint limits; commands nothing.

    Args:
        address: Of the controller.

    Raises:
        RobotConnectionError: It sends none in time, or limits that are not possible.
    """
    until = time.monotonic() + PRIMARY_S
    peer = f"{address}:{PRIMARY_PORT}"
    try:
        with socket.create_connection((address, PRIMARY_PORT), PRIMARY_S) as line:
            return _first_limits(line, until, peer)
    except OSError as error:
        raise _problem(peer, f"cannot be asked: {error.strerror or error}") from error


def _first_limits(line: socket.socket, until: float, peer: str) -> ReportedLimits:
    for kind, content in _packets(line, until, peer):
        if kind != ROBOT_STATE:
            continue
        try:
            limits = limits_in(content)
        except ValueError as error:
            raise _problem(peer, f"tells {error}") from error
        if limits is not None:
            return limits
    raise _problem(peer, "has not told its joint limits in time")


_PACKET, _PART = struct.Struct(">iB"), struct.Struct(">IB")


def _packets(line: socket.socket, until: float, peer: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of packets, up to a number and a time."""
    data, taken = b"", 0
    while taken < MOST_BYTES and (left := until - time.monotonic()) > 0:
        line.settimeout(left)
        try:
            more = line.recv(1 << 14)
        except TimeoutError:
            return
        if not more:
            raise _problem(peer, "has hung up")
        data, taken = data + more, taken + len(more)
        while len(data) >= _PACKET.size:
            size, kind = _PACKET.unpack_from(data)
            if not _PACKET.size <= size <= LARGEST_PACKET:
                raise _problem(peer, f"sends what is no packet: {data[:8].hex(' ')}")
            if len(data) < size:
                break
            yield kind, data[_PACKET.size : size]
            data = data[size:]


def _problem(peer: str, what: str) -> RobotConnectionError:
    return RobotConnectionError(
        f"the primary interface at {peer} {what}",
        hint="see whether port 30001 is open in the controller's security settings",
    )


def limits_in(state: bytes) -> ReportedLimits | None:
    """The joint limits in the content of one robot state, None when they are not in it.

    Raises:
        ValueError: It is no robot state, or no arm can have such limits.
    """
    at = 0
    while at < len(state):
        if len(state) - at < _PART.size:
            raise ValueError("a part of a robot state is cut off")
        size, kind = _PART.unpack_from(state, at)
        if not _PART.size <= size <= len(state) - at:
            raise ValueError(f"a part of a robot state says that it has {size} bytes")
        if kind == CONFIGURATION:
            return _limits_of(state[at + _PART.size : at + size])
        at += size
    return None


_LIMITS = struct.Struct(">24d")


def _limits_of(content: bytes) -> ReportedLimits:
    if len(content) < _LIMITS.size:
        raise ValueError(f"configuration data of {len(content)} bytes")
    numbers = np.array(_LIMITS.unpack_from(content)).reshape(2, N, 2)
    (q_min, q_max), (qd_max, qdd_max) = numbers.transpose(0, 2, 1)
    told = ReportedLimits(q_min, q_max, qd_max, qdd_max)
    sound = np.isfinite(numbers).all() and (q_min < q_max).all() and (numbers[1] > 0).all()
    if not sound:
        raise ValueError(f"joint limits that cannot be: {numbers.round(3).tolist()}")
    return told
