"""How sure a model is of its coefficients: what the estimator itself tells, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.identify.base import RobotEstimator
from hil.identify.rigid_classical import RigidClassical
from hil.identify.static_inverse import StaticInverse
from hil.identify.wls import WlsEstimator
from hil.typing import FloatArray

NO_DEGREES = "the estimator tells standard errors, but no degrees of freedom for an interval"
NOT_OF_METHOD = (
    "bounds, penalties and fitted exponents have no covariance of least squares; std is that of "
    "least squares without them"
)
PULLED = "a penalty, or noise in the columns, pulls by more than any scatter tells"
NOT_TOLD = "the estimator tells no uncertainty of single parameters; see sigma for predictions"
OUTSIDE = "its uncertainty is not in the standard errors of the others either"
NOT_FITTED = "given, not fitted"
NOT_ESTIMATED = "left out of the fit: its value is 0"


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Of p coefficients.

    Attributes:
        std: (p,) standard errors; NaN where there is none.
        interval: (p, 2) ends of 95 %; NaN where there is none.
        reasons: Length p, why something is missing; empty where nothing is.
    """

    std: FloatArray
    interval: FloatArray
    reasons: tuple[str, ...]

    @staticmethod
    def none(p: int, reason: str = NOT_TOLD) -> Spread:
        """Nothing known of p parameters."""
        return Spread(np.full(p, np.nan), np.full((p, 2), np.nan), (reason,) * p)

    def row(self, k: int) -> tuple[float, list[float], str]:
        """Standard error, interval and reason of one coefficient."""
        return float(self.std[k]), self.interval[k].tolist(), self.reasons[k]


def spread_of(model: RobotEstimator) -> Spread:
    """Of `coefficients_`, as `std_error_` and `interval` of the model say it."""
    if not isinstance(model, WlsEstimator):
        return Spread.none(0)
    std, missing = np.asarray(model.std_error_), ""
    interval = np.full((len(std), 2), np.nan)
    own = getattr(model, "interval", None)
    if own is None:
        missing = NO_DEGREES
    elif isinstance(model, RigidClassical) and not model.certain:
        missing = NOT_OF_METHOD
    else:
        interval = np.asarray(own(0.95))
    none = NOT_ESTIMATED if isinstance(model, StaticInverse) else PULLED
    reasons = tuple(
        none if not np.isfinite(std[k]) else "" if np.all(np.isfinite(interval[k])) else missing
        for k in range(len(std))
    )
    return Spread(std, interval, tuple(reason or "" for reason in reasons))


def conditions_of(model: RobotEstimator) -> dict[str, Any] | None:
    """What standard errors take for granted and leave out, as `model.json` has it."""
    told = model.fitted_facts().get("std_error")
    if not isinstance(told, dict):
        return None
    keys = ("given", "leaves_out", "method", "correlated_samples")
    return {key: told.get(key) for key in keys}
