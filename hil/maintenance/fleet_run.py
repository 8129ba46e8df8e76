"""A fleet run: one experiment on many robots of a station, some at a time.

Every robot's run is made by a worker process of its own, so that signals are the run's and no run
ends another's. What a robot has measured and judged is not done again; a run that ended early is
resumed. The document of the fleet (`hil.recording.FleetGroup`) is written anew after every robot,
and where it says less than the runs themselves (this process was killed), the runs count.

The first signal to the fleet stops every arm and starts no other, each further one is passed on:
the third ends the workers as it would end a run. A worker whose fleet process dies stops its arm.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import (
    HilError,
    Rejected,
    RobotError,
    Stopped,
    errors,
    exit_code_of,
    one_thread,
    process_context,
)
from hil.engine import WATCHED, nobody_goes_on
from hil.estimators import models_below
from hil.evaluation import verdict_word
from hil.maintenance.fleet_specs import experiment_for
from hil.recording import FleetGroup, Member, RunDirectory, worst_error
from hil.workflow import Together, Unconfirmed, check_driver, console_channel
from hil.workflow import resume as resume_experiment
from hil.workflow import run as run_experiment

if TYPE_CHECKING:
    from hil.workflow import Confirm, OperatorChannel, RunReport

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


@dataclass(frozen=True, slots=True)
class FleetReport:
    """The result of a fleet run.

    Attributes:
        folder: Of the fleet.
        members: Every robot whose run was started, now or before.
        left: Names of the others.
    """

    folder: Path
    members: tuple[Member, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """The worst: a stop, a robot that did not measure all, a missing model, a rejection."""
        worst = worst_error(self.members)
        if self.left and not isinstance(worst, Stopped):
            return Stopped(
                f"{len(self.left)} robots were not begun",
                by_signal=True,
                hint="hil fleet resume FOLDER goes on with them",
            )
        rejected = [member for member in self.members if member.word == "rejected"]
        if worst is None and rejected:
            return Rejected(
                f"{len(rejected)} of {len(self.members)} models missed their criteria",
                hint="hil fleet report FOLDER shows which and by how much",
            )
        return worst

    def to_dict(self) -> Document:
        """Return the contract of `hil fleet run --json`."""
        return {
            "fleet": str(self.folder),
            "robots": [member.to_dict() for member in self.members],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


OnEnd = Callable[[Member, int, int], object]
"""Called with a robot whose run has ended, how many have, and how many robots there are."""


def run_fleet(group: FleetGroup, manner: Manner, tell: OnEnd) -> FleetReport:
    """Run what is left of a fleet.

    Args:
        group: Its folder, held by this process.
        manner: How runs are made.
        tell: Called with every robot whose run has ended.
    """
    members = [_with_newest_run(group, member) for member in group.members()]
    todo = deque(i for i, member in enumerate(members) if not member.measured)
    workers = Workers(group, manner)
    with workers.signals():
        while (todo and not workers.stopping) or workers.running:
            while todo and not workers.stopping and len(workers.running) < manner.workers:
                i = todo.popleft()
                workers.start(i, members[i])
            for i, answer in workers.answers():
                members[i] = _after_worker(group, members[i], answer)
                group.write(members)
                ended = len(members) - len(todo) - len(workers.running)
                tell(members[i], ended, len(members))
    begun = [i for i, member in enumerate(members) if i not in todo or member.report]
    return FleetReport(
        group.path,
        tuple(members[i] for i in begun),
        tuple(members[i].robot for i in todo if i not in begun),
    )


def _with_newest_run(group: FleetGroup, member: Member) -> Member:
    """Return a robot as its newest run has it, if that says more than the document."""
    run = None if member.measured else group.run_of(member.robot)
    return member if run is None else replace(member, report=_report_from_disk(run), error=None)


def _report_from_disk(run: Path) -> Document:
    """Return a run's report as far as its directory tells it."""
    directory = RunDirectory.open(run)
    status = directory.status
    page = run / "report.html"
    return {
        "run": str(run),
        "uid": directory.start.get("uid", ""),
        # Measured in full, but not judged: resuming the run does that.
        "outcome": "interrupted" if status == "completed" and not directory.is_judged else status,
        "verdict": verdict_word(run),
        "models": [str(folder) for folder in models_below(run)],
        "report": str(page) if page.is_file() else None,
    }


def _after_worker(group: FleetGroup, before: Member, answer: Document) -> Member:
    """Return a robot by its worker's answer; if the worker died, by its run."""
    about = {"experiment": before.experiment, "robot": before.robot}
    after = Member.from_dict({**answer, **about})
    if isinstance(after.error, Stopped):
        after.error.by_signal = True
    if not after.report and (run := group.run_of(before.robot)) is not None:
        after = replace(after, report=_report_from_disk(run))
    died_after_all = isinstance(after.error, RobotError) and after.measured
    return replace(after, error=None) if died_after_all else after


def robots_left(group: FleetGroup) -> list[str]:
    """Return the robots without a run; resumed runs keep their own confirmation."""
    return [one.robot for one in group.members() if group.run_of(one.robot) is None]


