"""The state of a UR arm in its RTDE rows: as records, and as reasons why it cannot be moved.

Raw rows (`rtde.Receiver.take`) become rows of the base robot record (`state_rows`); everything else
that they hold becomes a topic of its own (`further_topic`). docs/reference/ur-driver-fields.md
lists which RTDE output becomes which field.

`complaints`, `occupied` and `speed_complaint` name what keeps an arm from moving, in the maker's
words and with what to do; `first_fault` finds the first row that shows an arm which does not obey.
Source: Universal Robots, user manuals (safety modes, robot modes) and RTDE guide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray, RobotFault, SpecError, StructArray
from hil.robot import Status, Topic, state_dtype
from hil_drivers.ur.rtde import FIELDS, TYPES

TorqueSource = Literal["current", "current-as-torque", "target-moment"]

EFFORTS: Mapping[str, tuple[str, str]] = {
    "current": ("actual_current", "target_current"),
    "current-as-torque": ("actual_current_as_torque", "target_moment"),
    "target-moment": ("target_moment", "target_moment"),
}
"""Torque source → RTDE outputs that become `effort` and `effort_target`."""

TOPIC = "/robot/ur"
N_JOINTS = 6

RUNNING = 7
"""`robot_mode` in which the servo holds the arm: in all others, currents mean nothing."""

HARMLESS = (1, 2)
"""`safety_mode` normal and reduced."""

STOPPING, STOPPED, PLAYING, PAUSING, PAUSED = range(5)
"""`runtime_state`: the first two without a program; 5 is resuming."""

STILL_RAD_S = 1e-3
"""A commanded speed below this is none [rad/s]; the controller's own ramps end at 0."""

AT_REST_RAD_S = 1e-6
"""The same where rows are recorded: a set-point of a slow trajectory counts as motion [rad/s]."""

_RENAMED = {
    "q": "actual_q",
    "qd": "actual_qd",
    "temperature": "joint_temperatures",
    "q_target": "target_q",
    "qd_target": "target_qd",
    "qdd_target": "target_qdd",
}
"""Field of the base record ← RTDE output."""

_ELSEWHERE = {"timestamp", *_RENAMED.values()}
_FURTHER = tuple(field for field in FIELDS if field.name not in _ELSEWHERE)


