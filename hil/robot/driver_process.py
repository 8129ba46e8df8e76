"""A driver's process, seen from outside: its two lines, what it printed, how it died."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

from hil.core import PluginError, RobotConnectionError, RobotTimeout, StructArray
from hil.robot.documents import error_from, understood
from hil.robot.frames import Message, pack
from hil.robot.spawn import end_of, is_suspended, last_words, new_log, printed_to, spawn
from hil.robot.stop_line import StopLine
from hil.robot.wire import EndOfLine, Line

STOP_WITHIN_S = 1.0
"""A driver that has not answered a stop by then is killed: its controller has to notice [s]."""

TERMINATE_AFTER_S = 1.0
KILL_AFTER_S = 2.0
"""How long a process that should end is waited for, before and after SIGTERM [s]."""

_TO_BE_SEEN_S = 1.0
_mine: weakref.WeakSet[DriverProcess] = weakref.WeakSet()


class DriverProcess:
    """One child process and the way to it.

    Calls are for one thread at a time. `stop` is for any number of threads and for signal
    handlers: it takes no lock that whoever was interrupted may hold.

    Raises:
        PluginError: This system lacks what it takes.
    """

    def __init__(self, name: str) -> None:
        if sys.platform != "linux":
            raise PluginError(
                "a driver gets a process of its own on Linux only",
                hint="set own_process: false in the station file",
            )
        self._name = name
        self._numbers = itertools.count()
        self._late: list[StructArray] = []
        self._lost = False
        calls, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        # Packets keep stops whole however many threads send them at once.
        stops, their_stops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._calls, self._stops = Line(calls), StopLine(stops)
        self._log = new_log(name)
        with theirs, their_stops:
            self._process = spawn((theirs.fileno(), their_stops.fileno(), self._log))
        self._drop = weakref.finalize(
            self, _drop, self._process, self._calls, self._stops, self._log
        )
        _mine.add(self)

    @property
    def pid(self) -> int:
        """Of the process, also once it has ended."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs, and was neither let go nor given up."""
        return self._drop.alive and not self._lost and self._process.poll() is None

    @property
    def answers(self) -> bool:
        """Whether calls make sense: it runs, and the line to it is in step."""
        return self.alive and not self._calls.torn

    @property
    def suspended(self) -> bool:
        """Whether it does not run because it was suspended (SIGSTOP, a debugger, a freezer)."""
        return is_suspended(self.pid) if self._process.poll() is None else False

    @property
    def exit_code(self) -> int | None:
        """Of the process; None while it runs, negative when a signal has ended it."""
        return self._process.poll()

    @property
    def printed(self) -> str:
        """The end of what the driver printed."""
        if not self._drop.alive:
            return ""
        return printed_to(self._log)

    def ask(
        self,
        call: str,
        timeout_s: float,
        details: Mapping[str, Any] | None = None,
        arrays: Sequence[StructArray] = (),
    ) -> Message:
        """Call a member of the driver and wait for what it says.

        Raises:
            RobotTimeout: It has not answered in time; rows that come late come with the
                next `read`.
            RobotConnectionError: Its process has died, or talks nonsense.
            HilError: What the driver raised.
            TypeError, ValueError: The details cannot be said in JSON.
        """
        number = next(self._numbers)
        frame = pack({"id": number, "call": call, "with": details or {}}, arrays)
        until = time.monotonic() + timeout_s
        try:
            self._calls.send(frame, timeout_s)
            said, rows = self._calls.receive(max(0.0, until - time.monotonic()))
            while said.get("id") != number:
                self._late += [] if "topics" in said else rows
                said, rows = self._calls.receive(max(0.0, until - time.monotonic()))
        except EndOfLine as error:
            raise self._died() from error
        except RobotTimeout as error:
            if self.suspended:
                raise self._is_suspended() from error
            raise RobotTimeout(
                f"{self._name}: the driver has not answered {call} within {timeout_s:.1f} s",
                hint=f"it hangs, or its robot does: process {self.pid}",
            ) from error
        if "error" in said:
            with understood():
                raised = error_from(said["error"])
            raise raised
        return said, self._with_late(call, rows)

    def stop(self, within_s: float | None = None) -> None:
        """Stop the arm over the line of its own; nothing to do once the process was let go.

        Args:
            within_s: Who has another way to stop the arm waits only so long, and the process
                goes on [s]; by default one that does not answer in a second is killed.

        Raises:
            RobotTimeout: The driver does not answer.
            RobotConnectionError: Its process has died.
            HilError: What the driver raised.
        """
        try:
            answer = self._stops.ask(STOP_WITHIN_S if within_s is None else within_s)
        except (OSError, ValueError) as error:  # what a socket says that was just closed
            if not self._drop.alive:
                return
            raise self._died(_TO_BE_SEEN_S if within_s is None else 0.0) from error
        if answer is None and within_s is not None:
            raise RobotTimeout(
                f"{self._name}: the driver has not answered a stop within {within_s:g} s",
                hint="stop the arm in another way",
            )
        if answer is None:
            why = ", its process being suspended," if self.suspended else ""
            self._lost = True
            self._process.kill()
            raise RobotTimeout(
                f"{self._name}: the driver has not answered a stop within {STOP_WITHIN_S:g} s{why} "
                "and was killed; only the controller can stop the arm now",
                hint="see to the robot itself, by its emergency stop if need be",
            )
        if answer:
            with understood():
                raised = error_from(json.loads(answer))
            raise raised

    def end(self) -> None:
        """Let the process come to its end, or bring it there, within seconds. Idempotent."""
        self._drop()

    def forget(self) -> None:
        """Let go of our ends without a word, in a process that is not the one they belong to."""
        if self._drop.detach():
            self._calls.close()
            self._stops.close()

    def _with_late(self, call: str, rows: list[StructArray]) -> list[StructArray]:
        if call != "read":
            return rows
        late, self._late = self._late, []
        return late + rows

    def _is_suspended(self) -> RobotTimeout:
        return RobotTimeout(
            f"{self._name}: the driver's process {self.pid} is suspended and does not answer",
            hint="look at the robot; continue the process (kill -CONT), or end it",
        )

    def _died(self, wait_s: float = _TO_BE_SEEN_S) -> RobotConnectionError:
        self._lost = True
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)
        message = f"{self._name}: the driver's process {end_of(self._process.returncode)}"
        last = last_words(self.printed)
        return RobotConnectionError(
            f"{message}; it printed last:\n{last}" if last else message,
            hint="nobody commands the robot now: see to it before going on",
        )


def _drop(process: subprocess.Popen[bytes], calls: Line, stops: StopLine, log: int) -> None:
    """The lines end first: the child then stops the arm, whatever becomes of the rest."""
    calls.cut()
    calls.close()
    stops.close()
    for patience_s, more in ((TERMINATE_AFTER_S, process.terminate), (KILL_AFTER_S, process.kill)):
        try:
            process.wait(patience_s)
            break
        except subprocess.TimeoutExpired:
            more()
    process.wait()
    os.close(log)


def _forget_in_fork() -> None:
    """A child made by fork shares our ends: it must neither keep nor use them, nor cut them."""
    for process in list(_mine):
        process.forget()


os.register_at_fork(after_in_child=_forget_in_fork)
