"""One writer at a time per name; readers need no lock, as nothing that is there is ever changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hil.core import RegistryError

LOCK_FILE = ".lock"
PATIENCE_S = 30.0
"""Longest wait for another writer: registering copies files, promoting writes a line."""

_POLL_S = 0.01


@contextmanager
def writing(folder: Path, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Hold the lock of a name. The kernel frees it when its holder dies, however it does.

    Raises:
        RegistryError: It cannot be made, or another process does not let it go.
    """
    from filelock import FileLock, Timeout

    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A lock file that survives its holder would keep a registry closed: never a soft lock.
        lock = FileLock(folder / LOCK_FILE, timeout=patience_s, fallback_to_soft=False)
        lock.acquire(poll_interval=_POLL_S)
    except Timeout as error:
        raise RegistryError(
            f"another process has been writing in {folder} for {patience_s:g} s",
            hint="try again when it is done",
        ) from error
    except OSError as error:
        raise RegistryError(
            f"cannot write in {folder}: {error.strerror or error}",
            hint="name a registry you may write to with --registry, on a file system with locks",
        ) from error
    try:
        yield
    finally:
        lock.release()
