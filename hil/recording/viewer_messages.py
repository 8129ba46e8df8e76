"""ROS 2 messages that every viewer displays: joint states and log messages for events.

These ROS 2 messages are written into recordings and sent by the live view. The joint state messages
are a decimated copy of the base robot record. Joint names and frame are constant within a file, so
that every joint state message has the same size. The constant parts of a joint state message are
stored in a template row; only stamp, position, velocity and effort are filled in.

Events are converted to `rcl_interfaces/msg/Log` messages, which log panels display. JSON messages
with a `jsonschema` would be simpler, but rosbags rejects a whole file that contains such a message
(KeyError on the schema encoding), and the MCAP profile `ros2` requires CDR. In a log message, the
kind of the event is therefore the logger name, and the message text is the event as JSON.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.core import StructArray, json_line
from hil.robot import CDR_HEADER, cdr_string, n_joints_of

JOINT_STATE_TOPIC = "/joint_states"
JOINT_STATE_SCHEMA = "sensor_msgs/msg/JointState"
JOINT_STATE_TEXT = f"""\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

MAX_RATE_HZ = 60.0
"""Maximum rate of JointState messages [Hz], which is sufficient for a display.

The base robot record keeps the full rate.
"""

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

_INFO = 20
"""Log level of an ordinary event; the levels are 10 debug, 20 info, 30 warning, 40 error."""


class JointStateView:
    """Converter of blocks of state rows into at most 60 JointState messages per second.

    Args:
        joint_names: Joint names in the order of the state record, length n.
        rate_hz: Rate of the state rows [Hz].
    """

    def __init__(self, joint_names: Sequence[str], rate_hz: float) -> None:
        self.every = max(1, int(np.ceil(rate_hz / MAX_RATE_HZ)))
        self._template = _template(tuple(joint_names))
        self._seen = 0

    def select(self, rows: StructArray) -> StructArray:
        """Return every `every`-th row of the stream of rows.

        The counting of rows continues across blocks.
        """
        first = -self._seen % self.every
        self._seen += len(rows)
        return rows[first :: self.every]

    def encode(self, rows: StructArray) -> StructArray:
        """Return one CDR message per state row; the stamp is `host_time`, or 0 if unknown.

        Raises:
            ValueError: The number of joints in the rows differs from the number of joint names.
        """
        n_names, n_joints = self._template.dtype["position"].shape[0], n_joints_of(rows)
        if n_names != n_joints:
            raise ValueError(f"{n_names} joint names for a state of {n_joints} joints")
        messages = np.repeat(self._template, len(rows))
        # fmax returns 0 if the host time is NaN.
        stamp = np.fmin(np.fmax(rows["host_time"], 0.0), 2.0**31 - 1)
        messages["sec"] = stamp
        messages["nanosec"] = stamp % 1.0 * 1e9
        for ours, theirs in (("q", "position"), ("qd", "velocity"), ("effort", "effort")):
            messages[theirs] = rows[ours]
        return messages


def _template(joint_names: tuple[str, ...]) -> StructArray:
    """Return a template row with all constant fields filled in, including the CDR header."""
    n = len(joint_names)
    # frame_id and the sequence of names, starting at byte 8 of the message, padded to 4 bytes
    names = cdr_string("") + struct.pack("<I", n) + b"".join(map(cdr_string, joint_names))
    fields: list[Any] = [("cdr", "V4"), ("sec", "<i4"), ("nanosec", "<u4")]
    fields += [("names", f"V{len(names)}")]
    for quantity in ("position", "velocity", "effort"):
        # Each sequence consists of a count, padding to the alignment of doubles, and the doubles.
        offset = np.dtype(fields).itemsize - len(CDR_HEADER)
        fields += [
            (f"{quantity}_count", "<u4"),
            (f"{quantity}_pad", f"V{-(offset + 4) % 8}"),
            (quantity, "<f8", (n,)),
        ]
    template = np.zeros(1, np.dtype([f for f in fields if f[1] != "V0"]))
    template["cdr"] = np.void(CDR_HEADER)
    template["names"] = np.void(names)
    for quantity in ("position", "velocity", "effort"):
        template[f"{quantity}_count"] = n
    return template


def encode_event(event: Mapping[str, Any]) -> bytes:
    """Return the CDR message of one event; the event has `t` (Unix time [s]) and `kind`."""
    return encode_log(float(event["t"]), _INFO, str(event["kind"]), json_line(event))


def encode_log(t: float, level: int, name: str, text: str) -> bytes:
    """Return the CDR message of one log line.

    Args:
        t: Unix time [s].
        level: Log level of the line: 10 debug, 20 info, 30 warning, 40 error.
        name: Name of the logger, displayed with the message.
        text: Text of the log message.
    """
    stamp = max(0.0, t)
    body = struct.pack("<iIB3x", int(stamp), int(stamp % 1.0 * 1e9), level)
    for part in (name, text, "", ""):
        body += cdr_string(part)
    return CDR_HEADER + body + struct.pack("<I", 0)
