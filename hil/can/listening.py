"""The socket at which a hub hears of participants, held by one hub at a time.

A lock beside it says who hosts the channel; the socket that a dead hub has left is replaced.
"""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

from hil.can.paths import private_folder
from hil.core import HeldFile, PluginError, hold, this_process

_BACKLOG = 16


class Listener:
    """Holds a channel and listens at it.

    Args:
        path: Of the socket; see `hil.can.paths.socket_path`.

    Attributes:
        path: The same.
        socket: Non-blocking.

    Raises:
        PluginError: Somebody else hosts the channel, or the socket cannot be made.
    """

    def __init__(self, path: Path) -> None:
        private_folder(path)
        self.path = path
        self._held = _held(path)
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            _clear(path)
            self.socket.bind(str(path))
            path.chmod(0o600)  # before it listens: nobody else gets in between
            self.socket.listen(_BACKLOG)
        except OSError as error:
            self.close()
            raise _unusable(path, error) from error
        except BaseException:
            self.close()
            raise
        self.socket.setblocking(False)

    def close(self) -> None:
        """Let go of the channel. Idempotent."""
        if self.socket.fileno() >= 0:
            self.socket.close()
            with contextlib.suppress(OSError):
                if self.path.is_socket():
                    self.path.unlink()
        self._held.release()


def _held(path: Path) -> HeldFile:
    lock = path.with_name(path.name + ".lock")
    try:
        held = hold(lock, {**this_process(), "channel": str(path)})
    except OSError as error:
        raise _unusable(path, error) from error
    if isinstance(held, HeldFile):
        return held
    raise PluginError(
        f"channel {path} is taken: {held} hosts it",
        hint="connect to that bus, end its host, or choose another channel",
    )


def _clear(path: Path) -> None:
    """Remove the socket of a hub that died; whoever holds the lock knows that it is dead."""
    if path.is_socket():
        path.unlink()
    elif os.path.lexists(path):
        raise PluginError(
            f"channel {path}: there is something that is no socket",
            hint="choose another channel, or move that away",
        )


def _unusable(path: Path, error: OSError) -> PluginError:
    return PluginError(
        f"channel {path} cannot be hosted: {error.strerror or error}",
        hint="choose a folder that you may write to",
    )
