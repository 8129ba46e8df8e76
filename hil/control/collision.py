"""Collisions of an arm with its surroundings, from a fitted model alone.

The external torque that `hil.control.momentum_observer` sees holds the model's errors too. What is
more than these comes from outside: a joint whose residual stays beyond its threshold, with the
same sign, for the debounce time. Haddadin et al. 2017, sec. V-A, call this detection with
isolation: the joint that is named is not always one of the link that was hit, since a force turns
every joint between the base and that link.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.control.collision_thresholds import CollisionThresholds
from hil.control.momentum_observer import MomentumObserver
from hil.control.rest_margin import RestMargin
from hil.core import FloatArray, SpecError
from hil.estimators import RobotEstimator

TIME_S = 1e-6
"""Time stamps are no more exact than this."""


@dataclass(frozen=True, slots=True)
class Collision:
    """A joint that something pushes.

    Attributes:
        joint: Its name; of several, the one that is furthest beyond its threshold.
        index: Its place among the model's joints.
        time_s: When it was told, in the samples' time.
        since_s: When the joint's residual first exceeded the threshold.
        torque: Residual [N·m], positive where the joint is pushed forwards.
        threshold: What it exceeds [N·m].
    """

    joint: str
    index: int
    time_s: float
    since_s: float
    torque: float
    threshold: float


class CollisionDetector:
    """Looks at one sample after the other.

    Args:
        model: Fitted, with a rigid body; a load that is no part of `payload` looks like a push.
        payload: The load that is mounted, declared or identified.
        thresholds: Those of the model's own uncertainty by default, see `CollisionThresholds`.

    Attributes:
        thresholds: As given; the observer's gain and the debounce time are theirs.

    Raises:
        FitError: The model has no rigid body, or cannot tell torques.
        SpecError: The thresholds are of other joints.
    """

    def __init__(
        self,
        model: RobotEstimator,
        payload: Payload | None = None,
        *,
        thresholds: CollisionThresholds | None = None,
    ) -> None:
        self.thresholds = thresholds or CollisionThresholds.of(model)
        if self.thresholds.joint_names != model.joint_names_:
            raise SpecError(
                f"the thresholds are of {', '.join(self.thresholds.joint_names)}, the model of "
                f"{', '.join(model.joint_names_)}",
                hint="calibrate thresholds with the model that they are for",
            )
        self._observer = MomentumObserver(model, payload, gain=self.thresholds.gain)
        self._margin = RestMargin(self.thresholds.resting)
        n = self._observer.n
        self._sign, self._since = np.zeros(n), np.full(n, np.inf)
        self._told = False

    @property
    def residual(self) -> FloatArray:
        """(n,) external torque [N·m], a view that changes with every sample."""
        return self._observer.residual

    def update(
        self, t: float, q: FloatArray, qd: FloatArray, effort: FloatArray
    ) -> Collision | None:
        """A collision when it becomes one; None while there is none, and while the same goes on.

        Args:
            t: Time of the sample [s].
            q: (n,) positions as measured [rad].
            qd: (n,) velocities [rad/s].
            effort: (n,) in the model's unit, current [A] or torque [N·m].

        Raises:
            DataError: A value is not finite, of another shape, or time does not go on.
        """
        residual = self._observer.update(t, q, qd, effort)
        limit = self.thresholds.at(qd) + self._margin.update(t, qd)
        sign = np.where(np.abs(residual) > limit, np.sign(residual), 0.0)
        self._since[sign != self._sign] = t
        self._sign = sign
        pushed = (sign != 0.0) & (t - self._since >= self.thresholds.debounce_s - TIME_S)
        if not np.any(pushed):
            # The same contact goes on as long as any joint feels it.
            self._told = self._told and bool(np.any(sign))
            return None
        if self._told:
            return None
        self._told = True
        j = int(np.argmax(np.where(pushed, np.abs(residual) / limit, 0.0)))
        name = self._observer.joint_names[j]
        return Collision(
            name, j, float(t), float(self._since[j]), float(residual[j]), float(limit[j])
        )
