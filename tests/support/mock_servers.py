"""Mock servers as processes of their own, on addresses and buses that no other test has.

`mock_ur`, `mock_can` and `mock_plc` start one with the arguments of its command line, wait until it
is ready and end it. It is a fork of a process that has imported it already (`mock_forks`), which
takes a tenth of a second instead of two; `by_command=True` runs `python -m hil_mock_robot`.
"""

from __future__ import annotations

import atexit
import itertools
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import can

from hil_mock_robot.cia402.mock import TELL as TELL_CAN
from hil_mock_robot.server.journal import read_journal
from hil_mock_robot.twincat.mock import TELL as TELL_PLC
from tests.support.waiting import until

SIDE_PORT = 30100
READY_WITHIN_S = 60.0
ENDED_WITHIN_S = 20.0
ANSWER_WITHIN_S = 60.0
_numbers = itertools.count()


def loopback() -> str:
    """Return an address of this test process that was not given away yet."""
    pid, number = os.getpid(), next(_numbers)
    return f"127.{1 + pid % 250}.{(pid // 250 + number // 250) % 250}.{2 + number % 250}"


# Processes


class Forks:
    """The process that forks mocks; one for all tests of a process, started by the first."""

    def __init__(self) -> None:
        self._line, theirs = socket.socketpair()
        command = [sys.executable, "-m", "tests.support.mock_forks"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        with theirs:
            self.process = subprocess.Popen(command, stdin=theirs.fileno(), env=environment)
        self._answers = self._line.makefile("r")
        self._owner = os.getpid()
        atexit.register(self.close)

    def fork(self, name: str, arguments: Sequence[str]) -> Fork:
        """Start a mock."""
        out, their_out = os.pipe()
        status, their_status = os.pipe()
        request = {
            "name": name,
            "arguments": list(arguments),
            "folder": os.getcwd(),
            "environment": {**os.environ, "OMP_NUM_THREADS": "1"},
        }
        fds = [their_out, 2, their_status]
        socket.send_fds(self._line, [json.dumps(request).encode()], fds)
        pid = int(self._answers.readline())
        os.close(their_out)
        os.close(their_status)
        return Fork(pid, os.fdopen(out, "r"), status)

    def close(self) -> None:
        """End it, and mocks that still run."""
        if os.getpid() == self._owner:
            self._answers.close()
            self._line.close()
            self.process.wait(ENDED_WITHIN_S)


_forks: list[Forks] = []


class Fork:
    """A forked mock; what `subprocess.Popen` is to a command.

    Attributes:
        pid: Of the process.
        stdout: Its standard output.
        returncode: Exit code, None while it runs.
    """

    def __init__(self, pid: int, stdout: IO[str], status: int) -> None:
        self.pid, self.stdout, self._status = pid, stdout, status
        self.returncode: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the mock has ended and return its exit code."""
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f"mock {self.pid}", timeout or 0.0)
            self.returncode = int(os.read(self._status, 100) or b"-9")
            os.close(self._status)
        return self.returncode

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        with suppress(subprocess.TimeoutExpired):
            return self.wait(0.0)
        return None

    def send_signal(self, number: int) -> None:
        """Send a signal, if it runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


Process = Fork | subprocess.Popen[str]


def command_of(name: str, arguments: Sequence[str]) -> list[str]:
    """Return the command line of a mock."""
    return [sys.executable, "-m", "hil_mock_robot", name, *arguments]


def started(name: str, arguments: Sequence[str], *, by_command: bool = False) -> Process:
    """Start a mock and wait until it is ready."""
    process: Process
    if by_command:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        command = command_of(name, arguments)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    else:
        if not _forks or _forks[0].process.poll() is not None:
            _forks[:] = [Forks()]
        process = _forks[0].fork(name, arguments)
    assert process.stdout is not None
    readable, _, _ = select.select([process.stdout], [], [], READY_WITHIN_S)
    line = process.stdout.readline() if readable else ""
    if not line.startswith("ready"):
        process.kill()
        code = process.wait(ENDED_WITHIN_S)
        process.stdout.close()
        raise AssertionError(f"the mock says {line!r} in place of ready, and ends with {code}")
    return process


class MockServer:
    """A mock that runs.

    Attributes:
        process: The process.
    """

    def __init__(self, process: Process, journal: Path | None) -> None:
        self.process, self._journal = process, journal

    def journal(self, event: str = "") -> list[dict[str, Any]]:
        """Return the lines of its journal so far, of one event or all."""
        assert self._journal is not None, "start the mock with journal="
        lines = [dict(line) for line in read_journal(self._journal)]
        return [line for line in lines if event in ("", line["event"])]

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(ENDED_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise


@contextmanager
def _ended(mock: MockServer) -> Iterator[None]:
    try:
        yield
    finally:
        mock.end()
        assert mock.process.stdout is not None
        mock.process.stdout.close()


@contextmanager
def served(name: str, arguments: Sequence[str]) -> Iterator[MockServer]:
    """Run a mock by its name, or by that of a module with a `main`."""
    mock = MockServer(started(name, arguments), None)
    with _ended(mock):
        yield mock


def _journal_option(journal: Path | None) -> list[str]:
    return [] if journal is None else ["--journal", str(journal)]


# A UR controller


class MockUr(MockServer):
    """A running mock UR controller.

    Attributes:
        address: Where it listens.
    """

    def __init__(self, address: str, process: Process, journal: Path | None) -> None:
        super().__init__(process, journal)
        self.address = address
        self._line = socket.create_connection((address, SIDE_PORT), 5.0)
        self._line.settimeout(ANSWER_WITHIN_S)
        self._answers = self._line.makefile("r", encoding="utf-8")

    def side(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the side channel for something."""
        self._line.sendall(json.dumps({"do": do, **more}).encode() + b"\n")
        answer = dict(json.loads(self._answers.readline()))
        assert "error" not in answer, answer
        return answer

    def step(self, ticks: int) -> None:
        """Lock-step: let ticks pass."""
        self.side("step", ticks=ticks)

    def connect(self, port: int) -> socket.socket:
        """Return a bare connection to one of its ports."""
        line = socket.create_connection((self.address, port), 5.0)
        line.settimeout(10.0)
        return line

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """See `MockServer`."""
        self._answers.close()
        self._line.close()
        return super().end(how)


@contextmanager
def mock_ur(
    *arguments: str,
    journal: Path | None = None,
    address: str | None = None,
    by_command: bool = False,
) -> Iterator[MockUr]:
    """Run a mock UR controller."""
    address = address or loopback()
    place = ["--address", address, "--side-port", str(SIDE_PORT)]
    process = started("ur", [*place, *arguments, *_journal_option(journal)], by_command=by_command)
    mock = MockUr(address, process, journal)
    with _ended(mock):
        yield mock


# Drives on a CAN bus


class MockCan(MockServer):
    """Running mock drives.

    Attributes:
        channel: Path of the bus: `{interface: hil_unix, channel: …}` in a station.
    """

    def __init__(self, channel: Path, process: Process, journal: Path | None) -> None:
        super().__init__(process, journal)
        self.channel, self.side_path = str(channel), str(channel.with_suffix(".side"))

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the side channel; raises `CommandRefused` with what it says is wrong."""
        return TELL_CAN.ask(self.side_path, {"do": do, **more})

    def state(self) -> dict[str, Any]:
        """Return the truth about the arm."""
        return self.tell("state")

    def wait_until(
        self, true: Callable[[dict[str, Any]], bool], within_s: float = 30.0
    ) -> dict[str, Any]:
        """Wait until `true(state())`; return that state."""

        def look() -> dict[str, Any]:
            return state if true(state := self.state()) else {}

        return until(look, within_s, every_s=0.02)

    def bus(self, **more: Any) -> can.BusABC:
        """Return another participant of its bus; close it with `shutdown` or `with`."""
        return can.Bus(interface="hil_unix", channel=self.channel, **more)


@contextmanager
def mock_can(
    *arguments: str,
    journal: Path | None = None,
    channel: Path | str | None = None,
    by_command: bool = False,
) -> Iterator[MockCan]:
    """Run mock drives; on a bus in a temporary folder unless a channel is given."""
    folder = Path(tempfile.mkdtemp(prefix="hil-can-"))
    where = Path(channel) if channel is not None else folder / "can.sock"
    options = ["--channel", str(where), *arguments, *_journal_option(journal)]
    try:
        mock = MockCan(where, started("can", options, by_command=by_command), journal)
        with _ended(mock):
            yield mock
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# A PLC


class MockPlc(MockServer):
    """A running mock PLC.

    Attributes:
        address: Where it listens.
    """

    def __init__(self, address: str, process: Process, folder: Path) -> None:
        super().__init__(process, folder / "journal")
        self.address, self.side_path = address, str(folder / "side")

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the side channel; raises `CommandRefused` with what it says is wrong."""
        return TELL_PLC.ask(self.side_path, {"do": do, **more})

    def side(self, **request: Any) -> None:
        """Ask for a fault, `clear=True`, or a `speed`."""
        if "clear" in request:
            self.tell("clear")
        elif "speed" in request:
            self.tell("speed", factor=request["speed"])
        else:
            self.tell("fault", **request)


@contextmanager
def mock_plc(
    folder: Path, *arguments: str, address: str | None = None, by_command: bool = False
) -> Iterator[MockPlc]:
    """Run a mock PLC; its journal and the socket of its side channel are in a folder."""
    address = address or loopback()
    files = ["--side", str(folder / "side"), "--journal", str(folder / "journal")]
    process = started("plc", ["--address", address, *files, *arguments], by_command=by_command)
    mock = MockPlc(address, process, folder)
    with _ended(mock):
        yield mock
