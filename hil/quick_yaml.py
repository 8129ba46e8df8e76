"""YAML that is only looked at: read safely, and quickly where PyYAML was compiled.

A station of a hundred robots takes 13 ms, not 60. Specs, which need places for their errors, are
read by `hil.spec`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

DEEPEST = 100
"""Levels of nesting, with those behind aliases: a compiled loader has no other end than a crash."""

MOST_VALUES = 250_000
"""With those behind aliases, which make much of little (`billion laughs`)."""


def look_into(text: str | bytes) -> Any:
    """What a document says.

    Raises:
        ValueError: It is not YAML, not UTF-8, nested too deeply, or more than anybody writes.
    """
    import yaml  # the command line starts without it

    bounded(text)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return yaml.load(text, loader)  # noqa: S506 - a safe loader, compiled
    except Exception as error:  # of `!!int ""` comes an IndexError, of `!!bool x` a KeyError
        raise ValueError(f"no YAML: {_said(error)}") from error


def bounded(text: str | bytes) -> None:
    """See that a document can be built at all, before anything of it is.

    Raises:
        ValueError: It is not YAML, not UTF-8, nested too deeply, or more than anybody writes.
    """
    import yaml

    extent, loader = _Extent(), getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        for event in yaml.parse(text, loader):
            if isinstance(event, yaml.CollectionStartEvent):
                extent.begin(event.anchor)
            elif isinstance(event, yaml.CollectionEndEvent):
                extent.end()
            elif isinstance(event, yaml.AliasEvent):
                extent.add(*extent.named.get(event.anchor, (0, 1)))
            elif isinstance(event, yaml.ScalarEvent):
                extent.add(0, 1)
    except Exception as error:
        raise ValueError(f"no YAML: {_said(error)}") from error


@dataclass
class _Open:
    """A list or mapping that has not ended."""

    anchor: str | None
    before: int
    levels: int = 1


class _Extent:
    """How deep and how large a document becomes; it refuses what is too much as soon as it is."""

    def __init__(self) -> None:
        self.values = 0
        self.open: list[_Open] = []
        self.named: dict[str | None, tuple[int, int]] = {}  # levels and values of each anchor

    def begin(self, anchor: str | None) -> None:
        self.add(1, 1)
        self.open.append(_Open(anchor, self.values))
        if anchor is not None:  # an alias in what it names has no end
            self.named[anchor] = (DEEPEST, 1)

    def end(self) -> None:
        ended = self.open.pop()
        if ended.anchor is not None:
            self.named[ended.anchor] = (ended.levels, self.values - ended.before + 1)
        self._reach(ended.levels)

    def add(self, levels: int, values: int) -> None:
        self.values += values
        if len(self.open) + levels > DEEPEST:
            raise ValueError(f"more than {DEEPEST} levels")
        if self.values > MOST_VALUES:
            raise ValueError(f"more than {MOST_VALUES} values, with those behind aliases")
        self._reach(levels)

    def _reach(self, levels: int) -> None:
        if self.open:
            self.open[-1].levels = max(self.open[-1].levels, levels + 1)


def _said(error: Exception) -> str:
    """PyYAML's own errors say where; others say little of what it tripped over."""
    plain = type(error) is ValueError or hasattr(error, "problem")
    return str(error) if plain else f"{type(error).__name__}: {error}"
