"""Complete runs in one call: plan, record, fit, judge and report, for new and for resumed runs.

The functions `run` and `resume` differ only in their motion (`hil.workflow.recording`,
`hil.workflow.resuming`). The function `_attended` contains the part that `run` and `resume` share:
signals, observers, fits, verdict and report.

The modules for recorder, dynamics and report are imported only when a run begins, so that `import
hil` is fast.
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
    """Run an experiment: plan, record, fit, evaluate and report.

    Args:
        experiment: Experiment returned by `load`.
        runs: Folder in which the run directory is created.
        operator: Name of the operator; by default the user of this process.
        observers: Receivers of progress events, each called on a separate thread.
        waivers: Reason for accepting a failed preflight check, by name of the check; the reasons
            are recorded.
        desk: Channel through which prompts are answered and pauses are ended; by default the
            console.
        robot: Name of the experiment's robot, which confirms that the robot may move; a real robot
            does not move without this confirmation.

    Returns:
        Report of the run and its models. An error that ends the run early is not raised: the report
        contains the error in `outcome` and `error`.

    Raises:
        NotConfirmed: The robot of the experiment is real, and `robot` does not name it.
        SpecError: `robot` is not the robot of the experiment.
        HilError: A different error occurred before the run directory was created.
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
    """Return the reason of each waiver, without surrounding white space.

    Raises:
        SpecError: `waivers` is not a mapping of names to texts, or a reason is empty.
    """
    example = "{'disk': 'the recording is short'}"
    reasons = values_by_name(waivers, "waivers", example)
    for check, reason in reasons.items():
        if not (isinstance(reason, str) and reason.strip()):
            raise SpecError(
                f"the waiver of {check!r} has no reason", hint=f"for example: waivers={example}"
            )
    return {check: reason.strip() for check, reason in reasons.items()}


def _confirming(desk: OperatorChannel | None, robot: str | None, operator: str) -> OperatorChannel:
    """Return the operator channel; if `robot` is passed, the motion counts as confirmed."""
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
    """Run an experiment with a robot that the caller has possibly already opened; see `run`."""
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
    """Execute the motion, then fit, evaluate and report; react to signals in all of these steps."""
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
                # An interrupted library may raise a different error than StopSignal.
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
    """Resume a run that ended early: measure what is missing, then fit and evaluate.

    Complete measurements of the run are not repeated. If everything was measured but the run has no
    verdict, the run is only fitted and evaluated.

    Args:
        run: Run directory.
        operator: Name of the operator; by default the user of this process.
        observers: Receivers of progress events, each called on a separate thread.
        waivers: Reason for accepting a failed preflight check, by name of the check; the reasons
            are recorded.
        desk: Channel through which prompts are answered and pauses are ended; by default the
            console.
        robot: Name of the run's robot, which confirms that the robot may move; required for a real
            robot unless address, payload and complete motion were confirmed when the run began.

    Returns:
        Report over all attempts of the run.

    Raises:
        DataError: The run is already complete, or its plan or spec was changed.
        PreflightFailed: The connected robot is not the robot with which the run began.
        NotConfirmed: The address or payload of a real robot changed, or the motion back to the plan
            sweeps more space than was confirmed, and `robot` does not name the robot.
        HilError: A different error prevents resuming the run.
    """
    folder, desk, reasons = path_of(run), _confirming(desk, robot, operator), _reasons(waivers)
    from hil.workflow.resuming import open_unfinished, recorded_before, resume_recording

    RunDirectory.open(folder)
    # Locked before reading, so that no two processes measure the missing part.
    with hold_attempt(folder):
        unfinished = open_unfinished(folder)

        def motion(attendance: Attendance) -> Recorded:
            if unfinished.complete.missing:
                return resume_recording(unfinished, attendance)
            return recorded_before(unfinished)

        return _attended(unfinished.experiment, motion, operator, observers, reasons, desk)


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """Result of an experiment: outcome, verdict, models and report.

    Attributes:
        run: Run directory.
        uid: Unique identifier of the run.
        outcome: Outcome of the motion: `completed`, `stopped`, `tripped` or `failed`.
        verdict: Verdict on the models, from held-out data; `not judged` if the run ended early or
            the spec has no criteria.
        samples, gaps, duplicates: Number of samples, gaps and repeated time stamps in the robot
            record, by the device clock.
        models: Paths of the model folders, sorted by name.
        report: Path of the HTML report; None if the report could not be written.
        error: Error that ended the run or the fit early; None if there was no error.
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
        """Return the HTML card for a notebook."""
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
        """Return the JSON output of `hil run --json`."""
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
