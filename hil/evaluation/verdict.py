"""Verdicts on models: comparison of held-out errors with the acceptance criteria of a spec.

`judge` compares the errors of one evaluation with criteria and returns one row per criterion and
joint. `judged_model` evaluates a fitted model on the hold-out set of a run or fleet and applies the
criteria; criteria apply to honest models only. The verdict on a whole run is in
`hil.evaluation.run_verdict`.
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
"""Error metric that a criterion can limit."""

UNIT_OF_METRIC = {"nrmse": "1", "mep": "%"}


@dataclass(frozen=True, slots=True)
class Criterion:
    """Acceptance criterion: upper limit of an error metric.

    Attributes:
        metric: Error metric.
        max: Upper limit of the metric; a value equal to the limit passes.
        unit: Unit of an RMSE limit, `A` or `N·m`, which must be the unit of the data; empty for
            other metrics.
        per: `joint` if the limit applies to every joint, `mean` if it applies to the mean over
            joints.
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
    """Result of one criterion for one joint or for the mean over joints.

    Attributes:
        criterion: Acceptance criterion with the limit.
        what: Name of the joint, or `mean` for the mean over joints.
        value: Value of the error metric; NaN fails, for example if no row could be evaluated.
        passed: Whether the value is within the limit.
    """

    criterion: Criterion
    what: str
    value: float
    passed: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the row in a form that JSON can store."""
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
    """Result of all criteria for the evaluation of one model.

    Attributes:
        passed: Whether all rows pass; also true if there are no criteria, see `judged`.
        rows: One result per criterion and joint (or mean).
    """

    passed: bool
    rows: tuple[VerdictRow, ...]

    @property
    def judged(self) -> bool:
        """Whether any criteria were applied."""
        return bool(self.rows)

    @property
    def word(self) -> str:
        """Verdict as a word: `pass`, `fail` or `not judged`."""
        if not self.judged:
            return "not judged"
        return "pass" if self.passed else "fail"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict in a form that JSON can store."""
        rows = [row.to_dict() for row in self.rows]
        return {"verdict": self.word, "passed": self.passed, "rows": rows}


def judge(evaluation: Evaluation, criteria: Sequence[Criterion]) -> Verdict:
    """Return the verdict on the total prediction errors of an evaluation.

    Raises:
        SpecError: The unit of a criterion differs from the unit of the data.
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
    """Return the criteria on models in a spec; `gaps_percent` limits the recording instead."""
    out: list[Criterion] = []
    if (rmse := accept.rmse) is not None:
        metric: Metric = "rmse_raw" if rmse.signal == "raw" else "rmse_filtered"
        out.append(Criterion(metric, rmse.max, rmse.unit, rmse.per))
    if (nrmse := accept.nrmse) is not None:
        out.append(Criterion("nrmse", nrmse.max, "", nrmse.per))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Fitted model together with its evaluation and verdict.

    Attributes:
        estimator: Name of the estimator that was evaluated.
        protocol: `honest`, or the deviation from an honest model; see `RobotEstimator.protocol`.
        folder: Model folder `<estimator>-<digest>`.
        held_out: Prediction errors on the hold-out set.
        trained: Prediction errors on the training data, for comparison only.
        verdict: Verdict on the held-out errors; `not judged` for models that are not honest.
        document: Content of `evaluation.json`, without the duration of the fit.
        test: Hold-out set of the evaluation.
        prediction: Prediction of the model for the hold-out set.
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
        """Return the prediction of the model for `data`, stored or newly computed.

        The stored prediction is returned if `data` equals the hold-out set.
        """
        same_series = [c.id for c in data.conditions] == [c.id for c in self.test.conditions]
        known = same_series and all(
            np.array_equal(data[name], self.test[name], equal_nan=True)
            for name in ("t", "q", "effort")
        )
        return self.prediction if known else model.predict(data)


def judged_model(estimator: str, fitted: Fitted, parts: Parts, accept: Accept) -> Judged:
    """Return the evaluation and verdict of a model on the hold-out set.

    Acceptance criteria apply to honest models only.

    Args:
        estimator: Name of the estimator that was evaluated.
        fitted: Model that was fitted to `parts.train`.
        parts: Training and hold-out set of the run.
        accept: Acceptance criteria of the spec. Criteria on the recording and on payloads are not
            checked by `judged_model`.
    """
    prediction = fitted.model.predict(parts.test)
    held_out = evaluate(fitted.model, parts.test, fitted.train_std, prediction=prediction)
    trained = evaluate(fitted.model, parts.train, fitted.train_std)
    protocol = fitted.model.protocol
    verdict = judge(held_out, _criteria_of(accept) if protocol == HONEST else [])
    # Errors on series in which only the payload or only the motion is new.
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
