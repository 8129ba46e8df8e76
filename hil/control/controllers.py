"""Joint controllers: a PD controller (spring), and four feed-forward laws.

The gains of the PD controller (`spring_for`) depend only on data published by the manufacturer, so
that all feed-forward laws use the same gains. The feed-forward laws (`feed_forwards`) range from no
feed-forward to the full model.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.control.hand_guiding import HandGuiding
from hil.control.predictor import Predictor
from hil.control.try_out_settings import RATE_HZ
from hil.core import FloatArray
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator
from hil.networks import ResidualNetwork

NOTHING, GRAVITY, NOMINAL, MODEL = "no model", "gravity", "datasheet arm", "model"

UNIDENTIFIED = (NOTHING, NOMINAL)
"""Names of the feed-forward laws that need no identification."""

TOLD = {
    NOTHING: "PD controller only",
    GRAVITY: "gravity, payload and offset of the model at the commanded position",
    NOMINAL: "rigid body with the manufacturer's masses, without friction and rotors",
    MODEL: "complete model of the commanded motion: Predictor, friction and network",
}


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Reference motion of the joints, sampled at `RATE_HZ`; static during the first second.

    Attributes:
        t: (N,) time since the beginning of the motion [s]; negative in the static phase before the
            motion.
        q, qd, qdd: (N, n) position, velocity, acceleration [rad, rad/s, rad/s²].
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


def feed_forwards(
    model: RobotEstimator, payload: Payload, reference: Reference, gains: FloatArray
) -> Iterator[tuple[str, FloatArray]]:
    """Yield name and torque (N, n) [N·m] of every feed-forward law along the reference.

    Args:
        model: Fitted model.
        payload: Mounted payload.
        reference: Reference motion of N samples.
        gains: (n,) drive gains that the controller uses, torque per current [N·m/A].
    """
    per_effort = gains if model.effort_kind_ == "current" else np.ones_like(gains)
    yield NOTHING, np.zeros_like(reference.q)
    gravity = HandGuiding(model, payload, friction_share=0.0)
    still = np.zeros_like(gains)
    yield GRAVITY, np.array([gravity(q, still) for q in reference.q]) * per_effort
    yield NOMINAL, nominal(model.robot_, payload, reference)
    yield MODEL, predicted(model, payload, reference) * per_effort


def nominal(robot: RobotModel, payload: Payload, reference: Reference) -> FloatArray:
    """Return the (N, n) torque [N·m] predicted with the parameters of the manufacturer."""
    loaded = as_made(robot, payload)
    return loaded.inverse_dynamics(reference.q, reference.qd, reference.qdd)


def as_made(robot: RobotModel, payload: Payload) -> RobotModel:
    """Return the arm with the parameters of the manufacturer and a payload."""
    return robot if payload.is_empty else robot.with_payload(payload)


def predicted(model: RobotEstimator, payload: Payload, reference: Reference) -> FloatArray:
    """Return the (N, n) effort of the full model, in the unit of the model.

    Networks with memory need a fixed sample rate: the model is evaluated in advance at the rate of
    its training data, and the efforts are interpolated linearly.
    """
    rate = rate_of(model)
    count = round((reference.t[-1] - reference.t[0]) * rate)
    t = reference.t[0] + np.arange(count + 1) / rate
    q, qd, qdd = (_at(t, reference.t, rows) for rows in (reference.q, reference.qd, reference.qdd))
    predictor = Predictor(model, payload)
    # A compiled predictor returns the same array every time.
    effort = np.array([predictor.step(*row).copy() for row in zip(q, qd, qdd, strict=True)])
    return effort if len(t) == len(reference.t) else _at(reference.t, t, effort)


def _at(t: FloatArray, known: FloatArray, rows: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(t, known, column) for column in rows.T])


def rate_of(model: RobotEstimator) -> float:
    """Return the sample rate that the model needs [Hz].

    The returned rate is the rate of the controller if the model works at any rate.
    """
    if isinstance(model, ResidualNetwork) and np.any(model.correction_.kept):
        return model.correction_.networks[0].rate_hz
    return RATE_HZ


BANDWIDTH_RAD_S = 20.0
DAMPING = 0.7

FULL_RAD = 0.35
"""Maximum deflection of the PD controller, which causes the full torque limit [rad].

Nominal inertias do not contain the rotors, which dominate the inertia of a wrist joint; therefore
the stiffness has a lower bound.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Spring:
    """PD controller: one spring and one damper per joint.

    Attributes:
        stiffness: (n,) [N·m/rad].
        damping: (n,) [N·m·s/rad].
    """

    stiffness: FloatArray
    damping: FloatArray

    def torque(self, error: FloatArray, rate: FloatArray) -> FloatArray:
        """Return the torque (n,) [N·m] for errors (n,) [rad] of the position and their rates."""
        return self.stiffness * error + self.damping * rate

    def firmer(self, factor: float) -> Spring:
        """Return the PD controller with its bandwidth multiplied by `factor`."""
        return Spring(self.stiffness * factor**2, self.damping * factor)


def spring_for(robot: RobotModel, q: FloatArray) -> Spring:
    """Return PD gains for the mean inertia of each joint over the poses `q` (N, n)."""
    inertia = np.diagonal(robot.mass_matrix(q), axis1=1, axis2=2).mean(axis=0)
    stiffness = np.maximum(inertia * BANDWIDTH_RAD_S**2, robot.effort_max / FULL_RAD)
    return Spring(stiffness, 2 * DAMPING * stiffness / BANDWIDTH_RAD_S)
