"""Room for the last word: a full disk must not keep a run from saying how it ended."""

from __future__ import annotations

import contextlib
import errno
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
        # What no file system compresses or leaves out. Of a nearly full disk a part is taken first.
        if os.write(descriptor, os.urandom(BYTES)) < BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def release(run: Path) -> None:
    """Give back what was taken. Idempotent."""
    with contextlib.suppress(OSError):
        (run / NAME).unlink()
