"""Process of a driver: `python -m hil.robot.subprocess_server CALLS STOP LOG`.

The driver process has two connections to `hil`. Calls of driver methods arrive over the first
connection and are answered one after the other (`serve`). Stop requests arrive over the second
connection and are handled by a separate thread (`Guard`), so that a slow call cannot delay a stop.
The class `HostedRobot` contains the driver, which both threads use. If one of the two connections
is closed, or at SIGTERM, the process stops the arm, monitors the arm until it is static, releases
the robot and exits. If a driver blocks the Python interpreter, a timer in C ends the process, and
the robot controller must react to the lost connection. The module `hil.robot.subprocess_robot`
contains the code of the process that commands the robot.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np

from hil.core import HilError, RobotConnectionError, RobotError, StructArray, plugins
from hil.robot.ipc import (
    EndOfLine,
    Line,
    Message,
    error_document,
    facts_document,
    pack,
    payload_from,
    segment_from,
)
from hil.robot.protocol import HasChecks, HasSpeedScaling, HasTopics, Robot
from hil.robot.state import Status

_TERMINATED = 128 + signal.SIGTERM
_BROKEN = 1


def main(arguments: list[str]) -> None:
    """Run the driver process; this function never returns."""
    calls_at, stops_at, log = (int(text) for text in arguments[:3])
    for descriptor in (calls_at, stops_at, log):
        # A process started by the driver must not inherit the connections and keep them open.
        os.set_inheritable(descriptor, False)
    faulthandler.enable(all_threads=False)
    terminated = _hear_signals()
    calls, stops = Line(socket.socket(fileno=calls_at)), socket.socket(fileno=stops_at)
    robot = HostedRobot()
    guard = Guard(robot, stops, calls, terminated, log)
    guard.start()
    code = 0
    try:
        serve(calls, robot)
    except EndOfLine:
        code = _TERMINATED if guard.terminated else 0
    except BaseException:
        traceback.print_exc()
        code = _BROKEN
    try:
        # The guard detects the shutdown and starts the timer that ends the process.
        with contextlib.suppress(OSError):
            stops.shutdown(socket.SHUT_RDWR)
        robot.let_go(gone=True)
        robot.finish()
    finally:
        _end(code)


def _hear_signals() -> int:
    """Ignore the signals of the terminal; return a descriptor that becomes readable at SIGTERM."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    return woken


def serve(calls: Line, robot: HostedRobot) -> None:
    """Answer calls until the robot is closed.

    Raise `RobotConnectionError` if the connection ends.
    """
    while not robot.closed:
        said, rows = robot.answer(calls.receive())
        try:
            frame = pack(said, rows)
        except (HilError, TypeError, ValueError) as error:
            frame = pack({"id": said["id"], "error": error_document(error, "answering")})
        calls.send(frame)


