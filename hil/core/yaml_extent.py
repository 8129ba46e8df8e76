"""Depth and size of a YAML document with its aliases followed, limited before anything is built.

Aliases make much of little ("billion laughs"): 600 bytes stand for 10⁹ values. Each alias is
counted as what its anchor held, while the events of the parser come in, so that a refusal costs
no more than reading that far. Every reader of YAML uses this limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import yaml

MOST_FREE = 10_000
"""Values that a document may hold however short it is."""

MOST_PER_CHARACTER = 2
"""Values a character: written out, a value takes one at least; the rest is behind aliases."""

MOST_VALUES = 2**19
"""Values of any document."""

MOST_CHARACTERS = 2**19
"""Characters of values that aliases may add to those of the text."""


@dataclass(slots=True)
class _Held:
    """What an anchor stands for."""

    levels: int
    values: int
    characters: int


@dataclass(slots=True)
class _Open:
    """A list or mapping that has not ended."""

    anchor: str | None
    values: int
    characters: int
    levels: int = 1


class Extent:
    """Depth and size of a document as far as its events were seen.

    Args:
        length: Characters of the text.
        deepest: Most levels of nesting.
    """

    def __init__(self, length: int, deepest: int) -> None:
        self._deepest = deepest
        self._most = min(MOST_FREE + MOST_PER_CHARACTER * length, MOST_VALUES)
        self._most_characters = MOST_CHARACTERS + length
        self._values = 0
        self._characters = 0
        self._open: list[_Open] = []
        # None: the anchor's list or mapping has not ended.
        self._anchors: dict[str | None, _Held | None] = {}

    def see(self, event: yaml.Event) -> None:
        """Count an event of the parser.

        Raises:
            ValueError: The document is nested too deeply, or its aliases expand to too much.
        """
        if isinstance(event, yaml.ScalarEvent):
            self._add(_Held(0, 1, len(event.value)))
            if event.anchor is not None:
                self._anchors[event.anchor] = _Held(0, 1, len(event.value))
        elif isinstance(event, yaml.CollectionStartEvent):
            self._begin(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._end()
        elif isinstance(event, yaml.AliasEvent):
            # An anchor that is not defined is an error of the reader itself.
            held = self._anchors.get(event.anchor, _Held(0, 1, 0))
            if held is None:
                raise ValueError("an alias contains itself")
            self._add(held)

    def _begin(self, anchor: str | None) -> None:
        opened = _Open(anchor, self._values, self._characters)
        self._add(_Held(1, 1, 0))
        self._open.append(opened)
        if anchor is not None:
            self._anchors[anchor] = None

    def _end(self) -> None:
        ended = self._open.pop()
        if ended.anchor is not None:
            values, characters = self._values - ended.values, self._characters - ended.characters
            self._anchors[ended.anchor] = _Held(ended.levels, values, characters)
        self._reach(ended.levels)

    def _add(self, held: _Held) -> None:
        self._values += held.values
        self._characters += held.characters
        if len(self._open) + held.levels > self._deepest:
            raise ValueError(f"more than {self._deepest} levels")
        if self._values > self._most or self._characters > self._most_characters:
            raise ValueError("aliases expand to more values than a file of this size may hold")
        self._reach(held.levels)

    def _reach(self, levels: int) -> None:
        if self._open:
            self._open[-1].levels = max(self._open[-1].levels, levels + 1)
