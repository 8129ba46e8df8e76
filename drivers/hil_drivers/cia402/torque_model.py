"""The torque that a motion takes, by a rigid-body model of the arm and its load.

Drives get it ahead of their own loops: an offset in CSP (60B2h), the set-point in CST (6071h).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.arms import Payload, arm_names
from hil.core import FloatArray, SpecError
from hil.dynamics import RobotModel

if TYPE_CHECKING:
    from hil.dynamics import RobotModel

GRAVITY = (0.0, 0.0, -9.81)


class TorqueModel:
    """Inverse dynamics without friction, and without rotors unless a URDF's model has them.

    Args:
        model: Built-in arm of the station.
        urdf: Path of a better model of this very arm; the built-in one when empty.
        gravity: (3,) in the base frame [m/s²]: says how the arm is mounted.

    Raises:
        SpecError: The URDF cannot be used, or has another number of joints.
    """

    def __init__(
        self, model: str, urdf: str = "", gravity: tuple[float, float, float] = GRAVITY
    ) -> None:
        self._bare = _robot_model(model, urdf, gravity)
        self._loaded = self._bare

    @property
    def n(self) -> int:
        """Number of joints."""
        return self._bare.n

    def mount(self, payload: Payload) -> None:
        """From now on with this load, in place of the one before."""
        self._loaded = self._bare.with_payload(payload)

    def torque(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(N, n) joint torques [N·m] for a motion, each argument (N, n)."""
        return self._loaded.inverse_dynamics(q, qd, qdd)

    def holding(self, q: FloatArray) -> FloatArray:
        """(N, n) joint torques [N·m] that hold the arm still."""
        return self._loaded.gravity(np.atleast_2d(q))


def _robot_model(model: str, urdf: str, gravity: tuple[float, float, float]) -> RobotModel:
    if not urdf:
        return RobotModel.from_arm(model, gravity=gravity)
    robot = RobotModel.from_urdf(Path(urdf), gravity=gravity)
    if model in arm_names() and robot.n != RobotModel.from_arm(model).n:
        raise SpecError(
            f"{urdf} has {robot.n} joints, a {model} has {RobotModel.from_arm(model).n}",
            hint="give the URDF of this arm, without gripper and external axes",
        )
    return robot
