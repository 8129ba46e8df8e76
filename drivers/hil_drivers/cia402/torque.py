"""Joint torques of a motion or a pose, by a rigid-body model of the arm and its load.

Drives get them ahead of their own loops: as an offset in CSP (60B2h), as the set-point in CST
(6071h). Before any torque is sent, `GravityComparison` compares the torques that the drives measure
while they hold the arm with the model's gravity torques: a wrong sign or scale shows there, and
nothing moves because of it.
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
    """Inverse dynamics without friction, and without rotors unless a URDF's model has them.

    Args:
        model: Built-in arm of the station.
        urdf: Path of a better model of this very arm; the built-in one when empty.
        gravity: (3,) in the base frame [m/s²], by which the mounting of the arm is given.

    Raises:
        SpecError: The URDF cannot be used, or has another number of joints.
    """

    def __init__(
        self, model: str, urdf: str = "", gravity: tuple[float, float, float] = GRAVITY
    ) -> None:
        self._bare = _robot_model(model, urdf, gravity)
        self._loaded = self._bare

    def mount(self, payload: Payload) -> None:
        """Replace the load."""
        self._loaded = self._bare.with_payload(payload)

    def torque(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return (N, n) joint torques [N·m] for a motion, each argument (N, n)."""
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
            f"{urdf} has {robot.n} joints, a {model} has {RobotModel.from_arm(model).n}",
            hint="give the URDF of this arm, without gripper and external axes",
        )
    return robot


NOTICEABLE = 0.10
"""Share of the joint's largest torque: smaller gravity torques are not distinguished from friction.
"""

FRICTION = 0.06
"""Share of the joint's largest torque that stick friction may add or take."""

TIMES = 3.0
"""Factor by which models, loads and rated torques may be wrong."""

HINT = (
    "look at polarity (607Eh bit 5), axes.direction, rated_torque_nm and offset_deg, at the load "
    "and at how the arm is mounted (gravity)"
)


@dataclass(frozen=True)
class GravityComparison:
    """Measured torques of an arm that is held still, compared with its gravity torques.

    Attributes:
        measured, gravity: (n,) joint torques of the drives and of the model [N·m].
        effort_max: (n,) largest joint torques [N·m].
        names: Of the joints.
    """

    measured: FloatArray
    gravity: FloatArray
    effort_max: FloatArray
    names: Sequence[str]

    @property
    def compared(self) -> list[int]:
        """Axes whose gravity torque is large enough to be compared."""
        heavy = np.abs(self.gravity) > NOTICEABLE * self.effort_max
        return [int(axis) for axis in np.flatnonzero(heavy)]

    @property
    def contradictions(self) -> list[str]:
        """For each axis whose measured torque cannot hold the arm: name, figures and reason."""
        return [
            f"{self.names[axis]} measures {self.measured[axis]:.1f} N·m where "
            f"{self.gravity[axis]:.1f} N·m hold the arm: {why}"
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
