"""The verdict on a run, `verdict.json`: its recording and its models apart, and what is not judged.

A model that is missing keeps a run from passing, but does not reject it. This module stands apart
from `hil.evaluation.verdict`, which judges the models, as lists of runs read the verdict of each
and start without estimators and specs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hil.core import DataError, HilError, read_json

if TYPE_CHECKING:
    from hil.spec import Accept

VerdictWord = Literal["passed", "rejected", "not judged"]


@dataclass(frozen=True, slots=True)
class FailedFit:
    """A model that could not be fitted or judged, and why.

    Attributes:
        estimator: Its name; empty where it concerns all of them.
        error: What happened.
    """

    estimator: str
    error: HilError

    def to_dict(self) -> dict[str, str]:
        """JSON form."""
        return {
            "estimator": self.estimator,
            "error": self.error.message,
            "hint": self.error.hint,
        }


def verdict_document(
    recording: Sequence[Mapping[str, Any]],
    models: Sequence[Mapping[str, Any]],
    *,
    not_judged: Sequence[Mapping[str, str]] = (),
    problems: Sequence[FailedFit] = (),
) -> dict[str, Any]:
    """The content of `verdict.json`.

    `passed` is the verdict on the run: false when any criterion is missed, be it the recording's;
    true only when model criteria are met and no model is missing; null otherwise.

    Args:
        recording: Rows judged on the recording.
        models: Rows judged on held-out data; only those of honest models.
        not_judged: Models that no criterion was applied to although there are some.
        problems: Models that are missing.
    """
    of_recording, of_models = _passed(recording), _passed(models)
    if problems and of_models:
        of_models = None
    passed = of_models
    if of_recording is False:
        passed = False
    return {
        "passed": passed,
        "verdict": _word(passed),
        "recording": {"verdict": _word(of_recording), "passed": of_recording},
        "model": {"verdict": _word(of_models), "passed": of_models},
        "rows": [*models, *recording],
        "not_judged": list(not_judged),
        "problems": [problem.to_dict() for problem in problems],
    }


def _passed(rows: Sequence[Mapping[str, Any]]) -> bool | None:
    return all(row["passed"] for row in rows) if rows else None


def _word(passed: bool | None) -> VerdictWord:
    """Return `passed`, `rejected` or `not judged`."""
    if passed is None:
        return "not judged"
    return "passed" if passed else "rejected"


def recording_rows(accept: Accept, counts: Mapping[str, int]) -> list[dict[str, Any]]:
    """The criteria on the recording: share of samples missing by the device's clock."""
    if accept.gaps_percent is None:
        return []
    missing = counts["missing"]
    share = 100.0 * missing / max(1, counts["samples"] + missing)
    limit = accept.gaps_percent.max
    return [
        {
            "estimator": "",
            "metric": "gaps_percent",
            "per": "run",
            "what": "recording",
            "value": share,
            "max": limit,
            "unit": "%",
            "passed": share <= limit,
        }
    ]


def verdict_word(run: Path) -> VerdictWord:
    """Return `passed`, `rejected` or `not judged`, as `verdict.json` of a run directory says.

    A file that is missing, damaged or may not be read says nothing.
    """
    file = run / "verdict.json"
    try:
        document = read_json(file) if file.is_file() else {}
    except (DataError, OSError):
        document = {}
    passed = document.get("passed")
    return _word(passed if isinstance(passed, bool) else None)
