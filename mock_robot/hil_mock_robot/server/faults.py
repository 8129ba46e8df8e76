"""Faults of a mock: each kind is one class, with its name, its keys and what it does.

A mock has a base class of its own, and below it one class a kind:

    class PlcFault(Fault[Target], counted=("motion",), example="{kind: silence, at_s: 2.0}"):
        motion: int | None = count(None)

    class Silence(PlcFault, kind="silence", lasts=True):
        def begin(self, mock: Target) -> None:
            mock.links.silent = True

        def end(self, mock: Target) -> None:
            mock.links.silent = False

Keys are class attributes made by `number`, `count` and `choice`, which stand for their default. The
base class reads the faults of a YAML file (`read`), of a list (`all_of`) or of one request
(`one_of`). `Faults` lets them begin and end; `Schedule` tells when, tick by tick of device time.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from hil.core import SpecError, look_into

LONGEST_S = 1e9
"""Three decades: what is later never happens, and ticks until then can still be counted."""

ROUNDING = 1e-6
REQUIRED: Any = object()
"""Default of a key that a fault cannot do without."""


class Key:
    """Permitted values of one key.

    Attributes:
        default: Where nothing is said, or `REQUIRED`.
        allowed: Whether a value fits.
        words: How to say so.
        whole: Whether numbers stay integers.
    """

    __slots__ = ("allowed", "default", "whole", "words")

    def __init__(
        self, default: Any, allowed: Callable[[Any], bool], words: str, *, whole: bool = True
    ) -> None:
        self.default, self.allowed, self.words, self.whole = default, allowed, words, whole


def number(default: Any, least: float, most: float, words: str, *, whole: bool = False) -> Any:
    """A key with a number from `least` to `most`."""
    kinds = int if whole else (int, float)

    def allowed(value: Any) -> bool:
        fits = isinstance(value, kinds) and not isinstance(value, bool)
        return fits and least <= value <= most

    return Key(default, allowed, words, whole=whole)


def count(default: int | None = 1, least: int = 1) -> Any:
    """A key with a whole number."""
    return number(default, least, math.inf, f"a whole number from {least} up", whole=True)


def seconds(default: Any, least: float = 0.0, most: float = LONGEST_S) -> Any:
    """A key with a time [s]."""
    end = "1e9" if most == LONGEST_S else f"{most:g}"
    start = "-1e9" if least == -LONGEST_S else f"{least:g}"
    return number(default, least, most, f"a number of seconds from {start} to {end}")


def choice(default: Any, allowed: Callable[[Any], bool], words: str) -> Any:
    """A key with a value that is no number."""
    return Key(default, allowed, words)


def _lasting_s(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and (0 <= value <= LONGEST_S or value == math.inf)


M = TypeVar("M", contravariant=True)
"""What of a mock its faults act on."""


class Fault(Generic[M]):
    """One fault, which happens once.

    Attributes:
        kind: What a file or a request calls it.
        lasts: Whether it lasts and has an end; else it is a moment's matter.
        keys: Key → what its value may be, with those of the base classes.
        kinds: All kinds of the same mock.
        counted: Keys by which a fault waits for something that is counted, such as `motion`.
        example: A fault that can be, for messages.
        at_s: Device time since the mock was started at which it begins.
        after_s: Device time since what it waits for began.
        for_s: Device time it lasts; infinite until it is cleared.
    """

    kind: ClassVar[str] = ""
    lasts: ClassVar[bool] = False
    keys: ClassVar[Mapping[str, Key]] = {}
    kinds: ClassVar[dict[str, type[Fault[Any]]]] = {}
    counted: ClassVar[tuple[str, ...]] = ()
    example: ClassVar[str] = ""

    at_s: float | None = None
    after_s: float = 0.0
    for_s: float = math.inf

    def __init_subclass__(
        cls,
        kind: str = "",
        *,
        lasts: bool = False,
        counted: tuple[str, ...] | None = None,
        example: str = "",
    ) -> None:
        super().__init_subclass__()
        own = {name: value for name, value in vars(cls).items() if isinstance(value, Key)}
        for name, key in own.items():
            setattr(cls, name, key.default)
        if counted is not None:
            when = {"at_s": seconds(None), **own, "after_s": seconds(0.0)}
            cls.kinds, cls.counted, cls.example, cls.keys = {}, counted, example, when
            return
        cls.keys = {**cls.keys, **own}
        if kind:
            cls.kind, cls.lasts, cls.kinds[kind] = kind, lasts, cls
        if lasts:
            words = "a number of seconds from 0 to 1e9; nothing for ever"
            cls.keys = {**cls.keys, "for_s": Key(cls.for_s, _lasting_s, words, whole=False)}

    def __init__(self, **given: Any) -> None:
        vars(self).update(given)

    def require(self, mock: M, where: str) -> None:
        """Raise if this mock cannot have it.

        Raises:
            SpecError, CommandRefused: It has not what the fault would strike.
        """

    def begin(self, mock: M) -> None:
        """Begin the fault."""

    def end(self, mock: M) -> None:
        """End the fault; called only where it `lasts`."""

    @classmethod
    def make(cls, kind: str, **given: Any) -> Self:
        """Return a fault of a kind; missing keys have their defaults."""
        made: Self = cls.kinds[kind](**given)  # type: ignore[assignment]
        return made

    @classmethod
    def read(cls, path: Path) -> tuple[Self, ...]:
        """Return the faults of a YAML file: `faults:` and a list, or the list alone.

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
            return cls.all_of(given)
        except SpecError as error:
            raise SpecError(f"{path}: {error.message}", hint=error.hint) from error

    @classmethod
    def all_of(cls, given: Any, name: str = "faults") -> tuple[Self, ...]:
        """Return the faults of a list, each with its beginning.

        Raises:
            SpecError: One is unknown or cannot be; the message names it.
        """
        if isinstance(given, str | Mapping) or not isinstance(given, Sequence):
            raise SpecError(f"{name} is {given!r}", hint=f"give a list: [{cls.example}]")
        faults = tuple(cls.one_of(f"{name}[{i}]", entry) for i, entry in enumerate(given))
        for i, (entry, fault) in enumerate(zip(given, faults, strict=True)):
            if all(getattr(fault, what) is None for what in ("at_s", *cls.counted)):
                raise _wrong(f"{name}[{i}]", entry, f"say when: {_or(['at_s', *cls.counted])}")
        return faults

    @classmethod
    def one_of(cls, where: str, given: Any) -> Self:
        """Return one fault; without a time it begins now.

        Raises:
            SpecError: It is unknown or cannot be.
        """
        name = given.get("kind") if isinstance(given, Mapping) else None
        if not isinstance(name, str) or name not in cls.kinds:
            raise _wrong(where, given, f"give kind: one of {', '.join(cls.kinds)}")
        kind, where = cls.kinds[name], f"{where} ({name})"
        unknown = sorted(str(key) for key in set(given) - {"kind", *kind.keys})
        if unknown:
            hint = f"this kind has {', '.join(kind.keys)}"
            raise SpecError(f"{where} has no key {unknown[0]}", hint=hint)
        begins = ["at_s", *cls.counted]
        if sum(key in given for key in begins) > 1:
            raise _wrong(where, dict(given), f"give one of {_or(begins, 'and')}")
        if "after_s" in given and not any(key in given for key in cls.counted):
            hint = f"it counts from the start of a {_or(list(cls.counted))}"
            raise _wrong(f"{where}.after_s", given["after_s"], hint)
        values: dict[str, Any] = {}
        for key, rule in kind.keys.items():
            if key not in given:
                if rule.default is REQUIRED:
                    raise SpecError(f"{where} lacks {key}", hint="say by how many seconds")
                continue
            value = given[key]
            if not rule.allowed(value):
                raise _wrong(f"{where}.{key}", value, f"use {rule.words}")
            values[key] = value if rule.whole else float(value)
        return cls.make(name, **values)


