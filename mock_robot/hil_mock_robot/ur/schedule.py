"""Which fault begins and which is over, tick by tick of device time."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hil_mock_robot.ur.faults import ROUNDING, Fault


class Schedule:
    """Counts ticks, motions and programs since the mock was started; a reboot changes nothing.

    Args:
        faults: What is to happen.
        tick_s: Device time of a tick.

    Attributes:
        ticks: Since the start.
        lasting: What has begun and is not over.
    """

    def __init__(self, faults: Sequence[Fault], tick_s: float) -> None:
        self._tick_s = tick_s
        self.ticks = 0
        self.lasting: list[Fault] = []
        self._counts = {"motion": 0, "program": 0}
        self._dated: list[tuple[int, Fault]] = []
        self._waiting: list[Fault] = []
        self._ends: list[tuple[int, Fault]] = []
        for fault in faults:
            self.add(fault)

    def add(self, fault: Fault) -> bool:
        """One more; whether it begins at once because no time was given."""
        if fault.motion is not None or fault.program is not None:
            self._waiting.append(fault)
        elif fault.at_s is not None:
            self._dated.append((self._count(fault.at_s), fault))
        else:
            self._begin(fault, self.ticks + 1)
            return True
        return False

    def began(self, what: str) -> None:
        """Note that a `motion` or `program` begins with this tick."""
        self._counts[what] += 1
        mine = [each for each in self._waiting if getattr(each, what) == self._counts[what]]
        self._waiting = [each for each in self._waiting if each not in mine]
        self._dated += [(self.ticks + self._count(each.after_s), each) for each in mine]

    def turn(self) -> tuple[list[Fault], list[Fault]]:
        """A tick: what begins with it, and what is over."""
        self.ticks += 1
        begun = [fault for first, fault in self._dated if first <= self.ticks]
        over = [fault for end, fault in self._ends if end <= self.ticks]
        if begun or over:
            self._dated = [(first, each) for first, each in self._dated if first > self.ticks]
            self._ends = [(end, each) for end, each in self._ends if end > self.ticks]
            self.lasting = [each for each in self.lasting if each not in over]
        for fault in begun:
            self._begin(fault, self.ticks)
        return begun, over

    def clear(self, keep: str) -> list[Fault]:
        """Forget everything but what lasts and is of one kind; returns what was lasting else."""
        lasting = [fault for fault in self.lasting if fault.kind != keep]
        self.lasting = [fault for fault in self.lasting if fault.kind == keep]
        self._ends = [(end, fault) for end, fault in self._ends if fault.kind == keep]
        self._dated, self._waiting = [], []
        return lasting

    def _begin(self, fault: Fault, tick: int) -> None:
        self.lasting.append(fault)
        if fault.for_s < math.inf:
            self._ends.append((tick + self._count(fault.for_s), fault))

    def _count(self, seconds: float) -> int:
        """Ticks in a time, rounded up, at least one."""
        return max(1, math.ceil(seconds / self._tick_s - ROUNDING))
