"""Fleet run: one experiment on many robots of a station, with several robots at a time.

A separate worker process executes the run of each robot, because each run handles signals and must
not end other runs. A robot that is measured and judged is not measured again, and a run that ended
early is resumed. The document of the fleet (`hil.recording.FleetGroup`) is rewritten after every
robot. If the fleet process is killed, the fleet document may be out of date; the run directories
are then authoritative.

After the first signal to the fleet process, every arm stops and no further run starts. Each further
signal is passed to the workers; the third signal ends the workers, as it would end a single run. If
the fleet process dies, each worker stops its arm.
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
    """Settings of the runs of a fleet.

    Attributes:
        workers: Number of robots that run at the same time.
        operator: Name of the operator at the robots; empty for the user of this process.
        waivers: Mapping from a preflight check to the reason why its failure is accepted.
        confirmed: Confirmation that the real robots of the fleet may move; None if the fleet has no
            real robots.
    """

    workers: int
    operator: str = ""
    waivers: Mapping[str, str] | None = None
    confirmed: Together | None = None


@dataclass(frozen=True, slots=True)
class FleetReport:
    """Result of a fleet run.

    Attributes:
        folder: Folder of the fleet.
        members: Robots whose runs were started in this or an earlier fleet run.
        left: Names of robots whose runs were not started.
    """

    folder: Path
    members: tuple[Member, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """Most severe error of all runs: stop, incomplete run, missing model or rejection."""
        worst = worst_error(self.members)
        if self.left and not isinstance(worst, Stopped):
            return Stopped(
                f"{len(self.left)} robots were not started",
                by_signal=True,
                hint="continue with: hil fleet resume FOLDER",
            )
        rejected = [member for member in self.members if member.word == "rejected"]
        if worst is None and rejected:
            return Rejected(
                f"{len(rejected)} of {len(self.members)} models did not meet their criteria",
                hint="see the differences with: hil fleet report FOLDER",
            )
        return worst

    def to_dict(self) -> Document:
        """Return the documented output of `hil fleet run --json`."""
        return {
            "fleet": str(self.folder),
            "robots": [member.to_dict() for member in self.members],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


OnEnd = Callable[[Member, int, int], object]
"""Callback that receives a robot whose run has ended, the number of ended runs and the total number
of robots.
"""


def run_fleet(group: FleetGroup, manner: Manner, tell: OnEnd) -> FleetReport:
    """Run the experiment on the remaining robots of a fleet.

    Args:
        group: Folder of the fleet, which must be locked by this process.
        manner: Settings of the runs.
        tell: Callback that receives every robot when its run has ended.
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
    """Return a robot with the report of its newest run, unless it is already measured."""
    run = None if member.measured else group.run_of(member.robot)
    return member if run is None else replace(member, report=_report_from_disk(run), error=None)


def _report_from_disk(run: Path) -> Document:
    """Return the report of a run, as far as the run directory contains it."""
    directory = RunDirectory.open(run)
    status = directory.status
    page = run / "report.html"
    return {
        "run": str(run),
        "uid": directory.start.get("uid", ""),
        # The measurement is complete but not judged; a resumed run judges it.
        "outcome": "interrupted" if status == "completed" and not directory.is_judged else status,
        "verdict": verdict_word(run),
        "models": [str(folder) for folder in models_below(run)],
        "report": str(page) if page.is_file() else None,
    }


def _after_worker(group: FleetGroup, before: Member, answer: Document) -> Member:
    """Return a robot with its worker's answer, or with its run's report if the worker died."""
    about = {"experiment": before.experiment, "robot": before.robot}
    after = Member.from_dict({**answer, **about})
    if isinstance(after.error, Stopped):
        after.error.by_signal = True
    if not after.report and (run := group.run_of(before.robot)) is not None:
        after = replace(after, report=_report_from_disk(run))
    died_after_all = isinstance(after.error, RobotError) and after.measured
    return replace(after, error=None) if died_after_all else after


def robots_left(group: FleetGroup) -> list[str]:
    """Return the names of the robots without a run.

    Robots whose runs are resumed are not included, because these runs retain their confirmation.
    """
    return [one.robot for one in group.members() if group.run_of(one.robot) is None]


