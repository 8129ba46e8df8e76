"""What the controller tells about tool and elbow, by its own kinematics; see `Publishing`.

Wrench and accelerometer are simplified: docs/reference/mock-ur-motions.md.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dposv

from hil.core import FloatArray
from hil_mock_robot.ur.chain import Posture, lengths_of, twist_of
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.force_sensor import DAMPING, raw_wrench
from hil_mock_robot.ur.poses import Frame, Triple, compose, frame_of, inverted, pose_from, turned

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine
    from hil_mock_robot.ur.variables import Values


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