class Workers:
    """The worker processes of a fleet, one per robot.

    Args:
        group: Of the fleet.
        manner: How runs are made.

    Attributes:
        running: Where each worker answers → its number and its process.
        stopping: Whether a signal has come: no further worker is started.
    """

    def __init__(self, group: FleetGroup, manner: Manner) -> None:
        self._group, self._manner = group, manner
        self.running: dict[Connection, tuple[int, BaseProcess]] = {}
        self.stopping = False

    @contextmanager
    def signals(self) -> Iterator[None]:
        """Pass signals on to the workers while inside; they interrupt nothing here."""

        def stop(number: int, frame: object) -> None:
            self.stopping = True
            self._pass_on()

        main = threading.current_thread() is threading.main_thread()
        heard = [n for n in WATCHED if main and signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, stop) for number in heard}
        try:
            yield
        except BaseException:
            self._pass_on()  # such as a full disk: the arms would go on without supervision
            raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _pass_on(self) -> None:
        for _, process in list(self.running.values()):
            _terminate(process)

    def start(self, i: int, member: Member) -> None:
        """Start the worker of a robot; Ctrl-C at the terminal does not reach it."""
        context = process_context(__name__)
        ours, theirs = context.Pipe(duplex=False)
        args = (self._job(member), theirs, dict(os.environ))
        process = context.Process(target=worker_main, args=args, name=member.robot)
        process.start()
        theirs.close()
        self.running[ours] = (i, process)
        if self.stopping:  # the signal came while it was started
            _terminate(process)

    def _job(self, member: Member) -> Job:
        head, manner, run = self._group.head, self._manner, member.run
        return Job(
            spec=self._group.spec_of(member.robot),
            folder=Path(head["source"]).parent,
            station=str(head["station"]),
            runs=self._group.runs,
            before=run if run is not None and (run / "plan.json").is_file() else None,
            operator=manner.operator,
            waivers=manner.waivers or {},
            confirmed=manner.confirmed,
        )

    def answers(self) -> Iterator[tuple[int, Document]]:
        """Wait for the next workers to answer or to die; yield the number and the answer of each.

        An answer is the report of the run as `hil run --json` has it, with `error` (`kind`,
        `message`, `hint`) if it did not go well.
        """
        ready: list[Any] = []
        while self.running and not ready:
            ready = wait(list(self.running), SIGNAL_S)
        for connection in ready:
            assert isinstance(connection, Connection)
            i, process = self.running[connection]
            try:
                answer: Document | None = connection.recv()
            except (EOFError, OSError):
                answer = None
            _wait_until_gone(process)
            del self.running[connection]  # not before: signals are passed on to it until it is gone
            connection.close()
            yield i, {"error": _cause_of_death(process)} if answer is None else answer


def _terminate(process: BaseProcess) -> None:
    if process.pid is not None and process.exitcode is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)


GONE_S = 10.0
"""A worker that has replied must exit within this time [s], else it is terminated."""

SIGNAL_S = 0.5
"""Longest single wait [s]: a signal that arrives just before a wait does not end it."""


def _wait_until_gone(process: BaseProcess) -> None:
    """Wait until a worker that has answered is gone; its arm is at rest, so it may be killed."""
    _join(process)
    for end in (process.terminate, process.kill):
        if process.exitcode is None:
            end()
            _join(process)


def _join(process: BaseProcess) -> None:
    end = time.monotonic() + GONE_S
    while process.exitcode is None and (left := end - time.monotonic()) > 0.0:
        process.join(min(left, SIGNAL_S))


def _cause_of_death(process: BaseProcess) -> Document:
    code = process.exitcode or 0
    if code in (-signal.SIGTERM, 130):
        return {"kind": "Stopped", "message": "stopped by SIGTERM"}
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return {"kind": "RobotError", "message": f"the process of its run died ({how})"}


@dataclass(frozen=True, slots=True)
class Job:
    """The run that a worker makes.

    Attributes:
        spec: The spec as the robot runs it.
        folder: Where relative paths in it begin.
        station: The station's file; empty for the one an experiment there would use.
        runs: Where run directories are kept.
        before: A run to resume; None to begin one.
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


def worker_main(job: Job, answer: Connection, environment: Mapping[str, str]) -> None:
    """Do a job in an environment and send the answer; the entry of a worker process.

    Ctrl-C is for the process that started this one, which passes it on as SIGTERM. When that
    process dies, the motion is stopped.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.clear()
    os.environ.update(environment)
    threading.Thread(target=_end_with_parent, name="hil-parent", daemon=True).start()
    with one_thread():
        answer.send(run_job(job))


def _end_with_parent() -> None:
    """Wait for the death of the fleet's process, then stop the arm, as by SIGTERM."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def run_job(job: Job) -> Document:
    """Return the answer of a job's run, see `Workers.answers`."""
    try:
        report = _run_attended(job)
    except HilError as error:
        return {"error": _error_document(error)}
    except Exception as error:  # drivers are plug-ins: whatever one of them raises is its robot's
        return {"error": {"kind": "RobotError", "message": f"{type(error).__name__}: {error}"}}
    document = report.to_dict()
    return document | ({"error": _error_document(report.error)} if report.error else {})


def _run_attended(job: Job) -> RunReport:
    def desk(confirm: Confirm | None) -> OperatorChannel:
        refused = Unconfirmed("start it with: hil fleet run")
        attended = console_channel(job.operator, confirm=confirm or refused)
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
    # A plug-in's own class is unknown where the answer is read: its base is sent instead.
    known = (one.__name__ for one in type(error).__mro__ if hasattr(errors, one.__name__))
    return {"kind": next(known), "message": error.message, "hint": error.hint}
