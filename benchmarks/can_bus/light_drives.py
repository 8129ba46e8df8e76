"""The drives of `drives.py`, as a participant of a bus that another process hosts.

Sends and takes many frames with one call, as our master does.
`python -m benchmarks.can_bus.light_drives CHANNEL [ordinary]`, until its input ends.
"""

from __future__ import annotations

import sys
import time

import can

from benchmarks.can_bus.drives import NODES, Drives
from benchmarks.can_bus.ending import forbid_priority, until_over
from hil.canbus.frame import FRAME, Frame, pack_frame
from hil_drivers.cia402.bursts import receiving, sending
from hil_drivers.cia402.mapping import POSITION, tpdo_cob_id
from hil_drivers.cia402.ports import FramePort, port_of
from hil_drivers.cia402.realtime import realtime

_HEAD_BYTES = 8


class Answering:
    """The drives, behind a port.

    Args:
        port: To the bus.
    """

    def __init__(self, port: FramePort) -> None:
        self._port, self._take = port, receiving(port)
        heads = [
            (tpdo_cob_id(pdo.number, node), pdo.length) for node in NODES for pdo in POSITION.tpdos
        ]
        self._answers = {head[0]: bytearray(pack_frame(head[0], bytes(head[1]))) for head in heads}
        self._last = heads[-1][0]
        self._send_all = sending(port, list(self._answers.values()))
        self._drives = Drives(self._send)

    def serve(self, within_s: float) -> None:
        """Take what comes within that time."""
        if self._port.wait(time.monotonic() + within_s):
            for raw in self._take():
                can_id, length, data = FRAME.unpack(raw)
                self._drives.heard(Frame(can_id, data[:length]))

    def _send(self, can_id: int, data: bytes) -> None:
        answer = self._answers.get(can_id)
        if answer is None:
            self._port.send(pack_frame(can_id, data))
            return
        answer[_HEAD_BYTES : _HEAD_BYTES + len(data)] = data
        if can_id == self._last:
            self._send_all()


def main(channel: str, *how: str) -> None:
    """Answer."""
    if "ordinary" in how:
        forbid_priority()
    with can.Bus(interface="hil_unix", channel=channel) as bus, realtime():
        until_over(Answering(port_of(bus)).serve)


if __name__ == "__main__":
    main(*sys.argv[1:])