def _wrong(where: str, value: object, hint: str) -> SpecError:
    return SpecError(f"{where} is {value!r}", hint=hint)


def _or(names: Sequence[str], word: str = "or") -> str:
    return f"{', '.join(names[:-1])} {word} {names[-1]}" if len(names) > 1 else names[0]


F = TypeVar("F", bound=Fault[Any])


class Schedule(Generic[F]):
    """Counts ticks, motions and the like since the mock was started; a reboot changes nothing.

    Args:
        faults: Planned faults.
        tick_s: Device time of a tick.

    Attributes:
        ticks: Since the start.
        lasting: Faults that have begun and last.
    """

    def __init__(self, faults: Sequence[F], tick_s: float) -> None:
        self._tick_s = tick_s
        self.ticks = 0
        self.lasting: list[F] = []
        self._counts: Counter[str] = Counter()
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
        """Add a fault; return whether it begins at once because no time was given."""
        if any(getattr(fault, what) is not None for what in fault.counted):
            self._waiting.append(fault)
        elif fault.at_s is not None:
            self._dated.append((self._count(fault.at_s), fault))
        else:
            self._begin(fault, self.ticks + 1)
            return True
        return False

    def began(self, what: str, number: int | None = None) -> None:
        """Note that something counted, such as a `motion`, begins with this tick.

        Args:
            what: One of the faults' `counted`.
            number: Which one; the next when None.
        """
        self._counts[what] = self._counts[what] + 1 if number is None else number
        mine = [each for each in self._waiting if getattr(each, what) == self._counts[what]]
        self._waiting = [each for each in self._waiting if each not in mine]
        self._dated += [(self.ticks + self._count(each.after_s), each) for each in mine]

    def turn(self, ticks: int = 1) -> tuple[list[F], list[F]]:
        """Let ticks pass; return the faults that begin with them, and those that end."""
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

    def unchanged(self, most: int) -> int:
        """Return how many of the next `most` ticks, with this one, pass before the next change."""
        ahead = [tick - self.ticks for tick, _ in (*self._dated, *self._ends)]
        return max(1, min([most, *ahead]))

    def clear(self, keep: str = "") -> list[F]:
        """Forget all but lasting faults of one kind; return the other lasting ones."""
        lasting = [fault for fault in self.lasting if fault.kind != keep]
        self._dated, self._waiting = [], []
        self.mend(keep)
        return lasting

    def mend(self, keep: str = "") -> None:
        """Forget lasting faults that are not of one kind; later ones still come."""
        self.lasting = [fault for fault in self.lasting if fault.kind == keep]
        self._ends = [(end, fault) for end, fault in self._ends if fault.kind == keep]

    def _begin(self, fault: F, tick: int) -> None:
        if fault.lasts:
            self.lasting.append(fault)
            if fault.for_s < math.inf:
                self._ends.append((tick + self._count(fault.for_s), fault))

    def _count(self, seconds: float) -> int:
        """Ticks in a time, rounded up, at least one."""
        return max(1, math.ceil(seconds / self._tick_s - ROUNDING))


