"""The main job: record, fit, judge, report; one call, one run directory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hil.core import HilError
from hil.engine import (
    Observer,
    Observers,
    SignalWatch,
    StopSignal,
    nobody_goes_on,
    require_waivable,
)
from hil.estimators import models_below
from hil.evaluation import verdict_word
from hil.planning import Experiment
from hil.recording import RunDirectory
from hil.report import render_report
from hil.workflow.control_files import hold_attempt
from hil.workflow.desk import Desk, console_desk
from hil.workflow.execute import Attendance
from hil.workflow.recording import record
from hil.workflow.run_report import RunReport

if TYPE_CHECKING:
    from hil.evaluation import Judged
    from hil.robot import Robot
    from hil.workflow.attempt import Recorded


def run_experiment(
    experiment: Experiment,
    *,
    runs: Path,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
    robot: Robot | None = None,
) -> RunReport:
    """Run an experiment to the end of what is possible.

    Args:
        experiment: What to do, and where.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events.
        waivers: Preflight check → why its failure is accepted.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: The experiment's robot, if it is open already; it is closed after the motion.

    Raises:
        HilError: What went wrong before there was a run directory; later errors are in the report.
    """

    def motion(attendance: Attendance) -> Recorded:
        return record(experiment, runs=runs, attendance=attendance, opened=robot)

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

            judged: list[Judged] = []
            error = judge_and_study(experiment, recorded, signals, watching, judged.append)
            watching.publish({"kind": "stage", "stage": "writing the report"})
            with signals.guard():
                page, problem = _report(recorded.directory.path, judged)
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


def _report(run: Path, judged: Sequence[Judged]) -> tuple[Path | None, HilError | None]:
    try:
        return render_report(run, judged), None
    except HilError as error:
        return None, error
