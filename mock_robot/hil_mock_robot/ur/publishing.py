"""What the controller tells by RTDE after every tick."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil_mock_robot.ur.modes import (
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

SUPPLY_V = 48.0
POWER_ON, PROGRAM_RUNNING = 1, 2
JOINT_MODES = {
    RobotMode.RUNNING: JOINT_RUNNING,
    RobotMode.IDLE: JOINT_IDLE,
    RobotMode.POWER_ON: JOINT_IDLE,
}


class Publishing:
    """Fills a machine's outputs."""

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
        out["joint_temperatures"] = seen.temperature.tolist()
        self._publish_modes(machine)

    def _publish_modes(self, machine: Machine) -> None:
        out, modes = machine.outputs, machine.modes
        out["robot_mode"], out["safety_mode"] = int(modes.robot), int(modes.safety)
        out["safety_status_bits"] = SAFETY_BITS[modes.safety]
        out.offer("safety_status", int(modes.safety))
        fault = modes.safety in (SafetyMode.FAULT, SafetyMode.VIOLATION)
        joint = JOINT_FAULT if fault else JOINT_MODES.get(modes.robot, JOINT_POWER_OFF)
        out["joint_mode"] = [joint] * 6
        out["runtime_state"] = int(machine.runtime)
        powered = modes.robot >= RobotMode.POWER_ON
        playing = machine.runtime is RuntimeState.PLAYING
        out["robot_status_bits"] = POWER_ON * powered + PROGRAM_RUNNING * playing
        moving = machine.motion is not None and np.abs(machine.setpoint[1]).max() > 0
        out["speed_scaling"] = 1.0 if moving or playing else 0.0
        out["target_speed_fraction"] = machine.speed_fraction
        out["actual_robot_voltage"] = SUPPLY_V
        payload = machine.body.declared
        out.offer("payload", payload.mass)
        out.offer("payload_cog", payload.com)
        out.offer("payload_inertia", payload.inertia)
