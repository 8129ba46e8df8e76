"""Faults of a mock: one class per kind, with its name, its keys and its effect.

Each mock has its own base class of faults, with one subclass per kind of fault:

    class PlcFault(Fault[Target], counted=("motion",), example="{kind: silence, at_s: 2.0}"):
        motion: int | None = count(None)

    class Silence(PlcFault, kind="silence", lasts=True):
        def begin(self, mock: Target) -> None:
            mock.links.silent = True

        def end(self, mock: Target) -> None:
            mock.links.silent = False

Keys are class attributes created by `number`, `count`, `seconds` and `choice`. After the definition
of the class, each attribute contains the default of its key. The base class reads faults from a
YAML file (`read`), from a list (`all_of`) or from one request (`one_of`). `Faults` begins and ends
the faults at the ticks of device time that `Schedule` determines.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from hil.core import SpecError, look_into

LONGEST_S = 1e9
"""Maximum time of a fault [s], about three decades; the tick count up to this time is still
exact."""

ROUNDING = 1e-6
REQUIRED: Any = object()
"""Marker in place of the default value of a key, if every fault of the kind must contain the
key."""


class Key:
    """Permitted values of one key.

    Attributes:
        default: Value if the key is missing, or `REQUIRED`.
        allowed: Function that returns whether a value is permitted.
        words: Description of the permitted values, for messages.
        whole: Whether a number stays an integer.
    """

    __slots__ = ("allowed", "default", "whole", "words")

    def __init__(
        self, default: Any, allowed: Callable[[Any], bool], words: str, *, whole: bool = True
    ) -> None:
        self.default, self.allowed, self.words, self.whole = default, allowed, words, whole


def number(default: Any, least: float, most: float, words: str, *, whole: bool = False) -> Any:
    """Return a key whose value is a number from `least` to `most`."""
    kinds = int if whole else (int, float)

    def allowed(value: Any) -> bool:
        fits = isinstance(value, kinds) and not isinstance(value, bool)
        return fits and least <= value <= most

    return Key(default, allowed, words, whole=whole)


def count(default: int | None = 1, least: int = 1) -> Any:
    """Return a key whose value is a whole number."""
    return number(default, least, math.inf, f"a whole number ≥ {least}", whole=True)


def seconds(default: Any, least: float = 0.0, most: float = LONGEST_S) -> Any:
    """Return a key whose value is a time [s]."""
    end = "1e9" if most == LONGEST_S else f"{most:g}"
    start = "-1e9" if least == -LONGEST_S else f"{least:g}"
    return number(default, least, most, f"a number of seconds from {start} to {end}")


def choice(default: Any, allowed: Callable[[Any], bool], words: str) -> Any:
    """Return a key whose value is not a number."""
    return Key(default, allowed, words)


def _lasting_s(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and (0 <= value <= LONGEST_S or value == math.inf)


M = TypeVar("M", contravariant=True)
"""Type variable: parts of a mock on which the faults of the mock act."""


class Fault(Generic[M]):
    """Fault of a mock; a fault happens once.

    Attributes:
        kind: Name of the fault in a file or a request.
        lasts: Whether the fault has a duration and an end; otherwise it is a single event.
        keys: Map from key to permitted values, including the keys of the base classes.
        kinds: Map from name to class, for all kinds of faults of the same mock.
        counted: Keys with which a fault waits for a counted event, such as `motion`.
        example: Valid fault as an example in messages.
        at_s: Device time since the start of the mock at which the fault begins [s].
        after_s: Delay of the fault after the counted event, in device time [s].
        for_s: Duration of the fault in device time [s]; by default infinite, until the fault is
            cleared.
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
            words = "a number of seconds from 0 to 1e9; infinite without"
            cls.keys = {**cls.keys, "for_s": Key(cls.for_s, _lasting_s, words, whole=False)}

    def __init__(self, **given: Any) -> None:
        vars(self).update(given)

    def require(self, mock: M, where: str) -> None:
        """Raise if the mock lacks the part on which the fault acts.

        Raises:
            SpecError, CommandRefused: The mock lacks the part on which the fault acts.
        """

    def begin(self, mock: M) -> None:
        """Begin the fault."""

    def end(self, mock: M) -> None:
        """End the fault; called only if `lasts` is true."""

    @classmethod
    def make(cls, kind: str, **given: Any) -> Self:
        """Return a fault of a kind; missing keys have their default values."""
        made: Self = cls.kinds[kind](**given)  # type: ignore[assignment]
        return made

    @classmethod
    def read(cls, path: Path) -> tuple[Self, ...]:
        """Return the faults of a YAML file, which contains a list, or `faults:` with a list.

        Raises:
            SpecError: The file cannot be read, or a fault is invalid.
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
        """Return the faults of a list; each fault must specify when it begins.

        Raises:
            SpecError: A fault is unknown or invalid; the message names the fault.
        """
        if isinstance(given, str | Mapping) or not isinstance(given, Sequence):
            raise SpecError(f"{name} is {given!r}", hint=f"give a list: [{cls.example}]")
        faults = tuple(cls.one_of(f"{name}[{i}]", entry) for i, entry in enumerate(given))
        for i, (entry, fault) in enumerate(zip(given, faults, strict=True)):
            if all(getattr(fault, what) is None for what in ("at_s", *cls.counted)):
                raise _wrong(
                    f"{name}[{i}]", entry, f"set the beginning: {_or(['at_s', *cls.counted])}"
                )
        return faults

    @classmethod
    def one_of(cls, where: str, given: Any) -> Self:
        """Return one fault; without a time, the fault begins immediately.

        Raises:
            SpecError: The fault is unknown or invalid.
        """
        name = given.get("kind") if isinstance(given, Mapping) else None
        if not isinstance(name, str) or name not in cls.kinds:
            raise _wrong(where, given, f"give kind: one of {', '.join(cls.kinds)}")
        kind, where = cls.kinds[name], f"{where} ({name})"
        unknown = sorted(str(key) for key in set(given) - {"kind", *kind.keys})
        if unknown:
            hint = f"use one of {', '.join(kind.keys)}"
            raise SpecError(f"{where} has no key {unknown[0]}", hint=hint)
        begins = ["at_s", *cls.counted]
        if sum(key in given for key in begins) > 1:
            raise _wrong(where, dict(given), f"give only one of {_or(begins, 'and')}")
        if "after_s" in given and not any(key in given for key in cls.counted):
            hint = f"after_s counts from the start of a {_or(list(cls.counted))}: give that too"
            raise _wrong(f"{where}.after_s", given["after_s"], hint)
        values: dict[str, Any] = {}
        for key, rule in kind.keys.items():
            if key not in given:
                if rule.default is REQUIRED:
                    raise SpecError(f"{where} lacks {key}", hint=f"give {rule.words}")
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
    """Schedule of faults by ticks and counted events since the mock was started.

    A reboot of the simulated controller does not reset the schedule.

    Args:
        faults: Planned faults.
        tick_s: Device time of a tick [s].

    Attributes:
        ticks: Number of ticks since the start.
        lasting: Faults that have begun and have not ended.
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
        """Whether no fault has a planned start or end, so that ticks change nothing."""
        return not self._dated and not self._ends

    def add(self, fault: F) -> bool:
        """Add a fault; return whether the fault begins immediately, because it has no time."""
        if any(getattr(fault, what) is not None for what in fault.counted):
            self._waiting.append(fault)
        elif fault.at_s is not None:
            self._dated.append((self._count(fault.at_s), fault))
        else:
            self._begin(fault, self.ticks + 1)
            return True
        return False

    def began(self, what: str, number: int | None = None) -> None:
        """Record that a counted event, such as a `motion`, begins with the present tick.

        Args:
            what: Name of the event, one of `counted`.
            number: Number of the event; None for the next event of this name.
        """
        self._counts[what] = self._counts[what] + 1 if number is None else number
        mine = [each for each in self._waiting if getattr(each, what) == self._counts[what]]
        self._waiting = [each for each in self._waiting if each not in mine]
        self._dated += [(self.ticks + self._count(each.after_s), each) for each in mine]

    def turn(self, ticks: int = 1) -> tuple[list[F], list[F]]:
        """Advance the ticks; return the faults that begin and the faults that end."""
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
        """Return the number of the next ticks up to the next change, at most `most`.

        The count includes the present tick and is at least 1.
        """
        ahead = [tick - self.ticks for tick, _ in (*self._dated, *self._ends)]
        return max(1, min([most, *ahead]))

    def clear(self, keep: str = "") -> list[F]:
        """Remove all faults except lasting faults of kind `keep`.

        The method returns the lasting faults that were removed.
        """
        lasting = [fault for fault in self.lasting if fault.kind != keep]
        self._dated, self._waiting = [], []
        self.mend(keep)
        return lasting

    def mend(self, keep: str = "") -> None:
        """Remove lasting faults except those of kind `keep`; planned faults remain."""
        self.lasting = [fault for fault in self.lasting if fault.kind == keep]
        self._ends = [(end, fault) for end, fault in self._ends if fault.kind == keep]

    def _begin(self, fault: F, tick: int) -> None:
        if fault.lasts:
            self.lasting.append(fault)
            if fault.for_s < math.inf:
                self._ends.append((tick + self._count(fault.for_s), fault))

    def _count(self, seconds: float) -> int:
        """Return the number of ticks in a time, rounded up; the result is at least 1."""
        return max(1, math.ceil(seconds / self._tick_s - ROUNDING))


