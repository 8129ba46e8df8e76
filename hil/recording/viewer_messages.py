"""Messages of ROS 2 that every viewer shows: a copy of the robot's state, and events as a log.

Written into recordings and sent by the live view. Joint states are a decimated copy of the base
robot record. Names and frame never change within a file, so every message has the same size and the
constant parts are written once into a template row; only stamp, position, velocity and effort are
filled.

Events are `rcl_interfaces/msg/Log`, which log panels show. JSON messages with a `jsonschema` would
be simpler, but rosbags refuses a whole file that holds one (KeyError on the schema encoding), and a
`ros2` profile promises CDR. So the event's kind is the logger's name and the event itself is the
message, as JSON text.
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
"""What a screen can show; the full rate is in the base record."""

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
"""Level of an ordinary event; 10 debug, 30 warning, 40 error."""


class JointStateView:
    """Turns blocks of state rows into at most 60 JointState messages a second.

    Args:
        joint_names: Names in the order of the state record, length n.
        rate_hz: Rate of the state rows [Hz].
    """

    def __init__(self, joint_names: Sequence[str], rate_hz: float) -> None:
        self.every = max(1, int(np.ceil(rate_hz / MAX_RATE_HZ)))
        self._template = _template(tuple(joint_names))
        self._seen = 0

    def select(self, rows: StructArray) -> StructArray:
        """Return the rows of this block that are shown: every `every`-th, counted across blocks."""
        first = -self._seen % self.every
        self._seen += len(rows)
        return rows[first :: self.every]

    def encode(self, rows: StructArray) -> StructArray:
        """Return one CDR message per state row; the stamp is `host_time` (0 where it is unknown).

        Raises:
            ValueError: The rows have another number of joints than there are names.
        """
        n_names, n_joints = self._template.dtype["position"].shape[0], n_joints_of(rows)
        if n_names != n_joints:
            raise ValueError(f"{n_names} joint names for a state of {n_joints} joints")
        messages = np.repeat(self._template, len(rows))
        # fmax takes the 0 where the host time is NaN.
        stamp = np.fmin(np.fmax(rows["host_time"], 0.0), 2.0**31 - 1)
        messages["sec"] = stamp
        messages["nanosec"] = stamp % 1.0 * 1e9
        for ours, theirs in (("q", "position"), ("qd", "velocity"), ("effort", "effort")):
            messages[theirs] = rows[ours]
        return messages


def _template(joint_names: tuple[str, ...]) -> StructArray:
    """Return a one-row array with everything constant filled in, CDR header included."""
    n = len(joint_names)
    # frame_id and the sequence of names, from byte 8 of the message on, padded to 4 bytes
    names = cdr_string("") + struct.pack("<I", n) + b"".join(map(cdr_string, joint_names))
    fields: list[Any] = [("cdr", "V4"), ("sec", "<i4"), ("nanosec", "<u4")]
    fields += [("names", f"V{len(names)}")]
    for quantity in ("position", "velocity", "effort"):
        # Sequences follow each other: a count, padding to the doubles' alignment, the doubles.
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
    """Return the CDR message of one event; it has `t` (Unix time [s]) and `kind`."""
    return encode_log(float(event["t"]), _INFO, str(event["kind"]), json_line(event))


def encode_log(t: float, level: int, name: str, text: str) -> bytes:
    """Return the CDR message of one log line.

    Args:
        t: Unix time [s].
        level: 10 debug, 20 info, 30 warning, 40 error.
        name: Name of the logger.
        text: The line.
    """
    stamp = max(0.0, t)
    body = struct.pack("<iIB3x", int(stamp), int(stamp % 1.0 * 1e9), level)
    for part in (name, text, "", ""):
        body += cdr_string(part)
    return CDR_HEADER + body + struct.pack("<I", 0)
