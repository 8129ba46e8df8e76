"""The command line as a program sees it: exit code and bytes of output, without a new process.

A process of its own costs a second of imports. It is needed where signals, pipes, a terminal, or
what is imported are tested.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hil.cli.app import main

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class Said:
    """What a command printed, as it leaves the process."""

    returncode: int
    stdout: str
    stderr: str

    @property
    def document(self) -> Any:
        """The one JSON document of its standard output."""
        return json.loads(self.stdout)


def hil(*arguments: object, cwd: Path | None = None, **env: str) -> Said:
    """Run `hil` in this process, with pipes for its streams and no station in the environment.

    Args:
        arguments: As on the command line.
        cwd: Folder in which it runs.
        env: Changes to the environment.
    """
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", errors="strict") for _ in range(2))
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    with (
        patch.dict(os.environ, {"HIL_STATION": "", **env}),
        patch.object(sys, "argv", ["hil", *map(str, arguments)]),
        patch.object(sys, "stdin", io.StringIO()),
        patch.object(sys, "stdout", out),
        patch.object(sys, "stderr", err),
        contextlib.chdir(cwd or Path.cwd()),
    ):
        try:
            main()
            code = 0
        except SystemExit as ending:
            code = ending.code if isinstance(ending.code, int) else int(ending.code is not None)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    texts = [stream.buffer.getvalue().decode() for stream in (out, err) if not stream.flush()]  # type: ignore[attr-defined]
    return Said(code, *texts)
