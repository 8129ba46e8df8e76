"""The worker processes of a fleet run: one robot's run each.

A process has one robot's run for itself: signals are the run's, and nobody ends another's. The
first signal to the fleet stops every arm and begins no other, each further one is passed on: the
third ends the workers as it would end a run. A worker whose fleet process dies stops its arm.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import HilError, RobotError, Stopped, errors, one_thread
from hil.engine import WATCHED, nobody_goes_on
from hil.maintenance.fleet_specs import experiment_for
from hil.models import FleetFolder
from hil.recording import RunDirectory
from hil.workflow import Ended, Together, Unconfirmed, check_driver, console_desk
from hil.workflow import resume as resume_experiment
from hil.workflow import run as run_experiment

if TYPE_CHECKING:
    from hil.workflow import Confirm, Desk, RunReport


Document = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Manner:
    """How the runs of a fleet are done.

    Attributes:
        workers: Robots at a time.
        operator: Who is at the robots; by default the user of this process.
        waivers: Preflight check → why its failure is accepted.
        confirmed: That their real robots may move; None if they have none.
    """

    workers: int
    operator: str = ""
    waivers: Mapping[str, str] | None = None
    confirmed: Together | None = None


class Workers:
    """The workers of a fleet that are running, one per robot."""

    def __init__(self, folder: FleetFolder, manner: Manner) -> None:
        self._folder, self._manner = folder, manner
        self.going: dict[Connection, tuple[int, BaseProcess]] = {}
        self.stopping = False

    def begin(self, i: int, member: Ended) -> None:
        """Start a worker; Ctrl-C at the terminal does not reach it."""
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(
            target=worker_main, args=(self._job(member), theirs), name=member.robot
        )
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.going[ours] = (i, process)
        if self.stopping:  # the signal came while it was started
            _terminate(process)

    def ended(self) -> Iterator[tuple[int, Document]]:
        """Wait for the next workers to answer, or to die."""
        for answer in wait(list(self.going)):
            assert isinstance(answer, Connection)
            i, process = self.going[answer]
            try:
                document: Document | None = answer.recv()
            except (EOFError, OSError):
                document = None
            _wait_until_gone(process)
            del self.going[answer]  # not before: signals are passed on to it until it has gone
            answer.close()
            yield i, {"error": _cause_of_death(process)} if document is None else document

    def _job(self, member: Ended) -> Job:
        head, manner, run = self._folder.head, self._manner, member.report.get("run")
        before = Path(run) if run and (Path(run) / "plan.json").is_file() else None
        return Job(
            self._folder.spec_of(member.robot), Path(head["source"]).parent, str(head["station"]),
            self._folder.runs, before, manner.operator, manner.waivers or {},
            manner.confirmed,
        )  # fmt: skip

    @contextmanager
    def signals(self) -> Iterator[None]:
        """While inside, signals are passed on to the workers, and interrupt nothing here."""

        def stop(number: int, frame: object) -> None:
            self.stopping = True
            self._pass_on()

        main = threading.current_thread() is threading.main_thread()
        heard = [n for n in WATCHED if main and signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, stop) for number in heard}
        try:
            yield
        except BaseException:
            self._pass_on()  # such as a disk that is full: nobody would see what the arms do
            raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _pass_on(self) -> None:
        for _, process in list(self.going.values()):
            _terminate(process)


def _terminate(process: BaseProcess) -> None:
    if process.pid is not None and process.exitcode is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)


GONE_S = 10.0
"""In which a worker that has answered should have gone by itself [s]."""


def _wait_until_gone(process: BaseProcess) -> None:
    """Wait until a worker that has answered is gone; the arm is at rest, and nobody hangs on it."""
    process.join(GONE_S)
    for end in (process.terminate, process.kill):
        if process.exitcode is None:
            end()
            process.join(GONE_S)


def _cause_of_death(process: BaseProcess) -> Document:
    code = process.exitcode or 0
    if code in (-signal.SIGTERM, 130):
        return {"kind": "Stopped", "message": "stopped by SIGTERM"}
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return {"kind": "RobotError", "message": f"the process of its run died ({how})"}


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


def worker_main(job: Job, answer: Connection) -> None:
    """Do a job, and answer with the run's report as JSON has it; the entry of a worker process.

    Ctrl-C is for the process that started this one, which says here by SIGTERM what it means. When
    that process dies, the motion is stopped.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="hil-parent", daemon=True).start()
    with one_thread():
        answer.send(run_job(job))


def _end_with_parent() -> None:
    """An arm whose fleet has gone is nobody's: it is stopped, as by SIGTERM."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def run_job(job: Job) -> Document:
    """Return the report of a job's run as JSON has it; with `error` where it did not go well."""
    try:
        report = _run_attended(job)
    except HilError as error:
        return {"error": _error_document(error)}
    except Exception as error:  # drivers are plug-ins: whatever one of them raises is this robot's
        return {"error": {"kind": "RobotError", "message": f"{type(error).__name__}: {error}"}}
    document = report.to_dict()
    return document | ({"error": _error_document(report.error)} if report.error else {})


def _run_attended(job: Job) -> RunReport:
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
    station = Path(job.station) if job.station else None
    experiment = experiment_for(job.spec.read_text("utf-8"), job.folder, station, job.spec)
    check_driver(experiment)
    at = desk(together.begin(experiment) if together else None)
    return run_experiment(
        experiment, runs=job.runs, operator=job.operator, waivers=job.waivers, desk=at
    )


def _error_document(error: HilError) -> Document:
    return {"kind": type(error).__name__, "message": error.message, "hint": error.hint}


def error_of(answer: Document) -> HilError | None:
    """Return the error in a worker's answer, of the class it had there; None without one."""
    document = answer.get("error")
    if document is None:
        return None
    kind = getattr(errors, str(document["kind"]), RobotError)
    error = kind(document["message"], hint=document.get("hint", ""))
    if isinstance(error, Stopped):
        error.by_signal = True
    assert isinstance(error, HilError)
    return error
