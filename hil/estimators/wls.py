"""Models that are linear in their parameters, solved jointwise: OLS, then joints weighted."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import Dataset, Prediction, Stream
from hil.estimators.base import RobotEstimator, chunks, payload_torque
from hil.estimators.checks import require_rank
from hil.estimators.covariance import correlated_samples
from hil.estimators.least_squares import JointwiseQR, Solution, jointwise_least_squares
from hil.estimators.stream import MemorylessStream

STD_ERROR_GIVEN = (
    "exact drive gains, declared loads, kinematics and form of the model; the residual's "
    "autocorrelation within a series is accounted for"
)
STD_ERROR_LEAVES_OUT = (
    "errors of the gains (they scale a joint's parameters as a whole), loads and kinematics; "
    "friction of another form; bias by noise in the regressor and by filters, which smear "
    "reversals; what all series have in common, such as temperature; correlation between joints"
)


class WlsEstimator(RobotEstimator):
    """A regressor in the torque domain times coefficients.

    Attributes:
        parameter_names_: Length p.
        coefficients_: (p,) in SI.
        std_error_: (p,) standard errors, see `STD_ERROR_GIVEN` and `STD_ERROR_LEAVES_OUT`.
        correlated_samples_: (n,) how many successive samples of a joint count as one in
            `std_error_`, 1 for independent ones; see `hil.estimators.covariance`.
        condition_: Condition number of the column-scaled, weighted regressor.
    """

    parameter_names_: tuple[str, ...]
    coefficients_: FloatArray
    std_error_: FloatArray
    correlated_samples_: FloatArray
    condition_: float

    @abstractmethod
    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        """Named parts of the effort without payload, each (N, n)."""

    @abstractmethod
    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Rows of the data, W (N·n, p) sample-major and the target torque (N, n), in order."""

    @abstractmethod
    def _open(self) -> None:
        """Set up the regressor for `robot_`; also called when a model file is read."""

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time; it has no memory, so samples stand alone."""
        return MemorylessStream(self.robot_.n, self._parts, self._load_effort, payload or Payload())

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Coefficients, their errors, gains and residual deviations."""
        return {
            "coefficients": self.coefficients_,
            "std_error": self.std_error_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Parameter names, how well they were excited, and what their errors mean."""
        return super().fitted_facts() | {
            "parameter_names": list(self.parameter_names_),
            "condition": self.condition_,
            "std_error": {
                "given": STD_ERROR_GIVEN,
                "leaves_out": STD_ERROR_LEAVES_OUT,
                "correlated_samples": self.correlated_samples_,
            },
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        self._restore_common(arrays, facts)
        self._open()
        self.coefficients_, self.std_error_ = arrays["coefficients"], arrays["std_error"]
        self.parameter_names_ = tuple(facts["parameter_names"])
        if not len(self.coefficients_) == len(self.std_error_) == len(self.parameter_names_):
            raise ValueError(
                f"coefficients: {len(self.coefficients_)} for {len(self.parameter_names_)} names"
            )
        self.condition_ = float(facts["condition"])
        # Older model files took every sample for independent.
        counted = facts.get("std_error", {}).get("correlated_samples", [1.0] * len(self.sigma_))
        self.correlated_samples_ = np.array(counted, dtype=np.float64)

    def _solve(self, data: Dataset, *, weighted: bool) -> None:
        """Fit to the observations, whose target is a torque; sets the fitted attributes."""
        self._adopt(data, jointwise_least_squares(self._compressed(data), weighted=weighted))

    def _compressed(self, data: Dataset) -> JointwiseQR:
        """All observations, one triangle per joint."""
        observed = JointwiseQR(data.n_joints)
        for _, W, target in self._observations(data):
            observed.add(W, target)
        return observed

    def _adopt(self, data: Dataset, found: Solution) -> None:
        """Take over a solution; sets the fitted attributes."""
        require_rank(found.rank, found.condition, self.parameter_names_, found.system[0])
        self.coefficients_, self.condition_ = found.coefficients, found.condition
        self.sigma_ = found.sigma / self.torque_scale_
        self._tell_uncertainty(data, found)

    def _tell_uncertainty(self, data: Dataset, found: Solution) -> None:
        """Set `correlated_samples_` and `std_error_`."""
        residual = self._residual(data, found.coefficients)
        self.correlated_samples_ = correlated_samples(residual, data.offsets)
        # (XᵀWX)⁻¹ XᵀW·V·WX (XᵀWX)⁻¹ with V the variance of a joint times its correlation time.
        X, _, joint = found.system
        deviation = found.sigma * np.sqrt(self.correlated_samples_)
        score = X * (found.weight * deviation)[joint, None]
        self.std_error_ = np.linalg.norm(score @ found.bread, axis=0)

    def _residual(self, data: Dataset, coefficients: FloatArray) -> FloatArray:
        """(N, n) target less regressor times coefficients (p,)."""
        residual = np.empty_like(data["q"])
        for rows, W, target in self._observations(data):
            residual[rows] = target - (W @ coefficients).reshape(target.shape)
        return residual

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
