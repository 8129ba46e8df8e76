"""systemd units of a schedule: a permanent service, or a timer that starts a service."""

from __future__ import annotations

import os
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from hil.core import RecordingError, SpecError, user_name, write_replacing

CALL_EVERY_MIN = 5
"""Interval of the timer [min]; the schedule decides which occasions are due at each call."""

STOP_WITHIN_S = 120
"""Maximum time to stop a robot and close its recording [s]."""

HANDED_ON = ("HIL_LEASES", "HIL_STATION")
"""Names of environment variables that are copied into the service."""


@dataclass(frozen=True, slots=True)
class Unit:
    """systemd unit file.

    Attributes:
        name: File name of the unit.
        text: Content of the unit file.
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
# After a stop by signal, the robot is at standstill and the run can be resumed.
SuccessExitStatus=130
KillSignal=SIGTERM
KillMode=mixed
TimeoutStopSec={stop_s}
{restart}{install}"""

_RESTART = """Restart=on-failure
RestartSec=30
# An invalid file or a schedule that is not armed needs an operator: no restart.
RestartPreventExitStatus=2 3
"""

_LIMITS = """StartLimitIntervalSec=1h
StartLimitBurst=5
"""

_TIMER = """[Unit]
Description=hil schedule {name}: checks whether an occasion is due

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
    """Return the systemd units of a schedule.

    Args:
        name: Name of the schedule.
        arguments: Command-line arguments of `hil schedule run`, with absolute paths.
        folder: Working directory of the service.
        timer: Flag; true for a timer that starts the service, false for a permanent service.
        user: Flag; true for units of `systemctl --user`.

    Raises:
        SpecError: A path contains characters that are not allowed in a unit.
    """
    command = (sys.executable, "-P", "-m", "hil", "schedule", "run", *arguments)
    words = " ".join(_quoted(word) for word in (*command, *(("--once",) if timer else ())))
    target = "default.target" if user else "multi-user.target"
    unit = f"hil-{name}"
    service = _SERVICE.format(
        name=name,
        kind="oneshot" if timer else "exec",
        # Leases are per user: the schedule must run as the user who runs other experiments.
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
    """Return a word of the setting ExecStart, quoted, with `%` and `$` escaped."""
    _require_plain(word)
    word = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    word = word.replace("$", "$$")
    return word if re.fullmatch(r"[\w@%+=:,./-]+", word) else f'"{word}"'


def _require_plain(text: str) -> None:
    if not text.isprintable():
        raise SpecError(
            f"{text!r} has characters that are not allowed in a systemd unit",
            hint="rename the folder",
        )


def _path(path: Path) -> str:
    """Return a path as the value of a unit setting, unquoted, with `%` escaped."""
    _require_plain(str(path))
    return str(path).replace("%", "%%")


def write_units(units: list[Unit], folder: Path) -> list[Path]:
    """Write units into a folder and return their files.

    The folder is created if it does not exist.

    Raises:
        RecordingError: The unit files cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot create {folder}: {error.strerror or error}",
            hint="name another folder with --out",
        ) from error
    for unit in units:
        write_replacing(folder / unit.name, unit.text.encode())
    return [folder / unit.name for unit in units]


def next_words(units: list[Unit], folder: Path, *, user: bool) -> list[str]:
    """Return the shell commands that install and start the units."""
    flag, where = (" --user", "~/.config/systemd/user/") if user else ("", "/etc/systemd/system/")
    files = " ".join(shlex.quote(str(folder / unit.name)) for unit in units)
    commands = [
        f"systemd-analyze{flag} verify {files}",
        f"install -m 644 {files} {where}",
        f"systemctl{flag} daemon-reload",
        f"systemctl{flag} enable --now {units[-1].name}",
    ]
    return commands + (
        ["loginctl enable-linger  # keep it running while you are logged out"] if user else []
    )
