"""A run that belongs to an occasion: moved once, however often somebody dies meanwhile.

Its start document names the occasion before anything moves. Whoever comes after a crash looks for
it there: a run that is complete is taken as it is, one that was cut off is gone on with.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hil.core import HilError, RobotError, Stopped, exit_code_of
from hil.engine import Observer, nobody_goes_on
from hil.planning import Experiment, held, opened
from hil.recording import RunDirectory, run_folders
from hil.report import render_report
from hil.robot import address_of
from hil.spec import StudyEntry, spec_hash
from hil.workflow import (
    Confirm,
    Console,
    ConsoleOperator,
    Desk,
    RunReport,
    Unconfirmed,
    describe_robot,
    missing_studies,
    require_same_robot,
    run_studies,
    whole,
)
from hil.workflow import resume as resume_experiment
from hil.workflow import run as run_experiment

BY_SIGNAL = exit_code_of(Stopped("", by_signal=True))


@dataclass(frozen=True, slots=True)
class Measuring:
    """How runs are made that nobody attends.

    Attributes:
        runs: Where run directories are kept.
        wait_s: How long to wait for a robot that somebody else holds [s].
        observers: Receive progress events.
        operator: Recorded; by default the user of this process.
        confirm: Confirms that a real robot may move; by default it may not.
    """

    runs: Path
    wait_s: float = 0.0
    observers: Sequence[Observer] = ()
    operator: str = ""
    confirm: Confirm = field(default_factory=Unconfirmed)

    def measure(self, experiment: Experiment, occasion: str) -> Path:
        """The run of an occasion: found, gone on with, or made now.

        Args:
            experiment: What is to be done.
            occasion: Unique among all runs with this spec.

        Returns:
            The run directory; its recording is complete and it was judged.

        Raises:
            NotConfirmed: A real robot may not, or no longer, be moved.
            RobotError: The run of this occasion was ended by something other than a crash or a
                signal: nobody is there to look before the arm moves again.
            HilError: It cannot be begun, or ended early.
        """
        found = run_of(self.runs, experiment, occasion)
        if found is None:
            begun = replace(experiment, occasion=occasion)
            return self._judged(run_experiment(begun, runs=self.runs, **self._attendance()))
        if _is_done(found):
            self._require_its_robot(found, experiment)
            _complete_views(found, experiment.spec.study)
            return found
        _require_harmless(found)
        self._require_confirmed(experiment)
        return self._judged(resume_experiment(found, **self._attendance()))

    def _attendance(self) -> dict[str, Any]:
        operator = ConsoleOperator(console=_NoConsole())
        desk = Desk(operator, nobody_goes_on, self.wait_s, self.confirm)
        return {"desk": desk, "observers": self.observers, "operator": self.operator}

    def _require_its_robot(self, run: Path, experiment: Experiment) -> None:
        """What goes on is done with the arm that made it, as in a run that is gone on with."""
        with held(experiment, wait_s=self.wait_s, report=lambda text: None) as (robot, _):
            require_same_robot(RunDirectory.open(run), describe_robot(robot, experiment.robot))

    def _require_confirmed(self, experiment: Experiment) -> None:
        """What was confirmed when the run began may be withdrawn: a schedule is armed no more."""
        name = experiment.spec.robot
        with opened(name, experiment.robot) as robot:
            at = address_of(robot)
        if at.real:
            self.confirm.admit(name, at.text)

    def _judged(self, report: RunReport) -> Path:
        if not _is_done(report.run):
            told = f"{report.run} ended early: {report.outcome}"
            raise report.error or RobotError(told, hint=f"hil show {report.run}")
        return report.run


def run_of(runs: Path, experiment: Experiment, occasion: str) -> Path | None:
    """The run of an occasion with this spec at this station; None if nothing has begun.

    Schedules of one name may share a folder of runs, and be due at the same time on two robots.
    """
    said = json.dumps(occasion, ensure_ascii=False).encode()
    wanted = {
        "occasion": occasion,
        "spec_hash": spec_hash(experiment.spec),
        "station": whole(experiment.station_source),
    }
    for path in reversed(run_folders(runs)):
        try:
            raw = (path / "start.json").read_bytes()
            start = json.loads(raw) if said in raw else {}
            station = (path / "station.yaml").read_text("utf-8")
        except (OSError, ValueError):
            continue
        if station == experiment.station_text and wanted.items() <= start.items():
            return path
    return None


class _NoConsole(Console):
    """Nobody sits here, also where the scheduler was started in a terminal."""

    @property
    def present(self) -> bool:
        """Never."""
        return False


def _is_done(run: Path) -> bool:
    """Only what was measured to its end is judged; whoever judged it after a crash ended no run."""
    return RunDirectory(run).is_judged


def _complete_views(run: Path, entries: Sequence[StudyEntry]) -> None:
    """Make the missing studies and report of a run whose process died after its verdict."""
    if RunDirectory(run).is_reported:
        return
    with contextlib.suppress(HilError):  # a study that fails does not invalidate the run
        run_studies(run, missing_studies(run, entries))
    with contextlib.suppress(HilError):
        render_report(run)


def _require_harmless(run: Path) -> None:
    """A crash or a signal says nothing against going on, nor does a motion that came to its end."""
    directory = RunDirectory.open(run)
    stop = directory.stop
    if stop is None:
        told = _told_by_events(directory.events())
    elif stop.get("outcome") == "completed" or stop.get("exit_code") == BY_SIGNAL:
        told = ""
    else:
        told = f"{stop.get('outcome')}: {stop.get('reason')}"
    if told:
        raise RobotError(
            f"{run} was {told}",
            hint=f"look at the robot, then go on with: hil resume {run}",
        )


def _told_by_events(events: Sequence[Mapping[str, Any]]) -> str:
    """Why the last attempt was being ended when its process died; empty if it was not."""
    told = ""
    for event in events:
        if event["kind"] in ("trip", "hung"):
            told = f"tripped: {event.get('reason')}"
        elif event.get("state") == "preflight":  # another attempt, which somebody has let go on
            told = ""
        elif event.get("state") == "stopping" and event.get("reason"):
            told = told or ("" if event.get("by_signal") else f"stopped: {event['reason']}")
    return told
