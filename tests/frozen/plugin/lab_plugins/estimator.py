"""An estimator that is wrong for every real arm: each joint's torque by the cosine of its angle."""

from __future__ import annotations

from typing import Any, ClassVar, Self

import numpy as np

from hil.core import FitError
from hil.data import Dataset, Prediction, Stream
from hil.estimators import RobotEstimator


class LabGravity(RobotEstimator):
    """Least squares of effort on 1 and cos q, joint by joint.

    Args:
        shrink: Factor on what was fitted, such as 1.
    """

    estimator: ClassVar[str] = "lab-gravity"
    series_kinds: ClassVar[Any] = (("dwell",), ("trajectory",))
    tells_friction: ClassVar[bool] = False

    def __init__(self, *, shrink: float = 1.0) -> None:
        self.shrink = shrink

    def fit(self, dataset: Dataset, robot: Any) -> Self:
        if len(dataset) < 2:
            raise FitError("one sample is too few", hint="record a longer program")
        effort, q = dataset["effort"], dataset["q"]
        self._remember(dataset, robot, np.ones(effort.shape[1]))
        self.coefficients_ = np.empty((2, effort.shape[1]))
        for joint in range(effort.shape[1]):
            columns = np.column_stack([np.ones(len(q)), np.cos(q[:, joint])])
            self.coefficients_[:, joint] = np.linalg.lstsq(columns, effort[:, joint])[0]
        self.samples_ = len(dataset)
        self.sigma_ = (effort - self._effort(q)).std(axis=0)
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        self.require_match(dataset)
        effort = self._effort(dataset["q"])
        unknown = np.full_like(effort, np.nan)
        return Prediction(effort, unknown, np.ones(effort.shape, bool), {"gravity": effort})

    def stream(self, payload: Any = None) -> Stream:
        model = self

        class One:
            def step(self, q: Any, qd: Any, qdd: Any) -> Any:
                return model._effort(q)

        return One()

    def fitted_arrays(self) -> dict[str, Any]:
        return {
            "coefficients": self.coefficients_,
            "sigma": self.sigma_,
            "torque_scale": self.torque_scale_,
        }

    def restore(self, arrays: dict[str, Any], facts: dict[str, Any]) -> None:
        self._restore_common(arrays, facts)
        self.coefficients_ = arrays["coefficients"]

    def _effort(self, q: Any) -> Any:
        return self.shrink * (self.coefficients_[0] + self.coefficients_[1] * np.cos(q))
