"""One robot's run in a process of its own, which it has for itself: signals are the run's."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import HilError, one_thread
from hil.engine import nobody_goes_on
from hil.maintenance.fleet.members import experiment_for
from hil.recording import RunDirectory
from hil.workflow import Unconfirmed, check_driver, console_desk
from hil.workflow import resume as resume_experiment
from hil.workflow import run as run_experiment

if TYPE_CHECKING:
    from hil.planning import Experiment
    from hil.workflow import Confirm, Desk, RunReport, Together


@dataclass(frozen=True, slots=True)
class Job:
    """What a worker is to do.

    Attributes:
        spec: The spec as the robot runs it.
        folder: Where relative paths in it begin.
        station: The station's file; empty for the one an experiment there would use.
        runs: Where run directories are kept.
        before: A run to go on with; None to begin one.
        operator: Who is at the robots.
        waivers: Preflight check → why its failure is accepted.
        confirmed: That the fleet's real robots may move; None if it has none.
    """

    spec: Path
    folder: Path
    station: str
    runs: Path
    before: Path | None = None
    operator: str = ""
    waivers: Mapping[str, str] = field(default_factory=dict)
    confirmed: Together | None = None


def work(job: Job, answer: Connection) -> None:
    """Do a job, and answer with the run's report as JSON has it; the entry of a worker process.

    Ctrl-C is for the process that started this one, which says here by SIGTERM what it means. When
    that process dies, the motion is stopped.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="hil-parent", daemon=True).start()
    with one_thread():
        answer.send(_done(job))


def _done(job: Job) -> dict[str, Any]:
    try:
        report = _run(job)
    except HilError as error:
        return {"error": _told(error)}
    except Exception as error:  # drivers are plug-ins: whatever one of them raises is this robot's
        return {"error": {"kind": "RobotError", "message": f"{type(error).__name__}: {error}"}}
    told = report.to_dict()
    return told if report.error is None else told | {"error": _told(report.error)}


def _told(error: HilError) -> dict[str, Any]:
    return {"kind": type(error).__name__, "message": error.message, "hint": error.hint}


def _run(job: Job) -> RunReport:
    def desk(confirm: Confirm | None) -> Desk:
        refused = Unconfirmed("start it with: hil fleet run")
        attended = console_desk(job.operator, confirm=confirm or refused)
        # A worker has no console: nothing typed ends a pause.
        return replace(attended, go_on=nobody_goes_on)

    together, before = job.confirmed, job.before
    if before is not None:
        robot = str(RunDirectory.open(before).start.get("robot_name", ""))
        at = desk(together.resume(robot, before) if together else None)
        return resume_experiment(before, operator=job.operator, waivers=job.waivers, desk=at)
    experiment = _experiment(job)
    check_driver(experiment)
    at = desk(together.begin(experiment) if together else None)
    return run_experiment(
        experiment, runs=job.runs, operator=job.operator, waivers=job.waivers, desk=at
    )


def _experiment(job: Job) -> Experiment:
    station = Path(job.station) if job.station else None
    return experiment_for(job.spec.read_text("utf-8"), job.folder, station, job.spec)


def _end_with_parent() -> None:
    """An arm whose fleet has gone is nobody's: it is stopped, as by SIGTERM."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
