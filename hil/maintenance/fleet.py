"""Many robots of one station run an experiment, some at a time, each in a process of its own.

A process has one robot's run for itself: signals are the run's, and nobody ends another's. Such
runs can also be probes, each against its robot's champion.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import (
    HilError,
    Rejected,
    RobotError,
    SpecError,
    Stopped,
    closest,
    errors,
    exit_code_of,
    one_thread,
    with_value,
)
from hil.engine import WATCHED, nobody_goes_on
from hil.estimators import models_below
from hil.evaluation import verdict_word
from hil.models import FleetFolder, Probe, Registry, assess, completed, robot_of
from hil.planning import Experiment, find_station
from hil.recording import RunDirectory
from hil.spec import Station, load_fleet_spec, resolve_robot, spec_from_text
from hil.workflow import Ended, Together, Unconfirmed, check_driver, console_desk
from hil.workflow import resume as resume_experiment
from hil.workflow import run as run_experiment

if TYPE_CHECKING:
    from hil.workflow import Confirm, Desk, RunReport


Document = dict[str, Any]

Tell = Callable[[Ended, int, int], object]
"""Told a robot's end, and the how-manieth of how many it was."""


@dataclass(frozen=True, slots=True)
class FleetReport:
    """What came of a fleet.

    Attributes:
        folder: Of the fleet.
        ended: Every robot that was begun, now or before.
        left: Robots that were not begun.
    """

    folder: Path
    ended: tuple[Ended, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """The worst: a stop, a robot that did not measure all, a missing model, a rejection."""
        stopped = [one.error for one in self.ended if isinstance(one.error, Stopped)]
        early = [one.error for one in self.ended if not one.measured and one.error]
        wrong = [one.error for one in self.ended if one.error]
        if self.left and not stopped:
            stopped = [
                Stopped(
                    f"{len(self.left)} robots were not begun",
                    by_signal=True,
                    hint="hil fleet resume FOLDER goes on with them",
                )
            ]
        bad = [one for one in self.ended if one.word == "rejected"]
        missed = [
            Rejected(
                f"{len(bad)} of {len(self.ended)} models missed their criteria",
                hint="hil fleet report FOLDER shows which and by how much",
            )
        ]
        return next(iter([*stopped, *early, *wrong, *(missed if bad else ())]), None)

    def to_dict(self) -> Document:
        """The contract of `hil fleet run --json`."""
        return {
            "fleet": str(self.folder),
            "robots": [one.to_dict() for one in self.ended],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


def run_fleet(
    folder: FleetFolder, members: Sequence[Document], manner: Manner, tell: Tell
) -> FleetReport:
    """Run what is left of a fleet.

    What a robot has measured and judged is not done again; a run that ended early is gone on with.
    The first signal stops every arm and begins no other, each further one is passed on: the third
    ends the workers as it would end a run.

    Args:
        folder: Held by this process.
        members: Entries of its document.
        manner: How.
        tell: Told every robot that has ended.
    """
    found = [_as_it_stands(folder, one) for one in members]
    todo = deque(i for i, one in enumerate(found) if not one.measured)
    fleet = Workers(folder, manner)
    with fleet.signals():
        while (todo and not fleet.stopping) or fleet.going:
            while todo and not fleet.stopping and len(fleet.going) < manner.workers:
                i = todo.popleft()
                fleet.begin(i, found[i])
            for i, told in fleet.ended():
                found[i] = _ended(folder, found[i], told)
                folder.write([one.to_dict() for one in found])
                tell(found[i], len(found) - len(todo) - len(fleet.going), len(found))
    begun = [i for i in range(len(found)) if i not in todo or found[i].report]
    return FleetReport(
        folder.path,
        tuple(found[i] for i in begun),
        tuple(found[i].robot for i in todo if i not in begun),
    )


def _as_it_stands(folder: FleetFolder, entry: Document) -> Ended:
    """A robot's entry, or what its newest run says where that is more."""
    told = Ended.from_dict({"experiment": folder.head["name"], **entry})
    run = folder.run_of(told.robot)
    if told.measured or run is None:
        return told
    return replace(told, report=_from_disk(run), error=None)


def _from_disk(run: Path) -> Document:
    """A run's report as far as its directory tells it."""
    directory = RunDirectory.open(run)
    judged = directory.status == "completed" and (run / "verdict.json").is_file()
    page = run / "report.html"
    return {
        "run": str(run),
        "uid": directory.start.get("uid", ""),
        "outcome": directory.status if judged or directory.status != "completed" else "interrupted",
        "verdict": verdict_word(run),
        "models": [str(folder) for folder in models_below(run)],
        "report": str(page) if page.is_file() else None,
    }


def _ended(folder: FleetFolder, before: Ended, told: Document) -> Ended:
    """What a worker has answered; one that died is known by its run."""
    error = _error(told.pop("error", None))
    if not told and (run := folder.run_of(before.robot)) is not None:
        told = _from_disk(run)
    found = Ended(before.experiment, before.robot, told, error)
    died_after_all = isinstance(error, RobotError) and found.measured
    return replace(found, error=None) if died_after_all else found


def _error(told: Document | None) -> HilError | None:
    if told is None:
        return None
    kind = getattr(errors, str(told["kind"]), RobotError)
    error = kind(told["message"], hint=told.get("hint", ""))
    if isinstance(error, Stopped):
        error.by_signal = True
    assert isinstance(error, HilError)
    return error


def left_of(folder: FleetFolder, members: Sequence[Document]) -> list[str]:
    """Return the robots without a run; resumed runs keep their own confirmation."""
    return [one["robot"] for one in members if folder.run_of(one["robot"]) is None]


FEW = 12
"""Of the names of robots a hint lists."""


def robots_like(station: Station, patterns: Sequence[str], where: str) -> tuple[str, ...]:
    """Names of a station's robots that match any of the patterns, in the station's order.

    Args:
        station: With the robots.
        patterns: As of files: `ur5-*`, `ur5-00[1-9]`, or whole names.
        where: The station's file, for errors.

    Raises:
        SpecError: One of the patterns matches no robot.
    """
    names = list(station.robots)
    known = ", ".join(names) if len(names) <= FEW else f"{len(names)}, the first is {names[0]!r}"
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            guess = closest(pattern, names)
            like = f"did you mean {guess!r}? " if guess else ""
            raise SpecError(
                f"{where} has no robot {pattern!r}",
                hint=f"{like}it has {known}",
            )
    return tuple(name for name in names if any(fnmatchcase(name, one) for one in patterns))


def named_in(given: Sequence[str]) -> tuple[list[str], Path, dict[str, str]]:
    """Return patterns of robots, the file that names robots with their addresses, and its content.

    Without a file among what is given, there are no addresses, and the file is one to be written.

    Raises:
        SpecError: The file has problems.
    """
    files = [one for one in given if one.endswith((".yaml", ".yml"))]
    named = {name: at for file in files for name, at in load_fleet_spec(file).robots.items()}
    patterns = [one for one in given if one not in files]
    return [*patterns, *named], Path(files[0] if files else "fleet.yaml"), named


def spec_for(text: str, name: str, robot: str) -> str:
    """The text of a spec with another robot; all else stays as it was written.

    Args:
        text: YAML.
        name: Of its file, for errors.
        robot: To be named in it.

    Raises:
        SpecError: It names no robot whose place could be taken.
    """
    try:
        changed = with_value(text, "robot", json.dumps(robot))
    except ValueError as error:
        raise SpecError(f"{name}: {error}", hint="`hil validate` says more") from None
    if changed is None:
        raise SpecError(f"{name} names no robot", hint="it needs a line such as `robot: ur5`")
    return changed


def experiment_for(text: str, folder: Path, station: Path | None, source: Path) -> Experiment:
    """The experiment of one robot.

    Args:
        text: Its spec, from `spec_for`.
        folder: Where relative paths in it begin.
        station: The station file; by default the one an experiment in `folder` would use.
        source: What the run shall name as its spec.

    Raises:
        SpecError: Spec or station have problems, or the station lacks the robot.
    """
    spec = spec_from_text(text, str(source), folder=folder)
    bench, station_text, where = find_station(folder, station)
    return Experiment(
        spec=spec,
        station=bench,
        robot=resolve_robot(spec, bench),
        spec_text=text,
        station_text=station_text or bench.as_text(where),
        station_source=where,
        folder=folder,
        spec_source=str(source),
    )


GONE_S = 10.0
"""In which a worker that has answered should have gone by itself [s]."""


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
    """The workers that are at it."""

    def __init__(self, folder: FleetFolder, manner: Manner) -> None:
        self._folder, self._manner = folder, manner
        self.going: dict[Connection, tuple[int, BaseProcess]] = {}
        self.stopping = False

    def begin(self, i: int, member: Ended) -> None:
        """Start a worker; Ctrl-C at the terminal does not reach it."""
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=work, args=(self._job(member), theirs), name=member.robot)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.going[ours] = (i, process)
        if self.stopping:  # the signal came while it was started
            _end(process)

    def ended(self) -> Iterator[tuple[int, Document]]:
        """Wait for the next workers to answer, or to die."""
        for answer in wait(list(self.going)):
            assert isinstance(answer, Connection)
            i, process = self.going[answer]
            try:
                told: Document | None = answer.recv()
            except (EOFError, OSError):
                told = None
            _let_go(process)
            del self.going[answer]  # not before: signals are passed on to it until it has gone
            answer.close()
            yield i, {"error": _died(process)} if told is None else told

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
            _end(process)


def _end(process: BaseProcess) -> None:
    if process.pid is not None and process.exitcode is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)


