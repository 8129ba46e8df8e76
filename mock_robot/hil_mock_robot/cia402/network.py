"""What `canopen`'s local node takes for its network: frames by callback, no thread, no bus."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Never

from canopen.network import Network

from hil_mock_robot.cia402.contracts import Send

Heard = Callable[[int, Any, float], None]


class DeviceNetwork(Network):
    """One node's view of the bus; the owner says what is on it, and takes what is sent.

    Args:
        send: Puts a frame on the bus.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._listeners: dict[int, list[Heard]] = {}
        super().__init__()

    def subscribe(self, can_id: int, callback: Heard) -> None:
        """Call this with every frame of that identifier."""
        self._listeners.setdefault(can_id, []).append(callback)

    def unsubscribe(self, can_id: int, callback: Heard | None = None) -> None:
        """Call it no longer; nobody, where none is named."""
        if callback is None:
            self._listeners.pop(can_id, None)
        elif callback in self._listeners.get(can_id, []):
            self._listeners[can_id].remove(callback)

    def send_message(self, can_id: int, data: Iterable[int], remote: bool = False) -> None:
        """Put a frame on the bus at once."""
        self._send(can_id, bytes(data))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Never:
        """Never: heartbeats and event timers go by the device's clock."""
        raise NotImplementedError("the mock node sends nothing by a timer of its own")

    def heard(self, can_id: int, data: bytes) -> None:
        """A frame is on the bus."""
        for callback in self._listeners.get(can_id, ()):
            callback(can_id, data, 0.0)
