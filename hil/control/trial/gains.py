"""A joint controller every law of a trial shares, made from what the maker publishes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.dynamics import RobotModel

BANDWIDTH_RAD_S = 20.0
DAMPING = 0.7
FULL_RAD = 0.35
"""Deflection that takes the whole torque limit, at most: nominal inertias lack the rotors, which
are most of a wrist's."""


@dataclass(frozen=True, slots=True, eq=False)
class Spring:
    """A spring and a damper per joint.

    Attributes:
        stiffness: (n,) [N·m/rad].
        damping: (n,) [N·m·s/rad].
    """

    stiffness: FloatArray
    damping: FloatArray

    def torque(self, error: FloatArray, rate: FloatArray) -> FloatArray:
        """(n,) [N·m] for a position error (n,) [rad] and its rate (n,) [rad/s]."""
        return self.stiffness * error + self.damping * rate

    def firmer(self, factor: float) -> Spring:
        """With so many times the bandwidth."""
        return Spring(self.stiffness * factor**2, self.damping * factor)


def spring_for(robot: RobotModel, q: FloatArray) -> Spring:
    """PD gains for the inertia that each joint carries on average over the poses `q` (N, n)."""
    inertia = np.diagonal(robot.mass_matrix(q), axis1=1, axis2=2).mean(axis=0)
    stiffness = np.maximum(inertia * BANDWIDTH_RAD_S**2, robot.effort_max / FULL_RAD)
    return Spring(stiffness, 2 * DAMPING * stiffness / BANDWIDTH_RAD_S)
