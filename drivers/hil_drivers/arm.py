"""Capabilities and limits of an arm, and the checks of commands against them.

The limits of an arm come from two sources: the description of the arm, which contains the
manufacturer's values and is known before the controller is connected, and the limits that the
controller reports after connecting (`ReportedLimits`). If both sources contain a limit, the
stricter limit applies. `require_executable` and `require_liftable` check a command against the
combined limits before the arm moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from hil.arms import Payload, load_arm
from hil.core import (
    BoolArray,
    CommandRefused,
    FloatArray,
    RobotConnectionError,
    RobotFault,
)
from hil.robot import Capabilities, EffortKind, Finding, Limits, Segment

AT_SET_POINT_RAD = 0.02
SLACK_RAD = 1e-6
REST_RAD_S = 0.01
SPEED_SLACK = 1.001


def capabilities_of(
    model: str,
    rate_hz: float | None = None,
    effort: EffortKind = "torque",
    drive_gains: Sequence[float] | None = None,
    drive_gains_source: str | None = None,
) -> Capabilities:
    """Return the capabilities of an arm: joint names, rate and quantity of `effort`, in wall time.

    Args:
        model: Name of an arm model that comes with hil.
        rate_hz: Rate of samples and set-points [Hz]; None for the value of the arm's description.
        effort: Quantity that the controller reports: torque at the joint [N·m] or motor current
            [A].
        drive_gains: Drive gains at the joints [N·m/A]; None for the values of the arm's
            description. If the controller reports torques, the capabilities contain no drive gains.
        drive_gains_source: Text that names the source of the drive gains; None for the source in
            the arm's description.
    """
    arm, current = load_arm(model), effort == "current"
    gains = arm.drive_gains.tolist() if drive_gains is None else drive_gains
    if drive_gains_source is None:
        drive_gains_source = arm.sources.get("drive_gains", "the station")
    return Capabilities(
        joint_names=arm.joint_names,
        rate_hz=rate_hz or arm.rate_hz,
        effort_kind=effort,
        drive_gains=tuple(gains) if current else (),
        drive_gains_source=drive_gains_source if current else "",
        clock="wall",
    )


@dataclass(frozen=True, slots=True, eq=False)
class ReportedLimits:
    """Limits of an arm as reported by its controller.

    A limit that the controller does not report is None, or NaN for single joints.


    Attributes:
        q_min: (n,) lower joint position limits [rad].
        q_max: (n,) upper joint position limits [rad].
        qd_max: (n,) maximum joint speeds [rad/s].
        qdd_max: (n,) maximum joint accelerations [rad/s²].
        effort_max: (n,) maximum joint torques [N·m].
        payload_max_kg: Maximum payload mass [kg].
    """

    q_min: FloatArray | None = None
    q_max: FloatArray | None = None
    qd_max: FloatArray | None = None
    qdd_max: FloatArray | None = None
    effort_max: FloatArray | None = None
    payload_max_kg: float | None = None

    def narrow(self, limits: Limits) -> Limits:
        """Return for each joint the stricter of the reported limit and the passed limit."""
        stricter = {}
        for name, reported in self._reported():
            choose = np.fmax if name == "q_min" else np.fmin  # both ignore NaN
            stricter[name] = choose(getattr(limits, name), reported)
        return replace(limits, **stricter)

    def exceeded_by(self, limits: Limits) -> BoolArray:
        """Return for each joint whether a passed limit is wider than the reported limit."""
        narrowed = self.narrow(limits)
        wider = [getattr(limits, name) != getattr(narrowed, name) for name, _ in self._reported()]
        return np.asarray(np.any(np.broadcast_arrays(*wider), axis=0))

    def _reported(self) -> list[tuple[str, Any]]:
        given = [(each.name, getattr(self, each.name)) for each in fields(self)]
        return [(name, value) for name, value in given if value is not None]


def limits_of(
    model: str, reported: ReportedLimits | None = None, speed_share: float = 1.0
) -> Limits:
    """Return the limits against which commands are checked.

    Args:
        model: Name of an arm model that comes with hil.
        reported: Limits reported by the connected controller, which apply if they are stricter than
            the limits of the description; None for the description only.
        speed_share: Share of the maximum joint speeds that the station permits; 1.0 for the full
            speeds.
    """
    arm = load_arm(model)
    limits = Limits(
        q_min=np.array(arm.q_min),
        q_max=np.array(arm.q_max),
        qd_max=np.array(arm.qd_max),
        qdd_max=np.array(arm.qdd_max),
        effort_max=np.array(arm.effort_max),
        payload_max_kg=arm.payload_max_kg,
    )
    if reported is not None:
        limits = reported.narrow(limits)
    return replace(limits, qd_max=limits.qd_max * speed_share)


def payload_finding(
    declared: Payload | None, read_back: Payload, hint: str, remark: str = ""
) -> Finding:
    """Return whether the controller uses the declared payload.

    Args:
        declared: Declared payload; None if no payload was declared since the robot was connected.
        read_back: Payload that the controller reports.
        hint: Remedy in the finding if the declared and the reported payload differ.
        remark: Text that is appended to the message of the finding.
    """
    message = f"payload {read_back} read back"
    if declared is not None:
        message += f", {declared} declared"
    return Finding(
        "payload",
        declared is None or declared.agrees_with(read_back),
        message + remark,
        read_back.mass,
        None if declared is None else declared.mass,
        hint,
    )


def require_executable(
    segment: Segment,
    limits: Limits,
    standing: FloatArray,
    *,
    at_set_point_rad: float = AT_SET_POINT_RAD,
) -> None:
    """Raise if the arm cannot execute a segment without exceeding limits or jumping.

    Args:
        segment: Next segment.
        limits: Position, speed, acceleration and torque limits of the n joints.
        standing: (n,) joint positions that the arm holds before the segment [rad].
        at_set_point_rad: Largest permitted distance between the held set-point and the segment's
            start [rad].

    Raises:
        CommandRefused: The segment leaves the limits, does not begin at the held set-point, or has
            a speed other than 0 at its first or last sample.
    """
    where = f"segment {segment.index} ({segment.kind})"
    n, q = len(limits.q_min), segment.q
    shapes = {np.shape(array) for array in (q, segment.qd, segment.qdd)}
    if shapes != {(len(q), n)} or not len(q):
        raise refused(f"{where} has {q.shape[-1]} joints, the arm has {n}")
    numbers = (q, segment.qd, segment.qdd, (segment.speed, segment.acceleration))
    if not all(np.isfinite(array).all() for array in numbers):
        raise refused(f"{where} contains values that are not finite numbers")
    if (q < limits.q_min - SLACK_RAD).any() or (q > limits.q_max + SLACK_RAD).any():
        raise refused(f"{where} leaves the arm's joint range")
    _require_joints_within(where, "rad/s", segment.qd, limits.qd_max)
    _require_joints_within(where, "rad/s²", segment.qdd, limits.qdd_max)
    off = float(np.abs(q[0] - standing).max())
    if off > at_set_point_rad:
        raise refused(f"{where} begins {off:.4f} rad from the present position of the arm")
    if segment.kind != "hold" and np.abs(segment.qd[[0, -1]]).max() > REST_RAD_S:
        raise refused(f"{where} does not begin and end at standstill")


def _require_joints_within(where: str, unit: str, values: FloatArray, most: FloatArray) -> None:
    highest = np.abs(values).max(axis=0)
    if (highest > most * SPEED_SLACK).any():
        joint = int((highest - most).argmax())
        raise refused(
            f"{where} moves joint {joint + 1} with {highest[joint]:.3f} {unit}; the limit is "
            f"{most[joint]:.3f} {unit}"
        )


def require_liftable(payload: Payload, limits: Limits) -> None:
    """Raise if the mass of a payload exceeds the maximum payload of the arm.

    Raises:
        CommandRefused: The payload is heavier than the arm permits.
    """
    if payload.mass > limits.payload_max_kg:
        raise CommandRefused(
            f"a payload of {payload.mass:g} kg is too heavy: the arm carries at most "
            f"{limits.payload_max_kg:g} kg",
            hint="mount a lighter payload",
        )


def refused(why: str) -> CommandRefused:
    """Return the error that reports a segment that the arm cannot execute."""
    return CommandRefused(why, hint="plan again for this arm, from its present position")


def nothing_prepared() -> CommandRefused:
    """Return the error for a call of `start` before a segment is prepared."""
    return CommandRefused("no segment is prepared", hint="call prepare() first")


def not_connected(name: str) -> RobotConnectionError:
    """Return the error for a command to a robot that is not connected, or was closed."""
    return RobotConnectionError(f"{name} is not connected", hint="call connect() first")


def faulty(name: str) -> RobotFault:
    """Return the error for a command that follows a fault of the robot."""
    return RobotFault(
        f"{name} accepts no commands since a fault",
        hint="remove the cause of the fault, then call connect()",
    )
