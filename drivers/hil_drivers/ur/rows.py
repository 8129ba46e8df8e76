"""RTDE rows as the base robot record, and everything else they hold as a topic of its own.

docs/reference/ur-driver-fields.md lists which RTDE output becomes which field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray, SpecError, StructArray
from hil.robot import Status, Topic, state_dtype
from hil_drivers.ur.fields import FIELDS
from hil_drivers.ur.rtde_wire import TYPES

TorqueSource = Literal["current", "current-as-torque", "target-moment"]

EFFORTS: Mapping[str, tuple[str, str]] = {
    "current": ("actual_current", "target_current"),
    "current-as-torque": ("actual_current_as_torque", "target_moment"),
    "target-moment": ("target_moment", "target_moment"),
}
"""Torque source → RTDE outputs that become `effort` and `effort_target`."""

TOPIC = "/robot/ur"
N_JOINTS = 6

_RENAMED = {
    "q": "actual_q",
    "qd": "actual_qd",
    "temperature": "joint_temperatures",
    "q_target": "target_q",
    "qd_target": "target_qd",
    "qdd_target": "target_qdd",
}
"""Field of the base record ← RTDE output."""

RUNNING = 7
"""`robot_mode` in which the servo holds the arm: in all others, currents mean nothing."""

HARMLESS = (1, 2)
"""`safety_mode` normal and reduced."""

STOPPING, STOPPED, PLAYING, PAUSING, PAUSED = range(5)
"""`runtime_state`: the first two without a program; 5 is resuming."""

_STILL_RAD_S = 1e-6
_ELSEWHERE = {"timestamp", *_RENAMED.values()}
_FURTHER = tuple(field for field in FIELDS if field.name not in _ELSEWHERE)


def further_topic(rate_hz: float) -> Topic:
    """What RTDE tells beyond the base record; the same for all controllers.

    Args:
        rate_hz: States per second [Hz].
    """
    fields: list[Any] = [("device_time", "<f8"), ("host_time", "<f8")]
    for field in _FURTHER:
        code, count = TYPES[field.type]
        fields.append((ros_name(field.name), code, (count,))[: 2 + (count > 1)])
    units = {"device_time": "s", "host_time": "s (Unix time)"}
    units |= {ros_name(field.name): field.unit for field in _FURTHER if field.unit}
    return Topic(
        name=TOPIC,
        dtype=np.dtype(fields),
        rate_hz=rate_hz,
        clock="controller",
        units=units,
        schema_name="hil/msg/UrState",
    )


def ros_name(name: str) -> str:
    """The name of an RTDE output as a ROS 2 field: `actual_TCP_pose` → `actual_tcp_pose`."""
    return name.lower()


def require_source(source: TorqueSource, missing: Mapping[str, str]) -> None:
    """Refuse a torque source that the controller does not send.

    Args:
        source: What `effort` is to be.
        missing: `Receiver.missing`.

    Raises:
        SpecError: It is missing.
    """
    output = EFFORTS[source][0]
    if output in missing:
        raise SpecError(
            f"torque_source {source} is {output}, which the controller does not send: "
            f"{missing[output]}",
            hint="use torque_source: current",
        )


def state_rows(raw: StructArray, source: TorqueSource = "current") -> StructArray:
    """Rows of `Receiver.take` as the base robot record; `segment` is −1.

    Args:
        raw: (N,) rows; outputs that are missing become NaN.
        source: Which RTDE output is the effort.
    """
    rows = np.zeros(len(raw), state_dtype(N_JOINTS))
    rows["device_time"], rows["host_time"] = raw["timestamp"], raw["host_time"]
    effort, effort_target = EFFORTS[source]
    for name, output in (*_RENAMED.items(), ("effort", effort), ("effort_target", effort_target)):
        rows[name] = raw[output] if output in _names(raw) else np.nan
    rows["segment"] = -1
    safety = integers(raw, "safety_mode", HARMLESS[0])
    mode = integers(raw, "robot_mode", RUNNING)
    faulty = ~np.isin(safety, HARMLESS)
    rows["fault_code"] = np.where(faulty, safety, 0)
    rows["mode"] = mode
    rows["status"] = _status(_still(raw), faulty, mode == RUNNING)
    return rows


def further_rows(raw: StructArray, topic: Topic) -> StructArray:
    """Rows of `Receiver.take` as rows of `further_topic`.

    What the controller does not send is NaN; of integers, all bits are set (−1).
    """
    rows = topic.blank(len(raw))
    rows["device_time"], rows["host_time"] = raw["timestamp"], raw["host_time"]
    present = _names(raw)
    for field in _FURTHER:
        name = ros_name(field.name)
        if field.name in present:
            rows[name] = raw[field.name]
        elif rows.dtype[name].base.kind != "f":
            rows[name] = np.iinfo(rows.dtype[name].base).max if _is_unsigned(rows, name) else -1
    return rows


def program_running(raw: StructArray) -> BoolArray:
    """(N,) whether a program plays or is paused; false where the controller does not say."""
    return np.asarray(~np.isin(program_state(raw), (STOPPING, STOPPED)))


def program_state(raw: StructArray) -> IntArray:
    """(N,) `runtime_state`; stopped where the controller does not say."""
    return integers(raw, "runtime_state", STOPPED)


def _names(raw: StructArray) -> Sequence[str]:
    return raw.dtype.names or ()


def integers(raw: StructArray, name: str, default: int) -> IntArray:
    """(N,) an output that is a whole number, `default` where the controller does not send it."""
    if name not in _names(raw):
        return np.full(len(raw), default, np.int64)
    return np.asarray(raw[name].astype(np.int64))


def _still(raw: StructArray) -> BoolArray:
    """(N,) whether the commanded velocity is zero; the measured one where none is told."""
    name = "target_qd" if "target_qd" in _names(raw) else "actual_qd"
    speed: FloatArray = raw[name]
    return np.asarray((np.abs(speed) < _STILL_RAD_S).all(axis=1))


def _status(still: BoolArray, faulty: BoolArray, running: BoolArray) -> IntArray:
    status = np.where(still, int(Status.HOLDING), int(Status.MOVING))
    status |= np.where(faulty, int(Status.FAULT), 0)
    # Without servo (brakes, freedrive, power off) and in a stop, the currents are no measurement.
    return np.asarray(status | np.where(faulty | ~running, int(Status.MASKED), 0))


def _is_unsigned(rows: StructArray, name: str) -> bool:
    return rows.dtype[name].base.kind == "u"
