"""A whole run in one call: plan, record, fit, judge, report; and the same for a resumed run.

`run` and `resume` differ in their motion alone (`hil.workflow.recording`, `resuming`). What both
have around it, signals, observers, fits, verdict and report, is in `_attended`.

Recorder, dynamics and report are imported when a run begins, so that `hil.run` is there at once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import AnyPath, HilError, SpecError, Tone, card, path_of, values_by_name
from hil.engine import Observer, Observers, SignalWatch, StopSignal, nobody_goes_on
from hil.estimators import models_below
from hil.evaluation import VerdictWord, verdict_word
from hil.planning import Experiment, require_experiment
from hil.recording import RunDirectory
from hil.workflow.motion_confirmation import Confirm, Granted, Unconfirmed
from hil.workflow.operator import OperatorChannel, console_channel
from hil.workflow.remote_control import hold_attempt

if TYPE_CHECKING:
    from hil.evaluation import Judged
    from hil.robot import Robot
    from hil.workflow.recording import Attendance, Recorded


def run(
    experiment: Experiment,
    *,
    runs: AnyPath = "runs",
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: OperatorChannel | None = None,
    robot: str | None = None,
) -> RunReport:
    """Plan, run, record, fit, judge and report.

    Args:
        experiment: From `load`.
        runs: Where run directories are kept.
        operator: Name of the operator; by default the user of this process.
        observers: Receive progress events, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: Name of the experiment's robot, which confirms that it may move; a real robot does
            not move without it.

    Returns:
        The report; a run that ended early says so in `outcome` and `error` and is not raised.

    Raises:
        NotConfirmed: The robot is real and was not named.
        SpecError: `robot` is not the robot of the experiment.
        HilError: What else went wrong before there was a run directory.
    """
    require_experiment(experiment)
    if robot not in (None, experiment.spec.robot):
        raise SpecError(
            f"robot={robot!r} is not the robot of {experiment.spec.name}",
            hint=f"its robot is {experiment.spec.robot!r} of {experiment.station_source}",
        )
    return run_opened(
        experiment,
        None,
        runs=path_of(runs),
        operator=operator,
        observers=observers,
        waivers=_reasons(waivers),
        desk=_confirming(desk, robot, operator),
    )


def _reasons(waivers: Mapping[str, str] | None) -> dict[str, str]:
    """Return the reason of each waiver, without space around it.

    Raises:
        SpecError: They are no reasons by check; a waiver without a reason is none.
    """
    example = "{'disk': 'another disk comes on Monday'}"
    reasons = values_by_name(waivers, "waivers", example)
    for check, reason in reasons.items():
        if not (isinstance(reason, str) and reason.strip()):
            raise SpecError(
                f"the waiver of {check!r} gives no reason", hint=f"for example: waivers={example}"
            )
    return {check: reason.strip() for check, reason in reasons.items()}


def _confirming(desk: OperatorChannel | None, robot: str | None, operator: str) -> OperatorChannel:
    """Return the desk; the motion counts as confirmed if the call names the robot."""
    confirm: Confirm = Unconfirmed() if desk is None else desk.confirm
    if robot is not None:
        confirm = Granted("robot=", operator, {"robot": robot})
    return replace(desk or console_channel(operator), confirm=confirm)


def run_opened(
    experiment: Experiment,
    opened: Robot | None,
    *,
    runs: Path,
    operator: str,
    observers: Sequence[Observer],
    waivers: Mapping[str, str],
    desk: OperatorChannel,
) -> RunReport:
    """Run an experiment whose robot its caller has opened already, or None; see `run`."""
    from hil.workflow.recording import record

    def motion(attendance: Attendance) -> Recorded:
        return record(experiment, runs=runs, attendance=attendance, opened=opened)

    return _attended(experiment, motion, operator, observers, waivers, desk)


def _attended(
    experiment: Experiment,
    motion: Callable[[Attendance], Recorded],
    operator: str,
    observers: Sequence[Observer],
    waivers: Mapping[str, str],
    desk: OperatorChannel,
) -> RunReport:
    """Execute the motion, then fit, judge and report, with signals and observers throughout."""
    from hil.engine import require_waivable
    from hil.workflow.recording import Attendance

    require_waivable(waivers)
    watching = Observers(tuple(observers))
    signals = SignalWatch(attended=desk.go_on is not nobody_goes_on)
    page: Path | None = None
    try:
        with signals, contextlib.ExitStack() as until_judged:
            try:
                recorded = motion(
                    Attendance(
                        watching,
                        signals,
                        desk.prompt,
                        desk.go_on,
                        operator,
                        waivers,
                        desk.wait_s,
                        desk.confirm,
                        until_judged,
                    )
                )
            except (Exception, StopSignal):
                # A library that was interrupted may raise an error of its own instead.
                if signals.seen:
                    raise signals.stopped() from None
                raise
            from hil.report import render_report
            from hil.workflow.judging import judge_and_study

            judged: list[Judged] = []
            error = judge_and_study(experiment, recorded, signals, watching, judged.append)
            watching.publish({"kind": "stage", "stage": "writing the report"})
            with signals.guard():
                try:
                    page = render_report(recorded.directory.path, judged)
                except HilError as problem:
                    error = error or problem
    finally:
        watching.close()
    directory, counts = recorded.directory, recorded.counts
    return RunReport(
        run=directory.path,
        uid=str(directory.start["uid"]),
        outcome=str(recorded.result.outcome),
        verdict=verdict_word(directory.path),
        samples=counts["samples"],
        gaps=counts["gaps"],
        duplicates=counts["duplicates"],
        models=tuple(models_below(directory.path)),
        report=page,
        error=error,
    )


def resume(
    run: AnyPath,
    *,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: OperatorChannel | None = None,
    robot: str | None = None,
) -> RunReport:
    """Resume a run that ended early: what is complete stays, the rest is measured and judged.

    A run in which everything was measured, but nothing judged, is judged.

    Args:
        run: The run directory.
        operator: Name of the operator; by default the user of this process.
        observers: Receive progress events, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: Name of the run's robot, which confirms that it may move; needed for a real robot
            unless address, payload and all of the motion were confirmed when the run began.

    Returns:
        The report over all attempts.

    Raises:
        DataError: The run has nothing left to do, or its plan or spec was changed.
        PreflightFailed: It is another robot.
        NotConfirmed: Address or payload of a real robot changed, or the arm stands where the way
            back sweeps more than was confirmed, and `robot` does not name it.
        HilError: What else keeps the run from going on.
    """
    folder, desk, reasons = path_of(run), _confirming(desk, robot, operator), _reasons(waivers)
    from hil.workflow.resuming import open_unfinished, recorded_before, resume_recording

    RunDirectory.open(folder)
    # Held before anything is read: two processes must not measure what is missing.
    with hold_attempt(folder):
        unfinished = open_unfinished(folder)

        def motion(attendance: Attendance) -> Recorded:
            if unfinished.complete.missing:
                return resume_recording(unfinished, attendance)
            return recorded_before(unfinished)

        return _attended(unfinished.experiment, motion, operator, observers, reasons, desk)


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """Result of an experiment.

    Attributes:
        run: The run directory.
        uid: Its identity.
        outcome: `completed`, `stopped`, `tripped` or `failed`.
        verdict: Of the models on held-out data; `not judged` when the run ended early or the
            spec has no criteria.
        samples, gaps, duplicates: Of the robot record, by device clock.
        models: Folders of the models, by name.
        report: The HTML page; None if it could not be made.
        error: What ended the run or the fit early; None if nothing did.
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
        """Return the card for a notebook."""
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
        """Return the contract of `hil run --json`."""
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
