"""The drives of `drives.py` in as few steps as may be, on a bus that another process hosts.

Sends and takes many frames with one call and knows them by their heads, as our master does.
`python -m benchmarks.can_bus.light_drives CHANNEL [ordinary]`, until its input ends.
"""

from __future__ import annotations

import struct
import sys
import time

import can

from benchmarks.can_bus.drives import BEAT_S, DISABLED, NODES, OPERATIONAL, STATUSWORDS
from benchmarks.can_bus.ending import forbid_priority, until_over
from hil.can.frames import FRAME, pack_frame
from hil_drivers.cia402.can_channel import (
    HEARTBEAT_COB_ID,
    SYNC_COB_ID,
    FramePort,
    port_of,
    receiving,
    rpdo_cob_id,
    sending,
    tpdo_cob_id,
)
from hil_drivers.cia402.mapping import POSITION, Pdo
from hil_drivers.cia402.objects import CSP
from hil_drivers.cia402.timing import realtime

_HEAD_BYTES = 5


def _behind_head(pdo: Pdo) -> struct.Struct:
    return struct.Struct("<8x" + pdo.packing.format.lstrip("<"))


_COMMAND = _behind_head(POSITION.rpdos[0])
_STATE, _MEASURED = (pdo.packing for pdo in POSITION.tpdos)


class Drives:
    """All axes; positions are the targets of the last cycle.

    Args:
        port: To the bus.
    """

    def __init__(self, port: FramePort) -> None:
        self._port, self._take = port, receiving(port)
        sync, told = pack_frame(SYNC_COB_ID, b""), bytes(POSITION.rpdos[0].length)
        self._sync = sync[:_HEAD_BYTES]
        self._axis = {
            pack_frame(rpdo_cob_id(1, node), told)[:_HEAD_BYTES]: axis
            for axis, node in enumerate(NODES)
        }
        first = pack_frame(0, _COMMAND.pack(0, CSP, 0)[8:])
        self._commands = [first] * len(NODES)
        self._memory = bytearray().join(
            pack_frame(tpdo_cob_id(pdo.number, node), bytes(pdo.length))
            for node in NODES
            for pdo in POSITION.tpdos
        )
        whole = memoryview(self._memory)
        frames = [whole[at : at + FRAME.size] for at in range(0, len(whole), FRAME.size)]
        for measured in frames[1::2]:
            _MEASURED.pack_into(measured, 8, 0, 100, 200)
        self._send_all, self._beat_at = sending(port, frames), 0.0

    def serve(self, within_s: float) -> None:
        """Take what comes within that time; a SYNC is answered at once."""
        if not self._port.wait(time.monotonic() + within_s):
            return
        for raw in self._take():
            head = raw[:_HEAD_BYTES]
            axis = self._axis.get(head)
            if axis is not None:
                self._commands[axis] = raw
            elif head == self._sync:
                self._answer()

    def _answer(self) -> None:
        at = 8
        for command in self._commands:
            controlword, mode, target = _COMMAND.unpack_from(command)
            statusword = STATUSWORDS.get(controlword, DISABLED)
            _STATE.pack_into(self._memory, at, statusword, target, mode)
            at += 2 * FRAME.size
        self._send_all(0.0)
        if (now := time.monotonic()) >= self._beat_at:
            self._beat_at = now + BEAT_S
            for node in NODES:
                self._port.send(pack_frame(HEARTBEAT_COB_ID + node, OPERATIONAL))


def main(channel: str, *how: str) -> None:
    """Answer."""
    if "ordinary" in how:
        forbid_priority()
    with can.Bus(interface="hil_unix", channel=channel) as bus, realtime():
        until_over(Drives(port_of(bus)).serve)


if __name__ == "__main__":
    main(*sys.argv[1:])
