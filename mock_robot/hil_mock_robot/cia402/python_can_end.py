"""The drives' end of a bus of python-can that is there already."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from typing import Any

import can

from hil.can import ERROR_BUS_OFF
from hil.core import PluginError, RobotConnectionError
from hil_mock_robot.cia402.ends import Heard, Readable, ignored

BURST = 64
"""Frames taken at once before the others have their turn."""


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

    def flush(self) -> None:
        """See `BusEnd`; nothing is kept here."""

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


def open_end(interface: str, channel: str, bitrate: float | None) -> PythonCanEnd:
    """Join a bus.

    Raises:
        PluginError: There is no such bus here.
    """
    more: dict[str, Any] = {} if bitrate is None else {"bitrate": round(bitrate)}
    where = f"{interface} channel {channel}"
    try:
        return PythonCanEnd(can.Bus(channel=channel, interface=interface, **more), where)
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise PluginError(
            f"{where} cannot be opened: {error}",
            hint="is the interface up? hil_unix needs no hardware and no kernel module",
        ) from error
