"""What friction may hide while a joint stands.

A joint at rest holds any torque up to its dry friction without moving, and how much it holds
changes unseen: a controller's integral unwinds, a gear creeps. No model of the motion knows this
torque, so that much less of a residual is a collision while a joint stands, and a while after.
"""

from __future__ import annotations

import math

import numpy as np

from hil.core import FloatArray
from hil.estimators import STANDSTILL, RobotEstimator, dry_friction
from hil.export import plain_friction

FADES_S = 0.1
"""Time constant after a start: the way in which friction comes round, and the observer's lag."""

SLIDING_HZ = 100.0
"""Samples of the motion at which a model is asked for friction that slides."""


def resting_friction(model: RobotEstimator) -> FloatArray:
    """(n,) dry friction of a model [N·m]: its own parameter, or what its sliding friction shows."""
    known = dry_friction(model)
    return plain_friction(model, SLIDING_HZ)[0] if known is None else known


class RestMargin:
    """Dry friction of joints that stand, or stood just before.

    Args:
        level: (n,) dry friction [N·m].
    """

    def __init__(self, level: FloatArray) -> None:
        self._level = level
        self._share = np.ones_like(level)
        self._time: float | None = None

    def update(self, t: float, qd: FloatArray) -> FloatArray:
        """(n,) margin [N·m] after a sample at time t [s] with velocities (n,) [rad/s]."""
        passed = 0.0 if self._time is None else t - self._time
        self._time = t
        self._share *= math.exp(-passed / FADES_S)
        self._share[np.abs(qd) < STANDSTILL] = 1.0
        margin: FloatArray = self._level * self._share
        return margin
