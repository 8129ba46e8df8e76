"""Events in the recording as `rcl_interfaces/msg/Log`, which every viewer's log panel shows.

JSON messages with a `jsonschema` would be simpler, but rosbags refuses a whole file that holds
one (KeyError on the schema encoding), and a `ros2` profile promises CDR. So the event's kind is
the logger's name and the event itself is the message, as JSON text.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from hil.core import json_line
from hil.robot import CDR_HEADER, cdr_string

EVENT_TOPIC = "/events"
EVENT_SCHEMA = "rcl_interfaces/msg/Log"
EVENT_TEXT = f"""\
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
INFO = 20
"""Level of an ordinary event; 10 debug, 30 warning, 40 error."""


def encode_event(event: Mapping[str, Any]) -> bytes:
    """The CDR message of one event; it has `t` (Unix time [s]) and `kind`."""
    return encode_log(float(event["t"]), INFO, str(event["kind"]), json_line(event))


def encode_log(t: float, level: int, name: str, text: str) -> bytes:
    """The CDR message of one log line.

    Args:
        t: Unix time [s].
        level: 10 debug, 20 info, 30 warning, 40 error.
        name: Of the logger.
        text: The line.
    """
    stamp = max(0.0, t)
    body = struct.pack("<iIB3x", int(stamp), int(stamp % 1.0 * 1e9), level)
    for part in (name, text, "", ""):
        body += cdr_string(part)
    return CDR_HEADER + body + struct.pack("<I", 0)
