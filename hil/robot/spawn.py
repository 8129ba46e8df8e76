"""Starting a driver's process, and what its end and its last words say."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Sequence

_LAST_LINES = 6
_LAST_BYTES = 2000
_CRASH = "Fatal Python error"


def new_log(name: str) -> int:
    """A descriptor to print to: a file in memory, which never waits for a reader, nor needs one."""
    log = os.memfd_create(f"hil-driver-{name}", os.MFD_CLOEXEC)
    fcntl.fcntl(log, fcntl.F_SETFL, os.O_APPEND)
    return log


def spawn(ours: Sequence[int]) -> subprocess.Popen[bytes]:
    """Start the child in a session of its own, where the terminal's signals do not reach it.

    Args:
        ours: Descriptors it gets: its ends of the two lines, and the log.
    """
    log = ours[-1]
    return subprocess.Popen(  # noqa: S603, our own module by our own interpreter
        [sys.executable, "-P", "-m", "hil.robot.child", *map(str, ours)],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        pass_fds=ours,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def end_of(code: int | None) -> str:
    """What became of a process, by its return code."""
    if code is None:
        return "has closed the line"
    if code < 0:
        return f"died (signal {-code}: {signal.strsignal(-code)})"
    return f"ended (exit code {code})"


def is_suspended(pid: int) -> bool:
    """Return whether a process is stopped by a signal or a debugger, according to /proc."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()[0] in ("T", "t")
    except (OSError, IndexError):
        return False


def printed_to(log: int) -> str:
    """The end of what was printed."""
    size = os.fstat(log).st_size
    raw = os.pread(log, _LAST_BYTES, max(0, size - _LAST_BYTES))
    return raw.decode("utf-8", "replace")


def last_words(printed: str) -> str:
    """Where it crashed, if it says so; else the last it printed."""
    _, crash, where = printed.rpartition(_CRASH)
    if crash:
        return "\n".join((crash + where).splitlines()[:_LAST_LINES])
    return "\n".join(printed.strip().splitlines()[-_LAST_LINES:])
