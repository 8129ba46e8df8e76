"""`canopen`'s network without a bus and a thread of its own: frames come and go through others."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from canopen import Network

Send = Callable[[int, bytes], None]


class FedNetwork(Network):
    """What it sends goes to `send`; what is on the bus, its owner tells it by `notify`.

    Args:
        send: Puts a frame (COB-ID, data) on the bus; called by any thread.
    """

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: Iterable[int], remote: bool = False) -> None:
        """Put a frame on the bus."""
        self._send(can_id, bytes(data))

    def send_periodic(self, *_: Any, **__: Any) -> Any:
        """Never: what is sent in time with the cycles is sent by the cyclic core."""
        raise NotImplementedError("periodic frames belong to the cyclic core")
