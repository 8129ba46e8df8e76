"""Data structure of a page and its conversion into one self-contained HTML file.

A page consists of a verdict, key figures and sections with tables, figures, facts and notes.
Modules that create a page do not write HTML themselves. For a new kind of result, add a function
that returns a `Section`; the template and the style sheet stay unchanged.

Every page contains the library plotly.js, compressed from 4.8 MB to 2.0 MB. A report is therefore
one file that can be sent by e-mail, opened from a read-only share and served by the dashboard. A
library file shared by all runs of a folder would be missing as soon as a report is copied to a
different folder.
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
    """Table cell.

    The `mark` of a cell adds a sign beside its text, so that the meaning does not depend on colour
    alone. The `link` of a cell is an address relative to the page.
    """

    text: str
    mark: Mark = ""
    link: str = ""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table; adjacent columns with the same `group` share a heading."""

    title: str
    group: str = ""
    number: bool = True


@dataclass(frozen=True, slots=True)
class Table:
    """Table of a page, whose first column contains the row names.

    Attributes:
        caption: Title of the table, with the units of its values.
        columns: Columns of the table, starting with the column of row names.
        rows: Rows of the table with one cell per column.
        note: Explanatory text below the table.
    """

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    kind: Literal["table"] = "table"

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Heading and number of columns of every column group, in order; empty without groups."""
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
        """Return the table without number columns that contain only unknown values."""
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
    """Names with values, displayed as a definition list."""

    title: str
    items: tuple[tuple[str, str], ...]
    kind: Literal["facts"] = "facts"


@dataclass(frozen=True, slots=True)
class Notes:
    """Sentences, displayed as a list."""

    items: tuple[str, ...]
    kind: Literal["notes"] = "notes"


@dataclass(frozen=True, slots=True)
class Paragraphs:
    """Continuous text of a page, in paragraphs."""

    items: tuple[str, ...]
    kind: Literal["paragraphs"] = "paragraphs"


Block: TypeAlias = Table | Figure | Facts | Notes | Paragraphs


@dataclass(frozen=True, slots=True)
class Section:
    """Part of a page with a heading and contents.

    If `folded` is true, the section is closed on the screen until a click, but open in print. The
    text `short` is the entry of the section in the table of contents: the title by default, or
    empty for no entry.
    """

    id: str
    title: str
    lead: str = ""
    blocks: tuple[Block, ...] = ()
    folded: bool = False
    short: str | None = None

    @property
    def entry(self) -> str:
        """Entry of the section in the table of contents."""
        return self.title if self.short is None else self.short


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """Important number that is displayed at the top of a page."""

    label: str
    value: str
    note: str = ""
    mark: Mark = ""


@dataclass(frozen=True, slots=True)
class Badge:
    """Verdict that is displayed as one word."""

    text: str
    mark: Mark


@dataclass(frozen=True, slots=True)
class Page:
    """Complete report page."""

    title: str
    subtitle: str
    badge: Badge
    summary: str
    key_figures: tuple[KeyFigure, ...] = ()
    warnings: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()
    footer: str = ""


def cells(*texts: str) -> tuple[Cell, ...]:
    """Return the cells of a table row without marks."""
    return tuple(Cell(text) for text in texts)


def items(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return names and values as text; names without a value are omitted."""
    return tuple((key, str(value)) for key, value in values.items() if value not in (None, "", {}))


def write_page(page: Page, path: Path) -> Path:
    """Write the page to `path` atomically, replacing an older page.

    Raises:
        RecordingError: The page cannot be written.
    """
    write_replacing(path, utf8_text(page_html(page)).encode())
    return path


def page_html(page: Page) -> str:
    """Return the page as HTML with all texts escaped."""
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
            css=Markup(css),  # noqa: S704 - trusted file of this package
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
    """Return the alternative text of a panel: every curve with its range of values."""
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
    """Return the compressed plotly.js (gzip, base64), which browsers since 2023 can unpack."""
    from plotly.offline import get_plotlyjs

    # A time stamp of zero, so that equal pages yield byte-identical files.
    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode("ascii")
