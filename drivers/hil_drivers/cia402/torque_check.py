"""Torques that drives measure while they hold the arm, against its weight: sign and scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray, RobotConnectionError
from hil_drivers.cia402.mapping import Mapping
from hil_drivers.cia402.objects import TORQUE
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.torque_model import TorqueModel

NOTICEABLE = 0.10
"""Of the joint's largest torque: less weight is not told from friction."""

FRICTION = 0.06
"""Of the same: stick friction may hold so much of the weight, or have to be overcome."""

TIMES = 3.0
"""Models, loads and rated torques may be off by so much."""

HINT = (
    "look at polarity (607Eh bit 5), axes.direction, rated_torque_nm and offset_deg, at the load "
    "and at how the arm is mounted (gravity)"
)


@dataclass(frozen=True)
class Weighed:
    """The arm as it is held.

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
        """Axes that carry noticeable weight."""
        heavy = np.abs(self.gravity) > NOTICEABLE * self.effort_max
        return [int(axis) for axis in np.flatnonzero(heavy)]

    @property
    def contradictions(self) -> list[str]:
        """Axes whose torque cannot be what holds the arm, with the figures."""
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


def weigh(session: Session, model: TorqueModel) -> Weighed | None:
    """Measure for a moment; the axes hold. None where process data do not carry 6077h.

    Raises:
        RobotError: See `Core.mean_torque`.
    """
    if not carries_torque(session.mapping):
        return None
    scaling = session.drives.scaling
    measured = scaling.torque(session.core.mean_torque())
    gravity = model.holding(scaling.position(session.player.position))[0]
    return Weighed(measured, gravity, np.array(session.arm.effort_max), session.arm.joint_names)


def require_plausible(session: Session, model: TorqueModel) -> None:
    """Refuse to send torques to drives whose own contradict the arm's weight.

    Raises:
        RobotConnectionError: With axis and figures.
    """
    weighed = weigh(session, model)
    if weighed is not None and (wrong := weighed.contradictions):
        raise RobotConnectionError("\n".join(wrong), hint=HINT)


def carries_torque(mapping: Mapping) -> bool:
    """Whether 6077h travels with every cycle."""
    return any(TORQUE in pdo.entries for pdo in mapping.tpdos)