def _let_go(process: BaseProcess) -> None:
    """Wait until a worker that has answered is gone; the arm is at rest, and nobody hangs on it."""
    process.join(GONE_S)
    for end in (process.terminate, process.kill):
        if process.exitcode is None:
            end()
            process.join(GONE_S)


def _died(process: BaseProcess) -> Document:
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


def work(job: Job, answer: Connection) -> None:
    """Do a job, and answer with the run's report as JSON has it; the entry of a worker process.

    Ctrl-C is for the process that started this one, which says here by SIGTERM what it means. When
    that process dies, the motion is stopped.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="hil-parent", daemon=True).start()
    with one_thread():
        answer.send(_done(job))


def _end_with_parent() -> None:
    """An arm whose fleet has gone is nobody's: it is stopped, as by SIGTERM."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def _done(job: Job) -> dict[str, Any]:
    try:
        report = _run(job)
    except HilError as error:
        return {"error": _told(error)}
    except Exception as error:  # drivers are plug-ins: whatever one of them raises is this robot's
        return {"error": {"kind": "RobotError", "message": f"{type(error).__name__}: {error}"}}
    told = report.to_dict()
    return told if report.error is None else told | {"error": _told(report.error)}


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


def _told(error: HilError) -> dict[str, Any]:
    return {"kind": type(error).__name__, "message": error.message, "hint": error.hint}