T = TypeVar("T")


class Faults(Generic[T]):
    """Scheduler that begins and ends the faults of a mock.

    Args:
        mock: Parts of the mock on which the faults act.
        kinds: Base class of the faults of the mock.
        tick_s: Device time of a tick [s].
        planned: Planned faults.
        stays: Kind of fault that `clear` does not end.
        mend: Function that `clear` calls to cancel pending effects of single-event faults.

    Attributes:
        mock: Parts of the mock on which the faults act.
        listeners: Functions that are called with each fault and with whether the fault begins or
            ends.

    Raises:
        SpecError, CommandRefused: The mock lacks the part on which a fault acts.
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
        """Faults that have begun and have not ended."""
        return self._schedule.lasting

    def add(self, given: object, where: str = "fault") -> Fault[T]:
        """Add a fault, for example from the side channel; without a time, it begins immediately.

        Raises:
            SpecError, CommandRefused: The fault is unknown or invalid.
        """
        fault = self._kinds.one_of(where, given)
        fault.require(self.mock, f"{where} ({fault.kind})")
        if self._schedule.add(fault):
            self._begin(fault)
        return fault

    def clear(self) -> None:
        """End lasting faults and remove planned faults."""
        for fault in self._schedule.clear(self._stays):
            self._end(fault)
        self._mend()

    def plan(self, fault: Fault[T]) -> None:
        """Add a fault that specifies when it begins."""
        self._schedule.add(fault)

    def mend(self) -> None:
        """Remove lasting faults because the affected parts were replaced by new ones.

        Planned faults remain in the schedule.
        """
        self._schedule.mend()

    def began(self, what: str, number: int | None = None, at: int | None = None) -> None:
        """Record the start of a counted event, such as a `motion`.

        Args:
            what: Name of the event, one of `Fault.counted`.
            number: Number of the event; None for the next event of this name.
            at: Number of ticks after which the event begins; None for now.
        """
        if at is not None:
            self._schedule.ticks = at
        self._schedule.began(what, number)

    def passed(self, ticks: int = 1) -> None:
        """Advance device time by a number of ticks; begin and end the faults that are due."""
        if self._schedule.idle:
            self._schedule.ticks += ticks
            return
        begun, over = self._schedule.turn(ticks)
        for fault in over:
            self._end(fault)
        for fault in begun:
            self._begin(fault)

    def reach(self, tick: int) -> None:
        """Advance device time up to tick number `tick`."""
        self.passed(tick - self._schedule.ticks)

    def unchanged(self, most: int) -> int:
        """Return the number of the next ticks until the next change, at most `most`.

        The count includes the present tick and is at least 1.
        """
        return self._schedule.unchanged(most)

    def _begin(self, fault: Fault[T]) -> None:
        for listener in self.listeners:
            listener(fault, True)
        fault.begin(self.mock)

    def _end(self, fault: Fault[T]) -> None:
        for listener in self.listeners:
            listener(fault, False)
        fault.end(self.mock)
