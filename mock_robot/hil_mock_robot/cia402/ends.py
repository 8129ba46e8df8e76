"""The drives' end of the bus: a bus that the mock hosts, or one of python-can that is there."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import can

from hil.canbus.frame import ERROR, ERROR_BUS_OFF, EXTENDED, REMOTE, Frame
from hil.canbus.hub import Hub
from hil.errors import PluginError, RobotConnectionError

Heard = Callable[[int, bytes, float], None]
"""COB-ID, data, wall time (monotonic)."""

FLAGS = EXTENDED | REMOTE | ERROR
HOSTED = "hil_unix"
BURST = 64
"""Frames taken at once before the others have their turn."""


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
        channel: See `hil.canbus.paths.socket_path`.
        bitrate: Of the wire, where it is modelled [bit/s].

    Attributes:
        where: The channel, for messages.
        heard: Called with every frame.
        hub: The bus.

    Raises:
        PluginError: The channel is taken, or cannot be made.
    """

    def __init__(self, channel: str, bitrate: float | None = None) -> None:
        self.hub = Hub(channel, bitrate=bitrate)
        self.where = f"{HOSTED} channel {channel}"
        self.heard: Heard = ignored
        self.send = self.hub.local.send
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


class PythonCanEnd:
    """Any bus of python-can.

    Args:
        bus: The bus.
        where: For messages.

    Attributes:
        where, heard: See `BusEnd`.
        lost: Frames the bus would not take.
    """

    def __init__(self, bus: can.BusABC, where: str) -> None:
        self._bus, self.where = bus, where
        self.heard: Heard = ignored
        self._off = False
        self.lost = 0

    def send(self, can_id: int, data: bytes) -> None:
        """See `BusEnd`; what the bus does not take is lost, as on a wire nobody listens to."""
        if self._off:
            return
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except can.CanError as error:
            self.lost += 1
            if self.lost == 1:
                print(f"{self.where}: frame lost: {error}", file=sys.stderr)  # noqa: T201

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """See `BusEnd`; it does not wait for `others`."""
        try:
            for _ in range(BURST):
                message = self._bus.recv(max(0.0, timeout_s))
                if message is None:
                    break
                self._came(message)
                timeout_s = 0.0
        except can.CanError as error:
            raise RobotConnectionError(
                f"{self.where} is gone: {error}", hint="is the interface still up?"
            ) from error
        return False

    def bus_off(self) -> None:
        """See `BusEnd`: an error frame, then silence both ways."""
        with contextlib.suppress(can.CanError):
            self._bus.send(can.Message(arbitration_id=ERROR_BUS_OFF, is_error_frame=True, dlc=8))
        self._off = True

    def recover(self) -> None:
        """See `BusEnd`."""
        self._off = False

    def close(self) -> None:
        """See `BusEnd`."""
        self._bus.shutdown()

    def _came(self, message: can.Message) -> None:
        data_frame = not (message.is_extended_id or message.is_remote_frame)
        if data_frame and not message.is_error_frame and not self._off:
            self.heard(message.arbitration_id, bytes(message.data), time.monotonic())


def end_of(interface: str, channel: str, bitrate: float | None = None) -> BusEnd:
    """The drives' end of a bus.

    Args:
        interface: `hil_unix`, or an interface of python-can.
        channel: Its channel.
        bitrate: Of the bus; on `hil_unix`, what the modelled wire has.

    Raises:
        PluginError: There is no such bus here.
    """
    if interface == HOSTED:
        return HubEnd(channel, bitrate)
    more: dict[str, Any] = {} if bitrate is None else {"bitrate": round(bitrate)}
    where = f"{interface} channel {channel}"
    try:
        return PythonCanEnd(can.Bus(channel=channel, interface=interface, **more), where)
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise PluginError(
            f"{where} cannot be opened: {error}",
            hint=f"is the interface up? {HOSTED} needs no hardware and no kernel module",
        ) from error


def side_path(interface: str, channel: str) -> str:
    """Where the side channel of such a mock is: beside the socket of its bus.

    Args:
        interface: As of `end_of`.
        channel: Of the bus.
    """
    from hil.canbus.paths import runtime_folder, socket_path

    if interface == HOSTED:
        return os.fspath(socket_path(channel).with_suffix(".side"))
    return os.fspath(runtime_folder() / f"{interface}-{channel}.side")
