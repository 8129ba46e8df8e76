"""Verdict on a run (`verdict.json`), with separate verdicts on its recording and its models.

A run with a missing model does not pass, but is not rejected because of the missing model alone.
The module is separate from `hil.evaluation.verdict`, because run lists read many verdicts and must
not import estimators and specs.
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
    """Model that could not be fitted or evaluated, with the reason of the failure.

    Attributes:
        estimator: Name of the estimator; empty if the error concerns all models.
        error: Message of the failed fit or evaluation.
    """

    estimator: str
    error: HilError

    def to_dict(self) -> dict[str, str]:
        """Return the failure as an entry for JSON."""
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
    """Return the content of the file `verdict.json`.

    The key `passed` is the verdict on the run. `passed` is false if any criterion is not met,
    including the criteria on the recording. `passed` is true only if all criteria on models are met
    and no model is missing. If `passed` is neither false nor true by these rules, its value is
    null.

    Args:
        recording: Verdict rows of the criteria on the recording.
        models: Verdict rows of the criteria on held-out data, only of honest models.
        not_judged: Models to which no criterion was applied although the spec contains criteria.
        problems: Models that could not be fitted or evaluated.
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
    """Return the verdict as text: `passed`, `rejected` or `not judged`."""
    if passed is None:
        return "not judged"
    return "passed" if passed else "rejected"


def recording_rows(accept: Accept, counts: Mapping[str, int]) -> list[dict[str, Any]]:
    """Return the verdict rows on the recording: share of missing samples by the device clock."""
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
    """Return the verdict in the file `verdict.json` of a run: `passed`, `rejected` or `not judged`.

    If the file is missing, damaged or unreadable, the verdict is `not judged`.
    """
    file = run / "verdict.json"
    try:
        document = read_json(file) if file.is_file() else {}
    except (DataError, OSError):
        document = {}
    passed = document.get("passed")
    return _word(passed if isinstance(passed, bool) else None)