def _end(code: int) -> None:
    """Exit the process immediately, without waiting for threads of vendor libraries."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(code)


STOP_TOKEN_BYTES = 8
"""Size of a stop request [bytes]; the answer starts with the same bytes and can contain an
error."""

MOST_LOG_BYTES = 1 << 18

KEPT_LOG_BYTES = 1 << 13
"""Size to which the output file of the driver is truncated [bytes], so that printing never
blocks."""

LAST_WORD_S = 5.0
"""Additional time after `REST_S` at which a hanging driver process is ended in any case [s]."""

HELD_S = 15.0
"""Time after which a driver that blocks the interpreter is ended [s]; the robot controller must
then react."""

_TICK_S = 0.25

REST_S = 5.0
"""Maximum time for which a released arm is monitored until it is static [s]."""


class Guard(threading.Thread):
    """Thread that stops the arm if requested, if the client is gone, or if the arm is not read.

    Args:
        robot: Robot that the thread stops.
        stops: Connection for stop requests.
        calls: Connection for calls; the thread shuts it down if the other side is gone, so that the
            call thread ends.
        woken: Descriptor that becomes readable at a signal, even while C code of the driver runs.
        log: Descriptor of the output file of the driver, which is truncated regularly.
    """

    def __init__(
        self, robot: HostedRobot, stops: socket.socket, calls: Line, woken: int, log: int
    ) -> None:
        super().__init__(name="hil-guard", daemon=True)
        self._robot, self._stops, self._calls = robot, stops, calls
        self._woken, self._log = woken, log
        self.terminated = False

    def run(self) -> None:
        """Monitor the robot until the robot has to be released."""
        poll = select.poll()
        poll.register(self._stops, select.POLLIN)
        poll.register(self._woken, select.POLLIN)
        while True:
            # This timer runs in C and works even if the interpreter is blocked.
            faulthandler.dump_traceback_later(HELD_S, exit=True)
            ready = [descriptor for descriptor, _ in poll.poll(_TICK_S * 1000)]
            if self._woken in ready and signal.SIGTERM in os.read(self._woken, 64):
                self.terminated = True
                return self._let_go(gone=False)
            if self._stops.fileno() in ready and not self._answer():
                return self._let_go(gone=True)
            self._robot.stop_if_unread()
            with contextlib.suppress(OSError):
                _keep_short(self._log)

    def _answer(self) -> bool:
        """Stop the arm and answer the request; return False if the other side is gone."""
        try:
            token = self._stops.recv(STOP_TOKEN_BYTES)
            if token:
                self._stops.sendall(token + self._stop())
        except OSError:
            return False
        return bool(token)

    def _stop(self) -> bytes:
        try:
            self._robot.stop()
        except Exception as error:
            return json.dumps(error_document(error, "stop")).encode()
        return b""

    def _let_go(self, *, gone: bool) -> None:
        faulthandler.dump_traceback_later(REST_S + LAST_WORD_S, exit=True)
        self._robot.let_go(gone=gone)
        self._calls.cut()


def _keep_short(log: int) -> None:
    size = os.fstat(log).st_size
    if size > MOST_LOG_BYTES:
        end = os.pread(log, KEPT_LOG_BYTES, size - KEPT_LOG_BYTES)
        os.ftruncate(log, 0)
        os.write(log, end)


UNREAD_S = 2.0
"""Time without a read after which a moving arm is stopped [s], because `hil` is suspended or
hangs."""

_REST_RAD_S = 0.01


class HostedRobot:
    """One driver and its state within the driver process.

    The call thread and the stop thread share this object. Only the call thread calls methods of the
    driver other than `stop`.
    """

    def __init__(self) -> None:
        self._robot: Robot | None = None
        self._wall = True
        self._moving = False
        self._busy = False
        self._last_asked = time.monotonic()
        self._complaint = ""
        self._closed = False
        self._letting_go = threading.Lock()
        self._let_go = False
        self._members: dict[str, Callable[..., Message]] = {
            "open": self._open,
            "connect": self._connect,
            "set_payload": self._set_payload,
            "prepare": self._prepare,
            "start": self._start,
            "read": self._read,
            "drain": self._drain,
            "checks": self._checks,
            "close": self._close,
        }

    def answer(self, question: Message) -> Message:
        """Execute a call and return its answer; an error is also returned as an answer."""
        asked, arrays = question
        doing = str(asked.get("call"))
        self._busy = True
        try:
            if self._let_go:
                raise RobotConnectionError("the driver process is about to end")
            if doing not in self._members:
                raise RobotError(f"unknown request to the driver process: {doing!r}")
            said, rows = self._members[doing](asked.get("with", {}), arrays)
        # A vendor library that calls sys.exit must not end the process that can stop the arm.
        except (Exception, SystemExit) as error:
            said, rows = {"error": error_document(error, doing)}, []
        finally:
            self._last_asked = time.monotonic()
            self._busy = False
        return {"id": asked.get("id"), **said}, rows

    @property
    def closed(self) -> bool:
        """Whether a call has closed the robot, after which no call remains."""
        return self._closed

    def stop(self) -> None:
        """Stop the arm from any thread; no effect before a driver has been opened."""
        if self._robot is not None:
            self._robot.stop()

    def stop_if_unread(self) -> None:
        """Stop an arm that moves in wall time although its state is not read.

        The next call of a driver method raises an error about this stop.
        """
        unread = time.monotonic() - self._last_asked
        if self._busy or not (self._moving and self._wall) or unread < UNREAD_S:
            return
        self._moving = False
        self._complaint = (
            f"the arm moved and no samples were read for {unread:.1f} s: its driver stopped it"
        )
        _attempt(self.stop)

    def let_go(self, *, gone: bool) -> None:
        """Stop the arm, because no process commands it; only the first call has an effect.

        Any thread can call this method.

        Args:
            gone: Whether the other side has disappeared; a mock robot is notified about the loss.
        """
        with self._letting_go:
            if self._let_go or self._closed:
                return
            self._let_go = True
            if gone:
                _attempt(getattr(self._robot, "client_gone", None))
            _attempt(self.stop)

    def finish(self) -> None:
        """Monitor a released arm until it is static, then close the driver."""
        if self._robot is None or self._closed:
            return
        # Repeated, because a call in progress possibly started a motion after the first stop.
        _attempt(self.stop)
        _attempt(self._come_to_rest)
        _attempt(self._robot.close)

    def _come_to_rest(self) -> None:
        until = time.monotonic() + REST_S
        while time.monotonic() < until:
            row = self._opened().read()[-1]
            if not row["status"] & Status.MOVING and (np.abs(row["qd"]) < _REST_RAD_S).all():
                return

    def _open(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._robot = open_driver(how)
        return facts_document(self._robot, connected=False), []

    def _connect(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        robot = self._opened()
        robot.connect()
        self._wall = robot.capabilities.clock == "wall"
        return facts_document(robot, connected=True), []

    def _set_payload(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        return {"payload": asdict(self._opened().set_payload(payload_from(how)))}, []

    def _prepare(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._complain()
        self._opened().prepare(segment_from(how, arrays))
        return {}, []

    def _start(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._complain()
        before, self._moving = self._moving, True
        try:
            self._opened().start()
        except BaseException:
            self._moving = before
            raise
        return {}, []

    def _read(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._complain()
        robot = self._opened()
        rows = robot.read(how["timeout_s"])
        self._moving = bool(rows[-1]["status"] & Status.MOVING)
        more = {"speed_scaling": robot.speed_scaling} if isinstance(robot, HasSpeedScaling) else {}
        return more, [rows]

    def _drain(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        robot = self._opened()
        fresh = robot.drain() if isinstance(robot, HasTopics) else {}
        return {"topics": list(fresh)}, list(fresh.values())

    def _checks(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        robot = self._opened()
        findings = robot.checks() if isinstance(robot, HasChecks) else ()
        return {"findings": [asdict(finding) for finding in findings]}, []

    def _close(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        try:
            self._opened().close()
        finally:
            # Set before the answer, because the other side closes the connection after the answer.
            self._closed = True
        return {}, []

    def _opened(self) -> Robot:
        if self._robot is None:
            raise RobotConnectionError("the driver was not opened")
        return self._robot

    def _complain(self) -> None:
        complaint, self._complaint = self._complaint, ""
        if complaint:
            raise RobotConnectionError(
                complaint, hint="if hil was suspended, continue its process, then resume the run"
            )


def _attempt(member: Callable[[], object] | None) -> None:
    """Call a function and print an exception instead of raising it."""
    try:
        if member is not None:
            member()
    except Exception:
        traceback.print_exc()


_GROUP = "hil.drivers"


def open_driver(how: Mapping[str, Any]) -> Robot:
    """Return the driver object, which is not connected.

    Args:
        how: Document with the keys `driver` (name or `module:Class`), `name`, `model`, `options`;
            `gravity` for simulating drivers, or None; `pythonpath` with which `hil` was started, or
            None.

    Raises:
        PluginError, SpecError, TypeError, ValueError: The driver cannot be opened, see
            `hil.planning.robots.open_robot`.
    """
    # Programs started by the driver get the environment with which `hil` was started.
    os.environ.pop("PYTHONPATH", None)
    if how["pythonpath"] is not None:
        os.environ["PYTHONPATH"] = how["pythonpath"]
    target = how["driver"]
    point = EntryPoint(target, target, _GROUP) if ":" in target else plugins.find(_GROUP, target)
    robot: Robot = plugins.load_point(point)(how["name"], how["model"], **how["options"])
    if how["gravity"] is not None and hasattr(robot, "set_gravity"):
        robot.set_gravity(tuple(how["gravity"]))
    return robot


if __name__ == "__main__":
    main(sys.argv[1:])
