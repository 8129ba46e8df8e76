"""One writer at a time per name; readers need no lock, as nothing that is there is ever changed."""

from __future__ import annotations

import errno
import fcntl
import os
import time
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
        RegistryError: It cannot be made, or somebody else does not let it go.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise RegistryError(
            f"cannot write in {folder}: {error.strerror}",
            hint="name a registry you may write to with --registry",
        ) from error
    try:
        _wait(descriptor, folder, time.monotonic() + patience_s)
        yield
    finally:
        os.close(descriptor)


def _wait(descriptor: int, folder: Path, until: float) -> None:
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EINTR):
                raise RegistryError(
                    f"{folder} cannot be locked: {error.strerror}",
                    hint="keep the registry on a file system with locks",
                ) from error
        if time.monotonic() > until:
            raise RegistryError(
                f"another process has been writing in {folder} for {PATIENCE_S:.0f} s",
                hint="try again when it is done",
            )
        time.sleep(_POLL_S)
