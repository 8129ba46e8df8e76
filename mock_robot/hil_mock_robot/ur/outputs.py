"""Outputs: what the controller publishes by RTDE after every tick.

`Publishing` fills joints, modes and supply, `Cartesian` what needs kinematics: TCP, elbow,
accelerometer, wrench. Quantities the plant does not have are simple but plausible
(docs/reference/mock-ur-rtde.md, docs/reference/mock-ur-motions.md).
"""

from __future__ import annotations

import math
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dposv

from hil.core import FloatArray
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.kinematics import (
    Frame,
    Posture,
    Triple,
    compose,
    frame_of,
    inverted,
    lengths_of,
    pose_from,
    turned,
    twist_of,
)
from hil_mock_robot.ur.modes import (
    JOINT_BOOTING,
    JOINT_FAULT,
    JOINT_IDLE,
    JOINT_POWER_OFF,
    JOINT_RUNNING,
    SAFETY_BITS,
    RobotMode,
    RuntimeState,
    SafetyMode,
)

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine
    from hil_mock_robot.ur.variables import Values


SUPPLY_V = 48.0

STANDBY_A = 0.5
"""What control box and joint electronics draw of the 48 V."""

WINDING_OHM = 1.0
"""Heat in each motor and its amplifier per square of its current; of a usual size."""

EXECUTION_MS = 0.35
"""`actual_execution_time` does not depend on the computer that simulates."""

DEVIATION_RAD = 0.1
"""Distance of actual from target position that `joint_position_deviation_ratio` counts as 1."""

CURRENT_WINDOW_A = 2.0
POWER_ON, PROGRAM_RUNNING = 1, 2
TOOL_RUNNING, TOOL_IDLE = 253, 255

JOINT_MODES = {
    RobotMode.RUNNING: JOINT_RUNNING,
    RobotMode.IDLE: JOINT_IDLE,
    RobotMode.POWER_ON: JOINT_IDLE,
    RobotMode.BOOTING: JOINT_BOOTING,
}


class Publishing:
    """Fills a machine's outputs."""

    def __init__(self) -> None:
        self._before: tuple[object, ...] = ()
        self._payload: object = None

    def publish(self, machine: Machine) -> None:
        """All that may change from tick to tick."""
        out, seen = machine.outputs, machine.reading
        out["timestamp"] = machine.now_s
        for name, values in zip(
            ("target_q", "target_qd", "target_qdd"), machine.setpoint, strict=True
        ):
            out[name] = values.tolist()
        out["target_current"] = seen.current_target.tolist()
        out["target_moment"] = seen.moment_target.tolist()
        out["actual_q"], out["actual_qd"] = seen.q.tolist(), seen.qd.tolist()
        out["actual_current"] = out["joint_control_output"] = seen.current.tolist()
        out["joint_temperatures"] = celsius = seen.temperature.tolist()
        out["tool_temperature"] = celsius[-1]
        if "joint_position_deviation_ratio" in out:
            apart = float(np.abs(machine.setpoint[0] - seen.q).max())
            out["joint_position_deviation_ratio"] = apart / DEVIATION_RAD
        self._publish_modes(machine)
        self._publish_load(machine)
        for publish in machine.publishers:
            publish(machine)
        out["actual_robot_current"] = _supply_current(machine)
        out["actual_momentum"] = _momentum(machine)

    def _publish_modes(self, machine: Machine) -> None:
        out, modes = machine.outputs, machine.modes
        moving = machine.motion is not None and np.abs(machine.setpoint[1]).max() > 0
        playing = machine.runtime is RuntimeState.PLAYING
        out["speed_scaling"] = 1.0 if moving or playing else 0.0
        out["target_speed_fraction"] = machine.speed_fraction
        now = modes.robot, modes.safety, machine.runtime
        if now == self._before:
            return
        self._before = now
        out["robot_mode"], out["safety_mode"] = int(modes.robot), int(modes.safety)
        out["safety_status_bits"] = SAFETY_BITS[modes.safety]
        out.offer("safety_status", int(modes.safety))
        out["runtime_state"] = int(machine.runtime)
        powered = modes.robot >= RobotMode.POWER_ON
        out["robot_status_bits"] = POWER_ON * powered + PROGRAM_RUNNING * playing
        fault = modes.safety in (SafetyMode.FAULT, SafetyMode.VIOLATION)
        joint = JOINT_FAULT if fault else JOINT_MODES.get(modes.robot, JOINT_POWER_OFF)
        out["joint_mode"] = [joint] * 6
        _publish_supply(out, powered=powered, running=modes.robot is RobotMode.RUNNING)

    def _publish_load(self, machine: Machine) -> None:
        out, payload = machine.outputs, machine.body.declared
        out.offer("tcp_offset", machine.tcp.tolist())
        if payload is self._payload:
            return
        self._payload = payload
        out.offer("payload", payload.mass)
        out.offer("payload_cog", payload.com)
        out.offer("payload_inertia", payload.inertia)


def _supply_current(machine: Machine) -> float:
    """What the robot draws of its 48 V [A]: electronics, heat in the motors, work of the joints."""
    if machine.modes.robot < RobotMode.POWER_ON:
        return 0.0
    seen = machine.reading
    heat = WINDING_OHM * float(seen.current @ seen.current)
    work = float(seen.moment_target @ machine.setpoint[1])
    return STANDBY_A + (heat + max(0.0, work)) / SUPPLY_V


