"""One fitted model, judged on what was held out: the same for a run and for a fleet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.data import Dataset, Model, Prediction
from hil.estimators import HONEST
from hil.evaluation.evaluation import Evaluation, evaluate
from hil.evaluation.fitting import Fitted
from hil.evaluation.holdout import Parts
from hil.evaluation.verdict import Criterion, Metric, Verdict, judge
from hil.spec import Accept


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
    verdict = judge(held_out, criteria_of(accept) if protocol == HONEST else [])
    document = {
        "estimator": estimator,
        "protocol": protocol,
        "notes": list(fitted.model.notes_),
        "held_out": {"what": parts.held_out, **held_out.to_dict()},
        "beside": _beside(fitted, parts),
        "trained": trained.to_dict(),
        "verdict": verdict.to_dict() | ({} if verdict.judged else {"passed": None}),
    }
    return Judged(
        estimator,
        protocol,
        fitted.folder,
        held_out,
        trained,
        verdict,
        document,
        parts.test,
        prediction,
    )


def criteria_of(accept: Accept) -> list[Criterion]:
    """The model criteria of a spec; `gaps_percent` is judged on the recording."""
    out: list[Criterion] = []
    if (rmse := accept.rmse) is not None:
        metric: Metric = "rmse_raw" if rmse.signal == "raw" else "rmse_filtered"
        out.append(Criterion(metric, rmse.max, rmse.unit, rmse.per))
    if (nrmse := accept.nrmse) is not None:
        out.append(Criterion("nrmse", nrmse.max, "", nrmse.per))
    return out


def _beside(fitted: Fitted, parts: Parts) -> list[dict[str, Any]]:
    """Errors where only the load or only the motion is new."""
    return [
        {"what": what, **evaluate(fitted.model, data, fitted.train_std).to_dict()}
        for what, data in parts.beside
    ]
