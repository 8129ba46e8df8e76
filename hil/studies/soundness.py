"""What a study's result must be like to be drawn and tabulated; studies are plug-ins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from hil.studies.figure import Curve
from hil.studies.result import Part, StudyResult, Table


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
    if curve.y_error and len(curve.y_error) != len(curve.y):
        yield f"{curve.name}: {len(curve.y_error)} error bars for {len(curve.y)} values"
    if len({isinstance(x, str) for x in curve.x}) > 1:
        yield f"{curve.name}: x mixes names and numbers"
