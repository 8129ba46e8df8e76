"""Ways to a CAN bus for the cyclic core: raw 16-byte frames in and out (`hil.canbus.frame`)."""

from __future__ import annotations

from typing import Any, Protocol


class FramePort(Protocol):
    """One end of a bus."""

    def send(self, frame: bytes | memoryview) -> bool:
        """Put a frame on the bus; False when there is no room for it.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def receive(self, until_s: float) -> bytes | None:
        """The next frame; None when there is none until that `time.monotonic` (0: right now).

        Raises:
            RobotConnectionError: The bus is gone.
        """


def port_of(bus: Any) -> FramePort:
    """The port of a `python-can` bus: its own socket where it has one that carries raw frames."""
    raise NotImplementedError
