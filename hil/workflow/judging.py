"""Steps after the motion of a run: fits, verdict and studies, until all are done or interrupted.

Fits, verdict and studies depend only on the run directory. The folder
`RUN/.training/<estimator>-<digest>/` contains the unfinished training of a network: `hil resume`
continues the training after an interruption. The folder of the training is removed when the verdict
is written.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import (
    CheckpointRefused,
    DataError,
    FitError,
    HilError,
    Stopped,
    Throttle,
    json_document,
    read_json,
)
from hil.data import Dataset
from hil.dynamics import load_model
from hil.engine import Observers, Outcome, SignalWatch, StopSignal
from hil.estimators import HONEST, estimator
from hil.evaluation import (
    DIGEST_LENGTH,
    EVALUATION_FILE,
    FailedFit,
    Fitted,
    Judged,
    broken_down,
    fit_dataset,
    hold_out,
    judged_model,
    recording_rows,
    usable_part,
    verdict_document,
)
from hil.importers import load_source
from hil.planning import Experiment
from hil.recording import RunDirectory
from hil.spec import ExperimentSpec, Fit, StudyEntry
from hil.studies import Ended
from hil.workflow.recording import Recorded
from hil.workflow.studies import Row, Tell, judge_under_loads, missing_studies, run_studies

if TYPE_CHECKING:
    from hil.networks import Told


def judge_and_study(
    experiment: Experiment,
    recorded: Recorded,
    signals: SignalWatch,
    watching: Observers,
    keep: Callable[[Judged], object] = lambda judged: None,
) -> HilError | None:
    """Fit, evaluate and study a completed run; return the error if results are missing.

    If the run already has a verdict, because its process died later, only the missing studies are
    run.

    Args:
        experiment: Experiment of the run.
        recorded: Recorded run.
        signals: Open signal watch; a signal ends fits and studies.
        watching: Receivers of progress events.
        keep: Callback that receives every model that is evaluated in this call.
    """
    entries = experiment.spec.study
    if recorded.directory.is_judged:
        error = missing_models(recorded.directory)
        entries = missing_studies(recorded.directory.path, entries)
    else:
        error = _judge(experiment, recorded, signals, watching, keep)
    if signals.seen or not _is_whole(recorded):
        return error
    return _both(error, _study(entries, recorded, signals, watching))


def _judge(
    experiment: Experiment,
    recorded: Recorded,
    signals: SignalWatch,
    watching: Observers,
    keep: Callable[[Judged], object],
) -> HilError | None:
    """Fit and evaluate a completed run; return the error that ended the run or the fit early."""
    result = recorded.result
    if result.outcome is not Outcome.COMPLETED:
        return result.error
    if "commissioning" in recorded.directory.start:
        return None  # commissioning runs are not fitted: partial program or reduced speed
    if signals.seen:
        return Stopped(
            "stopped after the motion, before the fit",
            by_signal=True,
            hint="fit the recorded data: hil fit RUN -e ESTIMATOR",
        )
    names = ", ".join(fit.estimator for fit in experiment.spec.fit)
    watching.publish({"kind": "stage", "stage": f"fitting {names}" if names else "evaluating"})
    try:
        judge_run(recorded.directory, experiment.spec, recorded.counts, watching.publish, keep=keep)
    except (Exception, StopSignal) as error:
        if signals.seen:
            path = recorded.directory.path
            training = "; the state of the training is kept" if has_training(path) else ""
            message = f"{signals.reason} during the fits; the recording is complete{training}"
            return Stopped(message, hint=f"continue with: hil resume {path}", by_signal=True)
        if isinstance(error, HilError):
            return error
        raise
    return None


def _is_whole(recorded: Recorded) -> bool:
    """Return whether the run measured its whole program as planned."""
    commissioning = "commissioning" in recorded.directory.start
    return recorded.result.outcome is Outcome.COMPLETED and not commissioning


def _both(fits: HilError | None, studies: HilError | None) -> HilError | None:
    """Return one error for missing models and studies; an error from a signal has priority."""
    if fits is None or studies is None or isinstance(studies, Stopped):
        return studies or fits
    hints = dict.fromkeys(filter(None, (fits.hint, studies.hint)))
    both = type(fits)(f"{fits.message}; {studies.message}", hint="; ".join(hints))
    both.__cause__ = fits
    return both


def _study(
    entries: Sequence[StudyEntry], recorded: Recorded, signals: SignalWatch, watching: Observers
) -> HilError | None:
    """Run the studies of the spec; return the error that ended or prevented some of them."""

    def watch(name: str, what: str, done: int, total: int) -> None:
        event = {"kind": "study", "study": name, "what": what, "done": done, "total": total}
        watching.publish(event)

    def fit_ended(name: str, ended: Ended) -> None:
        watching.publish({"kind": "study_fit", "study": name, "ended": asdict(ended)})

    path = recorded.directory.path
    if not entries:
        return None
    names = ", ".join(entry.study for entry in entries)
    watching.publish({"kind": "stage", "stage": f"computing studies: {names}"})
    try:
        return run_studies(path, entries, watch, fit_ended).error
    except (Exception, StopSignal) as error:
        if signals.seen:
            message = f"{signals.reason} during the studies; the run and its models are complete"
            hint = f"compute the missing studies: hil study {path}"
            return Stopped(message, hint=hint, by_signal=True)
        if isinstance(error, HilError):
            return error
        raise
    finally:
        watching.publish({"kind": "study", "study": ""})


def unwatched(event: Mapping[str, Any]) -> None:
    """Ignore the progress events of fits."""


def judge_run(
    directory: RunDirectory,
    spec: ExperimentSpec,
    counts: Mapping[str, int],
    tell: Tell = unwatched,
    *,
    keep: Callable[[Judged], object] = lambda judged: None,
) -> bool | None:
    """Evaluate the recording and every estimator of a completed run on the hold-out set.

    Each estimator is fitted separately, to the kinds of series that the estimator uses; a failed
    fit does not affect the other estimators. The function writes the models below `fit/` and the
    verdict in `verdict.json` into the run directory. A model that follows the protocol of a paper
    instead of the protocol `honest` is reported, but no criterion is applied to it. With
    `validate.under_loads`, the models are also evaluated with every load of the run.

    Args:
        directory: Run directory.
        spec: Spec that the run was started with.
        counts: Counts of the recording, see `Recorded.counts`.
        tell: Callback that receives the progress of the fits, see `FitNews`.
        keep: Callback that receives every evaluated model.

    Returns:
        True if all criteria are met, False if at least one criterion is violated. The return value
        is None if the spec has no criteria for a model, or if no criterion is violated but no model
        could be evaluated.

    Raises:
        DataError, FitError: At least one model is missing; the message contains the reason for each
            missing model. The verdict on all other results is written before the error is raised.
    """
    if not spec.fit:
        return judge_recording(directory, spec, counts)
    judged: list[Judged] = []
    problems: list[FailedFit] = []
    data: Dataset | None = None
    try:
        data = load_source(directory.path)
    except HilError as error:
        problems.append(FailedFit("", error))
    for number, fit in enumerate(spec.fit if data is not None else (), start=1):
        assert data is not None
        news = FitNews(fit.estimator, number, len(spec.fit), tell)
        try:
            with news.timed():
                judged.append(_judge_one(directory, data, fit, spec, news))
                keep(judged[-1])
        except HilError as error:
            problems.append(FailedFit(fit.estimator, error))
        # Estimators are plug-ins: an error of one must not prevent the other fits.
        except Exception as error:
            problems.append(FailedFit(fit.estimator, broken_down(fit.estimator, error, "it")))
    under: list[Row] = []
    if spec.validation.under_loads and data is not None and judged:
        under, missing = judge_under_loads(directory.path, spec, data, tell)
        problems += missing
    document = _verdict_document(judged, problems, spec, counts, under)
    directory.write_verdict(document)
    forget_training(directory.path)
    if problems:
        raise _all_in_one(problems, directory)
    passed: bool | None = document["passed"]
    return passed


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

    fitted = fit_or_continue(directory.path, fit, fitted_from, news.note)
    judged = judged_model(fit.estimator, fitted, parts, spec.accept)
    if not (fitted.folder / EVALUATION_FILE).exists():  # exists after a kill before the verdict
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


def _all_in_one(problems: Sequence[FailedFit], directory: RunDirectory) -> HilError:
    """Return one error for all missing models; a `DataError` if all causes are data errors."""
    kind = DataError if all(isinstance(p.error, DataError) for p in problems) else FitError
    messages = [": ".join(filter(None, (p.estimator, p.error.message))) for p in problems]
    hints = list(dict.fromkeys(p.error.hint for p in problems if p.error.hint))
    error = kind("; ".join(messages), hint="; ".join(hints) or f"hil show {directory.path}")
    error.__cause__ = problems[0].error
    return error


def judge_recording(
    directory: RunDirectory, spec: ExperimentSpec, counts: Mapping[str, int]
) -> bool | None:
    """Evaluate a run by its recording alone, for a spec without `fit`, and write `verdict.json`.

    Returns:
        False if a criterion is violated; otherwise None, because no model was evaluated.
    """
    document = verdict_document(recording_rows(spec.accept, counts), ())
    directory.write_verdict(document)
    passed: bool | None = document["passed"]
    return passed


def missing_models(directory: RunDirectory) -> HilError | None:
    """Return the error about the missing models of a run, according to its verdict.

    The return value is None if no model is missing.

    Raises:
        DataError: The file of the verdict is damaged.
    """
    rows = read_json(directory.path / "verdict.json").get("problems") or []
    messages = [": ".join(filter(None, (row["estimator"], row["error"]))) for row in rows]
    hints = list(dict.fromkeys(row["hint"] for row in rows if row["hint"]))
    hint = "; ".join(hints) or f"hil show {directory.path}"
    return FitError("; ".join(messages), hint=hint) if messages else None


EVERY_S = 0.1
"""Minimum time between two events about training epochs [s]."""


class FitNews:
    """Publisher of events about one fit of a run; also the callback of its network trainings.

    Args:
        estimator: Name of the estimator that is fitted.
        number: Number of this fit within the run, from 1.
        total: Number of fits of the run.
        tell: Callback that receives the events.
    """

    def __init__(self, estimator: str, number: int, total: int, tell: Tell) -> None:
        self._which = {"estimator": estimator, "number": number, "total": total}
        self._tell, self._often, self._unkept = tell, Throttle(EVERY_S), False

    def __call__(self, epoch: Told) -> None:
        """Publish a training epoch if the minimum time between two events has passed.

        The first epoch of every network is always published.
        """
        if self._often.due(anyway=epoch.epoch == 1):
            self._tell({"kind": "training", **self._which, "epoch": asdict(epoch)})

    def not_kept(self, error: HilError) -> None:
        """Publish a single note that training checkpoints cannot be stored; the fit continues."""
        if not self._unkept:
            self.note(f"{error.message}; the fit continues without checkpoints")
        self._unkept = True

    def note(self, text: str) -> None:
        """Publish a note about the fit for the operator."""
        self._tell({"kind": "fit_note", **self._which, "text": text})

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Publish duration and success of a fit; publish nothing if the fit is interrupted."""
        begin = time.perf_counter()
        try:
            yield
        except Exception:
            self._ended(begin, failed=True)
            raise
        self._ended(begin, failed=False)

    def _ended(self, begin: float, *, failed: bool) -> None:
        ending = {"seconds": time.perf_counter() - begin, "failed": failed}
        self._tell({"kind": "fitted", **self._which, **ending})


