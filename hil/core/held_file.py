"""A file that one process at a time may hold: locked by the kernel, freed by the holder's death.

The lock is `flock`: it belongs to the open file, so it is gone when the last descriptor is, however
the process ends. The content is for people, and says who holds it. Where the kernel cannot tell (a
file system without locks, a network mount whose locks end at each host) the heartbeat must: the
holder touches the file every second, and counts as alive for `FRESH_S` after the last touch.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import platform
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from hil.core.holder import Holder
from hil.core.text import json_text

HEARTBEAT_S = 1.0
FRESH_S = 15.0
"""Up to this age a heartbeat alone counts as a sign of life, where no lock can be seen [s]."""

_LOOKED_AT_S = 0.3
"""Whoever looks locks the file for an instant, which must not pass for a holder [s]."""

_MOST_BYTES = 64 * 1024
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP)
_OPEN = os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW

_descriptors: set[int] = set()


def _let_go_in_child() -> None:
    """A child made by fork without exec shares the lock, and would keep it beyond our death."""
    for descriptor in _descriptors:
        with contextlib.suppress(OSError):
            os.close(descriptor)
    _descriptors.clear()


os.register_at_fork(after_in_child=_let_go_in_child)


class HeldFile:
    """A file this process holds; made by `hold`.

    Args:
        path: Where it is.
        descriptor: Open for writing, and locked; closed by `release`.
        content: What to say in it.

    Raises:
        OSError: The content cannot be written.
    """

    def __init__(self, path: Path, descriptor: int, content: Mapping[str, Any]) -> None:
        self.path = path
        self.content = dict(content)
        self._descriptor, self._owner = descriptor, os.getpid()
        self._write()
        _descriptors.add(descriptor)
        self._released = threading.Event()
        self._beating = threading.Thread(target=self._beat, name="hil-heartbeat", daemon=True)
        self._beating.start()

    def update(self, **more: Any) -> None:
        """Say more in it. Raises `OSError`."""
        self.content |= more
        self._write()

    def release(self) -> None:
        """Remove the file and let it go. Idempotent; a forked child leaves its parent's alone."""
        if self._released.is_set() or self._owner != os.getpid():
            return
        self._released.set()
        self._beating.join(2 * HEARTBEAT_S)
        # Removed while still locked: whoever opened it before finds that out after locking it.
        try:
            self.path.unlink()
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, 0)
        _descriptors.discard(self._descriptor)
        os.close(self._descriptor)

    def __enter__(self) -> HeldFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    def _write(self) -> None:
        raw = json_text(self.content, indent=1).encode() + b"\n"
        os.pwrite(self._descriptor, raw, 0)
        os.ftruncate(self._descriptor, len(raw))

    def _beat(self) -> None:
        while not self._released.wait(HEARTBEAT_S):
            with contextlib.suppress(OSError):
                os.utime(self._descriptor)


def hold(path: Path, content: Mapping[str, Any], *, shared: bool = False) -> HeldFile | Holder:
    """Take hold of a file, or say who has it; does not wait.

    Args:
        path: Made when missing; its folder must exist.
        content: What it shall say; see `hil.core.holder.this_process`.
        shared: Let other users take it over when this process has died.

    Raises:
        OSError: The file cannot be made or written.
    """
    patience = time.monotonic() + _LOOKED_AT_S
    while True:
        descriptor = _open_or_make(path, shared)
        try:
            taken = _take(path, descriptor, content)
        except BaseException:
            os.close(descriptor)
            raise
        if isinstance(taken, HeldFile):
            return taken
        os.close(descriptor)
        if taken is not None and time.monotonic() > patience:
            return taken
        time.sleep(0.01)


def holder_of(path: Path) -> Holder | None:
    """Who holds a file at this moment; never waits, never makes the file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN)
    except OSError:
        return None
    try:
        locked = _lock(descriptor, exclusive=False)
        if locked:
            _unlock(descriptor)  # at once: nobody who takes it meanwhile should have to wait
        return _holder(descriptor, locked)
    except OSError:
        return None
    finally:
        os.close(descriptor)


def _take(path: Path, descriptor: int, content: Mapping[str, Any]) -> HeldFile | Holder | None:
    """The file, who else has it, or None when it was removed after it was opened."""
    got = _lock(descriptor, exclusive=True)
    if got is not False and not _is_at(path, descriptor):
        return None
    return _holder(descriptor, got) or HeldFile(path, descriptor, content)


def _open_or_make(path: Path, shared: bool) -> int:
    mode = 0o666 if shared else 0o644
    while True:
        # Made apart from opening: Linux refuses O_CREAT on others' files in a shared folder.
        with contextlib.suppress(FileNotFoundError):
            return os.open(path, os.O_RDWR | _OPEN)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _OPEN, mode)
        except FileExistsError:
            continue
        if shared:
            os.fchmod(descriptor, mode)  # whatever the umask says
        return descriptor


def _lock(descriptor: int, *, exclusive: bool) -> bool | None:
    """Whether the lock was got; None where there are no locks."""
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        raise
    return True


def _unlock(descriptor: int) -> None:
    fcntl.flock(descriptor, fcntl.LOCK_UN)


def _holder(descriptor: int, locked: bool | None) -> Holder | None:
    """Who holds an open file, given whether we could lock it."""
    content = _content(descriptor)
    since = time.time() - os.fstat(descriptor).st_mtime
    age = max(0.0, since)
    if locked is False:
        return Holder(content, age)
    # Our kernel has seen every process of this host end; of others only the heartbeat tells.
    ours = locked and content.get("host") == platform.node()
    # A beat from the future is of a clock that was wrong, and would count until it comes true.
    return None if ours or not content or abs(since) > FRESH_S else Holder(content, age)


def _content(descriptor: int) -> dict[str, Any]:
    for _ in range(3):  # the holder may be writing
        try:
            content = json.loads(os.pread(descriptor, _MOST_BYTES, 0))
        except (ValueError, RecursionError):
            time.sleep(0.002)
            continue
        return content if isinstance(content, dict) else {}
    return {}


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        there = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    mine = os.fstat(descriptor)
    return (there.st_dev, there.st_ino) == (mine.st_dev, mine.st_ino)
