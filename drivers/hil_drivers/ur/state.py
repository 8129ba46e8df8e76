"""Conversion of the RTDE rows of a UR arm into records and into reasons why the arm cannot move.

`state_rows` converts raw rows (`rtde.Receiver.take`) into rows of the base robot record.
`further_rows` converts the remaining outputs into rows of a separate topic (`further_topic`).
docs/reference/ur-driver-fields.md lists which RTDE output becomes which field.

`complaints`, `occupied` and `speed_complaint` return the conditions that prevent a motion, in the
manufacturer's terms and with a remedy. `first_fault` detects the first row in which the arm does
not obey. Source: Universal Robots, user manuals (safety modes, robot modes) and RTDE guide.
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
"""Map from torque source to the two RTDE outputs that become `effort` and `effort_target`."""

TOPIC = "/robot/ur"
N_JOINTS = 6

RUNNING = 7
"""Value of `robot_mode` in which the servo controls the arm; in all other modes, motor currents
are meaningless.
"""

HARMLESS = (1, 2)
"""Values of `safety_mode` that permit motion: normal (1) and reduced (2)."""

STOPPING, STOPPED, PLAYING, PAUSING, PAUSED = range(5)
"""Values of `runtime_state`; no program plays in states 0 (stopping) and 1 (stopped), and the
value 5 is resuming."""

STILL_RAD_S = 1e-3
"""Commanded joint speed below which the arm counts as at rest [rad/s]; the controller's ramps
end at 0.
"""

AT_REST_RAD_S = 1e-6
"""Joint speed below which a recorded row counts as at rest [rad/s]; a slow trajectory counts as
motion.
"""

_RENAMED = {
    "q": "actual_q",
    "qd": "actual_qd",
    "temperature": "joint_temperatures",
    "q_target": "target_q",
    "qd_target": "target_qd",
    "qdd_target": "target_qdd",
}
"""Map from a field of the base record to the RTDE output with its value."""

_ELSEWHERE = {"timestamp", *_RENAMED.values()}
_FURTHER = tuple(field for field in FIELDS if field.name not in _ELSEWHERE)


def further_topic(rate_hz: float) -> Topic:
    """Return the topic of the RTDE outputs beyond the base record.

    The topic is equal for all controllers.

    Args:
        rate_hz: Number of states per second.
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
    """Return the name of an RTDE output as a ROS 2 field: `actual_TCP_pose` → `actual_tcp_pose`."""
    return name.lower()


def require_source(source: TorqueSource, missing: Mapping[str, str]) -> None:
    """Raise if the controller does not send the RTDE output of a torque source.

    Args:
        source: Source of the field `effort`.
        missing: Outputs that the controller does not send, with the reason: `Receiver.missing`.

    Raises:
        SpecError: `missing` contains the RTDE output of the torque source.
    """
    output = EFFORTS[source][0]
    if output in missing:
        raise SpecError(
            f"torque_source {source} is {output}, which the controller does not send: "
            f"{missing[output]}",
            hint="use torque_source: current",
        )


def state_rows(raw: StructArray, source: TorqueSource = "current") -> StructArray:
    """Convert raw rows of `Receiver.take` into the base robot record; the field `segment` is −1.

    Args:
        raw: (N,) raw rows; missing outputs become NaN.
        source: Torque source, which selects the RTDE output for `effort`.
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
    # Use the commanded velocity; use the measured one if the controller does not send it.
    speed: FloatArray = raw["target_qd" if "target_qd" in _names(raw) else "actual_qd"]
    at_rest = (np.abs(speed) < AT_REST_RAD_S).all(axis=1)
    status = np.where(at_rest, int(Status.HOLDING), int(Status.MOVING))
    status |= np.where(faulty, int(Status.FAULT), 0)
    # Without servo (brakes, freedrive, power off) and in a stop, the currents are invalid.
    rows["status"] = status | np.where(faulty | (mode != RUNNING), int(Status.MASKED), 0)
    return rows


def _names(raw: StructArray) -> Sequence[str]:
    return raw.dtype.names or ()


def further_rows(raw: StructArray, topic: Topic) -> StructArray:
    """Convert raw rows of `Receiver.take` into rows of `further_topic`.

    An output that the controller does not send becomes NaN, or an integer with all bits set (−1).
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
    """Return for each raw row whether a program plays or is paused, (N,).

    The returned values are false if the controller does not send `runtime_state`.
    """
    return np.asarray(~np.isin(program_state(raw), (STOPPING, STOPPED)))


