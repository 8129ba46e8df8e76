"""State rows and recordings that the recording tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.core.typing import StructArray
from hil.recording import McapWriter
from hil.robot.state import STATE_TOPIC, Topic, state_topic

EPOCH = 1.8e9
JOINTS = [f"joint_{i}" for i in range(1, 7)]


def six_axis_topic(rate_hz: float = 125.0) -> Topic:
    return state_topic(6, rate_hz, clock="controller", effort_unit="A")


def raw_topic() -> Topic:
    """A driver's own topic, smaller integers last."""
    dtype = np.dtype(
        [
            ("device_time", "<f8"),
            ("host_time", "<f8"),
            ("position", "<i4", (6,)),
            ("torque", "<i2", (6,)),
            ("error", "|u1"),
        ]
    )
    return Topic("/can/raw", dtype, 250.0, "bus", schema_name="hil_drivers/msg/CanRaw")


def rows_of(topic: Topic, count: int, *, first: int = 0, seed: int = 0) -> StructArray:
    """Rows full of arbitrary but legal values, evenly spaced on the device clock."""
    rng = np.random.default_rng(seed + first)
    rows = topic.blank(count)
    for name in topic.dtype.names or ():
        field = rows[name]
        if field.dtype.kind == "f":
            rows[name] = rng.normal(size=field.shape)
        else:
            limits = np.iinfo(field.dtype)
            rows[name] = rng.integers(limits.min, limits.max, field.shape, endpoint=True)
    rows["device_time"] = (first + np.arange(count)) / topic.rate_hz
    rows["host_time"] = EPOCH + rows["device_time"]
    return rows


def record_state(path: Path, count: int = 200, *, rows_per_chunk: int = 20, **more: Any) -> Any:
    """Write `count` state rows, a chunk per `rows_per_chunk`, and return them."""
    topic = six_axis_topic()
    rows = rows_of(topic, count)
    with McapWriter(path, [topic], **more) as writer:
        for begin in range(0, count, rows_per_chunk):
            writer.write(STATE_TOPIC, rows[begin : begin + rows_per_chunk])
            writer.flush(durable=False)
    return rows
