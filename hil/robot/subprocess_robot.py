"""Robot whose driver runs in a separate process: the arm stops if the driver hangs or exits.

Decision record 0014 explains the reasons for a separate driver process, the behavior if either
process exits, and the cost of a call.

The class `RobotProcess` implements the robot interface for `hil`. The class `DriverProcess` is the
child process with two connections: calls are answered one after the other, and stop requests
(`StopLine`) overtake calls. The child process prints into a file in memory; if the child process
exits unexpectedly, the error message contains the end of this output. The module
`hil.robot.subprocess_server` contains the code of the child process. A child process exits when its
connections are closed, so that it outlives neither its `DriverProcess` object nor `hil`.
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
"""Time limits for calls of a driver: import, connection, commands and closing [s]."""

READ_GRACE_S = {"wall": 1.0, "virtual": 10.0}
"""Additional time limit for a read beyond the time-out of the read [s], because virtual clocks
can be slow."""


class RobotProcess:
    """Implementation of `hil.robot.Robot` with a driver in a child process; Linux only.

    The method `stop` can be called from a signal handler and while a different thread waits in any
    other method. A closed robot can be connected again, in a new process. The optional members of
    the driver (`topics` and `drain`, `resource`, `checks`) exist on the `RobotProcess` only if the
    driver has them.

    Args:
        driver: Name of the driver under `hil.drivers`, or `module:Class`.
        name: Name of the robot in its station.
        model: Name of a built-in arm, or path of an arm description.
        options: Options of the driver, with any values that YAML supports.
        gravity_m_s2: Gravity in the base frame, for drivers that simulate an arm [m/s²].
        known: Properties of the robot that the driver would report before connecting. If `known` is
            set, the driver process is started in `connect` and not at construction.

    Raises:
        PluginError: The driver does not exist, cannot be loaded, or the system is not Linux.
        SpecError: The driver does not accept its options.
        RobotError: The driver process does not start.
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
        # replaced by every stop, so that stops are detected without a lock
        self._last_stop: object = None
        self._identity: Identity | None = None
        self._process: DriverProcess | None = None
        if known is None:
            self._open()
        else:
            self._remember(known)

    @property
    def process(self) -> DriverProcess | None:
        """Process in which the driver runs; None after `close`."""
        return self._process

    @property
    def identity(self) -> Identity:
        """Identity of the robot, see `hil.robot.Robot`."""
        if self._identity is None:
            raise self._not_connected()
        return self._identity

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of the robot, see `hil.robot.Robot`."""
        return self._capabilities

    @property
    def limits(self) -> Limits:
        """Joint limits of the robot, see `hil.robot.Robot`."""
        return self._limits

    def connect(self) -> None:
        """Connect to the robot as described in `hil.robot.Robot`.

        If `stop` is called while this method runs, the robot is closed and an error is raised.
        """
        stop = self._last_stop
        if self._process is not None and not self._process.alive:
            self.close()
        if self._process is None:
            self._open()
        self._refuse_if_stopped_since(stop)
        self._remember(facts_from(self._ask("connect", CONNECT_S)[0]))
        self._refuse_if_stopped_since(stop)

    def set_payload(self, payload: Payload) -> Payload:
        """Declare the payload as described in `hil.robot.Robot`."""
        said, _ = self._ask("set_payload", COMMAND_S, asdict(payload))
        with understood():
            return payload_from(said["payload"])

    def prepare(self, segment: Segment) -> None:
        """Transfer the next segment as described in `hil.robot.Robot`."""
        self._ask("prepare", COMMAND_S, *segment_document(segment))

    def start(self) -> None:
        """Start the prepared segment as described in `hil.robot.Robot`."""
        self._ask("start", COMMAND_S)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Read state rows as described in `hil.robot.Robot`.

        Raises `RobotTimeout` also if the driver hangs.

        State rows that arrived too late for one read are returned by the next read.
        """
        patience_s = timeout_s + READ_GRACE_S[self._capabilities.clock]
        said, arrays = self._ask("read", patience_s, {"timeout_s": timeout_s})
        if "speed_scaling" in said:
            self.speed_scaling = float(said["speed_scaling"])
        if not arrays or not len(arrays[0]):
            raise garbage("a read without rows")
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)

    def stop(self) -> None:
        """Stop the arm as described in `hil.robot.Robot`.

        A driver process that does not answer within 1 s is killed.
        """
        self._last_stop = object()
        process = self._process
        if process is not None:
            process.stop()

    def close(self) -> None:
        """Close the robot within seconds: stop the arm, request closing, SIGTERM, SIGKILL."""
        process = self._process
        if process is None:
            return
        try:
            problem = _problem(process.stop)
            if isinstance(problem, RobotConnectionError) and not process.alive:
                problem = None  # the process had exited before, so there is nothing to release
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
        """Store the robot properties that the driver reported.

        Optional members are set on the `RobotProcess` only if the driver has them.
        """
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
        # If a thread hangs in a call, closing the connection is sufficient.
        if process and process.answers and self._one_call.acquire(timeout=CLOSE_S):
            try:
                process.ask("close", CLOSE_S)
            finally:
                self._one_call.release()

    def _refuse_if_stopped_since(self, stop: object) -> None:
        """Close the robot and raise if `stop` was called after the value `stop` was read.

        A stop request during connecting is effective even before the driver is ready.
        """
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
"""Time limit for the answer of a driver to a stop request [s].

A driver that does not answer in time is killed, and the robot controller must react to the lost
connection.
"""

