"""What is served, and how it is encoded: the same topics and schemas as in the recording.

So one layout shows a run while it goes on, and its MCAP file afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import StructArray
from hil.engine.standing import Standing
from hil.recording import (
    EVENT_SCHEMA,
    EVENT_TEXT,
    EVENT_TOPIC,
    JOINT_STATE_SCHEMA,
    JOINT_STATE_TEXT,
    JOINT_STATE_TOPIC,
    JointStateView,
)
from hil.robot import CDR_HEADER, Capabilities, Topic, state_topic

TRACKING_TOPIC = "/robot/tracking_error"
PROGRESS_TOPIC = "/hil/progress"

PROGRESS_SCHEMA: dict[str, Any] = {
    "title": "hil.Progress",
    "type": "object",
    "properties": {
        key: {"type": {str: "string", int: "integer", float: "number"}[type(value)]}
        for key, value in Standing().snapshot().items()
    },
}
"""JSON Schema of `Standing.snapshot`."""


@dataclass(frozen=True, slots=True)
class RosSchema:
    """A ROS 2 message definition, as viewers want it."""

    name: str
    text: str


class RobotTopics:
    """The topics of one robot: what they are called, and their messages.

    Args:
        robot: Joint names, rate and units.
    """

    def __init__(self, robot: Capabilities) -> None:
        n, unit = len(robot.joint_names), "A" if robot.effort_kind == "current" else "N·m"
        self._state = state_topic(n, robot.rate_hz, clock=robot.clock, effort_unit=unit)
        self._tracking = _tracking_topic(n, robot)
        self._joints = JointStateView(robot.joint_names, robot.rate_hz)

    @property
    def row_topics(self) -> tuple[str, ...]:
        """The topics that have a message for every row that is shown."""
        return JOINT_STATE_TOPIC, self._state.name, self._tracking.name

    @property
    def schemas(self) -> dict[str, RosSchema]:
        """Topic → schema, of everything that is CDR."""
        own = (self._state, self._tracking)
        return {
            JOINT_STATE_TOPIC: RosSchema(JOINT_STATE_SCHEMA, JOINT_STATE_TEXT),
            **{topic.name: RosSchema(topic.schema_name, topic.schema_text) for topic in own},
            EVENT_TOPIC: RosSchema(EVENT_SCHEMA, EVENT_TEXT),
        }

    def encode(self, topic: str, rows: StructArray) -> Iterator[bytes]:
        """One message per state row.

        Raises:
            ValueError: The rows have another number of joints than the robot.
        """
        if topic == JOINT_STATE_TOPIC:
            return (message.tobytes() for message in self._joints.encode(rows))
        if topic == self._tracking.name:
            rows = self._tracking_rows(rows)
        return (CDR_HEADER + row.tobytes() for row in rows)

    def _tracking_rows(self, rows: StructArray) -> StructArray:
        out = np.empty(len(rows), self._tracking.dtype)
        out["device_time"], out["host_time"] = rows["device_time"], rows["host_time"]
        out["tracking_error"] = rows["q_target"] - rows["q"]
        return out


def _tracking_topic(n_joints: int, robot: Capabilities) -> Topic:
    times = [("device_time", "<f8"), ("host_time", "<f8")]
    return Topic(
        name=TRACKING_TOPIC,
        dtype=np.dtype([*times, ("tracking_error", "<f8", (n_joints,))]),
        rate_hz=robot.rate_hz,
        clock=robot.clock,
        units={"device_time": "s", "host_time": "s (Unix time)", "tracking_error": "rad"},
        schema_name=f"hil/msg/TrackingError{n_joints}",
    )
