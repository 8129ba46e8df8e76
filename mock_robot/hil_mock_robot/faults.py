"""What is to go wrong with a mock robot, and when: the option `faults`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hil.core import SpecError
from hil_mock_robot.options import numbers_of

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


def _wrong(where: str, value: object, hint: str, what: str = "is") -> SpecError:
    shown = value if what != "is" else repr(value)
    return SpecError(f"mock option {where} {what} {shown}", hint=hint)


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
