"""A fleet's runs, some at a time: one process per robot, and nobody ends another's."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from hil import errors
from hil.campaign.series import Ended
from hil.campaign.view import verdict_word
from hil.engine.signals import WATCHED
from hil.errors import HilError, Rejected, RobotError, Stopped, exit_code_of
from hil.fleet.folder import FleetFolder
from hil.fleet.worker import Job, work
from hil.identify.model_folder import models_below
from hil.record.rundir import RunDirectory

Document = dict[str, Any]
Tell = Callable[[Ended, int, int], object]
"""Told a robot's end, and the how-manieth of how many it was."""


@dataclass(frozen=True, slots=True)
class Manner:
    """How the runs of a fleet are done.

    Attributes:
        workers: Robots at a time.
        operator: Who is at the robots; by default the user of this process.
        waivers: Preflight check → why its failure is accepted.
    """

    workers: int
    operator: str = ""
    waivers: Mapping[str, str] | None = None


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
            stopped = [Stopped(f"{len(self.left)} robots were not begun", by_signal=True)]
        bad = [one for one in self.ended if one.word == "rejected"]
        missed = [Rejected(f"{len(bad)} of {len(self.ended)} models missed their criteria")]
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
    fleet = _Fleet(folder, manner)
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


class _Fleet:
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
            i, process = self.going.pop(answer)
            try:
                told: Document = answer.recv()
            except (EOFError, OSError):
                process.join()
                told = {"error": _died(process)}
            process.join()
            answer.close()
            yield i, told

    def _job(self, member: Ended) -> Job:
        head, manner, run = self._folder.head, self._manner, member.report.get("run")
        before = Path(run) if run and (Path(run) / "plan.json").is_file() else None
        return Job(
            self._folder.spec_of(member.robot), Path(head["source"]).parent, str(head["station"]),
            self._folder.runs, before, manner.operator, manner.waivers or {},
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


def _died(process: BaseProcess) -> Document:
    code = process.exitcode or 0
    if code in (-signal.SIGTERM, 130):
        return {"kind": "Stopped", "message": "stopped by SIGTERM"}
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return {"kind": "RobotError", "message": f"the process of its run died ({how})"}


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
