"""After the motion: fits, verdict and studies of a run, until they are done or interrupted.

All are pure functions of the run directory. `RUN/.training/<estimator>-<digest>/` holds the
unfinished training of a network: `hil resume` continues from there after an interruption, and the
folder is removed once there is a verdict.
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
    """Fit, judge and study a completed run; return what ended it early, or what is missing.

    If the run was judged already, because its process died later, only missing studies are made.

    Args:
        experiment: Of the run.
        recorded: The run.
        signals: Watched: a signal ends fits and studies.
        watching: Receive progress events.
        keep: Called with every model that is judged now.
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
    """Fit and judge a completed run; return what ended the run or the fit early."""
    result = recorded.result
    if result.outcome is not Outcome.COMPLETED:
        return result.error
    if "commissioning" in recorded.directory.start:
        return None  # a part of the program, or another speed: no model is fitted to that
    if signals.seen:
        return Stopped(
            "stopped after the motion, before the fit",
            by_signal=True,
            hint="hil fit RUN -e ESTIMATOR fits what was recorded",
        )
    names = ", ".join(fit.estimator for fit in experiment.spec.fit)
    watching.publish({"kind": "stage", "stage": f"fitting {names}" if names else "judging"})
    try:
        judge_run(recorded.directory, experiment.spec, recorded.counts, watching.publish, keep=keep)
    except (Exception, StopSignal) as error:
        if signals.seen:
            path = recorded.directory.path
            training = "; the training is kept" if has_training(path) else ""
            message = f"{signals.reason} during the fits; the recording is complete{training}"
            return Stopped(message, hint=f"go on with: hil resume {path}", by_signal=True)
        if isinstance(error, HilError):
            return error
        raise
    return None


def _is_whole(recorded: Recorded) -> bool:
    """Return whether all of the program was measured as it was planned."""
    commissioning = "commissioning" in recorded.directory.start
    return recorded.result.outcome is Outcome.COMPLETED and not commissioning


def _both(fits: HilError | None, studies: HilError | None) -> HilError | None:
    """Return one error for missing models and missing studies; a stop by signal comes first."""
    if fits is None or studies is None or isinstance(studies, Stopped):
        return studies or fits
    hints = dict.fromkeys(filter(None, (fits.hint, studies.hint)))
    both = type(fits)(f"{fits.message}; {studies.message}", hint="; ".join(hints))
    both.__cause__ = fits
    return both


def _study(
    entries: Sequence[StudyEntry], recorded: Recorded, signals: SignalWatch, watching: Observers
) -> HilError | None:
    """Make studies of the spec; return what ended them early, or why some are missing."""

    def watch(name: str, what: str, done: int, total: int) -> None:
        event = {"kind": "study", "study": name, "what": what, "done": done, "total": total}
        watching.publish(event)

    def fit_ended(name: str, ended: Ended) -> None:
        watching.publish({"kind": "study_fit", "study": name, "ended": asdict(ended)})

    path = recorded.directory.path
    if not entries:
        return None
    names = ", ".join(entry.study for entry in entries)
    watching.publish({"kind": "stage", "stage": f"studying the run: {names}"})
    try:
        return run_studies(path, entries, watch, fit_ended).error
    except (Exception, StopSignal) as error:
        if signals.seen:
            message = f"{signals.reason} during the studies; the run and its models are complete"
            return Stopped(message, hint=f"make them with: hil study {path}", by_signal=True)
        if isinstance(error, HilError):
            return error
        raise
    finally:
        watching.publish({"kind": "study", "study": ""})


def unwatched(event: Mapping[str, Any]) -> None:
    """Ignore the progress of fits."""


def judge_run(
    directory: RunDirectory,
    spec: ExperimentSpec,
    counts: Mapping[str, int],
    tell: Tell = unwatched,
    *,
    keep: Callable[[Judged], object] = lambda judged: None,
) -> bool | None:
    """Judge a completed run: its recording, and every estimator of the spec on what was held out.

    Each estimator is fitted by itself, on the series of the kinds it learns from: one that fails
    leaves the others as they are. Writes `fit/…` and `verdict.json` into the run directory. A
    model that follows a paper's protocol instead of an honest one is reported, but never judged.

    With `validate.under_loads` the models are also judged under every load of the run.

    Args:
        directory: The run.
        spec: Its spec.
        counts: Of its recording, see `Recorded.counts`.
        tell: Receives the progress of the fits, see `FitNews`.
        keep: Called with every judged model.

    Returns:
        Whether all criteria are met; None if there are none for a model, or if no criterion is
        missed but no model could be judged.

    Raises:
        DataError, FitError: At least one model is missing; the message says of each why. The
            verdict on everything else has been written.
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
        # Estimators are plug-ins: whatever one of them raises must not cost the others.
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


def _all_in_one(problems: Sequence[FailedFit], directory: RunDirectory) -> HilError:
    """Return one error for all models that are missing; a `DataError` if all of them are."""
    kind = DataError if all(isinstance(p.error, DataError) for p in problems) else FitError
    messages = [": ".join(filter(None, (p.estimator, p.error.message))) for p in problems]
    hints = list(dict.fromkeys(p.error.hint for p in problems if p.error.hint))
    error = kind("; ".join(messages), hint="; ".join(hints) or f"hil show {directory.path}")
    error.__cause__ = problems[0].error
    return error


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


EVERY_S = 0.1
"""Least time between two events about epochs [s]."""


class FitNews:
    """Events about one of the fits of a run; the watch of its trainings.

    Args:
        estimator: Its name.
        number: Of the fit, from 1.
        total: Number of fits.
        tell: Receives the events.
    """

    def __init__(self, estimator: str, number: int, total: int, tell: Tell) -> None:
        self._which = {"estimator": estimator, "number": number, "total": total}
        self._tell, self._often, self._unkept = tell, Throttle(EVERY_S), False

    def __call__(self, epoch: Told) -> None:
        """Tell an epoch if it is time to; the first of every network in any case."""
        if self._often.due(anyway=epoch.epoch == 1):
            self._tell({"kind": "training", **self._which, "epoch": asdict(epoch)})

    def not_kept(self, error: HilError) -> None:
        """Tell once that the disk does not take the trainings; the fit continues."""
        if not self._unkept:
            self.note(f"{error.message}; the fit goes on without")
        self._unkept = True

    def note(self, text: str) -> None:
        """Tell something that an operator should know about the fit."""
        self._tell({"kind": "fit_note", **self._which, "text": text})

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Tell how long what is inside took, and whether it failed; nothing about an interrupt."""
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
    """Make a fit; trainings of it that were interrupted are continued.

    A training that cannot be continued, such as one of another version, is removed and begun anew;
    others of the same fit stay.

    Args:
        run: The run directory.
        fit: The entry of the spec.
        make: Fits, with its trainings in the folder that it is called with.
        note: Called with the reason for which a training is begun anew.
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
            note(f"{error.message}; this training begins anew")
            shutil.rmtree(refused, ignore_errors=True)


def forget_training(run: Path) -> None:
    """Delete the training checkpoints of a run once it has a verdict."""
    shutil.rmtree(run / TRAINING, ignore_errors=True)


def has_training(run: Path) -> bool:
    """Return whether a training of the run can be continued."""
    return any((run / TRAINING).glob("*/**/checkpoint.json"))
