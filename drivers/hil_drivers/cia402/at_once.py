"""SDO requests to many drives at once, one frame each: nobody waits for a drive that is silent.

Requests and answers that hold their value themselves (CiA 301, 7.2.4.3: expedited transfer) are
one frame there and one back. What is not answered in time is let be, and its answer is kept from
whoever asks the same drive something else.
"""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Iterable, Sequence

from hil.core import HilError
from hil_drivers.cia402.fed_network import Send
from hil_drivers.cia402.objects import Entry

SDO_REQUEST, SDO_ANSWER = 0x600, 0x580
_HEAD = struct.Struct("<BHB")
_READ, _WRITE = 0x40, 0x23
_VALUE, _VALUE_MASK = 0x42, 0xE2
_WRITTEN = 0x60

LOOK_S = 0.001

Place = tuple[int, int, int]
"""Axis, index, sub-index."""


class AtOnce:
    """Reads or writes one object of several drives; never raises.

    Args:
        send: Puts a frame (COB-ID, data) on the bus.
        nodes: Node ids, in the order of the axes.
    """

    def __init__(self, send: Send, nodes: Sequence[int]) -> None:
        self._send, self._nodes = send, tuple(nodes)
        self._axes = {SDO_ANSWER + node: axis for axis, node in enumerate(nodes)}
        self._expected: dict[Place, list[bytes]] = {}

    def heard(self, can_id: int, data: bytes) -> bool:
        """A frame of eight bytes; whether it answers a request from here.

        Called by the cyclic thread: there is no lock that whoever asks could hold.
        """
        axis = self._axes.get(can_id)
        if axis is None:
            return False
        _, index, sub = _HEAD.unpack_from(data)
        answer = self._expected.pop((axis, index, sub), None)
        if answer is None:
            return False
        answer.append(data)
        return True

    def forget(self, axis: int, entry: Entry) -> None:
        """Somebody else asks for it: the next answer is theirs."""
        self._expected.pop((axis, entry.index, entry.sub), None)

    def read(self, entry: Entry, axes: Iterable[int], within_s: float = 0.0) -> dict[int, int]:
        """Values by axis, of those who told them within that time [s], all together."""
        answers = self._asked(_READ, entry, bytes(4), axes, within_s)
        return {
            axis: int.from_bytes(data[4 : 4 + entry.size], "little", signed=entry.code.islower())
            for axis, data in answers.items()
            if data[0] & _VALUE_MASK == _VALUE
        }

    def write(
        self, entry: Entry, value: int, axes: Iterable[int], within_s: float = 0.0
    ) -> list[int]:
        """Axes that have said within that time [s] that they took it."""
        data = value.to_bytes(4, "little", signed=value < 0)
        command = _WRITE | (4 - entry.size) << 2
        answers = self._asked(command, entry, data, axes, within_s)
        return [axis for axis, said in answers.items() if said[0] == _WRITTEN]

    def _asked(
        self, command: int, entry: Entry, data: bytes, axes: Iterable[int], within_s: float
    ) -> dict[int, bytes]:
        head, until = _HEAD.pack(command, entry.index, entry.sub), time.monotonic() + within_s
        answers: dict[int, list[bytes]] = {axis: [] for axis in axes}
        with contextlib.suppress(HilError):  # a bus that takes no frame takes none of the others
            for axis, answer in answers.items():
                self._expected[axis, entry.index, entry.sub] = answer
                self._send(SDO_REQUEST + self._nodes[axis], head + data)
        while not all(answers.values()) and time.monotonic() < until:
            time.sleep(LOOK_S)
        return {axis: answer[0] for axis, answer in answers.items() if answer}
