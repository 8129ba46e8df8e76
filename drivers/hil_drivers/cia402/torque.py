"""Joint torques of a motion or a pose from a rigid-body model of the arm and its payload.

The torques are feed-forward values for the drives: a torque offset in CSP (60B2h), the torque
set-point in CST (6071h). Before any torque is sent, `GravityComparison` compares the torques that
the drives measure on the holding arm with the gravity torques of the model. The comparison detects
a wrong sign or scale of torque without any motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.arms import Payload, arm_names
from hil.core import FloatArray, SpecError
from hil.dynamics import RobotModel

GRAVITY = (0.0, 0.0, -9.81)


class TorqueModel:
    """Inverse dynamics without friction; rotor inertia is included only if a URDF contains it.

    Args:
        model: Name of the station's built-in arm.
        urdf: Path of a URDF with a more accurate model of the arm; empty for the built-in model.
        gravity: (3,) gravity vector in the base frame [m/s²], which describes how the arm is
            mounted.

    Raises:
        SpecError: The URDF is invalid or has a different number of joints.
    """

    def __init__(
        self, model: str, urdf: str = "", gravity: tuple[float, float, float] = GRAVITY
    ) -> None:
        self._bare = _robot_model(model, urdf, gravity)
        self._loaded = self._bare

    def mount(self, payload: Payload) -> None:
        """Replace the payload."""
        self._loaded = self._bare.with_payload(payload)

    def torque(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return (N, n) joint torques [N·m] of a motion; every argument has the shape (N, n)."""
        return self._loaded.inverse_dynamics(q, qd, qdd)

    def holding(self, q: FloatArray) -> FloatArray:
        """Return (N, n) joint torques [N·m] that hold the arm still."""
        return self._loaded.gravity(np.atleast_2d(q))


def _robot_model(model: str, urdf: str, gravity: tuple[float, float, float]) -> RobotModel:
    if not urdf:
        return RobotModel.from_arm(model, gravity=gravity)
    robot = RobotModel.from_urdf(Path(urdf), gravity=gravity)
    if model in arm_names() and robot.n != RobotModel.from_arm(model).n:
        raise SpecError(
            f"{urdf} has {robot.n} joints, the model {model} has {RobotModel.from_arm(model).n}",
            hint="use the URDF of this arm, without gripper and external axes",
        )
    return robot


NOTICEABLE = 0.10
"""Minimum gravity torque for the comparison, as a share of the joint's largest torque.

A gravity torque below the minimum cannot be distinguished from friction.
"""

FRICTION = 0.06
"""Assumed static friction torque in the comparison, as a share of the joint's largest torque."""

TIMES = 3.0
"""Tolerated factor between measured and modelled torque, due to model, payload, rated torque."""

HINT = (
    "check polarity (607Eh bit 5), axes.direction, rated_torque_nm and offset_deg, the payload, "
    "and how the arm is mounted (gravity)"
)


@dataclass(frozen=True)
class GravityComparison:
    """Comparison of measured torques of an arm at standstill with its gravity torques.

    Attributes:
        measured: (n,) joint torques measured by the drives [N·m].
        gravity: (n,) joint torques of the model [N·m].
        effort_max: (n,) largest joint torques [N·m].
        names: Names of the joints.
    """

    measured: FloatArray
    gravity: FloatArray
    effort_max: FloatArray
    names: Sequence[str]

    @property
    def compared(self) -> list[int]:
        """Numbers of the axes whose gravity torque is large enough to be compared."""
        heavy = np.abs(self.gravity) > NOTICEABLE * self.effort_max
        return [int(axis) for axis in np.flatnonzero(heavy)]

    @property
    def contradictions(self) -> list[str]:
        """One message, with values and reason, for each axis whose torque cannot hold the arm."""
        return [
            f"{self.names[axis]} measures {self.measured[axis]:.1f} N·m, but gravity needs "
            f"{self.gravity[axis]:.1f} N·m: {why}"
            for axis in self.compared
            if (why := self._wrong(axis))
        ]

    def _wrong(self, axis: int) -> str:
        weight, slack = abs(self.gravity[axis]), FRICTION * self.effort_max[axis]
        along = self.measured[axis] * np.sign(self.gravity[axis])
        if along < -slack / 2:
            return "the sign of torque is wrong"
        if along > TIMES * weight + slack or along < weight / TIMES - slack:
            return "the scale of torque is wrong"
        return ""
