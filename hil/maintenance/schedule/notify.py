"""Tell a command of the lab's own what came of an occasion: JSON on its standard input."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hil.core import json_text, plain

WITHIN_S = 60.0


@dataclass(frozen=True, slots=True)
class Command:
    """Run after every occasion; nothing it does ends the loop.

    Attributes:
        words: The command and its arguments; empty for none.
        schedule: Name of the schedule, in what it is told.
        within_s: It is killed after that time [s].
    """

    words: tuple[str, ...]
    schedule: str
    within_s: float = WITHIN_S

    def __call__(self, line: Mapping[str, Any]) -> str:
        """Tell it a line of the ledger; returns why that failed, or nothing."""
        if not self.words:
            return ""
        told = {key: value for key, value in line.items() if key != "before"}
        text = json_text({"schedule": self.schedule, **told})
        try:
            return self._run(text.encode())
        except subprocess.TimeoutExpired:
            return f"{self.words[0]} did not end within {self.within_s:g} s"
        except (OSError, ValueError) as error:
            return f"{self.words[0]} cannot be run: {error}"

    def _run(self, said: bytes) -> str:
        # Files, not pipes: a grandchild may keep a pipe open for as long as it likes.
        with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as told:
            given.write(said)
            given.seek(0)
            command = subprocess.Popen(  # noqa: S603
                self.words,
                stdin=given,
                stdout=subprocess.DEVNULL,
                stderr=told,
                start_new_session=True,
            )
            try:
                code = command.wait(self.within_s)
            finally:
                if command.poll() is None:
                    os.killpg(command.pid, signal.SIGKILL)
                    command.wait()
            told.seek(0)
            last = told.read().decode("utf-8", "replace").strip().splitlines()[-1:]
        if not code:
            return ""
        return f"{self.words[0]} ended with {code}" + "".join(f": {plain(line)}" for line in last)
