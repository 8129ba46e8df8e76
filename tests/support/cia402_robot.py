"""Robots on mock drives for tests, and somebody who listens on their bus."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from typing import Any

import can

from hil_drivers.cia402.can_channel import rpdo_cob_id
from hil_drivers.cia402.mapping import POSITION
from tests.support.mock_servers import MockCan

LAST_NODE = 6
SLOWER = 100
"""Increments by which two steps of a motion that does not brake differ at most."""


def options(mock: MockCan, **more: Any) -> dict[str, Any]:
    """Of the driver, for a mock."""
    bus = {"interface": "hil_unix", "channel": mock.channel}
    mocks = {"payload_object": 0x2100, "temperature_object": 0x2110, "late_cycles": 50}
    return {"bus": bus} | mocks | more


class BusEar:
    """Notes when set-points of the last axis begin to slow down: what a stop is on the wire."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus, self._over = bus, threading.Event()
        self._slowing: deque[float] = deque(maxlen=1000)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def first_after(self, asked: float) -> float | None:
        """When set-points first became slower after that `time.monotonic`."""
        return next((at for at in list(self._slowing) if at >= asked), None)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._bus.shutdown()

    def _listen(self) -> None:
        wanted, pdo = rpdo_cob_id(1, LAST_NODE), POSITION.rpdos[0]
        last, step = 0, 0
        with contextlib.suppress(can.CanError):
            while not self._over.is_set():
                message = self._bus.recv(0.05)
                if message is None or message.arbitration_id != wanted:
                    continue
                target = pdo.packing.unpack(bytes(message.data))[-1]
                before, step, last = step, abs(target - last), target
                if step < before - SLOWER:
                    self._slowing.append(time.monotonic())
