"""Friction in held-out data: the measured effort less what a model says is no friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.data.dataset import Dataset
from hil.data.dwells import series_means
from hil.data.prediction import Model, Prediction
from hil.report.fit_facts import HONEST
from hil.typing import FloatArray, IntArray

PART = "friction"
"""Of a prediction."""

NEAR_ZERO = 0.05
"""Up to this speed [rad/s] curves are drawn finely: friction turns there."""


@dataclass(frozen=True, slots=True, eq=False)
class AtRest:
    """Friction of held-out dwells.

    Attributes:
        q: (D, n) where [rad].
        measured: (D, n) mean effort less the model's gravity, offset and load.
        predicted: (D, n) friction of the model; None where it knows none at rest.
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
        torque, dry, std_error: See `hil.identify.friction_curve`.
    """

    qd: FloatArray
    torque: FloatArray
    dry: FloatArray
    std_error: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class InMotion:
    """Friction along held-out trajectories, rows the model calls valid.

    Attributes:
        qd: (N, n) [rad/s].
        measured: (N, n) effort less the model's gravity, inertia and load.
        predicted: (N, n) friction of the model.
        law: The same as a curve; None where it depends on more than velocity.
    """

    qd: FloatArray
    measured: FloatArray
    predicted: FloatArray
    law: Law | None


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
    from hil.identify.base import RobotEstimator
    from hil.identify.standstill import knows_torque

    if isinstance(model, RobotEstimator) and knows_torque(model):
        return model.torque_scale_, "N·m"
    return np.ones(1), "A"


def at_rest(model: Model, data: Dataset, prediction: Prediction) -> AtRest | None:
    """Friction of dwells; None when no approach is known, or the target was among the inputs."""
    approach = np.array([c.approach for c in data.conditions], dtype=np.int64)
    if not approach.any() or getattr(model, "protocol", HONEST) != HONEST:
        return None
    scale, _ = scale_of(model)
    told = prediction.components.get(PART)
    rest = prediction.effort if told is None else prediction.effort - told
    return AtRest(
        q=series_means(data, data["q"]),
        measured=series_means(data, data["effort"] - rest) * scale,
        predicted=None if told is None else series_means(data, told) * scale,
        approach=approach,
        pose=np.array([c.pose for c in data.conditions], dtype=np.int64),
    )


def in_motion(
    model: Model, data: Dataset, prediction: Prediction, qd: FloatArray
) -> InMotion | None:
    """Friction along trajectories; None when the model does not tell it, or is for arms at rest."""
    told = prediction.components.get(PART)
    if told is None or getattr(model, "protocol", HONEST) != HONEST:
        return None
    known = prediction.valid & np.isfinite(told)
    if not (known & (np.abs(told) > 0)).any():
        return None
    scale, _ = scale_of(model)
    measured = data["effort"] - prediction.effort + told
    predicted = np.where(known, told * scale, np.nan)
    return InMotion(qd, np.where(known, measured * scale, np.nan), predicted, _law(model, qd))


def _law(model: Model, qd: FloatArray) -> Law | None:
    from hil.identify.friction_curve import HasFrictionCurve

    if not isinstance(model, HasFrictionCurve):
        return None
    low, high = np.nanmin(qd, axis=0), np.nanmax(qd, axis=0)
    places = np.linspace(low, high, 161)
    near = np.linspace(-NEAR_ZERO, NEAR_ZERO, 41)[:, None] + np.zeros(qd.shape[1])
    places = np.sort(np.vstack([places, np.clip(near, low, high)]), axis=0)
    curve = model.friction_curve(places)
    return None if curve is None else Law(places, curve.torque, curve.dry, curve.std_error)