TERMINATE_AFTER_S, KILL_AFTER_S = 1.0, 2.0
"""Waiting times for the exit of a driver process before and after SIGTERM [s]."""

_TO_BE_SEEN_S = 1.0


class DriverProcess:
    """Child process of a driver, with the connections to this process.

    Only one thread at a time is allowed to call `ask`. Any number of threads and signal handlers
    can call `stop`, which acquires no lock that an interrupted thread possibly holds.

    Raises:
        PluginError: The operating system is not Linux.
    """

    def __init__(self, name: str) -> None:
        if sys.platform != "linux":
            raise PluginError(
                "a driver can run in its own process on Linux only",
                hint="set own_process: false in the station file",
            )
        self._name = name
        self._numbers = itertools.count()
        self._late: list[StructArray] = []
        self._lost = False
        calls, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        # Packets keep concurrent stops of several threads separate.
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
        """Process id of the driver process, valid also after the process has exited."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the driver process is running and has been neither released nor killed."""
        return self._drop.alive and not self._lost and self._process.poll() is None

    @property
    def answers(self) -> bool:
        """Whether calls are possible: the driver process runs, and its connection is in sync."""
        return self.alive and not self._calls.torn

    @property
    def suspended(self) -> bool:
        """Whether the driver process is suspended (SIGSTOP, a debugger, a freezer)."""
        return is_suspended(self.pid) if self._process.poll() is None else False

    @property
    def exit_code(self) -> int | None:
        """Exit code of the driver process; None while running, negative if a signal ended it."""
        return self._process.poll()

    @property
    def printed(self) -> str:
        """Last part of the output that the driver printed."""
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
        """Call a method of the driver and return its answer.

        Raises:
            RobotTimeout: The driver has not answered in time; rows that arrive late are returned by
                the next `read`.
            RobotConnectionError: The driver process has exited or sent invalid data.
            HilError: Error that the driver raised.
            TypeError, ValueError: The arguments of the call cannot be converted to JSON.
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
                hint=f"the driver or its robot hangs: process {self.pid}",
            ) from error
        if "error" in said:
            with understood():
                raised = error_from(said["error"])
            raise raised
        return said, self._with_late(call, rows)

    def stop(self, within_s: float | None = None) -> None:
        """Stop the arm over the separate stop connection.

        The method has no effect after the driver process was released.

        Args:
            within_s: Time limit for callers that can stop the arm by a different method; the driver
                process is not killed after this limit [s]. By default, the driver process is killed
                if it does not answer within 1 s.

        Raises:
            RobotTimeout: The driver does not answer in time.
            RobotConnectionError: The driver process has exited.
            HilError: Error that the driver raised.
        """
        try:
            answer = self._stops.ask(STOP_WITHIN_S if within_s is None else within_s)
        except (OSError, ValueError) as error:  # raised by a socket that was just closed
            if not self._drop.alive:
                return
            raise self._died(_TO_BE_SEEN_S if within_s is None else 0.0) from error
        if answer is None and within_s is not None:
            raise RobotTimeout(
                f"{self._name}: the driver has not answered a stop within {within_s:g} s",
                hint="stop the arm by other means",
            )
        if answer is None:
            why = " (its process is suspended)" if self.suspended else ""
            self._lost = True
            self._process.kill()
            raise RobotTimeout(
                f"{self._name}: the driver has not answered a stop within {STOP_WITHIN_S:g} s{why} "
                "and was killed; only the controller can stop the arm now",
                hint="check the robot, and use its emergency stop if necessary",
            )
        if answer:
            with understood():
                raised = error_from(json.loads(answer))
            raise raised

    def end(self) -> None:
        """Wait until the driver process exits, or end it, within seconds.

        Idempotent.
        """
        self._drop()

    def forget(self) -> None:
        """Close the connections silently in a forked process, which does not own them."""
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
            f"{self._name}: the driver process {self.pid} is suspended and does not answer",
            hint="check the robot; continue the process (kill -CONT), or end it",
        )

    def _died(self, wait_s: float = _TO_BE_SEEN_S) -> RobotConnectionError:
        self._lost = True
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)
        message = f"{self._name}: the driver process {end_of(self._process.returncode)}"
        last = last_words(self.printed)
        return RobotConnectionError(
            f"{message}; it printed last:\n{last}" if last else message,
            hint="no process commands the robot now: check the robot before you continue",
        )


_mine: weakref.WeakSet[DriverProcess] = weakref.WeakSet()


def _drop(process: subprocess.Popen[bytes], calls: Line, stops: StopLine, log: int) -> None:
    """Close the connections, which makes the child stop the arm; end the child if needed."""
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
    """Close inherited connections in a forked child, which must not use or shut them down."""
    for process in list(_mine):
        process.forget()


os.register_at_fork(after_in_child=_forget_in_fork)


_TOKEN_BYTES = 8
_LOOK_EVERY_S = 0.005
_PACKET_BYTES = 1 << 16


class StopLine:
    """One end of the packet connection for stop requests; no method waits for a lock.

    A signal handler interrupts the main thread, possibly during a stop request, and a lock held by
    the main thread would then never be released. Because no lock is used, every stop request has
    its own token, and packets are atomic. A thread that receives the answer to the stop request of
    a different thread stores the answer for that thread.

    Args:
        end: Connected packet socket; the connection owns the socket.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._tokens = itertools.count()
        self._answers: dict[bytes, bytes] = {}

    def ask(self, within_s: float) -> bytes | None:
        """Request a stop; return the answer, or None if no answer arrived in time.

        Raises:
            OSError: The other side has closed the connection.
        """
        token = next(self._tokens).to_bytes(_TOKEN_BYTES, "little")
        until = time.monotonic() + within_s
        # If the buffer is full, other stops are already waiting in it.
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
        """Close the stop connection; the other side then stops the arm."""
        self._end.close()

    def _receive(self) -> None:
        with contextlib.suppress(BlockingIOError):
            packet = self._end.recv(_PACKET_BYTES)
            if not packet:
                raise BrokenPipeError("the connection has ended")
            self._answers[packet[:_TOKEN_BYTES]] = packet[_TOKEN_BYTES:]


