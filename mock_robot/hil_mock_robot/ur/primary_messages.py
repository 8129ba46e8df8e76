"""Robot messages of the primary interface: versions, programs, errors, popups.

Source: Universal Robots, "Primary and Secondary Interfaces", messages to clients. Everything is
big-endian; a text reaches to the end of its message.
"""

from __future__ import annotations

import struct
import time
from enum import IntEnum

from hil_mock_robot.ur.series import Series

ROBOT_MESSAGE = 20
NAME = b"URControl"
UNTIMED = 0xFFFFFFFFFFFFFFFF
"""Time of what is told on connecting: clients that look for a packet by its first bytes, such as
python-urx, take a real time for one now and then."""


class Source(IntEnum):
    """Who a message is from."""

    ROBOT_INTERFACE = -2
    RT_MACHINE = -3
    SAFETY = 20
    CONTROLLER = 7
    GUI = -5


class Level(IntEnum):
    """How bad an error code is."""

    INFO = 1
    WARNING = 2
    VIOLATION = 3
    FAULT = 4


def message(
    kind: int, body: bytes, now_s: float | None, source: Source = Source.ROBOT_INTERFACE
) -> bytes:
    """A robot message: size, type, time [µs], source, kind of message, body."""
    time_us = UNTIMED if now_s is None else round(now_s * 1e6)
    head = struct.pack(">BQbb", ROBOT_MESSAGE, time_us, source, kind)
    return struct.pack(">i", 4 + len(head) + len(body)) + head + body


def text_message(text: str, now_s: float) -> bytes:
    """A line for the log (kind 0)."""
    return message(0, text.encode(), now_s, Source.RT_MACHINE)


def popup_message(title: str, text: str, now_s: float) -> bytes:
    """A popup that nobody has to answer (kind 2)."""
    name = title.encode()[:255]
    body = struct.pack(">II???B", 0, 0, False, False, False, len(name))
    return message(2, body + name + text.encode(), now_s, Source.RT_MACHINE)


def greeting(series: Series) -> bytes:
    """What a client is told on connecting: the version (kind 3), and what UR alone reads (12).

    As controllers and URSim of 3.10, 5.12 and 5.13 do: no time, no build number.
    """
    return _version(series) + message(12, struct.pack(">iiB", 0, 0, 1), None)


def _version(series: Series) -> bytes:
    major, minor, bugfix, _ = series.version
    date = time.strftime("%d-%m-%Y, %H:%M:%S", time.strptime(series.date, "%b %d %Y"))
    body = struct.pack(">b", len(NAME)) + NAME + struct.pack(">BBii", major, minor, bugfix, 0)
    return message(3, body + date.encode(), None)


def safety_mode_message(mode: int, now_s: float) -> bytes:
    """The safety mode has changed (kind 5)."""
    return message(5, struct.pack(">iiBII", 0, 0, mode, 0, 0), now_s, Source.SAFETY)


def error_message(code: int, level: Level, text: str, now_s: float) -> bytes:
    """An error code C… (kind 6)."""
    body = struct.pack(">iiiII", code, 0, level, 0, 0)
    return message(6, body + text.encode(), now_s, Source.CONTROLLER)


def key_message(title: str, text: str, now_s: float) -> bytes:
    """Something a client may wait for (kind 7)."""
    name = title.encode()[:255]
    body = struct.pack(">iiB", 0, 0, len(name))
    return message(7, body + name + text.encode(), now_s)


def exception_message(text: str, now_s: float, line: int = 1, column: int = 1) -> bytes:
    """The program has failed (kind 10)."""
    body = struct.pack(">II", line, column) + text.encode()
    return message(10, body, now_s, Source.RT_MACHINE)
