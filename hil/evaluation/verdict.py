"""Does a model meet the acceptance criteria of its spec?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from hil.core import SpecError
from hil.evaluation.evaluation import Errors, Evaluation

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
    rows = tuple(
        row for criterion in criteria for row in _rows(evaluation.total, evaluation, criterion)
    )
    return Verdict(all(row.passed for row in rows), rows)


def _rows(errors: Errors, evaluation: Evaluation, criterion: Criterion) -> list[VerdictRow]:
    unit = criterion.unit.replace("Nm", "N·m")
    if unit and criterion.metric not in UNIT_OF_METRIC and unit != evaluation.unit:
        raise SpecError(
            f"the criterion for {criterion.metric} is in {unit}, but the data are in "
            f"{evaluation.unit}",
            hint=f"give the limit in {evaluation.unit}",
        )
    if criterion.per == "mean":
        values = {"mean": errors.mean(criterion.metric)}
    else:
        found = getattr(errors, criterion.metric)
        values = {name: float(v) for name, v in zip(evaluation.joint_names, found, strict=True)}
    return [
        VerdictRow(criterion, what, value, bool(value <= criterion.max))
        for what, value in values.items()
    ]
