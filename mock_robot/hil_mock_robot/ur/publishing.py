"""What the controller tells by RTDE after every tick.

What needs kinematics (TCP, elbow, accelerometer, wrench) is filled by `Machine.publishers`.
Quantities the plant does not have are simple but plausible: docs/reference/mock-ur-rtde.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

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


def _publish_supply(out: Values, *, powered: bool, running: bool) -> None:
    """Voltages, and what else never changes while the mode stays."""
    out["actual_main_voltage"] = SUPPLY_V
    out["actual_robot_voltage"] = SUPPLY_V if powered else 0.0
    out["actual_joint_voltage"] = [SUPPLY_V if powered else 0.0] * 6
    out["actual_execution_time"] = EXECUTION_MS
    out["tool_mode"] = TOOL_RUNNING if running else TOOL_IDLE
    out.offer("actual_current_window", [CURRENT_WINDOW_A] * 6)


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
