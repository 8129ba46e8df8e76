"""Processes that outlive whoever starts them, and what they print."""

from __future__ import annotations

import contextlib
import os
import stat
import subprocess
from collections.abc import Sequence
from pathlib import Path

from hil.core import RecordingError
from hil.recording import STARTED_ID

LAST_LINES = 10
LAST_BYTES = 16 * 1024
SECRETS = ("HIL_TOKEN",)
"""Of the environment; a run and its plugins have no use for them."""


def begin(command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a command in a session of its own.

    Args:
        command: Program and arguments; no shell looks at them.
        log: What it prints; made, with its folder. It is not left behind where nothing was started.
            Its stem names the process, in its environment, see `is_ours`.

    Raises:
        RecordingError: The log cannot be written.
    """
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("xb") as printed:
            return subprocess.Popen(  # noqa: S603 - our own command line, no shell
                command,
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=own_environment() | {STARTED_ID: log.stem},
            )
    except OSError as error:
        with contextlib.suppress(OSError):
            log.unlink()
        raise RecordingError(
            f"cannot write to {log.parent}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def last_lines(log: Path) -> list[str]:
    """The last lines of what a process printed; of a long log only its end is read.

    None of a link, a pipe or a device that stands there: only what `begin` makes is a log.
    """
    try:
        # Not to wait for the writer of a pipe.
        opened = os.open(log, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        with open(opened, "rb") as printed:
            about = os.fstat(opened)
            if not stat.S_ISREG(about.st_mode):
                return []
            printed.seek(max(0, about.st_size - LAST_BYTES))
            text = printed.read(LAST_BYTES).decode("utf-8", "replace")
    except OSError:
        return []
    return text.replace("\r", "\n").splitlines()[-LAST_LINES:]


def ticks_of(pid: int) -> int:
    """When a process began in the kernel's own count, 0 for one that has ended."""
    try:
        about = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return 0
    state, *fields = about[about.rindex(")") + 2 :].split()
    return 0 if state in "ZX" else int(fields[18])


def is_ours(pid: int, name: str) -> bool:
    """Whether a process is a `python -P -m hil …` that `begin` has started under a name.

    What a record says is no proof: others may write in its folder. False where we may not look.
    """
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        given = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
    return words[1:4] == [b"-P", b"-m", b"hil"] and os.fsencode(f"{STARTED_ID}={name}") in given


def own_environment() -> dict[str, str]:
    """What a process that is started for somebody else gets: all but secrets."""
    return {key: value for key, value in os.environ.items() if key not in SECRETS}
