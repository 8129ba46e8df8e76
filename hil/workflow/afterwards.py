"""After the motion: fits, verdict and studies, while somebody may still press Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict

from hil.core import HilError, Stopped
from hil.engine import Observers, Outcome, SignalWatch, StopSignal
from hil.evaluation import Judged
from hil.planning import Experiment
from hil.spec import StudyEntry
from hil.studies import Ended
from hil.workflow.attempt import Recorded
from hil.workflow.judging import judge_run, missing_models
from hil.workflow.studies import missing_studies, run_studies
from hil.workflow.trainings import are_kept


def judge_and_study(
    experiment: Experiment,
    recorded: Recorded,
    signals: SignalWatch,
    watching: Observers,
    keep: Callable[[Judged], object] = lambda judged: None,
) -> HilError | None:
    """Fit, judge and study a completed run; return what ended it early, or what is missing.

    If the run was judged already, because its process died later, only missing studies are made.
    `keep` is called with every model that is judged now.
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
    """Fit and judge a completed run; returns what ended the run or the fit early."""
    result = recorded.result
    if result.outcome is not Outcome.COMPLETED:
        return result.error
    if "commissioning" in recorded.directory.start:
        return None  # a part of the program, or another speed: there is no model to be judged
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
            return _stopped(recorded, signals)
        if isinstance(error, HilError):
            return error
        raise
    return None


def _stopped(recorded: Recorded, signals: SignalWatch) -> Stopped:
    """What a signal during the fits leaves, and how to go on."""
    path = recorded.directory.path
    kept = "; the training is kept" if are_kept(path) else ""
    told = f"{signals.reason} during the fits; the recording is complete{kept}"
    return Stopped(told, hint=f"go on with: hil resume {path}", by_signal=True)


def _is_whole(recorded: Recorded) -> bool:
    """Whether all of the program was measured as it was planned."""
    commissioning = "commissioning" in recorded.directory.start
    return recorded.result.outcome is Outcome.COMPLETED and not commissioning


def _study(
    entries: Sequence[StudyEntry], recorded: Recorded, signals: SignalWatch, watching: Observers
) -> HilError | None:
    """Make studies of the spec; return what ended them early, or why some are missing."""

    def watch(name: str, what: str, done: int, total: int) -> None:
        event = {"kind": "study", "study": name, "what": what, "done": done, "total": total}
        watching.publish(event)

    def fitted(name: str, ended: Ended) -> None:
        watching.publish({"kind": "study_fit", "study": name, "ended": asdict(ended)})

    path = recorded.directory.path
    if not entries:
        return None
    names = ", ".join(entry.study for entry in entries)
    watching.publish({"kind": "stage", "stage": f"studying the run: {names}"})
    try:
        return run_studies(path, entries, watch, fitted).error
    except (Exception, StopSignal) as error:
        if signals.seen:
            told = f"{signals.reason} during the studies; the run and its models are complete"
            return Stopped(told, hint=f"make them with: hil study {path}", by_signal=True)
        if isinstance(error, HilError):
            return error
        raise
    finally:
        watching.publish({"kind": "study", "study": ""})


def _both(fits: HilError | None, studies: HilError | None) -> HilError | None:
    """One error where models and studies are missing; a stop by signal comes before all else."""
    if fits is None or studies is None or isinstance(studies, Stopped):
        return studies or fits
    hints = dict.fromkeys(filter(None, (fits.hint, studies.hint)))
    out = type(fits)(f"{fits.message}; {studies.message}", hint="; ".join(hints))
    out.__cause__ = fits
    return out
