"""The drives' end of the bus: a bus that the mock hosts, or one of python-can that is there."""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from hil.can import ERROR, EXTENDED, REMOTE, Frame, Hub
from hil.core import SpecError

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


def end_of(
    interface: str, channel: str, bitrate: float | None = None, wire_speed: float | None = None
) -> BusEnd:
    """The drives' end of a bus.

    Args:
        interface: `hil_unix`, or an interface of python-can.
        channel: Its channel.
        bitrate: Of the bus; on `hil_unix`, what the modelled wire has.
        wire_speed: Seconds of the modelled wire in one second; 1 when None.

    Raises:
        PluginError: There is no such bus here.
        SpecError: There is no wire that could be so fast or slow.
    """
    _require_wire(interface, bitrate, wire_speed)
    if interface == HOSTED:
        return HubEnd(channel, bitrate, wire_speed or 1.0)
    from hil_mock_robot.cia402.python_can_end import open_end

    return open_end(interface, channel, bitrate)


def _require_wire(interface: str, bitrate: float | None, speed: float | None) -> None:
    if bitrate is not None and not 0 < bitrate < math.inf:
        raise SpecError(f"--bitrate is {bitrate:g}", hint="give bits per second, such as 1000000")
    if speed is None:
        return
    if interface != HOSTED or bitrate is None:
        raise SpecError(
            f"--wire-speed {speed:g}: no wire is modelled on {interface}"
            + ("" if bitrate is None else ", it has its own"),
            hint=f"give --bitrate as well, on {HOSTED}",
        )
    if not 0 < speed < math.inf:
        raise SpecError(f"--wire-speed is {speed:g}", hint="give what the master has as its pace")


def side_path(interface: str, channel: str) -> str:
    """Where the side channel of such a mock is: beside the socket of its bus.

    Args:
        interface: As of `end_of`.
        channel: Of the bus.
    """
    from hil.can import runtime_folder, socket_path

    if interface == HOSTED:
        return os.fspath(socket_path(channel).with_suffix(".side"))
    return os.fspath(runtime_folder() / f"{interface}-{channel}.side")
