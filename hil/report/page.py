"""A page as data, and the one HTML file it becomes: no network, no neighbours.

A page is a verdict, key figures and sections of tables, figures, facts and notes; nothing that
builds one writes HTML. A new kind of result adds a function that returns a `Section`; template and
style stay as they are.

plotly.js is inside, compressed to 2.0 MB from 4.8 MB: a report is one file that can be mailed,
opened from a read-only share and served by the dashboard. A file shared by all runs of a folder
would be lost with the first report that is copied elsewhere.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from hil.core import utf8_text, write_replacing
from hil.report import colours
from hil.report.curves import dressed, legend, y_of
from hil.report.plotly_figure import figure_json, plotly_of
from hil.report.words import UNKNOWN, number
from hil.studies import Figure, Panel

if TYPE_CHECKING:
    from jinja2 import Environment

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


Block: TypeAlias = Table | Figure | Facts | Notes | Paragraphs


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
    sections: tuple[Section, ...] = ()
    footer: str = ""


def cells(*texts: str) -> tuple[Cell, ...]:
    """Unmarked cells."""
    return tuple(Cell(text) for text in texts)


def items(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Names and values as text; those without a value are left out."""
    return tuple((key, str(value)) for key, value in values.items() if value not in (None, "", {}))


def write_page(page: Page, path: Path) -> Path:
    """Write the page to `path`, whole or not at all; an older report there is replaced.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_replacing(path, utf8_text(page_html(page)).encode())
    return path


def page_html(page: Page) -> str:
    """Return the page as HTML; every text of it is escaped."""
    from markupsafe import Markup

    css = files("hil.report").joinpath("report.css").read_text("utf-8")
    blocks = [block for section in page.sections for block in section.blocks]
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            page=page,
            plotted=any(block.kind == "figure" for block in blocks),
            dark=colours.DARK,
            strokes=colours.STROKES,
            css=Markup(css),  # noqa: S704 - our own file
            plotly=packed_plotly,
        )
    )


def _environment() -> Environment:
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    folder = files("hil.report")
    environment = Environment(
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text("utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["figure_json"] = lambda figure: Markup(figure_json(figure))  # noqa: S704
    environment.filters |= {"dressed": dressed, "legend": legend, "plotly": plotly_of}
    environment.filters["in_words"] = _in_words
    return environment


def _in_words(panel: Panel, figure: Figure) -> str:
    """Return what a panel shows, for those who do not see it: every series with its range."""
    if panel.alt:
        return panel.alt
    told = [f"{figure.title}, {panel.title}", *([panel.corner] if panel.corner else [])]
    for curve in panel.curves:
        y = y_of(curve)
        y = y[np.isfinite(y)]
        if len(y):
            told.append(f"{curve.name}: {number(float(y.min()))} to {number(float(y.max()))}")
    return "; ".join(told)


@cache
def packed_plotly() -> str:
    """Return plotly.js as base64 of gzip, which every browser since 2023 unpacks by itself."""
    from plotly.offline import get_plotlyjs

    # A time of zero: equal pages are equal files.
    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode("ascii")
