"""What a study finds, in a form that knows neither HTML nor files: tables, curves and sentences.

Everything survives a trip through JSON (`to_dict`, `from_dict`); a NaN becomes null and comes back
as NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from hil.core import card, number

Style = Literal["line", "points", "bars", "identity"]
"""`identity` is the line y = x over the range of the panel; its x and y stay empty."""

Value = str | float | int | None


@dataclass(frozen=True, slots=True)
class Table:
    """A table whose first column names the row.

    Attributes:
        key: Short and stable, e.g. `table-2`; names the file it is exported to.
        title: Says what is in it, with units.
        columns: Headings.
        rows: As many values as columns each; None where there is no number.
        note: Small print below.
        decimals: Of every number that is not whole; by default as many as suit its column.
    """

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    note: str = ""
    decimals: int | None = None

    def _repr_html_(self) -> str:
        """Itself in a notebook."""

        def told(value: Value) -> str:
            if isinstance(value, float) and self.decimals is not None:
                return f"{value:.{self.decimals}f}"
            return (
                number(value) if isinstance(value, float) else str("–" if value is None else value)
            )

        rows = [tuple(map(told, row)) for row in self.rows]
        table = (self.columns, rows)
        notes = [self.note] if self.note else []
        return card("Table", self.title, {}, table=table, most=len(rows), notes=notes)


@dataclass(frozen=True, slots=True)
class Curve:
    """One series of a panel.

    Attributes:
        name: For the legend; neighbours in other panels with the same name look the same.
        x: Numbers, or names for bars.
        y: As many numbers.
        style: How it is drawn.
        y_error: Half-widths of error bars, or empty.
    """

    name: str
    x: tuple[float | str, ...] = ()
    y: tuple[float, ...] = ()
    style: Style = "line"
    y_error: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes.

    Attributes:
        title: Above it.
        x_title, y_title: With units.
        curves: In drawing order.
        corner: Text inside it, such as `R = 0.998`.
    """

    title: str
    x_title: str
    y_title: str
    curves: tuple[Curve, ...]
    corner: str = ""


@dataclass(frozen=True, slots=True)
class Figure:
    """Panels that belong together.

    Attributes:
        key: Short and stable, e.g. `fig-7`; names the file it is exported to.
        title: What it shows.
        caption: How to read it.
        panels: In reading order.
        per_row: Panels side by side.
    """

    key: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    per_row: int = 2


@dataclass(frozen=True, slots=True)
class Part:
    """What was found under one protocol.

    Attributes:
        title: Heading.
        protocol: `honest`, or how it departs from that; empty for parts about no model.
        text: Paragraphs for a reader who has not read the paper.
        tables, figures: In reading order.
    """

    title: str
    protocol: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True, slots=True)
class StudyResult:
    """Everything a study found.

    Attributes:
        study: Name it is registered under.
        title: Heading.
        summary: What a reader should take away, one sentence each, numbers included.
        parts: In reading order.
        parameters: What it was asked for.
        seconds: Wall time.
        warnings: What was left out or replaced, and why.
    """

    study: str
    title: str
    summary: tuple[str, ...]
    parts: tuple[Part, ...]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<StudyResult {self.study}: {len(self.parts)} parts, {self.seconds:.0f} s>"

    def _repr_html_(self) -> str:
        """Itself in a notebook: what to take away; its tables show themselves."""
        facts = {"study": self.study, "parts": ", ".join(part.title for part in self.parts)}
        return card("Study", self.title, facts, notes=(*self.summary, *self.warnings))

    def to_dict(self) -> dict[str, Any]:
        """JSON form, but for NaN; `hil.estimators.base.json_bytes` makes those null."""
        return asdict(self)

    @staticmethod
    def from_dict(raw: Mapping[str, Any]) -> StudyResult:
        """Inverse of `to_dict`, from JSON as well.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or garbled.
        """
        return StudyResult(
            study=str(raw["study"]),
            title=str(raw["title"]),
            summary=_texts(raw["summary"]),
            parts=tuple(_part(part) for part in raw["parts"]),
            parameters=dict(raw.get("parameters", {})),
            seconds=_number(raw.get("seconds")),
            warnings=_texts(raw.get("warnings", ())),
        )


def _part(raw: Mapping[str, Any]) -> Part:
    return Part(
        str(raw["title"]),
        str(raw["protocol"]),
        _texts(raw["text"]),
        tuple(_table(table) for table in raw["tables"]),
        tuple(_figure(figure) for figure in raw["figures"]),
    )


def _table(raw: Mapping[str, Any]) -> Table:
    rows = tuple(tuple(row) for row in raw["rows"])
    columns, decimals = _texts(raw["columns"]), raw.get("decimals")
    kept = None if decimals is None else int(decimals)
    return Table(str(raw["key"]), str(raw["title"]), columns, rows, raw["note"], kept)


def _figure(raw: Mapping[str, Any]) -> Figure:
    panels = tuple(_panel(panel) for panel in raw["panels"])
    key, title, caption = _texts([raw[name] for name in ("key", "title", "caption")])
    return Figure(key, title, caption, panels, int(raw["per_row"]))


def _panel(raw: Mapping[str, Any]) -> Panel:
    title, x_title, y_title = _texts([raw[name] for name in ("title", "x_title", "y_title")])
    curves = tuple(_curve(curve) for curve in raw["curves"])
    return Panel(title, x_title, y_title, curves, str(raw["corner"]))


def _curve(raw: Mapping[str, Any]) -> Curve:
    x = tuple(value if isinstance(value, str) else _number(value) for value in raw["x"])
    y = tuple(_number(value) for value in raw["y"])
    error = tuple(_number(value) for value in raw["y_error"])
    style = raw["style"]
    if style not in ("line", "points", "bars", "identity"):
        raise ValueError(f"style: {style!r:.40}")
    return Curve(str(raw["name"]), x, y, style, error)


def _texts(raw: Sequence[Any]) -> tuple[str, ...]:
    return tuple(str(text) for text in raw)


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
