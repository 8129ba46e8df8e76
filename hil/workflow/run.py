"""The main job: record, fit, judge, report; one call, one run directory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import HilError
from hil.engine import Observer, Observers, SignalWatch, StopSignal, nobody_goes_on
from hil.estimators import models_below
from hil.evaluation import VerdictWord, verdict_word
from hil.planning import Experiment
from hil.recording import RunDirectory
from hil.workflow.desk import Desk, console_desk

if TYPE_CHECKING:
    from hil.workflow.attempt import Recorded
    from hil.workflow.execute import Attendance


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """What came of an experiment.

    Attributes:
        run: The run directory.
        uid: Its identity.
        outcome: `completed`, `stopped`, `tripped` or `failed`.
        verdict: Of the models on held-out data; `not judged` when the run ended early or the
            spec has no criteria.
        samples, gaps, duplicates: Of the robot record, by device clock.
        models: Folders of what was fitted, by name.
        report: The HTML page, None if it could not be made.
        error: What ended the run or the fit early.
    """

    run: Path
    uid: str
    outcome: str
    verdict: VerdictWord
    samples: int
    gaps: int
    duplicates: int
    models: tuple[Path, ...]
    report: Path | None
    error: HilError | None = None

    def __repr__(self) -> str:
        return f"<RunReport {self.run}: {self.outcome}, {self.verdict}>"

    def _repr_html_(self) -> str:
        """Itself in a notebook."""
        from hil.core import Tone, card

        tones: dict[str, Tone] = {"passed": "pass", "rejected": "fail"}
        facts = {
            "outcome": self.outcome,
            "samples": f"{self.samples:,}",
            "gaps": self.gaps,
            "duplicates": self.duplicates,
            "models": ", ".join(folder.name for folder in self.models),
            "report": self.report or "",
        }
        notes = [self.error.message] if self.error else []
        badge = (self.verdict, tones.get(self.verdict, "warn"))
        return card("Run", self.run, facts, badge=badge, notes=notes)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil run --json`."""
        out: dict[str, Any] = {
            "run": str(self.run),
            "uid": self.uid,
            "outcome": self.outcome,
            "verdict": self.verdict,
            "samples": self.samples,
            "gaps": self.gaps,
            "duplicates": self.duplicates,
            "models": [str(folder) for folder in self.models],
            "report": str(self.report) if self.report else None,
        }
        if self.error is not None:
            out["error"] = {"kind": type(self.error).__name__, "message": self.error.message}
        return out


def run_experiment(
    experiment: Experiment,
    *,
    runs: Path,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
) -> RunReport:
    """Run an experiment to the end of what is possible.

    Args:
        experiment: What to do, and where.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events.
        waivers: Preflight check → why its failure is accepted.
        desk: Where prompts are answered and pauses are ended; by default the console.

    Raises:
        HilError: What went wrong before there was a run directory; later errors are in the report.
    """
    from hil.workflow.recording import record

    def motion(attendance: Attendance) -> Recorded:
        return record(experiment, runs=runs, attendance=attendance)

    return _attended(experiment, motion, operator, observers, waivers or {}, desk)


def resume_experiment(
    run: Path,
    *,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
) -> RunReport:
    """Go on with a run that ended early, from the last measurement that is whole.

    A run in which everything was measured, but nothing judged, is judged.

    Args:
        run: The run directory.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events.
        waivers: Preflight check → why its failure is accepted.
        desk: Where prompts are answered and pauses are ended; by default the console.

    Raises:
        HilError: What keeps the run from being resumed; later errors are in the report.
    """
    from hil.workflow.control_files import hold_attempt
    from hil.workflow.resuming import open_unfinished, recorded_before, resume_recording

    RunDirectory.open(run)
    # Held before anything is looked at: what is missing must not be measured by two at once.
    with hold_attempt(run):
        unfinished = open_unfinished(run)

        def motion(attendance: Attendance) -> Recorded:
            if unfinished.complete.missing:
                return resume_recording(unfinished, attendance)
            return recorded_before(unfinished)

        return _attended(unfinished.experiment, motion, operator, observers, waivers or {}, desk)


def _attended(
    experiment: Experiment,
    motion: Callable[[Attendance], Recorded],
    operator: str,
    observers: Sequence[Observer],
    waivers: Mapping[str, str],
    desk: Desk | None,
) -> RunReport:
    """Motion, fit, verdict and report, with signals and observers looked after."""
    from hil.engine import require_waivable
    from hil.workflow.execute import Attendance

    require_waivable(waivers)
    watching, at = Observers(tuple(observers)), desk or console_desk(operator)
    signals = SignalWatch(attended=at.go_on is not nobody_goes_on)
    try:
        with signals, contextlib.ExitStack() as until_judged:
            try:
                recorded = motion(
                    Attendance(
                        watching,
                        signals,
                        at.prompt,
                        at.go_on,
                        operator,
                        waivers,
                        at.wait_s,
                        at.confirm,
                        until_judged,
                    )
                )
            except (Exception, StopSignal):
                # A library that was interrupted may raise an error of its own instead.
                if signals.seen:
                    raise signals.stopped() from None
                raise
            from hil.workflow.afterwards import judge_and_study

            error = judge_and_study(experiment, recorded, signals, watching)
            watching.publish({"kind": "stage", "stage": "writing the report"})
            with signals.guard():
                page, problem = _report(recorded.directory.path)
    finally:
        watching.close()
    return _told(recorded, page, error or problem)


def _told(recorded: Recorded, page: Path | None, error: HilError | None) -> RunReport:
    return RunReport(
        run=recorded.directory.path,
        uid=str(recorded.directory.start["uid"]),
        outcome=str(recorded.result.outcome),
        verdict=verdict_word(recorded.directory.path),
        samples=recorded.counts["samples"],
        gaps=recorded.counts["gaps"],
        duplicates=recorded.counts["duplicates"],
        models=tuple(models_below(recorded.directory.path)),
        report=page,
        error=error,
    )


def _report(run: Path) -> tuple[Path | None, HilError | None]:
    from hil.report import render_report

    try:
        return render_report(run), None
    except HilError as error:
        return None, error
