"""Who holds a run or a robot: what a process says about itself, for people to read."""

from __future__ import annotations

import getpass
import os
import platform
import shlex
import sys
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from typing import Any


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds a file (see `hil.core.held_file`).

    Attributes:
        content: What the holder wrote into it; empty while it is being written.
        heartbeat_s: Age of the last heartbeat [s].
    """

    content: Mapping[str, Any]
    heartbeat_s: float

    @property
    def id(self) -> str:
        """Tells this holding from every other one."""
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
        told = (self.content.get("command"), since, f"run {run}" if run else "")
        inside = ", ".join(plain(text) for text in told if text)
        return self.process + (f" ({inside})" if inside else "")


def this_process() -> dict[str, Any]:
    """What a holder says about itself."""
    return {
        "id": uuid.uuid4().hex,
        "pid": os.getpid(),
        "host": platform.node(),
        "user": user_name(),
        "command": _command(),
        "since": datetime.now(UTC).isoformat(timespec="milliseconds"),
    }


def user_name() -> str:
    """The user of this process, as far as the system knows one."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "unknown"


def since_words(content: Mapping[str, Any], zone: tzinfo | None = None) -> str:
    """`since 10:42` in a time zone, with the day when it is another one; empty when unknown.

    By default the time is local.
    """
    try:
        since = datetime.fromisoformat(str(content["since"])).astimezone(zone)
    except (KeyError, ValueError, OverflowError, OSError):
        return ""
    today = since.date() == datetime.now(UTC).astimezone(zone).date()
    return f"since {since:%H:%M}" if today else f"since {since:%Y-%m-%d %H:%M}"


def plain(text: object, most: int = 200) -> str:
    """A text that is safe on a terminal and not too long, whoever wrote it."""
    told = "".join(c if c.isprintable() else "?" for c in str(text)[: most + 1])
    return told if len(told) <= most else told[: most - 1] + "…"


def _command() -> str:
    program = os.path.basename(sys.argv[0]) if sys.argv else ""
    if program == "__main__.py":
        program = os.path.basename(os.path.dirname(sys.argv[0]))
    return plain(shlex.join([program, *sys.argv[1:]]).strip())
