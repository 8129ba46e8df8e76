"""Models that are linear in their parameters, solved jointwise: OLS, then joints weighted."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from hil.data.dataset import Dataset
from hil.data.prediction import Prediction, Stream
from hil.identify.base import RobotEstimator, chunks, payload_torque
from hil.identify.checks import require_rank
from hil.identify.compress import JointwiseQR
from hil.identify.stream import MemorylessStream
from hil.payload import Payload
from hil.typing import FloatArray


class WlsEstimator(RobotEstimator):
    """A regressor in the torque domain times coefficients.

    Attributes:
        parameter_names_: Length p.
        coefficients_: (p,) in SI.
        std_error_: (p,) standard errors from the variance of the residual. Errors of neighbouring
            samples are correlated, so with trajectories the true ones are larger.
        condition_: Condition number of the column-scaled, weighted regressor.
    """

    parameter_names_: tuple[str, ...]
    coefficients_: FloatArray
    std_error_: FloatArray
    condition_: float

    @abstractmethod
    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        """Named parts of the effort without payload, each (N, n)."""

    @abstractmethod
    def _open(self) -> None:
        """Set up the regressor for `robot_`; also called when a model file is read."""

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time; it has no memory, so samples stand alone."""
        return MemorylessStream(self._parts, self._load_effort, payload or Payload())

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Coefficients, their errors, gains and residual deviations."""
        return {
            "coefficients": self.coefficients_,
            "std_error": self.std_error_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Parameter names and how well they were excited."""
        names, condition = list(self.parameter_names_), self.condition_
        return super().fitted_facts() | {"parameter_names": names, "condition": condition}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        self._restore_common(arrays, facts)
        self._open()
        self.coefficients_, self.std_error_ = arrays["coefficients"], arrays["std_error"]
        self.parameter_names_ = tuple(facts["parameter_names"])
        self.condition_ = float(facts["condition"])

    def _solve(self, observed: JointwiseQR, *, weighted: bool) -> None:
        """Fit to the observations, whose target is a torque; sets the fitted attributes."""
        from hil.identify.linear import WeightedLeastSquares

        X, y, joint = observed.system()
        solver = WeightedLeastSquares().fit(X, y)
        sigma = observed.residual_std(solver.coef_)
        if weighted:
            # Noise-free data would weight by 1/0.
            floor = 1e-12 * float(np.max(np.abs(y)))
            solver.fit(X, y, sample_weight=1.0 / np.maximum(sigma, floor)[joint] ** 2)
            sigma = observed.residual_std(solver.coef_)
        require_rank(solver.rank_, solver.condition_, self.parameter_names_, X)
        self.coefficients_, self.condition_ = solver.coef_, float(solver.condition_)
        self.sigma_ = sigma / self.torque_scale_
        variance = 1.0 if weighted else float(np.mean(sigma**2))
        self.std_error_ = np.sqrt(variance * np.diag(solver.unscaled_covariance_))

    def _predict(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> Prediction:
        parts = self._all_parts(dataset, q, qd, qdd)
        load = payload_torque(self.robot_, dataset, q, qd, qdd) / self.torque_scale_
        effort: FloatArray = np.sum([*parts.values(), load], axis=0)
        std = np.broadcast_to(self.sigma_, effort.shape)
        return Prediction(effort, std, np.isfinite(effort), {**parts, "payload": load})

    def _all_parts(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> dict[str, FloatArray]:
        found = [self._parts(q[rows], qd[rows], qdd[rows]) for rows in chunks(dataset)]
        names = found[0] if found else ()
        return {name: np.concatenate([part[name] for part in found]) for name in names}

    def _load_effort(
        self, load: Payload, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        effort: FloatArray = self.robot_.payload_effort(load, q, qd, qdd) / self.torque_scale_
        return effort
