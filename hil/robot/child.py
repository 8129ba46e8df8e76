"""The process a driver lives in: `python -m hil.robot.child CALLS STOP LOG`.

Two lines lead to it. Calls come over the first and are answered one after the other; stops come
over the second, which has a thread of its own, so that no call that takes its time delays one. The
end of either line, and SIGTERM, mean: stop the arm, follow it to rest, release it, end.
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
import traceback

from hil.core import HilError
from hil.robot.documents import error_document
from hil.robot.frames import pack
from hil.robot.hosted import REST_S, HostedRobot
from hil.robot.wire import EndOfLine, Line

STOP_TOKEN_BYTES = 8
"""A stop is a packet of so many bytes; its answer begins with them and may go on with an error."""

MOST_LOG_BYTES = 1 << 18
KEPT_LOG_BYTES = 1 << 13
"""Of what the driver prints, so much is kept [bytes]; it must never wait for a reader."""

LAST_WORD_S = 5.0
"""Beyond the time to come to rest, after which the process ends whatever still hangs in it [s]."""

HELD_S = 15.0
"""A driver that holds the interpreter for so long is ended: its controller must notice [s]."""

_TICK_S = 0.25
_TERMINATED = 128 + signal.SIGTERM
_BROKEN = 1


class Guard(threading.Thread):
    """Stops the arm: when asked, when nobody is there any more, and when nobody reads it.

    Args:
        robot: What is to be stopped.
        stops: The line stops come over.
        calls: Cut when nobody is there, so that the thread that answers calls comes to an end.
        woken: Becomes readable at a signal, even while a driver's C code runs.
        log: Descriptor of what the driver prints; kept short.
    """

    def __init__(
        self, robot: HostedRobot, stops: socket.socket, calls: Line, woken: int, log: int
    ) -> None:
        super().__init__(name="hil-guard", daemon=True)
        self._robot, self._stops, self._calls = robot, stops, calls
        self._woken, self._log = woken, log
        self.terminated = False

    def run(self) -> None:
        """Watch until the robot has to be let go."""
        poll = select.poll()
        poll.register(self._stops, select.POLLIN)
        poll.register(self._woken, select.POLLIN)
        while True:
            # By a timer in C: it works although the interpreter is held.
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
        """Stop and say so; False when nobody is there any more."""
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


def serve(calls: Line, robot: HostedRobot) -> None:
    """Answer calls until the robot is closed; raises `RobotConnectionError` if the line ends."""
    while not robot.closed:
        said, rows = robot.answer(calls.receive())
        try:
            frame = pack(said, rows)
        except (HilError, TypeError, ValueError) as error:
            frame = pack({"id": said["id"], "error": error_document(error, "answering")})
        calls.send(frame)


def main(arguments: list[str]) -> None:
    """Be a driver's process; never returns."""
    calls_at, stops_at, log = (int(text) for text in arguments[:3])
    for descriptor in (calls_at, stops_at, log):
        # A process that the driver starts must not keep our lines open beyond our end.
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
        # The guard sees this and sets the time by which everything has an end.
        with contextlib.suppress(OSError):
            stops.shutdown(socket.SHUT_RDWR)
        robot.let_go(gone=True)
        robot.finish()
    finally:
        _end(code)


def _end(code: int) -> None:
    """Not by returning: threads of a vendor's library must not keep the process alive."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(code)


def _hear_signals() -> int:
    """Leave the terminal's signals to `hil`; returns what becomes readable at SIGTERM."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    return woken


def _keep_short(log: int) -> None:
    size = os.fstat(log).st_size
    if size > MOST_LOG_BYTES:
        end = os.pread(log, KEPT_LOG_BYTES, size - KEPT_LOG_BYTES)
        os.ftruncate(log, 0)
        os.write(log, end)


if __name__ == "__main__":
    main(sys.argv[1:])
