"""Report sections about studies: summary, tables and figures.

The module also formats numbers and protocols of studies for page, terminal and paper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from statistics import median_low
from typing import Any

from hil.report.curves import dressed
from hil.report.page import Block, Column, Facts, Notes, Paragraphs, Section, Table, cells, items
from hil.report.words import UNKNOWN, duration, in_words, listed, number
from hil.studies import Part, StudyResult, Value
from hil.studies import Table as StudyTable

MOST_POINTS = 150_000
"""Maximum total number of curve points in a page: about 2 MB of data, in addition to 2 MB of
plotly.js.
"""

FEWEST, ENOUGH = 100, 1200
"""Minimum and maximum number of points of one curve; a plot in the page cannot show more points."""

LONG = 20
"""Minimum number of rows at which a table is placed after the figures.

Figures below a long table would easily be overlooked.
"""


def study_sections(studies: Sequence[StudyResult], models: Sequence[str] = ()) -> list[Section]:
    """Return a summary section and sections for all parts of every study.

    Args:
        studies: Results of the studies of the run.
        models: Names of all models in the order of the page; a model has the same look in all
            plots.
    """
    figures = [f for study in studies for part in study.parts for f in part.figures]
    curves = sum(len(panel.curves) for figure in figures for panel in figure.panels)
    points = max(FEWEST, min(ENOUGH, MOST_POINTS // max(1, curves)))
    titles = zip(distinct_titles(studies), short_titles(studies), strict=True)
    return [
        section
        for i, (study, (title, short)) in enumerate(zip(studies, titles, strict=True), 1)
        for section in _sections(f"study-{i}", study, points, models, title=title, short=short)
    ]


def _sections(
    name: str,
    study: StudyResult,
    points: int,
    models: Sequence[str],
    *,
    title: str,
    short: str,
) -> list[Section]:
    blocks: list[Block] = [Notes(study.summary)]
    asked = {key: in_words(value) for key, value in study.parameters.items()}
    parameters = items({**asked, "took": duration(study.seconds)})
    blocks.append(Facts("Parameters of the study", parameters))
    figures = [figure for part in study.parts for figure in part.figures]
    panels = [panel for figure in figures for panel in figure.panels]
    names = {panel.title for panel in panels} | {c.name for panel in panels for c in panel.curves}
    known = models if not names.isdisjoint(models) else ()
    parts = [_part(f"{name}-{i}", part, points, known) for i, part in enumerate(study.parts, 1)]
    if len(parts) == 1:
        parts = [replace(parts[0], short="")]
    first = Section(name, f"Study: {title}", "", tuple(blocks), short=f"Study: {short}")
    return [first, *parts]


def _part(name: str, part: Part, points: int, models: Sequence[str]) -> Section:
    mark = protocol_mark(part.protocol)
    blocks: list[Block] = [Paragraphs(part.text)] if part.text else []
    blocks += [_table(table) for table in part.tables if len(table.rows) < LONG]
    blocks += [dressed(figure, points, models) for figure in part.figures]
    blocks += [_table(table) for table in part.tables if len(table.rows) >= LONG]
    title = f"{part.title} ({mark})" if mark else part.title
    return Section(name, title, _lead(part.protocol), tuple(blocks))


def _table(table: StudyTable) -> Table:
    columns = tuple(
        Column(title, number=is_numeric(table, i)) for i, title in enumerate(table.columns)
    )
    rows = tuple(zip(*(cells(*column) for column in columns_of(table)), strict=True))
    return Table(table.title, columns, rows, table.note)


HONEST = "honest"

HONEST_MEANS = (
    "Honest protocol: models predict the effort from the motion alone, without the measured "
    "effort, and are evaluated on motions that were not used to fit them."
)


def _lead(protocol: str) -> str:
    """Return a text that explains the protocol.

    For the protocol of a paper, the text states that the numbers do not measure prediction
    accuracy.
    """
    if not protocol:
        return ""
    if protocol == HONEST:
        return HONEST_MEANS
    return (
        f"Protocol {protocol}. These numbers serve for comparison with the paper only; they do not "
        "measure how well a model predicts."
    )


MODEL_KEYS = ("models", "estimators")
"""Names of study parameters that contain names of models."""

DIGITS = 3
"""Number of significant digits for the median of a column, and for a single number."""

MOST_DIGITS = 6
"""Maximum number of digits of the largest number in a column with a common number of decimals.

