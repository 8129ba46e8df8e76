"""Lock files with an owner: a robot's lease, a live run, a fleet at work, a bus that is hosted.

One process at a time may hold such a file. `hold` takes it or returns who has it and never waits;
`holder_of` only looks. The content is JSON about the holder (process, host, user, command, since
when), for the message of whoever comes second.

Two signs of life, because neither is enough. The kernel's `flock` belongs to the open file and is
gone when the last descriptor is, however the process ends; but a file system without locks, or a
network mount whose locks end at each host, does not show it. There the heartbeat decides: the
holder touches the file every second, and counts as alive for `FRESH_S` after the last touch.

`hold_folder` locks a folder (`FOLDER/.lock`) and raises a readable error if it is held; `hold_run`
does so for a run directory, which counts as live while locked.
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
"""Of a folder that one process at a time works in."""

HEARTBEAT_S = 1.0
FRESH_S = 15.0
"""Up to this age a heartbeat alone counts as a sign of life, where no lock can be seen [s]."""

_LOOKED_AT_S = 0.3
"""`holder_of` locks the file for an instant, which must not pass for a holder [s]."""

_MOST_BYTES = 64 * 1024
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP)
_OPEN = os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW


@dataclass(frozen=True, slots=True)
class Holder:
    """The process that holds a lock file.

    Attributes:
        content: What it wrote into the file; empty while it is being written.
        heartbeat_s: Age of the last heartbeat [s].
    """

    content: Mapping[str, Any]
    heartbeat_s: float

    @property
    def id(self) -> str:
        """Unique per acquisition, also within one process."""
        return str(self.content.get("id", ""))

    @property
    def pid(self) -> int:
        """Of the process, 0 when it does not say."""
        pid = self.content.get("pid")
        return pid if isinstance(pid, int) else 0

    @property
    def process(self) -> str:
        """For example `pid 4711`, and on which host if it is another one."""
        host = self.content.get("host")
        where = f" on {plain(host)}" if host and host != platform.node() else ""
        return f"pid {self.pid or 'unknown'}{where}"

    def __str__(self) -> str:
        """For example `pid 4711 (hil run spec.yaml, since 10:42, run runs/…/0042-dwell)`."""
        return self.told()

    def told(self, zone: tzinfo | None = None) -> str:
        """The same in a time zone; by default this computer's."""
        run, since = self.content.get("run"), since_words(self.content, zone)
        facts = (self.content.get("command"), since, f"run {run}" if run else "")
        inside = ", ".join(plain(fact) for fact in facts if fact)
        return self.process + (f" ({inside})" if inside else "")


def since_words(content: Mapping[str, Any], zone: tzinfo | None = None) -> str:
    """Return `since 10:42`, with the day when it is another one; empty when unknown.

    Args:
        content: Of a lock file.
        zone: By default this computer's.
    """
    try:
        since = datetime.fromisoformat(str(content["since"])).astimezone(zone)
    except (KeyError, ValueError, OverflowError, OSError):
        return ""
    today = since.date() == datetime.now(UTC).astimezone(zone).date()
    return f"since {since:%H:%M}" if today else f"since {since:%Y-%m-%d %H:%M}"


def plain(text: object, most: int = 200) -> str:
    """Return a text that is safe on a terminal and not too long, whoever wrote it."""
    told = "".join(c if c.isprintable() else "?" for c in str(text)[: most + 1])
    return told if len(told) <= most else told[: most - 1] + "…"


_descriptors: set[int] = set()


def _close_in_child() -> None:
    """A child made by fork without exec shares the lock, and would keep it beyond our death."""
    for descriptor in _descriptors:
        with contextlib.suppress(OSError):
            os.close(descriptor)
    _descriptors.clear()


os.register_at_fork(after_in_child=_close_in_child)


class LockFile:
    """A lock file that this process holds; made by `hold`.

    Args:
        path: Where it is.
        descriptor: Open for writing, and locked; closed by `release`.
        content: JSON document to write into it.

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
        self._heartbeat = threading.Thread(target=self._beat, name="hil-heartbeat", daemon=True)
        self._heartbeat.start()

    def update(self, **more: Any) -> None:
        """Add to the content. Raises `OSError`."""
        self.content |= more
        self._write()

    def release(self) -> None:
        """Remove the file and let it go. Idempotent; a forked child leaves its parent's alone."""
        if self._released.is_set() or self._owner != os.getpid():
            return
        self._released.set()
        self._heartbeat.join(2 * HEARTBEAT_S)
        # Removed while still locked: a process that opened it before sees that after locking it.
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
    """Take a lock file, or return who has it; does not wait.

    Args:
        path: Made when missing; its folder must exist.
        about: What it shall say besides the process that holds it.
        shared: Let other users take it over when this process has died.

    Raises:
        OSError: The file cannot be made or written.
    """
    content = _this_process() | dict(about or {})
    patience = time.monotonic() + _LOOKED_AT_S
    while True:
        descriptor = _open_or_make(path, shared)
        try:
            locked = _lock(descriptor, exclusive=True)
            # Its holder removed it after it was opened here: the next one has another inode.
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
    """Return the user of this process, as far as the system knows one."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "unknown"


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


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        there = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    mine = os.fstat(descriptor)
    return (there.st_dev, there.st_ino) == (mine.st_dev, mine.st_ino)


def holder_of(path: Path) -> Holder | None:
    """Return who holds a file at this moment; never waits, never makes the file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN)
    except OSError:
        return None
    try:
        locked = _lock(descriptor, exclusive=False)
        if locked:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # at once: a taker should not have to wait
        return _holder(descriptor, locked)
    except OSError:
        return None
    finally:
        os.close(descriptor)


def _lock(descriptor: int, *, exclusive: bool) -> bool | None:
    """Return whether the lock was got; None where there are no locks."""
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
    """Return who else holds an open file, given whether we could lock it."""
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


@contextlib.contextmanager
def hold_folder(
    folder: Path,
    busy: Callable[[Holder], DataError],
    about: Mapping[str, Any] | None = None,
    *,
    hint: str = "see whether the folder is there, may be written to and its disk has room",
) -> Iterator[None]:
    """Hold a folder while inside; the kernel lets it go when this process dies.

    Args:
        folder: It must exist.
        busy: Makes the error to raise when another process (or this one) holds it.
        about: What the lock file shall say besides the process that holds it.
        hint: What to do where the folder cannot be locked.

    Raises:
        DataError: From `busy`.
        RecordingError: The lock cannot be written.
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
    """Hold a run directory while inside; it is live as long as it is held.

    Raises:
        DataError: Another process (or this one) holds it.
        RecordingError: The lock cannot be written.
    """
    return hold_folder(
        run,
        lambda holder: DataError(
            f"{run} is live: it belongs to {holder}", hint=f"follow it with: hil watch {run}"
        ),
    )


def run_holder(run: Path) -> Holder | None:
    """Return the process that holds a run, None when it is not live."""
    return holder_of(run / LOCK)


def is_live(run: Path) -> bool:
    """Return whether a process holds a run; never waits, never makes a file."""
    return run_holder(run) is not None
