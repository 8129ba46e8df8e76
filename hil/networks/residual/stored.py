"""A base model: whether it fits the data, and how it lies in the file of the model built on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.core import DataError, FitError, FloatArray, SpecError
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator, estimator, require_sound, with_prefix, without_prefix

BASE = "base."
"""Arrays of the base model begin with it."""


def made(base: dict[str, Any]) -> RobotEstimator:
    """A fresh base estimator from its name and parameters.

    Raises:
        PluginError: There is no estimator of that name.
        SpecError: It is not named, has no such parameter, or does not accept the value.
    """
    if not isinstance(base.get("estimator"), str):
        raise SpecError(
            f"base is {base!r:.60}, but must name the physics with `estimator`",
            hint="base: {estimator: rigid-hysteresis}",
        )
    params = {name: value for name, value in base.items() if name != "estimator"}
    return estimator(base["estimator"], **params)


def require_base(model: RobotEstimator, dataset: Dataset, robot: RobotModel) -> None:
    """Refuse a fitted model that cannot be the physics of these data.

    Raises:
        FitError: It is not fitted, or is of another robot, unit or gravity.
    """
    try:
        model.require_match(dataset)
    except DataError as error:
        raise FitError(f"base: {error.message}", hint=error.hint) from error
    if model.robot_.name != robot.name:
        raise FitError(
            f"base was fitted for the robot model {model.robot_.name}, not for {robot.name}",
            hint="correct a model of the same robot",
        )


def told(model: RobotEstimator) -> dict[str, Any]:
    """Name and parameters of a model, from which `made` makes another like it."""
    return {"estimator": model.estimator, **model.get_params()}


def arrays_of_base(model: RobotEstimator) -> dict[str, FloatArray]:
    """What the base model found, under names of its own."""
    return with_prefix(BASE, model.fitted_arrays())


def facts_of_base(model: RobotEstimator) -> dict[str, Any]:
    """The base model's part of `model.json`."""
    return {
        "estimator": model.estimator,
        "parameters": model.get_params(),
        "fitted": model.fitted_facts(),
    }


def restored_base(
    arrays: dict[str, FloatArray], facts: dict[str, Any], robot: RobotModel
) -> RobotEstimator:
    """Inverse of `arrays_of_base` and `facts_of_base`.

    Raises:
        KeyError, TypeError, ValueError: Something is missing or garbled.
    """
    model = estimator(str(facts["estimator"]), **facts["parameters"])
    model.robot_ = robot
    own = without_prefix(BASE, arrays)
    require_finite_arrays(own)
    model.restore(own, facts["fitted"])
    require_sound(model)
    return model


def require_finite_arrays(arrays: dict[str, FloatArray]) -> None:
    """Refuse numbers that are none before a prediction is made of them.

    Raises:
        ValueError: An array holds one.
    """
    for name, values in arrays.items():
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{name}: it holds values that are not finite")
