"""A robot whose driver lives in a process of its own: it may hang or die, and the arm is stopped.

Decision record 0014 says why, what happens when either side goes, and what a call costs.

`RobotProcess` is the robot that `hil` sees. `DriverProcess` is the child process and the two lines
to it: calls, answered one after the other, and stops, which overtake them (`StopLine`). It prints
into a file in memory, whose end goes into the error when it dies. `hil.robot.subprocess_server` is
the other side. A child ends when its lines end, so it outlives neither this object nor `hil`.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import (
    CommandRefused,
    HilError,
    PluginError,
    RobotConnectionError,
    RobotTimeout,
    StructArray,
)
from hil.robot.ipc import (
    EndOfLine,
    Facts,
    Line,
    Message,
    error_from,
    facts_from,
    garbage,
    pack,
    payload_from,
    plain_options,
    segment_document,
    understood,
)
from hil.robot.protocol import Address, Capabilities, Finding, Identity, Limits, Segment
from hil.robot.state import Topic

OPEN_S, CONNECT_S, COMMAND_S, CLOSE_S = 60.0, 120.0, 30.0, 3.0
"""How long the driver may take to be imported, to connect, to take a command, to close [s]."""

READ_GRACE_S = {"wall": 1.0, "virtual": 10.0}
"""How much longer than its own time-out a read may take; a virtual clock may be slow [s]."""


class RobotProcess:
    """Implements `hil.robot.Robot` by a driver in a child process; Linux only.

    `stop` works while another thread waits in any other member, and from a signal handler. A
    closed robot can be connected again, in a new process. What the driver opts into (`topics` and
    `drain`, `resource`, `checks`) this robot has too, and else it has not.

    Args:
        driver: Name under `hil.drivers`, or `module:Class`.
        name: The robot's name in its station.
        model: A built-in arm, or a path.
        options: The driver's own; what YAML can hold.
        gravity_m_s2: For drivers that simulate: gravity in the base frame.
        known: What the driver would say before it is connected; its process is started by
            `connect` then, not now.

    Raises:
        PluginError: There is no such driver, it does not load, or the system is not Linux.
        SpecError: The driver does not accept its options.
        RobotError: Its process does not come up.
    """

    topics: Sequence[Topic]
    drain: Callable[[], Mapping[str, StructArray]]
    resource: str
    address: Address
    checks: Callable[[], Sequence[Finding]]
    speed_scaling: float

    def __init__(
        self,
        driver: str,
        name: str,
        model: str,
        options: Mapping[str, Any] | None = None,
        *,
        gravity_m_s2: Sequence[float] | None = None,
        known: Facts | None = None,
    ) -> None:
        self._name = name
        self._how: dict[str, Any] = {
            "driver": driver,
            "name": name,
            "model": model,
            "options": plain_options(options or {}),
            "gravity": None if gravity_m_s2 is None else list(gravity_m_s2),
            "pythonpath": os.environ.get("PYTHONPATH"),
        }
        self._one_call = threading.Lock()
        self._last_stop: object = None  # a new one with every stop: told apart without a lock
        self._identity: Identity | None = None
        self._process: DriverProcess | None = None
        if known is None:
            self._open()
        else:
            self._remember(known)

    @property
    def process(self) -> DriverProcess | None:
        """Where the driver lives; None once closed."""
        return self._process

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        if self._identity is None:
            raise self._not_connected()
        return self._identity

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return self._capabilities

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`."""
        return self._limits

    def connect(self) -> None:
        """See `hil.robot.Robot`; refused when `stop` comes meanwhile, and closed then."""
        stop = self._last_stop
        if self._process is not None and not self._process.alive:
            self.close()
        if self._process is None:
            self._open()
        self._refuse_if_stopped_since(stop)
        self._remember(facts_from(self._ask("connect", CONNECT_S)[0]))
        self._refuse_if_stopped_since(stop)

    def set_payload(self, payload: Payload) -> Payload:
        """See `hil.robot.Robot`."""
        said, _ = self._ask("set_payload", COMMAND_S, asdict(payload))
        with understood():
            return payload_from(said["payload"])

    def prepare(self, segment: Segment) -> None:
        """See `hil.robot.Robot`."""
        self._ask("prepare", COMMAND_S, *segment_document(segment))

    def start(self) -> None:
        """See `hil.robot.Robot`."""
        self._ask("start", COMMAND_S)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """See `hil.robot.Robot`; `RobotTimeout` also when the driver hangs.

        Rows that came too late for the read that asked for them come with the next one.
        """
        patience_s = timeout_s + READ_GRACE_S[self._capabilities.clock]
        said, arrays = self._ask("read", patience_s, {"timeout_s": timeout_s})
        if "speed_scaling" in said:
            self.speed_scaling = float(said["speed_scaling"])
        if not arrays or not len(arrays[0]):
            raise garbage("a read without rows")
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)

    def stop(self) -> None:
        """See `hil.robot.Robot`; a driver that does not answer within a second is killed."""
        self._last_stop = object()
        process = self._process
        if process is not None:
            process.stop()

    def close(self) -> None:
        """See `hil.robot.Robot`: stop, ask, SIGTERM, SIGKILL; a matter of seconds at most."""
        process = self._process
        if process is None:
            return
        try:
            problem = _problem(process.stop)
            if isinstance(problem, RobotConnectionError) and not process.alive:
                problem = None  # it was dead before: nothing is left to be released
            problem = _problem(self._ask_to_close) or problem
        finally:
            process.end()
            self._process = self._identity = None
        if problem:
            raise problem

    def _open(self) -> None:
        process = DriverProcess(self._name)
        try:
            self._remember(facts_from(process.ask("open", OPEN_S, self._how)[0]))
        except BaseException:
            process.end()
            raise
        self._process = process

    def _remember(self, facts: Facts) -> None:
        """Members that a structural check looks for exist only where the driver has them."""
        self._capabilities, self._limits = facts.capabilities, facts.limits
        self._identity = facts.identity
        if facts.topics is not None:
            self.topics, self.drain = facts.topics, self._drain
        if facts.resource is not None:
            self.resource = facts.resource
        if facts.address is not None:
            self.address = facts.address
        if facts.checks:
            self.checks = self._checks
        if facts.speed_scaling:
            self.speed_scaling = math.nan

    def _ask(self, call: str, timeout_s: float, *what: Any) -> Message:
        process = self._process
        if process is None:
            raise self._not_connected()
        with self._one_call:
            return process.ask(call, timeout_s, *what)

    def _drain(self) -> Mapping[str, StructArray]:
        said, arrays = self._ask("drain", COMMAND_S)
        with understood():
            return dict(zip(said["topics"], arrays, strict=True))

    def _checks(self) -> Sequence[Finding]:
        said, _ = self._ask("checks", COMMAND_S)
        with understood():
            return [Finding(**each) for each in said["findings"]]

    def _not_connected(self) -> RobotConnectionError:
        return RobotConnectionError(f"{self._name} is not connected", hint="call connect() first")

    def _ask_to_close(self) -> None:
        process = self._process
        # Who is stuck in a call keeps the line; the end of it will do, then.
        if process and process.answers and self._one_call.acquire(timeout=CLOSE_S):
            try:
                process.ask("close", CLOSE_S)
            finally:
                self._one_call.release()

    def _refuse_if_stopped_since(self, stop: object) -> None:
        """A stop that found no driver, or one that was not at it yet, holds all the same."""
        if self._last_stop is not stop:
            self.close()
            raise CommandRefused("stopped while connecting", hint="connect again")


