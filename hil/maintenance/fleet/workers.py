"""The worker processes of a fleet: started, listened to, and told to stop."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from hil.engine import WATCHED
from hil.maintenance.fleet.worker import Job, work
from hil.models import FleetFolder
from hil.workflow import Ended, Together

Document = dict[str, Any]

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


def _let_go(process: BaseProcess) -> None:
    """Wait until a worker that has answered is gone; the arm is at rest, and nobody hangs on it."""
    process.join(GONE_S)
    for end in (process.terminate, process.kill):
        if process.exitcode is None:
            end()
            process.join(GONE_S)


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
