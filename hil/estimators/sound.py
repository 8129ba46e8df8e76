"""Whether a model that was read from a file can predict at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hil.estimators.base import RobotEstimator

PREDICTING = frozenset({"coefficients", "rigid", "gear_rigid", "friction", "inertial", "exponent"})
"""Arrays of models that predictions come from: never without a number."""


def text(value: object) -> str:
    """A text as it is.

    Raises:
        TypeError: It is none.
    """
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.60} is no text")
    return value


def require_sound(model: RobotEstimator) -> None:
    """Refuse names and units that are none before a prediction stumbles over them.

    Raises:
        TypeError, ValueError: Something fitted cannot be; the message names it.
    """
    names = [text(name) for name in model.joint_names_]
    if not np.shape(model.sigma_) == np.shape(model.torque_scale_) == (len(names),):
        raise ValueError(f"joint_names: {len(names)} for {np.size(model.sigma_)} joints")
    if not (np.all(np.isfinite(model.torque_scale_)) and np.all(model.torque_scale_ > 0)):
        raise ValueError(f"torque_scale: {model.torque_scale_.tolist()!s:.60}")
    # A deviation that is not known is NaN.
    if np.any(np.isinf(model.sigma_) | (model.sigma_ < 0)):
        raise ValueError(f"sigma: {model.sigma_.tolist()!s:.60}")
    for name, values in model.fitted_arrays().items():
        if name in PREDICTING and not np.all(np.isfinite(values)):
            raise ValueError(f"{name}: it holds values that are not finite")
    if model.effort_kind_ not in ("current", "torque"):
        raise ValueError(f"effort_kind: {model.effort_kind_!r:.60}")
