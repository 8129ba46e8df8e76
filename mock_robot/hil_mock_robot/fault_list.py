"""What may be asked to go wrong, and when: the form of `--faults FILE` and of side channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic

from hil.core import SpecError, look_into
from hil_mock_robot.schedule import F

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


def wrong(where: str, value: object, hint: str) -> SpecError:
    """What is said of a value that cannot be."""
    return SpecError(f"{where} is {value!r}", hint=hint)


def _or(names: Sequence[str], word: str = "or") -> str:
    return f"{', '.join(names[:-1])} {word} {names[-1]}" if len(names) > 1 else names[0]
