"""The lock of a live run: `RUN/.lock`, held from its first file to its last."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from hil.core.errors import DataError, RecordingError
from hil.core.held_file import hold, holder_of
from hil.core.holder import Holder, this_process

LOCK = ".lock"


@contextlib.contextmanager
def hold_run(run: Path) -> Iterator[None]:
    """Hold a run while inside; the kernel lets it go when this process dies.

    Args:
        run: The run directory; it must exist.

    Raises:
        DataError: Another process (or this one) holds it.
        RecordingError: The lock cannot be written.
    """
    try:
        held = hold(run / LOCK, this_process())
    except OSError as error:
        raise RecordingError(
            f"cannot lock {run}: {error.strerror or error}",
            hint="see whether the folder is there, may be written to and its disk has room",
        ) from error
    if isinstance(held, Holder):
        raise DataError(
            f"{run} is live: it belongs to {held}",
            hint=f"follow it with: hil watch {run}",
        )
    with held:
        yield


def is_live(run: Path) -> bool:
    """Whether a process holds the run; never waits, never makes a file."""
    return holder_of(run / LOCK) is not None


def run_holder(run: Path) -> Holder | None:
    """The process that holds the run, None when it is not live."""
    return holder_of(run / LOCK)
