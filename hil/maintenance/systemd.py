"""systemd units of a schedule: a service that keeps running, or a timer that starts one."""

from __future__ import annotations

import os
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from hil.core import RecordingError, SpecError, user_name, write_replacing

CALL_EVERY_MIN = 5
"""Interval of the timer; what is due is decided by the schedule [min]."""

STOP_WITHIN_S = 120
"""Longest time that a robot has to come to rest and a recording to be closed [s]."""

HANDED_ON = ("HIL_LEASES", "HIL_STATION")
"""Environment variables that the service gets as they are here."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit file.

    Attributes:
        name: Of the file.
        text: Its content.
    """

    name: str
    text: str


_SERVICE = """[Unit]
Description=hil schedule {name}
After=network-online.target time-sync.target
Wants=network-online.target
{limits}
[Service]
Type={kind}
{owner}WorkingDirectory={folder}
{environment}ExecStart={command}
# A stop by signal is an orderly one: the robot is at rest, and the run is gone on with.
SuccessExitStatus=130
KillSignal=SIGTERM
KillMode=mixed
TimeoutStopSec={stop_s}
{restart}{install}"""

_RESTART = """Restart=on-failure
RestartSec=30
# A mistake in a file, or a schedule that is not armed, does not go away by itself.
RestartPreventExitStatus=2 3
"""

_LIMITS = """StartLimitIntervalSec=1h
StartLimitBurst=5
"""

_TIMER = """[Unit]
Description=hil schedule {name}: looks whether something is due

[Timer]
OnCalendar=*:0/{every}
AccuracySec=1s
Persistent=true

[Install]
WantedBy=timers.target
"""


def units_of(
    name: str, arguments: tuple[str, ...], folder: Path, *, timer: bool, user: bool
) -> list[Unit]:
    """Return the units of a schedule.

    Args:
        name: Of the schedule.
        arguments: Of `hil schedule run`, with absolute paths.
        folder: Its working directory.
        timer: Whether a timer starts the service, in place of a service that keeps running.
        user: Whether the units are for `systemctl --user`.

    Raises:
        SpecError: A path has characters that a unit cannot have.
    """
    command = (sys.executable, "-P", "-m", "hil", "schedule", "run", *arguments)
    words = " ".join(_quoted(word) for word in (*command, *(("--once",) if timer else ())))
    target = "default.target" if user else "multi-user.target"
    unit = f"hil-{name}"
    service = _SERVICE.format(
        name=name,
        kind="oneshot" if timer else "exec",
        # Leases are per user: the schedule must run as the user who also runs experiments by hand.
        owner="" if user else f"User={user_name()}\n",
        environment="".join(
            f"Environment={_quoted(f'{key}={os.environ[key]}')}\n"
            for key in HANDED_ON
            if key in os.environ
        ),
        folder=_path(folder),
        command=words,
        stop_s=STOP_WITHIN_S,
        restart="" if timer else _RESTART,
        limits="" if timer else _LIMITS,
        install="" if timer else f"\n[Install]\nWantedBy={target}\n",
    )
    units = [Unit(f"{unit}.service", service)]
    if timer:
        units.append(Unit(f"{unit}.timer", _TIMER.format(name=name, every=CALL_EVERY_MIN)))
    return units


def _quoted(word: str) -> str:
    """Return a word of ExecStart: quoted, with `%` and `$` as themselves."""
    _require_plain(word)
    word = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    word = word.replace("$", "$$")
    return word if re.fullmatch(r"[\w@%+=:,./-]+", word) else f'"{word}"'


def _require_plain(text: str) -> None:
    if not text.isprintable():
        raise SpecError(
            f"{text!r} has characters that a systemd unit cannot have", hint="rename the folder"
        )


def _path(path: Path) -> str:
    """Return a path as a setting: unquoted, with `%` as itself."""
    _require_plain(str(path))
    return str(path).replace("%", "%%")


def write_units(units: list[Unit], folder: Path) -> list[Path]:
    """Write units into a folder, which is made when missing; return the files.

    Raises:
        RecordingError: They cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot make {folder}: {error.strerror or error}", hint="name another with --out"
        ) from error
    for unit in units:
        write_replacing(folder / unit.name, unit.text.encode())
    return [folder / unit.name for unit in units]


def next_words(units: list[Unit], folder: Path, *, user: bool) -> list[str]:
    """Return the commands that install and start the units."""
    flag, where = (" --user", "~/.config/systemd/user/") if user else ("", "/etc/systemd/system/")
    files = " ".join(shlex.quote(str(folder / unit.name)) for unit in units)
    commands = [
        f"systemd-analyze{flag} verify {files}",
        f"install -m 644 {files} {where}",
        f"systemctl{flag} daemon-reload",
        f"systemctl{flag} enable --now {units[-1].name}",
    ]
    return commands + (
        ["loginctl enable-linger  # it is to run while nobody is logged in"] if user else []
    )
