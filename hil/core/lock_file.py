"""Advisory lock files with an owner: leases of robots, live runs, active fleets and hosted buses.

Only one process at a time holds a lock file. The function `hold` acquires the lock file or returns
its present holder, without waiting; `holder_of` only reads the lock file. The lock file contains
JSON about its holder (process, host, user, command, start time), which is shown to the next process
that tries to acquire the file.

Two signals show whether the holder of a lock file is alive: a kernel lock and a heartbeat. The
kernel lock (`flock`) belongs to the open file and ends when the last descriptor is closed, even if
the process is killed. But on a file system without locks, or on a network mount with locks per
host, other hosts do not observe the kernel lock. On file systems without visible locks, the
heartbeat decides: the holder touches the lock file every second, and counts as alive for `FRESH_S`
after the last touch.

The function `hold_folder` locks a folder (`FOLDER/.lock`) and raises a readable error if the folder
is already locked. The function `hold_run` locks a run directory, which counts as live while it is
locked.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import getpass
import json
import os
import platform
import shlex
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from types import TracebackType
from typing import Any

from hil.core.errors import DataError, RecordingError
from hil.core.text import json_text

LOCK = ".lock"
"""Name of the lock file in a folder that only one process at a time may use."""

HEARTBEAT_S = 1.0
FRESH_S = 15.0
"""Maximum age of a heartbeat that still proves a living process if no lock is visible [s]."""

_LOOKED_AT_S = 0.3
"""Time for which `hold` ignores a lock, because `holder_of` locks the file for an instant [s]."""

_MOST_BYTES = 64 * 1024
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP)
_OPEN = os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW


@dataclass(frozen=True, slots=True)
class Holder:
    """Process that holds a lock file.

    Attributes:
        content: Content of the lock file; empty while the holder is writing the file.
        heartbeat_s: Time since the last heartbeat [s].
    """

    content: Mapping[str, Any]
    heartbeat_s: float

    @property
    def id(self) -> str:
        """Identifier of the lock acquisition, unique also within one process."""
        return str(self.content.get("id", ""))

    @property
    def pid(self) -> int:
        """Process id of the holder; 0 if the lock file does not contain the id."""
        pid = self.content.get("pid")
        return pid if isinstance(pid, int) else 0

    @property
    def process(self) -> str:
        """Process as text, for example `pid 4711`, with the host name if the host differs."""
        host = self.content.get("host")
        where = f" on {plain(host)}" if host and host != platform.node() else ""
        return f"pid {self.pid or 'unknown'}{where}"

    def __str__(self) -> str:
        """Return a description of the process with command, start time and run.

        The description has, for example, the form `pid 4711 (hil run spec.yaml, since 10:42, run
        runs/…/0042-dwell)`.
        """
        return self.told()

    def told(self, zone: tzinfo | None = None) -> str:
        """Return the text of `__str__` in a time zone; by default the zone of this computer."""
        run, since = self.content.get("run"), since_words(self.content, zone)
        facts = (self.content.get("command"), since, f"run {run}" if run else "")
        inside = ", ".join(plain(fact) for fact in facts if fact)
        return self.process + (f" ({inside})" if inside else "")


def since_words(content: Mapping[str, Any], zone: tzinfo | None = None) -> str:
    """Return `since 10:42`, with the date if the time is not today; empty if the time is unknown.

    Args:
        content: Content of a lock file, which includes the start time.
        zone: Time zone of the text; by default the time zone of this computer.
    """
    try:
        since = datetime.fromisoformat(str(content["since"])).astimezone(zone)
    except (KeyError, ValueError, OverflowError, OSError):
        return ""
    today = since.date() == datetime.now(UTC).astimezone(zone).date()
    return f"since {since:%H:%M}" if today else f"since {since:%Y-%m-%d %H:%M}"


def plain(text: object, most: int = 200) -> str:
    """Return a text that is safe on a terminal and has at most `most` characters."""
    safe = "".join(c if c.isprintable() else "?" for c in str(text)[: most + 1])
    return safe if len(safe) <= most else safe[: most - 1] + "…"


_descriptors: set[int] = set()


def _close_in_child() -> None:
    """Close the file descriptors of the locks in a forked child.

    A child process made by fork without exec shares the lock, and would hold the lock after the end
    of its parent.
    """
    for descriptor in _descriptors:
        with contextlib.suppress(OSError):
            os.close(descriptor)
    _descriptors.clear()


os.register_at_fork(after_in_child=_close_in_child)


class LockFile:
    """Lock file that this process holds; created by `hold`.

    Args:
        path: Path of the lock file that is held.
        descriptor: File descriptor of the lock file, locked and open for writing; closed by
            `release`.
        content: JSON document that is written into the lock file.

    Raises:
        OSError: The lock file cannot be written.
    """

    def __init__(self, path: Path, descriptor: int, content: Mapping[str, Any]) -> None:
        self.path = path
        self.content = dict(content)
        self._descriptor, self._owner = descriptor, os.getpid()
        self._write()
        _descriptors.add(descriptor)
        self._released = threading.Event()
        self._heartbeat = threading.Thread(target=self._beat, name="hil-heartbeat", daemon=True)
        self._heartbeat.start()

    def update(self, **more: Any) -> None:
        """Add entries to the content of the lock file.

        Raises:
            OSError: The lock file cannot be written.
        """
        self.content |= more
        self._write()

    def release(self) -> None:
        """Remove the lock file and release the lock; a second call has no effect.

        A forked child process does not release the lock of its parent.
        """
        if self._released.is_set() or self._owner != os.getpid():
            return
        self._released.set()
        self._heartbeat.join(2 * HEARTBEAT_S)
        # Removed while locked: a process that opened it earlier detects this after locking it.
        try:
            self.path.unlink()
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, 0)
        _descriptors.discard(self._descriptor)
        os.close(self._descriptor)

    def __enter__(self) -> LockFile:
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


def hold(
    path: Path, about: Mapping[str, Any] | None = None, *, shared: bool = False
) -> LockFile | Holder:
    """Acquire a lock file, or return its present holder; does not wait.

    Args:
        path: Path of the lock file, which is created if missing; its folder must exist.
        about: Additional content of the lock file besides the description of this process.
        shared: Whether other users may acquire the lock file after the end of this process.

    Raises:
        OSError: The lock file cannot be created or written.
    """
    content = _this_process() | dict(about or {})
    patience = time.monotonic() + _LOOKED_AT_S
    while True:
        descriptor = _open_or_make(path, shared)
        try:
            locked = _lock(descriptor, exclusive=True)
            # If the holder removed the file after it was opened here, a new file has a new inode.
            removed = locked is not False and not _is_at(path, descriptor)
            holder = None if removed else _holder(descriptor, locked)
            if not removed and holder is None:
                return LockFile(path, descriptor, content)
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        if holder is not None and time.monotonic() > patience:
            return holder
        time.sleep(0.01)


def _this_process() -> dict[str, Any]:
    program = os.path.basename(sys.argv[0]) if sys.argv else ""
    if program == "__main__.py":
        program = os.path.basename(os.path.dirname(sys.argv[0]))
    return {
        "id": uuid.uuid4().hex,
        "pid": os.getpid(),
        "host": platform.node(),
        "user": user_name(),
        "command": plain(shlex.join([program, *sys.argv[1:]]).strip()),
        "since": datetime.now(UTC).isoformat(timespec="milliseconds"),
    }


def user_name() -> str:
    """Return the name of this process's user; `unknown` if the system has no name for it."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "unknown"