def _problem(step: Callable[[], object]) -> HilError | None:
    try:
        step()
    except HilError as error:
        return error
    return None


STOP_WITHIN_S = 1.0
"""A driver that has not answered a stop by then is killed: its controller has to notice [s]."""

TERMINATE_AFTER_S, KILL_AFTER_S = 1.0, 2.0
"""How long a process that should end is waited for, before and after SIGTERM [s]."""

_TO_BE_SEEN_S = 1.0


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


_mine: weakref.WeakSet[DriverProcess] = weakref.WeakSet()


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


_TOKEN_BYTES = 8
_LOOK_EVERY_S = 0.005
_PACKET_BYTES = 1 << 16


class StopLine:
    """One end of a line of packets. Nothing in here waits for a lock.

    A handler runs in the middle of what the main thread does, which may be a stop: a lock that it
    holds would never be freed. Instead, every stop has a token of its own, packets are whole or
    not there, and whoever receives the answer to another's stop puts it where the other looks.

    Args:
        end: Connected packet socket; the line owns it.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._tokens = itertools.count()
        self._answers: dict[bytes, bytes] = {}

    def ask(self, within_s: float) -> bytes | None:
        """Ask for a stop; returns what was answered, None when nothing was in time.

        Raises:
            OSError: Nobody is there.
        """
        token = next(self._tokens).to_bytes(_TOKEN_BYTES, "little")
        until = time.monotonic() + within_s
        # A full line means that stops wait there already.
        with contextlib.suppress(BlockingIOError):
            self._end.send(token)
        poll = select.poll()
        poll.register(self._end, select.POLLIN)
        while token not in self._answers:
            if time.monotonic() > until:
                return None
            if poll.poll(_LOOK_EVERY_S * 1000):
                self._receive()
        return self._answers.pop(token)

    def close(self) -> None:
        """The other side sees the end, and stops the arm."""
        self._end.close()

    def _receive(self) -> None:
        with contextlib.suppress(BlockingIOError):
            packet = self._end.recv(_PACKET_BYTES)
            if not packet:
                raise BrokenPipeError("the line has ended")
            self._answers[packet[:_TOKEN_BYTES]] = packet[_TOKEN_BYTES:]


def new_log(name: str) -> int:
    """A descriptor to print to: a file in memory, which never waits for a reader, nor needs one."""
    log = os.memfd_create(f"hil-driver-{name}", os.MFD_CLOEXEC)
    fcntl.fcntl(log, fcntl.F_SETFL, os.O_APPEND)
    return log


def spawn(ours: Sequence[int]) -> subprocess.Popen[bytes]:
    """Start the child in a session of its own, where the terminal's signals do not reach it.

    Args:
        ours: Descriptors it gets: its ends of the two lines, and the log.
    """
    log = ours[-1]
    return subprocess.Popen(  # noqa: S603, our own module by our own interpreter
        [sys.executable, "-P", "-m", "hil.robot.subprocess_server", *map(str, ours)],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        pass_fds=ours,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def end_of(code: int | None) -> str:
    """What became of a process, by its return code."""
    if code is None:
        return "has closed the line"
    if code < 0:
        return f"died (signal {-code}: {signal.strsignal(-code)})"
    return f"ended (exit code {code})"


def is_suspended(pid: int) -> bool:
    """Return whether a process is stopped by a signal or a debugger, according to /proc."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()[0] in ("T", "t")
    except (OSError, IndexError):
        return False


_LAST_BYTES = 2000


def printed_to(log: int) -> str:
    """The end of what was printed."""
    size = os.fstat(log).st_size
    raw = os.pread(log, _LAST_BYTES, max(0, size - _LAST_BYTES))
    return raw.decode("utf-8", "replace")


_CRASH = "Fatal Python error"
_LAST_LINES = 6


def last_words(printed: str) -> str:
    """Where it crashed, if it says so; else the last it printed."""
    _, crash, where = printed.rpartition(_CRASH)
    if crash:
        return "\n".join((crash + where).splitlines()[:_LAST_LINES])
    return "\n".join(printed.strip().splitlines()[-_LAST_LINES:])
