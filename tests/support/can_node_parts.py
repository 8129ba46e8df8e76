"""One mock drive and a plain CANopen client of `canopen`, joined without bus, thread or wall time.

What the client sends is heard by the node within the call, and the other way round.
"""

from __future__ import annotations

import io
from functools import cache

import canopen
import pytest

from hil.arms import load_arm
from hil_mock_robot.cia402.dictionary import eds_of, registers_of
from hil_mock_robot.cia402.keys import Registers
from hil_mock_robot.cia402.node import Hooks, MockNode

NODE = 3
SYNC, EMERGENCY, HEARTBEAT = 0x080, 0x080 + NODE, 0x700 + NODE
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130


class Joined(canopen.Network):
    """The client's network: straight into the node."""

    node: MockNode

    def send_message(self, can_id, data, remote=False):
        self.node.heard(can_id, bytes(data))


class Bench:
    """A node at power-on and a client that has its EDS.

    Attributes:
        sent: Frames (COB-ID, data) of the node, but SDO answers.
        told: What the node told its drive.
    """

    def __init__(self, boot_s: float = 0.0, axis: int = NODE - 1) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.told: list[tuple[object, ...]] = []
        self.registers: Registers = registers_of(load_arm("lab6"), axis)
        self.network = Joined()
        self.node = MockNode(NODE, self.registers, self._put, self._hooks(), boot_s)
        self.network.node = self.node
        self.remote = canopen.RemoteNode(NODE, dictionary_of(axis))
        self.remote.sdo.RESPONSE_TIMEOUT = 0.001
        self.network.add_node(self.remote)
        self.node.boot()
        self.told.clear()

    def _hooks(self) -> Hooks:
        def telling(name):
            return lambda *what: self.told.append((name, *what))

        names = ("applied", "written", "nmt_changed", "booted", "connection_lost")
        return Hooks(**{name: telling(name) for name in names})

    def _put(self, can_id: int, data: bytes) -> None:
        if can_id != 0x580 + NODE:
            self.sent.append((can_id, data))
        self.network.notify(can_id, bytearray(data), 0.0)

    def read(self, index: int, sub: int = 0) -> int:
        """By SDO, as an integer without sign."""
        return int.from_bytes(self.remote.sdo.upload(index, sub), "little")

    def write(self, index: int, sub: int, value: int, size: int) -> None:
        self.remote.sdo.download(index, sub, value.to_bytes(size, "little", signed=value < 0))

    def aborts(self, index: int, sub: int, value: int, size: int) -> int:
        """The code with which a write is refused."""
        with pytest.raises(canopen.SdoAbortedError) as caught:
            self.write(index, sub, value, size)
        return caught.value.code

    def command(self, code: int, node: int = NODE) -> None:
        """By NMT."""
        self.node.heard(0, bytes([code, node]))

    def operational(self) -> None:
        self.command(START)
        self.node.ticked(0.0)
        self.sent.clear()
        self.told.clear()

    def taken(self) -> list[tuple[int, bytes]]:
        """What was sent since the last time."""
        sent, self.sent[:] = list(self.sent), []
        return sent

    def map(self, number: int, entries: list[int], *, transmit: bool, type_: int = 1) -> None:
        """Lay out a PDO (number from 1) by the procedure of CiA 301."""
        parameters = (0x1800 if transmit else 0x1400) + number - 1
        cob_id = (0x180 if transmit else 0x200) + 0x100 * (number - 1) + NODE
        self.write(parameters, 1, cob_id | 0xC000_0000, 4)
        self.write(parameters + 0x200, 0, 0, 1)
        for sub, entry in enumerate(entries, start=1):
            self.write(parameters + 0x200, sub, entry, 4)
        self.write(parameters + 0x200, 0, len(entries), 1)
        self.write(parameters, 2, type_, 1)
        self.write(parameters, 1, cob_id | 0x4000_0000, 4)


@cache
def dictionary_of(axis: int) -> canopen.ObjectDictionary:
    """The dictionary of an axis as its client has it; nobody changes it."""
    return imported(MockNode(NODE, registers_of(load_arm("lab6"), axis), lambda *_: None))


def imported(node: MockNode) -> canopen.ObjectDictionary:
    """What another tool makes of the node's EDS."""
    file = io.StringIO(eds_of(node.object_dictionary).decode("ascii"))
    file.name = "drive.eds"
    return canopen.import_od(file, node.node_id)
