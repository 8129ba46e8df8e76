"""Motions as a program asks for them: for this arm, this tool, and within what the arm can do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import CommandRefused, FloatArray
from hil_mock_robot.ur.kinematics import pose_of, solve
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.poses import Numbers
from hil_mock_robot.ur.servoing import SpeedJ, SpeedL
from hil_mock_robot.ur.stopping import StopJoints, StopL
from hil_mock_robot.ur.threaded import Steps, Threaded

LEAST_STOP = 1e-3
"""What comes to rest sooner or later, whatever deceleration was asked for."""
FARTHEST = 1e3
"""Metres and radians beyond which no pose is looked at."""
STEADY_RAD_S = 1e-3
NO_SOLUTION = "get_inverse_kin: unable to find an inverse kinematics solution"


def joints_of(
    machine: Machine,
    pose: FloatArray,
    near: FloatArray | None = None,
    errors: tuple[float, float] = (1e-9, 1e-9),
) -> FloatArray:
    """(6,) joint angles that bring the TCP to a pose, the nearest to `near` or to where it is.

    Args:
        machine: Whose arm and TCP.
        pose: (6,).
        near: (6,) [rad].
        errors: Largest position [m] and orientation error [rad].

    Raises:
        CommandRefused: The arm does not reach it.
    """
    start = machine.setpoint[0] if near is None else near
    if max(np.abs(pose).max(), np.abs(start).max()) > FARTHEST:
        raise CommandRefused(NO_SOLUTION)
    position_m, orientation_rad = errors
    q = solve(
        machine.body.arm, pose, start, machine.tcp,
        position_m=position_m, orientation_rad=orientation_rad,
    )  # fmt: skip
    if q is None:
        raise CommandRefused(NO_SOLUTION)
    return q


def within_limits(machine: Machine, q: Sequence[float] | FloatArray) -> bool:
    """Whether the joints may turn so far."""
    arm = machine.body.arm
    return bool(((arm.q_min <= q) & (q <= arm.q_max)).all())


def pose_at(machine: Machine, q: Numbers) -> FloatArray:
    """(6,) where the TCP is with joint angles (6,)."""
    return pose_of(machine.body.arm, q, machine.tcp)


def speed_motion(machine: Machine, *, linear: bool) -> SpeedJ | SpeedL:
    """What keeps the joints, or the TCP, at a speed."""
    if linear:
        return SpeedL(machine.body.arm, machine.tcp, machine.tick_s)
    return SpeedJ(machine.tick_s, machine.body.arm)


def stop_joints(program: Threaded, deceleration: float) -> Steps:
    """URScript `stopj`, until the arm is at rest."""
    rate = max(abs(deceleration), LEAST_STOP)
    return program.drive(lambda: StopJoints(rate, program.machine.tick_s))


def stop_line(program: Threaded, deceleration: float) -> Steps:
    """URScript `stopl`, until the arm is at rest."""
    machine, rate = program.machine, max(abs(deceleration), LEAST_STOP)
    return program.drive(lambda: StopL(machine.body.arm, machine.tcp, rate, machine.tick_s))


def joint_torques(machine: Machine) -> FloatArray:
    """(6,) what the motors deliver beyond what the controller's model needs [N·m]."""
    beyond = machine.reading.current - machine.reading.current_target
    return np.nan_to_num(machine.body.arm.drive_gains * beyond)


def is_steady(machine: Machine) -> bool:
    """Whether nothing moves, nor is about to."""
    commanded = bool(machine.setpoint[1].any())
    return not commanded and bool(np.abs(machine.reading.true_qd).max() < STEADY_RAD_S)
