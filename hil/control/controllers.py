"""What a controller of joints gives: a PD spring, and four laws ahead of any error.

The spring (`spring_for`) is made from what the maker publishes, so that all laws share it. The laws
(`feed_forwards`) reach from nothing to the whole model.
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
"""Laws for which nobody has to identify anything."""

TOLD = {
    NOTHING: "the PD controller alone",
    GRAVITY: "the model's gravity (and load, and offset) at the position wanted",
    NOMINAL: "rigid body with the maker's masses, without friction and rotors",
    MODEL: "everything the model says of the motion wanted: Predictor, friction and network",
}


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What the joints are to do, at `RATE_HZ`; the first second is at rest.

    Attributes:
        t: (N,) time from the beginning of the motion [s], negative before it.
        q, qd, qdd: (N, n) [rad, rad/s, rad/s²].
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


def feed_forwards(
    model: RobotEstimator, payload: Payload, reference: Reference, gains: FloatArray
) -> Iterator[tuple[str, FloatArray]]:
    """Every law's name and torque (N, n) [N·m] along the reference.

    Args:
        model: Fitted.
        payload: What is mounted.
        reference: N samples.
        gains: (n,) torque per current of the arm's controller [N·m/A].
    """
    per_effort = gains if model.effort_kind_ == "current" else np.ones_like(gains)
    yield NOTHING, np.zeros_like(reference.q)
    gravity = HandGuiding(model, payload, friction_share=0.0)
    still = np.zeros_like(gains)
    yield GRAVITY, np.array([gravity(q, still) for q in reference.q]) * per_effort
    yield NOMINAL, nominal(model.robot_, payload, reference)
    yield MODEL, predicted(model, payload, reference) * per_effort


def nominal(robot: RobotModel, payload: Payload, reference: Reference) -> FloatArray:
    """(N, n) torque [N·m] of the arm as its maker describes it."""
    loaded = as_made(robot, payload)
    return loaded.inverse_dynamics(reference.q, reference.qd, reference.qdd)


def as_made(robot: RobotModel, payload: Payload) -> RobotModel:
    """The arm as its maker describes it, with a load."""
    return robot if payload.is_empty else robot.with_payload(payload)


def predicted(model: RobotEstimator, payload: Payload, reference: Reference) -> FloatArray:
    """(N, n) effort of the whole model, in its unit.

    A network's memory counts samples: it is asked at the rate of its training, ahead of time,
    and its answers are joined by straight lines.
    """
    rate = rate_of(model)
    count = round((reference.t[-1] - reference.t[0]) * rate)
    t = reference.t[0] + np.arange(count + 1) / rate
    q, qd, qdd = (_at(t, reference.t, rows) for rows in (reference.q, reference.qd, reference.qdd))
    predictor = Predictor(model, payload)
    # A compiled predictor gives the same array every time.
    effort = np.array([predictor.step(*row).copy() for row in zip(q, qd, qdd, strict=True)])
    return effort if len(t) == len(reference.t) else _at(reference.t, t, effort)


def _at(t: FloatArray, known: FloatArray, rows: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(t, known, column) for column in rows.T])


def rate_of(model: RobotEstimator) -> float:
    """Samples per second that the model has to be asked at [Hz]; the controller's where any do."""
    if isinstance(model, ResidualNetwork) and np.any(model.correction_.kept):
        return model.correction_.networks[0].rate_hz
    return RATE_HZ


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
