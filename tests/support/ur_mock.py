"""The mock UR controller as a process of its own, on an address nobody else here has."""

from __future__ import annotations

import itertools
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil_mock_robot.server.journal import read_journal

SIDE_PORT = 30100
READY_WITHIN_S = 60.0
ANSWER_WITHIN_S = 60.0
_numbers = itertools.count(100)


class MockUr:
    """A running mock.

    Attributes:
        address: Where it listens.
        process: The process.
    """

    def __init__(self, address: str, process: subprocess.Popen[str], journal: Path | None) -> None:
        self.address, self.process, self._journal = address, process, journal
        self._line = socket.create_connection((address, SIDE_PORT), 5.0)
        self._line.settimeout(ANSWER_WITHIN_S)
        self._answers = self._line.makefile("r", encoding="utf-8")

    def side(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the side channel for something."""
        answer = self.ask(do, **more)
        assert "error" not in answer, answer
        return answer

    def ask(self, do: str, **more: Any) -> dict[str, Any]:
        """The same, errors included."""
        self._line.sendall(json.dumps({"do": do, **more}).encode() + b"\n")
        return dict(json.loads(self._answers.readline()))

    def step(self, ticks: int) -> None:
        """Lock-step: let ticks pass."""
        self.side("step", ticks=ticks)

    def journal(self) -> list[dict[str, Any]]:
        """The lines of its journal so far."""
        assert self._journal is not None, "start the mock with journal="
        return [dict(line) for line in read_journal(self._journal)]

    def connect(self, port: int) -> socket.socket:
        """A bare connection to one of its ports."""
        line = socket.create_connection((self.address, port), 5.0)
        line.settimeout(10.0)
        return line

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it; returns its exit code."""
        self._answers.close()
        self._line.close()
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise


def loopback() -> str:
    """An address of this test process that it has not given away yet."""
    pid = os.getpid()
    return f"127.{1 + pid % 250}.{pid // 250 % 250}.{next(_numbers)}"


@contextmanager
def mock_ur(
    *arguments: str, journal: Path | None = None, address: str | None = None
) -> Iterator[MockUr]:
    """Start a mock, wait until it is ready, end it."""
    address = address or loopback()
    command = [sys.executable, "-m", "hil_mock_robot", "ur", "--address", address]
    command += ["--side-port", str(SIDE_PORT), *arguments]
    if journal is not None:
        command += ["--journal", str(journal)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    mock = None
    try:
        _wait_until_ready(process)
        mock = MockUr(address, process, journal)
        yield mock
    finally:
        if mock is not None:
            mock.end()
        elif process.poll() is None:
            process.kill()
            process.wait(20)
        assert process.stdout is not None
        process.stdout.close()


def _wait_until_ready(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    until = time.monotonic() + READY_WITHIN_S
    while time.monotonic() < until:
        readable, _, _ = select.select([process.stdout], [], [], 0.5)
        if readable:
            line = process.stdout.readline()
            assert line.startswith("ready"), f"the mock says {line!r} and ends"
            return
        assert process.poll() is None, f"the mock has ended with {process.returncode}"
    raise AssertionError("the mock does not get ready")