TRAINING = ".training"


def fit_or_continue(
    run: Path, fit: Fit, make: Callable[[Path], Fitted], note: Callable[[str], None]
) -> Fitted:
    """Fit a model and continue its interrupted network trainings.

    A training that cannot be continued, for example because a different version wrote its
    checkpoint, is removed and restarted. Other trainings of the same fit are not removed.

    Args:
        run: Run directory.
        fit: Entry of the spec for this fit.
        make: Function that fits the model and stores its trainings in the folder that is passed to
            it.
        note: Callback that receives the reason for restarting a training.
    """
    text = json_document({"estimator": fit.estimator, "parameters": fit.parameters})
    digest = hashlib.sha256(text).hexdigest()[:DIGEST_LENGTH]
    folder = run / TRAINING / f"{fit.estimator}-{digest}"
    removed: set[Path] = set()
    while True:
        try:
            return make(folder)
        except CheckpointRefused as error:
            refused = error.folder
            if refused is None or refused in removed or not refused.is_relative_to(folder):
                raise
            removed.add(refused)
            note(f"{error.message}; this training starts again from the beginning")
            shutil.rmtree(refused, ignore_errors=True)


def forget_training(run: Path) -> None:
    """Delete the training checkpoints of a run that has a verdict."""
    shutil.rmtree(run / TRAINING, ignore_errors=True)


def has_training(run: Path) -> bool:
    """Return whether the run has a training that can be continued."""
    return any((run / TRAINING).glob("*/**/checkpoint.json"))
