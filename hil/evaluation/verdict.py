"""Verdicts on models: held-out errors against the acceptance criteria of a spec.

`judge` sets the errors of one evaluation against criteria and returns a row per criterion and
joint. `judged_model` evaluates a fitted model on what a run holds out and judges it, the same for a
run and for a fleet; criteria apply to honest models alone. The verdict on the run, of its recording
and all its models, is in `hil.evaluation.run_verdict`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from hil.core import SpecError
from hil.data import Dataset, Model, Prediction
from hil.estimators import HONEST
from hil.evaluation.evaluation import Evaluation, evaluate
from hil.evaluation.fitting import Fitted
from hil.evaluation.holdout import Parts
from hil.spec import Accept

Metric = Literal["rmse_raw", "rmse_filtered", "nrmse", "mep"]
"""What can be limited from above."""

UNIT_OF_METRIC = {"nrmse": "1", "mep": "%"}


@dataclass(frozen=True, slots=True)
class Criterion:
    """A largest acceptable error.

    Attributes:
        metric: Which error.
        max: Its limit; equal to the limit passes.
        unit: `A` or `N·m` for RMSEs, which must be the unit of the data; empty for the others.
        per: `joint`: every joint must meet it; `mean`: the mean over the joints must.
    """

    metric: Metric
    max: float
    unit: str = ""
    per: Literal["joint", "mean"] = "mean"

    def __post_init__(self) -> None:
        if self.metric not in get_args(Metric):
            raise SpecError(
                f"{self.metric!r} cannot be a criterion", hint=f"use {', '.join(get_args(Metric))}"
            )
        if not self.max > 0:
            raise SpecError(f"the limit of {self.metric} is {self.max}, but must be positive")


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """One number against its limit.

    Attributes:
        criterion: Which limit.
        what: The joint's name, or `mean`.
        value: The error found; NaN (nothing could be judged) fails.
        passed: Whether it meets the limit.
    """

    criterion: Criterion
    what: str
    value: float
    passed: bool

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "metric": self.criterion.metric,
            "per": self.criterion.per,
            "what": self.what,
            "value": self.value if np.isfinite(self.value) else None,
            "max": self.criterion.max,
            "unit": self.criterion.unit or UNIT_OF_METRIC.get(self.criterion.metric, ""),
            "passed": self.passed,
        }


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether every criterion is met, and by how much.

    Attributes:
        passed: True when all rows pass; without criteria there is nothing to pass: see `judged`.
        rows: One per criterion and joint (or mean).
    """

    passed: bool
    rows: tuple[VerdictRow, ...]

    @property
    def judged(self) -> bool:
        """False when there were no criteria."""
        return bool(self.rows)

    @property
    def word(self) -> str:
        """`pass`, `fail` or `not judged`."""
        if not self.judged:
            return "not judged"
        return "pass" if self.passed else "fail"

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        rows = [row.to_dict() for row in self.rows]
        return {"verdict": self.word, "passed": self.passed, "rows": rows}


def judge(evaluation: Evaluation, criteria: Sequence[Criterion]) -> Verdict:
    """Set an evaluation's total against criteria.

    Raises:
        SpecError: A criterion is in another unit than the data.
    """
    rows = tuple(row for criterion in criteria for row in _rows(evaluation, criterion))
    return Verdict(all(row.passed for row in rows), rows)


def _rows(evaluation: Evaluation, criterion: Criterion) -> list[VerdictRow]:
    unit = criterion.unit.replace("Nm", "N·m")
    if unit and criterion.metric not in UNIT_OF_METRIC and unit != evaluation.unit:
        raise SpecError(
            f"the criterion for {criterion.metric} is in {unit}, but the data are in "
            f"{evaluation.unit}",
            hint=f"give the limit in {evaluation.unit}",
        )
    if criterion.per == "mean":
        values = {"mean": evaluation.total.mean(criterion.metric)}
    else:
        found = getattr(evaluation.total, criterion.metric)
        values = {name: float(v) for name, v in zip(evaluation.joint_names, found, strict=True)}
    return [
        VerdictRow(criterion, what, value, bool(value <= criterion.max))
        for what, value in values.items()
    ]


def _criteria_of(accept: Accept) -> list[Criterion]:
    """Return the model criteria of a spec; `gaps_percent` is judged on the recording."""
    out: list[Criterion] = []
    if (rmse := accept.rmse) is not None:
        metric: Metric = "rmse_raw" if rmse.signal == "raw" else "rmse_filtered"
        out.append(Criterion(metric, rmse.max, rmse.unit, rmse.per))
    if (nrmse := accept.nrmse) is not None:
        out.append(Criterion("nrmse", nrmse.max, "", nrmse.per))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One fitted and judged model.

    Attributes:
        estimator: Its name.
        protocol: `honest`, or how the model departs from that; see `RobotEstimator.protocol`.
        folder: `<estimator>-<digest>`.
        held_out: Its errors on data it has not seen.
        trained: Its errors on the data it was fitted to, for comparison only.
        verdict: Whether the held-out errors meet the criteria; not judged unless honest.
        document: The content of `evaluation.json`, but for the seconds the fit took.
        test: The data it has not seen.
        prediction: What it predicts for them.
    """

    estimator: str
    protocol: str
    folder: Path
    held_out: Evaluation
    trained: Evaluation
    verdict: Verdict
    document: dict[str, Any]
    test: Dataset
    prediction: Prediction

    def predict(self, model: Model, data: Dataset) -> Prediction:
        """Return the model's prediction for `data`, computed only where it is not known."""
        same_series = [c.id for c in data.conditions] == [c.id for c in self.test.conditions]
        known = same_series and all(
            np.array_equal(data[name], self.test[name], equal_nan=True)
            for name in ("t", "q", "effort")
        )
        return self.prediction if known else model.predict(data)


def judged_model(estimator: str, fitted: Fitted, parts: Parts, accept: Accept) -> Judged:
    """Judge a model on what was held out; criteria apply to honest ones alone.

    Args:
        estimator: Its name.
        fitted: To `parts.train`.
        parts: Of the run.
        accept: Criteria of its spec; those of its recording and of loads are judged elsewhere.
    """
    prediction = fitted.model.predict(parts.test)
    held_out = evaluate(fitted.model, parts.test, fitted.train_std, prediction=prediction)
    trained = evaluate(fitted.model, parts.train, fitted.train_std)
    protocol = fitted.model.protocol
    verdict = judge(held_out, _criteria_of(accept) if protocol == HONEST else [])
    # Errors where only the load or only the motion is new.
    beside = [
        {"what": what, **evaluate(fitted.model, data, fitted.train_std).to_dict()}
        for what, data in parts.beside
    ]
    document = {
        "estimator": estimator,
        "protocol": protocol,
        "notes": list(fitted.model.notes_),
        "held_out": {"what": parts.held_out, **held_out.to_dict()},
        "beside": beside,
        "trained": trained.to_dict(),
        "verdict": verdict.to_dict() | ({} if verdict.judged else {"passed": None}),
    }
    return Judged(
        estimator, protocol, fitted.folder, held_out, trained, verdict, document, parts.test,
        prediction,
    )  # fmt: skip
