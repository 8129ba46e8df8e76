"""Faults of mock servers: which there are, how they are asked for, and when they begin and end.

`FaultList` reads the faults of a YAML file (`--faults FILE`) or of one side-channel request;
`Schedule` tells tick by tick of device time which fault begins and which is over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from hil.core import SpecError, look_into

LONGEST_S = 1e9
"""Three decades: what is later never happens, and ticks until then can still be counted."""


@dataclass(frozen=True, slots=True)
class Number:
    """What a number in a fault may be.

    Attributes:
        least, most: Its range.
        whole: Whether it is an integer.
        words: How to say so.
    """

    least: float
    most: float
    whole: bool
    words: str


SECONDS = Number(0, LONGEST_S, False, "a number of seconds from 0 to 1e9")
COUNT = Number(1, math.inf, True, "a whole number from 1 up")

SHARED = {
    "at_s": SECONDS,
    "after_s": SECONDS,
    "for_s": Number(0, LONGEST_S, False, "a number of seconds from 0 to 1e9; nothing for ever"),
}


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


@dataclass(frozen=True)
class FaultList(Generic[F]):
    """The form of one mock's faults.

    Attributes:
        make: Makes a fault from its kind and keys; keys that are missing have its own values.
        kinds: What can go wrong, and which further keys each kind has.
        counted: What faults may wait for, such as `motion`: a key with a number from 1.
        numbers: Key → what its number may be.
        words: Key → what its value may be, where it is no number, and how to say so.
        required: Kind → the key that it cannot do without.
        durations: How long kinds last when nothing is said; the others until they are cleared.
        example: A fault that can be.
    """

    make: Callable[..., F]
    kinds: Mapping[str, tuple[str, ...]]
    counted: tuple[str, ...]
    numbers: Mapping[str, Number]
    example: str
    words: Mapping[str, tuple[Callable[[Any], bool], str]] = field(default_factory=dict)
    required: Mapping[str, str] = field(default_factory=dict)
    durations: Mapping[str, float] = field(default_factory=dict)

    def read(self, path: Path) -> tuple[F, ...]:
        """The faults of a YAML file: `faults:` and a list, or the list alone.

        Raises:
            SpecError: It cannot be read, or a fault in it cannot be.
        """
        try:
            given = look_into(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            hint = "give a YAML file with a list of faults"
            raise SpecError(f"{path}: {error}", hint=hint) from error
        if isinstance(given, Mapping) and set(given) == {"faults"}:
            given = given["faults"]
        try:
            return self.all_of(given)
        except SpecError as error:
            raise SpecError(f"{path}: {error.message}", hint=error.hint) from error

    def all_of(self, given: Any) -> tuple[F, ...]:
        """The faults of a list.

        Raises:
            SpecError: One is unknown or cannot be; the message names it.
        """
        if isinstance(given, str | Mapping) or not isinstance(given, Sequence):
            raise SpecError(f"faults is {given!r}", hint=f"give a list: [{self.example}]")
        faults = tuple(self.one_of(f"faults[{i}]", entry) for i, entry in enumerate(given))
        for i, (entry, fault) in enumerate(zip(given, faults, strict=True)):
            if fault.at_s is None and all(getattr(fault, what) is None for what in self.counted):
                raise wrong(f"faults[{i}]", entry, f"say when: {_or(['at_s', *self.counted])}")
        return faults

    def one_of(self, where: str, given: Any) -> F:
        """One fault; without a time it begins now.

        Raises:
            SpecError: It is unknown or cannot be.
        """
        kind = given.get("kind") if isinstance(given, Mapping) else None
        if not isinstance(kind, str) or kind not in self.kinds:
            raise wrong(where, given, f"give kind: one of {', '.join(self.kinds)}")
        where = f"{where} ({kind})"
        keys = ("at_s", *self.counted, "after_s", *self.kinds[kind])
        unknown = sorted(str(key) for key in set(given) - {"kind", *keys})
        if unknown:
            hint = f"this kind has {', '.join(keys)}"
            raise SpecError(f"{where} has no key {unknown[0]}", hint=hint)
        self._require(where, kind, given)
        named = [key for key in given if key != "kind"]
        values = {key: self._value(f"{where}.{key}", key, given[key]) for key in named}
        return self.make(kind, **{"for_s": self.durations.get(kind, math.inf), **values})

    def _require(self, where: str, kind: str, given: Mapping[str, Any]) -> None:
        if sum(key in given for key in ("at_s", *self.counted)) > 1:
            raise wrong(where, dict(given), f"give one of {_or(['at_s', *self.counted], 'and')}")
        if "after_s" in given and not any(key in given for key in self.counted):
            hint = f"it counts from the start of a {_or(list(self.counted))}"
            raise wrong(f"{where}.after_s", given["after_s"], hint)
        if kind in self.required and self.required[kind] not in given:
            raise SpecError(f"{where} lacks {self.required[kind]}", hint="say by how many seconds")

    def _value(self, where: str, key: str, value: Any) -> Any:
        if key in self.words:
            allowed, words = self.words[key]
            if not allowed(value):
                raise wrong(where, value, words)
            return value
        if key == "for_s" and value == math.inf:
            return math.inf
        number = self.numbers.get(key) or SHARED.get(key, COUNT)
        kinds = int if number.whole else (int, float)
        fits = isinstance(value, kinds) and not isinstance(value, bool)
        if not fits or not number.least <= value <= number.most:
            raise wrong(where, value, f"use {number.words}")
        return value if number.whole else float(value)


def _or(names: Sequence[str], word: str = "or") -> str:
    return f"{', '.join(names[:-1])} {word} {names[-1]}" if len(names) > 1 else names[0]


def wrong(where: str, value: object, hint: str) -> SpecError:
    """What is said of a value that cannot be."""
    return SpecError(f"{where} is {value!r}", hint=hint)


ROUNDING = 1e-6


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
