"""What an arm is doing for us, and how its state tells."""

from __future__ import annotations

from enum import Enum, auto

import numpy as np

from hil.core import FloatArray, RobotFault
from hil_drivers.ur.standing import STILL_RAD_S

AT_GOAL_RAD, LED_TO_RAD = 5e-4, 0.01
"""Where a move has to end, and where leading has to begin and end at the latest [rad]."""


class Phase(Enum):
    """What the arm is doing."""

    IDLE = auto()
    STARTING = auto()
    MOVE = auto()
    """The controller executes a move of its own."""
    LED = auto()
    """It is given a set-point per tick."""
    SETTLING = auto()
    """The last set-point was given; it is still on its way there."""
    BRAKING = auto()


UNDER_WAY = (Phase.MOVE, Phase.LED, Phase.SETTLING)
"""Phases that a stop ends."""


def still(row: np.void) -> bool:
    """Whether the controller commands no speed."""
    return bool(np.abs(row["target_qd"]).max() < STILL_RAD_S)


def off(row: np.void, goal: FloatArray) -> float:
    """How far the controller's set-point is from `goal` (n,), by the joint that is furthest."""
    return float(np.abs(row["target_q"] - goal).max())


def elsewhere(far: float) -> RobotFault:
    """The error for a motion that is over too early."""
    return RobotFault(
        f"the motion ended {far:.4f} rad from its goal",
        hint="was it stopped at the teach pendant? connect again, and resume",
    )
