"""The mock PLC as a process of its own, on an address nobody else here has."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil_mock_robot.server.journal import read_journal
from hil_mock_robot.twincat.mock import TELL
from tests.support.ur_mock import _wait_until_ready, loopback


class MockPlc:
    """A running mock.

    Attributes:
        address: Where it listens.
        process: The process.
    """

    def __init__(self, address: str, process: subprocess.Popen[str], folder: Path) -> None:
        self.address, self.process, self._folder = address, process, folder

    def side(self, **request: Any) -> None:
        """Ask for a fault, `clear=True`, or a `speed`."""
        if "clear" in request:
            request = {"do": "clear"}
        elif "speed" in request:
            request = {"do": "speed", "factor": request["speed"]}
        TELL.ask(str(self._folder / "side"), {"do": "fault", **request})

    def journal(self, event: str = "") -> list[dict[str, Any]]:
        """The lines of its journal so far, of one event or all."""
        lines = [dict(line) for line in read_journal(self._folder / "journal")]
        return [line for line in lines if event in ("", line["event"])]

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it; returns its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise


@contextmanager
def mock_plc(folder: Path, *arguments: str, address: str | None = None) -> Iterator[MockPlc]:
    """Start a mock, wait until it is ready, end it; its journal and side socket are in a folder."""
    address = address or loopback()
    command = [sys.executable, "-m", "hil_mock_robot", "plc", "--address", address]
    command += ["--side", str(folder / "side"), "--journal", str(folder / "journal"), *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    mock = MockPlc(address, process, folder)
    try:
        _wait_until_ready(process)
        yield mock
    finally:
        mock.end()
        assert process.stdout is not None
        process.stdout.close()
