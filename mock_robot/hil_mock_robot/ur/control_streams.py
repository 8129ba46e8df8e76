"""Commands that start a thread which goes on until its stop command: servo, speed, jog, force."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.ur.moving import (
    joints_of,
    pose_at,
    speed_motion,
    stop_joints,
    stop_line,
)
from hil_mock_robot.ur.poses import frame_of, turned
from hil_mock_robot.ur.servoing import ServoJ, SpeedJ, SpeedL
from hil_mock_robot.ur.threaded import Steps

if TYPE_CHECKING:
    from hil_mock_robot.ur.control_script import ControlScript

SERVO, SPEED, JOG = "servo", "speed", "jog"
"""Threads."""
TOOL, CUSTOM = 1, 2
"""Features to jog along; anything else is the base."""
FORCE_STOP_M_S2, JOG_STOP_M_S2 = 10.0, 1.2


def _servoj(script: ControlScript) -> None:
    _servo_to(script, script.registers.doubles(0))


def _servol(script: ControlScript) -> None:
    _servo_to(script, joints_of(script.machine, script.registers.doubles(0)))


def _servo_to(script: ControlScript, q: FloatArray) -> None:
    """Speed and acceleration, registers 6 and 7, are not used: as in the script."""
    script.servo = (q, *script.registers.doubles(8, 3).tolist())
    if not script.runs(SERVO):
        script.run(SERVO, _servo(script))


def _servo(script: ControlScript) -> Steps:
    machine = script.machine
    with script.control():
        motion = ServoJ(machine.tick_s, machine.body.arm)
        while True:
            if machine.motion is not motion:
                motion = ServoJ(machine.tick_s, machine.body.arm)
                machine.move(motion)
            motion.aim(*script.servo)
            yield


def _servo_stop(script: ControlScript) -> Steps:
    script.kill(SERVO)
    return stop_line(script, script.registers.double(0))


def _speedj(script: ControlScript) -> None:
    _speed(script, linear=False)


def _speedl(script: ControlScript) -> None:
    _speed(script, linear=True)


def _speed(script: ControlScript, *, linear: bool) -> None:
    """The time, register 7, does not end the motion: the script repeats it for ever."""
    script.speed = (linear, script.registers.doubles(0), abs(script.registers.double(6)))
    if not script.runs(SPEED):
        script.run(SPEED, _keep_speed(script, lambda: script.speed))


def _keep_speed(
    script: ControlScript, wanted: Callable[[], tuple[bool, FloatArray, float]]
) -> Steps:
    machine = script.machine
    motion: SpeedJ | SpeedL | None = None
    with script.control():
        while True:
            linear, speed, acceleration = wanted()
            kind = SpeedL if linear else SpeedJ
            if motion is None or machine.motion is not motion or not isinstance(motion, kind):
                motion = speed_motion(machine, linear=linear)
                machine.move(motion)
            motion.aim(speed, acceleration)
            yield


def _speed_stop(script: ControlScript) -> Steps:
    script.kill(SPEED)
    stop = stop_line if script.speed[0] else stop_joints
    return stop(script, script.registers.double(0))


def _jog_start(script: ControlScript) -> None:
    feature, acceleration = script.registers.doubles(6, 2)
    script.jog = (True, _in_base(script, int(feature)), abs(acceleration))
    if not script.runs(JOG):
        script.run(JOG, _keep_speed(script, lambda: script.jog))


def _in_base(script: ControlScript, feature: int) -> FloatArray:
    """(6,) speed, which is given in the axes of a feature, in those of the base."""
    machine, speed = script.machine, script.registers.doubles(0)
    if feature not in (TOOL, CUSTOM):
        return speed
    tool = pose_at(machine, machine.reading.q)
    frame = frame_of(tool if feature == TOOL else script.registers.doubles(8))
    return np.array((*turned(frame, *speed[:3]), *turned(frame, *speed[3:])))


def _jog_stop(script: ControlScript) -> Steps:
    script.kill(JOG)
    return stop_line(script, JOG_STOP_M_S2)


def _force_mode(script: ControlScript) -> None:
    """Accepted; nothing yields (docs/reference/mock-ur-control.md)."""
    script.registers.doubles(0, 18)


def _force_mode_stop(script: ControlScript) -> Steps:
    return stop_line(script, FORCE_STOP_M_S2)


STREAMS: dict[int, Callable[[ControlScript], Steps | None]] = {
    6: _force_mode,
    7: _force_mode_stop,
    9: _speedj,
    10: _speedl,
    11: _servoj,
    15: _speed_stop,
    16: _servo_stop,
    24: _servol,
    41: _jog_start,
    42: _jog_stop,
}
