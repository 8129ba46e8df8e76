"""The control script's questions about kinematics and dynamics, answered by the nominal model.

Where the script for this software lacks the line, nothing is written: the client then reads what
the registers held before, as on a real controller.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from hil.core import CommandRefused, FloatArray
from hil_mock_robot.ur.kinematics import jacobian, pose_of, pose_trans
from hil_mock_robot.ur.moving import is_steady, joint_torques, joints_of, pose_at, within_limits
from hil_mock_robot.ur.threaded import Steps

if TYPE_CHECKING:
    from hil_mock_robot.ur.control_script import ControlScript

UPPER_COLUMNS = 36
"""Number of the register where columns 4 and 5 of a matrix begin; the others begin at 0."""
JACOBIAN_STEP_S = 1e-6


def _inverse_kin_near(script: ControlScript) -> None:
    script.registers.put_doubles(0, _solution_near(script))


def _solution_near(script: ControlScript) -> FloatArray:
    r = script.registers
    errors = (abs(r.double(12)), abs(r.double(13)))
    return joints_of(script.machine, r.doubles(0), r.doubles(6), errors)


def _inverse_kin(script: ControlScript) -> None:
    script.registers.put_doubles(0, _solution(script))


def _solution(script: ControlScript) -> FloatArray:
    return joints_of(script.machine, script.registers.doubles(0))


def _has_solution(script: ControlScript) -> None:
    if script.has((3, 15), (5, 10)):
        script.registers.put_integer(1, _reachable(lambda: _solution(script)))


def _has_solution_near(script: ControlScript) -> None:
    if script.has((3, 15), (5, 10)):
        script.registers.put_integer(1, _reachable(lambda: _solution_near(script)))


def _reachable(find: Callable[[], FloatArray]) -> bool:
    try:
        find()
    except CommandRefused:
        return False
    return True


def _is_pose_safe(script: ControlScript) -> None:
    script.registers.put_integer(1, _reachable(lambda: _solution(script)))


def _are_joints_safe(script: ControlScript) -> None:
    safe = within_limits(script.machine, script.registers.doubles(0))
    script.registers.put_integer(1, safe)


def _forward_kin(script: ControlScript) -> None:
    machine = script.machine
    script.registers.put_doubles(0, pose_at(machine, machine.reading.q))


def _forward_kin_of(script: ControlScript) -> None:
    q, tcp = script.registers.doubles(0), script.registers.doubles(6)
    script.registers.put_doubles(0, pose_of(script.machine.body.arm, q, tcp))


def _flange_pose(script: ControlScript) -> None:
    machine = script.machine
    pose = pose_of(machine.body.arm, machine.reading.q, np.zeros(6))
    script.registers.put_doubles(0, pose)


def _pose_trans(script: ControlScript) -> None:
    r = script.registers
    r.put_doubles(0, pose_trans(r.doubles(0), r.doubles(6)))


def _tcp_offset(script: ControlScript) -> None:
    if script.has((3, 6), (5, 0)):
        script.registers.put_doubles(0, script.machine.tcp)


def _target_waypoint(script: ControlScript) -> None:
    if script.has(None, (5, 3)):
        machine = script.machine
        standing = pose_at(machine, machine.setpoint[0])
        script.registers.put_doubles(0, standing if script.waypoint is None else script.waypoint)


def _step_time(script: ControlScript) -> None:
    if script.has(None, (5, 4)):
        script.registers.put_doubles(0, [script.machine.tick_s])


def _joint_torques(script: ControlScript) -> None:
    script.registers.put_doubles(0, joint_torques(script.machine))


def _is_steady(script: ControlScript) -> None:
    script.registers.put_integer(1, is_steady(script.machine))


def _mass_matrix(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        machine = script.machine
        _put_matrix(script, machine.body.mass_matrix(machine.reading.q))


def _coriolis(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        body, seen = script.machine.body, script.machine.reading
        still = np.zeros(6)
        moving = body.torque_for(seen.q, seen.qd, still)
        script.registers.put_doubles(0, moving - body.torque_for(seen.q, still, still))


def _target_accelerations(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        script.registers.put_doubles(0, script.machine.setpoint[2])


def _jacobian(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        machine = script.machine
        _put_matrix(script, jacobian(machine.body.arm, machine.reading.q, machine.tcp))


def _jacobian_rate(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        machine = script.machine
        arm, q, qd = machine.body.arm, machine.reading.q, machine.reading.qd
        ahead, behind = (
            np.asarray(jacobian(arm, q + sign * JACOBIAN_STEP_S * qd, machine.tcp))
            for sign in (1, -1)
        )
        _put_matrix(script, (ahead - behind) / (2 * JACOBIAN_STEP_S))


def _put_matrix(script: ControlScript, matrix: FloatArray) -> None:
    """Column by column, (6, 6)."""
    columns = np.asarray(matrix).T.ravel()
    script.registers.put_doubles(0, columns[:24])
    script.registers.put_doubles(UPPER_COLUMNS, columns[24:])


QUERIES: dict[int, Callable[[ControlScript], Steps | None]] = {
    26: _step_time,
    28: _target_waypoint,
    30: _inverse_kin_near,
    36: _is_pose_safe,
    37: _are_joints_safe,
    38: _joint_torques,
    39: _pose_trans,
    40: _tcp_offset,
    43: _forward_kin,
    44: _forward_kin_of,
    46: _inverse_kin,
    47: _is_steady,
    58: _flange_pose,
    60: _has_solution,
    61: _has_solution_near,
    67: _mass_matrix,
    68: _coriolis,
    69: _target_accelerations,
    70: _jacobian,
    71: _jacobian_rate,
}
