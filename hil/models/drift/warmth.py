"""What warmth does to friction, by a model's own law: what a probe must not call a change."""

from __future__ import annotations

import numpy as np

from hil.core import DataError, FloatArray
from hil.data import Dataset
from hil.estimators import RobotEstimator


def friction_change(
    model: RobotEstimator, data: Dataset, before: FloatArray, after: FloatArray
) -> FloatArray:
    """Change of each joint's friction over the same motion at another temperature.

    Args:
        model: Has a friction part.
        data: The motion.
        before: (n,) joint temperatures [°C].
        after: (n,) the same later.

    Returns:
        (n,) change of the friction's RMS as a share of what it was; 0 for a model that knows
        nothing of temperature.

    Raises:
        DataError: The model does not say which part of its prediction is friction.
    """
    cold, warm = (_rms(model, data, celsius) for celsius in (before, after))
    return warm / np.maximum(cold, np.finfo(np.float64).tiny) - 1.0


def _rms(model: RobotEstimator, data: Dataset, celsius: FloatArray) -> FloatArray:
    at = data.with_columns(temperature=np.broadcast_to(celsius, data["q"].shape).copy())
    prediction = model.predict(at)
    if "friction" not in prediction.components:
        raise DataError(
            f"{model.estimator} does not say which part of its prediction is friction",
            hint="take a model whose estimator tells friction apart, such as rigid-hysteresis",
        )
    friction = prediction.components["friction"][np.all(prediction.valid, axis=1)]
    found: FloatArray = np.sqrt(np.mean(friction**2, axis=0))
    return found
