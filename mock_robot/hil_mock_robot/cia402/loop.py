"""The loop of the mock drives: frames are served between the drives' steps."""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable

from hil_mock_robot.cia402.bus import BusEnd
from hil_mock_robot.cia402.contracts import STEP_S
from hil_mock_robot.cia402.journal import Witness
from hil_mock_robot.cia402.station import Station
from hil_mock_robot.server import loop
from hil_mock_robot.server.loop import Mishaps
from hil_mock_robot.server.side_channel import SideChannel

OWN_STEPS = 10
"""Steps that the drives' own timer makes at once."""

SIDE_S = 0.01
"""Wall time between two looks at the side channel while the bus is busy."""

SLEPT_S = 0.05
"""A turn that comes so much later: the computer had other things to do, for the master too."""


class Loop(loop.Loop):
    """Serves the bus and lets the drives' time pass.

    Args:
        end: Of the bus.
        station: The drives.
        side: The side channel, for those who want one.
        witness: Writes down what happens.

    Attributes:
        mishaps: Mistakes of the mock itself.
    """

    def __init__(
        self,
        end: BusEnd,
        station: Station,
        side: SideChannel | None = None,
        witness: Witness | None = None,
    ) -> None:
        super().__init__()
        self._end, self._station = end, station
        self._side, self._witness = side, witness
        self.mishaps = Mishaps()
        if witness is not None:
            self.mishaps.listeners.append(witness.stumbled)
        self._asked: deque[Callable[[], None]] = deque()
        self._side_due_s = 0.0
        self._turned_s = time.monotonic()
        self._beside_bus: list[socket.socket] = [self.woken]
        end.heard = self._heard

    def run(self) -> None:
        """Power on, and serve until `end`."""
        self._station.boot()
        super().run()

    def ask(self, action: Callable[[], None]) -> None:
        """Do something between two turns; for other threads."""
        self._asked.append(action)
        self.wake()

    def leave(self) -> None:
        """Leave the bus."""
        if self._side is not None:
            self._side.close()
        self._end.close()
        if self._witness is not None:
            self._witness.close(syncs=self._station.clock.syncs)

    def turn(self) -> None:
        """Hear what has come; let the drives' own timer go on where there is no SYNC."""
        clock = self._station.clock
        wait_s = min(clock.wait_s(time.monotonic(), OWN_STEPS), SIDE_S)
        asked = self._end.serve(wait_s, self._beside_bus)
        now_s = time.monotonic()
        if now_s - self._turned_s > SLEPT_S:
            clock.slept(now_s - self._turned_s)
        self._turned_s = now_s
        if clock.wait_s(now_s, OWN_STEPS) <= STEP_S / 10:
            self._end.serve(0.0)  # a SYNC that had come by then counts
            self._lapse(now_s)
        if asked or self._asked or now_s >= self._side_due_s:
            self._side_due_s = now_s + SIDE_S
            self._beside()

    def _heard(self, can_id: int, data: bytes, now_s: float) -> None:
        try:
            self._station.heard(can_id, data, now_s)
        except Exception as error:
            self.mishaps.met(error, f"frame {can_id:03X}#{data.hex()}")

    def _lapse(self, now_s: float) -> None:
        try:
            self._station.lapsed(now_s)
        except Exception as error:
            self.mishaps.met(error, "the drives' own timer")

    def _beside(self) -> None:
        self.woke()
        while self._asked:
            self._asked.popleft()()
        if self._side is not None:
            self._side.serve()
            self._beside_bus = [self.woken, *self._side.sockets]
