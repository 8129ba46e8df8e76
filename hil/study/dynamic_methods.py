"""The methods a study of dynamic identification sets side by side, and one fit of one of them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil import plugins
from hil.dynamics import RobotModel
from hil.errors import HilError
from hil.evaluate.metrics import mep, rmse
from hil.identify.base import GROUP, RobotEstimator, estimator
from hil.study.dynamic_data import MOVING, REVERSAL, Parts
from hil.typing import BoolArray, FloatArray

SHOWN = 250
"""Samples of a test trajectory that a figure shows."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way to predict joint torques.

    Attributes:
        key: In the spec.
        words: In tables.
        estimator: Name it is registered under.
        params: Of the estimator, beside those all share.
        smooth_sign: Whether it takes `sign_width`.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    smooth_sign: bool = True


METHODS = {
    method.key: method
    for method in (
        Method("ols", "least squares", "rigid-wls", {"weighted": False}),
        Method("wls", "Method 1: WLS", "rigid-wls"),
        Method("lmi", "Method 2: OLS, physical constraints", "rigid-lmi", {"weighted": False}),
        Method("lmi-weighted", "WLS, physical constraints", "rigid-lmi", {"weighted": True}),
        Method("irls", "Method 3: three loops of IRLS", "rigid-irls"),
        Method("ridge", "ridge", "rigid-linear", {"method": "ridge"}),
        Method("tls", "total least squares", "rigid-linear", {"method": "tls"}),
        Method("diffnea", "differentiable Newton–Euler", "rigid-diffnea"),
        Method("hysteresis", "ours: friction with memory", "rigid-hysteresis", {}, False),
    )
}
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
        shown: (SHOWN, n) predicted torque of the first test samples, for a figure.
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


def missing(method: Method) -> bool:
    """Whether no distribution installed here has the estimator."""
    return method.estimator not in plugins.names(GROUP)


def fit_and_score(method: Method, parts: Parts, robot: RobotModel, sign_width: float) -> Score:
    """Fit to the training part and judge on the test part; a failure is told, not raised."""
    shared = {"sign_width": sign_width} if method.smooth_sign else {}
    begin = time.process_time()
    try:
        model = estimator(method.estimator, **method.params, **shared).fit(parts.train, robot)
        return _scored(model, parts, time.process_time() - begin)
    except HilError as error:
        return _nothing(robot.n, error.message)
    # Estimators are plug-ins: one that breaks down must not cost what the others took.
    except Exception as error:
        return _nothing(robot.n, f"it broke down: {type(error).__name__}: {error}")


def _scored(model: RobotEstimator, parts: Parts, seconds: float) -> Score:
    test, scale = parts.test, model.torque_scale_
    predicted = model.predict(test)
    torque = np.where(predicted.valid, predicted.effort, np.nan) * scale
    filtered, raw = test["effort_f"] * scale, test["effort"] * scale
    known = np.isfinite(torque)
    trained = model.predict(parts.train).effort * scale
    return Score(
        filtered=_rmse_where(filtered, torque, known),
        raw=_rmse_where(raw, torque, known),
        moving=_rmse_where(filtered, torque, known & (test[MOVING] > 0)),
        reversal=_rmse_where(filtered, torque, known & (test[REVERSAL] > 0)),
        percent=_percent(filtered, torque, known),
        training=rmse(parts.train["effort_f"] * scale, trained),
        seconds=seconds,
        condition=float(getattr(model, "condition_", np.nan)),
        parameters=len(getattr(model, "coefficients_", ())),
        uncertain=_uncertain(model),
        shown=torque[:SHOWN],
    )


def _rmse_where(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
    found = [
        rmse(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def _percent(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
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