If the largest number of a column would need more digits, the column has no common number of
decimals.
"""


def columns_of(table: StudyTable) -> list[list[str]]:
    """Return the texts of each column; the numbers of a column have equal decimals if possible."""
    columns = ([row[i] for row in table.rows] for i in range(len(table.columns)))
    return [_column(values, table.decimals) for values in columns]


def _column(values: Sequence[Value], asked: int | None) -> list[str]:
    if asked is not None:
        return [
            f"{round(value, asked) + 0.0:.{asked}f}"
            if isinstance(value, float) and math.isfinite(value)
            else _text(value, asked)
            for value in values
        ]
    decimals = _decimals([value for value in values if isinstance(value, float)])
    return [_text(value, decimals) for value in values]


def _decimals(values: Sequence[float]) -> int | None:
    """Return a common number of decimals for some numbers; None if no number is suitable."""
    sizes = [abs(value) for value in values if math.isfinite(value) and value]
    if not sizes:
        return None
    middle, high = (math.floor(math.log10(size)) for size in (median_low(sizes), max(sizes)))
    decimals = max(0, DIGITS - 1 - middle)
    return decimals if high + 1 + decimals <= MOST_DIGITS else None


def _text(value: Value, decimals: int | None) -> str:
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        # A number that would be rounded to zero is shown with significant digits instead.
        shown = decimals is not None and (value == 0 or abs(value) >= 0.5 * 10.0**-decimals)
        return f"{value:.{decimals}f}" if shown else number(value, DIGITS)
    return str(value)


def distinct_titles(studies: Sequence[StudyResult]) -> list[str]:
    """Return the title of each study; equal titles are extended by distinguishing texts."""
    out = []
    for study in studies:
        alike = [other.parameters for other in studies if other.title == study.title]
        own = list(_differing(study.parameters, alike))
        out.append(f"{study.title} ({', '.join(own)})" if own else study.title)
    return out


def _differing(asked: Mapping[str, Any], alike: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the names of the parameters that differ between studies.

    If the model names of the studies differ, these names replace the parameters that contain
    models.
    """
    told = _models_of(asked)
    named = bool(told) and any(_models_of(other) != told for other in alike)
    if named:
        yield f"of {told}"
    for key, value in asked.items():
        if named and key in MODEL_KEYS:
            continue
        if any(other.get(key) != value for other in alike):
            yield f"{key} {in_words(value)}"


def _models_of(asked: Mapping[str, Any], most: int = 6) -> str:
    """Return the model names of a study, without the digests of stored models."""
    stored = asked.get("models") or ()
    named = [PurePath(str(one)).name.rpartition("-")[0] or str(one) for one in stored]
    return listed(named or [_entry(one) for one in asked.get("estimators") or ()], most)


def _entry(one: Any) -> str:
    """Return the name of an estimator that is passed as a name or as a parameter mapping."""
    return str(one.get("estimator")) if isinstance(one, Mapping) else str(one)


def short_titles(studies: Sequence[StudyResult]) -> list[str]:
    """Return short section titles for the table of contents.

    A short title is the part of the title before the first colon. Equal short titles are extended
    by model names or numbers.
    """
    short = [study.title.partition(":")[0].rstrip("?") for study in studies]
    models = [_models_of(study.parameters, 1) for study in studies]
    out = []
    for i, name in enumerate(short):
        alike = [models[j] for j, other in enumerate(short) if other == name]
        known = models[i] and alike.count(models[i]) == 1
        told = models[i] if known else str(short[: i + 1].count(name))
        out.append(name if len(alike) == 1 else f"{name} ({told})")
    return out


def is_numeric(table: StudyTable, i: int) -> bool:
    """Return whether a column contains no text; false for the first column, which has row names."""
    return i > 0 and not any(isinstance(row[i], str) for row in table.rows)


def protocol_mark(protocol: str) -> str:
    """Return `honest protocol` or `paper protocol`; empty for a part that evaluates no model."""
    word = protocol.partition(":")[0].strip()
    return f"{word} protocol" if word else ""
