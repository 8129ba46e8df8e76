"""Faults of the embedded mock, one class each, and the line to its host on which they act.

They are the option `faults` of a station, or asked for by `MockRobot.fault`
(docs/reference/mock.md).
"""

from __future__ import annotations

from collections import Counter, deque
from typing import Protocol

import numpy as np

from hil.core import StructArray
from hil_mock_robot.plant.records import EMERGENCY_STOP, PROTECTIVE_STOP
from hil_mock_robot.server.faults import LONGEST_S, REQUIRED, Fault, count, seconds


class Target(Protocol):
    """The controller, on which faults act."""

    @property
    def line(self) -> Line:
        """To its host."""

    def trip(self, fault: int) -> None:
        """Stop by a fault of the controller's own (a code of `FAULTS`)."""


class EmbeddedFault(Fault[Target], counted=("segment",), example="{kind: freeze, at_s: 2.0}"):
    """A fault of the controller, or of the line to its host."""

    segment: int | None = count(None, least=0)


class ProtectiveStop(EmbeddedFault, kind="protective_stop"):
    """The controller stops the arm."""

    def begin(self, mock: Target) -> None:
        mock.trip(PROTECTIVE_STOP)


class EmergencyStop(EmbeddedFault, kind="emergency_stop"):
    """The red button."""

    def begin(self, mock: Target) -> None:
        mock.trip(EMERGENCY_STOP)


class Refuse(EmbeddedFault, kind="refuse"):
    """That segment, or the first one after that time, is refused; `Controller.prepare` does it."""


class _OnLine(EmbeddedFault):
    """A fault of the line, for as long as it lasts."""

    def begin(self, mock: Target) -> None:
        mock.line.wrong[self.kind] += 1

    def end(self, mock: Target) -> None:
        mock.line.wrong[self.kind] -= 1


class Cut(_OnLine, kind="cut", lasts=True):
    """Nothing gets through in either direction, until the robot is connected anew."""


class Freeze(_OnLine, kind="freeze", lasts=True):
    """The newest row is repeated."""


class Silence(_OnLine, kind="silence", lasts=True):
    """No rows get through."""


class Hang(_OnLine, kind="hang", lasts=True):
    """Reading does not return."""


class Nan(_OnLine, kind="nan", lasts=True):
    """Everything measured is not a number."""


class Lag(EmbeddedFault, kind="lag", lasts=True):
    """Rows come late."""

    by_s: float = seconds(REQUIRED)

    def begin(self, mock: Target) -> None:
        mock.line.lags_s.append(self.by_s)

    def end(self, mock: Target) -> None:
        mock.line.lags_s.remove(self.by_s)


class ClockJump(EmbeddedFault, kind="clock_jump"):
    """The device clock jumps, and goes on from there."""

    by_s: float = seconds(REQUIRED, least=-LONGEST_S)

    def begin(self, mock: Target) -> None:
        mock.line.jump_s += self.by_s


class Drop(EmbeddedFault, kind="drop"):
    """The next samples are lost."""

    samples: int = count()

    def begin(self, mock: Target) -> None:
        mock.line.to_drop += self.samples


class Duplicate(EmbeddedFault, kind="duplicate"):
    """The next samples come twice."""

    samples: int = count()

    def begin(self, mock: Target) -> None:
        mock.line.to_repeat += self.samples


MEASURED = ("q", "qd", "effort", "temperature")


class Line:
    """Carries rows; a sound one carries them unchanged.

    What faults do is decided block by block: none may begin or end inside a block.

    Attributes:
        wrong: Kind → how many faults of it last.
        lags_s: How late each of the present lags makes rows.
        jump_s: How far the device clock has jumped.
        to_drop, to_repeat: How many of the next samples are lost, or come twice.
    """

    def __init__(self) -> None:
        self.wrong: Counter[str] = Counter()
        self.lags_s: list[float] = []
        self.jump_s = 0.0
        self.to_drop = self.to_repeat = 0
        self._newest: StructArray | None = None
        self._late: deque[tuple[float, StructArray]] = deque()

    @property
    def hanging(self) -> bool:
        """Whether reading never returns."""
        return bool(self.wrong["hang"])

    @property
    def cut(self) -> bool:
        """Whether nothing gets through in either direction."""
        return bool(self.wrong["cut"])

    @property
    def silent(self) -> bool:
        """Whether no rows get through."""
        return bool(self.wrong["silence"]) or self.cut or self.hanging

    def mend(self) -> None:
        """Be as new; a clock that jumped stays where it is."""
        self.wrong.clear()
        self.lags_s.clear()
        self._late.clear()
        self.to_drop = self.to_repeat = 0

    def carry(self, rows: StructArray, now: float) -> StructArray:
        """Return the rows that the host gets when `rows` are sent at the true device time `now`.

        Rows in `rows` may be changed.
        """
        if not len(rows):
            return rows
        arrival = rows["host_time"][-1]
        rows = self._frozen(self._lost_and_repeated(self._spoilt(rows)))
        rows = self._delayed(rows, now, arrival)
        return rows[:0] if self.silent else rows

    def _spoilt(self, rows: StructArray) -> StructArray:
        rows["device_time"] += self.jump_s
        if self.wrong["nan"]:
            for field in MEASURED:
                rows[field] = np.nan
        return rows

    def _lost_and_repeated(self, rows: StructArray) -> StructArray:
        dropped = min(self.to_drop, len(rows))
        self.to_drop -= dropped
        rows = rows[dropped:]
        repeated = min(self.to_repeat, len(rows))
        self.to_repeat -= repeated
        return np.repeat(rows, np.where(np.arange(len(rows)) < repeated, 2, 1))

    def _frozen(self, rows: StructArray) -> StructArray:
        if not self.wrong["freeze"]:
            self._newest = rows[-1:].copy() if len(rows) else self._newest
            return rows
        if self._newest is None:
            self._newest = rows[:1].copy()
        arrivals = rows["host_time"].copy()
        rows = np.repeat(self._newest, len(rows))
        rows["host_time"] = arrivals
        return rows

    def _delayed(self, rows: StructArray, now: float, arrival: float) -> StructArray:
        lag_s = sum(self.lags_s)
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
