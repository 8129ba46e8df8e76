"""A drive's way to the bus and back, and what can go wrong on it."""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable

from hil_mock_robot.cia402.contracts import Send

TPDOS = (0x180, 0x280, 0x380, 0x480)
SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700
DOWNLOAD, UPLOAD = 1, 2
"""Commands that begin an SDO transfer, in the three upper bits of its first byte."""

ABORT = struct.Struct("<BHBI")
ABORTED = 0x80
NOT_MAPPABLE = 0x0604_0041
MOST_BYTES = 8

Refusal = Callable[[int, int, int], int]
"""From command, index and sub-index to an abort code; 0 lets the request pass."""


class Line:
    """What is between one drive and the bus.

    Args:
        node_id: Of the drive.
        put: Puts a frame on the bus.

    Attributes:
        sound: Whether nothing is wrong: frames pass as they are.
        cuts: Why nothing passes, either way.
        mute: Its heartbeats are lost.
        refusals: What is said to SDO requests before the drive hears of them.
        unheard: SDO requests are lost.
        late_steps: How late TPDOs come, in steps of device time.
        owed: `lost_frames` or `wrong_length` → how many of the next TPDOs suffer from it.
        by_bytes: How much too long those of the wrong length are.
    """

    def __init__(self, node_id: int, put: Send) -> None:
        self._node_id, self._put = node_id, put
        self._tpdos = frozenset(base + node_id for base in TPDOS)
        self._held: deque[tuple[int, int, bytes]] = deque()
        self._steps = 0
        self.sound = True
        self.cuts: set[str] = set()
        self.mute = self.unheard = False
        self.refusals: dict[str, Refusal] = {}
        self.late_steps = 0
        self.owed: Counter[str] = Counter()
        self.by_bytes = 0

    def look(self) -> None:
        """See whether anything is wrong, after an attribute was changed."""
        wrong = self.cuts or self.mute or self.unheard or self.refusals or self.late_steps
        self.sound = not (wrong or self._held or any(self.owed.values()))

    def send(self, can_id: int, data: bytes) -> None:
        """From the drive to the bus."""
        if self.sound:
            self._put(can_id, data)
        elif self.cuts or (self.mute and can_id == HEARTBEAT + self._node_id):
            return
        elif can_id in self._tpdos:
            self._answer(can_id, data)
        else:
            self._put(can_id, data)

    def passes(self, can_id: int, data: bytes) -> bool:
        """Whether the drive hears a frame of the bus; a refusal is sent in its place."""
        if self.sound:
            return True
        if self.cuts:
            return False
        if can_id != SDO_REQUEST + self._node_id or len(data) != MOST_BYTES:
            return True
        return not self.unheard and not self._refused(data)

    def passed(self, steps: int) -> None:
        """Device time has passed."""
        self._steps += steps

    def release(self) -> None:
        """Send what was held back and is due."""
        while self._held and self._held[0][0] <= self._steps:
            _, can_id, data = self._held.popleft()
            if not self.cuts:
                self._put(can_id, data)
        self.look()

    def _answer(self, can_id: int, data: bytes) -> None:
        if self._owes("lost_frames"):
            return
        if self._owes("wrong_length"):
            data = data[: max(0, len(data) + self.by_bytes)]
            data = data.ljust(min(MOST_BYTES, len(data) + max(0, self.by_bytes)), b"\x00")
        if self.late_steps or self._held:
            self._held.append((self._steps + self.late_steps, can_id, data))
        else:
            self._put(can_id, data)

    def _refused(self, data: bytes) -> bool:
        command, index, sub = data[0] >> 5, data[1] | data[2] << 8, data[3]
        for refusal in self.refusals.values():
            if code := refusal(command, index, sub):
                self._put(SDO_ANSWER + self._node_id, ABORT.pack(ABORTED, index, sub, code))
                return True
        return False

    def _owes(self, kind: str) -> bool:
        owed = self.owed[kind] > 0
        self.owed[kind] -= owed
        return owed


def refused_mapping(command: int, index: int, sub: int) -> int:
    """A drive whose process data is laid out for good."""
    laid_out = 0x1600 <= index <= 0x17FF or 0x1A00 <= index <= 0x1BFF
    return NOT_MAPPABLE if command == DOWNLOAD and laid_out and sub else 0


def refused_object(wanted: int, code: int) -> Refusal:
    """Every transfer of an object, or of all for 0, ends with an abort code."""

    def refusal(command: int, index: int, sub: int) -> int:
        begins = command in (DOWNLOAD, UPLOAD)
        return code if begins and wanted in (0, index) else 0

    return refusal
