"""The methods a study of dynamic identification sets side by side, and one fit of one of them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, HilError, IntArray, plugins
from hil.data import Dataset, FilterSettings, mep, rmse
from hil.dynamics import RobotModel
from hil.estimators import GROUP, RobotEstimator, estimator
from hil.studies.dynamic_data import MOVING, REVERSAL, Parts

SHOWN = 250
"""Samples a figure shows of the first test trajectory, spread evenly over it."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way to predict joint torques.

    Attributes:
        key: In the spec.
        words: In tables.
        estimator: Name it is registered under.
        params: Of the estimator, beside those all share.
        memory: Whether its friction follows the path: it needs whole motions and no smooth sign.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    memory: bool = False


AS_PUBLISHED: Mapping[str, Any] = {"filter_columns": False}
"""Friction columns are those of the filtered velocity."""

METHODS = {
    method.key: method
    for method in (
        Method("ols", "least squares", "rigid-wls", {"weighted": False}),
        Method("wls", "Method 1: WLS", "rigid-wls"),
        Method("lmi", "Method 2: OLS, physical constraints", "rigid-lmi", AS_PUBLISHED),
        Method(
            "lmi-weighted", "WLS, physical constraints", "rigid-lmi",
            {**AS_PUBLISHED, "weighted": True},
        ),
        Method("irls", "Method 3: three loops of IRLS", "rigid-irls", AS_PUBLISHED),
        Method("ridge", "ridge", "rigid-linear", {**AS_PUBLISHED, "method": "ridge"}),
        Method("tls", "total least squares", "rigid-linear", {**AS_PUBLISHED, "method": "tls"}),
        Method("diffnea", "differentiable Newton–Euler", "rigid-diffnea"),
        Method("hysteresis", "ours: friction with memory", "rigid-hysteresis", memory=True),
    )
}  # fmt: skip
METHOD_KEYS = tuple(METHODS)


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """One fit of one method, in N·m, per joint; NaN where there is nothing to judge.

    Attributes:
        filtered, raw: (n,) RMSE against the filtered and the measured effort.
        moving, reversal: (n,) RMSE against the filtered one, in those samples only.
        percent: (n,) largest error over largest torque (MEP), filtered.
        training: (n,) RMSE on the training samples, filtered.
        seconds: CPU time of the fit.
        condition: Of the column-scaled regressor; NaN where the method has none.
        parameters: How many it fits, 0 where it does not say.
        uncertain: Share of parameters not told from 0 by two standard errors; NaN without errors.
        shown: (·, n) predicted torque at `shown_rows`, for a figure.
        failed: Why there is nothing; empty when there is.
    """

    filtered: FloatArray
    raw: FloatArray
    moving: FloatArray
    reversal: FloatArray
    percent: FloatArray
    training: FloatArray
    seconds: float = 0.0
    condition: float = float("nan")
    parameters: int = 0
    uncertain: float = float("nan")
    shown: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    failed: str = ""


def shown_rows(test: Dataset) -> IntArray:
    """Numbers of the rows that a figure shows."""
    end = int(test.offsets[1])
    return np.unique(np.linspace(0, end - 1, min(SHOWN, end)).astype(np.int64))


def missing(method: Method) -> bool:
    """Whether no distribution installed here has the estimator."""
    return method.estimator not in plugins.names(GROUP)


def fit_and_score(
    method: Method, parts: Parts, robot: RobotModel, sign_width: float, filters: FilterSettings
) -> Score:
    """Fit to the training part and judge on the test part; a failure is told, not raised."""
    begin = time.process_time()
    try:
        model = unfitted(method, sign_width, filters).fit(parts.train, robot)
        return score(model, parts, time.process_time() - begin)
    except HilError as error:
        return _nothing(robot.n, error.message)
    # Estimators are plug-ins: one that breaks down must not cost what the others took.
    except Exception as error:
        return _nothing(robot.n, f"it broke down: {type(error).__name__}: {error}")


def unfitted(method: Method, sign_width: float, filters: FilterSettings) -> RobotEstimator:
    """The method's estimator with the parameters all share.

    Raises:
        PluginError, SpecError: There is no such estimator, or it takes other parameters.
    """
    shared: dict[str, Any] = {"filters": filters}
    if not method.memory:
        shared["sign_width"] = sign_width
    return estimator(method.estimator, **method.params, **shared)


def score(model: RobotEstimator, parts: Parts, seconds: float = 0.0) -> Score:
    """How a fitted model does on the test part.

    Args:
        model: Fitted to the training part.
        parts: With the columns `MOVING` and `REVERSAL`.
        seconds: CPU time the fit took.
    """
    test, scale = parts.test, model.torque_scale_
    predicted = model.predict(test)
    torque = np.where(predicted.valid, predicted.effort, np.nan) * scale
    filtered, raw = test["effort_f"] * scale, test["effort"] * scale
    known = np.isfinite(torque)
    trained = model.predict(parts.train).effort * scale
    return Score(
        filtered=rmse_where(filtered, torque, known),
        raw=rmse_where(raw, torque, known),
        moving=rmse_where(filtered, torque, known & (test[MOVING] > 0)),
        reversal=rmse_where(filtered, torque, known & (test[REVERSAL] > 0)),
        percent=percent_where(filtered, torque, known),
        training=rmse(parts.train["effort_f"] * scale, trained),
        seconds=seconds,
        condition=float(getattr(model, "condition_", np.nan)),
        parameters=len(getattr(model, "parameter_names_", ())),
        uncertain=_uncertain(model),
        shown=torque[shown_rows(test)],
    )


def rmse_where(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
    """(n,) RMSE of every joint over its rows of `where` (N, n); NaN where it has none."""
    found = [
        rmse(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def percent_where(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
    """(n,) largest error over largest torque (MEP) of every joint over its rows of `where`."""
    found = [
        mep(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def _uncertain(model: RobotEstimator) -> float:
    error = np.asarray(getattr(model, "std_error_", ()), dtype=np.float64)
    values = np.asarray(getattr(model, "coefficients_", ()), dtype=np.float64)
    told = np.isfinite(error) if error.shape == values.shape else np.zeros(0, dtype=bool)
    if not np.any(told):
        return float("nan")
    return float(np.mean(np.abs(values[told]) < 2.0 * error[told]))


def _nothing(n: int, failed: str) -> Score:
    empty = np.full(n, np.nan)
    return Score(empty, empty, empty, empty, empty, empty, failed=failed)
