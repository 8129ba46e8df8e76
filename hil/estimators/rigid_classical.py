"""What the classical methods have in common beyond a linear model: honest standard errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np

from hil.core import FitError, FloatArray, IntArray
from hil.data import Dataset, FilterSettings, downsample, filter_columns
from hil.dynamics import BaseParameters
from hil.estimators.base import prepared
from hil.estimators.condition_report import condition_report
from hil.estimators.covariance import (
    Scores,
    correlated_samples,
    hac_covariance,
    hac_window,
    interval,
    trajectory_covariance,
)
from hil.estimators.essential import essential_parameters
from hil.estimators.friction_curve import FrictionCurve
from hil.estimators.least_squares import Solution
from hil.estimators.parameters import choice, flag
from hil.estimators.rigid_linear import RigidLinear

Covariance = Literal["hac", "clustered"]
COVARIANCES = ("hac", "clustered")

FILTERED = "filtered "
"""Columns of a dataset: friction terms, filtered before rows are left out."""

MEANING = {
    "hac": "Newey and West's covariance, over lags up to ten correlation times of the residual and "
    "between joints",
    "clustered": "clustered by trajectory, corrected for few of them (CR2, Satterthwaite's t)",
}


class RigidClassical(RigidLinear):
    """Base of `rigid-linear`, `rigid-lmi` and `rigid-irls`.

    Args:
        sign_width: Width of the tanh that stands for sign(qd) [rad/s]; 0 for the hard sign.
        filter_columns: Run the friction columns through the filter of the effort.
        covariance: What standard errors allow for, `hac` or `clustered`.
        filters: Preprocessing of training and prediction alike, a `FilterSettings` or its dict.

    Attributes:
        covariance_: (p, p) of the coefficients; NaN where a method tells none.
        degrees_: (p,) degrees of freedom of Student's t for intervals.
        excitation_: Condition numbers, the worst determined directions and, where the method is
            least squares, how many parameters are essential.
    """

    certain: ClassVar[bool] = True
    """Whether the covariance of least squares is that of the method."""

    bends: ClassVar[bool] = False
    """Whether the fit changes the form of its friction columns, so that they cannot be kept."""

    covariance_: FloatArray
    degrees_: FloatArray
    excitation_: dict[str, Any]

    def __init__(
        self,
        *,
        sign_width: float = 0.01,
        filter_columns: bool = True,
        covariance: Covariance = "hac",
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sign_width=sign_width, filters=filters)
        self.filter_columns = flag("filter_columns", filter_columns)
        self.covariance = choice("covariance", covariance, COVARIANCES)

    @property
    def base(self) -> BaseParameters:
        """The base parameters, in the order of the first coefficients."""
        return self._base

    def interval(self, level: float = 0.95) -> FloatArray:
        """(p, 2) ends between which a coefficient lies with probability `level`."""
        return interval(self.coefficients_, self.std_error_, self.degrees_, level)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Friction at velocities (N, n) [rad/s]; its standard error NaN unless `certain`."""
        curve = super().friction_curve(qd)
        if curve is None or self.certain:
            return curve
        # Bounds, penalties and exponents move coefficients by more than least squares tells.
        return replace(curve, std_error=np.full_like(curve.torque, np.nan))

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of every linear model, with the whole covariance."""
        return super().fitted_arrays() | {
            "covariance": self.covariance_,
            "degrees": self.degrees_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Those of every linear model; how the errors were found."""
        facts = super().fitted_facts()
        facts["std_error"]["method"] = MEANING[self.covariance]
        return facts | {"excitation": self.excitation_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.covariance_, self.degrees_ = arrays["covariance"], arrays["degrees"]
        self.excitation_ = dict(facts.get("excitation", {}))

    def _training_rows(self, dataset: Dataset) -> Dataset:
        if self.covariance == "clustered" and len(dataset.conditions) < 2:
            raise FitError(
                "standard errors clustered by trajectory need at least two trajectories",
                hint="record more of them, or choose covariance: hac",
            )
        data = prepared(dataset, self.filters)
        if self.filters.thins and self.filter_columns and not self.bends:
            # Left for later, steps would have folded, and the ends be filtered unlike the effort.
            terms = self._friction_terms(data)
            data = data.with_columns(**{FILTERED + name: term for name, term in terms.items()})
        return downsample(data, self.filters)

    def _friction_terms(self, data: Dataset) -> dict[str, FloatArray]:
        terms = super()._friction_terms(data)
        if not self.filter_columns:
            return terms
        if FILTERED + next(iter(terms)) in data.columns:
            return {name: data[FILTERED + name] for name in terms}
        return {name: filter_columns(term, data, self.filters) for name, term in terms.items()}

    def _tell_uncertainty(self, data: Dataset, found: Solution) -> None:
        p = len(found.coefficients)
        scores, residual = self._scores(data, found)
        self.correlated_samples_ = correlated_samples(residual, data.offsets)
        if self.covariance == "clustered":
            told = trajectory_covariance(found.bread, scores)
        else:
            window = hac_window(self.correlated_samples_, len(data))
            told = hac_covariance(found.bread, scores, window)
        self.covariance_ = told.covariance if self.certain else np.full((p, p), np.nan)
        self.degrees_ = told.degrees
        self.excitation_ = self._told_excitation(found, len(data))
        self.std_error_ = np.sqrt(np.diag(told.covariance))

    def _told_excitation(self, found: Solution, samples: int) -> dict[str, Any]:
        X, y = found.weighted_system()
        report = condition_report(X, self.parameter_names_).facts()
        if not self.certain:
            return report
        # Samples that repeat each other count once, for the test to be as strict as it says.
        times = self.correlated_samples_
        root = np.sqrt(times)[found.system[2]]
        independent = float(np.sum(samples / times))
        names = self.parameter_names_
        essential = essential_parameters(X / root[:, None], y / root, names, independent)
        return report | {"essential": essential.facts()}

    def _scores(self, data: Dataset, found: Solution) -> tuple[Scores, FloatArray]:
        """Scores of the weighted least squares, and the residual (N, n).

        Only clustered errors ask for XᵀWX of every series; otherwise it stays 0.
        """
        p = len(found.coefficients)
        score, gram = np.empty((len(data), p)), np.zeros((len(data.conditions), p, p))
        residual = np.empty_like(data["q"])
        series = data.series_index()
        for rows, W, target in self._observations(data):
            rest = target - (W @ found.coefficients).reshape(target.shape)
            residual[rows] = rest
            drive, curvature = self._sample_weights(rest, found)
            cube = W.reshape(*rest.shape, p)
            score[rows] = np.einsum("tjp,tj->tp", cube, drive * rest)
            if self.covariance == "clustered":  # costs as much as the fit itself
                weighted = cube * curvature[:, :, None]
                for number, own in _series_in(series[rows]):
                    gram[number] += np.tensordot(cube[own], weighted[own], ((0, 1), (0, 1)))
        return Scores(score, gram, data.offsets, data.n_joints), residual

    def _sample_weights(self, rest: FloatArray, found: Solution) -> tuple[FloatArray, FloatArray]:
        """ψ(r)/r and ψ′(r) of residuals (N, n), each (N, n): equal where squares are minimised."""
        weight = np.broadcast_to(found.weight, rest.shape)
        return weight, weight


def _series_in(series: IntArray) -> list[tuple[int, slice]]:
    """Numbers of the series and their rows, of successive rows with these numbers (N,)."""
    ends = [0, *(np.flatnonzero(np.diff(series)) + 1).tolist(), len(series)]
    return [(int(series[i]), slice(i, j)) for i, j in pairwise(ends) if j > i]
