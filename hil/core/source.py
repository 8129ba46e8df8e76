"""A parsed file that remembers where everything stood, and collects what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from hil.core.errors import SpecError

KeyPath: TypeAlias = tuple[str | int, ...]
"""Keys and list indices from the top of the file to a value."""

MOST_PROBLEMS = 50
"""So many problems are written out; whoever has more mends these first."""


class Mark(NamedTuple):
    """A place in a file; line and column count from 1, and are 0 for what is on one line anyway."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


class Problem(NamedTuple):
    """One thing that is wrong: where, at which key, and what in plain words."""

    mark: Mark
    path: KeyPath
    message: str

    def __str__(self) -> str:
        path = dotted(self.path)
        return f"{self.mark}: {path}: {self.message}" if path else f"{self.mark}: {self.message}"


@dataclass
class Source:
    """The content of one YAML file as plain data, with the place of every key and value.

    Attributes:
        name: The file as the person named it; begins every message.
        data: dicts, lists, strings, numbers, booleans and None.
        keys: Where each key of a mapping stands.
        values: Where each value begins.
        problems: What was wrong with the YAML itself, although it could be parsed.
    """

    name: str
    data: Any = None
    keys: dict[KeyPath, Mark] = field(default_factory=dict)
    values: dict[KeyPath, Mark] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def mark(self, path: KeyPath, *, key: bool = False) -> Mark:
        """The place of a value (or of its key), or else of the nearest thing around it."""
        if key and path in self.keys:
            return self.keys[path]
        while path not in self.values and path:
            path = path[:-1]
        return self.values.get(path, Mark(self.name, 1, 1))

    def at(self, path: KeyPath) -> Any:
        """The value at a path, None where there is nothing."""
        value = self.data
        for step in path:
            try:
                value = value[step]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def add(self, path: KeyPath, message: str, *, key: bool = False) -> None:
        """Note a problem with the value (or the key) at `path`."""
        self.problems.append(Problem(self.mark(path, key=key), path, message))

    def forget(self, path: KeyPath) -> None:
        """Drop the places of everything at and below `path`, because it is being replaced."""
        for places in (self.keys, self.values):
            for below in [p for p in places if p[: len(path)] == path]:
                del places[below]


def refuse(problems: list[Problem], hint: str = "", more: int = 0) -> SpecError:
    """The error that lists problems in the order of the file; `more` were not even explained."""
    ordered = sorted(set(problems), key=lambda p: (p.mark, dotted(p.path), p.message))
    lines = [str(problem) for problem in ordered[:MOST_PROBLEMS]]
    if (left := len(ordered) - len(lines) + more) > 0:
        lines.append(f"… and {left} more")
    return SpecError("\n".join(lines), hint=hint)


def dotted(path: KeyPath) -> str:
    """A path as people write it: `loads.1.mass_kg`."""
    return ".".join(shown(str(step)) for step in path)


def shown(value: object, most: int = 60) -> str:
    """A value for a message: on one line, printable, and of at most so many characters."""
    text = value if isinstance(value, str) else repr(value)
    text = "".join(c if c.isprintable() else "?" for c in text[: most + 1])
    return text if len(text) <= most else text[: most - 1] + "…"