class Workers:
    """Worker processes of a fleet, one process per robot.

    Args:
        group: Folder of the fleet.
        manner: Settings of the runs.

    Attributes:
        running: Mapping from the connection of each worker to the number and the process of the
            worker.
        stopping: Flag; true after a signal, when no further worker is started.
    """

    def __init__(self, group: FleetGroup, manner: Manner) -> None:
        self._group, self._manner = group, manner
        self.running: dict[Connection, tuple[int, BaseProcess]] = {}
        self.stopping = False

    @contextmanager
    def signals(self) -> Iterator[None]:
        """Pass signals to the workers inside the block; a signal does not interrupt the block."""

        def stop(number: int, frame: object) -> None:
            self.stopping = True
            self._pass_on()

        main = threading.current_thread() is threading.main_thread()
        heard = [n for n in WATCHED if main and signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, stop) for number in heard}
        try:
            yield
        except BaseException:
            self._pass_on()  # no arm must move without supervision
            raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _pass_on(self) -> None:
        for _, process in list(self.running.values()):
            _terminate(process)

    def start(self, i: int, member: Member) -> None:
        """Start the worker process of a robot.

        Ctrl-C in the terminal does not reach the worker.
        """
        context = process_context(__name__)
        ours, theirs = context.Pipe(duplex=False)
        args = (self._job(member), theirs, dict(os.environ))
        process = context.Process(target=worker_main, args=args, name=member.robot)
        process.start()
        theirs.close()
        self.running[ours] = (i, process)
        if self.stopping:  # a signal was received during the start
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
        """Wait until workers answer or die; yield the number and the answer of each.

        An answer of a worker is the report of the run in the format of `hil run --json`. The answer
        contains the key `error` (with `kind`, `message`, `hint`) if there was an error.
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
            del self.running[connection]  # after its exit, as it receives signals until then
            connection.close()
            yield i, {"error": _cause_of_death(process)} if answer is None else answer


def _terminate(process: BaseProcess) -> None:
    if process.pid is not None and process.exitcode is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)


GONE_S = 10.0
"""Time limit for the exit of a worker after its answer [s]; a slower worker is terminated."""

SIGNAL_S = 0.5
"""Maximum duration of a single wait [s], needed because a signal just before a wait does not end
the wait.
"""


def _wait_until_gone(process: BaseProcess) -> None:
    """Wait for the exit of a worker after its answer, and kill it if needed; its arm is static."""
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
    """Run of one robot that a worker process executes.

    Attributes:
        spec: Path of the spec file of this robot.
        folder: Folder to which relative paths in the spec are relative.
        station: Path of the station file; empty for the default station of an experiment in
            `folder`.
        runs: Folder of run directories.
        before: Run directory to resume; None for a new run.
        operator: Name of the operator at the robot.
        waivers: Mapping from a preflight check to the reason why its failure is accepted.
        confirmed: Confirmation that the real robots of the fleet may move; None if the fleet has no
            real robots.
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
    """Execute a job and send the answer; entry point of a worker process.

    The environment of the worker process is replaced by `environment`. The worker process ignores
    Ctrl-C, because the fleet process passes Ctrl-C on as SIGTERM. If the fleet process dies, the
    worker process stops its arm.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.clear()
    os.environ.update(environment)
    threading.Thread(target=_end_with_parent, name="hil-parent", daemon=True).start()
    with one_thread():
        answer.send(run_job(job))


def _end_with_parent() -> None:
    """Wait for the death of the fleet process, then stop the arm as after SIGTERM."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def run_job(job: Job) -> Document:
    """Execute a job and return the answer; see `Workers.answers` for its form."""
    try:
        report = _run_attended(job)
    except HilError as error:
        return {"error": _error_document(error)}
    except Exception as error:  # drivers are plug-ins: an error affects one robot only
        return {"error": {"kind": "RobotError", "message": f"{type(error).__name__}: {error}"}}
    document = report.to_dict()
    return document | ({"error": _error_document(report.error)} if report.error else {})


def _run_attended(job: Job) -> RunReport:
    def desk(confirm: Confirm | None) -> OperatorChannel:
        refused = Unconfirmed("start it with: hil fleet run")
        attended = console_channel(job.operator, confirm=confirm or refused)
        # A worker has no console, so that no key can end a pause.
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
    # The receiver may not know the class of a plug-in's error, so send a known base class.
    known = (one.__name__ for one in type(error).__mro__ if hasattr(errors, one.__name__))
    return {"kind": next(known), "message": error.message, "hint": error.hint}
