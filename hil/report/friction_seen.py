"""Friction in held-out data: the measured effort less what a model says is no friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Dataset, Model, Prediction, series_means
from hil.estimators import HasFrictionCurve, RobotEstimator, knows_torque
from hil.report.fit_facts import HONEST

PART, LEARNED = "friction", "residual"
"""Of a prediction. What a network adds to the physics is friction that the physics misses, or what
else it misses: taken away from the measured effort, it would hide just that friction."""

NEAR_ZERO = 0.05
"""Up to this speed [rad/s] curves are drawn finely: friction turns there."""


@dataclass(frozen=True, slots=True, eq=False)
class AtRest:
    """Friction of held-out dwells: means over the rows the model is valid in, NaN without any.

    Attributes:
        q: (D, n) where [rad].
        measured: (D, n) mean effort less the model's gravity, offset and load.
        predicted: (D, n) friction of the model, with what its network adds; None where it knows
            none at rest.
        approach, pose: (D,) +1, −1 or 0; pose numbers.
    """

    q: FloatArray
    measured: FloatArray
    predicted: FloatArray | None
    approach: IntArray
    pose: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """Friction as a function of velocity, over the velocities of the data; all arrays (M, n).

    Attributes:
        qd: Velocities of each joint, rising [rad/s].
        torque, dry, std_error, terms: See `hil.estimators.friction_curve`.
    """

    qd: FloatArray
    torque: FloatArray
    dry: FloatArray
    std_error: FloatArray
    terms: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class InMotion:
    """Friction along held-out trajectories, rows the model calls valid.

    Attributes:
        qd: (N, n) [rad/s].
        measured: (N, n) effort less the model's gravity, inertia and load.
        predicted: (N, n) friction of the model, with what its network adds.
        law: The same as a curve; None where the model gives none.
        learned: Whether a network adds something.
    """

    qd: FloatArray
    measured: FloatArray
    predicted: FloatArray
    law: Law | None
    learned: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Friction:
    """What is known of a model's friction; either part may be missing.

    Attributes:
        unit: `N·m`, or `A` where nobody knows the drive gains.
        at_rest, in_motion: In that unit.
    """

    unit: str
    at_rest: AtRest | None = None
    in_motion: InMotion | None = None


def scale_of(model: Model) -> tuple[FloatArray, str]:
    """What turns efforts of a model into its friction's unit, (n,) or (1,), and that unit."""
    if isinstance(model, RobotEstimator) and knows_torque(model):
        return model.torque_scale_, "N·m"
    return np.ones(1), "A"


def at_rest(model: Model, data: Dataset, prediction: Prediction) -> AtRest | None:
    """Friction of dwells; None when no approach is known, or the target was among the inputs.

    None, too, where the model is valid nowhere.
    """
    approach = np.array([c.approach for c in data.conditions], dtype=np.int64)
    if not approach.any() or getattr(model, "protocol", HONEST) != HONEST:
        return None
    if not prediction.valid.any():
        return None
    scale, _ = scale_of(model)
    told = _told(prediction)
    knows = PART in prediction.components
    return AtRest(
        q=series_means(data, data["q"]),
        measured=_means(data, data["effort"] - prediction.effort + told, prediction.valid) * scale,
        predicted=_means(data, told, prediction.valid) * scale if knows else None,
        approach=approach,
        pose=np.array([c.pose for c in data.conditions], dtype=np.int64),
    )


def _means(data: Dataset, values: FloatArray, valid: BoolArray) -> FloatArray:
    """(D, n) mean of values (N, n) over the valid rows of each dwell; NaN without any."""
    share = series_means(data, valid.astype(np.float64))
    sums = series_means(data, np.where(valid, values, 0.0))
    return np.divide(sums, share, out=np.full_like(sums, np.nan), where=share > 0)


def in_motion(
    model: Model, data: Dataset, prediction: Prediction, qd: FloatArray
) -> InMotion | None:
    """Friction along trajectories; None when the model does not tell it, or is for arms at rest."""
    friction = prediction.components.get(PART)
    if friction is None or getattr(model, "protocol", HONEST) != HONEST:
        return None
    told = _told(prediction)
    known = prediction.valid & np.isfinite(told)
    if not (known & (np.abs(friction) > 0)).any():
        return None
    learned = bool(np.any(known & (told != friction)))
    scale, _ = scale_of(model)
    measured = data["effort"] - prediction.effort + told
    predicted = np.where(known, told * scale, np.nan)
    law = None if learned else _law(model, np.where(known, qd, np.nan))
    return InMotion(qd, np.where(known, measured * scale, np.nan), predicted, law, learned)


def _told(prediction: Prediction) -> FloatArray:
    """(N, n) what may be friction, in the unit of the effort; 0 where the model tells none."""
    parts = [
        prediction.components[name] for name in (PART, LEARNED) if name in prediction.components
    ]
    told: FloatArray = np.sum([np.zeros_like(prediction.effort), *parts], axis=0)
    return told


def _law(model: Model, qd: FloatArray) -> Law | None:
    if not isinstance(model, HasFrictionCurve):
        return None
    good = np.isfinite(qd)
    low = np.min(qd, axis=0, where=good, initial=np.inf)
    high = np.max(qd, axis=0, where=good, initial=-np.inf)
    low, high = (np.where(good.any(axis=0), edge, np.nan) for edge in (low, high))
    places = np.linspace(low, high, 161)
    near = np.linspace(-NEAR_ZERO, NEAR_ZERO, 41)[:, None] + np.zeros(qd.shape[1])
    places = np.sort(np.vstack([places, np.clip(near, low, high)]), axis=0)
    curve = model.friction_curve(places)
    if curve is None:
        return None
    return Law(places, curve.torque, curve.dry, curve.std_error, curve.terms)
