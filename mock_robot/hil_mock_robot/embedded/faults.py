"""Faults of the embedded mock, one class each, and the line to the host on which they act.

Faults are set by the option `faults` of a station, or by `MockRobot.fault`
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
    """Controller of the embedded robot on which faults act."""

    @property
    def line(self) -> Line:
        """Connection between controller and host, on which faults act."""

    def trip(self, fault: int) -> None:
        """Stop the arm because of a fault of the controller (a code of `FAULTS`)."""


class EmbeddedFault(Fault[Target], counted=("segment",), example="{kind: freeze, at_s: 2.0}"):
    """Fault of the controller, or of the line to its host."""

    segment: int | None = count(None, least=0)


class ProtectiveStop(EmbeddedFault, kind="protective_stop"):
    """Protective stop of the arm by the controller."""

    def begin(self, mock: Target) -> None:
        mock.trip(PROTECTIVE_STOP)


class EmergencyStop(EmbeddedFault, kind="emergency_stop"):
    """Emergency stop of the arm by its button."""

    def begin(self, mock: Target) -> None:
        mock.trip(EMERGENCY_STOP)


class Refuse(EmbeddedFault, kind="refuse"):
    """Refusal of a segment, or of the first segment after a time; see `Controller.prepare`."""


class _OnLine(EmbeddedFault):
    """Fault of the line to the host that has a duration."""

    def begin(self, mock: Target) -> None:
        mock.line.wrong[self.kind] += 1

    def end(self, mock: Target) -> None:
        mock.line.wrong[self.kind] -= 1


class Cut(_OnLine, kind="cut", lasts=True):
    """Interruption of the line in both directions, until the robot is connected again."""


class Freeze(_OnLine, kind="freeze", lasts=True):
    """Frozen line that repeats the newest row."""


class Silence(_OnLine, kind="silence", lasts=True):
    """Silent line without rows."""


class Hang(_OnLine, kind="hang", lasts=True):
    """Hanging line on which reads do not return."""


class Nan(_OnLine, kind="nan", lasts=True):
    """Corrupt measurements that are all NaN."""


class Lag(EmbeddedFault, kind="lag", lasts=True):
    """Late arrival of rows."""

    by_s: float = seconds(REQUIRED)

    def begin(self, mock: Target) -> None:
        mock.line.lags_s.append(self.by_s)

    def end(self, mock: Target) -> None:
        mock.line.lags_s.remove(self.by_s)


class ClockJump(EmbeddedFault, kind="clock_jump"):
    """Jump of the device clock, which continues from its new time."""

    by_s: float = seconds(REQUIRED, least=-LONGEST_S)

    def begin(self, mock: Target) -> None:
        mock.line.jump_s += self.by_s


class Drop(EmbeddedFault, kind="drop"):
    """Loss of the next samples."""

    samples: int = count()

    def begin(self, mock: Target) -> None:
        mock.line.to_drop += self.samples


class Duplicate(EmbeddedFault, kind="duplicate"):
    """Duplication of the next samples."""

    samples: int = count()

    def begin(self, mock: Target) -> None:
        mock.line.to_repeat += self.samples


MEASURED = ("q", "qd", "effort", "temperature")


class Line:
    """Line to the host, which carries state rows and applies faults to them.

    Faults apply to whole blocks: no fault may begin or end inside a block.

    Attributes:
        wrong: Map from kind to the number of active faults of this kind.
        lags_s: Delay of rows by each active lag [s].
        jump_s: Sum of the jumps of the device clock [s].
        to_drop, to_repeat: Number of next samples that will be lost, and that will be duplicated.
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
        """Whether a fault makes reads hang."""
        return bool(self.wrong["hang"])

    @property
    def cut(self) -> bool:
        """Whether the line carries no data in either direction."""
        return bool(self.wrong["cut"])

    @property
    def silent(self) -> bool:
        """Whether the line carries no rows to the host."""
        return bool(self.wrong["silence"]) or self.cut or self.hanging

    def mend(self) -> None:
        """Remove all faults, except the jump of the device clock."""
        self.wrong.clear()
        self.lags_s.clear()
        self._late.clear()
        self.to_drop = self.to_repeat = 0

    def carry(self, rows: StructArray, now: float) -> StructArray:
        """Return the rows that the host receives if `rows` are sent at true device time `now`.

        The rows may be modified in place.
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
