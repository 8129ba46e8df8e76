"""The line from the controller to its host, and what can go wrong on it."""

from __future__ import annotations

from collections import deque

import numpy as np

from hil.core import StructArray
from hil_mock_robot.faults import Fault

MEASURED = ("q", "qd", "effort", "temperature")


class Line:
    """Carries rows; a sound one carries them unchanged.

    Faults last from `begin` to `end`. What they do is decided block by block, so whoever sends
    must not let a fault begin or end inside a block.
    """

    def __init__(self) -> None:
        self._lasting: list[Fault] = []
        self._jump_s = 0.0
        self._to_drop = self._to_repeat = 0
        self._newest: StructArray | None = None
        self._late: deque[tuple[float, StructArray]] = deque()

    @property
    def hanging(self) -> bool:
        """Whether reading never returns."""
        return self._has("hang")

    @property
    def cut(self) -> bool:
        """Whether nothing gets through in either direction."""
        return self._has("cut")

    @property
    def silent(self) -> bool:
        """Whether no rows get through."""
        return self._has("silence") or self.cut or self.hanging

    def begin(self, fault: Fault) -> None:
        """From the next block on, suffer from a fault."""
        self._lasting.append(fault)
        if fault.kind == "clock_jump":
            self._jump_s += fault.by_s
        elif fault.kind == "drop":
            self._to_drop += fault.samples
        elif fault.kind == "duplicate":
            self._to_repeat += fault.samples

    def end(self, fault: Fault) -> None:
        """From the next block on, no longer suffer from it."""
        if fault in self._lasting:
            self._lasting.remove(fault)

    def mend(self) -> list[Fault]:
        """Be as new; a clock that jumped stays where it is. Returns what is over."""
        over, self._lasting = self._lasting, []
        self._late.clear()
        self._to_drop = self._to_repeat = 0
        return over

    def carry(self, rows: StructArray, now: float) -> StructArray:
        """What the host gets, perhaps nothing, when `rows` are sent at the true device time `now`.

        Rows in `rows` may be changed.
        """
        if not len(rows):
            return rows
        arrival = rows["host_time"][-1]
        rows = self._frozen(self._lost_and_repeated(self._spoilt(rows)))
        rows = self._delayed(rows, now, arrival)
        return rows[:0] if self.silent else rows

    def _has(self, kind: str) -> bool:
        return any(fault.kind == kind for fault in self._lasting)

    def _spoilt(self, rows: StructArray) -> StructArray:
        rows["device_time"] += self._jump_s
        if self._has("nan"):
            for field in MEASURED:
                rows[field] = np.nan
        return rows

    def _lost_and_repeated(self, rows: StructArray) -> StructArray:
        dropped = min(self._to_drop, len(rows))
        self._to_drop -= dropped
        rows = rows[dropped:]
        repeated = min(self._to_repeat, len(rows))
        self._to_repeat -= repeated
        return np.repeat(rows, np.where(np.arange(len(rows)) < repeated, 2, 1))

    def _frozen(self, rows: StructArray) -> StructArray:
        if not self._has("freeze"):
            self._newest = rows[-1:].copy() if len(rows) else self._newest
            return rows
        if self._newest is None:
            self._newest = rows[:1].copy()
        arrivals = rows["host_time"].copy()
        rows = np.repeat(self._newest, len(rows))
        rows["host_time"] = arrivals
        return rows

    def _delayed(self, rows: StructArray, now: float, arrival: float) -> StructArray:
        lag_s = sum(fault.by_s for fault in self._lasting if fault.kind == "lag")
        if not lag_s and not self._late:
            return rows
        self._late.append((now, rows))
        due = []
        while self._late and self._late[0][0] + lag_s <= now + 1e-9:
            due.append(self._late.popleft()[1])
        if not due:
            return rows[:0]
        arrived = np.concatenate(due)
        arrived["host_time"] += arrival - arrived["host_time"][-1]
        return arrived
