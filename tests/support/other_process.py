"""A second Python process that does something, says so, and waits to be told or killed."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def other_process(code: str, **env: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Run `code`, which prints `ready` when it has got there; killed on the way out."""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **{name: str(value) for name, value in env.items()}},
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def holding_run(run: Path, then: str = "input()") -> str:
    """Code that holds a run."""
    return (
        "from pathlib import Path\n"
        "from hil.core.lock_file import hold_run\n"
        f"with hold_run(Path({str(run)!r})):\n"
        "    print('ready', flush=True)\n"
        f"    {then}\n"
    )
