"""The linear methods beside Method 1: OLS, WLS, ridge and total least squares on equal terms.

All see the same filters, the same smooth sign and, but for `ols`, joints weighted by the reciprocal
variance of their residual.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, SpecError
from hil.data import Conditions, Dataset, FilterSettings, Group, group_of
from hil.estimators.least_squares import (
    JointwiseQR,
    Solution,
    jointwise_least_squares,
    left_out_ridge,
    ridge,
    rough,
    total_least_squares,
)
from hil.estimators.parameters import choice, number
from hil.estimators.rigid_classical import Covariance, RigidClassical
from hil.estimators.rigid_linear import TERMS

Method = Literal["ols", "wls", "ridge", "tls"]
METHODS = ("ols", "wls", "ridge", "tls")

KNOWN_EXACTLY = 1e-9
"""Noise below this share of a column's mean square root counts as none."""


class RigidLeastSquares(RigidClassical):
    """Base rigid-body parameters and Coulomb–viscous friction by a linear method.

    Args:
        method: `ols`, `wls`, `ridge` or `tls`.
        alpha: Penalty of `ridge` as a share of each column's sum of squares; by default the one
            that predicts best a trajectory left out of the training.
        sign_width: Width of the tanh that stands for sign(qd) [rad/s]; 0 for the hard sign.
        filter_columns: Run the friction columns through the filter of the effort.
        covariance: What standard errors allow for, `hac` or `clustered`.
        filters: Preprocessing of training and prediction alike, a `FilterSettings` or its dict.

    Attributes:
        covariance_, std_error_: NaN for `ridge` and `tls`.
        alpha_: Penalty of `ridge`; 0 for the others.
        gap_: How far `tls` is from ill-posed, see `hil.estimators.least_squares`; else inf.
    """

    estimator: ClassVar[str] = "rigid-linear"
    alpha_: float
    gap_: float

    def __init__(
        self,
        *,
        method: Method = "wls",
        alpha: float | None = None,
        sign_width: float = 0.01,
        filter_columns: bool = True,
        covariance: Covariance = "hac",
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        super().__init__(
            sign_width=sign_width,
            filter_columns=filter_columns,
            covariance=covariance,
            filters=filters,
        )
        self.method = choice("method", method, METHODS)
        self.alpha = None if alpha is None else number("alpha", alpha, at_least=0.0)
        if alpha is not None and method != "ridge":
            raise SpecError(
                f"alpha belongs to method ridge, not to {method}",
                hint="leave alpha out, or set method: ridge",
            )

    @property
    def certain(self) -> bool:  # type: ignore[override]
        """A penalty pulls, and noise in columns biases, by more than any scatter tells."""
        return self.method in ("ols", "wls")

    def fitted_facts(self) -> dict[str, Any]:
        """Those of every classical method, with what the method found."""
        found = {"ridge": {"alpha": self.alpha_}, "tls": {"gap": self.gap_}}
        return super().fitted_facts() | found.get(self.method, {})

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.alpha_ = float(facts.get("alpha", 0.0))
        self.gap_ = float(facts.get("gap") or np.inf)

    def _tell_uncertainty(self, data: Dataset, found: Solution) -> None:
        super()._tell_uncertainty(data, found)
        if not self.certain:
            self.std_error_ = np.full_like(self.std_error_, np.nan)

    def _learn(self, data: Dataset) -> None:
        self.alpha_, self.gap_ = 0.0, float("inf")
        self._parts_of = self._by_trajectory(data) if self._needs_parts else []
        self._noise = self._noise_of(data) if self.method == "tls" else None
        super()._learn(data)
        del self._parts_of, self._noise

    @property
    def _needs_parts(self) -> bool:
        return self.method == "ridge" and self.alpha is None

    def _estimate(self, observed: JointwiseQR) -> Solution:
        found = jointwise_least_squares(observed, weighted=self.method != "ols")
        if self.method not in ("ridge", "tls"):
            return found
        X, y = found.weighted_system()
        if self.method == "tls":
            coefficients = self._total(found, X, y)
        elif self.alpha is not None:
            self.alpha_ = self.alpha
            coefficients = ridge(X, y, self.alpha, self._penalised(X.shape[1]))
        else:
            coefficients = self._left_out(found)
        sigma = observed.residual_std(coefficients)
        return replace(found, coefficients=coefficients, sigma=sigma)

    def _left_out(self, found: Solution) -> FloatArray:
        parts = []
        for part in self._parts_of:
            X, y, joint = part.system()
            root = np.sqrt(found.weight)[joint]
            parts.append((X * root[:, None], y * root))
        best = left_out_ridge(parts, self._penalised(parts[0][0].shape[1]))
        self.alpha_ = best.alpha
        return best.coefficients

    def _total(self, found: Solution, X: FloatArray, y: FloatArray) -> FloatArray:
        assert self._noise is not None
        # (n, p + 1) noise per joint, as it is in weighted rows, pooled over the joints.
        noise = np.sqrt(np.mean(found.weight[:, None] * self._noise**2, axis=0))
        columns, target = noise[:-1], float(noise[-1])
        # Rows of the compressed system are worth many samples each; only ratios matter.
        exact = columns <= KNOWN_EXACTLY * np.linalg.norm(X, axis=0)
        best = total_least_squares(X, y, columns, target, exact)
        self.gap_ = best.gap
        self.notes_ = (best.note,) if best.note else ()
        return best.coefficients

    def _penalised(self, p: int) -> BoolArray:
        """(p,) all but the offsets."""
        keep = np.ones(p, dtype=bool)
        offsets = p - len(TERMS) * len(self.joint_names_) + TERMS.index("offset")
        keep[offsets :: len(TERMS)] = False
        return keep

    def _noise_of(self, data: Dataset) -> FloatArray:
        """(n, p + 1) standard deviation of the noise on each joint's columns and target."""
        n = data.n_joints
        squares, count = np.zeros((n, len(self.parameter_names_) + 1)), 0
        series = data.series_index()
        for rows, W, target in self._observations(data):
            cube = np.concatenate([W.reshape(*target.shape, -1), target[:, :, None]], axis=2)
            for number_ in np.unique(series[rows]):
                own = cube[series[rows] == number_]
                squares += len(own) * np.stack([rough(own[:, j]) ** 2 for j in range(n)])
                count += len(own)
        return np.sqrt(squares / max(count, 1))

    def _by_trajectory(self, data: Dataset) -> list[JointwiseQR]:
        """The observations of every trajectory by itself."""
        groups = dict.fromkeys(group_of(condition, "trajectory") for condition in data.conditions)
        if len(groups) < 2:
            raise FitError(
                "ridge chooses alpha by leaving trajectories out, and there is only one",
                hint="give alpha, or more trajectories",
            )
        return [self._compressed(data.select(partial(_belongs, group))) for group in groups]


def _belongs(group: Group | None, condition: Conditions) -> bool:
    return group_of(condition, "trajectory") == group
