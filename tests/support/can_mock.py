"""The mock drives as a process of their own, on a bus that nobody else has."""

from __future__ import annotations

import itertools
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can

from hil_mock_robot.cia402.mock import TELL
from hil_mock_robot.server.journal import read_journal

READY_WITHIN_S = 60.0
ENDED_WITHIN_S = 20.0
_numbers = itertools.count(1)


class MockCan:
    """Running mock drives.

    Attributes:
        channel: Path of the bus: `{interface: hil_unix, channel: …}` in a station.
        process: The process.
    """

    def __init__(self, channel: Path, process: subprocess.Popen[str], journal: Path | None) -> None:
        self.channel, self.process, self._journal = str(channel), process, journal
        self._side = str(channel.with_suffix(".side"))

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the side channel; raises `CommandRefused` with what it says is wrong."""
        return TELL.ask(self._side, {"do": do, **more})

    def state(self) -> dict[str, Any]:
        """The truth about the arm."""
        return self.tell("state")

    def wait_until(self, true: Any, within_s: float = 10.0) -> dict[str, Any]:
        """Wait until `true(state())`; returns that state."""
        until = time.monotonic() + within_s
        while not true(state := self.state()):
            assert time.monotonic() < until, f"not within {within_s} s: {state}"
            time.sleep(0.02)
        return state

    def journal(self) -> list[dict[str, Any]]:
        """The lines of its journal so far."""
        assert self._journal is not None, "start the mock with journal="
        return [dict(line) for line in read_journal(self._journal)]

    def bus(self, **more: Any) -> can.BusABC:
        """Another participant of its bus; close it with `shutdown`, or use it with `with`."""
        return can.Bus(interface="hil_unix", channel=self.channel, **more)

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End it; returns its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(ENDED_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise


@contextmanager
def mock_can(
    *arguments: str, journal: Path | None = None, channel: Path | str | None = None
) -> Iterator[MockCan]:
    """Start mock drives, wait until their bus is there, end them.

    Args:
        *arguments: Of `python -m hil_mock_robot can`; it has a channel of its own already.
        journal: File for what happens.
        channel: Path of the bus; one of its own in a temporary folder without.
    """
    folder = Path(tempfile.mkdtemp(prefix="hil-can-"))
    where = Path(channel) if channel is not None else folder / f"can{next(_numbers)}.sock"
    command = [sys.executable, "-m", "hil_mock_robot", "can", "--channel", str(where), *arguments]
    if journal is not None:
        command += ["--journal", str(journal)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    mock = MockCan(where, process, journal)
    try:
        _wait_until_ready(process)
        yield mock
    finally:
        mock.end()
        assert process.stdout is not None
        process.stdout.close()
        shutil.rmtree(folder, ignore_errors=True)


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
