"""The loads of a run under a model: its errors told and not told, and what was identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray
from hil.data import Dataset
from hil.estimators import (
    Declaration,
    Friction,
    PayloadEstimate,
    RobotEstimator,
    check_declarations,
    estimate_payload,
    with_identified,
)
from hil.studies.dynamic_methods import rmse_where
from hil.studies.load_cases import LoadCase
from hil.studies.separation_text import mean_of

TOLD = ("unaware", "declared", "calibrated", "identified")
"""What the model is told of the load: nothing; what the spec says; the same, and how far the drive
gains are off as the other loads tell; what other motions with the load say."""


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """One load.

    Attributes:
        case: Its recordings.
        errors: By `TOLD`, (n,) RMSE in N·m on the motions held out; without `identified` where
            there is no estimate, and without `calibrated` where no other load tells gains.
        estimate: The identified load; None for the first one, and where it failed.
        failed: Why it did.
        check: The declaration against it; None without an estimate, or where nobody asked.
    """

    case: LoadCase
    errors: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    failed: str = ""
    check: Declaration | None = None


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoads:
    """What a model is worth under every load of a run.

    Attributes:
        name: Of the model, for people.
        protocol: `honest`, or how its fit departs from that.
        loads: The first one, under which it was fitted, then the others; errors over all folds,
            loads as identified without the first one.
        folds: The same of every fold by itself.
    """

    name: str
    protocol: str
    loads: tuple[Scored, ...]
    folds: tuple[tuple[Scored, ...], ...]

    @staticmethod
    def of(name: str, protocol: str, folds: Sequence[tuple[Scored, ...]]) -> UnderLoads:
        """From the folds: squares of errors are averaged, motion by motion."""
        loads = tuple(_pooled(each) for each in zip(*folds, strict=True))
        return UnderLoads(name, protocol, loads, tuple(folds))

    def ratios(self, told: str = "declared") -> FloatArray:
        """(loads but the first,) error over that with the first load; NaN where not known.

        Both errors are means over the joints.
        """
        return _ratios(self.loads, told)

    def worst(self, told: str = "declared") -> tuple[Scored, float]:
        """The load told of which it errs most, and by how many times as much as with the first."""
        i, ratios = self._worst(told), self.ratios(told)
        return self.loads[1 + i], float(ratios[i])

    def spread(self, told: str = "declared") -> tuple[float, float]:
        """Smallest and largest of the folds' own ratios, under the worst load of all."""
        i = self._worst(told)
        each = [float(_ratios(fold, told)[i]) for fold in self.folds]
        return min(each), max(each)

    def _worst(self, told: str) -> int:
        return int(np.argmax(self.ratios(told)))  # a NaN counts as the largest

    def contradicted(self) -> tuple[str, ...]:
        """Loads whose declaration is contradicted, or could not be checked."""
        others = (one for one in self.loads if one.case.told is not None)
        return tuple(one.case.name for one in others if one.check is None or not one.check.agrees)


def judged(
    model: RobotEstimator,
    cases: Sequence[LoadCase],
    scale: FloatArray,
    friction: Friction | Literal["auto"],
    false_alarm: float,
) -> tuple[Scored, ...]:
    """One fold: errors under every load, and every declaration against what was identified.

    Args:
        model: Fitted without any of it.
        cases: The loads, the first one first.
        scale: (n,) torque per unit of effort.
        friction: See `estimate_payload`.
        false_alarm: See `check_declarations`.
    """
    loads = [_scored(model, case, scale, friction) for case in cases]
    known = [one for one in loads if one.estimate is not None]
    declared = [one.case.declared for one in known]
    estimates = [one.estimate for one in known if one.estimate is not None]
    checks = iter(check_declarations(declared, estimates, false_alarm=false_alarm))
    return tuple(
        one if one.estimate is None else _checked(model, one, next(checks), scale) for one in loads
    )


def _scored(
    model: RobotEstimator, case: LoadCase, scale: FloatArray, friction: Friction | Literal["auto"]
) -> Scored:
    """A load's errors; an estimate that fails is told, not raised."""
    loads = {"unaware": Payload(), "declared": case.declared}
    found, failed = None, ""
    if case.told is not None:
        try:
            found = estimate_payload(model, case.told, friction=friction)
            loads["identified"] = found.payload
        except FitError as error:
            failed = error.message
    errors = {
        told: _error(case.judged, _effort(model, case.judged, load), scale)
        for told, load in loads.items()
    }
    return Scored(case, errors, found, failed)


def _checked(model: RobotEstimator, one: Scored, check: Declaration, scale: FloatArray) -> Scored:
    """With its declaration judged, and its error where gains are as the other loads tell."""
    errors = dict(one.errors)
    if np.any(check.gains):
        data = one.case.judged
        bare, declared = (_effort(model, data, load) for load in (Payload(), one.case.declared))
        # A larger gain makes the same torque of the load from less current.
        effort = bare + (declared - bare) / (1.0 + check.gains)
        errors["calibrated"] = _error(data, effort, scale)
    return replace(one, errors=errors, check=check)


def _effort(model: RobotEstimator, data: Dataset, load: Payload) -> FloatArray:
    """(N, n) effort; NaN where the model does not vouch for it."""
    predicted = model.predict(with_identified(data, load))
    return np.where(predicted.valid, predicted.effort, np.nan)


def _error(data: Dataset, effort: FloatArray, scale: FloatArray) -> FloatArray:
    return rmse_where(data["effort_f"] * scale, effort * scale, np.isfinite(effort))


def _pooled(folds: Sequence[Scored]) -> Scored:
    """One load over all folds."""
    rows = [len(fold.case.judged) for fold in folds]
    errors = {
        told: np.sqrt(np.average([fold.errors[told] ** 2 for fold in folds], axis=0, weights=rows))
        for told in TOLD
        if all(told in fold.errors for fold in folds)
    }
    failed = next((fold.failed for fold in folds if fold.failed), "")
    return replace(folds[0], errors=errors, failed=failed)


def _ratios(loads: Sequence[Scored], told: str) -> FloatArray:
    bare = mean_of(loads[0].errors["declared"])
    others = [mean_of(one.errors[told]) if told in one.errors else np.nan for one in loads[1:]]
    return np.array(others) / bare
