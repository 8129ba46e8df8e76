"""From a moment on a path to a set-point of the joints."""

from __future__ import annotations

from math import cos, sin

import numpy as np
from scipy.linalg.lapack import dgesv

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.chain import Posture, lengths_of, twist_of
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.inverse import nearest
from hil_mock_robot.ur.limits import SINGULARITY, MotionImpossible
from hil_mock_robot.ur.pieces import Moment
from hil_mock_robot.ur.poses import (
    Numbers,
    Triple,
    compose,
    frame_of,
    inverted,
    rotation_of,
    turned,
)

TOO_FAST = 1.001
"""Share of a joint's speed limit that rounding and the step of time may take."""
FEW_RAD = 1e-3
"""A smaller turn's exponential map is told from its series [rad]."""


class ToolFollower:
    """Finds the joints that bring the tool where a path leads.

    Args:
        arm: Its lengths and speed limits.
        tcp: (6,) tool in the flange frame.
        tick_s: Device time of a tick.
    """

    def __init__(self, arm: ArmDescription, tcp: Numbers, tick_s: float) -> None:
        self._arm, self._lengths = arm, lengths_of(arm)
        self._tool = frame_of(tcp)
        self._back = inverted(self._tool)
        self._tick_s = tick_s

    def setpoint(self, moment: Moment, anchor: FloatArray, pace: float, now: Setpoint) -> Setpoint:
        """The next set-point.

        Args:
            moment: Where the path is, in tool coordinates.
            anchor: (3,) rotation vector of the frame that they turn.
            pace: Motion time per time.
            now: The present set-point.

        Raises:
            MotionImpossible: With code 154: the way leads out of reach, or a joint would have to
                turn faster than it can.
        """
        x, y, z, *turn = moment[0].tolist()
        held = frame_of((x, y, z, *anchor.tolist()))
        frame = compose(held, (*rotation_of(*turn), 0.0, 0.0, 0.0))
        q = nearest(self._arm, compose(frame, self._back), now[0])
        if q is None:
            raise MotionImpossible("the way of the tool leads out of reach", SINGULARITY)
        vx, vy, vz, *rates = (pace * moment[1]).tolist()
        spin = turned(held, *_spin(turn, rates))
        qd = self.joint_speeds(q, (vx, vy, vz, *spin))
        if (np.abs(q - now[0]) > TOO_FAST * self._arm.qd_max * self._tick_s).any():
            raise MotionImpossible("the joints would have to jump", SINGULARITY)
        return np.array((q, qd, (qd - now[1]) / self._tick_s))

    def joint_speeds(self, q: Numbers, twist: Numbers) -> FloatArray:
        """Joint speeds (6,) [rad/s] that move the tool with a twist (6,).

        Raises:
            MotionImpossible: With code 154: there are none, or none that the joints can do.
        """
        J = np.array(self._jacobian(q)).reshape(6, 6)
        qd: FloatArray
        _, _, qd, singular = dgesv(J, np.array(twist))  # a third of the time of numpy's solve
        if singular:
            raise MotionImpossible("the tool cannot move in that direction", SINGULARITY)
        beyond = np.abs(qd) > TOO_FAST * self._arm.qd_max
        if beyond.any():
            joint = int(beyond.argmax())
            raise MotionImpossible(f"joint {joint + 1} cannot follow the tool", SINGULARITY)
        return qd

    def drift(self, now: Setpoint, twist: FloatArray) -> Setpoint:
        """The set-point after a tick at whose end the tool moves with a twist (6,).

        Raises:
            MotionImpossible: See `joint_speeds`.
        """
        ahead = now[0] + self._tick_s * now[1]
        qd = self.joint_speeds(ahead, twist)
        q = now[0] + 0.5 * self._tick_s * (now[1] + qd)
        return np.array((q, qd, (qd - now[1]) / self._tick_s))

    def twist(self, now: Setpoint) -> list[float]:
        """Velocity (6,) of the tool at a set-point, [m/s] and [rad/s]."""
        return twist_of(self._jacobian(now[0]), now[1])

    def _jacobian(self, q: Numbers) -> list[float]:
        posture = Posture(self._lengths, q)
        tool = compose(posture.flange, self._tool)
        return posture.jacobian((tool[9], tool[10], tool[11]))


def _spin(turn: list[float], rates: list[float]) -> Triple:
    """Angular velocity of a rotation vector that changes (left Jacobian of SO(3))."""
    x, y, z = turn
    u, v, w = rates
    cx, cy, cz = y * w - z * v, z * u - x * w, x * v - y * u
    square = x * x + y * y + z * z
    if square < FEW_RAD**2:
        b, c = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        angle = square**0.5
        b, c = (1.0 - cos(angle)) / square, (angle - sin(angle)) / (square * angle)
    return (
        u + b * cx + c * (y * cz - z * cy),
        v + b * cy + c * (z * cx - x * cz),
        w + b * cz + c * (x * cy - y * cx),
    )
