"""What a page is made of: sections of tables, plots, facts and notes. No HTML here.

A new kind of result adds a function that returns a `Section`; template and style stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from hil.report.plotly_figures import Figure
from hil.report.words import UNKNOWN

Mark = Literal["", "pass", "fail", "warn", "quiet"]


@dataclass(frozen=True, slots=True)
class Cell:
    """One table cell; `mark` adds a sign beside the text, never a colour alone.

    With a `link` the text leads to another page, told relative to this one.
    """

    text: str
    mark: Mark = ""
    link: str = ""


@dataclass(frozen=True, slots=True)
class Column:
    """One table column; neighbours with the same `group` share a heading above theirs."""

    title: str
    group: str = ""
    number: bool = True


@dataclass(frozen=True, slots=True)
class Table:
    """A table whose first column names the row.

    Attributes:
        caption: Says what is in it, with units.
        columns: The first one heads the row names.
        rows: As many cells as columns each.
        note: Small print below.
    """

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    kind: Literal["table"] = "table"

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Heading and width of every column group, in order; empty when there are none."""
        if not any(column.group for column in self.columns):
            return []
        out: list[tuple[str, int]] = []
        for column in self.columns:
            if out and out[-1][0] == column.group:
                out[-1] = (column.group, out[-1][1] + 1)
            else:
                out.append((column.group, 1))
        return out

    def without_empty_columns(self) -> Table:
        """The same table without the number columns in which nothing is known."""
        kept = [
            i
            for i, column in enumerate(self.columns)
            if not column.number or any(row[i].text != UNKNOWN for row in self.rows)
        ]
        columns = tuple(self.columns[i] for i in kept)
        rows = tuple(tuple(row[i] for i in kept) for row in self.rows)
        return replace(self, columns=columns, rows=rows)


@dataclass(frozen=True, slots=True)
class Panel:
    """One plot.

    Attributes:
        title: Above the plot, usually the joint.
        figure: See `figures`.
        alt: What it shows, in words, for those who do not see it.
        wide: Takes the whole width.
    """

    title: str
    figure: Figure
    alt: str
    wide: bool = False


@dataclass(frozen=True, slots=True)
class Plots:
    """Plots of one kind side by side, with one legend for all."""

    title: str
    lead: str
    panels: tuple[Panel, ...]
    legend: tuple[tuple[str, str, str], ...] = ()
    """(text, colour, a dash of `colours.STROKES` | `band` | marker character)."""
    columns: int = 0
    """2 for panels that are better large; 0 for as many side by side as there is room for."""
    kind: Literal["plots"] = "plots"


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values, as a definition list."""

    title: str
    items: tuple[tuple[str, str], ...]
    kind: Literal["facts"] = "facts"


@dataclass(frozen=True, slots=True)
class Notes:
    """Sentences, one below the other."""

    items: tuple[str, ...]
    kind: Literal["notes"] = "notes"


@dataclass(frozen=True, slots=True)
class Paragraphs:
    """Text to be read from the beginning to the end."""

    items: tuple[str, ...]
    kind: Literal["paragraphs"] = "paragraphs"


Block: TypeAlias = Table | Plots | Facts | Notes | Paragraphs


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page with a heading; `folded` ones open on a click (and in print).

    In the list of contents it is `short`, by default its title; empty for what has no entry there.
    """

    id: str
    title: str
    lead: str = ""
    blocks: tuple[Block, ...] = ()
    folded: bool = False
    short: str | None = None

    @property
    def entry(self) -> str:
        """What the list of contents calls it."""
        return self.title if self.short is None else self.short


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """A number people look for first."""

    label: str
    value: str
    note: str = ""
    mark: Mark = ""


@dataclass(frozen=True, slots=True)
class Badge:
    """The verdict in one word."""

    text: str
    mark: Mark


@dataclass(frozen=True, slots=True)
class Page:
    """A whole report."""

    title: str
    subtitle: str
    badge: Badge
    summary: str
    key_figures: tuple[KeyFigure, ...] = ()
    warnings: tuple[str, ...] = ()
    sections: tuple[Section, ...] = field(default=())
    footer: str = ""


def cells(*texts: str) -> tuple[Cell, ...]:
    """Unmarked cells."""
    return tuple(Cell(text) for text in texts)


def items(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Names and values as text; those without a value are left out."""
    return tuple((key, str(value)) for key, value in values.items() if value not in (None, "", {}))