def _open_or_make(path: Path, shared: bool) -> int:
    mode = 0o666 if shared else 0o644
    while True:
        # Creating and opening are separate, because Linux refuses O_CREAT for files of other
        # users in a shared folder.
        with contextlib.suppress(FileNotFoundError):
            return os.open(path, os.O_RDWR | _OPEN)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _OPEN, mode)
        except FileExistsError:
            continue
        if shared:
            os.fchmod(descriptor, mode)  # independent of the umask
        return descriptor


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        there = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    mine = os.fstat(descriptor)
    return (there.st_dev, there.st_ino) == (mine.st_dev, mine.st_ino)


def holder_of(path: Path) -> Holder | None:
    """Return the present holder of a lock file; never waits and never creates the file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN)
    except OSError:
        return None
    try:
        locked = _lock(descriptor, exclusive=False)
        if locked:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # at once, so that no acquiring process waits
        return _holder(descriptor, locked)
    except OSError:
        return None
    finally:
        os.close(descriptor)


def _lock(descriptor: int, *, exclusive: bool) -> bool | None:
    """Return whether the kernel lock was acquired; None if the file system has no locks."""
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        raise
    return True


def _holder(descriptor: int, locked: bool | None) -> Holder | None:
    """Return the other process that holds an open lock file; None if no other process holds it.

    Args:
        descriptor: Open file.
        locked: Result of `_lock` for this open file.
    """
    content = _content(descriptor)
    since = time.time() - os.fstat(descriptor).st_mtime
    age = max(0.0, since)
    if locked is False:
        return Holder(content, age)
    # The kernel detects the end of processes on this host; for other hosts, the heartbeat decides.
    ours = locked and content.get("host") == platform.node()
    # A heartbeat in the future comes from a wrong clock, and would count as alive for too long.
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


@contextlib.contextmanager
def hold_folder(
    folder: Path,
    busy: Callable[[Holder], DataError],
    about: Mapping[str, Any] | None = None,
    *,
    hint: str = "check that the folder exists and is writable, and that its disk has free space",
) -> Iterator[None]:
    """Hold the lock of a folder within the context; the kernel releases it if this process dies.

    Args:
        folder: Existing folder.
        busy: Function that creates the error to raise if a process already holds the folder.
        about: Additional content of the lock file besides the description of this process.
        hint: Hint of the error that is raised if the folder cannot be locked.

    Raises:
        DataError: A process already holds the folder; the function `busy` creates this error.
        RecordingError: The lock file cannot be written.
    """
    try:
        held = hold(folder / LOCK, about)
    except OSError as error:
        message = f"cannot lock {folder}: {error.strerror or error}"
        raise RecordingError(message, hint=hint) from error
    if isinstance(held, Holder):
        raise busy(held)
    with held:
        yield


def hold_run(run: Path) -> contextlib.AbstractContextManager[None]:
    """Hold the lock of a run directory within the context; the run counts as live meanwhile.

    Raises:
        DataError: A different process (or this process) already holds the run.
        RecordingError: The lock file cannot be written.
    """
    return hold_folder(
        run,
        lambda holder: DataError(
            f"{run} is active: it belongs to {holder}", hint=f"follow it with: hil watch {run}"
        ),
    )


def run_holder(run: Path) -> Holder | None:
    """Return the process that holds a run; None if the run is not live."""
    return holder_of(run / LOCK)


def is_live(run: Path) -> bool:
    """Return whether a process holds a run; never waits and never creates a file."""
    return run_holder(run) is not None