def _momentum(machine: Machine) -> float:
    """Half the arm and the whole load at the speed of the TCP [kg·m/s]: a rough measure."""
    body = machine.body
    x, y, z, *_ = machine.outputs["actual_TCP_speed"]
    moved = 0.5 * float(body.arm.mass.sum()) + body.declared.mass
    return moved * math.sqrt(x * x + y * y + z * z)


def _publish_supply(out: Values, *, powered: bool, running: bool) -> None:
    """Voltages, and what else never changes while the mode stays."""
    out["actual_main_voltage"] = SUPPLY_V
    out["actual_robot_voltage"] = SUPPLY_V if powered else 0.0
    out["actual_joint_voltage"] = [SUPPLY_V if powered else 0.0] * 6
    out["actual_execution_time"] = EXECUTION_MS
    out["tool_mode"] = TOOL_RUNNING if running else TOOL_IDLE
    out.offer("actual_current_window", [CURRENT_WINDOW_A] * 6)


DAMPING = 0.05
"""Keeps a push finite in a singularity, where the joints do not feel some of it."""


class Cartesian:
    """Fills the outputs of one machine that need kinematics."""

    def __init__(self, machine: Machine) -> None:
        body = machine.body
        self._lengths = lengths_of(body.arm)
        self._gains = body.arm.drive_gains
        self._gravity: Triple = body.gravity
        self._rate = 1.0 / machine.tick_s
        self._damping = DAMPING**2 * np.eye(6)
        self._setpoint: Setpoint = np.empty((3, 6))
        self._tcp: FloatArray = np.empty(6)
        self._before: list[float] | None = None

    def publish(self, machine: Machine) -> None:
        """After every tick."""
        out, seen = machine.outputs, machine.reading
        tool = frame_of(machine.tcp)
        if machine.setpoint is not self._setpoint or machine.tcp is not self._tcp:
            self._setpoint, self._tcp = machine.setpoint, machine.tcp
            self._publish_target(out, tool)
        posture = Posture(self._lengths, seen.q)
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        speeds = seen.qd.tolist()
        out["actual_TCP_pose"] = pose_from(frame)
        out["actual_TCP_speed"] = twist_of(J, speeds)
        if "elbow_position" in out:
            out["elbow_position"] = posture.elbow
            out["elbow_velocity"] = posture.elbow_velocity(speeds)
        wrench = self._wrench(machine, J)
        out["actual_TCP_force"] = wrench
        out["tcp_force_scalar"] = sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)
        out["actual_tool_accelerometer"] = felt = self._felt(posture, out["target_TCP_speed"])
        if "ft_raw_wrench" in out:
            out["ft_raw_wrench"] = raw_wrench(machine, posture, felt)

    def _publish_target(self, out: Values, tool: Frame) -> None:
        """What follows from the set-point, which mostly stands still in a dwell program."""
        posture = Posture(self._lengths, self._setpoint[0])
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        out["target_TCP_pose"] = pose_from(frame)
        out["target_TCP_speed"] = twist_of(J, self._setpoint[1])

    def _wrench(self, machine: Machine, jacobian: list[float]) -> list[float]:
        """What pushes the tool, from the torque that the servo's model does not explain."""
        if machine.body.braked:
            return [0.0] * 6
        seen = machine.reading
        torque = (seen.current_target - seen.current) * self._gains
        J = np.array(jacobian).reshape(6, 6)
        _, wrench, _ = dposv(J @ J.T + self._damping, J @ torque)
        numbers: list[float] = wrench.tolist()
        return numbers

    def _felt(self, posture: Posture, twist: list[float]) -> Triple:
        """Acceleration of the set-point less gravity, in the flange's axes [m/s²]."""
        before = self._before or twist
        self._before = twist
        gx, gy, gz = self._gravity
        x, y, z = (self._rate * (twist[i] - before[i]) for i in range(3))
        return turned(inverted(posture.flange), x - gx, y - gy, z - gz)


def raw_wrench(machine: Machine, posture: Posture, felt: Triple) -> list[float]:
    """(6,) force [N] and torque [N·m] on the flange, in its axes, about its origin.

    The weight and inertia of what really hangs there, as a point mass that does not turn, and the
    pushes of the side channel. Ideal: no noise, no offset, nothing taken off for what is declared.

    Args:
        machine: Whose arm.
        posture: Where its flange is.
        felt: Acceleration less gravity, in the axes of the flange [m/s²].
    """
    load = machine.body.mounted
    fx, fy, fz = (-load.mass * each for each in felt)
    x, y, z = load.com
    wrench = [fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx]
    push = machine.body.pushed
    if not push.any():
        return wrench
    flange = posture.flange
    J = np.array(posture.jacobian((flange[9], flange[10], flange[11]))).reshape(6, 6)
    pushed = np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), J @ push).tolist()
    back = inverted(flange)
    along = (*turned(back, *pushed[:3]), *turned(back, *pushed[3:]))
    return [a + b for a, b in zip(wrench, along, strict=True)]
