"""Room for the last word: a full disk must not keep a run from saying how it ended."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

NAME = ".reserve"
BYTES = 1 << 20


def reserve(run: Path) -> None:
    """Take some of the disk for a run, to be given back for its stop document.

    Raises:
        OSError: There is not even that much left.
    """
    descriptor = os.open(run / NAME, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        os.write(descriptor, os.urandom(BYTES))  # what no file system compresses or leaves out
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def release(run: Path) -> None:
    """Give back what was taken. Idempotent."""
    with contextlib.suppress(OSError):
        (run / NAME).unlink()
