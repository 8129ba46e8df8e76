"""Which fault begins and which is over, tick by tick of device time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

ROUNDING = 1e-6


class Timed(Protocol):
    """A fault that says when it begins and how long it lasts.

    It also has an attribute for everything that its schedule counts, such as `motion`: None, or
    which of them it waits for, from 1.
    """

    @property
    def kind(self) -> str:
        """What goes wrong."""

    @property
    def at_s(self) -> float | None:
        """Device time since the start; None where it waits for something, or begins at once."""

    @property
    def after_s(self) -> float:
        """Device time since what it waits for began."""

    @property
    def for_s(self) -> float:
        """Device time it lasts; infinite until it is cleared."""


F = TypeVar("F", bound=Timed)


class Schedule(Generic[F]):
    """Counts ticks, motions and the like since the mock was started; a reboot changes nothing.

    Args:
        faults: What is to happen.
        tick_s: Device time of a tick.
        counted: What faults may wait for.

    Attributes:
        ticks: Since the start.
        lasting: What has begun and is not over.
    """

    def __init__(
        self, faults: Sequence[F], tick_s: float, counted: Sequence[str] = ("motion", "program")
    ) -> None:
        self._tick_s = tick_s
        self.ticks = 0
        self.lasting: list[F] = []
        self._counts = dict.fromkeys(counted, 0)
        self._dated: list[tuple[int, F]] = []
        self._waiting: list[F] = []
        self._ends: list[tuple[int, F]] = []
        for fault in faults:
            self.add(fault)

    @property
    def idle(self) -> bool:
        """Whether ticks change nothing: nothing is dated and nothing ends."""
        return not self._dated and not self._ends

    def add(self, fault: F) -> bool:
        """One more; whether it begins at once because no time was given."""
        if any(getattr(fault, what) is not None for what in self._counts):
            self._waiting.append(fault)
        elif fault.at_s is not None:
            self._dated.append((self._count(fault.at_s), fault))
        else:
            self._begin(fault, self.ticks + 1)
            return True
        return False

    def began(self, what: str) -> None:
        """Note that something counted, such as a `motion`, begins with this tick."""
        self._counts[what] += 1
        mine = [each for each in self._waiting if getattr(each, what) == self._counts[what]]
        self._waiting = [each for each in self._waiting if each not in mine]
        self._dated += [(self.ticks + self._count(each.after_s), each) for each in mine]

    def turn(self, ticks: int = 1) -> tuple[list[F], list[F]]:
        """Let ticks pass: what begins with them, and what is over."""
        self.ticks += ticks
        begun = [fault for first, fault in self._dated if first <= self.ticks]
        over = [fault for end, fault in self._ends if end <= self.ticks]
        if begun or over:
            self._dated = [(first, each) for first, each in self._dated if first > self.ticks]
            self._ends = [(end, each) for end, each in self._ends if end > self.ticks]
            self.lasting = [each for each in self.lasting if each not in over]
        for fault in begun:
            self._begin(fault, self.ticks)
        return begun, over

    def clear(self, keep: str = "") -> list[F]:
        """Forget everything but what lasts and is of one kind; returns what was lasting else."""
        lasting = [fault for fault in self.lasting if fault.kind != keep]
        self.lasting = [fault for fault in self.lasting if fault.kind == keep]
        self._ends = [(end, fault) for end, fault in self._ends if fault.kind == keep]
        self._dated, self._waiting = [], []
        return lasting

    def _begin(self, fault: F, tick: int) -> None:
        self.lasting.append(fault)
        if fault.for_s < math.inf:
            self._ends.append((tick + self._count(fault.for_s), fault))

    def _count(self, seconds: float) -> int:
        """Ticks in a time, rounded up, at least one."""
        return max(1, math.ceil(seconds / self._tick_s - ROUNDING))
