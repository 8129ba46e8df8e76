"""Is the connection that `ur-rtde` opened still there, or has it connected again by itself?

It says nothing of that: while it connects again its set-points are lost with every answer `True`,
and the stop of its program may be overwritten by the next set-point before the program sees it.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Iterator
from typing import TypeAlias

RTDE_PORT = 30004
OPEN_FILES = "/proc/self/fd", "/dev/fd"

Socket: TypeAlias = tuple[int, int, int]
"""Descriptor, device, inode: a number may be given away again, all three together are not."""


class OwnLine:
    """The RTDE connections of this process that somebody opens while `opened` is entered."""

    def __init__(self) -> None:
        self._mine: frozenset[Socket] = frozenset()

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """What is inside opens them."""
        before = _connections()
        yield
        self._mine = _connections() - before

    @property
    def kept(self) -> bool:
        """Whether all of them are still open, the very same ones; costs a microsecond."""
        return all(_is_open(each) for each in self._mine)


def _is_open(each: Socket) -> bool:
    try:
        now = os.fstat(each[0])
    except OSError:
        return False
    return (now.st_dev, now.st_ino) == each[1:]


def _connections() -> frozenset[Socket]:
    folder = next(filter(os.path.isdir, OPEN_FILES), None)
    numbers = [int(name) for name in os.listdir(folder)] if folder else []
    return frozenset(filter(None, map(_rtde, numbers)))


def _rtde(number: int) -> Socket | None:
    """The socket behind a descriptor, if it leads to an RTDE server."""
    with contextlib.suppress(OSError):
        about = os.fstat(number)
        if stat.S_ISSOCK(about.st_mode):
            with socket.socket(fileno=os.dup(number)) as line:
                peer = line.getpeername()
            if isinstance(peer, tuple) and peer[1] == RTDE_PORT:
                return number, about.st_dev, about.st_ino
    return None
