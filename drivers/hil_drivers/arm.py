"""What a driver knows of its arm, and what it refuses to do with it.

Two sources are combined: the description of the arm, which holds its maker's numbers and is known
before anything is connected, and the limits that the controller reports once it is connected
(`ReportedLimits`). Of two limits the stricter one applies. `require_executable` and
`require_liftable` hold commands against the result before anything moves.
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
    """Return names, rate and the meaning of `effort`, in wall time.

    Args:
        model: Built-in arm.
        rate_hz: Samples and set-points per second [Hz]; the arm's own when None.
        effort: What the controller reports: torque at the joint [N·m] or motor current [A].
        drive_gains: Torque per current at the joint [N·m/A]; the arm's own when None. They are
            left out where the controller reports torques.
        drive_gains_source: Where they come from; the source of the arm's own when None.
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
    """The limits that a controller reports of itself; None, or NaN per joint, where it has none.

    Attributes:
        q_min, q_max: (n,) joint positions [rad].
        qd_max: (n,) joint speeds [rad/s].
        qdd_max: (n,) joint accelerations [rad/s²].
        effort_max: (n,) joint torques [N·m].
        payload_max_kg: Mass of the load [kg].
    """

    q_min: FloatArray | None = None
    q_max: FloatArray | None = None
    qd_max: FloatArray | None = None
    qdd_max: FloatArray | None = None
    effort_max: FloatArray | None = None
    payload_max_kg: float | None = None

    def narrow(self, limits: Limits) -> Limits:
        """Return the stricter of both, joint by joint."""
        stricter = {}
        for name, reported in self._reported():
            choose = np.fmax if name == "q_min" else np.fmin  # these pass over NaN
            stricter[name] = choose(getattr(limits, name), reported)
        return replace(limits, **stricter)

    def exceeded_by(self, limits: Limits) -> BoolArray:
        """Return for each joint whether one of its limits is wider than the reported one."""
        narrowed = self.narrow(limits)
        wider = [getattr(limits, name) != getattr(narrowed, name) for name, _ in self._reported()]
        return np.asarray(np.any(np.broadcast_arrays(*wider), axis=0))

    def _reported(self) -> list[tuple[str, Any]]:
        given = [(each.name, getattr(self, each.name)) for each in fields(self)]
        return [(name, value) for name, value in given if value is not None]


def limits_of(
    model: str, reported: ReportedLimits | None = None, speed_share: float = 1.0
) -> Limits:
    """Return the limits that commands are held against.

    Args:
        model: Built-in arm.
        reported: By the controller, once it is connected; the stricter of both applies.
        speed_share: Share of the resulting joint speeds that the station lets be used.
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
    """Return whether the controller computes with the load that was declared to it.

    Args:
        declared: None where no load was declared since the robot was connected.
        read_back: The load that the controller reports.
        hint: Remedy if they differ.
        remark: Added to the message.
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
    """Raise if the arm cannot execute a segment, or would do it with a jump.

    Args:
        segment: The next one.
        limits: Of the arm with n joints.
        standing: (n,) the set-point it holds [rad].
        at_set_point_rad: How far from there the segment may begin [rad].

    Raises:
        CommandRefused: It leaves the limits, begins elsewhere or moves at its ends.
    """
    where = f"segment {segment.index} ({segment.kind})"
    n, q = len(limits.q_min), segment.q
    shapes = {np.shape(array) for array in (q, segment.qd, segment.qdd)}
    if shapes != {(len(q), n)} or not len(q):
        raise refused(f"{where} is for {q.shape[-1]} joints, the arm has {n}")
    numbers = (q, segment.qd, segment.qdd, (segment.speed, segment.acceleration))
    if not all(np.isfinite(array).all() for array in numbers):
        raise refused(f"{where} holds numbers that are none")
    if (q < limits.q_min - SLACK_RAD).any() or (q > limits.q_max + SLACK_RAD).any():
        raise refused(f"{where} leaves the arm's joint range")
    _require_joints_within(where, "rad/s", segment.qd, limits.qd_max)
    _require_joints_within(where, "rad/s²", segment.qdd, limits.qdd_max)
    off = float(np.abs(q[0] - standing).max())
    if off > at_set_point_rad:
        raise refused(f"{where} begins {off:.4f} rad from where the arm stands")
    if segment.kind != "hold" and np.abs(segment.qd[[0, -1]]).max() > REST_RAD_S:
        raise refused(f"{where} does not begin and end at rest")


def _require_joints_within(where: str, unit: str, values: FloatArray, most: FloatArray) -> None:
    highest = np.abs(values).max(axis=0)
    if (highest > most * SPEED_SLACK).any():
        joint = int((highest - most).argmax())
        raise refused(
            f"{where} moves joint {joint + 1} at {highest[joint]:.3f} {unit}, {most[joint]:.3f} "
            "are allowed"
        )


def require_liftable(payload: Payload, limits: Limits) -> None:
    """Raise if a load is too heavy for the arm.

    Raises:
        CommandRefused: It is.
    """
    if payload.mass > limits.payload_max_kg:
        raise CommandRefused(
            f"a load of {payload.mass:g} kg is too heavy: the arm carries "
            f"{limits.payload_max_kg:g} kg",
            hint="mount a lighter one",
        )


def refused(why: str) -> CommandRefused:
    """Return the error for a segment that cannot be executed."""
    return CommandRefused(why, hint="plan again for this arm, from where it stands")


def nothing_prepared() -> CommandRefused:
    """Return the error for `start` without a prepared segment."""
    return CommandRefused("no segment is prepared", hint="call prepare() first")


def not_connected(name: str) -> RobotConnectionError:
    """Return the error for a robot that was not connected, or was closed."""
    return RobotConnectionError(f"{name} is not connected", hint="call connect() first")


def faulty(name: str) -> RobotFault:
    """Return the error for commands after a fault."""
    return RobotFault(
        f"{name} does not obey since a fault", hint="remove its cause, then connect()"
    )
