"""After the motion: split, fit, evaluate, verdict. Pure functions of the run directory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.core import DataError, FitError, HilError, read_json
from hil.data import Dataset
from hil.dynamics import load_model
from hil.estimators import HONEST, estimator
from hil.evaluation import (
    EVALUATION_FILE,
    FailedFit,
    Fitted,
    Judged,
    fit_dataset,
    hold_out,
    judged_model,
    recording_rows,
    usable_part,
    verdict_document,
)
from hil.importers import load_source
from hil.recording import RunDirectory
from hil.spec import ExperimentSpec, Fit
from hil.workflow.trainings import FitNews, Tell, fit_or_go_on, forget, nobody
from hil.workflow.under_loads import Row, judge_under_loads


def judge_run(
    directory: RunDirectory,
    spec: ExperimentSpec,
    counts: Mapping[str, int],
    tell: Tell = nobody,
    *,
    keep: Callable[[Judged], object] = lambda judged: None,
) -> bool | None:
    """Judge a completed run: its recording, and every estimator of the spec on what was held out.

    Each estimator is fitted by itself, on the series of the kinds it learns from: one that fails
    leaves the others as they are. Writes `fit/…` and `verdict.json` into the run directory. A
    model that follows a paper's protocol instead of an honest one is reported, but never judged.

    With `validate.under_loads` the models are also judged under every load of the run.

    How far fits are is told as `hil.workflow.trainings` says. `keep` is called with every judged
    model.

    Returns:
        Whether all criteria are met; None when there are none for a model, or when no criterion
        is missed but no model could be judged.

    Raises:
        DataError, FitError: At least one model is missing; the message says of each why. The
            verdict on everything else has been written.
    """
    if not spec.fit:
        return judge_recording(directory, spec, counts)
    judged: list[Judged] = []
    problems: list[FailedFit] = []
    data = _loaded(directory, problems)
    for number, fit in enumerate(spec.fit if data is not None else (), start=1):
        assert data is not None
        news = FitNews(fit.estimator, number, len(spec.fit), tell)
        try:
            with news.ended():
                judged.append(_judge_one(directory, data, fit, spec, news))
                keep(judged[-1])
        except HilError as error:
            problems.append(FailedFit(fit.estimator, error))
        # Estimators are plug-ins: whatever one of them raises must not cost the others.
        except Exception as error:
            problems.append(FailedFit(fit.estimator, _as_fit_error(fit.estimator, error)))
    under: list[Row] = []
    if spec.validation.under_loads and data is not None and judged:
        under, missing = judge_under_loads(directory.path, spec, data, tell)
        problems += missing
    document = _verdict_document(judged, problems, spec, counts, under)
    directory.write_verdict(document)
    forget(directory.path)
    if problems:
        raise _all_in_one(problems, directory)
    passed: bool | None = document["passed"]
    return passed


def judge_recording(
    directory: RunDirectory, spec: ExperimentSpec, counts: Mapping[str, int]
) -> bool | None:
    """Judge a run by its recording alone and write `verdict.json`; for specs without `fit`.

    Returns:
        False when a criterion is missed; else None: no model was judged.
    """
    document = verdict_document(recording_rows(spec.accept, counts), ())
    directory.write_verdict(document)
    passed: bool | None = document["passed"]
    return passed


def _loaded(directory: RunDirectory, problems: list[FailedFit]) -> Dataset | None:
    try:
        return load_source(directory.path)
    except HilError as error:
        problems.append(FailedFit("", error))
        return None


def _judge_one(
    directory: RunDirectory, data: Dataset, fit: Fit, spec: ExperimentSpec, news: FitNews
) -> Judged:
    usable = usable_part(data, estimator(fit.estimator, **fit.parameters))
    parts = hold_out(usable, spec.hold_out)
    robot = load_model(data.robot, gravity=data.gravity)

    def fitted_from(checkpoints: Path) -> Fitted:
        return fit_dataset(
            parts.train, fit.estimator, robot, out=directory.path / "fit", watch=news,
            checkpoints=checkpoints, **fit.parameters,
        )  # fmt: skip

    fitted = fit_or_go_on(directory.path, fit, fitted_from, news.note)
    judged = judged_model(fit.estimator, fitted, parts, spec.accept)
    if not (fitted.folder / EVALUATION_FILE).exists():  # else a kill before the verdict left it
        document = judged.document | {"seconds": fitted.seconds}
        directory.write_json(f"fit/{fitted.folder.name}/{EVALUATION_FILE}", document)
    return judged


def _verdict_document(
    judged: Sequence[Judged],
    problems: Sequence[FailedFit],
    spec: ExperimentSpec,
    counts: Mapping[str, int],
    under_loads: Sequence[Row] = (),
) -> dict[str, Any]:
    rows = [
        {"estimator": one.estimator, **row.to_dict()} for one in judged for row in one.verdict.rows
    ]
    rows += under_loads
    unjudged = [
        {"estimator": one.estimator, "protocol": one.protocol}
        for one in judged
        if one.protocol != HONEST
    ]
    return verdict_document(
        recording_rows(spec.accept, counts), rows, not_judged=unjudged, problems=problems
    )


def _as_fit_error(name: str, error: Exception) -> FitError:
    told = FitError(
        f"{name} broke down: {type(error).__name__}: {error}",
        hint="this is a fault of the estimator: report it to whoever wrote it",
    )
    told.__cause__ = error
    return told


def missing_models(directory: RunDirectory) -> HilError | None:
    """Return the error that judging a run ended with, from its verdict; None if there was none.

    Raises:
        DataError: The verdict is damaged.
    """
    rows = read_json(directory.path / "verdict.json").get("problems") or []
    messages = [": ".join(filter(None, (row["estimator"], row["error"]))) for row in rows]
    hints = list(dict.fromkeys(row["hint"] for row in rows if row["hint"]))
    hint = "; ".join(hints) or f"hil show {directory.path}"
    return FitError("; ".join(messages), hint=hint) if messages else None


def _all_in_one(problems: Sequence[FailedFit], directory: RunDirectory) -> HilError:
    """One error for all models that are missing; the recording is at fault only if it alone is."""
    kind = DataError if all(isinstance(p.error, DataError) for p in problems) else FitError
    told = [": ".join(filter(None, (p.estimator, p.error.message))) for p in problems]
    hints = list(dict.fromkeys(p.error.hint for p in problems if p.error.hint))
    out = kind("; ".join(told), hint="; ".join(hints) or f"hil show {directory.path}")
    out.__cause__ = problems[0].error
    return out