def new_log(name: str) -> int:
    """Return the descriptor of a memory file for output, which never blocks the writer."""
    log = os.memfd_create(f"hil-driver-{name}", os.MFD_CLOEXEC)
    fcntl.fcntl(log, fcntl.F_SETFL, os.O_APPEND)
    return log


def spawn(ours: Sequence[int]) -> subprocess.Popen[bytes]:
    """Start the child process in a separate session, which terminal signals do not reach.

    Args:
        ours: Descriptors for the child process: its ends of the two connections, and the log.
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
    """Return a text about how a process ended, from its return code."""
    if code is None:
        return "has closed the connection"
    if code < 0:
        return f"died (signal {-code}: {signal.strsignal(-code)})"
    return f"ended (exit code {code})"


def is_suspended(pid: int) -> bool:
    """Return whether /proc shows that a process is stopped by a signal or a debugger."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()[0] in ("T", "t")
    except (OSError, IndexError):
        return False


_LAST_BYTES = 2000


def printed_to(log: int) -> str:
    """Return the last part of the printed output."""
    size = os.fstat(log).st_size
    raw = os.pread(log, _LAST_BYTES, max(0, size - _LAST_BYTES))
    return raw.decode("utf-8", "replace")


_CRASH = "Fatal Python error"
_LAST_LINES = 6


def last_words(printed: str) -> str:
    """Return the crash report of the Python interpreter if any, else the last printed lines."""
    _, crash, where = printed.rpartition(_CRASH)
    if crash:
        return "\n".join((crash + where).splitlines()[:_LAST_LINES])
    return "\n".join(printed.strip().splitlines()[-_LAST_LINES:])
