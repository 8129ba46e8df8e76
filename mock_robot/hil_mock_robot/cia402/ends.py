"""The drives' end of the bus: a bus that the mock hosts, or one of python-can that is there."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from hil.can import ERROR, EXTENDED, REMOTE, Frame, Hub, runtime_folder, socket_path

Heard = Callable[[int, bytes, float], None]
"""COB-ID, data, wall time (monotonic)."""

FLAGS = EXTENDED | REMOTE | ERROR
HOSTED = "hil_unix"


class Readable(Protocol):
    """Something `select` can wait for."""

    def fileno(self) -> int:
        """Of a socket."""


class BusEnd(Protocol):
    """Where frames come from and go to; one thread."""

    where: str
    heard: Heard

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus."""

    def flush(self) -> None:
        """See that all which was sent goes now: what follows takes long."""

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """Hear what has come; waits so long for it, or until one of `others` has something.

        Returns whether one of them has.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def bus_off(self) -> None:
        """Put everybody else who is there now off the bus."""

    def recover(self) -> None:
        """Let them back."""

    def close(self) -> None:
        """Leave."""


def ignored(can_id: int, data: bytes, now_s: float) -> None:
    """Nobody listens yet."""


class HubEnd:
    """A bus between processes, hosted by the mock.

    Args:
        channel: See `hil.can.paths.socket_path`.
        bitrate: Of the wire, where it is modelled [bit/s].
        speed: Seconds of that wire in one second of the clock.

    Attributes:
        where: The channel, for messages.
        heard: Called with every frame.
        hub: The bus.

    Raises:
        PluginError: The channel is taken, or cannot be made.
    """

    def __init__(self, channel: str, bitrate: float | None = None, speed: float = 1.0) -> None:
        self.hub = Hub(channel, bitrate=bitrate, speed=speed)
        self.where = f"{HOSTED} channel {channel}"
        self.heard: Heard = ignored
        self.send, self.flush = self.hub.local.send, self.hub.flush
        self.hub.local.heard = self._came

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """See `BusEnd`."""
        due_s = self.hub.due_s
        if due_s is not None:
            timeout_s = min(timeout_s, due_s - time.monotonic())
        ready, _, _ = select.select([self.hub, *others], [], [], max(0.0, timeout_s))
        self.hub.serve()
        return any(each is not self.hub for each in ready)

    def bus_off(self) -> None:
        """See `BusEnd`."""
        self.hub.bus_off()

    def recover(self) -> None:
        """See `BusEnd`."""
        self.hub.recover()

    def close(self) -> None:
        """See `BusEnd`."""
        self.hub.close()

    def _came(self, frame: Frame) -> None:
        if not frame.id & FLAGS:
            self.heard(frame.id, frame.data, time.monotonic())


def side_path(interface: str, channel: str) -> str:
    """Where the side channel of such a mock is: beside the socket of its bus.

    Args:
        interface: As of `end_of`.
        channel: Of the bus.
    """
    if interface == HOSTED:
        return os.fspath(socket_path(channel).with_suffix(".side"))
    return os.fspath(runtime_folder() / f"{interface}-{channel}.side")
