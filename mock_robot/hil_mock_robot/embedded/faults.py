"""Faults of the embedded mock: the option `faults`, when they begin, what they do to the rows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import SpecError, StructArray
from hil_mock_robot.server.options import numbers_of

KINDS: dict[str, tuple[str, ...]] = {
    "protective_stop": (),
    "emergency_stop": (),
    "refuse": (),
    "cut": (),
    "freeze": ("for_s",),
    "silence": ("for_s",),
    "hang": ("for_s",),
    "nan": ("for_s",),
    "lag": ("by_s", "for_s"),
    "clock_jump": ("by_s",),
    "drop": ("samples",),
    "duplicate": ("samples",),
}
"""What can go wrong, and which further keys each kind has."""

WHEN = ("at_s", "segment", "after_s")
NEEDS_BY = ("lag", "clock_jump")
ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong, once.

    Attributes:
        kind: One of `KINDS`.
        at_s: Device time at which it begins.
        segment: The segment it belongs to, when there is no `at_s`.
        after_s: Device time from the start of that segment.
        for_s: Device time it lasts.
        by_s: How late rows come, or how far the device clock jumps.
        samples: How many samples are dropped or sent twice.
    """

    kind: str
    at_s: float | None = None
    segment: int | None = None
    after_s: float = 0.0
    for_s: float = math.inf
    by_s: float = 0.0
    samples: int = 1


def faults_of(given: Any) -> tuple[Fault, ...]:
    """The faults of a station's list.

    Raises:
        SpecError: One is unknown or cannot be; the message names it.
    """
    if isinstance(given, str | Mapping) or not isinstance(given, Sequence):
        raise SpecError(
            f"mock option faults is {given!r}", hint="give a list: [{kind: freeze, at_s: 2.0}]"
        )
    return tuple(_fault_of(f"faults[{i}]", entry) for i, entry in enumerate(given))


def _fault_of(where: str, given: Any) -> Fault:
    kind = given.get("kind") if isinstance(given, Mapping) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise _wrong(where, given, f"give kind: one of {', '.join(KINDS)}")
    unknown = sorted(str(key) for key in set(given) - {"kind", *WHEN, *KINDS[kind]})
    if unknown:
        known = ", ".join((*WHEN, *KINDS[kind]))
        raise _wrong(f"{where} ({kind})", unknown[0], f"this kind has {known}", what="has no key")
    _require_when(where, kind, given)
    if kind in NEEDS_BY and "by_s" not in given:
        raise _wrong(f"{where} ({kind})", "by_s", "say by how many seconds", what="lacks")
    numbers = {key: _value_of(f"{where}.{key}", key, kind, given[key]) for key in given}
    return Fault(**{**numbers, "kind": kind})


def _wrong(where: str, value: object, hint: str, what: str = "is") -> SpecError:
    shown = value if what != "is" else repr(value)
    return SpecError(f"mock option {where} {what} {shown}", hint=hint)


def _require_when(where: str, kind: str, given: Mapping[str, Any]) -> None:
    if ("at_s" in given) == ("segment" in given):
        raise _wrong(where, dict(given), "give either at_s or segment")
    relative = "segment" in given and kind != "refuse"
    if "after_s" in given and not relative:
        raise _wrong(f"{where}.after_s", given["after_s"], "it counts from the start of a segment")


def _value_of(where: str, key: str, kind: str, value: Any) -> Any:
    if key == "kind":
        return value
    if key in ("segment", "samples"):
        least = 1 if key == "samples" else 0
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise _wrong(where, value, f"use a whole number from {least} up")
        return value
    number = numbers_of([value], 1)
    backwards = key == "by_s" and kind == "clock_jump"
    if number is None or (number[0] < 0 and not backwards):
        raise _wrong(where, value, "use a number of seconds" + ("" if backwards else " ≥ 0"))
    return number[0]


class Schedule:
    """Says before every sample what begins and what is over.

    Args:
        faults: What is to happen.
        rate_hz: Samples per second of device time.
    """

    def __init__(self, faults: Sequence[Fault], rate_hz: float) -> None:
        self._rate = rate_hz
        self._refusals: list[Fault] = []
        self._waiting: list[Fault] = []
        self._dated: list[tuple[int, Fault]] = []
        self._lasting: list[tuple[int, Fault]] = []
        for fault in faults:
            self.add(fault)

    def add(self, fault: Fault) -> None:
        """One more; what is due already begins with the next sample."""
        if fault.kind == "refuse":
            self._refusals.append(fault)
        elif fault.segment is not None:
            self._waiting.append(fault)
        elif fault.at_s is not None:
            self._dated.append((self._count(fault.at_s), fault))

    def clear(self) -> None:
        """Forget what is to come, and when what lasts would end."""
        self._refusals, self._waiting, self._dated, self._lasting = [], [], [], []

    def began(self, segment: int, samples: int) -> None:
        """Note that a segment starts after so many samples."""
        mine = [fault for fault in self._waiting if fault.segment == segment]
        self._waiting = [fault for fault in self._waiting if fault.segment != segment]
        self._dated += [(samples + self._count(fault.after_s), fault) for fault in mine]

    def refuses(self, segment: int, samples: int) -> bool:
        """Whether to refuse this segment; each refusal is used up by one."""
        for fault in self._refusals:
            due = fault.at_s is not None and samples >= fault.at_s * self._rate - ROUNDING
            if due or fault.segment == segment:
                self._refusals.remove(fault)
                return True
        return False

    def turn(self, samples: int) -> tuple[list[Fault], list[Fault]]:
        """What begins and what ends with the sample after so many."""
        begun = [fault for first, fault in self._dated if first <= samples + 1]
        over = [fault for end, fault in self._lasting if end <= samples + 1]
        self._dated = [(first, f) for first, f in self._dated if first > samples + 1]
        self._lasting = [(end, f) for end, f in self._lasting if end > samples + 1]
        self._lasting += [
            (samples + 1 + self._count(f.for_s), f) for f in begun if f.for_s < math.inf
        ]
        return begun, over

    def unchanged(self, samples: int, most: int) -> int:
        """How many of the next `most` samples pass before anything begins or ends."""
        ahead = [first - 1 - samples for first, _ in (*self._dated, *self._lasting)]
        return max(1, min([most, *ahead]))

    def mend(self) -> None:
        """End what lasts: there is a new connection."""
        self._lasting = []

    def _count(self, seconds: float) -> int:
        """Samples in a time, rounded up, at least one."""
        return max(1, math.ceil(seconds * self._rate - ROUNDING))


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
