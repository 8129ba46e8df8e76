"""CAN channels of this computer: sockets of buses between processes, and kernel interfaces.

A bus between processes has a socket in a folder that only this user can access (`socket_path`,
`private_folder`). Kernel interfaces, such as most CAN adapters, are listed in `/sys`. Reading
`/sys` needs no privileges, and no interface is opened.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from pathlib import Path

from hil.core import PluginError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")

_LONGEST = 107
"""Longest path of a socket that the kernel accepts [bytes]."""


def socket_path(channel: str | os.PathLike[str]) -> Path:
    """Return the path of a channel's socket, without creating or checking the file.

    Args:
        channel: Name of the channel such as `can0`, or absolute path of its socket.

    Raises:
        PluginError: The channel is neither a name nor an absolute path, or the path is too long for
            the kernel.
    """
    text = os.fspath(channel)
    if os.path.isabs(text):
        path = Path(text)
    elif _NAME.fullmatch(text):
        path = runtime_folder() / f"{text}.sock"
    else:
        raise PluginError(
            f"{text!r} is not a valid channel of a bus between processes",
            hint="use a name of letters, digits, '.', '_' and '-', as in can0, or the absolute "
            "path of the socket",
        )
    if len(os.fsencode(path)) > _LONGEST:
        raise PluginError(
            f"channel {path}: the path of a socket has {_LONGEST} bytes at most",
            hint="choose a folder with a shorter path",
        )
    return path


def runtime_folder() -> Path:
    """Return the folder of this user's named channels.

    The folder is in `$XDG_RUNTIME_DIR`, or in the temporary folder if this variable is not set.
    """
    above = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(above) / f"hil-can-{os.getuid()}"


def named_channels() -> list[str]:
    """Return the names of all channels in the runtime folder, with or without a running host."""
    return sorted(path.stem for path in runtime_folder().glob("*.sock"))


_HINT = "set XDG_RUNTIME_DIR to a folder that you own, or use the absolute path of a socket"


def private_folder(path: Path) -> None:
    """Raise unless a socket is in a folder to which no other user has access.

    The runtime folder is created if necessary.

    Args:
        path: Path of the socket.

    Raises:
        PluginError: The folder is missing, is not a folder, or is accessible to another user.
    """
    folder = path.parent
    try:
        if folder == runtime_folder():
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat() if folder == runtime_folder() else folder.stat()
    except OSError as error:
        raise PluginError(
            f"the folder of channel {path} cannot be used: {error.strerror}", hint=_HINT
        ) from error
    if not stat.S_ISDIR(found.st_mode):
        raise PluginError(f"the folder of channel {path} is not a folder", hint=_HINT)
    if folder == runtime_folder():
        _refuse_foreign(folder, found)


def _refuse_foreign(folder: Path, found: os.stat_result) -> None:
    if found.st_uid != os.getuid():
        raise PluginError(f"{folder} belongs to another user (uid {found.st_uid})", hint=_HINT)
    if stat.S_IMODE(found.st_mode) & 0o077:
        raise PluginError(
            f"other users have access to {folder}", hint=f"restrict it first: chmod 700 {folder}"
        )


NETWORK = Path("/sys/class/net")
"""Folder in which the kernel lists its network interfaces."""

IFF_UP = 0x1

ARPHRD_CAN = 280
"""Number with which the kernel's file `type` marks a CAN interface."""


def can_interfaces(network: Path = NETWORK) -> list[str]:
    """Return the names of all CAN interfaces of the kernel, up or down."""
    return [p.name for p in sorted(network.glob("*")) if _number(p / "type", 10) == ARPHRD_CAN]


def _number(file: Path, base: int) -> int | None:
    try:
        return int(file.read_text("utf-8"), base)
    except (OSError, ValueError):
        return None


def is_up(name: str, network: Path = NETWORK) -> bool | None:
    """Return whether an interface is up; None if there is no interface of that name.

    An adapter that is disconnected during the check counts as missing.
    """
    flags = _number(network / name / "flags", 16)
    return None if flags is None else bool(flags & IFF_UP)


def up_command(name: str, bitrate: int) -> str:
    """Return the shell command that switches a CAN interface on.

    Args:
        name: Name of the interface.
        bitrate: Bit rate of classic CAN [bit/s].
    """
    return f"sudo ip link set {name} up type can bitrate {bitrate}"