T = TypeVar("T")


class Faults(Generic[T]):
    """Lets faults strike a mock, and end again.

    Args:
        mock: What of it they act on.
        kinds: The base class of its faults.
        tick_s: Device time of a tick.
        planned: Planned faults.
        stays: Kind of fault that `clear` leaves to its own end.
        mend: Called by `clear` to forget what a moment's fault still owes.

    Attributes:
        mock: As given.
        listeners: Called with each fault, and whether it begins.

    Raises:
        SpecError, CommandRefused: The mock has not what a fault would strike.
    """

    def __init__(
        self,
        mock: T,
        kinds: type[Fault[T]],
        tick_s: float,
        planned: Sequence[Fault[T]] = (),
        stays: str = "",
        mend: Callable[[], object] = lambda: None,
    ) -> None:
        self.mock, self._kinds, self._stays, self._mend = mock, kinds, stays, mend
        for i, fault in enumerate(planned):
            fault.require(mock, f"faults[{i}] ({fault.kind})")
        self._schedule: Schedule[Fault[T]] = Schedule(planned, tick_s)
        self.listeners: list[Callable[[Fault[T], bool], None]] = []

    @property
    def lasting(self) -> list[Fault[T]]:
        """Faults that have begun and last."""
        return self._schedule.lasting

    def add(self, given: object, where: str = "fault") -> Fault[T]:
        """Add a fault, such as from the side channel; without a time it begins at once.

        Raises:
            SpecError, CommandRefused: It is unknown or cannot be.
        """
        fault = self._kinds.one_of(where, given)
        fault.require(self.mock, f"{where} ({fault.kind})")
        if self._schedule.add(fault):
            self._begin(fault)
        return fault

    def clear(self) -> None:
        """End lasting faults and forget later ones."""
        for fault in self._schedule.clear(self._stays):
            self._end(fault)
        self._mend()

    def plan(self, fault: Fault[T]) -> None:
        """Add a fault with its beginning."""
        self._schedule.add(fault)

    def mend(self) -> None:
        """Forget lasting faults, because the parts they act on are new; later ones still come."""
        self._schedule.mend()

    def began(self, what: str, number: int | None = None, at: int | None = None) -> None:
        """Note that something begins that faults may wait for, such as a `motion`.

        Args:
            what: One of `Fault.counted`.
            number: Which one; the next when None.
            at: After how many ticks; now when None.
        """
        if at is not None:
            self._schedule.ticks = at
        self._schedule.began(what, number)

    def passed(self, ticks: int = 1) -> None:
        """Let ticks of device time pass."""
        if self._schedule.idle:
            self._schedule.ticks += ticks
            return
        begun, over = self._schedule.turn(ticks)
        for fault in over:
            self._end(fault)
        for fault in begun:
            self._begin(fault)

    def reach(self, tick: int) -> None:
        """Let device time pass up to this tick."""
        self.passed(tick - self._schedule.ticks)

    def unchanged(self, most: int) -> int:
        """Return how many of the next `most` ticks, with this one, pass before the next change."""
        return self._schedule.unchanged(most)

    def _begin(self, fault: Fault[T]) -> None:
        for listener in self.listeners:
            listener(fault, True)
        fault.begin(self.mock)

    def _end(self, fault: Fault[T]) -> None:
        for listener in self.listeners:
            listener(fault, False)
        fault.end(self.mock)
