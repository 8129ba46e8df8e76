"""What a study finds, in a form that knows neither HTML nor files: tables, figures and sentences.

Everything survives a trip through JSON (`to_dict`, `from_dict`); a NaN becomes null and comes back
as NaN. Studies are plug-ins, so `faults_of` says what keeps a result from being shown. The last
functions are the numbers and words that studies put into tables.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hil.core import FloatArray, card, number
from hil.studies.figure import Curve, Figure, figure_from_dict

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
        """JSON form, but for arrays and NaN; `hil.core.json_value` converts those."""
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


def _texts(raw: Sequence[Any]) -> tuple[str, ...]:
    return tuple(str(text) for text in raw)


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


def faults_of(result: StudyResult) -> list[str]:
    """What keeps a result from being shown, in words; empty when it is sound."""
    return [f"{part.title}: {fault}" for part in result.parts for fault in _of_part(part)]


def _of_part(part: Part) -> Iterator[str]:
    keys = Counter([*(table.key for table in part.tables), *(f.key for f in part.figures)])
    yield from (f"{n} tables or figures have the key {key!r}" for key, n in keys.items() if n > 1)
    for table in part.tables:
        yield from _of_table(table)
    for figure in part.figures:
        if figure.per_row < 1:
            yield f"{figure.key}: per_row is {figure.per_row}, but must be at least 1"
        for panel in figure.panels:
            for curve in panel.curves:
                yield from (f"{figure.key}, {panel.title}: {text}" for text in _of_curve(curve))


def _of_table(table: Table) -> Iterator[str]:
    for row in table.rows:
        if len(row) != len(table.columns):
            name = row[0] if row else ""
            yield f"{table.key}: {len(row)} values for {len(table.columns)} columns in {name!r}"


def _of_curve(curve: Curve) -> Iterator[str]:
    if len(curve.x) != len(curve.y):
        yield f"{curve.name}: {len(curve.x)} values of x for {len(curve.y)} of y"
    if len(curve.y_error) and len(curve.y_error) != len(curve.y):
        yield f"{curve.name}: {len(curve.y_error)} error bars for {len(curve.y)} values"
    if len({isinstance(x, str) for x in curve.x}) > 1:
        yield f"{curve.name}: x mixes names and numbers"


def joint_titles(n: int) -> tuple[str, ...]:
    """J1 to Jn."""
    return tuple(f"J{j + 1}" for j in range(n))


def values(numbers: FloatArray | Sequence[float]) -> tuple[Value, ...]:
    """Numbers for a table; None where there is none."""
    return tuple(value(float(number)) for number in numbers)


def value(number: float) -> float | None:
    """A number for a table; None for NaN."""
    return number if np.isfinite(number) else None


def mean_of(per_joint: FloatArray) -> float:
    """Mean over the joints it is known for; NaN without any."""
    known = per_joint[np.isfinite(per_joint)]
    return float(np.mean(known)) if len(known) else float("nan")


def with_mean(per_joint: FloatArray) -> tuple[Value, ...]:
    """The joints, and their mean."""
    return values([*per_joint.tolist(), mean_of(per_joint)])


def listed(items: Sequence[str]) -> str:
    """`a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else list(items))


def layout_name(layout: Sequence[int]) -> str:
    """`4-20-20-10-1`."""
    return "-".join(str(units) for units in layout)
