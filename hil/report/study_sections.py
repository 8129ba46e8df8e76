"""Sections about studies: what a reader should take away, then all tables and figures.

Also how the numbers and protocols of studies are said on the page, in the terminal and on paper.
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
"""Of all series of a page together: about 2 MB, beside 2 MB of the plotting library."""

FEWEST, ENOUGH = 100, 1200
"""Points of one series: never fewer, and more than these no plot of the page can show."""

LONG = 20
"""Rows from which on a table comes after the figures: nobody reads on to them below it."""


def study_sections(studies: Sequence[StudyResult], models: Sequence[str] = ()) -> list[Section]:
    """For every study what it comes to, followed by its parts.

    Args:
        studies: What they found.
        models: Of the page, in its order: they look alike in all plots.
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
    blocks.append(Facts("How it was made", items({**asked, "took": duration(study.seconds)})))
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
    "Honest protocol: models predict the effort from the motion alone, without a look at what was "
    "measured, and errors are of motions that were not used in fitting them."
)


def _lead(protocol: str) -> str:
    """What a protocol is, before anybody reads its numbers; a paper's are no predictions."""
    if not protocol:
        return ""
    if protocol == HONEST:
        return HONEST_MEANS
    return (
        f"Protocol {protocol}. These numbers are there to be compared with the paper's; they are "
        "no measure of how well a model predicts."
    )


MODEL_KEYS = ("models", "estimators")
"""Parameters of studies that name models."""

DIGITS = 3
"""Significant digits of the median of a column, and of any number that stands by itself."""

MOST_DIGITS = 6
"""A column whose largest number would take more is not brought to common decimals."""


def columns_of(table: StudyTable) -> list[list[str]]:
    """The texts of each column; the numbers of one have equally many decimals where they can."""
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
    """How many decimals suit all of some numbers; None where each needs its own."""
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
        # A number far below the others keeps digits of its own: it is small, and not nothing.
        shown = decimals is not None and (value == 0 or abs(value) >= 0.5 * 10.0**-decimals)
        return f"{value:.{decimals}f}" if shown else number(value, DIGITS)
    return str(value)


def distinct_titles(studies: Sequence[StudyResult]) -> list[str]:
    """Title of each study; of those with equal titles, with the models or what else differs."""
    out = []
    for study in studies:
        alike = [other.parameters for other in studies if other.title == study.title]
        own = list(_differing(study.parameters, alike))
        out.append(f"{study.title} ({', '.join(own)})" if own else study.title)
    return out


def _differing(asked: Mapping[str, Any], alike: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What is not the same in all of them; models by name where their names do it."""
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
    """Names of the models a study is of, those of stored ones without digests."""
    stored = asked.get("models") or ()
    named = [PurePath(str(one)).name.rpartition("-")[0] or str(one) for one in stored]
    return listed(named or [_entry(one) for one in asked.get("estimators") or ()], most)


def _entry(one: Any) -> str:
    """An estimator, by name or with its parameters beside that."""
    return str(one.get("estimator")) if isinstance(one, Mapping) else str(one)


def short_titles(studies: Sequence[StudyResult]) -> list[str]:
    """For a list of contents: up to the colon; of those alike, with models or numbers."""
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
    """Whether a column holds numbers only; the first names the rows."""
    return i > 0 and not any(isinstance(row[i], str) for row in table.rows)


def protocol_mark(protocol: str) -> str:
    """`honest protocol`, `paper protocol`; empty for parts about no model."""
    word = protocol.partition(":")[0].strip()
    return f"{word} protocol" if word else ""
