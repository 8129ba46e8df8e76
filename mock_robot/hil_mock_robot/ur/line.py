"""The line on which the controller sends RTDE packages, and what can go wrong on it."""

from __future__ import annotations

import random
from collections import Counter, deque

from hil_mock_robot.ur.contracts import Link
from hil_mock_robot.ur.faults import Fault
from hil_mock_robot.ur.wire import HEADER, Kind

LASTING = ("silence", "jitter", "late", "freeze")
COUNTED = ("drop", "duplicate", "wrong_length", "garbage")


class Line:
    """What all RTDE clients' connections have in common.

    Args:
        tick_s: Device time of a tick.
        seed: Of jitter and garbage.

    Attributes:
        sound: Whether nothing is wrong with it: packages pass as they are.
        cut: Whether connections are hung up on as soon as they are made.
    """

    def __init__(self, tick_s: float, seed: int = 0) -> None:
        self._tick_s = tick_s
        self.random = random.Random(seed)  # noqa: S311
        self.ticks = 0
        self.sound = True
        self.cut = False
        self._lasting: list[Fault] = []
        self._ends: list[LineEnd] = []

    def over(self, link: Link) -> Link:
        """The link to a client, by way of this line."""
        self._ends = [end for end in self._ends if not end.closed]
        end = LineEnd(self, link)
        self._ends.append(end)
        if self.cut:
            end.close()
        return end

    def begin(self, fault: Fault) -> None:
        """From the next package on, suffer from a fault."""
        if fault.kind == "cut":
            self.cut = fault.for_s > 0
            for end in self._ends:
                end.close()
        elif fault.kind in LASTING:
            self._lasting.append(fault)
        else:
            for end in self._ends:
                end.owed[fault.kind] += fault.packages
                end.by_bytes = fault.by_bytes
        self._look()

    def end(self, fault: Fault) -> None:
        """No longer suffer from it."""
        if fault.kind == "cut":
            self.cut = False
        if fault in self._lasting:
            self._lasting.remove(fault)
        self._look()

    def mend(self) -> None:
        """Forget packages that were still to be spoilt."""
        for end in self._ends:
            end.owed.clear()
        self._look()

    def tick(self) -> None:
        """Let a tick of device time pass: what was held back may be due."""
        self.ticks += 1
        if not self.sound:
            for end in self._ends:
                end.release()
            self._look()

    def has(self, kind: str) -> bool:
        """Whether it suffers from this."""
        return any(fault.kind == kind for fault in self._lasting)

    def delay(self) -> int:
        """Ticks for which the next package is held back."""
        ticks = 0
        for fault in self._lasting:
            most = round(fault.by_s / self._tick_s)
            if fault.kind == "late":
                ticks += most
            elif fault.kind == "jitter":
                ticks += self.random.randint(0, most)
        return ticks

    def _look(self) -> None:
        self.sound = not self._lasting and not any(end.spoilt for end in self._ends)


class LineEnd:
    """One connection; implements `Link`. What is sent at once is one package.

    Args:
        line: What it is part of.
        link: The connection itself.

    Attributes:
        owed: Kind of fault → how many of the next data packages suffer from it.
        by_bytes: How much too long those of the wrong length are.
    """

    def __init__(self, line: Line, link: Link) -> None:
        self._line, self._link = line, link
        self.peer = link.peer
        self.owed: Counter[str] = Counter()
        self.by_bytes = 0
        self._held: deque[tuple[int, bytes]] = deque()
        self._newest = b""

    @property
    def closed(self) -> bool:
        """See `Link`."""
        return self._link.closed

    @property
    def pending(self) -> int:
        """See `Link`."""
        return self._link.pending

    @property
    def spoilt(self) -> bool:
        """Whether this connection alone still suffers from something."""
        return not self.closed and (bool(self._held) or any(self.owed.values()))

    def close(self) -> None:
        """See `Link`."""
        self._held.clear()
        self._link.close()

    def send(self, data: bytes) -> None:
        """See `Link`."""
        if self._line.sound:
            self._newest = data
            self._link.send(data)
            return
        for each in self.carry(data):
            self._held.append((self._line.ticks + self._line.delay(), each))
        self.release()

    def carry(self, data: bytes) -> list[bytes]:
        """What becomes of a package; replies only get lost."""
        line = self._line
        if line.has("silence"):
            return []
        if data[2] != Kind.DATA:
            return [data]
        if line.has("freeze"):
            data = self._newest if self._newest[2:3] == bytes([Kind.DATA]) else data
        self._newest = data
        if self._owes("drop"):
            return []
        if self._owes("garbage"):
            return [self._line.random.randbytes(len(data))]
        if self._owes("wrong_length"):
            return [_resized(data, self.by_bytes)]
        return [data, data] if self._owes("duplicate") else [data]

    def release(self) -> None:
        """Send what is due; nothing overtakes."""
        while self._held and self._held[0][0] <= self._line.ticks:
            self._link.send(self._held.popleft()[1])

    def _owes(self, kind: str) -> bool:
        owed = self.owed[kind] > 0
        self.owed[kind] -= owed
        return owed


def _resized(data: bytes, by_bytes: int) -> bytes:
    """The package with fewer or more bytes than its recipe has, and a header that says so."""
    size, kind = HEADER.unpack_from(data)
    size = max(HEADER.size + 1, size + by_bytes)
    body = data[HEADER.size : size].ljust(size - HEADER.size, b"\x00")
    return HEADER.pack(size, kind) + body
