"""Six drives that cost next to nothing: they answer SYNC with what they were told last.

As a process it hosts the bus: `python -m benchmarks.can_bus.drives CHANNEL`, until its input ends.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from benchmarks.can_bus.ending import until_over
from hil.can.frames import Frame
from hil.can.hub import Hub
from hil_drivers.cia402.can_channel import HEARTBEAT_COB_ID, SYNC_COB_ID, rpdo_cob_id, tpdo_cob_id
from hil_drivers.cia402.mapping import POSITION
from hil_drivers.cia402.objects import CSP
from hil_drivers.cia402.timing import realtime

NODES = (1, 2, 3, 4, 5, 6)
BEAT_S = 0.1
OPERATIONAL = b"\x05"
STATUSWORDS = {0x06: 0x0231, 0x07: 0x0233, 0x0F: 0x1237}
"""Controlword → ready to switch on, switched on, operation enabled; else switch on disabled."""
DISABLED = 0x0250

_COMMAND = POSITION.rpdos[0].packing
_STATE, _MEASURED = (pdo.packing for pdo in POSITION.tpdos)


class Drives:
    """All axes; positions are the targets of the last cycle.

    Args:
        send: Puts a frame on the bus: COB-ID, data.
    """

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        self._send = send
        self._axis = {rpdo_cob_id(1, node): axis for axis, node in enumerate(NODES)}
        self._commands = [_COMMAND.pack(0, CSP, 0)] * len(NODES)
        self._answers = [(tpdo_cob_id(1, node), tpdo_cob_id(2, node)) for node in NODES]
        self._beat_at = 0.0

    def heard(self, frame: Frame) -> None:
        """Take a frame; a SYNC is answered before it returns."""
        axis = self._axis.get(frame.id)
        if axis is not None:
            self._commands[axis] = frame.data
        elif frame.id == SYNC_COB_ID:
            self._answer()

    def _answer(self) -> None:
        for (state_id, measured_id), command in zip(self._answers, self._commands, strict=True):
            controlword, mode, target = _COMMAND.unpack(command)
            statusword = STATUSWORDS.get(controlword, DISABLED)
            self._send(state_id, _STATE.pack(statusword, target, mode))
            self._send(measured_id, _MEASURED.pack(0, 100, 200))
        if (now := time.monotonic()) >= self._beat_at:
            self._beat_at = now + BEAT_S
            for node in NODES:
                self._send(HEARTBEAT_COB_ID + node, OPERATIONAL)


def main(channel: str) -> None:
    """Host the bus and the drives on it."""
    with Hub(channel) as hub, realtime():
        hub.local.heard = Drives(hub.local.send).heard
        until_over(hub.serve)


if __name__ == "__main__":
    main(sys.argv[1])