def program_state(raw: StructArray) -> IntArray:
    """Return `runtime_state` of each row, (N,); `STOPPED` if the controller does not send it."""
    return integers(raw, "runtime_state", STOPPED)


def integers(raw: StructArray, name: str, default: int) -> IntArray:
    """Return an integer output of each row, (N,); `default` if the controller does not send it."""
    if name not in _names(raw):
        return np.full(len(raw), default, np.int64)
    return np.asarray(raw[name].astype(np.int64))


def still(row: np.void) -> bool:
    """Return whether every commanded joint speed of a raw row is below `STILL_RAD_S`."""
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
"""Map from value of `safety_mode` to description and remedy, without the values 1 (normal) and 2
(reduced)."""

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
"""Map from value of `robot_mode` to description and remedy, without the value 7 (running)."""

MODE_NAMES = {
    -1: "NO_CONTROLLER", 0: "DISCONNECTED", 1: "CONFIRM_SAFETY", 2: "BOOTING", 3: "POWER_OFF",
    4: "POWER_ON", 5: "IDLE", 6: "BACKDRIVE", 7: "RUNNING", 8: "UPDATING_FIRMWARE",
}  # fmt: skip
SAFETY_NAMES = {1: "NORMAL", 2: "REDUCED", 3: "PROTECTIVE_STOP", 4: "RECOVERY"}

EMERGENCY = (6, 7)
"""Safety modes that switch the arm off; the remedy is the same for the two modes."""

RUNTIME = {0: "stopping", 1: "stopped", 2: "playing", 3: "pausing", 4: "paused", 5: "resuming"}
FULL_SPEED = 0.99
SLIDER = "target_speed_fraction"


def complaints(row: np.void) -> list[tuple[str, str]]:
    """Return the modes in a raw RTDE row that prevent a motion, each with its remedy."""
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
    """Return the problem of a speed slider below 100 %, which would change every planned motion."""
    share = slider_of(row)
    if not share < FULL_SPEED:
        return []
    return [(f"the speed slider is at {share:.0%}", "set it to 100 % at the teach pendant")]


def occupied(row: np.void) -> list[tuple[str, str]]:
    """Return the actions of other clients in a raw row that block the arm, with remedies."""
    problems = []
    state = _number(row, "runtime_state", STOPPED)
    if state == STOPPING:
        problems.append(("a program is about to end", "wait until it has ended"))
    elif state != STOPPED:
        what = "a program is paused" if state in (PAUSING, PAUSED) else "a program is running"
        problems.append((what, "stop it at the teach pendant, or end the other client"))
    speed = float(np.abs(row["target_qd"]).max()) if _has(row, "target_qd") else 0.0
    if speed > STILL_RAD_S:
        problems.append(
            (f"the arm is moving at {speed:.3f} rad/s", "wait until it is at standstill")
        )
    return problems


def first_fault(raw: StructArray, *, program: bool) -> RobotFault | None:
    """Return the first fault in a block of raw rows, even if the fault is over at the end.

    Args:
        raw: (N,) raw RTDE rows.
        program: Whether the driver's robot program is expected to play.
    """
    safety, mode = integers(raw, "safety_mode", 1), integers(raw, "robot_mode", RUNNING)
    state = integers(raw, "runtime_state", PLAYING)
    unsafe = ~np.isin(safety, HARMLESS) | (mode != RUNNING)
    # If both are detected in one row, report the cause of the stop rather than the program's end.
    for wrong in (unsafe, (state != PLAYING) & program):
        if wrong.any():
            at = int(wrong.argmax())
            return fault_of(raw[at], program=program)
    return None


def fault_of(row: np.void, *, program: bool) -> RobotFault | None:
    """Return the fault of an arm under command in one raw RTDE row; None without a fault.

    Args:
        row: Raw row of `Receiver.take`.
        program: Whether the driver's robot program is expected to play.
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
            hint="see the teach pendant for a stop or another program, then connect again",
        )
    return None


def remedies(said: list[tuple[str, str]]) -> str:
    """Return the remedies of all findings in one text, without repetitions."""
    return "; ".join(dict.fromkeys(do for _, do in said if do))
