"""A mock that is a process of its own, as tests see it: asked, made to fail, ended."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.core import CommandRefused, RobotConnectionError, RobotTimeout

ANSWER_WITHIN_S = 60.0
ENDED_WITHIN_S = 20.0
_LOOKS_S = 0.02


class MockProcess(ABC):
    """A mock that runs.

    Attributes:
        process: The process.
    """

    def __init__(self, process: subprocess.Popen[str], journal: Path) -> None:
        self.process, self._journal = process, journal

    @abstractmethod
    def _line(self) -> socket.socket:
        """A new connection to the side channel."""

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the mock itself for something, past the interfaces under test; its answer.

        Args:
            do: A request of its side channel: `state`, `fault`, `push`, `mount`, …
            **more: What the request holds.

        Raises:
            CommandRefused: It does not do that.
            RobotConnectionError: It is not there any more.
        """
        request = json.dumps({"do": do, **more}).encode() + b"\n"
        try:
            with self._line() as line, line.makefile("r", encoding="utf-8") as answers:
                line.settimeout(ANSWER_WITHIN_S)
                line.sendall(request)
                answer = dict(json.loads(answers.readline()))
        except (OSError, ValueError) as error:
            raise RobotConnectionError(f"the mock does not answer: {error}") from error
        if "error" in answer:
            raise CommandRefused(answer["error"], hint=answer.get("hint", ""))
        return answer

    def state(self) -> dict[str, Any]:
        """The truth about the robot: where its arm is, modes, faults that last."""
        return self.tell("state")

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Let something go wrong now; in a `with` statement until its end.

        Args:
            kind: What: docs/reference/mock-ur-faults.md, docs/reference/mock-can-faults.md.
            **keys: Its further keys, such as `for_s`; `at_s` or `motion` for later.

        Raises:
            CommandRefused: There is no such kind or key.
        """
        self.tell("fault", kind=kind, **keys)
        over = contextlib.ExitStack()
        over.callback(self.clear)
        return over

    def clear(self) -> None:
        """What goes wrong is over and nothing is to come; stops stay until they are released."""
        self.tell("clear")

    def wait_until(
        self, true: Callable[[dict[str, Any]], bool], within_s: float = 10.0
    ) -> dict[str, Any]:
        """Wait until `true(state())`; returns that state.

        Raises:
            RobotTimeout: It does not become true in time.
        """
        until = time.monotonic() + within_s
        while not true(state := self.state()):
            if time.monotonic() > until:
                raise RobotTimeout(f"the mock has not got there within {within_s:g} s: {state}")
            time.sleep(_LOOKS_S)
        return state

    def journal(self, event: str = "") -> list[dict[str, Any]]:
        """What it was told and did so far, line by line.

        Args:
            event: Only lines of this event, such as `start`; all of them without.
        """
        if not self._journal.exists():
            return []
        text = self._journal.read_text("utf-8")
        lines = [dict(json.loads(line)) for line in text.splitlines()]
        return [line for line in lines if not event or line["event"] == event]

    def end(self) -> int:
        """End it; returns its exit code.

        Raises:
            RobotTimeout: It does not end, and was killed.
        """
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(ENDED_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise RobotTimeout(f"the mock has not ended within {ENDED_WITHIN_S:g} s") from None