def further_topic(rate_hz: float) -> Topic:
    """Return the topic of RTDE outputs beyond the base record; the same for all controllers.

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
    # By the commanded velocity; by the measured one where the controller does not send it.
    speed: FloatArray = raw["target_qd" if "target_qd" in _names(raw) else "actual_qd"]
    at_rest = (np.abs(speed) < AT_REST_RAD_S).all(axis=1)
    status = np.where(at_rest, int(Status.HOLDING), int(Status.MOVING))
    status |= np.where(faulty, int(Status.FAULT), 0)
    # Without servo (brakes, freedrive, power off) and in a stop, the currents are no measurement.
    rows["status"] = status | np.where(faulty | (mode != RUNNING), int(Status.MASKED), 0)
    return rows


def _names(raw: StructArray) -> Sequence[str]:
    return raw.dtype.names or ()


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
        elif (base := rows.dtype[name].base).kind != "f":
            rows[name] = np.iinfo(base).max if base.kind == "u" else -1
    return rows


def program_running(raw: StructArray) -> BoolArray:
    """Return (N,) whether a program plays or is paused; false where the controller lacks that."""
    return np.asarray(~np.isin(program_state(raw), (STOPPING, STOPPED)))


def program_state(raw: StructArray) -> IntArray:
    """Return (N,) `runtime_state`; stopped where the controller lacks that."""
    return integers(raw, "runtime_state", STOPPED)


def integers(raw: StructArray, name: str, default: int) -> IntArray:
    """(N,) an output that is a whole number, `default` where the controller does not send it."""
    if name not in _names(raw):
        return np.full(len(raw), default, np.int64)
    return np.asarray(raw[name].astype(np.int64))


def still(row: np.void) -> bool:
    """Whether the controller commands no speed."""
    return bool(np.abs(row["target_qd"]).max() < STILL_RAD_S)


SAFETY: dict[int, tuple[str, str]] = {
    3: (
        "a protective stop",
        "find out what the arm has touched or what overloaded it; 5 s after the stop, unlock it at "
        "the teach pendant, then connect again",
    ),
    4: (
        "recovery mode: a joint is outside its limits",
        "move it back inside by freedrive at the teach pendant",
    ),
    5: ("a safeguard stop", "close the safeguard (gate, scanner), reset it, then connect again"),
    6: (
        "an emergency stop of the system",
        "remove the cause, release the button, switch the arm on and release its brakes, at the "
        "teach pendant",
    ),
    7: (
        "an emergency stop",
        "remove the cause, release the button, switch the arm on and release its brakes, at the "
        "teach pendant",
    ),
    8: ("a violation of a safety limit", "restart the safety system at the teach pendant"),
    9: ("a fault of the safety system", "restart the controller; see its log"),
    10: ("the safety system asks for the joints' identities", "confirm them at the teach pendant"),
    11: ("an undefined safety mode", "see the teach pendant"),
    12: (
        "a safeguard stop in automatic mode",
        "close the safeguard, reset it, then connect again",
    ),
    13: ("the three-position switch", "hold it in its middle position, or leave manual mode"),
}
"""`safety_mode` → what it is, what to do. 1 is normal, 2 reduced."""

MODES: dict[int, tuple[str, str]] = {
    -1: ("no controller", "restart the controller"),
    0: ("disconnected", "switch the arm on at the teach pendant"),
    1: ("waiting for the safety settings to be confirmed", "confirm them at the teach pendant"),
    2: ("booting", "wait until it has started"),
    3: ("switched off", "switch the arm on and release its brakes, at the teach pendant"),
    4: ("switched on without servo", "release the brakes at the teach pendant"),
    5: ("idle, its brakes are on", "release the brakes at the teach pendant"),
    6: ("moved by hand", "end freedrive at the teach pendant"),
    8: ("updating its firmware", "wait until it has started"),
}
"""`robot_mode` → what it is, what to do. 7 is running."""

MODE_NAMES = {
    -1: "NO_CONTROLLER", 0: "DISCONNECTED", 1: "CONFIRM_SAFETY", 2: "BOOTING", 3: "POWER_OFF",
    4: "POWER_ON", 5: "IDLE", 6: "BACKDRIVE", 7: "RUNNING", 8: "UPDATING_FIRMWARE",
}  # fmt: skip
SAFETY_NAMES = {1: "NORMAL", 2: "REDUCED", 3: "PROTECTIVE_STOP", 4: "RECOVERY"}

EMERGENCY = (6, 7)
"""Safety modes that switch the arm off: the remedy of the one is that of the other."""

RUNTIME = {0: "stopping", 1: "stopped", 2: "playing", 3: "pausing", 4: "paused", 5: "resuming"}
FULL_SPEED = 0.99
SLIDER = "target_speed_fraction"


def complaints(row: np.void) -> list[tuple[str, str]]:
    """Return what keeps an arm from moving, by one raw RTDE row; each with its remedy."""
    problems = []
    safety, mode = _number(row, "safety_mode", 1), _number(row, "robot_mode", RUNNING)
    if safety not in HARMLESS:
        problems.append(SAFETY.get(safety, (f"safety mode {safety}", "see the teach pendant")))
    if mode != RUNNING:
        what, remedy = MODES.get(mode, (f"in robot mode {mode}", "see the teach pendant"))
        problems.append((f"the arm is {what}", "" if safety in EMERGENCY else remedy))
    return problems


def _number(row: np.void, name: str, default: int) -> int:
    return int(row[name]) if _has(row, name) else default


def _has(row: np.void, name: str) -> bool:
    return name in (row.dtype.names or ())


def slider_of(raw: StructArray | np.void) -> float:
    """Return the lowest position of the speed slider, 0 to 1, in raw rows; NaN if not sent."""
    return float(raw[SLIDER].min()) if SLIDER in (raw.dtype.names or ()) else math.nan


def speed_complaint(row: np.void) -> list[tuple[str, str]]:
    """A speed slider that is not at its end makes every motion another one than planned."""
    share = slider_of(row)
    if not share < FULL_SPEED:
        return []
    return [(f"the speed slider is at {share:.0%}", "set it to 100 % at the teach pendant")]


def occupied(row: np.void) -> list[tuple[str, str]]:
    """Return what another client does with an arm, by one raw row; each with its remedy."""
    problems = []
    state = _number(row, "runtime_state", STOPPED)
    if state == STOPPING:
        problems.append(("a program is about to end", "wait until it has"))
    elif state != STOPPED:
        what = "a program is paused" if state in (PAUSING, PAUSED) else "a program is running"
        problems.append((what, "stop it at the teach pendant, or whoever else drives the arm"))
    speed = float(np.abs(row["target_qd"]).max()) if _has(row, "target_qd") else 0.0
    if speed > STILL_RAD_S:
        problems.append((f"the arm is moving at {speed:.3f} rad/s", "wait until it stands still"))
    return problems


def first_fault(raw: StructArray, *, program: bool) -> RobotFault | None:
    """The first fault in a block, were it over at its end or not.

    Args:
        raw: (N,) raw RTDE rows.
        program: Whether our robot program ought to play.
    """
    safety, mode = integers(raw, "safety_mode", 1), integers(raw, "robot_mode", RUNNING)
    state = integers(raw, "runtime_state", PLAYING)
    unsafe = ~np.isin(safety, HARMLESS) | (mode != RUNNING)
    # What stops the program is a better reason than that it has stopped, if both are seen at once.
    for wrong in (unsafe, (state != PLAYING) & program):
        if wrong.any():
            at = int(wrong.argmax())
            return fault_of(raw[at], program=program)
    return None


def fault_of(row: np.void, *, program: bool) -> RobotFault | None:
    """Return the fault of an arm under command, by one raw RTDE row; None if there is none.

    Args:
        row: Of `Receiver.take`.
        program: Whether our robot program ought to play.
    """
    at = f"at device time {float(row['timestamp']):.3f} s"
    if problems := complaints(row):
        return RobotFault(
            f"{'; '.join(what for what, _ in problems)} {at}", hint=remedies(problems)
        )
    state = _number(row, "runtime_state", PLAYING)
    if program and state != PLAYING:
        return RobotFault(
            f"the robot program is {RUNTIME.get(state, f'in state {state}')} {at}",
            hint="was it stopped at the teach pendant, or replaced by another? connect again",
        )
    return None


def remedies(said: list[tuple[str, str]]) -> str:
    """Return the remedies of all findings, each once."""
    return "; ".join(dict.fromkeys(do for _, do in said if do))
