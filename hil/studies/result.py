"""What a study finds, in a form that knows neither HTML nor files: tables, figures and sentences.

Everything survives a trip through JSON (`to_dict`, `from_dict`); a NaN becomes null and comes back
as NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from hil.core import card, number
from hil.studies.figure import Figure, figure_from_dict

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
        return {
            "study": self.study,
            "title": self.title,
            "summary": self.summary,
            "parts": [_part_to_dict(part) for part in self.parts],
            "parameters": dict(self.parameters),
            "seconds": self.seconds,
            "warnings": self.warnings,
        }

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
            seconds=float("nan" if raw.get("seconds") is None else raw["seconds"]),
            warnings=_texts(raw.get("warnings", ())),
        )


def _part_to_dict(part: Part) -> dict[str, Any]:
    return {
        "title": part.title,
        "protocol": part.protocol,
        "text": part.text,
        "tables": [asdict(table) for table in part.tables],
        "figures": [figure.to_dict() for figure in part.figures],
    }


def _part(raw: Mapping[str, Any]) -> Part:
    return Part(
        str(raw["title"]),
        str(raw["protocol"]),
        _texts(raw["text"]),
        tuple(_table(table) for table in raw["tables"]),
        tuple(figure_from_dict(figure) for figure in raw["figures"]),
    )


def _table(raw: Mapping[str, Any]) -> Table:
    rows = tuple(tuple(row) for row in raw["rows"])
    columns, decimals = _texts(raw["columns"]), raw.get("decimals")
    kept = None if decimals is None else int(decimals)
    return Table(str(raw["key"]), str(raw["title"]), columns, rows, raw["note"], kept)


def _texts(raw: Sequence[Any]) -> tuple[str, ...]:
    return tuple(str(text) for text in raw)
