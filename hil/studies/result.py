"""Result of a study: tables, figures and summary sentences, independent of HTML and file formats.

Study results can be converted to JSON and back (`to_dict`, `from_dict`); NaN is stored as null and
read back as NaN. Studies are plug-ins, so the function `faults_of` checks whether a result can be
displayed. Further functions of the module format numbers and texts for tables.
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
    """Table of a study, whose first column contains the row names.

    Attributes:
        key: Short stable identifier of the table, such as `table-2`; also the name of the exported
            file.
        title: Title of the table with the units of its values.
        columns: Column headings.
        rows: Rows of the table with one value per column; None stands for a missing number.
        note: Explanatory text below the table.
        decimals: Number of decimals of every number that is not an integer; None selects the number
            of decimals per column.
    """

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    note: str = ""
    decimals: int | None = None

    def _repr_html_(self) -> str:
        """Return the table as HTML for a notebook."""

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
    """Results of a study under one protocol.

    Attributes:
        title: Heading.
        protocol: `honest`, or a description of how the evaluation departs from the honest protocol;
            empty for a part that evaluates no model.
        text: Paragraphs that explain the results to a reader who has not read the paper.
        tables, figures: Tables and figures in reading order.
    """

    title: str
    protocol: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True, slots=True)
class StudyResult:
    """Complete result of a study.

    Attributes:
        study: Name under which the study is registered.
        title: Heading.
        summary: Main conclusions of the study with numbers, one sentence each.
        parts: Parts of the result in reading order.
        parameters: Parameters with which the study was executed.
        seconds: Wall-clock time of the study [s].
        warnings: Texts about omitted or replaced items, with the reason.
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
        """Return the summary as HTML for a notebook; the tables are displayed separately."""
        facts = {"study": self.study, "parts": ", ".join(part.title for part in self.parts)}
        return card("Study", self.title, facts, notes=(*self.summary, *self.warnings))

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON.

        Arrays and NaN remain unchanged in the dictionary; `hil.core.json_value` converts them to
        JSON values.
        """
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
        """Create a study result from the output of `to_dict` or from JSON.

        Raises:
            KeyError, TypeError, ValueError: A field of the result is missing or invalid.
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
    """Return the faults that prevent the display of a result; empty if it can be displayed."""
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
    """Return the joint titles from J1 to Jn."""
    return tuple(f"J{j + 1}" for j in range(n))


def values(numbers: FloatArray | Sequence[float]) -> tuple[Value, ...]:
    """Return numbers as table values; None replaces NaN and infinity."""
    return tuple(value(float(number)) for number in numbers)


def value(number: float) -> float | None:
    """Return a number as a table value; None replaces NaN and infinity."""
    return number if np.isfinite(number) else None


def mean_of(per_joint: FloatArray) -> float:
    """Return the mean over the joints that have a finite value; NaN if no joint has one."""
    known = per_joint[np.isfinite(per_joint)]
    return float(np.mean(known)) if len(known) else float("nan")


def with_mean(per_joint: FloatArray) -> tuple[Value, ...]:
    """Return the table values of all joints, followed by the mean of the joints."""
    return values([*per_joint.tolist(), mean_of(per_joint)])


def listed(items: Sequence[str]) -> str:
    """Return the items as a phrase such as `a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else list(items))


def layout_name(layout: Sequence[int]) -> str:
    """Return the layer sizes of a network as a text such as `4-20-20-10-1`."""
    return "-".join(str(units) for units in layout)
