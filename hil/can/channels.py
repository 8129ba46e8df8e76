"""CAN channels of this computer: sockets of buses between processes, interfaces of the kernel.

A bus between processes lives at a socket in a folder of this user alone (`socket_path`,
`private_folder`). Interfaces of the kernel, as most adapters are, are read from what it tells
everybody: no rights are needed, and nothing is opened or sent.
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
"""Bytes of a path that the kernel takes for a socket."""


def socket_path(channel: str | os.PathLike[str]) -> Path:
    """The socket of a channel; nothing is made or looked at.

    Args:
        channel: A name such as `can0`, or the absolute path of the socket.

    Raises:
        PluginError: It is neither, or the path is longer than the kernel takes.
    """
    told = os.fspath(channel)
    if os.path.isabs(told):
        path = Path(told)
    elif _NAME.fullmatch(told):
        path = runtime_folder() / f"{told}.sock"
    else:
        raise PluginError(
            f"{told!r} is no channel of a bus between processes",
            hint="name it with letters, digits, '.', '_' and '-', as in can0, or give the "
            "absolute path of its socket",
        )
    if len(os.fsencode(path)) > _LONGEST:
        raise PluginError(
            f"channel {path}: the path of a socket has {_LONGEST} bytes at most",
            hint="choose a folder with a shorter path",
        )
    return path


def runtime_folder() -> Path:
    """The folder of all named channels of this user: `$XDG_RUNTIME_DIR`, else the temporary one."""
    above = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(above) / f"hil-can-{os.getuid()}"


def named_channels() -> list[str]:
    """Names of the channels in the runtime folder, whether or not they are hosted now."""
    return sorted(path.stem for path in runtime_folder().glob("*.sock"))


_HINT = "set XDG_RUNTIME_DIR to a folder of yours, or give the absolute path of a socket"


def private_folder(path: Path) -> None:
    """See that a socket lies where no other user can replace it; the runtime folder is made.

    Args:
        path: Of the socket.

    Raises:
        PluginError: The folder is missing, no folder, or another user's.
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
        raise PluginError(f"the folder of channel {path} is none", hint=_HINT)
    if folder == runtime_folder():
        _refuse_foreign(folder, found)


def _refuse_foreign(folder: Path, found: os.stat_result) -> None:
    if found.st_uid != os.getuid():
        raise PluginError(f"{folder} belongs to another user (uid {found.st_uid})", hint=_HINT)
    if stat.S_IMODE(found.st_mode) & 0o077:
        raise PluginError(
            f"other users can get into {folder}", hint=f"close it first: chmod 700 {folder}"
        )


NETWORK = Path("/sys/class/net")
"""Where the kernel lists its interfaces."""

IFF_UP = 0x1

ARPHRD_CAN = 280
"""What the kernel calls a CAN interface in `type`."""


def can_interfaces(network: Path = NETWORK) -> list[str]:
    """Names of all CAN interfaces, up or down."""
    return [p.name for p in sorted(network.glob("*")) if _number(p / "type", 10) == ARPHRD_CAN]


def _number(file: Path, base: int) -> int | None:
    try:
        return int(file.read_text("utf-8"), base)
    except (OSError, ValueError):
        return None


def is_up(name: str, network: Path = NETWORK) -> bool | None:
    """Whether an interface is switched on; None where there is none of that name.

    An adapter that is pulled while this looks is not there.
    """
    flags = _number(network / name / "flags", 16)
    return None if flags is None else bool(flags & IFF_UP)


def up_command(name: str, bitrate: int) -> str:
    """What switches an interface on.

    Args:
        name: Of the interface.
        bitrate: Bits per second of classic CAN [bit/s].
    """
    return f"sudo ip link set {name} up type can bitrate {bitrate}"
