"""Drives that share one end of the bus hear each other, as nodes on a wire do."""

from __future__ import annotations

from collections import deque

from hil_mock_robot.cia402.contracts import Send
from hil_mock_robot.cia402.routes import PROCESS_DATA, Routes

HEARTBEATS = range(0x701, 0x780)


class Siblings:
    """Keeps what drives send until the others can hear it: when all have done with the last frame.

    Args:
        put: Puts a frame on the bus, for everybody else.
    """

    def __init__(self, put: Send) -> None:
        self._put = put
        self._said: deque[tuple[int, int, bytes]] = deque()

    def voice(self, number: int) -> Send:
        """By which the drive of that number (from 0) sends."""

        def say(can_id: int, data: bytes) -> None:
            self._put(can_id, data)
            if can_id in PROCESS_DATA or can_id in HEARTBEATS:
                self._said.append((number, can_id, data))

        return say

    def listen(self, routes: Routes) -> None:
        """Let the others hear what was said: PDOs that are linked, heartbeats that are watched."""
        while self._said:
            number, can_id, data = self._said.popleft()
            for unit in routes.to(can_id):
                if unit.number != number and unit.line.passes(can_id, data):
                    unit.node.heard(can_id, data)