@dataclass(frozen=True, slots=True, eq=False)
class Probed:
    """What was said of one robot.

    Attributes:
        robot: Its name.
        asked: False-alarm rate that was asked for it, so that the fleet's is as stated.
        probe: None where it could not be judged.
        error: Why not, else empty.
    """

    robot: str
    asked: float
    probe: Probe | None = None
    error: str = ""

    @property
    def note(self) -> str:
        """What is to be known of the judgement: it may be one that was made before."""
        if self.probe is None or math.isclose(self.probe.false_alarm, self.asked, rel_tol=1e-9):
            return ""
        return f"judged before, at a rate of {self.probe.false_alarm:.2g}, not {self.asked:.2g}"

    def to_dict(self) -> dict[str, Any]:
        """An entry of `hil fleet drift --json`."""
        told = {} if self.probe is None else self.probe.to_dict()
        more = {"asked": self.asked, "note": self.note or None, "error": self.error or None}
        return {"robot": self.robot, **told, **more}


def probe_fleet(path: Path, registry: Registry, false_alarm: float) -> list[Probed]:
    """Judge the runs of a fleet as probes; one that cannot be judged leaves the others alone.

    Args:
        path: Folder of the fleet.
        registry: With champions of the robots.
        false_alarm: Probability with which any of the robots is called changed though none is:
            nominally, of probes that are judged now and know nothing of one another.

    Raises:
        DataError: It is no fleet.
    """
    runs = completed(FleetFolder.open(path)[1])
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, len(runs)))
    return [_probed(registry, run, each) for run in runs]


def _probed(registry: Registry, run: Path, false_alarm: float) -> Probed:
    robot = robot_of(run)
    try:
        return Probed(robot, false_alarm, assess(registry, robot, run, false_alarm=false_alarm))
    except HilError as error:
        return Probed(robot, false_alarm, error=error.message)
